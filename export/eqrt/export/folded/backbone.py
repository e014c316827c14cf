"""EqMotion's backbone (`eqrt.training.networks.eqmotion`), folded.

    geometric (B, 2, N, C)  coordinates first, so that what does not turn spreads over whole rows
    pattern   (B N, D)      rows of agents
    pairs     (B, ., 1, P)  columns, of the P = N (N - 1) pairs of different agents

Per layer, all that is read from the pattern features is one product. From agents to pairs, and from
pairs back to their receivers, lead products with constant matrices, and the masks are in these.
What the last layer of a perceptron multiplies is multiplied with what comes next: its weights are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from eqrt.export.folded.products import (
    Fixed,
    PairColumns,
    PairsOf,
    Rows,
    SideBySide,
    last_layer,
    linears,
    receiver_sender,
)
from eqrt.export.folded.tokens import folded_map
from eqrt.training.networks.canonical import last_valid, masked
from eqrt.training.networks.config import UNIT_M
from eqrt.training.networks.eqmotion import EqMotion
from eqrt.training.networks.eqmotion_layers import (
    Agents,
    FeatureLearning,
    GeometricLayer,
    InteractionReasoning,
    PairPerceptron,
)
from eqrt.training.networks.layers import TINY, VectorNonlinearity
from eqrt.training.networks.modes import most_probable_first


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Who there is and who sees whom, for all layers."""

    mean: Tensor
    """(B, N C, 1): weights of the mean over the agents that exist, and the channels."""
    gather: Tensor
    """(B, N, P): sums over the pairs in which an agent receives and the sender exists."""
    count: Tensor
    """(B N, 1): of these."""


class FoldedEqMotion(nn.Module):
    """One of the paper's systems on EqMotion, for export."""

    read_map = EqMotion.read_map

    def __init__(self, model: EqMotion, num_agents: int) -> None:
        super().__init__()
        like = model.norm.weight
        self.modes, self.steps = model.modes, model.steps
        self.frame, self.in_metres = model.frame, model.in_metres
        self.map = None if model.map is None else folded_map(model.map)
        self.fusion, self.initial = model.fusion, model.initial
        self.pairs = PairsOf(num_agents, like)
        layers = [layer for layer in model.layers if isinstance(layer, FeatureLearning)]
        self.interaction = FoldedInteraction(model.interaction, self.pairs, layers)
        self.layers = nn.ModuleList(FoldedLayer(layer, self.pairs) for layer in layers)
        self.norm, self.decoder, self.logits = model.norm, model.decoder, model.logits

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """As `EqMotion.forward`."""
        history = masked(history, history_valid)
        last = last_valid(history, history_valid).unsqueeze(2)  # (B, N, 1, 2)
        origin = last[:, :1]
        held = torch.where(history_valid.unsqueeze(-1), history, last)
        agents = Agents.of(history_valid, history.dtype)
        map_points = self.frame(
            history[:, 0], history_valid[:, 0], heading, centerlines, centerlines_valid
        )
        from_map, vectors = self.read_map(map_points)
        features, rows = self.initial((held - origin) / UNIT_M, history_valid, agents, from_map)
        geometric = features.transpose(1, 2)  # (B, 2, N, C)
        if vectors is not None:
            geometric = geometric + self.pairs.target @ vectors.transpose(1, 2)

        neighbours = self._neighbours(agents, geometric.shape[-1])
        pattern = rows.flatten(0, 1)
        weights, biases = self.interaction(geometric, pattern, neighbours)
        for layer, bias in zip(self.layers, biases, strict=True):
            geometric, pattern = layer(geometric, pattern, weights, bias, neighbours)
        return self._decode(geometric, pattern, origin, neighbours)

    def _neighbours(self, agents: Agents, channels: int) -> Neighbours:
        exist = agents.exist[..., 0, 0]  # (B, N)
        share = exist / (exist.sum(1, keepdim=True).clamp(min=1.0) * channels)
        mean = share.unsqueeze(-1).expand(-1, -1, channels).reshape(exist.shape[0], -1, 1)
        gather = self.pairs.receives * (exist.unsqueeze(1) @ self.pairs.sends)
        return Neighbours(mean, gather, gather.sum(-1).reshape(-1, 1))

    def _decode(
        self, geometric: Tensor, pattern: Tensor, origin: Tensor, neighbours: Neighbours
    ) -> tuple[Tensor, Tensor]:
        target = self.norm(pattern.view(-1, geometric.shape[2], pattern.shape[1])[:, 0])
        centre = geometric.flatten(2) @ neighbours.mean  # (B, 2, 1)
        decoded = self.decoder(geometric[:, :, 0] - centre, target) + centre  # (B, 2, K H)
        trajectories = decoded.unflatten(-1, (self.modes, self.steps)).permute(0, 2, 3, 1)
        logits = None if self.logits is None else self.logits(target)
        return most_probable_first(origin + UNIT_M * trajectories, logits)


