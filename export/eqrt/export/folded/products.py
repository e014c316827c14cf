"""Weights multiplied out, and the layers that hold them.

Rows are agents, (B N, D), and pass through linear layers. Pairs of agents are columns,
(B, channels, 1, pairs), and pass through 1x1 convolutions: one operator for all R perceptrons of a
layer side by side, bias included, and the pairs are contiguous.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from eqrt.training.networks.eqmotion_layers import PairPerceptron


class Fixed(nn.Module):
    """A module whose numbers are buffers, rounded to the dtype of what they were made from."""

    def __init__(self, like: Tensor) -> None:
        super().__init__()
        self._dtype = like.dtype

    def keep(self, **values: Tensor) -> None:
        """Hold these under their names."""
        for name, value in values.items():
            self.register_buffer(name, value.detach().to(self._dtype).contiguous())


class Rows(Fixed):
    """Linear layers on rows, with SiLU between them (and before the first, if `activated`)."""

    def __init__(
        self, weights: Sequence[Tensor], biases: Sequence[Tensor], *, like: Tensor, activated: bool
    ) -> None:
        """Weights (outputs, inputs) and biases (outputs,)."""
        super().__init__(like)
        self.count, self.activated = len(weights), activated
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            self.keep(**{f"weight{index}": weight, f"bias{index}": bias})

    def forward(self, rows: Tensor) -> Tensor:
        """(M, inputs) -> (M, outputs)."""
        for index in range(self.count):
            if index or self.activated:
                rows = functional.silu(rows)
            rows = functional.linear(
                rows, self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}")
            )
        return rows


class PairColumns(Fixed):
    """A `PairPerceptron` up to its last activation; what follows is linear, and folded elsewhere.

    The first layer's part that reads pattern features comes from outside, `by_agent`: it is the same
    for all pairs of an agent, so it is computed per agent, in one product with whatever else
    reads these (`receiver_sender`).
    """

    def __init__(self, of: PairPerceptron) -> None:
        super().__init__(of.distance.weight)
        self.groups = of.distance.weight.shape[0]
        self.keep(distance=columns(of.distance.weight))
        self.hidden = len(of.rest) - 1
        for index, layer in enumerate(list(of.rest)[:-1]):
            bias = layer.get_parameter("bias").flatten()
            weight = columns(layer.get_parameter("weight"))
            self.keep(**{f"weight{index}": weight, f"bias{index}": bias})

    def forward(self, distance: Tensor, by_agent: Tensor) -> Tensor:
        """Distances (B, C, 1, pairs), by_agent (B, R W, 1, pairs) -> (B, R W, 1, pairs)."""
        pairs = functional.conv2d(distance, self.get_buffer("distance")) + by_agent
        for index in range(self.hidden):
            weight, bias = self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}")
            pairs = functional.conv2d(functional.silu(pairs), weight, bias, groups=self.groups)
        return functional.silu(pairs)


def columns(grouped: Tensor) -> Tensor:
    """Weights (R, inputs, outputs) of a `GroupedLinear` as those of a 1x1 convolution."""
    return grouped.transpose(1, 2).flatten(0, 1)[..., None, None]


def receiver_sender(*perceptrons: PairPerceptron) -> tuple[Tensor, Tensor]:
    """What `by_agent` is made from, for several: weights (2 sum(R W), D), and biases.

    First what every agent adds to the pairs that it receives in, then to those it sends in.
    """
    receivers = [p.receiver.weight.transpose(1, 2).flatten(0, 1) for p in perceptrons]
    senders = [p.sender.weight.transpose(1, 2).flatten(0, 1) for p in perceptrons]
    biases = [p.receiver.get_parameter("bias").flatten() for p in perceptrons]
    weight, bias = torch.cat([*receivers, *senders]), torch.cat(biases)
    return weight.double(), torch.cat([bias, torch.zeros_like(bias)]).double()


def last_layer(perceptron: PairPerceptron) -> tuple[Tensor, Tensor]:
    """Weights (R, W, outputs) and biases (R, outputs) of what `PairColumns` leaves out."""
    last = perceptron.rest[-1]
    return last.get_parameter("weight").double(), last.get_parameter("bias").flatten(1).double()


def linears(sequence: nn.Sequential) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases of an `mlp`, in float64."""
    layers = [layer for layer in sequence if isinstance(layer, nn.Linear)]
    return [l.weight.double() for l in layers], [l.bias.double() for l in layers]


class SideBySide(Fixed):
    """Linear layers (weight, bias) that read the same rows, as one product."""

    def __init__(self, parts: Sequence[tuple[Tensor, Tensor]], like: Tensor) -> None:
        super().__init__(like)
        self.sizes = [len(bias) for _, bias in parts]
        self.keep(weight=torch.cat([weight for weight, _ in parts]))
        self.keep(bias=torch.cat([bias for _, bias in parts]))

    def forward(self, rows: Tensor) -> tuple[Tensor, ...]:
        """(M, D) -> of each layer (M, its outputs)."""
        every = functional.linear(rows, self.get_buffer("weight"), self.get_buffer("bias"))
        return every.split(self.sizes, 1) if len(self.sizes) > 1 else (every,)


class PairsOf(Fixed):
    """Constants over the P = N (N - 1) ordered pairs of different agents."""

    receives: Tensor
    """(N, P) 1 where the agent is the pair's receiver."""
    sends: Tensor
    """(N, P)"""
    difference: Tensor
    """(N, P): receiver minus sender."""
    alternating: Tensor
    """(2 N, P): adds row 2 i of the receiver and row 2 j + 1 of the sender."""

    target: Tensor
    """(N, 1): 1 where the agent is the target."""

    def __init__(self, agents: int, like: Tensor) -> None:
        super().__init__(like)
        pairs = [(i, j) for i in range(agents) for j in range(agents) if i != j]
        one_hot = torch.eye(agents, dtype=torch.float64)
        receives, sends = (one_hot[:, list(side)] for side in zip(*pairs, strict=True))
        alternating = torch.stack([receives, sends], 1).flatten(0, 1)
        self.keep(receives=receives, sends=sends)
        self.keep(difference=receives - sends, alternating=alternating, target=one_hot[:, :1])

    def offsets(self, geometric: Tensor) -> Tensor:
        """From the sender to the receiver: (B, 2, N, C) -> (B, 2, C, P)."""
        return geometric.transpose(2, 3) @ self.difference

    def by_agent(self, rows: Tensor) -> Tensor:
        """Rows (B N, 2 F) of `receiver_sender` -> their sums per pair (B, F, 1, P)."""
        twice_agents = self.alternating.shape[0]
        per_side = rows.reshape(-1, twice_agents, rows.shape[1] // 2)  # (B, 2 N, F)
        return (per_side.transpose(1, 2) @ self.alternating).unsqueeze(2)
