"""Make clean recordings look like what a sensor in a car sees.

The network is equivariant, so nothing is rotated or shifted here. What it must learn is that tracks
begin late, have holes, jitter, that neighbours are hidden and that a map may be missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

Batch = dict[str, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Probabilities per window unless said otherwise."""

    short_history: float
    """The target and its neighbours were first seen only some steps ago."""
    missing_step: float
    """Per step and agent."""
    hidden_neighbour: float
    """Per neighbour."""
    missing_line: float
    """Per centerline."""
    no_map: float
    """Every centerline at once."""
    unknown_heading: float
    heading_noise_rad: float
    """Standard deviation."""
    position_noise_m: float
    """Standard deviation of the noisiest windows; each window draws its own below it."""


def augment(batch: Batch, config: AugmentConfig, generator: torch.Generator) -> Batch:
    """A new batch; the target's last step and the future stay as they are."""

    def chance(probability: float, *shape: int) -> Tensor:
        return torch.rand(shape, generator=generator) < probability

    windows, agents, steps = batch["history_valid"].shape
    lines = batch["centerlines_valid"].shape[1]
    first = torch.randint(0, steps - 1, (windows, 1, 1), generator=generator)
    late = chance(config.short_history, windows, 1, 1) & (torch.arange(steps) < first)
    drop = late | chance(config.missing_step, windows, agents, steps)
    hidden = chance(config.hidden_neighbour, windows, agents, 1)
    hidden[:, 0] = False
    drop = drop | hidden
    drop[:, 0, -1] = False  # the target is seen now: that is what makes it a target
    lost = chance(config.missing_line, windows, lines, 1) | chance(config.no_map, windows, 1, 1)
    return batch | {
        "history": batch["history"] + _noise(batch["history"], config, generator),
        "history_valid": batch["history_valid"] & ~drop,
        "heading": _heading(batch["heading"], config, generator),
        "centerlines_valid": batch["centerlines_valid"] & ~lost,
    }


def _noise(history: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    level = torch.rand((len(history), 1, 1, 1), generator=generator) ** 2  # mostly clean
    return config.position_noise_m * level * torch.randn(history.shape, generator=generator)


def _heading(heading: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    angle = config.heading_noise_rad * torch.randn(len(heading), generator=generator)
    known = torch.rand(len(heading), generator=generator) >= config.unknown_heading
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = heading.unbind(-1)
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return turned * known[:, None]
