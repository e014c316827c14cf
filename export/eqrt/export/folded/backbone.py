"""EqMotion's backbone (`eqrt.training.networks.eqmotion`), folded.

    geometric (B, 2, N C)  coordinates first, so that what does not turn spreads over whole rows
    pattern   (B N, D)     rows of agents
    pairs     (B P, .)     rows of the P = N (N - 1) pairs of different agents

All that a layer reads from the pattern features is one product. From agents to pairs, and from
pairs to those who receive, lead products with small matrices; masks are in these. The last layer of
a perceptron is multiplied with the linear layer behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.export.folded.products import (
    Fixed,
    Linears,
    PairRows,
    PairsOf,
    SideBySide,
    last_layer,
    linears,
    receiver_sender,
)
from eqrt.export.folded.tokens import folded_map
from eqrt.training.networks.canonical import last_valid, masked
from eqrt.training.networks.config import UNIT_M
from eqrt.training.networks.eqmotion import EqMotion, read_map
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


@dataclass(frozen=True, slots=True)
class Categories:
    """Of all pairs: how much each counts, and what that makes of a layer's biases."""

    weights: Tensor
    """(B P, R W), the same for all W."""
    bias: Tensor
    """(B P, C) of one layer."""


class FoldedEqMotion(nn.Module):
    """One of the paper's systems on EqMotion, for export."""

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
        from_map, vectors = read_map(self.map, self.fusion, map_points, in_metres=self.in_metres)
        features, rows = self.initial((held - origin) / UNIT_M, history_valid, agents, from_map)
        geometric = features.transpose(1, 2)  # (B, 2, N, C)
        if vectors is not None:
            geometric = geometric + self.pairs.target @ vectors.transpose(1, 2)

        neighbours = self._neighbours(agents, geometric.shape[-1])
        geometric, pattern = geometric.flatten(2), rows.flatten(0, 1)
        of_layers = self.interaction(geometric, pattern, neighbours)
        for layer, categories in zip(self.layers, of_layers, strict=True):
            geometric, pattern = layer(geometric, pattern, categories, neighbours)
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
        agents, channels = len(self.pairs.target), pattern.shape[1]
        target = self.norm(pattern.view(-1, agents, channels)[:, 0])
        centre = geometric @ neighbours.mean  # (B, 2, 1)
        own = geometric[..., :channels] - centre  # of agent 0
        decoded = self.decoder(own, target) + centre  # (B, 2, K H)
        trajectories = decoded.unflatten(-1, (self.modes, self.steps)).permute(0, 2, 3, 1)
        logits = None if self.logits is None else self.logits(target)
        return most_probable_first(origin + UNIT_M * trajectories, logits)


class FoldedInteraction(Fixed):
    """`InteractionReasoning`, and what the categories make of the layers' biases: no layer does."""

    def __init__(
        self, of: InteractionReasoning, pairs: PairsOf, layers: list[FeatureLearning]
    ) -> None:
        super().__init__(of.message.distance.weight)
        like = of.message.distance.weight
        self.pairs = pairs
        self.message = FoldedMessage(of.message, of.update)
        self.read = SideBySide([receiver_sender(of.message), self.message.reads], like)
        self.reread = Linears([receiver_sender(of.category)], like)
        self.category = PairRows(of.category)
        weight, bias = last_layer(of.category)
        self.last = Linears([(weight[0].T, bias[0])], like)
        biases = [last_layer(layer.geometric.interaction)[1] for layer in layers]  # (R, C) each
        self.keep(biases=torch.cat(biases, 1))
        self.width = of.message.distance.weight.shape[2]

    def forward(
        self, geometric: Tensor, pattern: Tensor, neighbours: Neighbours
    ) -> list[Categories]:
        """G (B, 2, N C) and H (B N, D) -> the categories, for each layer."""
        distance = self.pairs.distances(geometric)
        sides, update = self.read(pattern)
        reasoned = self.message(distance, self.pairs.by_agent(sides), update, neighbours)
        hidden = self.category(distance, self.pairs.by_agent(self.reread(reasoned)))
        weights = self.last(hidden).softmax(-1)  # (B P, R)
        biases = torch.split(weights @ self.get_buffer("biases"), self.width, 1)
        by_width = weights.unsqueeze(-1).expand(-1, -1, self.width).flatten(1)
        return [Categories(by_width, bias) for bias in biases]


