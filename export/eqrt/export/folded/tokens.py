"""The map encoders that attend (`eqrt.training.networks.map_tokens`), folded.

Tokens are linear in a point's two coordinates, so a query's score of a point is u . p plus what is
the same for all points, with two numbers u per query and head; and what a head returns is linear in
the mean of the points under the softmax. Keys and values are never formed.

All heads' queries stand one after the other. They are taken some at a time: their scores of all
points, the softmax, and the means pass through the processor's cache, not through memory.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from eqrt.export.folded.products import Fixed, Linears, linears
from eqrt.training.networks.map_tokens import AttentionEncoder, TransformerEncoder

QUERIES = 200
"""Taken at a time: with 1,000 points their scores are 800 kB."""
_UNSEEN = -40.0
"""Added to the score of a point that does not exist. e^-40 is nothing beside 1, in any float."""


def folded_map(encoder: nn.Module) -> nn.Module:
    """The encoder for export; one that does not attend is as it is."""
    if isinstance(encoder, TransformerEncoder):
        return FoldedTransformer(encoder)
    if isinstance(encoder, AttentionEncoder):
        return FoldedAttention(encoder)
    return encoder


class PointMeans(Fixed):
    """Every head's attention among points: for each point the mean of all, as it weighs them."""

    def __init__(self, query: Tensor, key: Tensor, heads: int, like: Tensor) -> None:
        """Query and key: (W, 3), what makes them of (x, y, 1)."""
        super().__init__(like)
        width = query.shape[0] // heads
        query, key = query.view(heads, width, 3), key.view(heads, width, 3)
        score = query.transpose(1, 2) @ key / width**0.5  # (heads, 3, 3)
        # The last column would add the same to a query's scores of all points. There: the mask's.
        mask = torch.tensor([0.0, 0.0, 1.0]).double()
        self.keep(ask=torch.cat([score[..., :2], mask.view(1, 3, 1).expand(heads, 3, 1)], 2))

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, 3, P), 0 where not valid (B, 1, P) but for the last coordinate, which is 1.

        Means (B, 2 heads, P): first every head's x, then every head's y.
        """
        ask, count = self.get_buffer("ask"), points.shape[2]
        queries = (points.unsqueeze(1).transpose(2, 3) @ ask).flatten(1, 2)  # (B, heads P, 3)
        keys = _keys(points, valid.to(points.dtype))
        x, y = points[:, 0].unsqueeze(2), points[:, 1].unsqueeze(2)  # (B, P, 1)
        means: tuple[list[Tensor], list[Tensor]] = ([], [])
        for some in torch.split(queries, QUERIES, 1):
            share = (some @ keys).softmax(-1)
            # Two products with a vector: with a matrix of two columns, one would cost four times
            # as much.
            means[0].append(share @ x)
            means[1].append(share @ y)
        return torch.cat([*means[0], *means[1]], 1).view(-1, 2 * len(ask), count)


class FoldedAttention(Fixed):
    """`AttentionEncoder`: values and the perceptron's first layer are one, of means of points."""

    def __init__(self, of: AttentionEncoder) -> None:
        super().__init__(of.qkv.weight)
        query, key, value = of_points(of.qkv, torch.eye(3).double())
        self.means = PointMeans(query, key, 1, of.qkv.weight)
        (weight, bias), *others = linears(of.perceptron)
        by_point = weight.view(len(weight), -1, len(value)) @ value  # (D, P, 3)
        weight = by_point.transpose(1, 2).flatten(1)
        self.perceptron = Linears([(weight, bias), *others], of.qkv.weight)

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, P, 2), 0 where not valid (B, P) -> the map's feature (B, D)."""
        columns = with_ones(points)
        seen = valid.unsqueeze(1)
        means = torch.cat([self.means(columns, seen), columns[:, 2:]], 1)
        feature: Tensor = self.perceptron((means * seen).flatten(1))
        return feature


