"""The network's promises, in float64, on untrained weights: they hold by construction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.export.vectors import (
    move,
    named_scenes,
    nan_where_invalid,
    road_scene,
    seen_for,
    without_map,
    without_neighbours,
)
from eqrt.training.losses import best_mode_loss, spread_loss
from eqrt.training.networks.canonical import canonical_from_tile, heading_vector
from eqrt.training.networks.compact import CompactConfig, CompactPredictor, ModeLayer
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.registry import ModelConfig
from eqrt.training.networks.spread import FLOOR_M, START_M, START_MPS
from poses import random_pose

SCENE = SceneConfig(
    num_agents=6,
    history_steps=20,
    num_centerlines=5,
    centerline_points=12,
    lane_choice="routes",
    horizon_steps=30,
    num_modes=3,
    dt_s=0.1,
)
CONFIG = CompactConfig(width=24, hidden=40, heads=4, layers=2, dropout=0.1)
CONTRACT = SCENE.contract("test", "0.0.0")
SCENES = named_scenes(CONTRACT)
SOMEWHERE = Pose2(5.0, 5.0, 0.3)


VARIANTS = {
    "one step": replace(CONFIG, heading="one_step"),
    "points": replace(CONFIG, tokens="point"),
    "uncertain": replace(CONFIG, uncertainty=True),
    "translated": replace(CONFIG, frame="translated"),
}


def random_network(config: CompactConfig) -> CompactPredictor:
    """Random weights everywhere, also where training starts from zero."""
    torch.manual_seed(7)
    model = CompactPredictor(SCENE, config).double().eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model


@pytest.fixture(scope="module")
def model() -> CompactPredictor:
    return random_network(CONFIG)


@pytest.fixture(scope="module")
def variants() -> dict[str, CompactPredictor]:
    return {name: random_network(config) for name, config in VARIANTS.items()}


def predict(model: CompactPredictor, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    trajectories, probabilities, *_ = outputs(model, scene)
    return trajectories, probabilities


def outputs(model: CompactPredictor, scene: Scene) -> list[np.ndarray]:
    """All there are, in the contract's order."""
    inputs = [torch.from_numpy(value) for value in scene.inputs().values()]
    with torch.no_grad():
        found = model(*(value.double() if value.is_floating_point() else value for value in inputs))
    return [output.numpy() for output in found]


def in_double(scene: Scene) -> Scene:
    """Turning in float64, so that nothing but the network can break the symmetry."""
    names = ("history", "heading", "centerlines")
    changes: dict[str, Any] = {name: getattr(scene, name).astype(np.float64) for name in names}
    return replace(scene, **changes)


def move_exactly(scene: Scene, pose: Pose2) -> Scene:
    changes: dict[str, Any] = {
        "history": pose.apply(np.asarray(scene.history, np.float64)),
        "heading": pose.rotate(np.asarray(scene.heading, np.float64)),
        "centerlines": pose.apply(np.asarray(scene.centerlines, np.float64)),
    }
    return replace(scene, **changes)


@pytest.mark.parametrize("name", SCENES)
def test_turning_and_shifting_the_world_turns_and_shifts_the_prediction(
    model: CompactPredictor, name: str
) -> None:
    rng = np.random.default_rng(3)
    scene = in_double(nan_free(SCENES[name]))
    before, probabilities = predict(model, scene)
    for _ in range(10):
        pose = random_pose(rng, 900.0)
        after, same = predict(model, move_exactly(scene, pose))
        np.testing.assert_allclose(after, pose.apply(before), atol=1e-8)
        np.testing.assert_allclose(same, probabilities, atol=1e-10)


def nan_free(scene: Scene) -> Scene:
    return replace(
        scene, history=np.nan_to_num(scene.history), centerlines=np.nan_to_num(scene.centerlines)
    )


