"""How PlotJuggler 3 reads what we give it: names of series, and its files of layouts."""

from __future__ import annotations

import contextlib
import math
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from processes import PATIENCE_S


def series(content: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """The series that PlotJuggler makes of a message, MessagePack or JSON, on topic `path` (a UDP
    server has none): one of every number, named after the keys and places that lead to it.
    """
    if isinstance(content, dict):
        for key, value in content.items():
            yield from series(value, f"{path}/{key}")
    elif isinstance(content, list):
        for place, value in enumerate(content):
            yield from series(value, f"{path}[{place}]")
    elif isinstance(content, int | float):
        assert math.isfinite(content), path
        yield path, content


def curves(layout: Path) -> set[str]:
    """The series that a layout shows; fails if PlotJuggler could not divide its window so."""
    root = ElementTree.parse(layout).getroot()
    assert (root.tag, root.get("version")) == ("root", "2.3.8")  # else it warns, or refuses
    for container in root.iter("Container"):
        assert [child.tag for child in container] == ["DockSplitter"]
    for splitter in root.iter("DockSplitter"):
        sizes = [float(size) for size in splitter.get("sizes", "").split(";")]
        assert splitter.get("orientation") in {"|", "-"}
        assert {child.tag for child in splitter} <= {"DockSplitter", "DockArea"}
        assert int(splitter.get("count", "")) == len(splitter) == len(sizes)
        assert math.isclose(sum(sizes), 1.0, abs_tol=1e-3)
    return {name for plot in root.iter("plot") for name in _curves_of(plot)}


def _curves_of(plot: ElementTree.Element) -> Iterator[str]:
    for curve in plot.iter("curve"):
        assert re.fullmatch(r"#[0-9a-f]{6}", curve.get("color", ""))
        names = ("curve_x", "curve_y") if plot.get("mode") == "XYPlot" else ("name",)
        yield from (curve.attrib[name] for name in names)


@contextlib.contextmanager
def plotjuggler_server() -> Iterator[tuple[socket.socket, str]]:
    """Where PlotJuggler would listen: a socket, and its address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(PATIENCE_S)
        yield server, f"127.0.0.1:{server.getsockname()[1]}"
