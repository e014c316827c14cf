"""What can happen to messages between a sensor and the service, as functions from stream to stream.

A stream is messages in the order in which they arrive, stamped with when. A fault takes a stream
and a source of randomness; faults compose. None of them changes the messages it is given.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import dataclass, field

import can

Stream = Iterable[can.Message]
Operator = Callable[[Stream, "Injected"], Iterator[can.Message]]


@dataclass
class Injected:
    """How often a fault has struck, and its dice."""

    dice: random.Random = field(default_factory=lambda: random.Random(0))
    count: int = 0

    def strikes(self, share: float) -> bool:
        """True for that share of all times that it is asked."""
        struck = self.dice.random() < share
        self.count += struck
        return struck


def composed(*operators: Operator) -> Operator:
    """One after the other."""

    def all_of_them(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for operator in operators:
            stream = operator(stream, injected)
        yield from stream

    return all_of_them


def drop(share: float) -> Operator:
    """Single messages are lost."""
    return lambda stream, injected: (m for m in stream if not injected.strikes(share))


def burst(share: float, length: int) -> Operator:
    """Runs of messages are lost."""

    def lose(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        left = 0
        for message in stream:
            if left == 0 and injected.dice.random() < share / length:
                left = length
            if left:
                left -= 1
                injected.count += 1
            else:
                yield message

    return lose


def duplicate(share: float) -> Operator:
    """Messages come twice."""

    def repeat(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for message in stream:
            yield message
            if injected.strikes(share):
                yield copy(message)

    return repeat


def reorder(share: float, by: int = 5) -> Operator:
    """Messages are overtaken by up to `by` others; arrival times stay in order."""

    def shuffle(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        waiting: list[tuple[int, int, can.Message]] = []
        number = 0
        for number, message in enumerate(stream):
            behind = injected.dice.randint(1, by) if injected.strikes(share) else 0
            heapq.heappush(waiting, (number + behind, number, message))
            while waiting and waiting[0][0] <= number:
                yield _at(heapq.heappop(waiting)[2], message.timestamp)
        for _, _, message in sorted(waiting):
            yield _at(message, max(message.timestamp, 0.0))

    return shuffle


def delay(share: float, up_to_s: float) -> Operator:
    """Messages come late, and after what was sent later."""

    def hold(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        held: list[tuple[float, int, can.Message]] = []
        for number, message in enumerate(stream):
            while held and held[0][0] <= message.timestamp:
                yield heapq.heappop(held)[2]
            if injected.strikes(share):
                due_s = message.timestamp + injected.dice.uniform(0.0, up_to_s)
                heapq.heappush(held, (due_s, number, _at(message, due_s)))
            else:
                yield message
        while held:
            yield heapq.heappop(held)[2]

    return hold


def corrupt(share: float, bits: int = 1) -> Operator:
    """Bits of the payload are flipped."""

    def flip(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for message in stream:
            if message.data and injected.strikes(share):
                data = bytearray(message.data)
                for _ in range(bits):
                    data[injected.dice.randrange(len(data))] ^= 1 << injected.dice.randrange(8)
                yield _with(message, data)
            else:
                yield message

    return flip


def truncate(share: float) -> Operator:
    """Messages are shorter than they should be, down to nothing."""

    def cut(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for message in stream:
            if message.data and injected.strikes(share):
                yield _with(message, message.data[: injected.dice.randrange(len(message.data))])
            else:
                yield message

    return cut


def extreme(share: float) -> Operator:
    """Signals say `not available`, or their largest or smallest value: all bits are alike."""

    def fill(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for message in stream:
            if message.data and injected.strikes(share):
                yield _with(
                    message, bytearray([injected.dice.choice((0, 255))] * len(message.data))
                )
            else:
                yield message

    return fill


def flood(per_message: int, ids: list[int]) -> Operator:
    """Between any two messages others of the same ids, with random bytes, lengths and kinds."""

    def babble(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for message in stream:
            yield message
            for _ in range(per_message):
                injected.count += 1
                yield random_message(injected.dice, ids, message.timestamp)

    return babble


def jump_clock(at: int, by_s: float) -> Operator:
    """The clock that stamps the messages is set, once, at message number `at`."""

    def jump(stream: Stream, injected: Injected) -> Iterator[can.Message]:
        for number, message in enumerate(stream):
            injected.count += number == at
            yield _at(message, message.timestamp + (by_s if number >= at else 0.0))

    return jump


def nothing(stream: Stream, injected: Injected) -> Iterator[can.Message]:  # noqa: ARG001
    """All is well."""
    yield from stream


def random_message(dice: random.Random, ids: list[int], timestamp_s: float) -> can.Message:
    """One of these ids, and otherwise anything that can be on a bus."""
    is_fd = dice.random() < 0.1
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=dice.choice(ids),
        is_extended_id=dice.random() < 0.1,
        is_remote_frame=not is_fd and dice.random() < 0.1,
        is_error_frame=not is_fd and dice.random() < 0.1,
        is_fd=is_fd,
        data=dice.randbytes(dice.randrange(65 if is_fd else 9)),
        check=False,
    )


def moved(stream: Stream, by_s: float) -> Iterator[can.Message]:
    """The same, later."""
    return (_at(message, message.timestamp + by_s) for message in stream)


def endless(stream: list[can.Message], period_s: float) -> Iterator[can.Message]:
    """Over and over again."""
    for turn in itertools.count():
        yield from moved(stream, turn * period_s)


def _at(message: can.Message, timestamp_s: float) -> can.Message:
    changed = copy(message)
    changed.timestamp = timestamp_s
    return changed


def _with(message: can.Message, data: bytes | bytearray) -> can.Message:
    changed = copy(message)
    changed.data = bytearray(data)
    changed.dlc = len(data)
    return changed
