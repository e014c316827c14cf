"""Our own predictor: few wide layers over one token per agent and one per centerline.

    history ------> the target's frame --> agent tokens --+
                                                          +--> transformer --> K mode queries
    centerlines --> the target's frame --> lane tokens  --+          --> trajectories, turned back

The paper's idea, taken to its end: not only the map but everything is read in the target's own
frame, which turns with the world (`canonical.heading_vector`); so every feature is invariant, and a
trajectory that is turned back is equivariant. A target without any direction (it stands, nothing
measures its heading, no lane is near) has the zero matrix for a frame: it sees nothing that turns,
and is predicted to stay on its course.

What each choice is worth is measured by taking the other one: how the heading is read, whether
anything is turned at all, and what a token of the map is. With `uncertainty` the network also says
how far off it may be (`eqrt.training.networks.spread`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import (
    LaneDirections,
    canonical_from_tile,
    exact,
    heading_vector,
    lane_directions,
    last_valid,
    masked,
)
from eqrt.training.networks.config import UNIT_M, SceneConfig
from eqrt.training.networks.layers import mlp
from eqrt.training.networks.motion import COURSE, SLOPE_STEPS, MotionFit, fitted_vectors
from eqrt.training.networks.spread import SpreadDecoder, tile_covariances
from eqrt.training.networks.target_frame import (
    FRAMES,
    HEADINGS,
    check_choice,
    one_step_heading,
    upright,
)
from eqrt.training.networks.time_basis import BASIS, time_basis

TOKENS = ("line", "point")
"""What a token of the map is."""
_MASKED = -1e9  # a finite minus infinity: a row without any valid token must not become NaN


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactConfig:
    """Table [network] with kind = "compact"."""

    width: int
    """Of a token."""
    heads: int
    layers: int
    """Transformer layers over all tokens."""
    decoder_layers: int
    """Layers in which the modes look at the tokens."""
    dropout: float
    """Share of updates dropped while training."""
    heading: str = "robust"
    """Which way the target faces: one of HEADINGS (`eqrt.training.networks.target_frame`)."""
    frame: str = "rotated"
    """One of FRAMES; `translated` turns nothing, so that the network is not equivariant."""
    tokens: str = "line"
    """One per centerline, or one per `point` of each, with the line's direction there."""
    uncertainty: bool = False
    """Whether covariances are predicted too, the third output."""

    def __post_init__(self) -> None:
        check_choice("heading", self.heading, HEADINGS)
        check_choice("frame", self.frame, FRAMES)
        check_choice("tokens", self.tokens, TOKENS)
        if not isinstance(self.uncertainty, bool):
            raise ValueError(f"uncertainty is {self.uncertainty!r}, expected true or false")