class FoldedTransformer(Fixed):
    """`TransformerEncoder`.

    What the first normalisation reads is linear in K = 2 heads + 3 numbers per point: the means,
    the point, and 1. So it is they that are divided by the standard deviation, which is the length
    of a product of theirs; and what follows reads them.
    """

    def __init__(self, of: TransformerEncoder) -> None:
        super().__init__(of.embed.weight)
        embed = torch.cat([of.embed.weight, of.embed.bias.unsqueeze(1)], 1).double()  # (W, 3)
        query, key, value = of_points(of.qkv, homogeneous(embed))
        self.means = PointMeans(query, key, of.heads, of.embed.weight)
        by_head = of.project.weight.double().view(len(value), of.heads, -1).transpose(0, 1)
        told = by_head @ value.view(of.heads, -1, 3)  # (heads, W, 3)
        embed[:, 2] += told[..., 2].sum(0) + of.project.bias
        self._keep_tokens(torch.cat([told[..., 0].T, told[..., 1].T, embed], 1), of)
        (weight, bias), *others = linears(of.perceptron)
        self.keep(first=weight, first_bias=bias)
        self.perceptron = Linears(others, of.embed.weight, activated=True)

    def _keep_tokens(self, read: Tensor, of: TransformerEncoder) -> None:
        """`read` (W, K): what makes that which the first normalisation reads."""
        centred = read - read.mean(0)
        deviation = torch.linalg.qr(centred / len(read) ** 0.5).R
        self.keep(deviation=deviation, ones=torch.ones(1, len(deviation)))
        token = of.norm1.weight.double().unsqueeze(1) * centred  # (W, K)
        (widen, bias), (narrow, last) = linears(of.feed_forward)
        self.keep(token=token, token_bias=of.norm1.bias + last)
        self.keep(widen=widen @ token, widen_bias=widen @ of.norm1.bias.double() + bias)
        self.keep(narrow=narrow.T, scale=of.norm2.weight, shift=of.norm2.bias)
        self.eps = of.norm1.eps, of.norm2.eps

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, P, 2), 0 where not valid (B, P) -> the map's feature (B, D)."""
        columns = with_ones(points)
        known = torch.cat([self.means(columns, valid.unsqueeze(1)), columns], 1)  # (B, K, P)
        tokens = self._tokens(known)  # (B P, W)
        seen = valid.reshape(-1, 1).to(points.dtype)
        tokens = (tokens * seen).view(points.shape[0], -1, 1)
        # 4.6 M weights on the left, which a runtime reads as they are, once, at memory's speed.
        first = (self.get_buffer("first") @ tokens).squeeze(2) + self.get_buffer("first_bias")
        feature: Tensor = self.perceptron(first)
        return feature

    def _tokens(self, known: Tensor) -> Tensor:
        """(B, K, P) -> (B P, W)."""
        of = self.get_buffer
        deviation = of("deviation") @ known
        variance = of("ones") @ (deviation * deviation)  # (B, 1, P)
        rows = (known / (variance + self.eps[0]).sqrt()).transpose(1, 2).flatten(0, 1)
        wide = functional.linear(rows, of("widen"), of("widen_bias")).relu()
        token = functional.linear(rows, of("token"), of("token_bias"))
        tokens = torch.addmm(token, wide, of("narrow"))
        shape = of("scale").shape
        return functional.layer_norm(tokens, shape, of("scale"), of("shift"), self.eps[1])


def _keys(points: Tensor, valid: Tensor) -> Tensor:
    """Keys (B, 3, P) of points (B, 3, P), 0 where not valid (B, 1, P), and the last coordinate 1.

    What does not exist lies at the middle of what does, which no query prefers to all of that, and
    counts e^-40 as much. Hidden by minus infinity, or -1e9, it would have an exponential too small
    for a normal float, and a softmax of these takes an Intel core ten times as long.
    """
    count = valid.sum(2, keepdim=True).clamp(min=1.0)
    middle = (points @ valid.transpose(1, 2)) / count  # (B, 3, 1); of no points: 0
    place = torch.cat([middle[:, :2], torch.full_like(count, _UNSEEN)], 1)
    return torch.addcmul(points, place, 1.0 - valid)


def with_ones(points: Tensor) -> Tensor:
    """Points (B, P, 2) -> (B, 3, P), the last coordinate 1."""
    return torch.cat([points.transpose(1, 2), torch.ones_like(points[..., :1]).transpose(1, 2)], 1)


def homogeneous(linear: Tensor) -> Tensor:
    """What makes (x, y, 1) from a point, of what makes its features (W, 3): (W + 1, 3)."""
    return torch.cat([linear, torch.tensor([[0.0, 0.0, 1.0]]).double()])


def of_points(qkv: nn.Linear, tokens: Tensor) -> tuple[Tensor, ...]:
    """Query, key and value, each (W, 3), of (x, y, 1); qkv reads `tokens` (inputs + 1, 3)."""
    whole = torch.cat([qkv.weight, qkv.bias.unsqueeze(1)], 1).double()
    return (whole @ tokens).chunk(3)