def test_a_mirror_image_is_another_scene(model: CompactPredictor) -> None:
    """Traffic keeps to one side: SE(2), deliberately not E(2)."""
    scene = in_double(SCENES["driving"])
    flip = np.array([1.0, -1.0])
    mirrored = replace(scene, history=scene.history * flip, centerlines=scene.centerlines * flip)
    before, _ = predict(model, scene)
    after, _ = predict(model, mirrored)
    assert np.abs(after * flip - before).max() > 0.01


@pytest.mark.parametrize("name", SCENES)
def test_values_under_false_masks_are_never_read(model: CompactPredictor, name: str) -> None:
    clean, _ = predict(model, nan_free(SCENES[name]))
    dirty, _ = predict(model, nan_where_invalid(SCENES[name]))
    np.testing.assert_array_equal(dirty, clean)


def test_an_agent_that_was_never_seen_moves_nobody(model: CompactPredictor) -> None:
    scene = without_neighbours(SCENES["driving"])
    elsewhere = replace(scene, history=scene.history.copy())
    elsewhere.history[:, 1:] += 5.0
    np.testing.assert_array_equal(predict(model, scene)[0], predict(model, elsewhere)[0])


def test_padding_with_more_agents_and_lines_changes_nothing(model: CompactPredictor) -> None:
    scene = SCENES["driving"]
    agents, lines = SCENE.num_agents, SCENE.num_centerlines
    small = replace(
        scene,
        history=scene.history[:, :3],
        history_valid=scene.history_valid[:, :3],
        centerlines=scene.centerlines[:, :2],
        centerlines_valid=scene.centerlines_valid[:, :2],
    )
    padded = replace(
        scene,
        history_valid=scene.history_valid & (np.arange(agents) < 3)[None, :, None],
        centerlines_valid=scene.centerlines_valid & (np.arange(lines) < 2)[None, :, None],
    )
    np.testing.assert_allclose(predict(model, padded)[0], predict(model, small)[0], atol=1e-10)


def test_the_order_of_neighbours_and_lines_does_not_matter(model: CompactPredictor) -> None:
    scene = SCENES["driving"]
    agents, lines = [0, 4, 2, 5, 1, 3], [3, 0, 4, 1, 2]
    shuffled = replace(
        scene,
        history=scene.history[:, agents],
        history_valid=scene.history_valid[:, agents],
        centerlines=scene.centerlines[:, lines],
        centerlines_valid=scene.centerlines_valid[:, lines],
    )
    np.testing.assert_allclose(predict(model, shuffled)[0], predict(model, scene)[0], atol=1e-10)


def test_neighbours_and_map_do_matter(model: CompactPredictor) -> None:
    full, _ = predict(model, SCENES["driving"])
    for poorer in (without_map(SCENES["driving"]), without_neighbours(SCENES["driving"])):
        assert np.abs(predict(model, poorer)[0] - full).max() > 1e-4


def test_a_lone_standing_agent_without_map_is_predicted_where_it_stands(
    model: CompactPredictor,
) -> None:
    """Nothing in such a scene has a direction, so no other answer could be equivariant."""
    scene = SCENES["lone_agent_no_map_stopped"]
    trajectories, _ = predict(model, scene)
    here = np.broadcast_to(scene.history[0, 0, -1], trajectories.shape)
    np.testing.assert_allclose(trajectories, here, atol=1e-6)


def test_probabilities_sum_to_one_and_fall(model: CompactPredictor) -> None:
    for scene in SCENES.values():
        _, probabilities = predict(model, scene)
        np.testing.assert_allclose(probabilities.sum(-1), 1.0)
        assert (np.diff(probabilities, axis=-1) <= 0).all()


