"""A profile: how the messages of one setup of sensors and car become detections and ego motion.

A profile is a TOML file plus the DBCs it names; docs/profiles.md has every key. The code knows no
sensor by name: what is loaded here is all it goes by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from eqrt.core.errors import ProfileError
from eqrt.core.files import may_be_file
from eqrt.runtime.decoding import dbc_files, toml_tables
from eqrt.runtime.decoding.dbc_files import Dbc, load_dbc, parse_dbc
from eqrt.runtime.decoding.ego_profile import EgoProfile, bind_ego
from eqrt.runtime.decoding.latency_checks import check_latencies
from eqrt.runtime.decoding.profile_schema import ProfileTable
from eqrt.runtime.decoding.sensor_binding import bind_sensor
from eqrt.runtime.decoding.sensor_profile import SensorProfile
from eqrt.runtime.decoding.toml_tables import parse_toml, read_toml

_HERE = Path(__file__).parent
_MAX_BIAS_DEG_S = 10.0
_PROFILES, _DBCS = _HERE / "profiles", _HERE / "dbc"


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """How the messages on the buses become detections and ego motion."""

    name: str
    description: str
    sensors: tuple[SensorProfile, ...]
    ego: tuple[EgoProfile, ...]
    yaw_rate_bias_rad_s: float
    """Where the estimate of the yaw rate's bias starts: measured minus true."""

    @property
    def has_ego(self) -> bool:
        """Whether anything tells the ego vehicle's motion or pose."""
        return bool(self.ego)

    def gives(self, what: str) -> bool:
        """Whether a message tells that of the ego vehicle: a key of `[ego.fields]`, or `pose`."""
        keys = {"x", "latitude"} if what == "pose" else {what}
        return any(keys & set(ego.numbers) for ego in self.ego)

    @property
    def arbitration_ids(self) -> frozenset[int]:
        """Every id that the profile means, on any bus."""
        return frozenset(arbitration_id for arbitration_id, _ in self.ids)

    @property
    def ids(self) -> frozenset[tuple[int, bool]]:
        """The same, and whether each is an extended one."""
        return self.ids_on(self.roles)

    def ids_on(self, buses: Collection[str]) -> frozenset[tuple[int, bool]]:
        """Those of some of its buses, by their roles."""
        addresses = [part.address for ego in self.ego if ego.bus in buses for part in ego.parts]
        for sensor in (sensor for sensor in self.sensors if sensor.bus in buses):
            addresses += [address for part in sensor.parts for address in part.addresses]
            addresses += [sensor.header.address] if sensor.header else []
        return frozenset((address.arbitration_id, address.is_extended) for address in addresses)

    @property
    def roles(self) -> tuple[str, ...]:
        """The buses that the profile speaks of, in the order in which it does."""
        return tuple(dict.fromkeys([x.bus for x in self.sensors] + [x.bus for x in self.ego]))

    def sensor(self, name: str) -> SensorProfile:
        """The sensor that `Detections.sensor` names."""
        return next(sensor for sensor in self.sensors if sensor.name == name)


def builtin_profiles() -> list[str]:
    """Names that `load_profile` knows without a path."""
    return sorted(path.stem for path in _PROFILES.glob("*.toml"))


def load_profile(name_or_path: str) -> Profile:
    """A built-in profile by its name, or the one in a file.

    Raises ProfileError, one line that names file and key, if it or its DBCs cannot be used.
    """
    path = _path(name_or_path)
    table = read_toml(path, ProfileTable)
    return _profile(table, path, lambda name: load_dbc(_dbc_path(name, path)))


def parse_profile(files: Mapping[str, bytes], name: str) -> Profile:
    """The profile of that name from files as `profile_files` gives them; no other is looked at,
    whatever it names.

    Raises ProfileError as `load_profile` does, and if one of them is not there.
    """
    path = f"{name}.toml"
    table = parse_toml(_among(files, path, toml_tables.MAX_BYTES), ProfileTable, path)
    return _profile(
        table,
        Path(path),
        lambda dbc: parse_dbc(_among(files, dbc, dbc_files.MAX_BYTES), Path(dbc)),
    )


