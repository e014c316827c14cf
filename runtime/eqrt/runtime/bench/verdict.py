"""Whether the figures can be trusted, and what would make them better."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

from eqrt.runtime.bench.environment import Environment
from eqrt.runtime.bench.percentiles import samples_needed
from eqrt.runtime.bench.report import Punctuality, Settings, WorkloadResult
from eqrt.runtime.bench.resources import Resources

MAX_STEAL = 0.01
"""Of the cores' time."""
MAX_OTHERS = 0.05
"""Of the cores' time; the kernel and what a quiet system runs stay below."""
MAX_INTERRUPTIONS_PER_S = 20.0
"""Involuntary context switches per second of CPU time: beside another busy program hundreds. Only
for one thread: several interrupt each other."""
MAX_FREQUENCY_RATIO = 1.05
WANTED = "p99"
"""A measurement that cannot give this percentile is not valid."""
_SHORTER = 0.98  # of the time asked for: the last tick may be nearly a period before the end
_LONG_TAIL = 3.0
_SLOW_WAKE_UP_NS = 1_000_000
_LEAK_KIB_PER_S = 10.0
_COLD = 5.0  # times; a wait evicts little by itself
_WASTED_CPU = 1.2  # CPU time per time taken, with several threads
_WORTH_THREADS = 1.1  # times as fast as one


def reasons(
    settings: Settings,
    judged: WorkloadResult,
    resources: Resources,
    seconds: float,
    *,
    clock_went_back: bool,
) -> tuple[str, ...]:
    """Why the figures are not to be trusted; empty if nothing speaks against them."""
    return tuple(_reasons(settings, judged, resources, seconds, clock_went_back))


def advice(
    settings: Settings,
    environment: Environment,
    judged: WorkloadResult,
    punctuality: Punctuality | None,
    resources: Resources,
) -> tuple[str, ...]:
    """What a reader should know or try, a line each."""
    return (
        *_tail(settings, judged),
        *_more_samples(settings, judged),
        *_threads(settings, judged),
        *_ticks(punctuality),
        *_wake_up(judged, punctuality),
        *_memory(resources),
        *_machine(environment, resources),
        *_caches(settings, environment),
    )


def _reasons(
    settings: Settings,
    judged: WorkloadResult,
    resources: Resources,
    seconds: float,
    clock_went_back: bool,
) -> Iterator[str]:
    if judged.samples < samples_needed(WANTED):
        yield f"{judged.samples:,} samples, a {WANTED} needs {samples_needed(WANTED):,}"
    if seconds < _SHORTER * settings.seconds:
        yield f"ran for {seconds:.1f} s of {settings.seconds:g} s"
    if clock_went_back:
        yield "the clock went back"
    if resources.steal_share > MAX_STEAL:
        yield (
            f"the hypervisor took {resources.steal_share:.1%} of the cores' time "
            f"(at most {MAX_STEAL:.0%})"
        )
    if resources.others_share > MAX_OTHERS:
        yield (
            f"other programs used {resources.others_share:.1%} of the cores' time "
            f"(at most {MAX_OTHERS:.0%})"
        )
    per_s = resources.involuntary_switches / max(resources.cpu_s, 1.0)
    if settings.threads == 1 and per_s > MAX_INTERRUPTIONS_PER_S:
        yield (
            f"interrupted {per_s:.0f} times per second of CPU time "
            f"(at most {MAX_INTERRUPTIONS_PER_S:.0f})"
        )
    low, high = resources.frequency_low_mhz, resources.frequency_high_mhz
    if low is not None and high is not None and high > MAX_FREQUENCY_RATIO * low:
        yield f"the cores' clock went from {low:.0f} to {high:.0f} MHz"


def _tail(settings: Settings, judged: WorkloadResult) -> Iterator[str]:
    found = judged.total.percentiles
    if "p99" in found and found["p99"].value_ns > _LONG_TAIL * found["p50"].value_ns:
        ratio = found["p99"].value_ns / found["p50"].value_ns
        why = "other work on these cores? see --cpus"
        if settings.threads > 1:
            why = "threads wait for each other: --threads 1 is steadier"
        yield f"p99 is {ratio:.1f} x p50: {why}"


