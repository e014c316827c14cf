"""The picture of a moment: well-formed, and everything in it that its key promises."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from drives import DRIVES, TILE, shipped_predictor
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.demo.picture import WIDTH_PX, Moment, render
from eqrt.runtime.demo.score import Scoreboard
from eqrt.runtime.demo.snapshots import BestMoment
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.replay import replay

SVG = "{http://www.w3.org/2000/svg}"
LABELS = (
    "history, 2 s",
    "what happened, 3 s",
    "constant velocity, 3 s",
    "eqrt's prediction, 3 s",
    "ego",
    "N",
    "20 m",
)


def line(*points: tuple[float, float]) -> NDArray[np.float64]:
    return np.array(points, np.float64)


def one_car() -> Moment:
    """100 m of road to the east; a car on it, and the ego 40 m behind."""
    moment = Moment(title="1 agent & <mode>", ego=np.array([0.0, 0.0]))
    moment.lanes.append(line((0.0, 0.0), (100.0, 0.0)))
    moment.lines["history"].append(line((20.0, 0.0), (40.0, 0.0)))
    moment.lines["truth"].append(line((40.0, 0.0), (80.0, 0.0)))
    moment.lines["predicted"].append(line((40.0, 0.0), (78.0, 1.0)))
    moment.lines["constant velocity"].append(line((40.0, 0.0), (70.0, 0.0)))
    moment.agents.append(np.array([40.0, 0.0]))
    return moment


def drawn(moment: Moment) -> ElementTree.Element:
    return ElementTree.fromstring(render(moment))


def texts(picture: ElementTree.Element) -> list[str]:
    return [element.text or "" for element in picture.iter(f"{SVG}text")]


def pixels(picture: ElementTree.Element) -> NDArray[np.float64]:
    """Every point of every line."""
    points = " ".join(e.attrib["points"] for e in picture.iter(f"{SVG}polyline"))
    return np.array([pair.split(",") for pair in points.split()], np.float64)


def test_a_picture_is_xml_with_a_line_for_everything() -> None:
    """Two for the lane, its surface and its middle."""
    picture = drawn(one_car())
    assert picture.tag == f"{SVG}svg"
    assert len(list(picture.iter(f"{SVG}polyline"))) == 4 + 2
    circles = [c.attrib["fill"] for c in picture.iter(f"{SVG}circle")]
    # The ends of two predictions, the car, the ego, and the ego in the key.
    assert circles == ["#333333", "#d55e00", "#333333", "#009e73", "#009e73"]


def test_titles_and_labels_are_text() -> None:
    assert texts(drawn(one_car())) == ["1 agent & <mode>", *LABELS]


def test_what_is_not_drawn_is_not_in_the_key() -> None:
    moment = one_car()
    moment.lines["constant velocity"].clear()
    moment.ego = None
    assert texts(drawn(moment))[1:] == [*LABELS[:2], LABELS[3], *LABELS[5:]]


def test_a_metre_is_a_metre_in_both_directions() -> None:
    """The scale bar is as long as 20 m of the road, which has a corner."""
    moment = Moment(title="")
    moment.lines["truth"].append(line((0.0, 0.0), (20.0, 0.0), (20.0, 20.0)))
    picture = drawn(moment)
    start, corner, end = pixels(picture)
    bar = next(picture.iter(f"{SVG}path")).attrib["d"]
    left, right = (float(number) for number in re.findall(r"[MH]([\d.]+)", bar))
    for side in (corner - start, end - corner):
        assert np.hypot(*side) == pytest.approx(right - left, abs=0.2)


@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, 1.0), (-0.6, -0.8)])
def test_traffic_goes_to_the_right_and_left_is_up(way: tuple[float, float]) -> None:
    """Whatever the road's course, and the arrow points north."""
    along = np.array(way)
    left = np.array([-along[1], along[0]])
    moment = Moment(title="")
    moment.lines["truth"].append(np.array([0.0 * along, 100.0 * along]))
    moment.lines["truth"].append(np.array([5.0 * left, 40.0 * along + 5.0 * left]))
    picture = drawn(moment)
    start, end, left_start, _ = pixels(picture)
    assert end[0] - start[0] == pytest.approx(1152.0, rel=0.02)  # the picture's width
    assert abs(end[1] - start[1]) < 40.0
    assert left_start[1] < start[1] - 30.0
    tip, *corners = (
        np.array(corner.split(","), np.float64)
        for corner in next(picture.iter(f"{SVG}polygon")).attrib["points"].split()
    )
    arrow = tip - np.mean(corners, axis=0)
    north = np.array([along[1], -along[0]])  # in pixels, y down
    assert arrow @ north == pytest.approx(np.hypot(*arrow), rel=0.01)


def test_where_north_is_not_known_no_arrow_points_there() -> None:
    """Without a pose in a map, y is only where the car looked when it began."""
    moment = Moment(title="", is_north_known=False)
    moment.lines["truth"].append(np.array([(0.0, 0.0), (100.0, 0.0)]))
    assert not list(drawn(moment).iter(f"{SVG}polygon"))
    assert "N" not in [text.text for text in drawn(moment).iter(f"{SVG}text")]


@pytest.mark.parametrize("far_m", [0.0, 30.0, 3000.0])
def test_everything_but_lanes_is_inside_the_picture(far_m: float) -> None:
    """Also when somebody is far away, or all stand on one point."""
    moment = one_car()
    moment.lanes.clear()
    moment.agents.append(np.array([far_m, -far_m]))
    moment.lines["truth"].append(line((far_m, -far_m), (far_m, -far_m)))
    picture = drawn(moment)
    width, height = float(picture.attrib["width"]), float(picture.attrib["height"])
    points = pixels(picture)
    assert width == WIDTH_PX
    assert (points >= 0.0).all()
    assert (points[:, 0] <= width).all()
    assert (points[:, 1] <= height).all()


def test_nothing_to_draw_is_an_error_of_the_caller() -> None:
    with pytest.raises(ValueError, match="nothing to draw"):
        render(Moment(title="empty", lanes=[line((0.0, 0.0), (1.0, 0.0))]))


def test_a_stream_without_a_scored_prediction_has_no_picture() -> None:
    assert BestMoment().picture(None) is None


def test_the_best_moment_of_a_drive_shows_who_moved() -> None:
    """From ten seconds of NGSIM: every line of an agent starts where the agent is."""
    log = read_log(DRIVES["ngsim"].log)
    messages = []
    for message in log:
        messages.append(message)
        if message.timestamp > messages[0].timestamp + 6.0:
            break
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(TILE))
    board, best = Scoreboard(), BestMoment()
    for forecast in replay(pipeline, messages):
        best.add(forecast, board.add(forecast))
    moment = best.picture(load_tile(TILE))
    assert moment is not None
    assert len(moment.agents) >= 10
    assert moment.lanes
    assert moment.is_north_known
    without = best.picture(None)
    assert without is not None
    assert not without.is_north_known
    for name in ("truth", "predicted", "constant velocity"):
        starts = np.array([path[0] for path in moment.lines[name]])
        np.testing.assert_allclose(starts, moment.agents)
    for history, agent in zip(moment.lines["history"], moment.agents, strict=True):
        np.testing.assert_allclose(history[-1], agent)
    moved_m = [float(np.linalg.norm(path[-1] - path[0])) for path in moment.lines["truth"]]
    assert np.median(moved_m) > 10.0
    assert moment.title.startswith(f"{len(moment.agents)} agents")
    assert len(list(drawn(moment).iter(f"{SVG}polyline"))) > 4 * len(moment.agents)
