"""Muon: orthogonal steps for hidden matrices, AdamW's for the rest."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn
from torch.optim import AdamW

from eqrt.training.muon import MIN_SIDE, Muon, orthogonalized


def network(width: int = 2 * MIN_SIDE) -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(3, width), nn.Tanh(), nn.Linear(width, width), nn.Linear(width, 1)
    )


def fit(model: nn.Module, optimizer: torch.optim.Optimizer, steps: int) -> float:
    """The loss after some steps on a smooth function."""
    torch.manual_seed(1)
    x = torch.randn(256, 3)
    y = (x.sum(-1, keepdim=True)).sin()
    for _ in range(steps):
        loss = (model(x) - y).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return float(loss.item())


@pytest.mark.parametrize("shape", [(3, 8, 8), (2, 12, 5), (1, 5, 12)])
def test_the_direction_keeps_singular_vectors_and_evens_out_their_lengths(
    shape: tuple[int, ...],
) -> None:
    torch.manual_seed(0)
    matrices = torch.randn(shape, dtype=torch.float64)
    left, _, right = torch.linalg.svd(matrices, full_matrices=False)
    found = left.transpose(-1, -2) @ orthogonalized(matrices) @ right.transpose(-1, -2)
    lengths = found.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(torch.diag_embed(lengths), found, atol=1e-9, rtol=0)
    assert 0.4 < float(lengths.min()) < float(lengths.max()) < 1.3


def test_only_hidden_matrices_take_orthogonal_steps() -> None:
    """What is no hidden matrix goes exactly as AdamW would have moved it."""
    model = network()
    before, reference = copy.deepcopy(model), copy.deepcopy(model)
    vectors = {"weight_decay": 0.0, "params": [w for w in reference.parameters() if w.dim() < 2]}
    matrices = {"weight_decay": 0.1, "params": [w for w in reference.parameters() if w.dim() == 2]}
    fit(reference, AdamW([matrices, vectors], lr=1e-2), steps=1)
    fit(model, Muon(model, 1e-2, 0.1), steps=1)
    for name, weight in model.named_parameters():
        if name == "2.weight":
            gradient: torch.Tensor = reference.get_parameter(name).grad  # type: ignore[assignment]
            moved = weight - before.get_parameter(name) * (1.0 - 1e-2 * 0.1)
            step = -1e-2 * 0.2 * len(weight) ** 0.5 * orthogonalized(gradient[None])[0]
            torch.testing.assert_close(moved, step, atol=1e-5, rtol=1e-3)
        else:
            torch.testing.assert_close(weight, reference.get_parameter(name))


def test_it_learns() -> None:
    model = network()
    untrained = fit(model, Muon(model, 3e-3, 0.0), 1)
    assert fit(model, Muon(model, 3e-3, 0.0), 150) < 0.2 * untrained


def test_a_frozen_weight_stays() -> None:
    model = network()
    frozen = model.get_parameter("2.weight").requires_grad_(False)
    before = frozen.clone()
    fit(model, Muon(model, 1e-2, 0.1), steps=2)
    assert torch.equal(frozen, before)