def _more_samples(settings: Settings, judged: WorkloadResult) -> Iterator[str]:
    for name in ("p99", "p99.9"):
        needed = samples_needed(name)
        if judged.samples < needed:
            seconds = settings.seconds * needed / max(judged.samples, 1)
            if settings.rate_hz is not None:
                seconds = needed / settings.rate_hz
            yield (
                f"{name} needs {needed:,} samples, there are {judged.samples:,}: "
                f"--seconds {ceil(seconds)}"
            )
            return


def alone_advice(settings: Settings, judged: WorkloadResult, alone_ns: int) -> tuple[str, ...]:
    """Whether several threads are worth it, beside the median of one, measured just after."""
    gain = alone_ns / max(_median_ns(judged), 1)
    if settings.threads == 1 or gain > _WORTH_THREADS:
        return ()
    return (
        f"{settings.threads} threads gain next to nothing at this size, {gain:.2f} x the speed of "
        f"one ({alone_ns / 1e6:.3f} ms): --threads 1 leaves the other cores free",
    )


def _median_ns(judged: WorkloadResult) -> int:
    found = judged.total.percentiles.get("p50")
    return judged.total.mean_ns if found is None else found.value_ns


def _threads(settings: Settings, judged: WorkloadResult) -> Iterator[str]:
    ratio = judged.cpu_mean_ns / max(judged.total.mean_ns, 1)
    if settings.threads > 1 and ratio > _WASTED_CPU:
        yield (
            f"{settings.threads} threads: {ratio:.1f} s of CPU time for every second of answering; "
            "compare --threads 1"
        )


def _ticks(punctuality: Punctuality | None) -> Iterator[str]:
    if punctuality is None:
        return
    if punctuality.misses:
        yield (
            f"{punctuality.misses:,} of {punctuality.ticks:,} deadlines missed: fewer targets, "
            "a smaller model, or a lower rate"
        )


def _wake_up(judged: WorkloadResult, punctuality: Punctuality | None) -> Iterator[str]:
    """Of a run that was due; of the service, until it has the message."""
    wake_up = judged.stages.get("wake-up", punctuality.wake_up if punctuality else None)
    found = wake_up.percentiles.get("p99") if wake_up else None
    if found is not None and found.value_ns > _SLOW_WAKE_UP_NS:
        yield (
            f"p99 of waking up is {found.value_ns / 1e6:.1f} ms late: a real-time priority "
            "(chrt --fifo) or a core of its own"
        )


def _memory(resources: Resources) -> Iterator[str]:
    slope = resources.rss_slope_kib_per_s
    if slope is not None and slope > _LEAK_KIB_PER_S:
        yield f"memory grew by {slope:.1f} KiB/s: does it go on? repeat with a longer --seconds"
    if resources.major_faults:
        yield f"{resources.major_faults:,} pages came from disk: is memory short?"


def _machine(environment: Environment, resources: Resources) -> Iterator[str]:
    if resources.steal_share > MAX_STEAL:
        yield "the hypervisor takes time from these cores: a machine with cores of its own"
    if environment.governor not in (None, "performance"):
        yield f"the frequency governor is {environment.governor!r}: performance is steadier"
    if "avx2" not in environment.flags and not any("asimd" in f for f in environment.flags):
        yield "no AVX2 here: onnxruntime is several times slower without"


def _caches(settings: Settings, environment: Environment) -> Iterator[str]:
    """Back-to-back runs hardly wait, and find what the one before left."""
    cooling = environment.cooling
    if settings.rate_hz is not None and cooling is not None and cooling > _COLD:
        yield (
            f"after 30 ms of waiting, caches are cold: a sum of 16 KiB takes {cooling:.0f} x as "
            "long. Others use them: programs, or guests of the same host; elsewhere a run at "
            f"{settings.rate_hz:g} Hz may be much quicker"
        )
