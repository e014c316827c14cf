"""Our own predictor: few wide layers over one token per agent and one per centerline.

    history ------> the target's frame --> agent tokens --+
                                                          +--> K mode queries --> trajectories,
    centerlines --> the target's frame --> lane tokens  --+    layer by layer     turned back

The paper's idea, taken to its end: not only the map but everything is read in the target's own
frame, which turns with the world (`canonical.heading_vector`); so every feature is invariant, and a
trajectory that is turned back is equivariant. A target without any direction (it stands, nothing
measures its heading, no lane is near) has the zero matrix for a frame: it sees nothing that turns,
and is predicted to stay on its course.

What each choice is worth is measured by taking the other one: how the heading is read, whether
anything is turned at all, and what a token of the map is. With `uncertainty` the network also says
how far off it may be (`eqrt.training.networks.spread`).

It is written for the exported graph, whose cost on a CPU is one operator after the other: products
of two matrices wherever possible, and no more of them than needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eqrt.training.networks.canonical import exact
from eqrt.training.networks.config import UNIT_M, SceneConfig
from eqrt.training.networks.layers import mlp
from eqrt.training.networks.motion import SLOPE_STEPS
from eqrt.training.networks.spread import SpreadDecoder, tile_covariances
from eqrt.training.networks.target_frame import FRAMES, HEADINGS
from eqrt.training.networks.target_view import TOKENS, TargetView
from eqrt.training.networks.time_basis import BASIS, time_basis
from eqrt.training.tables import BoundedCount, PartialShare, check_choice, check_multiple

_MASKED = 1e9  # a finite infinity: a row without any valid token must not become NaN


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactConfig:
    """Table [network] with kind = "compact"."""

    width: BoundedCount
    """Of a token; a multiple of `heads`."""
    hidden: BoundedCount
    """Of the perceptrons."""
    heads: BoundedCount
    """Ways in which a mode looks at the tokens at once."""
    layers: BoundedCount
    """In each of which every mode looks at all tokens."""
    dropout: PartialShare
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
        check_multiple("width", self.width, self.heads)


class CompactPredictor(nn.Module):
    """One token per agent, one per centerline (or per point of it)."""

    def __init__(self, scene: SceneConfig, config: CompactConfig) -> None:
        super().__init__()
        self.view = TargetView(scene, config.heading, config.frame, config.tokens)
        self.agent = TokenEncoder(self.view.of_agent, config)
        self.lane = TokenEncoder(self.view.of_lane, config)
        self.norm = nn.LayerNorm(config.width)
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
            seen = self.view(history, history_valid, heading, centerlines, centerlines_valid)
        tokens = self.norm(torch.cat([self.agent(seen.agents), self.lane(seen.lanes)], 1))
        drawn = self.modes(tokens, seen.valid)
        with exact(history):
            course = drawn.share.to(seen.velocity) @ seen.velocity.transpose(1, 2)  # (B, K, 2)
            shape = (drawn.shape.to(course) @ seen.turn).unflatten(1, (-1, BASIS))
            path = self.modes.basis @ torch.cat([course.unsqueeze(2), shape], 2)
            covariances = [tile_covariances(spread, seen.turn) for spread in drawn.spreads]
            return seen.origin + path, drawn.probabilities, *covariances


class TokenEncoder(nn.Module):
    """A perceptron from what is known of an agent, or of a lane, to its token."""

    inputs: Tensor
    """(F, known): what is read, of what is known; folded into the weights when exported."""

    def __init__(self, inputs: Tensor, config: CompactConfig) -> None:
        super().__init__()
        self.register_buffer("inputs", inputs, persistent=False)
        self.widen = nn.Linear(len(inputs), config.hidden)
        self.narrow = nn.Sequential(nn.SiLU(), nn.Linear(config.hidden, config.width))

    def forward(self, known: Tensor) -> Tensor:
        """(B, 1, M, known) -> (B, M, W), as products of two matrices."""
        rows = known.flatten(0, 2)
        wide = torch.nn.functional.linear(rows, self.widen.weight @ self.inputs, self.widen.bias)
        tokens: Tensor = self.narrow(wide)
        return tokens.view(-1, known.shape[2], tokens.shape[-1])


@dataclass(frozen=True, slots=True)
class Drawn:
    """K modes of each target, the most probable first."""

    probabilities: Tensor
    """(B, K)"""
    share: Tensor
    """(B, K, S) of each fitted velocity in the mode's course."""
    shape: Tensor
    """(B, K BASIS, 2) how the mode leaves its course, in the target's frame."""
    spreads: tuple[Tensor, ...]
    """With uncertainty, (B, K, 3, H) of `spread`, in the target's frame; else empty."""


