"""The page in Chromium, with real services behind it. Screenshots stay in `.artifacts/`."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import Browser
from crowd import crowd, cycles
from drives import DEMO, DRIVES, TILE
from eqrt.core.frames import Pose2
from eqrt.runtime.output.datagrams import DatagramPublisher
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.prediction.tiles import load_tile
from processes import PATIENCE_S, Heard, Serving
from recorded_drives import recorded_drive
from viewing import Viewing, artifact, watched

TILE_ID = load_tile(TILE).info.tile_id
FULL_SERVICE = "e.words === 'Full service: model, map and ego motion'"
"""What a machine that does much else says now and then only."""
LOGS = {"ngsim": DRIVES["ngsim"].log, "rav4": DEMO / "rav4.log.gz"}


@pytest.fixture(scope="module")
def ngsim() -> Iterator[tuple[Viewing, Heard, Serving]]:
    with watched(DRIVES["ngsim"], LOGS["ngsim"]) as all_of_it:
        yield all_of_it


@contextlib.contextmanager
def sending(
    viewing: Viewing,
    change: Callable[[ForecastSet], ForecastSet] = lambda forecast: forecast,
    *,
    agents: int = 8,
) -> Iterator[None]:
    """The crowd's cycles, changed, in a thread."""
    ended = threading.Event()

    def send() -> None:
        with DatagramPublisher([viewing.datagrams]) as publisher:
            for forecast in cycles(agents):
                if ended.is_set():
                    return
                publisher.publish(change(forecast))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def shown(browser: Browser, name: str) -> Any:
    """What the page says of itself."""
    return browser.evaluate(f"return window.eqrt && window.eqrt.{name}")


def wait(browser: Browser, condition: str) -> None:
    """Until a JavaScript expression, with the page's `e`, is true."""
    end_s = time.monotonic() + PATIENCE_S
    while not browser.evaluate(f"const e = window.eqrt; return Boolean(e && ({condition}))"):
        said = browser.evaluate("return document.body.innerText")
        assert time.monotonic() < end_s, f"{condition} never came true; the page says {said!r}"
        time.sleep(0.1)


def text(browser: Browser, selector: str) -> str:
    return str(browser.evaluate(f"return document.querySelector('{selector}').innerText"))


def scrub_to(browser: Browser, thousandths: int) -> None:
    """Move the handle of the timeline."""
    browser.evaluate(
        f"const handle = document.getElementById('scrub'); handle.value = {thousandths};"
        "handle.dispatchEvent(new Event('input'))"
    )


def test_traffic_with_a_map_is_shown_and_moves(
    browser: Browser, ngsim: tuple[Viewing, Heard, Serving]
) -> None:
    browser.open(ngsim[0].address)
    wait(browser, "e.agents.length > 15 && e.ghosts > 10 && e.score && e.lanes > 0")
    wait(browser, FULL_SERVICE)
    before = {agent["id"]: agent for agent in shown(browser, "agents")}
    time.sleep(1.0)
    after = {agent["id"]: agent for agent in shown(browser, "agents")}
    both = before.keys() & after.keys()
    assert len(both) > 10
    moved_m = [
        abs(after[i]["x"] - before[i]["x"]) + abs(after[i]["y"] - before[i]["y"]) for i in both
    ]
    assert sum(metres > 3.0 for metres in moved_m) > 5
    assert "ms" in text(browser, "#service-numbers")
    assert "constant velocity" in text(browser, "#score-table")
    assert "profile generic" in text(browser, "#what")
    browser.screenshot(artifact("view-with-a-map.png"))
    assert browser.console() == []


