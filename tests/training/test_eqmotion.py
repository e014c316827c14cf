"""The paper's systems on EqMotion: what each promises, in float64, on random weights."""

from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.export.vectors import nan_where_invalid, seen_for, without_map, without_neighbours
from eqrt.training.losses import ade_loss
from eqrt.training.networks.canonical import canonical_from_tile
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.eqmotion import EqMotion, EqMotionConfig
from eqrt.training.networks.eqmotion_layers import Agents, channel_distances
from eqrt.training.networks.lstm import LstmBaseline, LstmConfig
from eqrt.training.networks.map_tokens import (
    AttentionEncoder,
    TransformerEncoder,
    attend,
    choose,
    read_side_by_side,
)
from eqrt.training.networks.target_frame import TargetFrame, fitted_velocity, last_step
from paper_systems import (
    EQMOTION,
    EQUIVARIANT,
    SCENE,
    SCENES,
    SYSTEMS,
    move_exactly,
    nan_free,
    predict,
    small_system,
)
from poses import random_pose
from source_tree import ROOT

ON_EQMOTION = {name: config for name, config in SYSTEMS.items() if name != "lstm"}
CONFIGS = sorted((ROOT / "training" / "configs").glob("paper-*.toml"))
ROWS = [path for path in CONFIGS if not path.stem.endswith("recipe")]


@pytest.fixture(params=ON_EQMOTION)
def system(request: pytest.FixtureRequest) -> nn.Module:
    return small_system(SYSTEMS[request.param]).double()


@pytest.fixture(params=EQUIVARIANT)
def equivariant(request: pytest.FixtureRequest) -> nn.Module:
    return small_system(EQUIVARIANT[request.param]).double()


def test_turning_and_shifting_the_world_turns_and_shifts_the_prediction(
    equivariant: nn.Module,
) -> None:
    rng = np.random.default_rng(3)
    for name, scene in SCENES.items():
        before = predict(equivariant, nan_free(scene))
        for _ in range(3):
            pose = random_pose(rng, 900.0)
            after = predict(equivariant, move_exactly(nan_free(scene), pose))
            np.testing.assert_allclose(after, pose.apply(before), atol=1e-8, err_msg=name)


@pytest.mark.parametrize("name", ["translated_attention", "translated_transformer"])
def test_a_map_that_is_only_translated_breaks_the_symmetry(name: str) -> None:
    """Shifting the world still shifts the prediction; turning it does something else."""
    model = small_system(SYSTEMS[name]).double()
    before = predict(model, SCENES["driving"])
    shift, turn = Pose2(30.0, -20.0, 0.0), Pose2(0.0, 0.0, 1.0)
    shifted = predict(model, move_exactly(SCENES["driving"], shift))
    turned = predict(model, move_exactly(SCENES["driving"], turn))
    np.testing.assert_allclose(shifted, shift.apply(before), atol=1e-8)
    assert np.abs(turned - turn.apply(before)).max() > 0.01


