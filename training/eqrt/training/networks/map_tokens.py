"""The paper's map encoders: centerlines in the target's frame -> one feature of the map.

Every point of every line is one token of two numbers. One layer of attention lets the tokens see
each other; then all of them, side by side, enter a perceptron. Only that reading comes near the
paper's parameter counts: its 4.3 M for the transformer are 1,000 tokens x 64 x hidden 64, while the
transformer layer itself has some tens of thousands. So the order of the lines matters, which is
fixed (the nearest first); what is not valid enters as 0.

Attention costs the square of the points. With `point_dropout` a training step reads only some of
them, others each time, which also keeps a perceptron of millions of weights from learning few
scenes by heart. As ever with dropout, what is left counts for more, and nothing is dropped later.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eqrt.training.networks.layers import mlp

_MASKED = -1e9  # a finite minus infinity: a row without any valid point must not become NaN


class AttentionEncoder(nn.Module):
    """One plain self-attention layer of `graph_width`, one head, over all points."""

    def __init__(
        self, tokens: int, graph_width: int, sizes: list[int], dropout: float = 0.0
    ) -> None:
        """`tokens`: Q * L. `sizes`: widths of the perceptron's layers. `dropout`: of points."""
        super().__init__()
        self.dropout = dropout
        self.qkv = nn.Linear(2, 3 * graph_width)
        self.perceptron = mlp([tokens * graph_width, *sizes])

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, P, 2), 0 where not valid (B, P) -> the map's feature (B, D)."""
        chosen = choose(points.shape[1], self.dropout) if self.training else None
        points, valid = _of(chosen, points), _of(chosen, valid)
        attended = attend(self.qkv(points), valid, heads=1)
        return read_side_by_side(self.perceptron, _only(attended, valid), chosen)


class TransformerEncoder(nn.Module):
    """One transformer encoder layer over all points: the method of the paper."""

    def __init__(
        self, tokens: int, width: int, heads: int, sizes: list[int], dropout: float = 0.0
    ) -> None:
        """`tokens`: Q * L. `width`: a multiple of `heads`. `sizes`: widths of the perceptron's
        layers. `dropout`: of points.
        """
        super().__init__()
        self.dropout = dropout
        self.heads = heads
        self.embed = nn.Linear(2, width)
        self.qkv = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.norm1 = nn.LayerNorm(width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width)
        )
        self.norm2 = nn.LayerNorm(width)
        self.perceptron = mlp([tokens * width, *sizes])

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, P, 2), 0 where not valid (B, P) -> the map's feature (B, D)."""
        chosen = choose(points.shape[1], self.dropout) if self.training else None
        points, valid = _of(chosen, points), _of(chosen, valid)
        tokens = self.embed(points)  # (B, P, W)
        attended = attend(self.qkv(tokens), valid, self.heads)
        tokens = self.norm1(tokens + self.project(attended))
        tokens = self.norm2(tokens + self.feed_forward(tokens))
        return read_side_by_side(self.perceptron, _only(tokens, valid), chosen)


def choose(points: int, dropout: float) -> Tensor | None:
    """Which of the points (torch's global generator) a training step reads; None = all."""
    if not dropout:
        return None
    return torch.randperm(points)[: max(round((1.0 - dropout) * points), 1)]


def read_side_by_side(perceptron: nn.Sequential, tokens: Tensor, chosen: Tensor | None) -> Tensor:
    """Tokens (B, P, W), the `chosen` of all that the perceptron has weights for -> (B, D)."""
    if chosen is None:
        whole: Tensor = perceptron(tokens.flatten(1))
        return whole
    first, *rest = perceptron
    assert isinstance(first, nn.Linear)
    weight = first.weight.view(first.out_features, -1, tokens.shape[2])  # (D, all, W)
    scale = weight.shape[1] / len(chosen)
    seen = weight[:, chosen.to(weight.device)].flatten(1)
    feature = nn.functional.linear(scale * tokens.flatten(1), seen, first.bias)
    for layer in rest:
        feature = layer(feature)
    return feature


def _of(chosen: Tensor | None, per_point: Tensor) -> Tensor:
    return per_point if chosen is None else per_point[:, chosen.to(per_point.device)]


def attend(qkv: Tensor, valid: Tensor, heads: int) -> Tensor:
    """Attention (B, P, W) among the valid (B, P) of P tokens; qkv (B, P, 3 W) side by side."""
    count, width = qkv.shape[1], qkv.shape[2] // 3
    split = qkv.view(-1, count, 3, heads, width // heads).permute(2, 0, 3, 1, 4)
    query, key, value = split.unbind(0)  # (B, heads, P, W / heads)
    hidden = torch.where(valid, 0.0, _MASKED).to(qkv.dtype)[:, None, None, :]
    # Torch's fused kernel: the 12 x 1,000 x 1,000 weights of one scene would be 48 MB.
    attended = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=hidden)
    return attended.transpose(1, 2).reshape(-1, count, width)


def _only(tokens: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid.unsqueeze(-1), tokens, torch.zeros_like(tokens))
