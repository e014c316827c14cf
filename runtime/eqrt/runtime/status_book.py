"""What happens while serving, counted and noted until it is time to say so."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Protocol

import numpy as np

from eqrt.runtime.bus.health import BusHealth
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.status import BusStatus, ServiceStatus, SourceStatus
from eqrt.runtime.pipeline import Pipeline, PipelineCounters
from eqrt.runtime.tracking.ego import EgoCounters
from eqrt.runtime.tracking.tracks import TrackCounters


class Counting(Protocol):
    """Something with counters of its own."""

    def counts(self) -> dict[str, int]:
        """Since the start, by name."""


class Channels(Counting, Protocol):
    """The buses that are read."""

    def health(self) -> Sequence[BusHealth]:
        """One for each."""


class StatusBook:
    """One period of the service after the other."""

    def __init__(
        self, pipeline: Pipeline, channels: Channels, publishers: Sequence[Counting]
    ) -> None:
        self._pipeline = pipeline
        self._channels = channels
        self._counting = [channels, *publishers]
        self._version = importlib.metadata.version("eqrt")
        self._started_s = self._mode_since_s = self._begun_s = time.monotonic()
        self._mode = Mode.SILENT
        self._objects = 0
        self._ego_known = False
        self._messages = 0
        self._latencies_s: list[float] = []

    def received(self) -> None:
        """A message came."""
        self._messages += 1

    def published(self, forecast: ForecastSet) -> None:
        """A cycle has been sent."""
        now_s = time.monotonic()
        if forecast.mode != self._mode:
            self._mode, self._mode_since_s = forecast.mode, now_s
        self._objects = forecast.num_targets
        self._ego_known = forecast.map_from_ego is not None
        if forecast.num_targets:
            self._latencies_s.append(now_s - forecast.received_s)

    def close(self, now_s: float) -> ServiceStatus:
        """What the period was; the next one begins at `now_s` (monotonic clock)."""
        pipeline = self._pipeline
        predictor, tile = pipeline.predictor, pipeline.tile
        status = ServiceStatus(
            time_s=now_s,
            uptime_s=now_s - self._started_s,
            seconds=now_s - self._begun_s,
            eqrt=self._version,
            profile=pipeline.profile.name,
            model=predictor.contract.name,
            model_id=predictor.model_id,
            tile=str(tile.path.absolute()) if tile else "",
            tile_id=tile.info.tile_id if tile else "",
            mode=self._mode,
            mode_s=now_s - self._mode_since_s,
            objects=self._objects,
            messages=self._messages,
            latencies_s=self._latencies_s,
            stages_s={name.removesuffix("_s"): s for name, s in asdict(pipeline.times).items()},
            totals=self._totals(),
            ego_known=self._ego_known,
            buses=[_bus(one, now_s) for one in self._channels.health()],
            sources=self._sources(now_s),
        )
        self._begun_s, self._messages, self._latencies_s = now_s, 0, []
        return status

    def _totals(self) -> dict[str, int]:
        pipeline = self._pipeline
        parts: dict[str, DecoderCounters | EgoCounters | TrackCounters | PipelineCounters] = {
            "decoder": pipeline.decoder.counters,
            "ego": pipeline.ego.counters,
            "tracks": pipeline.tracks.counters,
            "pipeline": pipeline.counters,
        }
        totals: dict[str, int] = {}
        for part, counters in parts.items():
            totals |= {f"{part}_{name}": count for name, count in asdict(counters).items()}
        for one in self._counting:
            totals |= one.counts()
        return totals

    def _sources(self, now_s: float) -> list[SourceStatus]:
        return [
            SourceStatus(
                name=one.name,
                valid=one.valid,
                reason=one.reason,
                since_s=now_s - (self._started_s if one.since_s is None else one.since_s),
            )
            for one in self._pipeline.decoder.sources
        ]


def _bus(health: BusHealth, now_s: float) -> BusStatus:
    return BusStatus(
        channel=health.channel,
        state=health.state.name,
        since_s=now_s - health.since_s,
        reason=health.reason,
        losses=health.losses,
        overflow=health.dropped or 0,
        error_frames=health.error_frames,
    )


def status_line(status: ServiceStatus) -> str:
    """One line for the terminal."""
    messages = status.messages / status.seconds
    if not status.totals["pipeline_cycles"]:
        return f"no object cycle ({messages:.0f} messages/s)"
    rate_hz = len(status.latencies_s) / status.seconds
    name = Mode(status.mode).name
    text = f"{name:<8} {status.objects:3d} objects {rate_hz:5.1f} predictions/s"
    if status.latencies_s:
        middle, worst = 1e3 * np.median(status.latencies_s), 1e3 * max(status.latencies_s)
        text += f"  latency {middle:5.1f} ms (worst {worst:5.1f})"
    return f"{text}  {messages:5.0f} messages/s"