def test_the_printed_sign_of_the_rotation_would_not_be_invariant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The paper prints the rotation by +theta; only -theta makes the network equivariant."""

    def printed(heading: Tensor) -> Tensor:
        return canonical_from_tile(heading).transpose(-1, -2)

    monkeypatch.setattr("eqrt.training.networks.target_frame.canonical_from_tile", printed)
    model, pose = small_system(EQMOTION).double(), Pose2(3.0, 4.0, 1.0)
    before = predict(model, SCENES["driving"])
    after = predict(model, move_exactly(SCENES["driving"], pose))
    assert np.abs(after - pose.apply(before)).max() > 1e-3


def test_a_mirror_image_is_another_scene(system: nn.Module) -> None:
    """Traffic keeps to one side: SE(2), deliberately not E(2)."""
    scene, flip = SCENES["driving"], np.array([1.0, -1.0], np.float32)
    mirrored = replace(scene, history=scene.history * flip, centerlines=scene.centerlines * flip)
    assert np.abs(predict(system, mirrored) * flip - predict(system, scene)).max() > 1e-6


def test_values_under_false_masks_are_never_read(system: nn.Module) -> None:
    for scene in SCENES.values():
        clean = predict(system, nan_free(scene))
        np.testing.assert_array_equal(predict(system, nan_where_invalid(scene)), clean)


def test_padding_with_more_agents_changes_nothing(system: nn.Module) -> None:
    scene = SCENES["driving"]
    two = replace(scene, history=scene.history[:, :2], history_valid=scene.history_valid[:, :2])
    hidden = scene.history_valid & (np.arange(SCENE.num_agents) < 2)[None, :, None]
    padded = replace(scene, history_valid=hidden)
    np.testing.assert_allclose(predict(system, padded), predict(system, two), atol=1e-10)


def test_the_order_of_the_neighbours_does_not_matter(system: nn.Module) -> None:
    scene, order = seen_for(SCENES["driving"], 12), [0, 3, 1, 2]
    shuffled = replace(
        scene, history=scene.history[:, order], history_valid=scene.history_valid[:, order]
    )
    np.testing.assert_allclose(predict(system, shuffled), predict(system, scene), atol=1e-10)


def test_neighbours_do_matter(system: nn.Module) -> None:
    full = predict(system, SCENES["driving"])
    assert np.abs(predict(system, without_neighbours(SCENES["driving"])) - full).max() > 1e-4


@pytest.mark.parametrize("name", ON_EQMOTION)
def test_the_map_matters_where_there_is_one(name: str) -> None:
    model = small_system(SYSTEMS[name]).double()
    full = predict(model, SCENES["driving"])
    changed = np.abs(predict(model, without_map(SCENES["driving"])) - full).max()
    assert changed == 0.0 if name == "no_map" else changed > 1e-4


def test_a_lone_standing_agent_without_map_is_predicted_where_it_stands() -> None:
    """Nothing in such a scene has a direction, so no other answer could be equivariant."""
    scene = SCENES["lone_agent_no_map_stopped"]
    for config in EQUIVARIANT.values():
        found = predict(small_system(config).double(), scene)
        here = np.broadcast_to(scene.history[0, 0, -1], found.shape)
        np.testing.assert_allclose(found, here, atol=1e-6)


def test_a_batch_is_its_scenes_one_by_one(system: nn.Module) -> None:
    scenes = [nan_free(scene).inputs() for scene in SCENES.values()]
    batch = {name: np.concatenate([scene[name] for scene in scenes]) for name in scenes[0]}
    together = predict(system, replace(SCENES["driving"], **batch))
    alone = [predict(system, nan_free(scene))[0] for scene in SCENES.values()]
    np.testing.assert_allclose(together, alone, atol=1e-10)


@pytest.mark.parametrize("steps", [1, 2, 20])
@pytest.mark.parametrize("name", SYSTEMS)
def test_gradients_are_finite_whatever_is_masked(name: str, steps: int) -> None:
    model = small_system(SYSTEMS[name]).train()
    for scene in (SCENES["driving"], SCENES["lone_agent_no_map_stopped"], SCENES["stopped"]):
        model.zero_grad()
        inputs = [torch.from_numpy(value) for value in seen_for(scene, steps).inputs().values()]
        seen = torch.ones(1, SCENE.horizon_steps, dtype=torch.bool)
        trajectories, probabilities = model(*inputs)
        future = torch.zeros(1, SCENE.horizon_steps, 2)
        loss = ade_loss(trajectories, probabilities, future, seen)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        gradients = {key: value.grad for key, value in model.named_parameters()}
        assert [key for key, value in gradients.items() if value is None] == []
        assert all(torch.isfinite(value).all() for value in gradients.values() if value is not None)


@pytest.mark.parametrize("name", SYSTEMS)
def test_several_modes_come_with_probabilities_the_highest_first(name: str) -> None:
    model = small_system(SYSTEMS[name], replace(SCENE, num_modes=3))
    inputs = [torch.from_numpy(value) for value in SCENES["driving"].inputs().values()]
    trajectories, probabilities = model(*inputs)
    assert trajectories.shape == (1, 3, SCENE.horizon_steps, 2)
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(1))
    assert (probabilities.diff(dim=-1) <= 0).all()


def test_twenty_layers_keep_the_scale_of_features_and_gradients() -> None:
    """What enters the paper's depth comes out of it, and learns from it."""
    torch.manual_seed(3)
    model = EqMotion(SCENE, replace(EQMOTION, layers=20, hidden=32))
    history = torch.from_numpy(SCENES["driving"].history)
    valid = torch.from_numpy(SCENES["driving"].history_valid)
    agents = Agents.of(valid, history.dtype)
    first, pattern = model.initial((history - history[:, :1, -1:]) / 10.0, valid, agents, None)
    weights = model.interaction(first, pattern, agents).permute(3, 0, 1, 2).unsqueeze(-1)
    last = first
    for layer in model.layers:
        last, pattern = layer(last, pattern, weights, agents)
    assert 0.2 < float((last.std() / first.std()).detach()) < 5.0
    last.square().sum().backward()
    named = dict(model.layers.named_parameters())
    steps = [named[f"{layer}.geometric.step"].grad for layer in (0, 19)]
    sizes = [float(step.norm()) for step in steps if step is not None]
    assert 0.05 < sizes[0] / sizes[1] < 20.0


