"""`eqrt serve --record`: what the pipeline was told, and what came of it, on its way to a file.

Everything that decides the predictions is kept: each message with the pipeline's time, each moment
at which it was asked without one, and what its clock said while it computed. A replay of that makes
the same predictions bit for bit. A process of its own writes (`writer`); this side fills a pipe,
and what does not fit for want of a quick disk is dropped, counted, and noted in the recording.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from typing import Self

import can
import msgspec

from eqrt.core.errors import RecordingError
from eqrt.runtime.operation.outlet import Outlet
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.recording.exact_forecasts import encode_forecasts
from eqrt.runtime.recording.order import SAID_WHY, Description, Order
from eqrt.runtime.recording.pipe import MAX_WAITING_BYTES, PipeEnd
from eqrt.runtime.recording.runs import RunTape
from eqrt.runtime.recording.steps import Lost, PollEntry, TapedClock, can_entry
from eqrt.runtime.recording.topics import DESCRIPTION, ENTRY, LENGTH, Topic

END_S = 3.0
"""How long the end of the service may wait for the disk, in all: the TimeoutStopSec of
deploy/eqrt.service has to do for everything else as well."""
_BATCH_S = 0.1  # what a killed service takes with it
_BATCH_BYTES = 1 << 16
_MSGPACK = msgspec.msgpack.Encoder()
_JSON = msgspec.json.Encoder()


class Recorder:
    """The service's side of a recording: a witness of its steps, a publisher, an observer."""

    def __init__(
        self,
        order: Order,
        clock: TapedClock,
        runs: RunTape,
        max_waiting_bytes: int = MAX_WAITING_BYTES,
    ) -> None:
        """`clock`: the pipeline's; `runs`: that of what runs its model.

        Raises RecordingError if the writer cannot be started.
        """
        self._clock = clock
        self._runs = runs
        self.description = order.description
        """What the coming steps are of."""
        self._described = b""
        self._batch: list[bytes] = []
        self._batch_bytes = 0
        self._in_batch = dict.fromkeys(Topic, 0)
        self._lost = dict.fromkeys(Topic, 0)
        self._due_s = time.monotonic() + _BATCH_S
        self._sent_bytes = 0
        self._dropped = 0
        self._is_said = False
        self._writer, self._pipe = _started(max_waiting_bytes)
        self._offer(_MSGPACK.encode(order))

    @property
    def writer_pid(self) -> int:
        """The process that writes."""
        return self._writer.pid

    # --- a witness of every step

    def begin(self, message: can.Message | None, now_s: float) -> None:
        """The pipeline is about to be told this."""
        if message is None:
            self._put(Topic.POLL, _MSGPACK.encode(PollEntry(now_s)))
        else:
            entry = _MSGPACK.encode(can_entry(message, now_s))
            self._put(Topic.CAN, entry, _nanoseconds(message.timestamp))

    def end(self) -> None:
        """It has been told, and what it made of it is published."""
        self._put_clock()
        if outcomes := self._runs.take():
            self._put(Topic.RUNS, _MSGPACK.encode(outcomes))
        if (
            self._in_batch[Topic.FORECASTS]  # the writer works while the service has least to do
            or self._batch_bytes >= _BATCH_BYTES
            or time.monotonic() >= self._due_s
        ):
            self.flush()

    def describe(self, description: Description) -> None:
        """From the next step on, it is this that predicts: model or tile were exchanged."""
        self.flush()
        self.description = description
        self._described = bytes([DESCRIPTION]) + _MSGPACK.encode(description)

    # --- a publisher and observer

    def publish(self, forecast: ForecastSet) -> None:
        """Note one cycle's predictions."""
        self._put_clock()
        self._put(Topic.FORECASTS, encode_forecasts(forecast))

    def report(self, status: ServiceStatus) -> None:
        """Note the service's own state."""
        self._put(Topic.STATUS, _JSON.encode(status))

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""
        return {
            "recording_bytes": self._sent_bytes,
            "recording_dropped": self._dropped,
            "recording_ended": int(not self._pipe.is_open),
        }

    def flush(self) -> None:
        """Send what has gathered, if there is room for it."""
        self._due_s = time.monotonic() + _BATCH_S
        self._pipe.push()
        if not self._pipe.is_open:
            self._say_if_unexplained()
        if not self._batch:
            return
        batch, size = self._batch, self._batch_bytes
        self._batch, self._batch_bytes = [], 0
        lost = self._lost_entry()
        if self._is_described() and self._offer(b"".join([lost, *batch])):
            self._sent_bytes += size
            self._lost = dict.fromkeys(Topic, 0)
        else:
            self._lost = {topic: n + self._in_batch[topic] for topic, n in self._lost.items()}
            self._dropped += sum(self._in_batch.values())
        self._in_batch = dict.fromkeys(Topic, 0)

    def close(self) -> None:
        """Send the rest and wait for the writer, END_S in all; leaving `with` does it too.

        A writer that takes longer ends by itself when it has written what it was sent.
        """
        give_up_s = time.monotonic() + END_S
        self.flush()
        if any(self._lost.values()):  # it is noted, too, if there is room before the end
            self._pipe.drain(give_up_s)
            self._offer(self._lost_entry())
        self._pipe.close(give_up_s)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._writer.wait(max(give_up_s - time.monotonic(), 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---

    def _say_if_unexplained(self) -> None:
        """Once; of a writer that has not said why it ended."""
        code = self._writer.poll()
        if code in (None, SAID_WHY) or self._is_said:
            return
        self._is_said = True
        how = f"was killed ({signal.Signals(-code).name})" if code < 0 else "could not go on"
        Outlet(sys.stderr).put(f"eqrt serve: recording ended: its writer {how}; predictions go on")

    def _is_described(self) -> bool:
        """Whether the writer knows what the coming entries are of: nothing is sent before."""
        if self._described and self._pipe.is_open and self._offer(self._described):
            self._described = b""
        return self._pipe.is_open and not self._described

    def _put_clock(self) -> None:
        if said_s := self._clock.take():
            self._put(Topic.CLOCK, _MSGPACK.encode(said_s))

    def _put(self, topic: Topic, payload: bytes, published_ns: int | None = None) -> None:
        now_ns = time.time_ns()
        head = _entry_head(topic, now_ns, published_ns, payload)
        self._batch += (head, payload)
        self._batch_bytes += len(head) + len(payload)
        self._in_batch[topic] += 1

    def _lost_entry(self) -> bytes:
        """What is missing before this batch, as an entry; empty if nothing is."""
        if not any(self._lost.values()):
            return b""
        payload = _JSON.encode(
            Lost(
                steps=self._lost[Topic.CAN] + self._lost[Topic.POLL],
                forecasts=self._lost[Topic.FORECASTS],
                statuses=self._lost[Topic.STATUS],
            )
        )
        return _entry_head(Topic.LOST, time.time_ns(), None, payload) + payload

    def _offer(self, piece: bytes) -> bool:
        return self._pipe.offer(LENGTH.pack(len(piece)) + piece)


def _entry_head(topic: Topic, now_ns: int, published_ns: int | None, payload: bytes) -> bytes:
    return ENTRY.pack(topic, now_ns, now_ns if published_ns is None else published_ns, len(payload))


def _nanoseconds(stamp_s: float) -> int:
    """A driver's stamp as MCAP wants it; whatever it is, `CanEntry` has it exactly."""
    return min(max(int(stamp_s * 1e9), 0), (1 << 63) - 1)


def _started(max_waiting_bytes: int) -> tuple[subprocess.Popen[bytes], PipeEnd]:
    reading, writing = os.pipe()
    command = [sys.executable, "-m", "eqrt.runtime.recording.writer"]
    try:
        writer = subprocess.Popen(command, stdin=reading, stdout=subprocess.DEVNULL)
    except OSError as error:
        os.close(writing)
        raise RecordingError(
            f"cannot start the recording's writer ({error.strerror}); leave --record out"
        ) from error
    finally:
        os.close(reading)
    return writer, PipeEnd(writing, max_waiting_bytes)
