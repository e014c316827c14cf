"""EqMotion (Xu et al., CVPR 2023) layer by layer, with masks.

    geometric (B, N, 2, C)  C vectors per agent, relative to the target; they turn with the world
    pattern   (B, N, D)     D numbers per agent; they do not

Where EqMotion subtracts the mean of G from what its layers turn into something new, and adds it
again, so do these: the mean over all agents that exist, and over the channels (`centre`).

Left of the paper's road, because twenty layers must train: attention and interaction start at the
identity; a geometric layer adds a tenth of its result to what it was given, where EqMotion replaces
it; a pattern layer adds too, and reads through a LayerNorm. Angles enter as cosine and sine, so a
left and a right turn differ: traffic keeps to one side.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.layers import VectorNonlinearity, cross, dot, length, mlp

_STEP = 0.1
"""Share of a geometric layer's result that is added, at first."""
_STILL = 0.01
"""Network units per second (0.1 m/s): below this speed a direction of motion fades out."""


@dataclass(frozen=True, slots=True)
class Agents:
    """Which agents there are, and which see each other."""

    exist: Tensor
    """(B, N, 1, 1) 1.0 where the agent was ever seen."""
    pairs: Tensor
    """(B, N, N, 1) 1.0 where agent j exists and is not i."""

    @classmethod
    def of(cls, valid: Tensor, dtype: torch.dtype) -> Agents:
        """From history_valid (B, N, T)."""
        exists = valid.any(-1)
        apart = ~torch.eye(exists.shape[1], dtype=torch.bool, device=exists.device)
        pairs = (exists.unsqueeze(1) & apart).to(dtype).unsqueeze(-1)
        return cls(exists[..., None, None].to(dtype), pairs)

    def centre(self, geometric: Tensor) -> Tensor:
        """The mean (B, 1, 2, 1) of (B, N, 2, C) over agents and channels."""
        count = self.exist.sum(1, keepdim=True).clamp(min=1.0)
        return (geometric.mean(-1, keepdim=True) * self.exist).sum(1, keepdim=True) / count


class GroupedLinear(nn.Module):
    """R linear layers side by side, in one product."""

    def __init__(self, groups: int, inputs: int, outputs: int, *, bias: bool = True) -> None:
        super().__init__()
        bound = inputs**-0.5  # as nn.Linear starts
        self.weight = nn.Parameter(torch.empty(groups, inputs, outputs).uniform_(-bound, bound))
        shape = (groups, 1, outputs)
        self.bias = nn.Parameter(torch.empty(shape).uniform_(-bound, bound)) if bias else None

    def forward(self, values: Tensor) -> Tensor:
        """(M, inputs), the same for all, or (R, M, inputs) -> (R, M, outputs)."""
        product: Tensor = values @ self.weight
        return product if self.bias is None else product + self.bias


