"""Make clean recordings look like what a sensor in a car sees.

What a predictor must learn is that tracks begin late, have holes, jitter, that neighbours are
hidden and that a map may be missing; and that there are parked cars, and faster and slower roads
than the recorded ones. That roads lead everywhere an equivariant network need not learn: `rotated`
is for the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import torch
from torch import Tensor

from eqrt.training.tables import NotNegative, Share

Batch = dict[str, Tensor]

GHOST_M = 1.5
"""A radar sees a vehicle at its corners, wheels and through its underbody."""
WANDER_STEPS = 15.0
"""Over so many steps the place of a reflection on a standing thing forgets where it was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Probabilities per window unless said otherwise; what is not given does not happen."""

    rotated: Share = 0.0
    """The whole scene, about the target, by any angle. An equivariant network cannot tell."""
    mirrored: Share = 0.0
    """The whole scene, as if seen in a mirror: traffic that keeps to the other side."""
    scaled: Share = 0.0
    """The whole scene, lanes and future too, is made larger or smaller: other speeds."""
    max_scale: Annotated[float, msgspec.Meta(ge=1.0)] = 1.0
    """The largest factor; the smallest is its inverse."""
    parked: Share = 0.0
    """The target has always stood where it is, and stays."""
    standing: Share = 0.0
    """So has everybody: a queue."""
    clutter: Share = 0.0
    """Per neighbour: it is a thing beside the road that has never moved."""
    wander_m: NotNegative = 0.0
    """Standard deviation of how far the sensor's point on a thing that stands moves about: its
    reflection runs along a wall. Each thing draws its own below it."""
    ghost: Share = 0.0
    """Per neighbour: it is a second reflection of the target, within some metres."""
    alone: Share = 0.0
    """Every neighbour is hidden."""
    short_history: Share = 0.0
    """The target and its neighbours were first seen only some steps ago."""
    missing_step: Share = 0.0
    """Per step and agent."""
    hidden_neighbour: Share = 0.0
    """Per neighbour."""
    missing_line: Share = 0.0
    """Per centerline."""
    line_offset_m: NotNegative = 0.0
    """Standard deviation, of where each centerline lies: maps are not exact."""
    no_map: Share = 0.0
    """Every centerline at once."""
    unknown_heading: Share = 0.0
    heading_noise_rad: NotNegative = 0.0
    """Standard deviation."""
    position_noise_m: NotNegative = 0.0
    """Standard deviation of the noisiest windows; each window draws its own below it."""


def augment(batch: Batch, config: AugmentConfig, generator: torch.Generator) -> Batch:
    """A new batch; the target's last step stays where it is, up to noise."""

    def chance(probability: float, *shape: int) -> Tensor:
        return torch.rand(shape, generator=generator) < probability

    windows = len(batch["future"])
    agents = batch["history"].shape[1]
    still = chance(config.clutter, windows, agents)
    still[:, 0] = chance(config.parked, windows)
    still |= chance(config.standing, windows, 1)
    steps, ahead = batch["history"].shape[2], batch["future"].shape[1]
    wander = _wander(config.wander_m, (windows, agents), steps, ahead, generator)
    batch = _stood(batch, still, wander)
    batch = _ghosts(batch, chance(config.ghost, windows, agents), generator)
    batch = _scaled(batch, _scales(windows, config, generator))
    batch = _mirrored(batch, chance(config.mirrored, windows))
    if config.rotated:
        batch = _rotated(batch, chance(config.rotated, windows), generator)
    lines = batch["centerlines_valid"].shape[1]
    first = torch.randint(0, steps, (windows, 1, 1), generator=generator)
    late = chance(config.short_history, windows, 1, 1) & (torch.arange(steps) < first)
    drop = late | chance(config.missing_step, windows, agents, steps)
    hidden = chance(config.hidden_neighbour, windows, agents, 1)
    hidden |= chance(config.alone, windows, 1, 1)
    hidden[:, 0] = False
    drop = drop | hidden
    drop[:, 0, -1] = False  # the target is seen now: that is what makes it a target
    lost = chance(config.missing_line, windows, lines, 1) | chance(config.no_map, windows, 1, 1)
    return batch | {
        "history": batch["history"] + _noise(batch["history"], config, generator),
        "history_valid": batch["history_valid"] & ~drop,
        "heading": _heading(batch["heading"], config, generator),
        "centerlines": _offset_lines(batch["centerlines"], config, generator),
        "centerlines_valid": batch["centerlines_valid"] & ~lost,
    }


def _stood(batch: Batch, still: Tensor, wander: Tensor) -> Batch:
    """The agents `still` (B, N) have never moved, and a target among them never will.

    All but `wander` (B, N, T + H, 2), which is 0 now. Agents that are not seen now keep their past:
    where they are now is not known.
    """
    last = batch["history"][:, :, -1:]  # (B, N, 1, 2)
    still = (still & batch["history_valid"][:, :, -1])[..., None, None]  # (B, N, 1, 1)
    places, past = last + wander, batch["history"].shape[2]
    return batch | {
        "history": torch.where(still, places[:, :, :past], batch["history"]),
        "future": torch.where(still[:, 0], places[:, 0, past:], batch["future"]),
    }