class FoldedLayer(nn.Module):
    """`FeatureLearning`."""

    def __init__(self, of: FeatureLearning, pairs: PairsOf) -> None:
        super().__init__()
        like, geometric = of.norm.weight, of.geometric
        first, *others, (weight, bias) = linears(geometric.attention)
        others.append((weight, bias + 1.0))  # what G is scaled by
        self.norm, self.pairs = of.norm, pairs
        self.attention = Linears(others, like, activated=True)
        self.message = FoldedMessage(of.pattern.message, of.pattern.update)
        perceptrons = geometric.interaction, of.pattern.message
        reads = [receiver_sender(*perceptrons), first, self.message.reads]
        self.read = SideBySide(reads, like)
        self.geometric = FoldedGeometric(geometric, pairs)
        self.sizes = [self.geometric.interaction.outputs, self.message.pairs.outputs]

    def forward(
        self,
        geometric: Tensor,
        pattern: Tensor,
        categories: Categories,
        neighbours: Neighbours,
    ) -> tuple[Tensor, Tensor]:
        """G (B, 2, N C) and H (B N, D) -> the same two."""
        sides, attention, update = self.read(self.norm(pattern))
        of_interaction, of_message = torch.split(self.pairs.by_agent(sides), self.sizes, 1)
        scale = self.attention(attention)
        geometric = self.geometric(geometric, scale, of_interaction, categories, neighbours)
        distance = self.pairs.distances(geometric)
        return geometric, pattern + self.message(distance, of_message, update, neighbours)


class FoldedGeometric(Fixed):
    """`GeometricLayer` behind its attention."""

    def __init__(self, of: GeometricLayer, pairs: PairsOf) -> None:
        super().__init__(of.step)
        self.pairs, self.interaction = pairs, PairRows(of.interaction)
        weight, _ = last_layer(of.interaction)  # (R, W, C)
        self.keep(strength=weight.flatten(0, 1))
        self.nonlinearity = FoldedNonlinearity(of.nonlinearity, of.step, pairs)

    def forward(
        self,
        geometric: Tensor,
        scale: Tensor,
        by_agent: Tensor,
        categories: Categories,
        neighbours: Neighbours,
    ) -> Tensor:
        """G (B, 2, N C), scaled by (B N, C) -> G."""
        flat = geometric.shape[0], 1, -1
        around = (geometric - geometric @ neighbours.mean) * scale.view(flat)
        offset = self.pairs.offsets(around)  # (B, 2, P C) from j to i
        hidden = self.interaction(self.pairs.lengths(offset), by_agent) * categories.weights
        strength = torch.addmm(categories.bias, hidden, self.get_buffer("strength"))  # (B P, C)
        pull = self.pairs.per_pair(offset * strength.view(flat))
        around = self.pairs.per_agent(around) + neighbours.gather.unsqueeze(1) @ pull
        moved: Tensor = geometric + self.nonlinearity(around)
        return moved


class FoldedNonlinearity(Fixed):
    """`VectorNonlinearity`, times a factor for every channel."""

    def __init__(self, of: VectorNonlinearity, factor: Tensor, pairs: PairsOf) -> None:
        super().__init__(factor)
        self.pairs = pairs
        # A negative factor turns the query over, and so whether it points against its key.
        sign = torch.where(factor < 0.0, 1.0, -1.0).double()
        self.keep(query=of.query.weight.double().T * factor, key=of.key.weight.double().T * sign)

    def forward(self, vectors: Tensor) -> Tensor:
        """(B, 2, N, C) -> (B, 2, N C)."""
        query = (vectors @ self.get_buffer("query")).flatten(2)
        key = (vectors @ self.get_buffer("key")).flatten(2)
        against = self.pairs.dot(query, key).relu()  # (B, 1, N C) does not turn
        return query - against / (self.pairs.dot(key, key) + TINY) * key


class FoldedMessage(Fixed):
    """`PatternLayer`: messages along channel distances, and what they and H make of H."""

    def __init__(self, of: PairPerceptron, update: nn.Sequential) -> None:
        super().__init__(of.distance.weight)
        self.pairs = PairRows(of)
        last, last_bias = last_layer(of)
        (weight, bias), *others = linears(update)
        message, pattern = weight.chunk(2, 1)
        self.keep(of_sum=last[0] @ message.T, of_count=last_bias @ message.T)
        self.reads = pattern, bias
        self.update = Linears(others, of.distance.weight, activated=True)

    def forward(
        self, distance: Tensor, by_agent: Tensor, update: Tensor, neighbours: Neighbours
    ) -> Tensor:
        """Distances (B P, C); from the pattern features: by_agent (B P, W), update (B N, D)."""
        hidden = self.pairs(distance, by_agent)
        by_pair = hidden.unflatten(0, (-1, neighbours.gather.shape[2]))  # (B, P, W)
        received = (neighbours.gather @ by_pair).flatten(0, 1)
        update = torch.addmm(update, neighbours.count, self.get_buffer("of_count"))
        rows: Tensor = self.update(torch.addmm(update, received, self.get_buffer("of_sum")))
        return rows
