"""Two runs over the same drive compared, target by target: `eqrt replay --diff`.

Runs come as their JSON lines (docs/output.md), so that a recording, a replay and a file written
long ago are compared in the same way, to the millimetre. Cycles are matched by the time of their
newest measurement, targets by their sensor's number and the time of their own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from eqrt.core.errors import LogError, in_one_line

_SHOWN_PERCENTILES = (50, 95, 99)


class _Target(msgspec.Struct, frozen=True):
    """A line, its numbers not yet read."""

    cycle: int
    time_s: float
    cycle_mode: str
    model_id: str
    tile_id: str
    track_id: int
    object_id: int
    mode: str
    anchor_s: float
    age_s: float
    dt_s: float
    position: msgspec.Raw
    velocity: msgspec.Raw
    probabilities: msgspec.Raw
    trajectories: msgspec.Raw

    @property
    def key(self) -> tuple[int, float]:
        """What the same target has in the same cycle of another run."""
        return self.object_id, self.anchor_s

    def says(self) -> tuple[object, ...]:
        """Everything but the names of model and tile."""
        arrays = (self.position, self.velocity, self.probabilities, self.trajectories)
        numbers = (self.cycle, self.time_s, self.track_id, self.object_id, self.anchor_s)
        modes = (self.cycle_mode, self.mode, self.age_s, self.dt_s)
        return (*numbers, *modes, *map(bytes, arrays))


_DECODER = msgspec.json.Decoder(_Target)
_TRAJECTORIES = msgspec.json.Decoder(list[list[tuple[float, float]]])


@dataclass(frozen=True, slots=True)
class Worst:
    """The target that moved furthest."""

    distance_m: float
    time_s: float
    track_id: int
    object_id: int


@dataclass(slots=True)
class Difference:
    """What two runs have in common, and what not; `first` and `second` in the order given."""

    cycles: int = 0
    """In both, with targets."""
    cycles_only_first: int = 0
    cycles_only_second: int = 0
    cycles_left_out: int = 0
    """Only in the second, because the first cannot say what they were: no difference."""
    targets: int = 0
    """In both."""
    targets_only_first: int = 0
    targets_only_second: int = 0
    identical: int = 0
    """Targets of which both say the same, to the last digit."""
    cycle_modes: int = 0
    """Cycles whose mode differs."""
    modes: int = 0
    """Targets whose mode differs."""
    incomparable: int = 0
    """Targets in both whose trajectories have other steps."""
    distances_m: list[float] = field(default_factory=list)
    """Of every target in both: how far its most probable trajectories are apart at most."""
    worst: Worst | None = None
    model_ids: tuple[set[str], set[str]] = field(default_factory=lambda: (set(), set()))
    tile_ids: tuple[set[str], set[str]] = field(default_factory=lambda: (set(), set()))

    @property
    def is_none(self) -> bool:
        """Whether both runs have the same targets and say the same of each."""
        alone = (
            self.cycles_only_first
            + self.cycles_only_second
            + self.targets_only_first
            + self.targets_only_second
        )
        return not alone and self.identical == self.targets


def compare_runs(
    first: Iterable[bytes],
    second: Iterable[bytes],
    is_left_out: Callable[[float], bool] = lambda _: False,
) -> Difference:
    """The difference of two runs, each given as its JSON lines. Raises LogError on another line.

    `is_left_out` tells of the time of a cycle whether the first run lacks it with good reason; it
    is asked when the first run has got past that time.
    """
    found = Difference()
    firsts = _cycles(first, "the first run", (found.model_ids[0], found.tile_ids[0]))
    seconds = _cycles(second, "the second run", (found.model_ids[1], found.tile_ids[1]))
    one, other = next(firsts, None), next(seconds, None)
    while one is not None or other is not None:
        if other is None or (one is not None and one.at < other.at):
            assert one is not None
            found.cycles_only_first += 1
            found.targets_only_first += len(one.targets)
            one = next(firsts, None)
        elif one is None or other.at < one.at:
            _count_second(other, found, is_left_out)
            other = next(seconds, None)
        else:
            _compare_cycles(one, other, found)
            one, other = next(firsts, None), next(seconds, None)
    return found


def _count_second(cycle: _Cycle, found: Difference, is_left_out: Callable[[float], bool]) -> None:
    if is_left_out(cycle.at[1]):
        found.cycles_left_out += 1
    else:
        found.cycles_only_second += 1
        found.targets_only_second += len(cycle.targets)


def table(found: Difference, first: str, second: str) -> str:
    """The difference for people; `first` and `second` are what the runs are called."""
    rows = [
        ("cycles in both", found.cycles),
        (f"  only in {first}", found.cycles_only_first),
        (f"  only in {second}", found.cycles_only_second),
        ("  with another mode", found.cycle_modes),
        ("targets in both", found.targets),
        (f"  only in {first}", found.targets_only_first),
        (f"  only in {second}", found.targets_only_second),
        ("  identical", found.identical),
        ("  with another mode", found.modes),
    ]
    if found.cycles_left_out:
        rows.insert(3, (f"  left out of {first}", found.cycles_left_out))
    if found.incomparable:
        rows.append(("  with other time steps", found.incomparable))
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {count:>9,}" for name, count in rows]
    return "\n".join(_names(found, first, second) + lines + _distances(found, width)) + "\n"


def _names(found: Difference, first: str, second: str) -> list[str]:
    """A line per kind of name, if the runs do not have it in common."""
    return [
        f"{what}: {_listed(ids[0])} in {first}, {_listed(ids[1])} in {second}"
        for what, ids in (("model", found.model_ids), ("tile", found.tile_ids))
        if ids[0] != ids[1]
    ]


def _listed(ids: set[str]) -> str:
    return ", ".join(sorted(name or "none" for name in ids)) or "nothing"


def _distances(found: Difference, width: int) -> list[str]:
    if not found.distances_m:
        return []
    lines = ["apart at most, most probable trajectory:"]
    values = np.percentile(found.distances_m, _SHOWN_PERCENTILES)
    for percent, value in zip(_SHOWN_PERCENTILES, values.tolist(), strict=True):
        lines.append(f"{f'  of {percent} % of targets':<{width}}  {value:>9.3f} m")
    lines.append(f"{'  of all':<{width}}  {max(found.distances_m):>9.3f} m")
    if found.worst:
        worst = found.worst
        lines.append(
            f"{'  the worst':<{width}}  track {worst.track_id}, object {worst.object_id}, "
            f"in the cycle at {worst.time_s:.6f} s"
        )
    return lines


@dataclass(frozen=True, slots=True)
class _Cycle:
    at: tuple[int, float]
    """Times that the clock was set back before, and the cycle's time."""
    targets: list[_Target]