def _wander(
    deviation_m: float, shape: tuple[int, int], past: int, ahead: int, generator: torch.Generator
) -> Tensor:
    """(*shape, past + ahead, 2) relative to the last of the past: a smooth random process each.

    Gaussian, with the Matern covariance of order 3/2 (Rasmussen & Williams, Gaussian Processes for
    Machine Learning, eq. 4.17) over WANDER_STEPS.
    """
    steps = torch.arange(past + ahead)
    if deviation_m == 0.0:
        return torch.zeros((*shape, len(steps), 2))
    apart = 3.0**0.5 * (steps[:, None] - steps).abs() / WANDER_STEPS
    covariance = ((1.0 + apart) * torch.exp(-apart)).double()
    root = torch.linalg.cholesky(covariance + 1e-6 * torch.eye(len(steps))).float()
    level = deviation_m * torch.rand((*shape, 1, 1), generator=generator) ** 2  # mostly little
    paths: Tensor = level * (root @ torch.randn((*shape, len(steps), 2), generator=generator))
    return paths - paths[:, :, past - 1 : past]


def _ghosts(batch: Batch, ghost: Tensor, generator: torch.Generator) -> Batch:
    """The neighbours `ghost` (B, N) move with the target, GHOST_M away or so."""
    ghost[:, 0] = False
    offset = GHOST_M * torch.randn((*ghost.shape, 1, 2), generator=generator)
    copies = batch["history"][:, :1] + offset  # (B, N, T, 2)
    chosen = ghost[..., None]  # (B, N, 1)
    return batch | {
        "history": torch.where(chosen[..., None], copies, batch["history"]),
        "history_valid": torch.where(chosen, batch["history_valid"][:, :1], batch["history_valid"]),
    }


def _scales(windows: int, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    """(B,) factors, even in their logarithm; 1 for those that stay as they are."""
    power = 2.0 * torch.rand(windows, generator=generator) - 1.0
    chosen = torch.rand(windows, generator=generator) < config.scaled
    return torch.where(chosen, config.max_scale**power, 1.0)


def _scaled(batch: Batch, scale: Tensor) -> Batch:
    """Everything farther from, or nearer to, the target's last place by `scale` (B,)."""
    here = batch["history"][:, 0, -1]  # (B, 2)

    def grown(points: Tensor) -> Tensor:
        shape = (-1, *[1] * (points.dim() - 2))
        center = here.view(*shape, 2)
        return center + (points - center) * scale.view(*shape, 1)

    return batch | {name: grown(batch[name]) for name in ("history", "centerlines", "future")}


def _mirrored(batch: Batch, chosen: Tensor) -> Batch:
    """The windows chosen (B,), mirrored at the line through the target along x."""
    here = batch["history"][:, 0, -1, 1]  # (B,)
    sign = torch.where(chosen, -1.0, 1.0)

    def flipped(points: Tensor) -> Tensor:
        shape = (-1, *[1] * (points.dim() - 2))
        center = here.view(shape)
        y = center + (points[..., 1] - center) * sign.view(shape)
        return torch.stack([points[..., 0], y], -1)

    heading = batch["heading"] * torch.stack([torch.ones_like(sign), sign], -1)
    turned = {name: flipped(batch[name]) for name in ("history", "centerlines", "future")}
    return batch | turned | {"heading": heading}


def _rotated(batch: Batch, chosen: Tensor, generator: torch.Generator) -> Batch:
    """The windows chosen (B,), each turned about the target's last place by an angle of its own."""
    angle = 2.0 * torch.pi * torch.rand(len(chosen), generator=generator) * chosen
    cos, sin = torch.cos(angle), torch.sin(angle)
    turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)  # for rows
    here = batch["history"][:, 0, -1]  # (B, 2)

    def turned(points: Tensor) -> Tensor:
        center = here.view(-1, *[1] * (points.dim() - 2), 2)
        flat = (points - center).flatten(1, -2) @ turn
        return center + flat.view(points.shape)

    scene = {name: turned(batch[name]) for name in ("history", "centerlines", "future")}
    return batch | scene | {"heading": (batch["heading"].unsqueeze(1) @ turn).squeeze(1)}


def _noise(history: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    level = torch.rand((len(history), 1, 1, 1), generator=generator) ** 2  # mostly clean
    return config.position_noise_m * level * torch.randn(history.shape, generator=generator)


def _offset_lines(lines: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    """Every line (B, Q, L, 2) shifted as a whole."""
    return lines + config.line_offset_m * torch.randn((*lines.shape[:2], 1, 2), generator=generator)


def _heading(heading: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    angle = config.heading_noise_rad * torch.randn(len(heading), generator=generator)
    known = torch.rand(len(heading), generator=generator) >= config.unknown_heading
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = heading.unbind(-1)
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return turned * known[:, None]
