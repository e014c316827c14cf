"""Building blocks: layers that turn with the world, and layers that do not see it turn.

Two kinds of features run side by side, as in EqMotion (Xu et al., CVPR 2023, section 4):

    geometric (B, N, 2, C)  C vectors per agent; they turn with the world
    pattern   (B, N, D)     D numbers per agent; they do not change when it turns

The axis of x and y stands before the channels, so that mixing channels is a plain matrix product.
Only bias-free mixing of channels, and scaling by numbers made from pattern features, may touch
geometric features: that is what keeps them exactly equivariant.
"""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn

TINY = 1e-3  # a centimetre in network units; its square must stay above 1e-8 (canonical.py)


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
    return (dot(vectors, vectors) + TINY**2).sqrt()


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
        against = dot(query, key).clamp(max=0.0) / (dot(key, key) + TINY)  # (..., C) does not turn
        kept: Tensor = query - against.unsqueeze(-2) * key
        return kept


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