class PairPerceptron(nn.Module):
    """R perceptrons over [pattern of i, pattern of j, channel distances] of every pair.

    The first layer is split into three products, so that the concatenation never exists.
    """

    def __init__(
        self, width: int, distances: int, outputs: int, *, layers: int, groups: int = 1
    ) -> None:
        """`layers` of all, 2 or more; `groups` is R."""
        super().__init__()
        self.receiver = GroupedLinear(groups, width, width)
        self.sender = GroupedLinear(groups, width, width, bias=False)
        self.distance = GroupedLinear(groups, distances, width, bias=False)
        self.rest = nn.ModuleList(
            GroupedLinear(groups, width, width if index else outputs)
            for index in reversed(range(layers - 1))
        )

    def forward(self, pattern: Tensor, distance: Tensor) -> Tensor:
        """Pattern (B, N, D), distances (B, N, N, C) -> (R, B, N, N, outputs)."""
        agents, width = pattern.shape[1], pattern.shape[2]
        every = pattern.flatten(0, 1)
        receiver = self.receiver(every).view(-1, every.shape[0] // agents, agents, 1, width)
        sender = self.sender(every).view(-1, every.shape[0] // agents, 1, agents, width)
        apart = self.distance(distance.flatten(0, 2))
        pair: Tensor = (receiver + sender).flatten(1, 3) + apart
        for layer in self.rest:
            pair = layer(nn.functional.silu(pair))
        return pair.view(pair.shape[0], -1, agents, agents, pair.shape[-1])


def channel_distances(geometric: Tensor) -> Tensor:
    """|G_j - G_i| for every channel: (B, N, 2, C) -> (B, N, N, C)."""
    return length(geometric.unsqueeze(1) - geometric.unsqueeze(2))


class Initialisation(nn.Module):
    """EqMotion's initialisation layer.

    Geometric: bias-free mixing of the steps around the centre of all. Pattern: speeds, angles
    between successive velocities, which steps were seen, and what the map adds (`MapFusion`).
    """

    def __init__(self, steps: int, dt_s: float, width: int, layers: int) -> None:
        super().__init__()
        self.dt_s = dt_s
        self.mix = nn.Linear(steps, width, bias=False)
        self.motion = nn.Linear(steps + (steps - 1) + 2 * (steps - 2), width)
        self.pattern = nn.Sequential(nn.SiLU(), mlp([width] * layers))

    def forward(
        self, history: Tensor, valid: Tensor, agents: Agents, from_map: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """G (B, N, 2, C) and H (B, N, D).

        history (B, N, T, 2): network units, relative to the target's last position; a step that was
        not seen holds the agent's last seen position. from_map (B, 1, D), or None.
        """
        positions = history.transpose(2, 3)  # (B, N, 2, T)
        centre = agents.centre(positions)
        geometric = self.mix(positions - centre) + centre
        pattern = self.motion(self._invariants(positions, valid))
        if from_map is not None:
            pattern = pattern + from_map
        return geometric, self.pattern(pattern)

    def _invariants(self, positions: Tensor, valid: Tensor) -> Tensor:
        """(B, N, I): speeds, cosine and sine of the turn from step to step, what was seen."""
        both = valid[..., 1:] & valid[..., :-1]
        velocity = (positions[..., 1:] - positions[..., :-1]) / self.dt_s
        velocity = torch.where(both.unsqueeze(2), velocity, torch.zeros_like(velocity))
        speed = (dot(velocity, velocity) + _STILL**2).sqrt()
        before, after = velocity[..., :-1], velocity[..., 1:]
        scale = speed[..., :-1] * speed[..., 1:]
        turn = [dot(before, after) / scale, cross(before, after) / scale]
        return torch.cat([valid.to(positions.dtype), speed, *turn], -1)


class MapFusion(nn.Module):
    """Hands the map's feature to the agents.

    The feature is as invariant as its frame, so it joins the pattern features, of every agent.
    Vectors made from it lie in the target's frame: they are turned back into the tile's axes and
    join the target's geometric features.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.pattern = nn.Linear(width, width, bias=False)
        self.vectors = nn.Linear(width, 2 * width)

    def forward(self, feature: Tensor, tile_from_frame: Tensor) -> tuple[Tensor, Tensor]:
        """Feature (B, D), rotation (B, 2, 2) -> for H (B, 1, D), for one G (B, 1, 2, C)."""
        vectors = self.vectors(feature).unflatten(-1, (2, -1))
        return self.pattern(feature).unsqueeze(1), (tile_from_frame @ vectors).unsqueeze(1)


class InteractionReasoning(nn.Module):
    """Soft categories of every pair of agents, inferred once (EqMotion's reasoning module)."""

    def __init__(self, width: int, categories: int, layers: int) -> None:
        super().__init__()
        self.message = PairPerceptron(width, width, width, layers=layers)
        self.update = mlp([2 * width] + [width] * layers)
        self.category = PairPerceptron(width, width, categories, layers=layers)

    def forward(self, geometric: Tensor, pattern: Tensor, agents: Agents) -> Tensor:
        """Weights (B, N, N, R) that sum to 1 over the R categories."""
        distance = channel_distances(geometric)
        message = (self.message(pattern, distance)[0] * agents.pairs).sum(2)  # (B, N, D)
        reasoned = self.update(torch.cat([message, pattern], -1))
        weights: Tensor = self.category(reasoned, distance)[0].softmax(-1)
        return weights


class GeometricLayer(nn.Module):
    """G further on: inner-agent attention, inter-agent aggregation, equivariant non-linearity."""

    def __init__(self, width: int, categories: int, layers: int) -> None:
        super().__init__()
        self.attention = mlp([width] * (layers + 1))
        self.interaction = PairPerceptron(width, width, width, layers=layers, groups=categories)
        _start_at_zero(self.attention[-1], self.interaction.rest[-1])
        self.nonlinearity = VectorNonlinearity(width)
        self.step = nn.Parameter(torch.full((width,), _STEP))

    def forward(
        self, geometric: Tensor, pattern: Tensor, weights: Tensor, agents: Agents
    ) -> Tensor:
        """G (B, N, 2, C), H (B, N, D), category weights (R, B, N, N, 1) -> G."""
        around = geometric - agents.centre(geometric)
        around = around * (1.0 + self.attention(pattern).unsqueeze(-2))
        offset = around.unsqueeze(2) - around.unsqueeze(1)  # (B, N, N, 2, C) from j to i
        by_category = self.interaction(pattern, length(offset))  # (R, B, N, N, C)
        strength = (by_category * weights).sum(0) * agents.pairs  # e_ij: (B, N, N, C)
        around = around + (strength.unsqueeze(-2) * offset).sum(2)
        moved: Tensor = geometric + self.step * self.nonlinearity(around)
        return moved


class PatternLayer(nn.Module):
    """What to add to H: message passing on channel distances."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        self.message = PairPerceptron(width, width, width, layers=layers)
        self.update = mlp([2 * width] + [width] * layers)

    def forward(self, geometric: Tensor, pattern: Tensor, agents: Agents) -> Tensor:
        """G (B, N, 2, C), H (B, N, D) -> (B, N, D)."""
        message = self.message(pattern, channel_distances(geometric))[0] * agents.pairs
        updated: Tensor = self.update(torch.cat([message.sum(2), pattern], -1))
        return updated


class FeatureLearning(nn.Module):
    """One of the P layers: the geometric features, then the pattern features."""

    def __init__(self, width: int, categories: int, layers: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.geometric = GeometricLayer(width, categories, layers)
        self.pattern = PatternLayer(width, layers)

    def forward(
        self, geometric: Tensor, pattern: Tensor, weights: Tensor, agents: Agents
    ) -> tuple[Tensor, Tensor]:
        """G (B, N, 2, C) and H (B, N, D), category weights (R, B, N, N, 1) -> the same two."""
        read = self.norm(pattern)
        geometric = self.geometric(geometric, read, weights, agents)
        return geometric, pattern + self.pattern(geometric, read, agents)


def _start_at_zero(*last_layers: nn.Module) -> None:
    for layer in last_layers:
        for parameter in layer.parameters():
            nn.init.zeros_(parameter)