def test_categories_of_a_pair_sum_to_one() -> None:
    model = EqMotion(SCENE, EQMOTION)
    agents = Agents.of(torch.ones(2, 4, 20, dtype=torch.bool), torch.float32)
    weights = model.interaction(torch.randn(2, 4, 2, 8), torch.randn(2, 4, 8), agents)
    assert weights.shape == (2, 4, 4, EQMOTION.categories)
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 4, 4))


def test_channel_distances_are_those_between_the_agents() -> None:
    geometric = torch.tensor([[[[0.0], [0.0]], [[3.0], [4.0]]]])  # two agents, one vector each
    expected = torch.tensor([[0.0, 5.0], [5.0, 0.0]])
    torch.testing.assert_close(channel_distances(geometric)[0, ..., 0], expected, atol=2e-3, rtol=0)


def test_the_centre_counts_only_agents_that_exist() -> None:
    valid = torch.tensor([[[True], [True], [False]]])
    agents = Agents.of(valid, torch.float32)
    geometric = torch.tensor([2.0, 4.0, 100.0]).view(1, 3, 1, 1).expand(1, 3, 2, 5)
    torch.testing.assert_close(agents.centre(geometric), torch.full((1, 1, 2, 1), 3.0))


# -- the target's frame


def facing(name: str, scene: Scene, heading: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Which way the target is taken to face: the x axis of its frame, in the tile's axes."""
    frame = TargetFrame("rotated", name, SCENE.dt_s, SCENE.centerline_points)
    history, valid = torch.from_numpy(scene.history), torch.from_numpy(scene.history_valid)
    seen = frame(
        torch.where(valid[..., None], history, 0.0)[:, 0],
        valid[:, 0],
        torch.tensor([heading]),
        torch.from_numpy(scene.centerlines),
        torch.from_numpy(scene.centerlines_valid),
    )
    x_axis: Tensor = seen.tile_from_frame[0, :, 0]
    return x_axis


def with_track(x: list[float], y: list[float]) -> Scene:
    """The driving scene, the target's last positions replaced by these."""
    scene = SCENES["driving"]
    history = scene.history.copy()
    history[0, 0] = 0.0
    history[0, 0, -len(x) :, 0], history[0, 0, -len(y) :, 1] = x, y
    return replace(scene, history=history)


def test_one_step_heading_is_the_last_displacement_and_nothing_else() -> None:
    scene = with_track([0.0, 5.0, 5.0], [0.0, 0.0, 1.0])
    torch.testing.assert_close(facing("one_step", scene, (-1.0, 0.0)), torch.tensor([0.0, 1.0]))


def test_one_step_heading_of_a_target_that_stands_is_measured_or_the_lanes() -> None:
    scene = with_track([0.0] * 20, [0.0] * 20)
    measured, lane = facing("one_step", scene, (0.0, -1.0)), facing("one_step", scene)
    torch.testing.assert_close(measured, torch.tensor([0.0, -1.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(lane, torch.tensor([1.0, 0.0]), atol=0.05, rtol=0)


def test_robust_heading_hardly_minds_the_last_displacement() -> None:
    along = [0.5 * step for step in range(20)]
    scene = with_track(along, [0.0] * 19 + [0.3])
    assert facing("one_step", scene)[1] > 0.5
    assert facing("robust", scene)[1] < 0.1


def test_the_last_step_is_between_the_last_two_seen_positions() -> None:
    history = torch.tensor([[[1.0, 1.0], [2.0, 5.0], [0.0, 0.0], [4.0, 6.0]]])
    seen = torch.tensor([[True, True, False, True]])
    torch.testing.assert_close(last_step(history, seen), torch.tensor([[2.0, 1.0]]))
    once = torch.tensor([[False, True, False, False]])
    torch.testing.assert_close(last_step(history, once), torch.zeros(1, 2))


def test_fitted_velocity_of_steady_motion_is_its_velocity_however_much_was_seen() -> None:
    time = torch.arange(20) * 0.1
    history = (time[:, None] * torch.tensor([3.0, -4.0]) + 50.0)[None]
    for seen in (2, 5, 20):
        valid = (torch.arange(20) >= 20 - seen)[None]
        found = fitted_velocity(history * valid[..., None], valid, 0.1)
        torch.testing.assert_close(found, torch.tensor([[3.0, -4.0]]), atol=1e-3, rtol=0)
    once = torch.arange(20)[None] == 19
    torch.testing.assert_close(fitted_velocity(history, once, 0.1), torch.zeros(1, 2))


# -- the map's tokens


def test_tokens_that_are_not_valid_are_not_attended_to() -> None:
    torch.manual_seed(1)
    qkv, valid = torch.randn(2, 9, 3 * 8), torch.ones(2, 9, dtype=torch.bool)
    padded = torch.cat([qkv, 100.0 * torch.randn(2, 5, 3 * 8)], 1)
    padded_valid = torch.cat([valid, torch.zeros(2, 5, dtype=torch.bool)], 1)
    expected = attend(qkv, valid, 2)
    torch.testing.assert_close(attend(padded, padded_valid, 2)[:, :9], expected)


def test_attention_is_the_softmax_of_scaled_products() -> None:
    torch.manual_seed(1)
    query, key, value = torch.randn(3, 1, 5, 4).unbind(0)
    expected = (query @ key.transpose(-1, -2) / 2.0).softmax(-1) @ value
    found = attend(torch.cat([query, key, value], -1), torch.ones(1, 5, dtype=torch.bool), 1)
    torch.testing.assert_close(found, expected)


def test_a_map_without_a_valid_point_has_the_feature_of_no_map() -> None:
    encoder = AttentionEncoder(6, 4, [8, 8])
    nothing = torch.zeros(2, 6, dtype=torch.bool)
    feature = encoder(torch.randn(2, 6, 2), nothing)
    torch.testing.assert_close(feature[0], feature[1])
    torch.testing.assert_close(feature[0], encoder.perceptron(torch.zeros(24)))


ENCODERS: dict[str, Callable[[float], nn.Module]] = {
    "attention": lambda dropout: AttentionEncoder(8, 4, [8, 8], dropout),
    "transformer": lambda dropout: TransformerEncoder(8, 4, 2, [8, 8], dropout),
}
"""Over eight points."""


def encoded(kind: str, dropout: float, training: bool) -> tuple[Tensor, nn.Module]:
    torch.manual_seed(4)
    encoder = ENCODERS[kind](dropout).train(training)
    points, valid = torch.randn(3, 8, 2), torch.ones(3, 8, dtype=torch.bool)
    valid[0, 5:] = False
    torch.manual_seed(9)
    feature: Tensor = encoder(points, valid)
    return feature, encoder


@pytest.mark.parametrize("kind", ENCODERS)
def test_no_point_is_dropped_when_the_training_is_over(kind: str) -> None:
    assert torch.equal(encoded(kind, 0.5, training=False)[0], encoded(kind, 0.0, False)[0])
    torch.testing.assert_close(encoded(kind, 1e-9, True)[0], encoded(kind, 0.0, True)[0])
    assert not torch.equal(encoded(kind, 0.5, True)[0], encoded(kind, 0.0, True)[0])


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_training_step_learns_from_the_points_that_it_reads_and_no_others(kind: str) -> None:
    feature, encoder = encoded(kind, 0.75, training=True)
    first = encoder.get_parameter("perceptron.0.weight")
    (gradient,) = torch.autograd.grad(feature.sum(), first)
    read = gradient.view(-1, 8, 4).abs().amax(dim=(0, 2)) > 0
    torch.manual_seed(9)
    chosen = choose(8, 0.75)
    assert chosen is not None
    assert set(read.nonzero().flatten().tolist()) == set(chosen.tolist())
    assert len(chosen) == 2


def test_what_is_left_of_the_points_counts_for_more() -> None:
    """Side by side the expected sum stays the same, over all choices."""
    torch.manual_seed(2)
    perceptron, tokens = nn.Sequential(nn.Linear(8, 3)), torch.randn(5, 4, 2)
    whole = read_side_by_side(perceptron, tokens, None)
    each = [
        read_side_by_side(perceptron, tokens[:, chosen], chosen)
        for chosen in (torch.tensor(pair) for pair in itertools.combinations(range(4), 2))
    ]
    torch.testing.assert_close(torch.stack(each).mean(0), whole)


# -- configurations


def table(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text(encoding="utf-8"))


def on_meta(path: Path) -> nn.Module:
    """The network of a configuration file, without memory."""
    tables = table(path)
    scene, network = SceneConfig(**tables["scene"]), dict(tables["network"])
    with torch.device("meta"):
        if network.pop("kind") == "lstm":
            return LstmBaseline(scene, LstmConfig(**network))
        return EqMotion(scene, EqMotionConfig(**network))


def test_there_is_one_configuration_per_row_of_the_papers_table() -> None:
    assert [path.stem.split("-")[1] for path in ROWS] == list("1234567")
    for path in CONFIGS:
        assert table(path)["name"] == path.stem


def test_the_rows_differ_in_their_network_only() -> None:
    first = table(ROWS[0])
    for path in ROWS:
        assert {**table(path), "name": "", "network": {}} == {**first, "name": "", "network": {}}


def test_rotating_the_map_costs_no_parameters() -> None:
    assert weights_of(ROWS[2]) == weights_of(ROWS[3])
    assert weights_of(ROWS[4]) == weights_of(ROWS[5])


def weights_of(path: Path) -> int:
    return sum(parameter.numel() for parameter in on_meta(path).parameters())


def test_the_parameters_in_the_documentation_are_the_networks() -> None:
    text = (ROOT / "docs" / "systems.md").read_text(encoding="utf-8")
    stated = re.findall(r"^\| (\d) \|.*?\| ([\d.]+) M \|", text, re.MULTILINE)
    counted = [(str(row + 1), f"{weights_of(path) / 1e6:.2f}") for row, path in enumerate(ROWS)]
    assert stated == counted


@pytest.mark.parametrize(("field", "value"), [("map", "photo"), ("frame", "x"), ("heading", "y")])
def test_an_unknown_choice_is_named(field: str, value: str) -> None:
    changes: dict[str, Any] = {field: value}
    with pytest.raises(ValueError, match=f"{field} is '{value}', expected one of"):
        replace(EQMOTION, **changes)


def test_heads_must_divide_the_token_width() -> None:
    with pytest.raises(ValueError, match="token_width is 64, expected a multiple of heads, 12"):
        replace(EQMOTION, map="transformer", heads=12, token_width=64)


def test_every_field_of_the_configuration_is_in_the_files() -> None:
    for path in CONFIGS:
        network = table(path)["network"]
        kind = LstmConfig if network["kind"] == "lstm" else EqMotionConfig
        assert set(network) - {"kind"} == {field.name for field in fields(kind)}
