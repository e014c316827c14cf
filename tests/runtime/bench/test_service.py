"""`eqrt bench --service`: real processes on the local bus, and the parts of it."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import can
import numpy as np
import pytest

from bench_reports import SERVICE_REPORT, bench, bench_for_real
from drives import DRIVES, first_seconds
from eqrt.core.errors import EqrtError, UsageError
from eqrt.runtime.bench.budget import broken, check_duty, load_budget
from eqrt.runtime.bench.environment import allowed_cores, read_environment
from eqrt.runtime.bench.page import render_page
from eqrt.runtime.bench.report import SERVICE
from eqrt.runtime.bench.service.bench import objects_in
from eqrt.runtime.bench.service.case import Setup, measure_service
from eqrt.runtime.bench.service.crowd import MESSAGE_S, crowded_cycles
from eqrt.runtime.bench.service.journal import STAGES
from eqrt.runtime.bench.service.orders import BusOrder, ServiceOrder, TrafficOrder
from eqrt.runtime.bench.service.programs import Program
from eqrt.runtime.bench.table import WIDTH, case_lines, closing_lines
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.detections import Detections
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.can_output import Offset
from eqrt.runtime.output.publish_can import BASE_ID
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from processes import Heard
from source_tree import ROOT

CHANNELS = (f"bench-service-{os.getpid()}-{number}" for number in count())
LAST_INPUT_ID = 0x5A5  # OBJECT_MOTION, the last of them ends a cycle of the generic object list
SHIPPED = ROOT / "deploy/budgets.toml"


# --- for real


def test_at_10_hz_on_classic_can_with_a_budget_that_nothing_can_keep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    budget = tmp_path / "budget.toml"
    duty = 'schedule = "periodic"\nrate_hz = 10\n'
    budget.write_text(f"{duty}[service.start]\nrss_mib = 1\n[service.objects.8]\np50_ms = 0\n")
    options = ["--service", "--objects", "8", "--seconds", "3", "--no-fd", "--budget", str(budget)]
    run = bench_for_real(tmp_path, capsys, *options)
    assert run.status == 3
    assert "OVER BUDGET start: rss is " in run.said
    assert "OVER BUDGET 8 objects: p50 is " in run.said
    assert run.report.settings.bus == f"{LOCAL}, classic CAN"
    measured = run.report.cases[0]
    service = measured.judged
    assert tuple(service.stages) == STAGES
    assert all(stage.mean_ns > 0 for stage in service.stages.values())
    means = [stage.mean_ns for stage in service.stages.values()]
    assert service.total.mean_ns == pytest.approx(sum(means), abs=len(means))
    assert service.cpu_mean_ns > 0
    kept = measured.punctuality
    assert kept is not None
    assert service.samples + kept.skipped == kept.ticks
    assert 15 <= kept.ticks <= 31
    start = run.report.cold_start
    assert 0.0 < start.first_s < start.total_s <= start.slowest_s  # medians: parts need not add up
    assert start.rss_bare_mib < start.rss_mib <= measured.resources.rss_peak_mib + 10.0
    assert "the whole service" in run.page


def test_back_to_back_every_object_of_every_cycle_is_predicted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Far more often than 60 ms apart, which cycles at their own time could not be."""
    options = ["--service", "--schedule", "back-to-back", "--objects", "2", "--seconds", "3"]
    run = bench_for_real(tmp_path, capsys, *options, "--threads", "2")
    assert run.status == 0
    measured = run.report.cases[0]
    assert measured.judged.samples > 3.0 / 0.06
    assert measured.punctuality is None
    assert "objects were predicted in a cycle" not in "".join(measured.advice)
    assert "not answered" not in "".join(measured.reasons)


def test_a_recorded_log_is_played_as_it_was_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive, log = DRIVES["ngsim"], tmp_path / "part.log"
    log.write_text(first_seconds(drive.log, 8.0))
    options = ["--service", "--log", str(log), *drive.options, "--seconds", "2"]
    run = bench_for_real(tmp_path, capsys, *options)
    assert run.status == 0
    assert run.report.settings.log == "part.log"
    measured = run.report.cases[0]
    assert measured.targets == objects_in(log, drive.profile) > 2
    assert 10 <= measured.judged.samples <= 21


def test_a_listener_on_the_bus_sees_the_same_latency() -> None:
    """From the kernel's stamps of what it hears, without asking the service."""
    channel = next(CHANNELS)
    bus = BusOrder(channel=channel, interface=LOCAL, fd=True)
    settings = replace(SERVICE_REPORT.settings, targets=(4,), seconds=4.0)
    with Heard(channel) as heard:
        case = measure_service(setup_on(bus), 4, settings, read_environment(), never)
    assert case is not None
    outside_ns = 1e9 * float(np.median(latencies_s(heard.messages)))
    inside_ns = case.judged.total.percentiles["p50"].value_ns
    assert outside_ns == pytest.approx(inside_ns, rel=0.5)


