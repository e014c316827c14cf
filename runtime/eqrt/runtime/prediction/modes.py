"""Which mode a cycle is in: it falls at once, and rises when the reason has stayed away."""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet

from eqrt.runtime.output.forecasts import Mode

HOLD_S = 0.5
"""A degraded mode is left when its reason has been away for so long: consumers that switch with the
mode are not made to flicker by a pose, or a deadline, that comes and goes."""
_BY_RANK = (Mode.FALLBACK, Mode.NO_POSE, Mode.LATE, Mode.NO_MAP)


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
