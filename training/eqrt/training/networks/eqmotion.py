"""The paper's systems on the EqMotion backbone (its rows 2 to 7): one network, four map encoders.

    centerlines -> the target's frame -> map encoder ----+
                                                         v
    history -------------------------------> initialisation layer -> G, H
    G, H -> interaction reasoning (once) -> P feature-learning layers -> decoder

With a rotated map, or none, the network is exactly equivariant: turning and shifting the world
turns and shifts the prediction. With a map that is only translated it is not. Inputs and outputs
are contract version 1; inside, lengths are in units of UNIT_M relative to the target's last seen
position.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import last_valid, masked
from eqrt.training.networks.config import UNIT_M, SceneConfig
from eqrt.training.networks.eqmotion_layers import (
    Agents,
    FeatureLearning,
    Initialisation,
    InteractionReasoning,
    MapFusion,
)
from eqrt.training.networks.layers import GatedVectorMlp, mlp
from eqrt.training.networks.map_tokens import AttentionEncoder, TransformerEncoder
from eqrt.training.networks.modes import most_probable_first
from eqrt.training.networks.raster import Pixels, RasterEncoder
from eqrt.training.networks.target_frame import FRAMES, HEADINGS, MapPoints, TargetFrame
from eqrt.training.tables import BoundedCount, PartialShare, Positive, check_choice, check_multiple

MAPS = ("none", "attention", "transformer", "raster")
"""The map encoders."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EqMotionConfig:
    """Table [network] with kind = "eqmotion"."""

    hidden: BoundedCount
    """C = D: vectors per agent, and every width that is not named below."""
    layers: BoundedCount
    """P, feature-learning layers."""
    mlp_layers: BoundedCount
    """Layers of every perceptron."""
    categories: BoundedCount
    """R, interaction categories."""
    map: str
    """One of MAPS."""
    frame: str
    """`translated` or `rotated` (`eqrt.training.networks.target_frame`)."""
    heading: str
    """`one_step` or `robust` (the same module)."""
    heads: BoundedCount
    """Of the transformer."""
    token_width: BoundedCount
    """Of a map point in the attention or the transformer; there a multiple of `heads`."""
    image_pixels: Pixels
    """Of one side of the drawn map (map = "raster"), a multiple of 4."""
    image_cell_m: Positive
    image_channels: BoundedCount
    """Of both convolutions."""
    image_width: BoundedCount
    """First layer of the perceptron that reads the image."""
    point_dropout: PartialShare = 0.0
    """Share of the map's points that a training step does not read (attention, transformer)."""

    def __post_init__(self) -> None:
        check_choice("map", self.map, MAPS)
        check_choice("frame", self.frame, FRAMES)
        check_choice("heading", self.heading, HEADINGS)
        if self.map == "transformer":
            check_multiple("token_width", self.token_width, self.heads)


class EqMotion(nn.Module):
    """EqMotion's backbone, and one of four readings of the map."""

    def __init__(self, scene: SceneConfig, config: EqMotionConfig) -> None:
        super().__init__()
        width, depth = config.hidden, config.mlp_layers
        self.modes, self.steps = scene.num_modes, scene.horizon_steps
        self.frame = TargetFrame(config.frame, config.heading, scene.dt_s, scene.centerline_points)
        self.in_metres = config.map == "raster"
        self.map = map_encoder(scene, config)
        self.fusion = None if self.map is None else MapFusion(width)
        self.initial = Initialisation(scene.history_steps, scene.dt_s, width, depth)
        self.interaction = InteractionReasoning(width, config.categories, depth)
        self.layers = nn.ModuleList(
            FeatureLearning(width, config.categories, depth) for _ in range(config.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.decoder = GatedVectorMlp([width] * depth + [self.modes * self.steps], width)
        self.logits = mlp([width] * depth + [self.modes]) if self.modes > 1 else None

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
        last = last_valid(history, history_valid).unsqueeze(2)  # (B, N, 1, 2)
        origin = last[:, :1]  # (B, 1, 1, 2) the target, now
        held = torch.where(history_valid.unsqueeze(-1), history, last)
        agents = Agents.of(history_valid, history.dtype)
        map_points = self.frame(
            history[:, 0], history_valid[:, 0], heading, centerlines, centerlines_valid
        )
        from_map, vectors = read_map(self.map, self.fusion, map_points, in_metres=self.in_metres)
        geometric, pattern = self.initial((held - origin) / UNIT_M, history_valid, agents, from_map)
        if vectors is not None:
            geometric = torch.cat([geometric[:, :1] + vectors, geometric[:, 1:]], 1)

        weights = self.interaction(geometric, pattern, agents)
        weights = weights.permute(3, 0, 1, 2).unsqueeze(-1)  # (R, B, N, N, 1)
        for layer in self.layers:
            geometric, pattern = layer(geometric, pattern, weights, agents)

        target = self.norm(pattern[:, 0])
        centre = agents.centre(geometric)[:, 0]  # (B, 2, 1)
        decoded = self.decoder(geometric[:, 0] - centre, target) + centre  # (B, 2, K H)
        trajectories = decoded.unflatten(-1, (self.modes, self.steps)).permute(0, 2, 3, 1)
        logits = None if self.logits is None else self.logits(target)
        return most_probable_first(origin + UNIT_M * trajectories, logits)


def read_map(
    encoder: nn.Module | None, fusion: MapFusion | None, points: MapPoints, *, in_metres: bool
) -> tuple[Tensor | None, Tensor | None]:
    """What the map adds to every H (B, 1, D), and to the target's G (B, 1, 2, C).

    `in_metres` is what the encoder reads; else tokens in network units, all in a row.
    """
    if encoder is None or fusion is None:
        return None, None
    if in_metres:
        feature = encoder(UNIT_M * points.points, points.valid)
    else:
        feature = encoder(points.points.flatten(1, 2), points.valid.flatten(1))
    from_map, vectors = fusion(feature, points.tile_from_frame)
    return from_map, vectors


def map_encoder(scene: SceneConfig, config: EqMotionConfig) -> nn.Module | None:
    """The map encoder that the configuration names; None for none."""
    hidden = [config.hidden] * config.mlp_layers
    tokens = scene.num_centerlines * scene.centerline_points
    if config.map == "none":
        return None
    if config.map == "attention":
        return AttentionEncoder(tokens, config.token_width, hidden, config.point_dropout)
    if config.map == "transformer":
        return TransformerEncoder(
            tokens, config.token_width, config.heads, hidden, config.point_dropout
        )
    return RasterEncoder(
        config.image_pixels,
        config.image_cell_m,
        scene.centerline_points,
        config.image_channels,
        [config.image_width, *hidden[1:]],
    )