def never() -> bool:
    return False


def setup_on(bus: BusOrder) -> Setup:
    return Setup(
        bus=bus,
        profile="generic",
        model=DEFAULT_ARTIFACT,
        tile=DRIVES["ngsim"].tile,
        stationary=False,
        log=None,
        traffic_cores=allowed_cores(),
    )


def latencies_s(messages: list[can.Message]) -> list[float]:
    """From the last message of an object list to the last trajectory that follows it."""
    found: list[float] = []
    asked_s = said_s = 0.0
    for message in sorted(messages, key=lambda one: one.timestamp):
        if message.arbitration_id == BASE_ID + Offset.TRAJECTORY:
            said_s = message.timestamp
        elif message.arbitration_id == LAST_INPUT_ID:
            if asked_s < said_s:
                found.append(said_s - asked_s)
            asked_s = message.timestamp
    return found


def test_traffic_comes_at_its_rate_and_says_how_late_it_was() -> None:
    """Sixteen cycles, whole, in about a second."""
    bus = BusOrder(channel=next(CHANNELS), interface=LOCAL, fd=None)
    order = TrafficOrder(bus=bus, cores=(0,), objects=4, period_s=1 / 16, log=None)
    with open_bus(bus.channel, LOCAL) as ear, Program(order, never) as traffic:
        assert traffic.wait_for("ready")
        heard: list[can.Message] = []
        while len(heard) < 16 * (3 + 1 + 2 * 4):
            message = ear.recv(10.0)
            assert message is not None
            heard.append(message)
        traffic.stop()
        ended = traffic.wait_for("ended")
    assert ended is not None
    assert ended["cycles"] >= 16
    assert 0.0 <= ended["late_p99_s"] < 10.0
    decoder = Decoder(load_profile("generic"))
    cycles = [
        event
        for message in heard
        for event in decoder.feed(message, message.timestamp)
        if isinstance(event, Detections)
    ]
    assert [len(cycle.object_id) for cycle in cycles] == [4] * 16
    assert heard[-1].timestamp - heard[0].timestamp > 0.5  # not all at once


def test_told_to_stop_both_programs_say_what_they_have(tmp_path: Path) -> None:
    bus, rows = BusOrder(channel=next(CHANNELS), interface=LOCAL, fd=None), "rows.npy"
    stop: list[str] = []
    order = ServiceOrder(
        bus=bus,
        cores=allowed_cores(),
        profile="generic",
        model=str(DEFAULT_ARTIFACT),
        tile=None,
        stationary=False,
        threads=1,
        seconds=600.0,
        expected=100,
        answered_clock=True,
        rows=str(tmp_path / rows),
    )
    sent = TrafficOrder(bus=bus, cores=allowed_cores(), objects=2, period_s=None, log=None)
    with Program(order, lambda: bool(stop)) as serving:
        assert serving.wait_for("ready")
        with Program(sent, lambda: bool(stop)) as traffic:
            assert serving.wait_for("measuring")
            time.sleep(1.0)
            stop.append("now")
            told, ended = serving.wait_for("measured"), traffic.wait_for("ended")
            for _ in range(2):
                assert serving.wait_for("anything more") is None
    assert told is not None
    assert told["seconds"] < 600.0
    assert len(np.load(tmp_path / rows)) > 0
    assert ended is not None
    assert ended["cycles"] > 30


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    bus = BusOrder(channel="x", interface=LOCAL, fd=None)
    log = str(tmp_path / "nowhere.log")
    order = TrafficOrder(bus=bus, cores=(0,), objects=1, period_s=None, log=log)
    with (
        Program(order, never) as traffic,
        pytest.raises(EqrtError, match=r"traffic failed: .*nowhere"),
    ):
        traffic.wait_for("ended")


# --- its parts


@pytest.mark.parametrize("objects", [1, 8, 64])
def test_generated_traffic_has_as_many_objects_as_wanted_and_keeps_their_names(
    objects: int,
) -> None:
    decoder = Decoder(load_profile("generic"))
    cycles = [cycle for _, cycle in zip(range(30), crowded_cycles(objects), strict=False)]
    lists = [
        event
        for number, cycle in enumerate(cycles)
        for message in cycle
        for event in decoder.feed(message, number / 10 + message.timestamp)
        if isinstance(event, Detections)
    ]
    assert [len(one.object_id) for one in lists] == [objects] * 30
    assert all(len({*one.object_id.tolist()}) == objects for one in lists)
    for before, now in pairwise(lists):
        assert np.isin(now.object_id[~now.is_new], before.object_id).all()
    spacing = np.diff([message.timestamp for message in cycles[0]])
    np.testing.assert_allclose(spacing, MESSAGE_S)