class CompactPredictor(nn.Module):
    """One token per agent, one per centerline (or per point of it)."""

    def __init__(self, scene: SceneConfig, config: CompactConfig) -> None:
        super().__init__()
        width = config.width
        self.heading, self.frame, self.tokens = config.heading, config.frame, config.tokens
        self.motion = MotionFit(scene)
        seen = 2 + 2 * fitted_vectors(scene) + scene.history_steps
        self.agent = mlp([seen, 2 * width, width])
        of_lane = 3 * scene.centerline_points if config.tokens == "line" else 4
        self.lane = mlp([of_lane, 2 * width, width])
        self.norm = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            TokenLayer(width, config.heads, config.dropout) for _ in range(config.layers)
        )
        self.modes = ModeDecoder(scene, config)

    def forward(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> tuple[Tensor, ...]:
        """Contract version 1: trajectories (B, K, H, 2) tile frame, probabilities (B, K).

        With uncertainty also covariances (B, K, H, 2, 2), square metres, tile frame.
        """
        with exact(history):
            seen = self._see(history, history_valid, heading, centerlines, centerlines_valid)
        tokens = self.norm(torch.cat([self.agent(seen.agents), self.lane(seen.lines)], 1))
        for layer in self.layers:
            tokens = layer(tokens, tokens, seen.valid)
        drawn, probabilities, *factors = self.modes(tokens, seen.valid, seen.velocity)
        with exact(history):
            turned_back = drawn @ seen.canonical.transpose(-1, -2).unsqueeze(1)
            trajectories = seen.origin[:, None, None, :] + UNIT_M * turned_back
            covariances = [tile_covariances(factor, seen.canonical) for factor in factors]
            return trajectories, probabilities, *covariances

    def _see(
        self,
        history: Tensor,
        history_valid: Tensor,
        heading: Tensor,
        centerlines: Tensor,
        centerlines_valid: Tensor,
    ) -> _Seen:
        """The contract's inputs, from the target's own frame."""
        history = masked(history, history_valid)
        last = last_valid(history, history_valid)  # (B, N, 2)
        origin = last[:, 0]
        motion = self.motion(history, history_valid, last)
        points = masked((centerlines - origin[:, None, None, :]) / UNIT_M, centerlines_valid)
        lanes = lane_directions(points, centerlines_valid, UNIT_M)
        if self.frame == "translated":
            canonical = upright(origin)
        elif self.heading == "one_step":
            facing = one_step_heading(history[:, 0], history_valid[:, 0], heading, lanes)
            canonical = canonical_from_tile(facing)
        else:
            moved = motion.velocity[:, 0, :, COURSE] * UNIT_M
            canonical = canonical_from_tile(heading_vector(moved, heading, lanes))
        turn = canonical.transpose(-1, -2).unsqueeze(1)  # (B, 1, 2, 2), for columns

        exists = history_valid.any(-1)  # (B, N)
        place = masked((last - origin.unsqueeze(1)) / UNIT_M, exists) @ canonical
        vectors = (turn @ motion.vectors).flatten(2)
        lines, lines_valid = self._lines(points, centerlines_valid, lanes, canonical)
        return _Seen(
            origin=origin,
            canonical=canonical,
            agents=torch.cat([place, vectors, history_valid.to(place.dtype)], -1),
            lines=lines,
            valid=torch.cat([exists, lines_valid], 1),
            velocity=turn[:, 0] @ motion.velocity[:, 0],
        )

    def _lines(
        self, points: Tensor, valid: Tensor, lanes: LaneDirections, canonical: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What is known of each token of the map, and which exist, from points (B, Q, L, 2)."""
        if self.tokens == "point":
            vectors = torch.cat(
                [points.flatten(1, 2) @ canonical, lanes.directions @ canonical], -1
            )
            return vectors, valid.flatten(1)
        lines = (points @ canonical.unsqueeze(1)).flatten(2)  # (B, Q, 2 L)
        return torch.cat([lines, valid.to(lines.dtype)], -1), valid.any(-1)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A scene as the target sees it; only `origin` and `canonical` know where that is."""

    origin: Tensor
    """(B, 2) the target now, tile frame."""
    canonical: Tensor
    """(B, 2, 2) turns into the target's frame, for row vectors."""
    agents: Tensor
    """(B, N, .) where each agent is, how it moved, and when it was seen."""
    lines: Tensor
    """(B, Q, 3 L) the points of each centerline, and which exist; or (B, Q L, 4) each point, and
    which way its line leads there."""
    valid: Tensor
    """(B, N + Q) or (B, N + Q L): which agents, lines or points exist."""
    velocity: Tensor
    """(B, 2, S) the target's fitted velocities."""


class TokenLayer(nn.Module):
    """Attention and a perceptron, each added to what was there (pre-norm)."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.project = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.perceptron = mlp([width, 2 * width, width])
        self.dropout = nn.Dropout(dropout)

    def forward(self, tokens: Tensor, seen: Tensor, valid: Tensor) -> Tensor:
        """Tokens (B, M, W) that look at the tokens seen (B, S, W), valid (B, S)."""
        query = self._split(self.query(self.norm1(tokens)))
        key, value = self.key_value(self.norm1(seen)).chunk(2, -1)
        hidden = (~valid[:, None, None, :]).to(tokens.dtype) * _MASKED
        score = query @ self._split(key).transpose(-1, -2) / query.shape[-1] ** 0.5
        attended = ((score + hidden).softmax(-1) @ self._split(value)).transpose(1, 2).flatten(2)
        tokens = tokens + self.dropout(self.project(attended))
        updated: Tensor = tokens + self.dropout(self.perceptron(self.norm2(tokens)))
        return updated

    def _split(self, tokens: Tensor) -> Tensor:
        batch, count, _ = tokens.shape
        return tokens.view(batch, count, self.heads, -1).transpose(1, 2)  # (B, heads, M, W / heads)


class ModeDecoder(nn.Module):
    """K queries, one per mode, look at all tokens; each draws a trajectory.

    A trajectory is the target's mean course, a mixture of its fitted velocities, plus smooth
    functions of time that are 0 now. With uncertainty, each mode also draws its spread.
    """

    time: Tensor
    """(H,) seconds."""
    basis: Tensor
    """(BASIS, H)"""

    def __init__(self, scene: SceneConfig, config: CompactConfig) -> None:
        super().__init__()
        width = config.width
        self.num_modes, self.steps = scene.num_modes, scene.horizon_steps
        self.query = nn.Parameter(0.5 * torch.randn(scene.num_modes, width))
        self.layers = nn.ModuleList(
            TokenLayer(width, config.heads, config.dropout) for _ in range(config.decoder_layers)
        )
        self.norm = nn.LayerNorm(width)
        self.draw = mlp([width, 2 * width, 2 * BASIS + len(SLOPE_STEPS)])
        with torch.no_grad():
            list(self.draw.parameters())[-2].mul_(0.1)  # training starts near the mean course
        self.logit = mlp([width, width, 1])
        time = torch.arange(1, self.steps + 1) * scene.dt_s
        self.register_buffer("time", time, persistent=False)
        self.register_buffer("basis", time_basis(self.steps), persistent=False)
        spread = SpreadDecoder(width, self.steps, scene.dt_s) if config.uncertainty else None
        self.spread = spread  # last, so that all other weights start as they would without

    def forward(self, tokens: Tensor, valid: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Tokens (B, M, W), the target's first; valid (B, M); its velocity (B, 2, S).

        Returns (B, K, H, 2), relative to the target, in its frame, network units, and (B, K); the
        most probable mode first. With uncertainty also the factors (B, K, H, 2, 2) of `spread`.
        """
        queries = tokens[:, :1] + self.query
        for layer in self.layers:
            queries = layer(queries, tokens, valid)
        queries = self.norm(queries)  # (B, K, W)
        probabilities = self.logit(queries).squeeze(-1).softmax(-1)
        drawn = self.draw(queries).to(velocity.dtype)
        with exact(velocity):
            share = drawn[..., 2 * BASIS :].softmax(-1)  # (B, K, S)
            course = (share @ velocity.transpose(-1, -2)).unsqueeze(-2) * self.time.unsqueeze(-1)
            shape = drawn[..., : 2 * BASIS].unflatten(-1, (2, BASIS)) @ self.basis  # (B, K, 2, H)
            trajectories = course + shape.transpose(-1, -2)
        factors = () if self.spread is None else (self.spread(queries),)
        if self.num_modes == 1:
            return trajectories, probabilities, *factors
        probabilities, order = probabilities.topk(self.num_modes, dim=-1)
        places = order[..., None, None].expand(-1, -1, self.steps, 2)
        ordered = [
            factor.gather(1, places.unsqueeze(-1).expand(-1, -1, -1, -1, 2)) for factor in factors
        ]
        return trajectories.gather(1, places), probabilities, *ordered
