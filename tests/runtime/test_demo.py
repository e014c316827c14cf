"""`eqrt demo` as its user sees it: started anywhere, it plays, predicts, scores and draws."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from drives import first_seconds
from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.runtime.demo.command import PARTS, play_part
from processes import eqrt, files_of_at_most

LINE = re.compile(r"  +\d+ s  (RUN|LATE) +\d+ objects +\d+\.\d ms")
TABLE = re.compile(r"  (eqrt|constant velocity) +" + r" +".join([r"\d+\.\d\d"] * 6))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    """Seven seconds of the first part, from an empty directory."""
    folder = tmp_path_factory.mktemp("empty")
    done = eqrt("demo", "--part", "ngsim", "--seconds", "7", "--out", "pictures", cwd=folder)
    return done, folder


def test_the_demo_shows_predictions_against_what_happened(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    """A line a second, from the fourth or fifth on with errors; then the figures in a table."""
    done, _ = demo
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    seconds = [line for line in lines if LINE.match(line)]
    assert len(seconds) >= 4
    assert re.search(r"ADE 3 s +\d+\.\d\d m \(constant velocity +\d+\.\d\d\)", seconds[-1])
    first, second = [match for line in lines if (match := TABLE.fullmatch(line))]
    assert (first[1], second[1]) == ("eqrt", "constant velocity")
    heads = [line for line in lines if line.split()[:3] == ["time", "mode", "compute"]]
    assert lines.index(heads[0]) < lines.index(seconds[0])
    assert re.search(r"verdict +after 3 s, eqrt is \d+% (nearer to|farther from) ", done.stdout)
    assert lines[-1] == "next: with your own radar, docs/start-radar.md"
    scored = next(line for line in lines if "predictions scored" in line)
    assert int(scored.split()[0]) > 50


def test_the_demo_leaves_a_picture_and_nothing_else(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    done, folder = demo
    path = folder / "pictures" / "eqrt-demo-ngsim.svg"
    assert f"picture    {path.resolve()}" in done.stdout
    assert [found for found in folder.rglob("*") if found.is_file()] == [path]
    assert ElementTree.parse(path).getroot().tag.endswith("svg")


def test_a_demo_that_is_too_short_to_score_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--part", "rav4", "--seconds", "0.5", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "no prediction could be scored" in said
    assert "picture    none" in said


def test_the_recordings_of_the_demo_ship_with_it() -> None:
    for part in PARTS:
        assert part.log.is_file()
        assert part.tile is None or part.tile.is_file()


def test_pictures_that_cannot_be_written_are_known_before_the_minute(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main(["demo", "--out", str(tmp_path / "file")]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"eqrt: cannot write pictures to {tmp_path / 'file'} (")
    assert err.count("\n") == 1


def test_a_picture_that_does_not_fit_on_the_disk_is_not_begun(tmp_path: Path) -> None:
    part = next(part for part in PARTS if part.name == "ngsim")
    result = play_part(part, 7.0)
    with files_of_at_most(1 << 10), pytest.raises(EqrtError, match=r"a\.svg: cannot be written"):
        result.write_picture(tmp_path / "a.svg")
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_has_ended_is_said_to_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once, and no line about the silence after it."""
    log = tmp_path / "short.log"
    log.write_text(first_seconds(PARTS[0].log, 3.0))
    play_part(replace(PARTS[0], log=log), None)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "  (end of recording)"
    assert len([line for line in lines if LINE.match(line)]) >= 1
    assert not [line for line in lines if "SILENT" in line]
