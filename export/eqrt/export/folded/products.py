"""Weights multiplied out, and the layers that hold them.

Whatever passes through linear layers are rows: of agents (B N, D), and of pairs of agents (B P, W).
A runtime packs constant matrices for its kernels if they stand on the right of a product of two
matrices; small constants that many layers share stand on the left, where they are not copied.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import torch
from torch import Tensor, nn
from torch.nn import functional

from eqrt.training.networks.eqmotion_layers import PairPerceptron
from eqrt.training.networks.layers import TINY

Affine = tuple[Tensor, Tensor]
"""Weight (outputs, inputs) and bias (outputs,), in float64."""


class Fixed(nn.Module):
    """A module whose numbers are buffers, rounded to the dtype of what they were made from."""

    def __init__(self, like: Tensor) -> None:
        super().__init__()
        self._dtype = like.dtype

    def keep(self, **values: Tensor) -> None:
        """Hold these under their names."""
        for name, value in values.items():
            self.register_buffer(name, value.detach().to(self._dtype).contiguous())


class Linears(Fixed):
    """Linear layers one after the other, with SiLU between them."""

    def __init__(self, layers: Sequence[Affine], like: Tensor, *, activated: bool = False) -> None:
        """`activated`: SiLU also before the first."""
        super().__init__(like)
        self.count, self.activated = len(layers), activated
        for index, (weight, bias) in enumerate(layers):
            self.keep(**{f"weight{index}": weight, f"bias{index}": bias})

    def forward(self, rows: Tensor) -> Tensor:
        """(M, inputs) -> (M, outputs)."""
        for index in range(self.count):
            weight, bias = self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}")
            if index or self.activated:
                rows = functional.silu(rows)
            rows = functional.linear(rows, weight, bias)
        return rows


class SideBySide(Fixed):
    """Linear layers that read the same rows, as one product."""

    def __init__(self, layers: Sequence[Affine], like: Tensor) -> None:
        super().__init__(like)
        self.sizes = [len(bias) for _, bias in layers]
        self.keep(weight=torch.cat([weight for weight, _ in layers]))
        self.keep(bias=torch.cat([bias for _, bias in layers]))

    def forward(self, rows: Tensor) -> tuple[Tensor, ...]:
        """(M, D) -> of each layer (M, its outputs)."""
        every = functional.linear(rows, self.get_buffer("weight"), self.get_buffer("bias"))
        return torch.split(every, self.sizes, 1)


class PairRows(Fixed):
    """A `PairPerceptron` up to its last activation; what follows is linear, and folded elsewhere.

    The part of its first layer that reads pattern features comes from outside, `by_agent`: it is
    the same for all pairs of an agent, so it is computed per agent, in one product with whatever
    else reads these (`receiver_sender`).
    """

    def __init__(self, of: PairPerceptron) -> None:
        super().__init__(of.distance.weight)
        self.groups, _, width = of.distance.weight.shape
        self.outputs, self.hidden = self.groups * width, len(of.rest) - 1
        self.keep(distance=of.distance.weight.transpose(0, 1).flatten(1))  # (C, R W)
        for index, layer in enumerate(list(of.rest)[:-1]):
            weight = layer.get_parameter("weight").transpose(1, 2).flatten(0, 1)  # (R W, W)
            bias = layer.get_parameter("bias").flatten()
            self.keep(**{f"weight{index}": weight, f"bias{index}": bias})

    def forward(self, distance: Tensor, by_agent: Tensor) -> Tensor:
        """Distances (B P, C), by_agent (B P, R W) -> (B P, R W)."""
        pairs = functional.silu(torch.addmm(by_agent, distance, self.get_buffer("distance")))
        if self.groups > 1 and self.hidden:
            return self._side_by_side(pairs)
        for index in range(self.hidden):
            weight, bias = self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}")
            pairs = functional.silu(functional.linear(pairs, weight, bias))
        return pairs

    def _side_by_side(self, pairs: Tensor) -> Tensor:
        """R perceptrons that do not mix, in one operator per layer: a grouped convolution."""
        columns = pairs.view(1, 1, -1, self.outputs).permute(0, 3, 1, 2)  # (1, R W, 1, B P)
        for index in range(self.hidden):
            weight, bias = self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}")
            columns = functional.silu(columns) if index else columns
            columns = functional.conv2d(columns, weight[..., None, None], bias, groups=self.groups)
        return functional.silu(columns.permute(0, 2, 3, 1).flatten(0, 2))


class PairsOf(Fixed):
    """The P = N (N - 1) ordered pairs of different agents, and vectors between them."""

    sends: Tensor
    """(N, P) 1 where the agent is the pair's sender."""
    receives: Tensor
    """(N, P)"""
    difference: Tensor
    """(P, N): receiver minus sender."""
    alternating: Tensor
    """(P, 2 N): row 2 i of the receiver, plus row 2 j + 1 of the sender."""
    target: Tensor
    """(N, 1): 1 where the agent is the target."""
    both: Tensor
    """(1, 2): adds what two coordinates give."""

    def __init__(self, agents: int, like: Tensor) -> None:
        super().__init__(like)
        one_hot = torch.eye(agents, dtype=torch.float64)
        sides = zip(*permutations(range(agents), 2), strict=True)
        receives, sends = (one_hot[:, list(side)] for side in sides)
        alternating = torch.stack([receives, sends], 1).flatten(0, 1).T
        self.keep(receives=receives, sends=sends, difference=(receives - sends).T)
        self.keep(alternating=alternating, target=one_hot[:, :1], both=torch.ones(1, 2))

    def by_agent(self, rows: Tensor) -> Tensor:
        """Rows (B N, 2 F) of `receiver_sender` -> their sums for every pair (B P, F)."""
        per_side = rows.reshape(-1, self.alternating.shape[1], rows.shape[1] // 2)  # (B, 2 N, F)
        return (self.alternating @ per_side).flatten(0, 1)

    def per_agent(self, vectors: Tensor) -> Tensor:
        """(B, 2, N C) -> (B, 2, N, C)."""
        return vectors.view(vectors.shape[0], 2, self.difference.shape[1], -1)

    def per_pair(self, vectors: Tensor) -> Tensor:
        """(B, 2, P C) -> (B, 2, P, C)."""
        return vectors.view(vectors.shape[0], 2, self.difference.shape[0], -1)

    def offsets(self, geometric: Tensor) -> Tensor:
        """From the sender to the receiver: (B, 2, N C) -> (B, 2, P C)."""
        return (self.difference @ self.per_agent(geometric)).flatten(2)

    def dot(self, one: Tensor, other: Tensor) -> Tensor:
        """Inner products of vectors (B, 2, M): (B, 1, M)."""
        return self.both @ (one * other)

    def lengths(self, offsets: Tensor) -> Tensor:
        """(B, 2, P C) -> (B P, C), as `layers.length`."""
        channels = offsets.shape[2] // self.difference.shape[0]
        return (self.dot(offsets, offsets) + TINY**2).sqrt().view(-1, channels)

    def distances(self, geometric: Tensor) -> Tensor:
        """(B, 2, N C) -> (B P, C)."""
        return self.lengths(self.offsets(geometric))


def receiver_sender(*perceptrons: PairPerceptron) -> Affine:
    """What agents contribute to the first layers of all their pairs, for several perceptrons.

    First what each adds to the pairs that it receives in, then to those that it sends in.
    """
    receivers = [p.receiver.weight.transpose(1, 2).flatten(0, 1) for p in perceptrons]
    senders = [p.sender.weight.transpose(1, 2).flatten(0, 1) for p in perceptrons]
    bias = torch.cat([p.receiver.get_parameter("bias").flatten() for p in perceptrons])
    weight = torch.cat([*receivers, *senders])
    return weight.double(), torch.cat([bias, torch.zeros_like(bias)]).double()


def last_layer(perceptron: PairPerceptron) -> Affine:
    """What `PairRows` leaves out: weights (R, W, outputs), biases (R, outputs)."""
    last = perceptron.rest[-1]
    return last.get_parameter("weight").double(), last.get_parameter("bias").flatten(1).double()


def linears(sequence: nn.Sequential) -> list[Affine]:
    """The layers of an `mlp`, in float64."""
    layers = [layer for layer in sequence if isinstance(layer, nn.Linear)]
    return [(layer.weight.double(), layer.bias.double()) for layer in layers]
