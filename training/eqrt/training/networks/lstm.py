"""The paper's baseline (its row 1): an LSTM over the tracks, and a CNN over the drawn map.

It reads positions relative to the target, not turned, so it is not equivariant: it has to learn
every direction of travel on its own. That is what it is compared for.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import last_valid, masked
from eqrt.training.networks.config import UNIT_M, SceneConfig
from eqrt.training.networks.layers import mlp
from eqrt.training.networks.modes import most_probable_first
from eqrt.training.networks.raster import Pixels, RasterEncoder
from eqrt.training.tables import BoundedCount, Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class LstmConfig:
    """Table [network] with kind = "lstm"."""

    hidden: BoundedCount
    """Width of the LSTM, of the features and of the perceptrons."""
    mlp_layers: BoundedCount
    """Layers of every perceptron."""
    image_pixels: Pixels
    """Of one side of the drawn map, a multiple of 4."""
    image_cell_m: Positive
    image_channels: BoundedCount
    """Of both convolutions."""
    image_width: BoundedCount
    """First layer of the perceptron that reads the image."""


class LstmBaseline(nn.Module):
    """Tracks -> LSTM; map -> image -> CNN; both -> perceptron -> K trajectories."""

    def __init__(self, scene: SceneConfig, config: LstmConfig) -> None:
        super().__init__()
        self.modes, self.steps = scene.num_modes, scene.horizon_steps
        hidden = [config.hidden] * (config.mlp_layers - 1)
        self.tracks = nn.LSTM(3 * scene.num_agents, config.hidden, batch_first=True)
        self.map = RasterEncoder(
            config.image_pixels,
            config.image_cell_m,
            scene.centerline_points,
            config.image_channels,
            [config.image_width, *hidden],
        )
        self.decoder = mlp([2 * config.hidden, *hidden, self.modes * self.steps * 2])
        self.logits = mlp([2 * config.hidden, *hidden, self.modes]) if self.modes > 1 else None

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,  # noqa: ARG002 (the contract gives it; the paper's baseline has no use for it)
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Contract version 1: trajectories (B, K, H, 2) tile frame, probabilities (B, K)."""
        history = masked(history, history_valid)
        origin = last_valid(history[:, 0], history_valid[:, 0])  # (B, 2) the target, now
        tracks = masked((history - origin[:, None, None, :]) / UNIT_M, history_valid)
        seen = history_valid.unsqueeze(-1).to(tracks.dtype)
        steps = torch.cat([tracks, seen], -1).transpose(1, 2).flatten(2)  # (B, T, 3 N)
        track_feature = self.tracks(steps)[0][:, -1]  # (B, D)
        points = masked(centerlines - origin[:, None, None, :], centerlines_valid)
        feature = torch.cat([track_feature, self.map(points, centerlines_valid)], -1)
        trajectories = self.decoder(feature).view(-1, self.modes, self.steps, 2)
        logits = None if self.logits is None else self.logits(feature)
        return most_probable_first(origin[:, None, None, :] + UNIT_M * trajectories, logits)