class FoldedInteraction(nn.Module):
    """Categories of all pairs; and what they make of the layers' biases, which no layer changes."""

    def __init__(
        self, of: InteractionReasoning, pairs: PairsOf, layers: list[FeatureLearning]
    ) -> None:
        super().__init__()
        like = of.message.distance.weight
        self.pairs = pairs
        self.message = FoldedMessage(of.message, of.update)
        self.read = SideBySide([receiver_sender(of.message), self.message.reads], like)
        self.category_read = SideBySide([receiver_sender(of.category)], like)
        self.category = PairColumns(of.category)
        self.last = Fixed(like)
        weight, bias = last_layer(of.category)
        biases = [last_layer(layer.geometric.interaction)[1].T for layer in layers]
        self.last.keep(weight=weight[0].T[..., None, None], bias=bias[0])
        self.last.keep(of_layers=torch.cat(biases)[..., None, None])
        self.width = biases[0].shape[0]

    def forward(
        self, geometric: Tensor, pattern: Tensor, neighbours: Neighbours
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Category weights (B, R W, 1, P), per channel, and each layer's bias (B, C, 1, P)."""
        distance = distances(self.pairs.offsets(geometric))
        sides, update = self.read(pattern)
        reasoned = self.message(distance, self.pairs.by_agent(sides), update, neighbours)
        (sides,) = self.category_read(reasoned)
        hidden = self.category(distance, self.pairs.by_agent(sides))
        last = self.last
        logits = functional.conv2d(hidden, last.get_buffer("weight"), last.get_buffer("bias"))
        weights = logits.softmax(1)  # (B, R, 1, P)
        biases = functional.conv2d(weights, last.get_buffer("of_layers")).split(self.width, 1)
        return weights.expand(-1, -1, self.width, -1).flatten(1, 2).unsqueeze(2), biases


class FoldedLayer(nn.Module):
    """`FeatureLearning`."""

    def __init__(self, of: FeatureLearning, pairs: PairsOf) -> None:
        super().__init__()
        like, geometric = of.norm.weight, of.geometric
        weights, biases = linears(geometric.attention)
        biases[-1] = biases[-1] + 1.0  # what G is scaled by
        self.norm, self.pairs = of.norm, pairs
        self.attention = Rows(weights[1:], biases[1:], like=like, activated=True)
        self.message = FoldedMessage(of.pattern.message, of.pattern.update)
        perceptrons = geometric.interaction, of.pattern.message
        parts = [receiver_sender(*perceptrons), (weights[0], biases[0]), self.message.reads]
        self.read = SideBySide(parts, like)
        self.geometric = FoldedGeometric(geometric, pairs)
        self.sizes = [p.distance.weight.shape[0] * p.distance.weight.shape[2] for p in perceptrons]

    def forward(
        self,
        geometric: Tensor,
        pattern: Tensor,
        weights: Tensor,
        bias: Tensor,
        neighbours: Neighbours,
    ) -> tuple[Tensor, Tensor]:
        """G (B, 2, N, C) and H (B N, D), both of `FoldedInteraction` -> the same two."""
        sides, attention, update = self.read(self.norm(pattern))
        of_interaction, of_message = self.pairs.by_agent(sides).split(self.sizes, 1)
        scale = self.attention(attention)
        geometric = self.geometric(geometric, scale, of_interaction, weights, bias, neighbours)
        distance = distances(self.pairs.offsets(geometric))
        return geometric, pattern + self.message(distance, of_message, update, neighbours)


class FoldedGeometric(Fixed):
    """`GeometricLayer` behind its attention."""

    def __init__(self, of: GeometricLayer, pairs: PairsOf) -> None:
        super().__init__(of.step)
        self.pairs, self.interaction = pairs, PairColumns(of.interaction)
        weight, _ = last_layer(of.interaction)  # (R, W, C)
        self.keep(strength=weight.permute(2, 0, 1).flatten(1)[..., None, None])
        self.nonlinearity = FoldedNonlinearity(of.nonlinearity, of.step)

    def forward(
        self,
        geometric: Tensor,
        scale: Tensor,
        by_agent: Tensor,
        weights: Tensor,
        bias: Tensor,
        neighbours: Neighbours,
    ) -> Tensor:
        """G (B, 2, N, C), scaled by (B N, C) -> G."""
        agents, channels = geometric.shape[2:]
        flat = geometric.flatten(2)
        around = (flat - flat @ neighbours.mean).unflatten(2, (agents, channels))
        around = around * scale.view(-1, 1, agents, channels)
        offset = self.pairs.offsets(around)  # (B, 2, C, P) from j to i
        hidden = self.interaction(distances(offset), by_agent) * weights
        strength = functional.conv2d(hidden, self.get_buffer("strength")) + bias  # (B, C, 1, P)
        pull = offset * strength.transpose(1, 2)
        around = around + neighbours.gather.unsqueeze(1) @ pull.transpose(2, 3)
        return self.nonlinearity(around, geometric)


class FoldedNonlinearity(Fixed):
    """`VectorNonlinearity`, times a factor for every channel, on top of other vectors."""

    def __init__(self, of: VectorNonlinearity, factor: Tensor) -> None:
        super().__init__(factor)
        # A negative factor turns the query over, and so whether it points against the key.
        sign = torch.where(factor < 0.0, 1.0, -1.0).double()
        self.keep(query=(of.query.weight.double().T * factor))
        self.keep(against=(of.key.weight.double().T * sign))

    def forward(self, vectors: Tensor, to: Tensor) -> Tensor:
        """(B, 2, M, C) -> (B, 2, M, C)."""
        query, key = vectors @ self.get_buffer("query"), vectors @ self.get_buffer("against")
        along = (query * key).sum(1, keepdim=True).relu()  # (B, 1, M, C) does not turn
        lost = along / ((key * key).sum(1, keepdim=True) + TINY) * key
        return to + (query - lost)


class FoldedMessage(Fixed):
    """`PatternLayer`: messages along channel distances, and what they and H make of H."""

    def __init__(self, of: PairPerceptron, update: nn.Sequential) -> None:
        super().__init__(of.distance.weight)
        self.pairs = PairColumns(of)
        last, last_bias = last_layer(of)
        weights, biases = linears(update)
        message, pattern = weights[0].chunk(2, 1)
        self.keep(of_sum=last[0] @ message.T, of_count=last_bias[:1] @ message.T)
        self.reads = pattern, biases[0]
        self.update = Rows(weights[1:], biases[1:], like=of.distance.weight, activated=True)

    def forward(
        self, distance: Tensor, by_agent: Tensor, update: Tensor, neighbours: Neighbours
    ) -> Tensor:
        """Distances (B, C, 1, P); from the pattern features: by_agent, update (B N, D)."""
        hidden = self.pairs(distance, by_agent).squeeze(2)  # (B, W, P)
        received = (neighbours.gather @ hidden.transpose(1, 2)).flatten(0, 1)
        update = torch.addmm(update, neighbours.count, self.get_buffer("of_count"))
        rows: Tensor = self.update(torch.addmm(update, received, self.get_buffer("of_sum")))
        return rows


def distances(offset: Tensor) -> Tensor:
    """Lengths (B, C, 1, P) of vectors (B, 2, C, P), as `layers.length`."""
    squared = (offset * offset).sum(1, keepdim=True)
    return (squared + TINY**2).sqrt().transpose(1, 2)
