"""Building blocks: layers that turn with the world, and layers that do not see it turn.

Two kinds of features run side by side, as in EqMotion (Xu et al., CVPR 2023, section 4):

    geometric (B, N, 2, C)  C vectors per agent; they turn with the world
    pattern   (B, N, D)     D numbers per agent; they do not change when it turns

The axis of x and y stands before the channels, so that mixing channels is a plain matrix product.
Only bias-free mixing of channels, and scaling by numbers made from pattern features, may touch
geometric features: that is what keeps them exactly equivariant.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

_TINY = 1e-3  # a centimetre in network units; its square must stay above 1e-8 (canonical.py)


def mlp(sizes: list[int]) -> nn.Sequential:
    """Linear layers with SiLU between them: `mlp([a, b, c])` maps a to c."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products of vectors (..., 2, C) per channel: (..., C). Does not turn."""
    return (a * b).sum(-2)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Signed areas of vectors (..., 2, C) per channel: (..., C). Does not turn, but mirrors."""
    return a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :]


def length(vectors: Tensor) -> Tensor:
    """Lengths of vectors (..., 2, C): (..., C); smooth at zero, where a norm has no gradient."""
    return (dot(vectors, vectors) + _TINY**2).sqrt()


class VectorNonlinearity(nn.Module):
    """EqMotion's equivariant non-linearity (its equation 8).

    A query vector is kept where it points along its key, and loses its part against it.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)

    def forward(self, geometric: Tensor) -> Tensor:
        """(..., 2, C) -> (..., 2, C)."""
        query, key = self.query(geometric), self.key(geometric)
        against = dot(query, key).clamp(max=0.0) / (dot(key, key) + _TINY)  # (..., C) does not turn
        kept: Tensor = query - against.unsqueeze(-2) * key
        return kept


RELATIONS = 5
"""Numbers that `relations` gives for every pair of agents."""


def relations(place: Tensor, velocity: Tensor) -> Tensor:
    """How agent j lies and moves as seen from agent i: (B, N, N, RELATIONS). Does not turn.

    place, velocity: (B, N, 2). Distance; then, along and to the left of i's own motion, where j is
    and how it moves against i. EqMotion's pairs know distances only, which cannot tell ahead from
    behind or left from right; traffic can. An agent that stands has no axis, and sees distances.
    """
    speed = (velocity.square().sum(-1, keepdim=True) + 0.01).sqrt()  # fades below 1 m/s
    ahead = (velocity / speed).unsqueeze(2).unsqueeze(-1)  # (B, N, 1, 2, 1)
    pair = torch.stack([place, velocity], -1)  # (B, N, 2, 2)
    offset = pair.unsqueeze(1) - pair.unsqueeze(2)  # (B, N, N, 2, 2) from i to j
    along, left = dot(offset, ahead), cross(ahead, offset)  # (B, N, N, 2)
    return torch.cat([length(offset[..., :1]), along, left], -1)


class InteractionReasoning(nn.Module):
    """Soft categories of every pair of agents, inferred once (EqMotion's reasoning module).

    The first linear layer over [receiver, sender, distances] is split into three products, so that
    the pairwise concatenation never exists.
    """

    def __init__(self, channels: int, width: int, categories: int) -> None:
        super().__init__()
        self.receiver = nn.Linear(width, width)
        self.sender = nn.Linear(width, width, bias=False)
        self.distance = nn.Linear(channels + RELATIONS, width, bias=False)
        self.readout = nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.category = nn.Linear(width, categories)

    def forward(self, distance: Tensor, pattern: Tensor) -> Tensor:
        """Pairs (B, N, N, C + RELATIONS), patterns (B, N, D) -> weights (B, N, N, R), sum 1 over R.

        `distance`: the channel distances, and `relations`.
        """
        pair = self.receiver(pattern).unsqueeze(2) + self.sender(pattern).unsqueeze(1)
        weights: Tensor = self.category(self.readout(pair + self.distance(distance))).softmax(-1)
        return weights


@dataclass(frozen=True, slots=True)
class Pairs:
    """What is known of every pair of agents before the layers run."""

    weights: Tensor
    """(B, N, N, R) interaction categories."""
    relations: Tensor
    """(B, N, N, RELATIONS)"""
    valid: Tensor
    """(B, N, N, 1) 1.0 where agent j exists and is not i."""

    def of(self, receivers: int) -> Pairs:
        """The pairs in which i is one of the first `receivers` agents."""
        own = slice(receivers)
        return Pairs(self.weights[:, own], self.relations[:, own], self.valid[:, own])