def test_agents_are_where_the_service_said(
    browser: Browser, ngsim: tuple[Viewing, Heard, Serving]
) -> None:
    """Paused, so that nobody is on the way from one cycle to the next."""
    viewing, heard, _ = ngsim
    browser.open(viewing.address)
    wait(browser, "e.agents.length > 5 && e.kept > 5")
    browser.click("#play")
    wait(browser, "e.paused")
    moment = shown(browser, "moment")
    agents = {agent["id"]: agent for agent in shown(browser, "agents")}
    said = next(one for one in heard.forecasts if one.cycle == moment["cycle"])
    assert agents.keys() == set(said.track_id.tolist())
    for track_id, position in zip(said.track_id.tolist(), said.position.tolist(), strict=True):
        assert (agents[track_id]["x"], agents[track_id]["y"]) == pytest.approx(position, abs=0.02)


def test_pause_holds_the_picture_and_steps_go_through_the_last_minute(
    browser: Browser, ngsim: tuple[Viewing, Heard, Serving]
) -> None:
    browser.open(ngsim[0].address)
    wait(browser, "e.live && e.kept > 30")
    browser.press("p")
    wait(browser, "e.paused && !e.live")
    held = shown(browser, "agents")
    cycle = shown(browser, "moment")["cycle"]
    kept = shown(browser, "kept")
    wait(browser, f"e.kept > {kept} + 3 || e.kept > 590")  # the world goes on
    assert shown(browser, "agents") == held
    browser.press("ArrowLeft", "ArrowLeft")
    wait(browser, f"e.moment.cycle === {cycle - 2}")
    assert shown(browser, "agents") != held
    browser.press("ArrowRight")
    wait(browser, f"e.moment.cycle === {cycle - 1}")
    assert "s ago" in text(browser, "#when")
    assert text(browser, "#play") == "Play"
    browser.screenshot(artifact("view-paused.png"))
    scrub_to(browser, 0)
    wait(browser, f"e.moment.cycle < {cycle - 15}")
    browser.press("l")
    wait(browser, f"e.live && !e.paused && e.moment.cycle > {cycle}")
    assert browser.console() == []


def test_stepping_back_shows_the_lanes_of_where_it_was(browser: Browser) -> None:
    """Also to a page that is opened after the ego vehicle has left them."""
    here, far_away = places_far_apart()

    def driven_on(forecast: ForecastSet) -> ForecastSet:
        x_m, y_m = here if forecast.cycle < 30 else far_away
        pose = Pose2(x_m, y_m, 0.0)
        return replace(forecast, tile_id=TILE_ID, mode=Mode.RUN, map_from_ego=pose)

    with Viewing("--tile", str(TILE)) as viewing, sending(viewing, driven_on):
        browser.open(viewing.address)
        wait(browser, "e.moment && e.moment.cycle < 25 && e.lanes > 0")
        for _ in range(2):
            wait(browser, "e.moment && e.moment.cycle > 40 && e.kept > 40 && e.lanes > 0")
            browser.press("p")
            scrub_to(browser, 0)
            wait(browser, "e.moment.cycle < 20 && e.lanes > 0")
            browser.open(viewing.address)
        assert browser.console() == []


def places_far_apart() -> tuple[list[float], list[float]]:
    """On two lanes of the demo's tile."""
    lane_map = load_tile(TILE).lane_map
    starts = [lane_map.lane_points(lane)[0].tolist() for lane in range(lane_map.num_lanes)]
    far_away = max(starts, key=lambda start: math.dist(start, starts[0]))
    assert math.dist(far_away, starts[0]) > 1_000.0
    return starts[0], far_away


