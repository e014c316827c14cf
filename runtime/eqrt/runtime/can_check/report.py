"""What a check found, as data: `--json` writes it as it stands here.

Lengths in metres, angles in degrees, times in seconds, in the frames of the profile; None where
something is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

SCHEMA = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Rhythm:
    """How regularly something comes."""

    count: int
    per_second: float
    median_period_s: float | None
    worst_gap_s: float | None
    worst_gap_at_s: float | None
    """When it began, from the beginning of the log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileMessage:
    """A message that the profile names."""

    id: str
    name: str
    used_by: str
    """Names of the sensors that read it; ego."""
    optional: bool
    channels: tuple[str, ...]
    rhythm: Rhythm
    short: int
    bad_checksum: int
    bad_counter: int


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownMessage:
    """A message that the profile does not name."""

    id: str
    channels: tuple[str, ...]
    rhythm: Rhythm


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One bus of the log."""

    name: str
    known: int
    """Messages that the profile names."""
    unknown: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Values:
    """How one decoded quantity is distributed."""

    name: str
    unit: str
    count: int
    missing: float
    """Share that is not known."""
    low: float | None
    p5: float | None
    median: float | None
    p95: float | None
    high: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """Does what the sensor says about motion fit the change of its own positions?"""

    what: str
    pairs: int
    """Pairs of measurements of one object, about half a second apart."""
    spread: float
    """Standard deviation of what the sensor says, m/s (of the yaw rate deg/s)."""
    correlation: float | None
    slope: float | None
    """Change of position for each m/s that the sensor says: 1 where all is right."""
    residual: float | None
    """Median difference between the two, in the same unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """What one sensor says."""

    name: str
    velocity: str
    """The kind, as the profile has it."""
    mount: str
    """Where the profile says that it sits, seen from the car's reference point."""
    cycles: Rhythm
    incomplete: int
    objects: int
    objects_per_cycle: tuple[float, ...]
    """Least, median, most; empty if there is no cycle."""
    ids: int
    """Different ones."""
    values: tuple[Values, ...]
    classes: dict[str, int]
    fits: tuple[Fit, ...]
    jumps: float
    """Share of steps from one cycle to the next that no vehicle can make."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ego:
    """What is said about the ego vehicle."""

    speed: Rhythm
    yaw_rate: Rhythm
    poses: Rhythm
    values: tuple[Values, ...]
    fits: tuple[Fit, ...]
    """Speed and yaw rate against the change of the poses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that looks wrong, in plain words."""

    about: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """All of it."""

    schema: int
    log: str
    profile: str
    messages: int
    seconds: float
    decoded: bool
    """Whether anything was decoded at all."""
    counters: dict[str, int]
    channels: tuple[Channel, ...]
    profile_messages: tuple[ProfileMessage, ...]
    unknown: tuple[UnknownMessage, ...]
    """The ten that come most often."""
    unknown_rest: tuple[int, int]
    """How many more ids, and how many messages they are."""
    sensors: tuple[Sensor, ...]
    ego: Ego
    findings: tuple[Finding, ...]
