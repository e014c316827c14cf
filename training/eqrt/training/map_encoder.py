"""Map encoders: canonical centerlines in, one invariant feature and lane vectors out.

The paper's encoder takes every centerline point as one token through one transformer layer. The
tokens are invariant (they are seen from the target's own frame), so what is made from them belongs
to the pattern features. The way back to the geometric features goes through *pointers*: weights
that are invariant, over the map's own points, which turn with the world.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eqrt.training.canonical import unit

TOKEN_FEATURES = 4
"""Position and direction in the canonical frame."""
_MASKED = -1e9  # a finite minus infinity: a row without any valid point must not become NaN


class PointTransformer(nn.Module):
    """One transformer encoder layer over all Q * L map points (the paper's map encoder)."""

    def __init__(self, width: int, heads: int, pointers: int, agent_width: int) -> None:
        super().__init__()
        if width % heads:
            raise ValueError(f"token width {width} is not a multiple of {heads} heads")
        self.heads = heads
        self.embed = nn.Linear(TOKEN_FEATURES, width)
        self.qkv = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.norm1 = nn.LayerNorm(width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )
        self.norm2 = nn.LayerNorm(width)
        self.keys = nn.Linear(width, pointers * width)
        self.query = nn.Linear(agent_width, width)
        self.summary = nn.Linear(pointers * width, agent_width)
        self.pointers = pointers

    def forward(
        self, tokens: Tensor, valid: Tensor, points: Tensor, pattern: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Tokens (B, P, 4) -> map feature (B, D), lane vectors (B, 2, pointers).

        valid (B, P); points (B, P, 2) the same points in the tile's axes, relative to the target,
        0 where not valid; pattern (B, D) the target's. Without a map both results are 0.
        """
        has_map = valid.any(-1, keepdim=True)  # (B, 1)
        encoded = self._encode(self.embed(tokens), valid)  # (B, P, W)
        keys = self.keys(encoded).unflatten(-1, (self.pointers, -1)).transpose(1, 2)  # (B, A, P, W)
        query = self.query(pattern)[:, None, :, None]  # (B, 1, W, 1)
        score = (keys @ query).squeeze(-1) / encoded.shape[-1] ** 0.5  # (B, A, P)
        weight = score.masked_fill(~valid.unsqueeze(1), _MASKED).softmax(-1)
        weight = weight * has_map.unsqueeze(-1)
        feature = self.summary((weight @ encoded).flatten(1)) * has_map
        return feature, (weight @ points).transpose(1, 2)

    def _encode(self, tokens: Tensor, valid: Tensor) -> Tensor:
        batch, count, width = tokens.shape
        qkv = self.qkv(tokens).view(batch, count, 3, self.heads, width // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind(0)  # (B, heads, P, W / heads)
        query = query / (width // self.heads) ** 0.5
        hidden = (~valid[:, None, None, :]).to(tokens.dtype) * _MASKED
        weight = (query @ key.transpose(-1, -2) + hidden).softmax(-1)
        attended = (weight @ value).transpose(1, 2).reshape(batch, count, width)
        tokens = self.norm1(tokens + self.project(attended))
        encoded: Tensor = self.norm2(tokens + self.feed_forward(tokens))
        return encoded


def point_directions(centerlines: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Unit direction (B, Q, L, 2) of the lane at each point, and where it is defined (B, Q, L).

    To the next point; at a line's last valid point, from the previous one.
    """
    step = centerlines[..., 1:, :] - centerlines[..., :-1, :]
    step_valid = valid[..., 1:] & valid[..., :-1]
    step = torch.where(step_valid.unsqueeze(-1), step, torch.zeros_like(step))
    step = unit(step)
    none = torch.zeros_like(step[..., :1, :])
    forward = torch.cat([step, none], -2)
    backward = torch.cat([none, step], -2)
    has_forward = torch.cat([step_valid, torch.zeros_like(step_valid[..., :1])], -1)
    has_backward = torch.cat([torch.zeros_like(step_valid[..., :1]), step_valid], -1)
    return torch.where(has_forward.unsqueeze(-1), forward, backward), has_forward | has_backward