def test_a_log_without_object_cycles_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "empty.log"
    log.write_text("(1.0) can0 123#00\n")
    with pytest.raises(EqrtError, match=r"empty.log: no object cycle of the profile generic"):
        objects_in(log, "generic")


@pytest.mark.parametrize(
    ("without", "named"),
    [("300#", "(SpeedInformation not on the bus)"), ("30", "(SpeedInformation, YawRateInform")],
)
def test_a_log_that_tells_no_motion_is_refused_at_once(
    without: str, named: str, tmp_path: Path
) -> None:
    """Unless the sensor stands still."""
    log = tmp_path / "parked.log"
    lines = first_seconds(DRIVES["ars408"].log, 1.0).splitlines(keepends=True)
    log.write_text("".join(line for line in lines if f" {without}" not in line))
    with pytest.raises(EqrtError, match="NO_POSE: nothing tells the car's speed and yaw") as error:
        objects_in(log, "ars408")
    assert named in str(error.value)
    assert "--stationary" in str(error.value)
    assert objects_in(log, "ars408", stationary=True) >= 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--objects", "8"], "--objects is for --service, not for the model alone"),
        (["--service", "--targets", "8"], "--targets is for the model alone, .*not for --service"),
        (["--service", "--objects", "65"], "--objects '65': give different numbers from 1 to 64"),
        (["--service", "--rate", "20"], "--rate is 20; give 0.1 to 16"),
        (["--service", "--tile", "x"], "--tile needs --log; generated traffic has its own"),
        (["--service", "--log", "x.log"], "--log needs --profile"),
        (["--service", "--log", "x", "--rate", "5"], "leave out --rate and --schedule"),
        (
            ["--service", "--log", "x", "--profile", "generic", "--objects", "3"],
            "leave out --objects",
        ),
        (["--service", "--can-interface", "virtual"], "--can-interface needs --can"),
        (["--service", "--operators"], "not allowed with argument"),
        (["--service", "--budget", "BUDGET"], "has no limits for the service; give another"),
    ],
)
def test_wrong_usage_is_refused_in_one_line(
    tmp_path: Path, arguments: list[str], said: str
) -> None:
    budget = tmp_path / "budget.toml"
    budget.write_text('schedule = "periodic"\nrate_hz = 10\n[targets.1]\np50_ms = 1\n')
    with pytest.raises(UsageError, match=said) as error:
        bench(*(str(budget) if word == "BUDGET" else word for word in arguments))
    assert "\n" not in str(error.value)


def test_a_channel_that_does_not_exist_is_named() -> None:
    with pytest.raises(EqrtError, match=r"CAN channel 'nocan7'"):
        bench("--service", "--can", "nocan7", "--seconds", "1")


# --- its report


def test_the_report_speaks_of_objects() -> None:
    lines = [line for one in SERVICE_REPORT.cases for line in case_lines(one)]
    assert "32 objects, ms" in lines[1]
    assert max(map(len, lines)) <= WIDTH
    assert "<h2>32 objects</h2>" in render_page(SERVICE_REPORT)
    noisy = replace(SERVICE_REPORT.cases[0], reasons=("noise",))
    assert closing_lines(replace(SERVICE_REPORT, cases=(noisy,)))[1].startswith(
        "INVALID: objects 32"
    )


def test_limits_of_the_service_are_its_own(tmp_path: Path) -> None:
    path = tmp_path / "budget.toml"
    duty = 'schedule = "periodic"\nrate_hz = 10\n'
    path.write_text(f"{duty}[targets.1]\np50_ms = 0\n[service.objects.32]\np50_ms = 3\n")
    budget = load_budget(path, SERVICE)
    check_duty(budget, SERVICE_REPORT.settings)
    assert broken(budget, SERVICE_REPORT) == ["32 objects: p50 is 4 ms, allowed 3 ms"]
    other = replace(SERVICE_REPORT.settings, targets=(8,))
    with pytest.raises(UsageError, match="limits for 32 objects, which are not measured; add"):
        check_duty(budget, other)
    path.write_text(f"{duty}[service.objects.x]\np50_ms = 3\n")
    with pytest.raises(EqrtError, match=r"\[service.objects.x\]: 'x' is no number of objects"):
        load_budget(path)


def test_the_shipped_budget_has_limits_for_the_service_at_10_hz() -> None:
    budget = load_budget(SHIPPED, SERVICE)
    wanted = tuple(budget.targets)
    assert {1, 32, 64} <= {*wanted}
    check_duty(budget, replace(SERVICE_REPORT.settings, targets=wanted))
    assert all(limits["p50_ms"] < limits["p99_ms"] for limits in budget.targets.values())
