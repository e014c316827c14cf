"""Ctrl-C and SIGTERM as a question that a loop asks, so that it can end cleanly."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def until_told_to_stop() -> Iterator[Callable[[], bool]]:
    """Gives `should_stop()`, which turns true with the first signal; a second one kills.

    Only in the main thread, like everything about signals; the handlers are put back at the end.
    """
    told: list[int] = []

    def tell(number: int, _frame: FrameType | None) -> None:
        told.append(number)
        signal.signal(number, signal.SIG_DFL)

    before = {number: signal.signal(number, tell) for number in _SIGNALS}
    try:
        yield lambda: bool(told)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
