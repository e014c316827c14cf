"""One channel that is opened again whenever it was lost."""

from __future__ import annotations

import contextlib
import errno
import math
import selectors
import threading
import time
from collections.abc import Callable

import can

from eqrt.core.errors import AbsentBusError, in_one_line
from eqrt.runtime.bus.health import LOST, BusHealth, BusState, BusWord, told_overrun, told_state
from eqrt.runtime.bus.links import Link
from eqrt.runtime.bus.outbox import Outbox

FIRST_RETRY_S = 0.1
LONGEST_RETRY_S = 1.0
"""Between attempts to open a channel; also how long one must have been up to start over."""
_LOOK_S = 0.01  # how often an attempt is asked whether it is over
_MOST_LEFT = 100_000  # messages; more than any receive queue holds
_REASONS = {
    BusState.ERROR_PASSIVE: "many errors on the bus",
    BusState.BUS_OFF: "bus-off, which is too many errors; the controller stays so until it is "
    "restarted, which it does by itself after: ip link set {} type can restart-ms 100",
}


class Connection:
    """A channel to read from and send on; being lost is a state, not an error."""

    def __init__(
        self,
        channel: str,
        open_link: Callable[[], Link],
        selector: selectors.BaseSelector,
        say: Callable[[BusWord], None],
    ) -> None:
        """Registers with the selector while open, as data of its key. Call `open` next."""
        self.channel = channel
        self.outbox = Outbox(self)
        """Sends what is put there, by and by, while somebody waits for messages."""
        self._open_link = open_link
        self._selector = selector
        self._say = say
        self._link: Link | None = None
        self._fileno = -1
        self._attempt: _Attempt | None = None
        self._due_s, self._delay_s = math.inf, FIRST_RETRY_S
        self._state, self._since_s, self._reason = BusState.DOWN, time.monotonic(), ""
        self._protocol = can.CanProtocol.CAN_20
        self._opened_s = -math.inf
        self._lost_s: float | None = None
        self._losses = self._reconnects = self._bus_offs = 0
        self._error_frames = self._overruns = 0
        self._dropped: int | None = None

    def open(self, *, wait: bool) -> None:
        """Open it now. `wait`: a channel that is not there is tried again, and is no error.

        Raises BusError.
        """
        try:
            self._take(self._open_link())
        except AbsentBusError as error:
            if not wait:
                raise
            self._tell(f"waiting for {self.channel}: {error}")
            self._lost_s, self._reason = self._since_s, f"{error}"
            self._try_later()

    def _take(self, link: Link) -> None:
        self._fileno = link.fileno()
        self._selector.register(self._fileno, selectors.EVENT_READ, self)
        self._link, self._due_s, self._opened_s = link, math.inf, time.monotonic()
        self._protocol = link.protocol
        self._enter(BusState.UP)

    def try_again(self, now_s: float) -> float:
        """Go on with opening, or with sending, without waiting; seconds until this wants a call."""
        if self._link is not None:
            return self.outbox.push(now_s)
        if self._attempt is None:
            if not now_s >= self._due_s:
                return self._due_s - now_s
            self._attempt = _Attempt(self._open_link)
        if not self._attempt.is_over():
            return _LOOK_S
        attempt, self._attempt = self._attempt, None
        if attempt.link is None:
            self._reason = attempt.error
            self._try_later()
            return self._due_s - now_s
        self._reconnects += 1
        self._take(attempt.link)
        return math.inf

    def _try_later(self) -> None:
        self._due_s = time.monotonic() + self._delay_s
        self._delay_s = min(2.0 * self._delay_s, LONGEST_RETRY_S)

    def read(self) -> list[can.Message]:
        """What has come, without error frames, which are counted; empty if nothing has."""
        if self._link is None:
            return []
        try:
            messages = self._link.read()
        except (can.CanError, OSError) as error:
            return self._lose(error)
        return self._sifted(messages)

    def _sifted(self, messages: list[can.Message]) -> list[can.Message]:
        if any(message.is_error_frame for message in messages):
            return [message for message in messages if not self._is_error(message)]
        if self._state is BusState.BUS_OFF and messages:
            self._enter(BusState.UP)  # some drivers do not tell of a restart
        return messages

    def _is_error(self, message: can.Message) -> bool:
        if not message.is_error_frame:
            return False
        self._error_frames += 1
        self._overruns += told_overrun(message)
        if (state := told_state(message)) is not None and state is not self._state:
            self._bus_offs += state is BusState.BUS_OFF
            self._enter(state, _REASONS.get(state, "").format(self.channel))
        return True

    def _lose(self, error: Exception) -> list[can.Message]:
        """Close the channel, but give what had come before."""
        rest: list[can.Message] = []
        with contextlib.suppress(can.CanError, OSError):
            while (messages := self._link_read()) and len(rest) < _MOST_LEFT:
                rest += messages
        rest = self._sifted(rest)
        if time.monotonic() - self._opened_s >= LONGEST_RETRY_S:
            self._delay_s = FIRST_RETRY_S
        self._losses += 1
        self._close()
        self._enter(BusState.DOWN, _words(error))
        self._try_later()
        return rest

    def _link_read(self) -> list[can.Message]:
        return [] if self._link is None else self._link.read()

    def send(self, msg: can.Message) -> None:
        """Hand a message to the driver; OSError or can.CanError if it fails, or there is none."""
        if self._link is None:
            raise can.CanOperationError(f"{self.channel} is down", errno.ENETDOWN)
        self._link.send(msg)

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether it carries CAN FD, as far as is known."""
        return self._protocol

    def health(self) -> BusHealth:
        """How it is now."""
        return BusHealth(
            channel=self.channel,
            state=self._state,
            since_s=self._since_s,
            reason=self._reason,
            losses=self._losses,
            reconnects=self._reconnects,
            bus_offs=self._bus_offs,
            error_frames=self._error_frames,
            dropped=self._all_dropped(),
            overruns=self._overruns,
        )

    def _all_dropped(self) -> int | None:
        """Of this link and those before."""
        dropped = None if self._link is None else self._link.drops()
        return self._dropped if dropped is None else dropped + (self._dropped or 0)

    def _enter(self, state: BusState, reason: str = "") -> None:
        """Change the state, and say so when the channel is lost or back."""
        now_s = time.monotonic()
        self._state, self._since_s, self._reason = state, now_s, reason
        if state in LOST and self._lost_s is None:
            self._lost_s = now_s
            self._tell(f"{self.channel} is lost: {reason}")
        elif state not in LOST and self._lost_s is not None:
            back = "back" if self._losses or self._bus_offs else "there"
            self._tell(f"{self.channel} is {back} after {now_s - self._lost_s:.1f} s")
            self._lost_s = None

    def _tell(self, text: str) -> None:
        self._say(BusWord(channel=self.channel, state=self._state, text=text))

    def _close(self) -> None:
        if self._link is not None:
            self._dropped = self._all_dropped()
            self._selector.unregister(self._fileno)
            self._link.shutdown()
            self._link = None

    def shutdown(self) -> None:
        """Close it for good."""
        self._close()
        self._due_s = math.inf


class _Attempt:
    """Opening a channel in a thread: a driver may take its time."""

    def __init__(self, open_link: Callable[[], Link]) -> None:
        self.link: Link | None = None
        self.error = ""
        self._open_link = open_link
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.link = self._open_link()
        except Exception as error:  # whatever it is, the next attempt may go better
            self.error = _words(error)

    def is_over(self) -> bool:
        return not self._thread.is_alive()


def _words(error: Exception) -> str:
    """An exception in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return in_one_line(error)
