"""Whether a source (a sensor, or a group of messages about the ego vehicle) is to be believed.

A part of AUTOSAR's E2E state machine ("E2E Protocol Specification", document 849): a source is
valid until all of the last `MAX_WRONG` verdicts were wrong, and again when the last `MIN_RIGHT`
were right. There: WindowSizeValid 5, MaxErrorStateValid 4, MinOkStateValid 1; WindowSizeInvalid
and MinOkStateInvalid 3, MaxErrorStateInvalid 0; WindowSizeInit and MinOkStateInit 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

MAX_WRONG = 5
"""This many wrong verdicts in a row and a source is not believed any more. Fewer happen on a
disturbed bus, and what was wrong did not count anyway; more would be half a second of it."""
MIN_RIGHT = 3
"""This many right ones in a row and it is believed again. One may be chance (a checksum of eight
bits lets one wrong message in 256 pass), and with three, two steps of the counter were seen."""
DEFAULT_SILENCE_S = 0.5
"""Five cycles of 10 Hz; nothing older is predicted from anyhow."""


class SourceState(Enum):
    """What is known of a source; the values are meant to be shown."""

    WAITING = "nothing right has come yet"
    VALID = "valid"
    WRONG = "wrong checksums or counters"
    SILENT = "silent"


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceReport:
    """A source at one time."""

    name: str
    """The sensor's, or `ego` and the message that tells."""
    state: SourceState
    since_s: float | None
    """When it got into this state; None = it has been in it from the beginning."""
    right: int
    """Verdicts so far: cycles of a sensor, messages about the ego vehicle."""
    wrong: int
    silences: int
    """How often it fell silent."""
    refused: int
    """What came while it was not valid and was not used: cycles, or messages that tell."""

    @property
    def valid(self) -> bool:
        """Whether what it says is used."""
        return self.state is SourceState.VALID

    @property
    def reason(self) -> str:
        """Why it is not valid; empty if it is."""
        return "" if self.valid else self.state.value


class SourceHealth:
    """Takes a verdict on all that comes from a source, and the time."""

    def __init__(self, name: str, silence_s: float, num_parts: int = 1) -> None:
        """Each of `num_parts` is judged by itself; the last one not coming is silence."""
        self._name = name
        self._silence_s = silence_s
        self._parts = [_Streak() for _ in range(num_parts)]
        self._heard_s: float | None = None
        self._state, self._is_valid = SourceState.WAITING, False
        self._since_s: float | None = None
        self._right = self._wrong = self._silences = self._refused = 0

    @property
    def report(self) -> SourceReport:
        """How it is now."""
        return SourceReport(
            name=self._name,
            state=self._state,
            since_s=self._since_s,
            right=self._right,
            wrong=self._wrong,
            silences=self._silences,
            refused=self._refused,
        )

    def judge(self, right: bool, now_s: float, part: int = -1) -> bool:
        """Take a verdict on something of a part; whether the source is valid with it."""
        silent = self.expire(now_s)
        streak = self._parts[part]
        self._right += right
        self._wrong += not right
        if streak is self._parts[-1]:
            self._heard_s, silent = now_s, False
        if self._is_valid and right and streak.is_settled:  # as nearly always
            return True
        streak.add(right)
        if self._heard_s is not None and not silent:
            self._conclude(now_s)
        return self._is_valid

    def refuse(self) -> None:
        """Count what is not used because the source is not valid."""
        self._refused += 1

    def expire(self, now_s: float) -> bool:
        """Whether it is silent: it has been for too long, or the clock was set back."""
        if self._heard_s is None:
            return False
        if -self._silence_s <= now_s - self._heard_s <= self._silence_s:
            return False
        if self._state is not SourceState.SILENT:
            self._silences += 1
            self._become(SourceState.SILENT, now_s)
        return True

    def _conclude(self, now_s: float) -> None:
        if all(streak.is_good for streak in self._parts):
            self._become(SourceState.VALID, now_s)
        elif self._state is not SourceState.WAITING or any(
            streak.wrong >= MAX_WRONG for streak in self._parts
        ):
            self._become(SourceState.WRONG, now_s)

    def _become(self, state: SourceState, now_s: float) -> None:
        if state is not self._state:
            self._state, self._since_s = state, now_s
            self._is_valid = state is SourceState.VALID


class _Streak:
    """Verdicts in a row. What was never judged is as good as what was right."""

    def __init__(self) -> None:
        self.wrong = 0  # in a row, up to now
        self._missing = 0  # right ones, until it is good
        self._needed = 1  # of them, after a wrong one: the first right one will do at the start
        self._is_new = True
        self.is_settled = False  # right ones change nothing

    @property
    def is_good(self) -> bool:
        return self._missing == 0

    def add(self, right: bool) -> None:
        if right:
            self.wrong = 0
            self._missing = max(0, self._missing - 1)
        else:
            self.wrong += 1
            if self.wrong >= MAX_WRONG:
                self._needed = MIN_RIGHT
            if self.wrong >= MAX_WRONG or self._missing or self._is_new:
                self._missing = self._needed
        self._is_new = False
        self.is_settled = right and self.is_good