def test_a_click_selects_an_agent_and_shows_its_numbers(
    browser: Browser, ngsim: tuple[Viewing, Heard, Serving]
) -> None:
    browser.open(ngsim[0].address)
    long_seen = "e.ghosts > 2 * e.agents.length"  # and not just found, as when the log begins again
    wait(browser, f"e.agents.length > 5 && {long_seen} && {FULL_SERVICE}")
    browser.press("p")
    wait(browser, "e.paused")
    agent = browser.evaluate(
        "const box = document.getElementById('scene').getBoundingClientRect();"
        "const inside = window.eqrt.pixels.filter(a => a.px > 200 && a.px < box.width - 200"
        "  && a.py > 100 && a.py < box.height - 100);"
        "const a = inside[0]; return { id: a.id, x: a.px + box.left, y: a.py + box.top }"
    )
    browser.click_at(agent["x"], agent["y"])
    wait(browser, "e.selected !== null")
    chosen = shown(browser, "selected")
    assert chosen in {a["id"] for a in shown(browser, "agents")}
    panel = text(browser, "#selected")
    for words in (f"{chosen}, car", "m/s", "from ego", "by the model", "path 1", "100 %"):
        assert words in panel
    browser.screenshot(artifact("view-selected.png"))
    browser.press("Escape")
    wait(browser, "e.selected === null && document.getElementById('selected').hidden")
    assert browser.console() == []


def test_no_label_lies_on_another(browser: Browser) -> None:
    with Viewing() as viewing, sending(viewing, agents=64):
        browser.open(viewing.address)
        wait(browser, "e.agents.length === 64 && e.labels.length > 15")
        boxes = shown(browser, "labels")
        browser.screenshot(artifact("view-64-agents.png"))
    for a, b in itertools.combinations(boxes, 2):
        assert not (a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3])


def test_between_two_cycles_agents_are_on_their_way_and_never_beyond(browser: Browser) -> None:
    """An agent of the crowd drives straight on at a constant speed."""
    with Viewing() as viewing, sending(viewing):
        browser.open(viewing.address)
        wait(browser, "e.live && e.kept > 10")
        browser.evaluate(
            "window.seen = []; const id = window.eqrt.agents[0].id; const look = () => {"
            "const a = window.eqrt.agents.find((one) => one.id === id); if (a) seen.push(a.x);"
            "if (seen.length < 90) requestAnimationFrame(look); }; look()"
        )
        wait(browser, "seen.length === 90")
        seen = browser.evaluate("return window.seen")
    steps = [abs(after - before) for before, after in itertools.pairwise(seen)]
    assert sum(step > 0.0 for step in steps) > 45  # ten cycles a second alone would give 15
    assert max(steps) < 5.0


def test_wheel_drag_and_keys_move_the_view(
    browser: Browser, ngsim: tuple[Viewing, Heard, Serving]
) -> None:
    browser.open(ngsim[0].address)
    wait(browser, "e.agents.length > 5")
    scale = shown(browser, "camera")["scale"]
    browser.press("+")
    wait(browser, f"e.camera.scale > {scale}")
    assert shown(browser, "camera")["follow"] == "ego"
    browser.drag(400, 300, 460, 320)
    wait(browser, "e.camera.follow === 'free'")
    browser.press("f")
    wait(browser, "e.camera.follow === 'ego'")
    assert shown(browser, "camera")["axis"] == "right"
    browser.press("n")
    wait(browser, "e.camera.axis === 'up'")


def test_traffic_without_a_map_says_so(browser: Browser) -> None:
    with watched(DRIVES["rav4"], LOGS["rav4"]) as (viewing, _, _):
        browser.open(viewing.address)
        wait(browser, "e.agents.length > 2")
        wait(browser, "e.words.startsWith('No map here: predicting without lanes, for ')")
        assert shown(browser, "lanes") == 0
        assert "no map" in text(browser, "#what")
        browser.screenshot(artifact("view-without-a-map.png"))
        assert browser.console() == []


def test_a_stopped_browser_leaves_the_service_as_it_is(
    ngsim: tuple[Viewing, Heard, Serving],
) -> None:
    viewing, heard, _ = ngsim
    with Browser() as victim:
        victim.open(viewing.address)
        wait(victim, "e.agents.length > 5")
        children = victim.processes()
        for pid in children:
            os.kill(pid, signal.SIGSTOP)
        before = len(heard.forecasts)
        time.sleep(4.0)
        came = len(heard.forecasts) - before
        for pid in children:
            os.kill(pid, signal.SIGCONT)
        assert 30 < came < 50  # 10 a second
        wait(victim, f"e.live && e.moment.cycle > {heard.forecasts[-1].cycle - 30}")