class FeatureLearning(nn.Module):
    """One feature-learning layer: geometric, then pattern features (EqMotion, section 4.3).

    Inner-agent attention, inter-agent aggregation and the equivariant non-linearity update the
    geometric features; message passing on channel distances updates the pattern features. The
    messages of all interaction categories come from one stacked matrix.
    """

    def __init__(self, channels: int, width: int, categories: int, dropout: float) -> None:
        super().__init__()
        self.categories = categories
        self.inner = nn.Linear(width, channels)
        self.receiver = nn.Linear(width, width * categories)
        self.sender = nn.Linear(width, width * categories, bias=False)
        self.distance = nn.Linear(channels + RELATIONS, width * categories, bias=False)
        self.pull = nn.Linear(width, channels)
        self.nonlinearity = VectorNonlinearity(channels)
        self.step = nn.Parameter(torch.full((channels,), 0.1))  # or vectors grow with every layer
        self.update = mlp([2 * width + 2 * channels, width, width])
        self.dropout = nn.Dropout(dropout)
        self.norm = nn.LayerNorm(width)

    def forward(
        self, geometric: Tensor, pattern: Tensor, pairs: Pairs, receivers: int
    ) -> tuple[Tensor, Tensor]:
        """Geometric (B, N, 2, C) and pattern (B, N, D) -> the same two, further on.

        Only the first `receivers` agents are returned, (B, receivers, ...): after the last layer
        nobody asks for the neighbours.
        """
        own, own_pattern = geometric[:, :receivers], pattern[:, :receivers]
        pairs = pairs.of(receivers)
        offset = geometric.unsqueeze(1) - own.unsqueeze(2)  # (B, R, N, 2, C) from i to j
        distance = torch.cat([length(offset), pairs.relations], -1)
        message = self._messages(distance, own_pattern, pattern, pairs.weights)
        message = message * pairs.valid  # (B, R, N, D)
        count = pairs.valid.sum(2).clamp(min=1.0)  # (B, R, 1)
        pull = (self.pull(message) * pairs.valid).unsqueeze(-2)  # (B, R, N, 1, C) does not turn
        aggregated = (pull * offset).sum(2) / count.unsqueeze(-2)  # (B, R, 2, C)
        scale = 1.0 + self.inner(own_pattern).unsqueeze(-2)  # (B, R, 1, C)
        own = own + self.step * self.nonlinearity(scale * own + aggregated)
        seen = self.update(self._invariants(own, own_pattern, message.sum(2) / count))
        return own, self.norm(own_pattern + self.dropout(seen))

    def _messages(
        self, distance: Tensor, own_pattern: Tensor, pattern: Tensor, weights: Tensor
    ) -> Tensor:
        """Messages (B, R, N, D) from agent j to i, the categories already mixed."""
        pair = self.receiver(own_pattern).unsqueeze(2) + self.sender(pattern).unsqueeze(1)
        stacked = nn.functional.silu(pair + self.distance(distance))  # (B, R, N, categories * D)
        by_category = stacked.view(*stacked.shape[:-1], self.categories, -1)
        mixed: Tensor = (by_category * weights.unsqueeze(-1)).sum(-2)
        return mixed

    def _invariants(self, geometric: Tensor, pattern: Tensor, message: Tensor) -> Tensor:
        neighbour = geometric.roll(
            1, -1
        )  # every channel against the next: angles, not only lengths
        return torch.cat(
            [pattern, message, dot(geometric, neighbour), cross(geometric, neighbour)], -1
        )


class GatedVectorMlp(nn.Module):
    """A multi-layer perceptron on vectors: bias-free mixing, gated by pattern features.

    The paper's four-layer decoder, made equivariant: a bias on coordinates would not turn.
    """

    def __init__(self, sizes: list[int], width: int) -> None:
        super().__init__()
        pairs = list(pairwise(sizes))
        layers = [nn.Linear(a, b, bias=False) for a, b in pairs]
        nn.init.zeros_(layers[-1].weight)  # training starts from no output at all
        self.mix = nn.ModuleList(layers)
        self.gate = nn.ModuleList(nn.Linear(width, b) for _, b in pairs)
        self.nonlinearity = nn.ModuleList(VectorNonlinearity(b) for _, b in pairs[:-1])

    def forward(self, vectors: Tensor, pattern: Tensor) -> Tensor:
        """Vectors (B, 2, C) and pattern (B, D) -> vectors (B, 2, sizes[-1])."""
        last = len(self.mix) - 1
        for index, (mix, gate) in enumerate(zip(self.mix, self.gate, strict=True)):
            vectors = mix(vectors) * (1.0 + gate(pattern).unsqueeze(-2))
            if index < last:
                vectors = self.nonlinearity[index](vectors)
        return vectors
