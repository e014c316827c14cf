"""Which mode a target was predicted in, and which mode a cycle is in.

A cycle's mode falls at once, and rises when the reason has stayed away.
"""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.output.forecasts import Mode
from eqrt.runtime.prediction.forecaster import Raw
from eqrt.runtime.prediction.guard import Guarded
from eqrt.runtime.tracking.ego import EgoState

HOLD_S = 0.5
"""A degraded mode is left when its reason has been away for so long: consumers that switch with the
mode are not made to flicker by a pose, or a deadline, that comes and goes."""
_BY_RANK = (Mode.FALLBACK, Mode.NO_POSE, Mode.LATE, Mode.NO_MAP)


def agent_modes(raw: Raw, guarded: Guarded) -> NDArray[np.uint8]:
    """(B,) how each target was predicted: RUN, PARTIAL, LATE or FALLBACK."""
    seen = np.where(raw.targets.valid.all(axis=1), Mode.RUN, Mode.PARTIAL)
    fell_back = np.where(raw.late, Mode.LATE, Mode.FALLBACK)
    return np.where(guarded.accepted, seen, fell_back).astype(np.uint8)


def cycle_reasons(
    raw: Raw, guarded: Guarded, ego: EgoState | None, *, has_tile: bool, overdue: bool
) -> set[Mode]:
    """All that is wrong with a cycle; `overdue`: it took longer than a period."""
    refused = ~guarded.accepted & ~raw.late
    found = {
        Mode.FALLBACK: refused.any() and not guarded.accepted.any(),
        Mode.NO_POSE: ego is None or (has_tile and not ego.has_map_pose),
        Mode.LATE: overdue or raw.late.any(),
        Mode.NO_MAP: not has_tile or (guarded.accepted.any() and not raw.has_lanes),
    }
    return {mode for mode, holds in found.items() if holds}


class ModeKeeper:
    """Remembers when each degradation was last seen."""

    def __init__(self) -> None:
        self._now_s = -math.inf
        self._seen_s = dict.fromkeys(_BY_RANK, -math.inf)

    def cycle(self, reasons: AbstractSet[Mode], now_s: float) -> Mode:
        """The mode of a cycle at `now_s` that was made under `reasons`.

        The gravest that holds, or held within HOLD_S: FALLBACK, NO_POSE, LATE, NO_MAP; else RUN.
        """
        if now_s < self._now_s:  # the clock was set back: what it said before means nothing
            self._seen_s = dict.fromkeys(_BY_RANK, -math.inf)
        self._now_s = now_s
        for mode in reasons:
            self._seen_s[mode] = now_s
        held = (mode for mode, seen_s in self._seen_s.items() if now_s - seen_s < HOLD_S)
        return next(held, Mode.RUN)
