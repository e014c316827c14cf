"""The form in which the paper's systems are exported is the trained network, to rounding error."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor, nn

from eqrt.core.scene import Scene, concatenate
from eqrt.export.folded import folded
from eqrt.export.folded.backbone import FoldedNonlinearity
from eqrt.export.folded.products import PairsOf
from eqrt.export.folded.tokens import FoldedAttention, FoldedTransformer, PointMeans
from eqrt.export.to_onnx import to_onnx
from eqrt.training.networks.eqmotion import EqMotion
from eqrt.training.networks.layers import VectorNonlinearity
from eqrt.training.networks.map_tokens import AttentionEncoder, TransformerEncoder
from paper_systems import EQMOTION, SCENE, SCENES, SYSTEMS, nan_free, predict, small_system

EXACT = 1e-10
"""Metres, in float64."""


def both(model: nn.Module, scene: Scene, num_agents: int = 4) -> tuple[Any, Any]:
    """Trajectories of a network in float64, and of its folded form."""
    return predict(model, scene), predict(folded(model, num_agents).eval(), scene)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_folded_form_answers_as_the_network_does(name: str) -> None:
    model = small_system(SYSTEMS[name]).double()
    for scene_name, scene in SCENES.items():
        expected, found = both(model, nan_free(scene))
        np.testing.assert_allclose(found, expected, atol=EXACT, rtol=0, err_msg=scene_name)


@pytest.mark.parametrize("name", SYSTEMS)
def test_so_does_it_for_many_scenes_at_once(name: str) -> None:
    together = concatenate([nan_free(scene) for scene in SCENES.values()])
    expected, found = both(small_system(SYSTEMS[name]).double(), together)
    np.testing.assert_allclose(found, expected, atol=EXACT, rtol=0)


@pytest.mark.parametrize(
    "changes", [{"categories": 1}, {"mlp_layers": 2}, {"mlp_layers": 3}, {"layers": 5}]
)
def test_so_does_it_in_other_sizes(changes: dict[str, Any]) -> None:
    model = small_system(replace(EQMOTION, **changes)).double()
    expected, found = both(model, nan_free(SCENES["driving"]))
    np.testing.assert_allclose(found, expected, atol=EXACT, rtol=0)


@pytest.mark.parametrize("agents", [1, 2, 3])
def test_so_does_it_for_other_numbers_of_agents(agents: int) -> None:
    model = small_system(EQMOTION, replace(SCENE, num_agents=agents)).double()
    scene = nan_free(SCENES["driving"])
    fewer = replace(
        scene, history=scene.history[:, :agents], history_valid=scene.history_valid[:, :agents]
    )
    expected, found = both(model, fewer, agents)
    np.testing.assert_allclose(found, expected, atol=EXACT, rtol=0)


def test_several_modes_come_with_the_same_probabilities() -> None:
    model = small_system(EQMOTION, replace(SCENE, num_modes=3))
    inputs = [torch.from_numpy(value) for value in SCENES["driving"].inputs().values()]
    with torch.no_grad():
        expected, found = model(*inputs), folded(model, 4).eval()(*inputs)
    torch.testing.assert_close(found[0], expected[0], atol=1e-4, rtol=0)
    torch.testing.assert_close(found[1], expected[1])


def test_a_network_is_folded_from_what_it_is_and_stays_so() -> None:
    model = small_system(EQMOTION)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    form = folded(model, 4)
    assert not isinstance(form, EqMotion)
    assert list(model.state_dict()) == list(before)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_what_has_no_folded_form_is_exported_as_it_is() -> None:
    lstm, lone = small_system(SYSTEMS["lstm"]), small_system(EQMOTION)
    assert folded(lstm, 4) is lstm
    assert folded(lone, 1) is lone


# -- piece by piece


def test_the_nonlinearity_keeps_its_side_whatever_the_sign_of_its_factor() -> None:
    torch.manual_seed(2)
    layer, vectors = VectorNonlinearity(6).double(), torch.randn(3, 4, 2, 6).double()
    factor = torch.tensor([0.1, -0.3, 0.0, 2.0, -1.0, 1e-30]).double()
    form = FoldedNonlinearity(layer, factor, PairsOf(4, factor))
    found = form(vectors.transpose(1, 2)).view(3, 2, 4, 6).transpose(1, 2)
    torch.testing.assert_close(found, factor * layer(vectors), atol=1e-14, rtol=0)


def naive_means(query: Tensor, key: Tensor, points: Tensor, valid: Tensor) -> Tensor:
    """One head's (B, P, 2): the mean of the valid points under the softmax of scaled products."""
    whole = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    score = (whole @ query.T) @ (whole @ key.T).transpose(-1, -2) / len(query) ** 0.5
    share = score.masked_fill(~valid.unsqueeze(1), -torch.inf).softmax(-1)
    means: Tensor = share @ points
    return means


