"""What the service says about itself, once a second: to viewers, recorders, metrics and the log."""

from __future__ import annotations

import msgspec


class BusStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A CAN channel."""

    channel: str
    state: str
    """Name of a `BusState`: UP, ERROR_PASSIVE, BUS_OFF or DOWN."""
    since_s: float
    """How long it has been so."""
    reason: str = ""
    """Why it is not up."""
    losses: int = 0
    """Times that it went down or away."""
    overflow: int = 0
    """Messages that found the kernel's receive queue full."""
    error_frames: int = 0


class SourceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A sensor, or a source of the ego vehicle's motion."""

    name: str
    valid: bool
    reason: str
    """Why it is not; empty if it is."""
    since_s: float
    """How long it has been so."""


class ServiceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The service, and what happened since it spoke last."""

    time_s: float
    """On the service's monotonic clock."""
    uptime_s: float
    seconds: float
    """The period that this speaks of."""
    eqrt: str
    """Version of the program."""
    profile: str
    model: str
    model_id: str
    tile: str
    """The tile's file, absolute; empty = none."""
    tile_id: str
    mode: int
    """`Mode` of the newest cycle; SILENT before the first."""
    mode_s: float
    """How long the cycles have had it."""
    objects: int
    """Targets of the newest cycle."""
    messages: int
    """In this period."""
    latencies_s: list[float]
    """In this period, of every cycle with targets: from the arrival of its last message until its
    predictions had been sent.
    """
    stages_s: dict[str, float]
    """Of the newest cycle: tracks, scene, infer, guard."""
    totals: dict[str, int]
    """Counts since the start, by name: docs/output.md."""
    ego_known: bool = True
    """How the ego vehicle moves was known for the newest cycle: without, nothing is predicted.
    False in SILENT.
    """
    buses: list[BusStatus] = []
    sources: list[SourceStatus] = []
