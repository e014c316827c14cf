"""Signals as questions that a loop asks: to end cleanly, and to load its files anew.

A handler interrupts the loop anywhere, even within an answer or another handler. So it notes the
signal in a list and takes no lock: whoever holds that would be waited for by what interrupted it.
"""

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


@contextlib.contextmanager
def asked_to_reload() -> Iterator[Callable[[], bool]]:
    """Gives `is_asked()`, true once after one or more SIGHUP; never where there is no such signal.

    Only in the main thread; the handler is put back at the end.
    """
    asked: list[int] = []

    def is_asked() -> bool:
        if not asked:
            return False
        asked.clear()
        return True

    def ask(number: int, _frame: FrameType | None) -> None:
        asked.append(number)

    number = getattr(signal, "SIGHUP", None)
    if number is None:
        yield is_asked
        return
    before = signal.signal(number, ask)
    try:
        yield is_asked
    finally:
        signal.signal(number, before)
