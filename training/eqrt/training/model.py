"""The paper's predictor: an equivariant network over agents, plus a canonicalised map.

    history ----> geometric features (turn) ----+--> P feature-learning layers --> decoder
         \\-----> pattern features (do not) -----+          ^
    centerlines -> canonical frame -> transformer -> fused into pattern; lane vectors into geometric

Inputs and outputs are contract version 1. Inside, lengths are in units of UNIT_M, and positions are
relative to the target's last seen position, so nothing depends on where the tile lies.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eqrt.training.canonical import canonical_from_tile, heading_vector, last_valid, masked
from eqrt.training.config import UNIT_M, ModelConfig
from eqrt.training.decoder import Decoder
from eqrt.training.layers import FeatureLearning, InteractionReasoning, Pairs, length, relations
from eqrt.training.map_encoder import PointTransformer, point_directions
from eqrt.training.motion import COURSE, MotionFeatures, MotionInit


class EquivariantPredictor(nn.Module):
    """Rotated map, point transformer, EqMotion layers (row 6 of the paper's table)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.motion = MotionInit(config)
        self.dropout = nn.Dropout(config.dropout)
        self.map = PointTransformer(config.token_width, config.heads, config.pointers, config.width)
        self.fuse = nn.Linear(config.channels + config.pointers, config.channels, bias=False)
        self.interaction = InteractionReasoning(config.channels, config.width, config.categories)
        self.layers = nn.ModuleList(
            FeatureLearning(config.channels, config.width, config.categories, config.dropout)
            for _ in range(config.layers)
        )
        self.decoder = Decoder(config)

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Contract version 1: trajectories (B, K, H, 2) tile frame, probabilities (B, K)."""
        history = masked(history, history_valid)
        last = last_valid(history, history_valid)  # (B, N, 2)
        origin = last[:, 0]  # (B, 2) the target, now
        motion = self.motion(history, history_valid, last)
        geometric, pattern = self.fuse_map(motion, origin, heading, centerlines, centerlines_valid)

        exists = history_valid.any(-1)  # (B, N)
        apart = ~torch.eye(exists.shape[1], dtype=torch.bool, device=exists.device)
        pair_valid = (exists.unsqueeze(1) & apart).to(geometric.dtype).unsqueeze(-1)
        offset = geometric.unsqueeze(1) - geometric.unsqueeze(2)
        relation = relations((last - last[:, :1]) / UNIT_M, motion.velocity[..., COURSE])
        weights = self.interaction(torch.cat([length(offset), relation], -1), pattern)
        pairs = Pairs(weights, relation, pair_valid)
        last_layer = len(self.layers) - 1
        for index, layer in enumerate(self.layers):
            receivers = 1 if index == last_layer else exists.shape[1]
            geometric, pattern = layer(geometric, pattern, pairs, receivers)

        trajectories, probabilities = self.decoder(
            geometric[:, 0], pattern[:, 0], motion.velocity[:, 0], motion.deviation
        )
        return origin[:, None, None, :] + UNIT_M * trajectories, probabilities

    def fuse_map(
        self,
        motion: MotionFeatures,
        origin: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Read the map from the target's own frame; hand it to the target's features."""
        points = (centerlines - origin[:, None, None, :]) / UNIT_M
        points = masked(points, centerlines_valid)  # (B, Q, L, 2)
        direction, has_direction = point_directions(points, centerlines_valid)
        points, direction = points.flatten(1, 2), direction.flatten(1, 2)  # (B, P, 2)
        valid = (centerlines_valid & has_direction).flatten(1)  # (B, P)
        distance2 = points.square().sum(-1) * UNIT_M**2
        moved = (
            motion.velocity[:, 0, :, COURSE] * UNIT_M
        )  # (B, 2) metres in a second, over the last second
        canonical = canonical_from_tile(heading_vector(moved, heading, direction, distance2, valid))
        tokens = torch.cat([points @ canonical, direction @ canonical], -1)  # (B, P, 4) invariant
        feature, lanes = self.map(tokens, valid, masked(points, valid), motion.pattern[:, 0])

        target = torch.cat([motion.geometric[:, 0], lanes], -1)  # (B, 2, C + pointers) turns
        geometric = torch.cat([self.fuse(target).unsqueeze(1), motion.geometric[:, 1:]], 1)
        pattern = torch.cat(
            [(motion.pattern[:, 0] + self.dropout(feature)).unsqueeze(1), motion.pattern[:, 1:]], 1
        )
        return geometric, pattern