@pytest.mark.parametrize("steps", [1, 2, 20])
def test_gradients_are_finite_whatever_is_masked(steps: int) -> None:
    torch.manual_seed(1)
    model = CompactPredictor(SCENE, CONFIG)
    for scene in (SCENES["stopped"], without_map(SCENES["driving"]), SCENES["driving"]):
        model.zero_grad()
        inputs = [torch.from_numpy(value) for value in seen_for(scene, steps).inputs().values()]
        future = torch.zeros(1, SCENE.horizon_steps, 2)
        seen = torch.ones(1, SCENE.horizon_steps, dtype=torch.bool)
        trajectories, probabilities = model(*inputs)
        loss = best_mode_loss(trajectories, probabilities, future, seen)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        gradients: list[Tensor] = [p.grad for p in model.parameters() if p.grad is not None]
        assert gradients
        assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_the_rotation_turns_the_heading_onto_x() -> None:
    heading = torch.tensor([[0.6, 0.8], [-1.0, 0.0]])
    turned = canonical_from_tile(heading) @ heading.unsqueeze(-1)
    torch.testing.assert_close(turned[..., 0], torch.tensor([[1.0, 0.0], [1.0, 0.0]]))


def test_the_printed_sign_of_the_rotation_would_not_be_invariant(
    model: CompactPredictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper prints the rotation by +theta; only -theta makes the network equivariant."""

    def printed(heading: Tensor) -> Tensor:
        return canonical_from_tile(heading).transpose(-1, -2)

    monkeypatch.setattr("eqrt.training.networks.target_view.canonical_from_tile", printed)
    scene, pose = in_double(SCENES["driving"]), Pose2(3.0, 4.0, 1.0)
    before, _ = predict(model, scene)
    after, _ = predict(model, move_exactly(scene, pose))
    assert np.abs(after - pose.apply(before)).max() > 1e-3


def test_a_layer_is_the_usual_attention_although_it_computes_no_keys_and_no_values() -> None:
    """Against torch's own multi-head attention with the same weights."""
    torch.manual_seed(3)
    layer = ModeLayer(CONFIG).double().eval()
    queries, tokens = torch.randn(4, 3, 24).double(), torch.randn(4, 7, 24).double()
    missing = torch.rand(4, 7) < 0.4
    missing[:, 0] = False
    told = layer(
        queries.flatten(0, 1),
        tokens,
        tokens.transpose(1, 2),
        -1e9 * missing.unsqueeze(1).double(),
    )
    usual = torch.nn.MultiheadAttention(24, CONFIG.heads, batch_first=True).double()
    weights = [layer.query.weight, layer.key.weight, layer.value.weight]
    with torch.no_grad():
        usual.in_proj_weight.copy_(torch.cat(weights))
        usual.in_proj_bias.zero_()
        usual.in_proj_bias[:24] = layer.query.bias
        usual.out_proj.weight.copy_(layer.project.weight)
        usual.out_proj.bias.zero_()
        attended, _ = usual(layer.norm1(queries), tokens, tokens, key_padding_mask=missing)
        expected = queries + attended
        expected = expected + layer.narrow(layer.widen(layer.norm2(expected)))
    torch.testing.assert_close(told, expected.flatten(0, 1))


@pytest.mark.parametrize(
    ("apart_deg", "least"), [(0.0, 1.0), (60.0, 1.0), (115.0, 1.0), (150.0, 0.5), (180.0, 0.0)]
)
def test_a_heading_is_whole_unless_its_sources_contradict_each_other(
    apart_deg: float, least: float
) -> None:
    """The shortest at any speed, and nowhere does it turn or shrink faster than speed changes."""
    speed = torch.linspace(0.0, 2.0, 2001).double().unsqueeze(1)
    angle = torch.deg2rad(torch.tensor(apart_deg).double())
    measured = torch.stack([angle.cos(), angle.sin()]).expand(2001, 2)
    heading = heading_vector(speed * torch.tensor([1.0, 0.0]), measured, torch.zeros(2001, 2))
    lengths = heading.norm(dim=1)
    assert float(lengths.max()) <= 1.0 + 1e-12
    assert float(lengths.min()) == pytest.approx(least, abs=0.02)
    torch.testing.assert_close(heading[-1], torch.tensor([1.0, 0.0]).double())
    assert float((heading[1:] - heading[:-1]).norm(dim=1).max()) < 0.01  # per mm/s


def test_the_slightest_motion_is_a_heading_where_nothing_else_is() -> None:
    moved, none = torch.tensor([[0.0, 0.02], [0.3, 0.4]]), torch.zeros(2, 2)
    expected = torch.tensor([[0.0, 1.0], [0.6, 0.8]])
    torch.testing.assert_close(heading_vector(moved, none, none), expected)


def facing(scene: Scene, direction: float, *, measured: bool) -> Scene:
    """Its target moves along +x: so (1), or against it (-1), leads what else says its heading."""
    if measured:
        return replace(scene, heading=np.array([[direction, 0.0]], np.float32))
    onward = slice(None, None, int(direction))
    lines, valid = scene.centerlines[:, :, onward], scene.centerlines_valid[:, :, onward]
    return replace(scene, centerlines=lines.copy(), centerlines_valid=valid.copy())


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_slowly_stopping_target_is_predicted_without_a_jump(
    model: CompactPredictor, direction: float, measured: bool
) -> None:
    """Between driving, crawling and standing the expected end moves, but nowhere jumps.

    Where it moves most from one speed to the next, it moves in proportion to the difference. So
    does one that reverses, and one that creeps against the lanes beside it.
    """

    def ends(speeds: np.ndarray) -> np.ndarray:
        """Expectation over the modes, whose order changes where two are as probable."""
        roads = [facing(road_scene(CONTRACT, v), direction, measured=measured) for v in speeds]
        pairs = [predict(model, move(road, SOMEWHERE)) for road in roads]
        return np.array([probabilities[0] @ paths[0, :, -1] for paths, probabilities in pairs])

    speeds = np.linspace(2.0, 0.0, 101)
    moved = np.linalg.norm(np.diff(ends(speeds), axis=0), axis=-1)
    at = int(moved.argmax())
    between = np.linspace(speeds[at], speeds[at + 1], 11)
    finer = np.linalg.norm(np.diff(ends(between), axis=0), axis=-1)
    assert finer.max() < 0.3 * moved[at]


def test_in_bfloat16_the_prediction_moves_by_its_features_not_by_its_positions() -> None:
    """Far from the target bfloat16 knows positions to a metre; only what is learned may feel it.

    Fresh weights hardly draw, so that what remains is the course, in float32.
    """
    torch.manual_seed(2)
    model = CompactPredictor(SCENE, CONFIG).eval()
    inputs = [torch.from_numpy(value) for value in SCENES["driving"].inputs().values()]
    with torch.no_grad():
        expected, _ = model(*inputs)
        with torch.autocast("cpu", torch.bfloat16):
            rounded, _ = model(*inputs)
    assert rounded.dtype == torch.float32
    assert 0.0 < float((rounded - expected).abs().max()) < 0.1


# --- what else it may be: each choice against the other


@pytest.mark.parametrize("scene_name", SCENES)
@pytest.mark.parametrize("variant", ["one step", "points", "uncertain"])
def test_variants_that_turn_are_equivariant_and_so_are_covariances(
    variants: dict[str, CompactPredictor], variant: str, scene_name: str
) -> None:
    rng = np.random.default_rng(5)
    scene = in_double(nan_free(SCENES[scene_name]))
    before, probabilities, *covariances = outputs(variants[variant], scene)
    for _ in range(4):
        pose = random_pose(rng, 900.0)
        after, same, *turned = outputs(variants[variant], move_exactly(scene, pose))
        np.testing.assert_allclose(after, pose.apply(before), atol=1e-8)
        np.testing.assert_allclose(same, probabilities, atol=1e-10)
        turn = pose.rotate(np.eye(2)).T  # its columns are where x and y go
        for expected, found in zip(covariances, turned, strict=True):
            np.testing.assert_allclose(found, turn @ expected @ turn.T, atol=1e-8)


def test_a_network_that_only_translates_is_shifted_but_not_turned(
    variants: dict[str, CompactPredictor],
) -> None:
    model, scene = variants["translated"], in_double(SCENES["driving"])
    before, _ = predict(model, scene)
    shift, turn = Pose2(-80.0, 35.0, 0.0), Pose2(0.0, 0.0, 1.0)
    after, _ = predict(model, move_exactly(scene, shift))
    np.testing.assert_allclose(after, shift.apply(before), atol=1e-8)
    after, _ = predict(model, move_exactly(scene, turn))
    assert np.abs(after - turn.apply(before)).max() > 0.1


def test_the_last_step_tells_the_heading_of_the_last_second_only_on_a_straight_course(
    model: CompactPredictor, variants: dict[str, CompactPredictor]
) -> None:
    """The two networks have the same weights, so that only the frame can differ."""
    bend = in_double(without_map(SCENES["driving"]))
    straight = replace(bend, history=bend.history * np.array([1.0, 0.0]))
    same, _ = predict(variants["one step"], straight)
    np.testing.assert_allclose(same, predict(model, straight)[0], atol=1e-5)
    other, _ = predict(variants["one step"], bend)
    assert np.abs(other - predict(model, bend)[0]).max() > 0.01


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("variant", VARIANTS)
def test_no_variant_reads_values_under_false_masks(
    variants: dict[str, CompactPredictor], variant: str, name: str
) -> None:
    clean = outputs(variants[variant], nan_free(SCENES[name]))
    dirty = outputs(variants[variant], nan_where_invalid(SCENES[name]))
    for one, other in zip(clean, dirty, strict=True):
        np.testing.assert_array_equal(one, other)


def test_points_of_a_line_may_come_in_any_place_but_say_which_way_it_leads(
    variants: dict[str, CompactPredictor],
) -> None:
    """Swapping whole lines changes nothing; driving them the other way does."""
    model, scene = variants["points"], SCENES["driving"]
    swapped = replace(
        scene,
        centerlines=scene.centerlines[:, ::-1].copy(),
        centerlines_valid=scene.centerlines_valid[:, ::-1].copy(),
    )
    before, _ = predict(model, scene)
    np.testing.assert_allclose(predict(model, swapped)[0], before, atol=1e-10)
    against = replace(
        scene,
        centerlines=scene.centerlines[:, :, ::-1].copy(),
        centerlines_valid=scene.centerlines_valid[:, :, ::-1].copy(),
    )
    assert np.abs(predict(model, against)[0] - before).max() > 1e-3


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"heading": "north"}, "heading is 'north', expected one of one_step, robust"),
        ({"frame": "map"}, "frame is 'map', expected one of translated, rotated"),
        ({"tokens": "pixel"}, "tokens is 'pixel', expected one of line, point"),
    ],
)
def test_a_choice_that_there_is_not_is_named(setting: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(CONFIG, **setting)


def test_a_configuration_from_before_the_choices_means_what_it_meant() -> None:
    tables = ModelConfig(scene=SCENE, kind="compact", network=CONFIG).to_tables()
    old = {name: tables["network"][name] for name in ("kind", "width", "hidden", "heads")}
    old |= {"layers": 2, "dropout": 0.1}
    assert set(tables["network"]) - set(old) == {"heading", "frame", "tokens", "uncertainty"}
    assert ModelConfig.from_tables(tables["scene"], old).network == CONFIG
    del old["width"]
    with pytest.raises(ValueError, match=r"\[network\] has missing or unknown fields: width"):
        ModelConfig.from_tables(tables["scene"], old)


def test_the_contract_has_a_third_output_if_the_network_has() -> None:
    certain = ModelConfig(scene=SCENE, kind="compact", network=CONFIG).contract("test", "0.0.0")
    assert certain == CONTRACT
    uncertain = ModelConfig(scene=SCENE, kind="compact", network=VARIANTS["uncertain"])
    assert uncertain.contract("test", "0.0.0") == replace(CONTRACT, covariances=True)


# --- predicted uncertainty


def test_fresh_weights_predict_the_same_with_and_without_uncertainty() -> None:
    networks = []
    for config in (CONFIG, VARIANTS["uncertain"]):
        torch.manual_seed(4)
        networks.append(CompactPredictor(SCENE, config).double().eval())
    for scene in SCENES.values():
        for one, other in zip(*(predict(network, scene) for network in networks), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", SCENES)
def test_covariances_are_symmetric_and_nowhere_below_the_floor(
    variants: dict[str, CompactPredictor], name: str
) -> None:
    *_, covariances = outputs(variants["uncertain"], SCENES[name])
    assert covariances.shape == (1, SCENE.num_modes, SCENE.horizon_steps, 2, 2)
    np.testing.assert_array_equal(covariances, covariances.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(covariances).min() > 0.0
    assert np.linalg.det(covariances).min() > (3 * FLOOR_M**2) ** 2


def test_training_starts_from_a_spread_that_grows_with_time() -> None:
    """0.15 m after a step and 1.6 m after three seconds, within half as much again."""
    torch.manual_seed(4)
    model = CompactPredictor(SCENE, VARIANTS["uncertain"]).double().eval()
    *_, covariances = outputs(model, SCENES["driving"])
    scale = np.linalg.det(covariances[0] / 3) ** 0.25  # (K, H) metres
    for step in (0, 9, 29):
        expected = START_M + START_MPS * 0.1 * (step + 1)
        assert (scale[:, step] > expected / 1.5).all()
        assert (scale[:, step] < expected * 1.5).all()


def test_the_spread_of_a_target_without_any_direction_is_a_circle(
    variants: dict[str, CompactPredictor],
) -> None:
    *_, covariances = outputs(variants["uncertain"], SCENES["lone_agent_no_map_stopped"])
    np.testing.assert_allclose(covariances[..., 0, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(covariances[..., 0, 0], covariances[..., 1, 1])
    assert covariances[..., 0, 0].min() > FLOOR_M**2


def test_covariances_come_in_the_order_of_their_modes(
    variants: dict[str, CompactPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without probabilities that differ, modes stay as they are drawn: the same pairs are there."""
    model, scene = variants["uncertain"], SCENES["driving"]
    sorted_modes = outputs(model, scene)
    assert model.modes.logit is not None
    with torch.no_grad():
        last = list(model.modes.logit.parameters())[-2]
        monkeypatch.setattr(last, "data", -last.data)  # the least probable first
    turned_over = outputs(model, scene)
    for ahead, behind in zip(sorted_modes[::2], turned_over[::2], strict=True):
        np.testing.assert_allclose(ahead, behind[:, ::-1], atol=1e-10)


@pytest.mark.parametrize("steps", [1, 2, 20])
def test_gradients_of_the_spread_are_finite_whatever_is_masked(steps: int) -> None:
    torch.manual_seed(1)
    model = CompactPredictor(SCENE, VARIANTS["uncertain"])
    future = torch.zeros(1, SCENE.horizon_steps, 2)
    for name, seen_until in (("stopped", 30), ("lone_agent_no_map_stopped", 7), ("driving", 0)):
        model.zero_grad()
        scene = seen_for(SCENES[name], steps)
        inputs = [torch.from_numpy(value) for value in scene.inputs().values()]
        trajectories, _, covariances = model(*inputs)
        seen = (torch.arange(SCENE.horizon_steps) < seen_until)[None]
        spread_loss(trajectories, covariances, future, seen).backward()  # type: ignore[no-untyped-call]
        assert model.modes.spread is not None
        gradients = [p.grad for p in model.modes.spread.parameters() if p.grad is not None]
        assert gradients
        assert all(torch.isfinite(gradient).all() for gradient in gradients)
