"""The report as one page of HTML that needs nothing else: no script, no font, no address."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from eqrt.runtime.bench.baseline import Comparison
from eqrt.runtime.bench.charts import course_chart, histogram_chart, stages_chart
from eqrt.runtime.bench.percentiles import CONFIDENCE, PERCENTILES
from eqrt.runtime.bench.report import GENERATED, SERVICE, Case, Distribution, Report, WorkloadResult
from eqrt.runtime.bench.table import interval, ms

_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --card: #f5f6f8; --ink: #1c1f24;
  --faint: #5d6570; --line: #d6dae0; --bar: #0072b2; --mark: #b34700; --good: #00664a;
  --bad: #a8200d; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171b; --card: #1e2228; --ink: #e8eaed;
  --faint: #a3abb6; --line: #3a414b; --bar: #56b4e9; --mark: #f0a35e; --good: #4fc79f;
  --bad: #ff8a75; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 16px; background: var(--paper);
  color: var(--ink); font: 16px/1.45 system-ui, sans-serif; }
h1 { font-size: 1.5rem; margin: 0.2em 0; } h2 { font-size: 1.2rem; margin: 1.8em 0 0.4em; }
h3 { font-size: 1rem; margin: 0 0 0.3em; font-weight: 600; }
p, ul { margin: 0.4em 0; } ul { padding-left: 1.2em; } .faint { color: var(--faint); }
.good { color: var(--good); font-weight: 700; } .bad { color: var(--bad); font-weight: 700; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.9rem;
  font-variant-numeric: tabular-nums; } th, td { padding: 3px 12px 3px 0; text-align: right;
  white-space: nowrap; border-bottom: 1px solid var(--line); } th:first-child, td:first-child
  { text-align: left; } th { font-weight: 600; color: var(--faint); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 320px), 1fr));
  gap: 12px; margin: 12px 0; } .card { background: var(--card); border-radius: 8px;
  padding: 10px 12px; } svg { width: 100%; height: auto; display: block; }
svg text { font: 11px system-ui, sans-serif; fill: var(--ink); }
svg .unit, svg .label { fill: var(--faint); } svg .grid { stroke: var(--line); }
svg .bar { fill: var(--bar); } svg .mark { stroke: var(--mark); stroke-dasharray: 3 3; }
svg .mark-text, svg .slowest-text { fill: var(--mark); } svg .median-text { fill: var(--bar); }
svg polyline { fill: none; stroke-width: 1.6; } svg .median { stroke: var(--bar); }
svg .slowest { stroke: var(--mark); stroke-width: 1; }
"""