class ModeDecoder(nn.Module):
    """K queries, one per mode, look at all tokens; each draws a trajectory.

    A trajectory is the target's mean course, a mixture of its fitted velocities, plus smooth
    functions of time that are 0 now. With uncertainty, each mode also draws its spread.
    """

    basis: Tensor
    """(H, 1 + BASIS) metres: what a velocity of 1 m/s, and each drawn number, adds at each step."""

    def __init__(self, scene: SceneConfig, config: CompactConfig) -> None:
        super().__init__()
        width = config.width
        self.num_modes, self.steps = scene.num_modes, scene.horizon_steps
        self.query = nn.Parameter(0.5 * torch.randn(scene.num_modes, width))
        self.layers = nn.ModuleList(ModeLayer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.draw = mlp([width, config.hidden, 2 * BASIS + len(SLOPE_STEPS)])
        with torch.no_grad():
            list(self.draw.parameters())[-2].mul_(0.1)  # training starts near the mean course
        self.logit = mlp([width, width, 1]) if scene.num_modes > 1 else None
        time = torch.arange(1, self.steps + 1) * scene.dt_s
        basis = torch.cat([time.unsqueeze(0), UNIT_M * time_basis(self.steps)])
        self.register_buffer("basis", basis.T.contiguous(), persistent=False)
        spread = SpreadDecoder(width, self.steps, scene.dt_s) if config.uncertainty else None
        self.spread = spread  # last, so that all other weights start as they would without

    def forward(self, tokens: Tensor, valid: Tensor) -> Drawn:
        """Tokens (B, M, W), the target's first; valid (B, 1, M) 1 or 0."""
        hidden = (valid - 1.0) * _MASKED
        columns = tokens.transpose(1, 2)
        queries = (tokens[:, :1] + self.query).flatten(0, 1)  # (B K, W)
        for layer in self.layers:
            queries = layer(queries, tokens, columns, hidden)
        probabilities, queries = self._most_probable_first(self.norm(queries))
        shape, share = self.draw(queries).split([2 * BASIS, len(SLOPE_STEPS)], -1)
        return Drawn(
            probabilities,
            self._by_mode(share.softmax(-1)),
            shape.reshape(-1, self.num_modes * BASIS, 2),
            () if self.spread is None else (self.spread(self._by_mode(queries)),),
        )

    def _by_mode(self, values: Tensor) -> Tensor:
        """(B K, F) -> (B, K, F)."""
        return values.view(-1, self.num_modes, values.shape[-1])

    def _most_probable_first(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Probabilities (B, K), and the queries (B K, W) in their order."""
        if self.logit is None:
            return queries[:, :1].softmax(-1), queries  # of one: 1
        logits = self._by_mode(self.logit(queries)).squeeze(-1)
        probabilities, order = logits.softmax(-1).topk(self.num_modes, dim=-1)
        places = order.unsqueeze(-1).expand(-1, -1, queries.shape[-1])
        return probabilities, self._by_mode(queries).gather(1, places).flatten(0, 1)


class ModeLayer(nn.Module):
    """Attention of the modes to the tokens, and a perceptron, each added to what was there.

    It is the usual attention, multiplied out for few queries, often one, and many tokens: a key's
    product with a query is the token's product with a row of W, and what a head returns is a mean
    of tokens. So keys and values are never computed; their weights are folded into those before and
    after, once, when the network is exported.
    """

    def __init__(self, config: CompactConfig) -> None:
        super().__init__()
        self.heads, width = config.heads, config.width
        self.norm1 = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width, bias=False)  # one would change no share
        self.value = nn.Linear(width, width, bias=False)
        self.project = nn.Linear(width, width, bias=False)
        self.norm2 = nn.LayerNorm(width)
        self.widen = nn.Sequential(nn.Linear(width, config.hidden), nn.SiLU())
        self.narrow = nn.Linear(config.hidden, width, bias=False)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, queries: Tensor, tokens: Tensor, columns: Tensor, hidden: Tensor) -> Tensor:
        """Queries (B K, W) that look at tokens (B, M, W), also given as columns (B, W, M).

        hidden (B, 1, M): 0, or minus infinity where there is no token.
        """
        batch, _, width = tokens.shape
        ask, ask_bias, tell = self._folded()
        asked = torch.nn.functional.linear(self.norm1(queries), ask, ask_bias)
        share = (asked.view(batch, -1, width) @ columns + hidden).softmax(-1)  # (B, K heads, M)
        answer = (share @ tokens).view(-1, self.heads * width)
        queries = self._add(queries, answer, tell)
        return self._add(queries, self.widen(self.norm2(queries)), self.narrow.weight.T)

    def _folded(self) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (heads W, W) and bias (heads W,) of what is asked; (heads W, W) of the answer."""
        width = self.query.weight.shape[0]
        by_head = (self.heads, -1, width)
        key = self.key.weight.view(by_head).transpose(-1, -2) / (width / self.heads) ** 0.5
        ask = key @ self.query.weight.view(by_head)  # (heads, W, W)
        bias = key @ self.query.bias.view(self.heads, -1, 1)
        value = self.value.weight.view(by_head).transpose(-1, -2)
        tell = value @ self.project.weight.T.reshape(by_head)
        return ask.flatten(0, 1), bias.flatten(), tell.flatten(0, 1)

    def _add(self, to: Tensor, values: Tensor, weight: Tensor) -> Tensor:
        """A linear function of `values` on top: one operator in the exported graph."""
        if self.training:
            dropped: Tensor = to + self.dropout(values @ weight)
            return dropped
        return torch.addmm(to, values, weight)
