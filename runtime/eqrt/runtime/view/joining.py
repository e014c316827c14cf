"""Datagrams to whole cycles: the parts of a cycle put together, and what was missed, counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from eqrt.runtime.output.datagrams import Datagram
from eqrt.runtime.output.forecasts import ForecastSet


class Joiner:
    """Takes datagrams in the order in which they come."""

    def __init__(self) -> None:
        self._parts: dict[int, Datagram] = {}
        self._waits_for: tuple[object, ...] = ()
        self._cycle = -1
        self.lost_cycles = 0
        """Cycles of which nothing, or not everything, came."""

    def begin_anew(self) -> None:
        """Another service is heard from now on: what it has sent before is not lost."""
        self._cycle = -1

    def add(self, datagram: Datagram) -> ForecastSet | None:
        """The whole cycle, if this was its last part."""
        cycle, whole = datagram.forecasts.cycle, _whole(datagram)
        if self._parts and (whole != self._waits_for or datagram.part in self._parts):
            self.lost_cycles += 1
            self._parts = {}
        if not self._parts and self._cycle >= 0:  # a service that started again counts from 0
            self.lost_cycles += max(0, cycle - self._cycle - 1)
        self._cycle, self._waits_for = cycle, whole
        self._parts[datagram.part] = datagram
        if len(self._parts) < datagram.parts:
            return None
        parts, self._parts = self._parts, {}
        return joined([parts[number].forecasts for number in sorted(parts)])


def _whole(datagram: Datagram) -> tuple[object, ...]:
    """What the parts of one cycle have in common. The count alone does not tell: a service that
    starts again counts from 0.
    """
    said = datagram.forecasts
    sizes = (said.history.shape[1:], said.trajectories.shape[1:], said.covariances is None)
    return (said.cycle, said.made_s, said.model_id, datagram.parts, sizes)


def joined(parts: Sequence[ForecastSet]) -> ForecastSet:
    """One cycle from some of its targets each."""
    if len(parts) == 1:
        return parts[0]
    arrays: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(ForecastSet)
        if isinstance(getattr(parts[0], field.name), np.ndarray)
    }
    return replace(parts[0], **arrays)