def render_page(report: Report, comparison: Comparison | None = None) -> str:
    """The text of the page, and what changed since a baseline."""
    title = f"eqrt bench: {report.model.name} {report.model.version}{_whole(report)}"
    body = [
        f"<h1>{escape(title)}</h1>",
        *_heading(report),
        *([] if comparison is None else _comparison(comparison)),
        *(part for case in report.cases for part in _case(case)),
        "<h2>What it holds for</h2>",
        _table(("", ""), _facts(report)),
        f'<p class="faint">A percentile is shown only with samples enough for it; intervals have '
        f"{CONFIDENCE:.0%} confidence. docs/benchmarks.md defines every number.</p>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _whole(report: Report) -> str:
    return ", the whole service" if report.settings.benchmark == SERVICE else ""


def _heading(report: Report) -> Iterator[str]:
    settings, start = report.settings, report.cold_start
    yield (
        f"<p>{_verdict(report.valid)} {escape(settings.duty())}, {settings.seconds:g} s a case, "
        f"{settings.threads} thread{'s' * (settings.threads != 1)}, on "
        f"{escape(report.environment.cpu)}, {escape(report.measured_at)}</p>"
    )
    yield (
        f"<p>Cold start {start.total_s:.2f} s (import {start.import_s:.2f}, load "
        f"{start.load_s:.2f}, first answer {1e3 * start.first_s:.1f} ms), then "
        f"{start.rss_mib:.1f} MiB of memory, of which numpy and onnxruntime "
        f"{start.rss_bare_mib:.1f} MiB.</p>"
    )


def _case(case: Case) -> Iterator[str]:
    judged = case.judged
    yield f"<h2>{case.title}</h2>"
    yield f"<p>{_verdict(case.valid)} {escape('; '.join(case.reasons))}</p>"
    yield _table(("ms", *PERCENTILES, "max", "CPU", "samples"), _rows(case))
    yield from _list(case.advice)
    marks = {name: estimate.value_ns for name, estimate in judged.total.percentiles.items()}
    yield '<div class="cards">'
    yield _card("How often which latency", histogram_chart(judged.histogram, marks))
    yield _card("Over time", course_chart(judged.course))
    yield _card("Where the time goes, mean", stages_chart(judged))
    yield "</div>"
    yield _table(("", ""), _costs(case))


def _rows(case: Case) -> Iterator[Sequence[str]]:
    for workload in case.workloads:
        yield _row(workload.name, workload.total, workload)
        if workload is case.judged:
            found = workload.total.percentiles
            cells = [interval(found[name]) if name in found else "" for name in PERCENTILES]
            yield (f"{CONFIDENCE:.0%} confidence", *cells, "", "", "")
            for name, stage in workload.stages.items():
                yield _row(f"· {name}", stage)
    if case.punctuality is not None and case.punctuality.wake_up is not None:
        yield _row("wake-up, late by", case.punctuality.wake_up)


def _row(
    name: str, distribution: Distribution, workload: WorkloadResult | None = None
) -> Sequence[str]:
    found = distribution.percentiles
    cells = [ms(found[key].value_ns) if key in found else "-" for key in PERCENTILES]
    costs = ("", "") if workload is None else (ms(workload.cpu_mean_ns), f"{workload.samples:,}")
    return (name, *cells, ms(distribution.max_ns), *costs)


def _costs(case: Case) -> Iterator[Sequence[str]]:
    resources, kept = case.resources, case.punctuality
    if kept is not None:
        yield "deadlines missed", f"{kept.misses:,} of {kept.ticks:,} ({kept.skipped:,} skipped)"
    slope = resources.rss_slope_kib_per_s
    grows = "" if slope is None else f", {slope:+.1f} KiB/s"
    yield (
        "memory",
        f"{resources.rss_start_mib:.1f} MiB, peak {resources.rss_peak_mib:.1f} MiB{grows}",
    )
    yield (
        "context switches",
        f"{resources.voluntary_switches:,} voluntary, {resources.involuntary_switches:,} not",
    )
    yield "page faults", f"{resources.minor_faults:,} minor, {resources.major_faults:,} major"
    yield "others, steal", f"{resources.others_share:.1%}, {resources.steal_share:.1%}"


def _facts(report: Report) -> Iterator[Sequence[str]]:
    environment = report.environment
    settings = report.settings
    yield "model", f"{report.model.name} {report.model.version}"
    if settings.bus is not None:
        yield "bus", settings.bus
        yield "traffic", settings.log or GENERATED
    yield "SHA-256", report.model.sha256
    yield "processor", environment.cpu
    yield "instructions", " ".join(environment.flags)
    cores = ", ".join(map(str, environment.cores_allowed))
    yield "cores", f"{cores} of {environment.cores_present}"
    yield "governor", environment.governor or "not known"
    yield "virtual machine", "yes" if environment.hypervisor else "no"
    if environment.cooling is not None:
        yield "16 KiB after 30 ms", f"{environment.cooling:g} x as long"
    yield "kernel", environment.kernel
    for name in ("eqrt", "python", "numpy", "onnxruntime"):
        yield name, getattr(environment, name)


def _comparison(comparison: Comparison) -> Iterator[str]:
    yield "<h2>Beside the baseline</h2>"
    rows = [
        (
            f"{change.title}, {change.percentile}",
            interval(change.before),
            interval(change.now),
            f"{change.ratio:.3f}{' *' if change.significant else ''}",
            "REGRESSION" if change.regression else "",
        )
        for change in comparison.changes
    ]
    yield _table(("ms", "before", "now", "now / before", ""), rows)
    yield f'<p class="faint">* the intervals ({CONFIDENCE:.0%}) are apart</p>'
    yield from _list(comparison.remarks)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in head) if any(head) else ""
    top = f"<thead><tr>{heads}</tr></thead>" if heads else ""
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table>{top}<tbody>{body}</tbody></table></div>'


def _list(lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


def _card(title: str, chart: str) -> str:
    return f'<div class="card"><h3>{escape(title)}</h3>{chart}</div>'


def _verdict(valid: bool) -> str:
    return '<span class="good">VALID</span>' if valid else '<span class="bad">INVALID</span>'