@pytest.mark.parametrize("spread", [1.0, 300.0])
def test_points_are_averaged_under_exact_attention(spread: float) -> None:
    """Over more queries than are taken at a time, and with scores of any size."""
    torch.manual_seed(3)
    query, key = torch.randn(2, 2 * 5, 3).double().unbind(0)
    valid = torch.rand(2, 130) < 0.8
    points = spread * torch.randn(2, 130, 2).double() * valid.unsqueeze(-1)
    means = PointMeans(query, key, 2, points)
    columns = torch.cat([points.transpose(1, 2), torch.ones(2, 1, 130).double()], 1)
    found = means(columns, valid.unsqueeze(1))  # (B, 4, P): x of both heads, then y
    for head in range(2):
        rows = slice(5 * head, 5 * head + 5)
        expected = naive_means(query[rows], key[rows], points, valid)
        torch.testing.assert_close(found[:, head], expected[..., 0], atol=1e-9, rtol=1e-9)
        torch.testing.assert_close(found[:, 2 + head], expected[..., 1], atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("heads", [1, 6])
def test_map_encoders_give_the_same_feature_whatever_is_valid(heads: int) -> None:
    torch.manual_seed(4)
    transformer = TransformerEncoder(20, 12, heads, [8, 8]).double()
    attention = AttentionEncoder(20, 5, [8, 8]).double()
    for parameter in (*transformer.parameters(), *attention.parameters()):
        parameter.data.add_(torch.randn_like(parameter))
    valid = torch.arange(20) < torch.tensor([[20], [7], [1], [0]])
    points = torch.randn(4, 20, 2).double() * valid.unsqueeze(-1)
    pairs = ((transformer, FoldedTransformer(transformer)), (attention, FoldedAttention(attention)))
    for encoder, form in pairs:
        torch.testing.assert_close(form(points, valid), encoder(points, valid))


# -- the graph


def operators(layers: int) -> Counter[tuple[str, str]]:
    """Of the exported transformer on rotated maps: (domain, kind) -> how many."""
    model = small_system(replace(EQMOTION, layers=layers))
    graph = onnx.load_from_string(to_onnx(model, SCENE.contract("test", "0.0.0"), {})).graph
    return Counter((node.domain, node.op_type) for node in graph.node)


def test_a_layer_is_a_hundred_cheap_operators_all_of_the_standard() -> None:
    one, two = operators(1), operators(2)
    assert {domain for domain, _ in two} == {""}
    layer = two - one
    assert sum(layer.values()) <= 100
    assert layer["", "Conv"] == 2  # R perceptrons side by side
    assert layer["", "Gemm"] + layer["", "MatMul"] <= 26
    expensive = {"ReduceSum", "ReduceMean", "Expand", "Where", "Gather", "Concat", "Pow"}
    assert not expensive & {kind for _, kind in layer}


@pytest.mark.parametrize("heads", [1, 6])
def test_no_share_of_attention_is_too_small_for_a_normal_float(heads: int) -> None:
    """A softmax full of exponentials that are takes an Intel processor ten times as long."""
    torch.manual_seed(5)
    encoder = FoldedTransformer(TransformerEncoder(40, 12, heads, [8, 8]))
    shares: list[Tensor] = []
    softmax = Tensor.softmax

    def noted(scores: Tensor, dim: int) -> Tensor:
        shares.append(softmax(scores, dim))
        return shares[-1]

    valid = torch.arange(40) < torch.tensor([[40], [7], [1], [0]])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tensor, "softmax", noted)
        encoder(3.0 * torch.randn(4, 40, 2) * valid.unsqueeze(-1), valid)
    assert shares
    assert min(share.min() for share in shares) >= torch.finfo(torch.float32).tiny


def test_points_that_do_not_exist_weigh_nothing() -> None:
    torch.manual_seed(6)
    few = torch.randn(1, 9, 2).double()
    padded = torch.cat([few, torch.zeros(1, 900, 2).double()], 1)
    query, key = torch.randn(2, 2 * 5, 3).double().unbind(0)
    means = PointMeans(query, key, 2, few)

    def found(points: Tensor) -> Tensor:
        valid = torch.arange(points.shape[1]) < 9
        ones = torch.ones(1, 1, points.shape[1]).double()
        seen: Tensor = means(torch.cat([points.mT, ones], 1), valid.view(1, 1, -1))
        return seen[..., :9]

    torch.testing.assert_close(found(padded), found(few), atol=1e-13, rtol=0)
