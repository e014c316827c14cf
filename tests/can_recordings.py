"""Recorded CAN logs through the decoder, and what their publishers decoded from them."""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder, Event
from eqrt.runtime.decoding.detections import Detections

DATA = Path(__file__).parent / "data" / "can"


@cache
def messages_of(recording: str) -> tuple[can.Message, ...]:
    """All messages of ars408, rav4 or srr520."""
    return tuple(read_log(DATA / recording / "candump.log.gz"))


def feed_all(decoder: Decoder, messages: Iterable[can.Message]) -> list[Event]:
    """What the messages complete, at the times at which they were recorded."""
    events: list[Event] = []
    for message in messages:
        events += decoder.poll(message.timestamp)
        events += decoder.feed(message, message.timestamp)
    return events


def detections_of(events: list[Event]) -> list[Detections]:
    """The cycles among the events."""
    return [event for event in events if isinstance(event, Detections)]


def rav4_array(name: str) -> NDArray[np.float64]:
    """An array of the RAV4 recording, for example `radar_value`."""
    with gzip.open(DATA / "rav4" / f"{name}.npy.gz") as stream:
        values: NDArray[np.float64] = np.load(stream)
    return values


def srr520_objects() -> list[dict[str, float]]:
    """The objects of the SRR520 cycle as its publisher decoded them."""
    text = gzip.decompress((DATA / "srr520" / "objects.yaml.gz").read_bytes()).decode()
    objects = text.partition("objects:")[2].split("\n  - ")[1:]
    return [
        {key: float(value) for key, value in re.findall(r"(\w+): (\S+)", item)} for item in objects
    ]