def test_before_anything_comes_it_says_what_to_run_and_goes_on_by_itself(browser: Browser) -> None:
    with Viewing() as viewing:
        browser.open(viewing.address)
        wait(browser, "e.words === 'Waiting for predictions'")
        wait(browser, "!document.getElementById('notice').hidden")
        assert f"--datagrams {viewing.datagrams}" in text(browser, "#notice")
        browser.screenshot(artifact("view-waiting.png"))
        with sending(viewing):
            wait(browser, "e.agents.length === 8")
            wait(browser, "document.getElementById('notice').hidden")
        wait(browser, "e.words.startsWith('Nothing heard of the service, for ')")
        assert re.fullmatch(r"stopped \d+ s ago", text(browser, "#when"))
        assert browser.evaluate("return document.querySelector('#live.now')") is None
    wait(browser, "e.words === 'Connection to eqrt view lost'")
    assert "eqrt view" in text(browser, "#notice")
    browser.screenshot(artifact("view-connection-lost.png"))
    port = int(viewing.host.rpartition(":")[2])
    browser.press("p")
    with Viewing(port=port) as again, sending(again, lambda forecast: forecast.targets(slice(5))):
        wait(browser, "e.connected && e.live && e.agents.length === 5")  # and it is not paused


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        (Mode.NO_POSE, "No map pose: predicting without lanes"),
        (Mode.LATE, "Late: predictions come late, or not all from the model"),
        (Mode.FALLBACK, "Without the model: constant turn rate and speed"),
        (Mode.SILENT, "No input from the sensor: earlier predictions are void"),
    ],
)
def test_what_the_service_cannot_do_is_said_in_words(
    browser: Browser, mode: Mode, words: str
) -> None:
    def change(forecast: ForecastSet) -> ForecastSet:
        if mode is Mode.SILENT:
            forecast = forecast.targets(slice(0))
        elif mode is Mode.FALLBACK:
            forecast.agent_mode[:] = Mode.FALLBACK
        return replace(forecast, mode=mode)

    with Viewing() as viewing, sending(viewing, change):
        browser.open(viewing.address)
        wait(browser, f"e.words.startsWith({words!r})")
        browser.screenshot(artifact(f"view-{mode.name.lower()}.png"))