def profile_files(name_or_path: str) -> dict[str, bytes]:
    """What `load_profile` reads, for `parse_profile`: the profile by its name with `.toml`, and its
    DBCs by what the profile calls them, wherever they lie.

    Raises ProfileError if one cannot be read.
    """
    path = _path(name_or_path)
    table = read_toml(path, ProfileTable)
    names = sorted({s.dbc for s in table.sensor} | {ego.dbc for ego in table.ego})
    try:
        dbcs = {name: _dbc_path(name, path).read_bytes() for name in names}
        return {f"{path.stem}.toml": path.read_bytes()} | dbcs
    except OSError as error:
        raise ProfileError(f"cannot read {error.filename}: {error.strerror}") from error


def _profile(table: ProfileTable, path: Path, load: Callable[[str], Dbc]) -> Profile:
    """`path` names it, in errors too; `load` gives a DBC that it names."""
    if problem := _problem(table):
        raise ProfileError(f"{path}: {problem}")
    check_latencies(table, str(path))
    dbc = cache(load)  # sensor and ego often share one
    offset = table.arbitration_id_offset
    return Profile(
        name=path.stem,
        description=table.description,
        sensors=tuple(
            bind_sensor(sensor, dbc(sensor.dbc), offset, f"{path}: sensor[{i}]")
            for i, sensor in enumerate(table.sensor)
        ),
        ego=tuple(
            bind_ego(ego, dbc(ego.dbc), offset, f"{path}: ego[{i}]")
            for i, ego in enumerate(table.ego)
        ),
        yaw_rate_bias_rad_s=math.radians(table.yaw_rate_bias_deg_s),
    )


def _among(files: Mapping[str, bytes], name: str, max_bytes: int) -> bytes:
    if name not in files:
        raise ProfileError(f"there is no {name!r} among its files")
    if (size := len(files[name])) > max_bytes:
        raise ProfileError(
            f"{name!r} has {size:,} bytes, and no such file has more than {max_bytes:,}"
        )
    return files[name]


def _problem(table: ProfileTable) -> str | None:
    if not table.sensor and not table.ego:
        return "there is neither a [[sensor]] nor an [[ego]] in it"
    names = [sensor.name for sensor in table.sensor]
    for name in names:
        if names.count(name) > 1:
            return f"more than one sensor has the name {name!r}; names must be unique"
    if sum(ego.fields.latitude is not None for ego in table.ego) > 1:
        return "more than one [[ego]] gives latitude and longitude; keep one"
    if not abs(table.yaw_rate_bias_deg_s) <= _MAX_BIAS_DEG_S:
        bias = table.yaw_rate_bias_deg_s
        return f"yaw_rate_bias_deg_s is {bias}, expected at most {_MAX_BIAS_DEG_S:g} either way"
    return None


def _path(name_or_path: str) -> Path:
    """A built-in profile's file for its name; anything that looks like a path is one."""
    path = Path(name_or_path)
    if path.suffix != ".toml" and path.name == name_or_path:
        path = _PROFILES / f"{name_or_path}.toml"
    if may_be_file(path):
        return path
    known = ", ".join(builtin_profiles())
    raise ProfileError(
        f"there is no profile {name_or_path!r}; built in are {known}, or give the path of a .toml"
    )


def _dbc_path(name: str, profile: Path) -> Path:
    """The DBC that a profile names: beside the profile, or one of ours."""
    for path in (profile.parent / name, _DBCS / name):
        if may_be_file(path):
            return path
    known = ", ".join(sorted(str(path.relative_to(_DBCS)) for path in _DBCS.rglob("*.dbc")))
    raise ProfileError(
        f"{profile}: there is no DBC {name!r} beside the profile, nor built in ({known})"
    )
