"""The report for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from eqrt.runtime.can_check.plain import plain
from eqrt.runtime.can_check.report import Fit, Report, Rhythm, Sensor, Values
from eqrt.runtime.can_check.scale import tells

SHOWN_SLOTS = 6
"""Messages of one reader that are shown singly; of a radar with 16 slots, the rest is summed up."""
_HOW_FITS_READ = (
    "Does what is said fit the change of positions over half a second? "
    "Slope and correlation are 1 at best."
)


def lines(report: Report) -> Iterator[str]:
    """Line by line; what looks wrong stands at the end, where it is seen."""
    told = f"{report.messages} messages in {report.seconds:.1f} s, profile {report.profile}"
    yield f"{report.log}: {told}"
    yield from _channels(report)
    yield from _messages(report)
    yield from _unknown(report)
    for sensor in report.sensors:
        yield from _sensor(sensor)
    yield from _ego(report)
    yield from _verdict(report)


def _channels(report: Report) -> Iterator[str]:
    for channel in report.channels:
        told = f"{channel.known} messages of the profile, {channel.unknown} others"
        yield f"  channel {channel.name}: {told}"
    counted = {name: report.counters[name] for name in ("not_data", "wrong_bus", "stray")}
    if rest := [f"{name} {number}" for name, number in counted.items() if number]:
        yield f"  counted: {', '.join(rest)} (docs/profiles.md says what these are)"


def _messages(report: Report) -> Iterator[str]:
    yield ""
    yield "Messages of the profile"
    rows, left = [], 0
    shown: dict[str, int] = {}
    for message in report.profile_messages:
        shown[message.used_by] = shown.get(message.used_by, 0) + 1
        bad = (message.short, message.bad_checksum, message.bad_counter)
        if shown[message.used_by] > SHOWN_SLOTS and message.rhythm.count and not any(bad):
            left += 1
            continue
        note = " (optional)" if message.optional else ""
        name = f"{message.name}{note}"
        rows.append((message.id, name, message.used_by, *_rhythm(message.rhythm), *map(str, bad)))
    heads = ("id", "message", "read by", *_RHYTHM_HEADS, "short", "checksum", "counter")
    yield from _table(heads, rows, left=3)
    if left:
        yield f"  and {left} more slots, all of which came undamaged"


_RHYTHM_HEADS = ("count", "per s", "period", "worst gap")


def _rhythm(rhythm: Rhythm) -> tuple[str, ...]:
    gap = "-"
    if rhythm.worst_gap_s is not None:
        gap = f"{_duration(rhythm.worst_gap_s)} at {rhythm.worst_gap_at_s:.1f} s"
    return (str(rhythm.count), f"{rhythm.per_second:.1f}", _duration(rhythm.median_period_s), gap)


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1.0 else f"{seconds:.2f} s"


def _unknown(report: Report) -> Iterator[str]:
    if not report.unknown:
        return
    yield ""
    yield "Ids that the profile does not name"
    rows = [(row.id, ", ".join(row.channels), *_rhythm(row.rhythm)) for row in report.unknown]
    yield from _table(("id", "channel", *_RHYTHM_HEADS), rows, left=2)
    ids, messages = report.unknown_rest
    if ids:
        yield f"  and {ids} more ids with {messages} messages"


def _sensor(sensor: Sensor) -> Iterator[str]:
    yield ""
    cycles = sensor.cycles
    yield (
        f"Sensor {sensor.name}: {cycles.count} cycles ({sensor.incomplete} incomplete), "
        f"period {_duration(cycles.median_period_s)}, "
        f"worst gap {_duration(cycles.worst_gap_s)}"
    )
    yield f"  mount {sensor.mount}, as the profile says; no recording can tell whether that is so"
    if not sensor.objects:
        return
    least, median, most = sensor.objects_per_cycle
    yield (
        f"  {sensor.objects} objects, {least:g} to {most:g} in a cycle, {median:g} in the middle; "
        f"{sensor.ids} different ids"
    )
    yield from _values(sensor.values)
    if set(sensor.classes) != {"unknown"}:
        yield f"  class: {', '.join(f'{name} {n}' for name, n in sensor.classes.items())}"
    yield from _fits(sensor.fits)


def _ego(report: Report) -> Iterator[str]:
    ego = report.ego
    yield ""
    if not (ego.speed.count or ego.yaw_rate.count or ego.poses.count):
        yield "Ego: nothing decoded; a sensor that stands still is served with --stationary"
        return
    yield "Ego"
    rows = [("speed", ego.speed), ("yaw rate", ego.yaw_rate), ("pose", ego.poses)]
    came = [(name, *_rhythm(rhythm)) for name, rhythm in rows if rhythm.count]
    yield from _table(("what", *_RHYTHM_HEADS), came, left=1)
    yield from _values(tuple(row for row in ego.values if row.count))
    yield from _fits(ego.fits)


def _values(values: Iterable[Values]) -> Iterator[str]:
    rows = [
        (
            f"{row.name}, {row.unit}" if row.unit else row.name,
            *(plain(x, 2) for x in (row.low, row.p5, row.median, row.p95, row.high)),
            f"{row.missing:.0%}" if row.missing else "",
        )
        for row in values
        if row.missing < 1.0
    ]
    yield from _table(("", "least", "5 %", "middle", "95 %", "most", "not known"), rows, left=1)
    never = [row.name for row in values if row.missing == 1.0]
    if never:
        yield f"  never known: {', '.join(never)}"


def _fits(fits: Sequence[Fit]) -> Iterator[str]:
    if not fits:
        return
    yield f"  {_HOW_FITS_READ}"
    rows = [
        (
            fit.what,
            str(fit.pairs),
            plain(fit.spread, 2),
            plain(fit.correlation, 2),
            plain(fit.slope, 2),
            plain(fit.residual, 2),
            "" if tells(fit) else "too little movement to tell",
        )
        for fit in fits
    ]
    heads = ("", "pairs", "spread", "correlation", "slope", "off by", "")
    yield from _table(heads, rows, left=1)


def _verdict(report: Report) -> Iterator[str]:
    yield ""
    if not report.decoded:
        yield "NOTHING DECODED: no object, no ego motion and no pose came out of this log"
    if not report.findings:
        yield "Nothing looks wrong. Look at the pictures (--plot) before you trust it."
        return
    yield "Looks wrong:" if len(report.findings) > 1 else "Looks wrong, one thing:"
    for finding in report.findings:
        yield f"  - {finding.about}: {finding.text}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, left: int) -> Iterator[str]:
    """The first `left` columns to the left, numbers to the right."""
    if not rows:
        return
    table = [heads, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(heads))]
    for row in table:
        cells = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield f"  {'  '.join(cells)}".rstrip()