def test_a_file_plays_pauses_and_can_be_gone_through(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "replayed.jsonl"
    path.write_bytes(b"".join(json_lines(crowd(cycle, 8)) for cycle in range(300)))
    with Viewing(str(path)) as viewing:
        browser.open(viewing.address)
        wait(browser, "e.kept === 300 && e.moment && e.moment.time_s > 0.5")
        wait(browser, "document.getElementById('when').innerText.endsWith('of 0:29.9')")
        assert not shown(browser, "paused")
        browser.press("p")
        wait(browser, "e.paused")
        scrub_to(browser, 800)
        wait(browser, "Math.abs(e.moment.time_s - 23.9) < 0.2 && e.agents.length === 8")
        wait(browser, "e.ghosts > 3 && e.score !== null")
        cycle = shown(browser, "moment")["cycle"]
        browser.press("ArrowRight")
        wait(browser, f"e.moment.cycle === {cycle} + 1")
        browser.press("l")
        wait(browser, "e.moment.cycle === 299")
        browser.screenshot(artifact("view-file.png"))
        assert browser.console() == []


def test_north_is_shown_where_it_is_known(browser: Browser) -> None:
    """Without a pose in a map, the map frame begins as the ego vehicle stood when it began."""

    def change(forecast: ForecastSet) -> ForecastSet:
        on_map = forecast.cycle % 40 >= 20
        mode, tile_id = (Mode.RUN, TILE_ID) if on_map else (Mode.NO_POSE, "")
        return replace(forecast, mode=mode, tile_id=tile_id)

    with Viewing() as viewing, sending(viewing, change):
        browser.open(viewing.address)
        wait(browser, "e.agents.length === 8")
        browser.press("n", "n")
        for north, words in (("false", "Not turning"), ("true", "North up")):
            wait(
                browser,
                f"e.north === {north} && document.getElementById('turn').innerText === '{words}'",
            )
            browser.screenshot(artifact(f"view-north-{north}.png"))
        assert browser.console() == []


def test_who_is_not_predicted_has_no_paths(browser: Browser) -> None:
    def change(forecast: ForecastSet) -> ForecastSet:
        forecast.velocity[:] = math.nan
        forecast.agent_mode[:] = Mode.PARTIAL
        forecast.trajectories[:] = forecast.position[:, None, None]
        return replace(forecast, covariances=None)

    with Viewing() as viewing, sending(viewing, change):
        browser.open(viewing.address)
        wait(browser, "e.agents.length === 8")
        browser.press("Enter")
        wait(browser, "e.selected !== null")
        panel = text(browser, "#selected")
        browser.screenshot(artifact("view-not-predicted.png"))
    assert "Not predicted: nothing tells how it moves." in panel
    assert "path 1" not in panel


def test_silence_lasts_and_can_be_stepped_through(browser: Browser) -> None:
    """The service repeats the time of its last measurement in it."""
    last: list[ForecastSet] = []

    def change(forecast: ForecastSet) -> ForecastSet:
        if forecast.cycle < 20:
            last[:] = [forecast]
            return forecast
        silent = replace(forecast, timestamp_s=last[0].timestamp_s, mode=Mode.SILENT)
        return silent.targets(slice(0))

    with Viewing() as viewing, sending(viewing, change):
        browser.open(viewing.address)
        wait(browser, "/earlier predictions are void, for [2-9] s/.test(e.words)")
        assert shown(browser, "agents") == []
        browser.press("p")
        wait(browser, "e.paused")
        cycle = shown(browser, "moment")["cycle"]
        browser.press("ArrowLeft", "ArrowLeft", "ArrowLeft")
        wait(browser, f"e.moment.cycle === {cycle - 3}")
        browser.press(*["ArrowLeft"] * (cycle - 3 - 19))
        wait(browser, "e.moment.cycle === 19 && e.agents.length === 8")


def test_another_source_at_the_same_address_is_looked_at_anew(
    browser: Browser, tmp_path: Path
) -> None:
    """JSON lines know no ego vehicle: the picture follows the traffic, wherever it is."""
    path = tmp_path / "replayed.jsonl"
    path.write_bytes(b"".join(json_lines(far_away(crowd(n, 8))) for n in range(200)))
    with Viewing() as viewing, sending(viewing):
        browser.open(viewing.address)
        wait(browser, "e.agents.length === 8")
        browser.press("Enter")
        wait(browser, "e.selected !== null")
        port = int(viewing.host.rpartition(":")[2])
    with Viewing(str(path), port=port):
        wait(browser, "e.connected && e.kept === 200 && e.agents.length === 8")
        wait(browser, "e.pixels.some(a => a.px > 0 && a.px < 1280 && a.py > 0 && a.py < 720)")
        assert shown(browser, "selected") is None


def far_away(forecast: ForecastSet) -> ForecastSet:
    away = np.array([40_000.0, -7_000.0])
    return replace(
        forecast,
        position=forecast.position + away,
        trajectories=forecast.trajectories + away,
    )


def test_a_file_of_several_starts_plays_through(browser: Browser, tmp_path: Path) -> None:
    """The second drive's clock is behind the first one's, as after a restart of the computer."""
    path = tmp_path / "drives.jsonl"
    drives = [(cycle, start_s) for start_s in (900.0, 30.0) for cycle in range(30)]
    lines = [json_lines(crowd(cycle, 8, start_s=start_s)) for cycle, start_s in drives]
    path.write_bytes(b"".join(lines))
    with Viewing(str(path)) as viewing:
        browser.open(viewing.address)
        wait(browser, "e.kept === 60 && e.moment && e.agents.length === 8")
        wait(browser, "document.getElementById('when').innerText.endsWith('of 0:06.8')")
        wait(browser, "e.paused && e.moment.cycle === 29 && e.moment.time_s > 904.5")
        browser.press(*["ArrowLeft"] * 40)
        wait(browser, "e.moment.cycle === 19 && e.moment.time_s < 904.0")
        browser.press("Enter")
        wait(browser, "e.selected !== null")
        browser.press(" ")
        wait(browser, "e.paused && e.moment.cycle === 29 && e.moment.time_s > 904.5")
        assert shown(browser, "selected") is None  # the second drive's numbers are others


def test_a_folder_of_drives_is_shown_with_what_ran_in_each(
    browser: Browser, tmp_path: Path
) -> None:
    """Real ones, with a map and without; the second was killed."""
    folder = tmp_path / "drives"
    for name in ("ngsim", "rav4"):
        with recorded_drive(name, folder, tmp_path / f"{name}.log", until=25) as (service, _):
            service.end(signal.SIGTERM if name == "ngsim" else signal.SIGKILL)
    what = "document.getElementById('what').innerText"
    with Viewing(str(folder)) as viewing:
        browser.open(viewing.address)
        wait(browser, "e.paused && e.lanes === 0 && e.agents.length > 2")  # played to its end
        wait(browser, f"/toyota-rav4.* no map/.test({what})")
        browser.press(*["ArrowLeft"] * 40)
        wait(browser, "e.lanes > 0 && e.agents.length > 10")
        wait(browser, f"/profile generic.* map ngsim.tile/.test({what})")
        browser.screenshot(artifact("view-folder.png"))
        browser.press(" ")
        wait(browser, f"e.paused && e.lanes === 0 && /toyota-rav4.* no map/.test({what})")
        assert browser.console() == []


def test_where_a_file_has_nothing_it_says_so(browser: Browser, tmp_path: Path) -> None:
    """JSON lines have none in silence, and nobody is said to be where he was long ago."""
    path = tmp_path / "gap.jsonl"
    cycles_ = [*range(10), *range(110, 120)]
    path.write_bytes(b"".join(json_lines(crowd(cycle, 8)) for cycle in cycles_))
    with Viewing(str(path)) as viewing:
        browser.open(viewing.address)
        wait(browser, "/^Nothing is recorded here, for [2-9] s/.test(e.words)")
        browser.screenshot(artifact("view-file-gap.png"))
        wait(browser, "e.moment.cycle >= 110 && e.words.startsWith('No map here')")


def test_dark_and_narrow(browser: Browser, ngsim: tuple[Viewing, Heard, Serving]) -> None:
    """Nothing is cut off sideways, and colours are those of the dark."""
    browser.emulate(prefers_color_scheme="dark")
    browser.open(ngsim[0].address)
    wait(browser, "e.agents.length > 5")
    for width, height, name in ((800, 1000, "view-dark-narrow"), (390, 844, "view-dark-phone")):
        browser.resize(width, height)
        wait(browser, f"innerWidth === {width}")
        browser.screenshot(artifact(f"{name}.png"))
        for element in ("document.documentElement", "document.getElementById('panels')"):
            assert browser.evaluate(f"return {element}.scrollWidth <= {element}.clientWidth")
        outside = "[...document.querySelectorAll('button, output, #scrub')].filter((part) => "
        outside += f"part.getBoundingClientRect().right > {width}).length"
        assert browser.evaluate(f"return {outside}") == 0
    shade = browser.evaluate("return getComputedStyle(document.body).backgroundColor")
    assert shade == "rgb(20, 24, 27)"
    browser.emulate(prefers_color_scheme="light")
    browser.resize(1280, 720)
    assert browser.console() == []