def _cycles(lines: Iterable[bytes], where: str, ids: tuple[set[str], set[str]]) -> Iterator[_Cycle]:
    starts, before_s = 0, -math.inf
    for time_s, group in itertools.groupby(_targets(lines, where), lambda target: target.time_s):
        targets = list(group)
        ids[0].add(targets[0].model_id)
        ids[1].add(targets[0].tile_id)
        starts += time_s < before_s  # another start of the service, whose clock begins anew
        before_s = time_s
        yield _Cycle((starts, time_s), targets)


def _targets(lines: Iterable[bytes], where: str) -> Iterator[_Target]:
    for number, line in enumerate(lines, 1):
        try:
            yield _DECODER.decode(line)
        except msgspec.MsgspecError as error:
            raise LogError(
                f"{where}: line {number} is no prediction ({in_one_line(error)}); "
                "`eqrt replay --out` writes JSON lines"
            ) from error


def _compare_cycles(one: _Cycle, other: _Cycle, found: Difference) -> None:
    found.cycles += 1
    found.cycle_modes += one.targets[0].cycle_mode != other.targets[0].cycle_mode
    waiting: dict[tuple[int, float], list[_Target]] = {}
    for target in other.targets:
        waiting.setdefault(target.key, []).append(target)
    for target in one.targets:
        if same := waiting.get(target.key):
            _compare_targets(target, same.pop(0), found)
        else:
            found.targets_only_first += 1
    found.targets_only_second += sum(map(len, waiting.values()))


def _compare_targets(one: _Target, other: _Target, found: Difference) -> None:
    found.targets += 1
    if one.says() == other.says():
        found.identical += 1
        found.distances_m.append(0.0)
        return
    found.modes += one.mode != other.mode
    distance_m = _apart_m(one, other)
    if distance_m is None:
        found.incomparable += 1
        return
    found.distances_m.append(distance_m)
    if found.worst is None or distance_m > found.worst.distance_m:
        found.worst = Worst(distance_m, one.time_s, one.track_id, one.object_id)


def _apart_m(one: _Target, other: _Target) -> float | None:
    """How far the most probable trajectories are apart at most, as far as both go."""
    mine, theirs = _most_probable(one), _most_probable(other)
    steps = min(len(mine), len(theirs))
    if not steps or one.dt_s != other.dt_s:
        return None
    return float(np.linalg.norm(mine[:steps] - theirs[:steps], axis=-1).max())


def _most_probable(target: _Target) -> NDArray[np.float64]:
    """(H, 2) metres. Raises LogError if the line has something else there."""
    try:
        return np.array(_TRAJECTORIES.decode(target.trajectories)[0])
    except (msgspec.MsgspecError, IndexError) as error:
        raise LogError(
            f"object {target.object_id} in the cycle at {target.time_s:.6f} s has no trajectories "
            f"({in_one_line(error)}); `eqrt replay --out` writes JSON lines"
        ) from error
