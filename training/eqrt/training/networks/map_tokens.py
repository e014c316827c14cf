"""The paper's map encoders: centerlines in the target's frame -> one feature of the map.

Every point of every line is one token of two numbers. One layer of attention lets the tokens see
each other; then all of them, side by side, enter a perceptron. Only that reading comes near the
paper's parameter counts: its 4.3 M for the transformer are 1,000 tokens x 64 x hidden 64, while the
transformer layer itself has some tens of thousands. So the order of the lines matters, which is
fixed (the nearest first); what is not valid enters as 0.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eqrt.training.networks.layers import mlp

_MASKED = -1e9  # a finite minus infinity: a row without any valid point must not become NaN


class AttentionEncoder(nn.Module):
    """One plain self-attention layer of `graph_width`, one head, over all points."""

    def __init__(self, tokens: int, graph_width: int, sizes: list[int]) -> None:
        """`tokens`: Q * L. `sizes`: widths of the perceptron's layers."""
        super().__init__()
        self.qkv = nn.Linear(2, 3 * graph_width)
        self.perceptron = mlp([tokens * graph_width, *sizes])

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Points (B, P, 2), 0 where not valid (B, P) -> the map's feature (B, D)."""
        attended = attend(self.qkv(points), valid, heads=1)
        feature: Tensor = self.perceptron(_only(attended, valid).flatten(1))
        return feature


class TransformerEncoder(nn.Module):
    """One transformer encoder layer over all points: the method of the paper."""

    def __init__(self, tokens: int, width: int, heads: int, sizes: list[int]) -> None:
        """`tokens`: Q * L. `sizes`: widths of the perceptron's layers."""
        super().__init__()
        if width % heads:
            raise ValueError(f"token width {width} is not a multiple of {heads} heads")
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
        tokens = self.embed(points)  # (B, P, W)
        attended = attend(self.qkv(tokens), valid, self.heads)
        tokens = self.norm1(tokens + self.project(attended))
        tokens = self.norm2(tokens + self.feed_forward(tokens))
        feature: Tensor = self.perceptron(_only(tokens, valid).flatten(1))
        return feature


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
