"""Tile files in the car: loaded, described, and refused in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.core.errors import TileError
from eqrt.core.lanes import Lane, build_lane_map, middle_line
from eqrt.core.routes import RouteFinder
from eqrt.core.tile import TileInfo, encode
from eqrt.runtime.prediction.tiles import load_tile, save_tile

ROAD = np.array([[0.0, 0.0], [1000.0, 0.0]])
TILE = encode(
    build_lane_map([Lane(lane_id=5, centerline=middle_line(ROAD, ROAD))], "test"),
    TileInfo(name="straight", source="straight.osm", credit="drawn for this test"),
)


def test_a_saved_tile_loads_and_its_routes_are_found(tmp_path: Path) -> None:
    path = tmp_path / "straight.tile"
    save_tile(path, TILE)
    tile = load_tile(path)
    assert tile.info.name == "straight"
    assert tile.lane_map.lane_id.tolist() == [5]
    points, valid = RouteFinder(tile.lane_map).centerlines(np.array([500.0, 1.0]), None, 2, 3)
    assert points[0].tolist() == [[490.0, 0.0], [540.0, 0.0], [590.0, 0.0]]
    assert valid.tolist() == [[True] * 3, [False] * 3]


def test_saving_replaces_the_old_tile_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.tile"
    path.write_bytes(b"old")
    save_tile(path, TILE)
    assert path.read_bytes() == TILE
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.tile"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.skipif(sys.platform != "linux", reason="of links and devices as Linux has them")
def test_a_device_is_written_and_stays_what_it_is(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    nowhere.symlink_to("/dev/null")
    save_tile(nowhere, TILE)
    assert nowhere.is_symlink()
    assert nowhere.is_char_device()


def test_info_says_what_a_tile_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "straight.tile"
    save_tile(path, TILE)
    assert main(["tile", "info", str(path)]) == 0
    rows = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines())
    rows = {name: text.strip() for name, text in rows.items()}
    assert rows["tile"] == f"straight (id {load_tile(path).info.tile_id})"
    assert rows["lanes"] == "1, 1.00 km, 501 points, 0 connections"
    assert rows["extent"] == "x 0.0 to 1000.0 m, y 0.0 to 0.0 m"
    assert rows["origin"].startswith("not known")
    assert rows["speed limit"] == "known for 0% of lanes"
    assert rows["source"] == "straight.osm"
    assert rows["credit"] == "drawn for this test"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such tile file"),
        (b"", "not a tile"),
        (b"<?xml version='1.0'?><osm/>", "not a tile"),
        (TILE[:500], "cut short"),
        (TILE[:600] + b"?" + TILE[601:], "checksum is wrong"),
    ],
)
def test_a_file_that_is_no_tile_is_one_line_that_names_it(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    content: bytes | None,
    message: str,
) -> None:
    path = tmp_path / "wrong.tile"
    if content is not None:
        path.write_bytes(content)
    assert main(["tile", "info", str(path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"eqrt: {path}: ")
    assert message in line


def test_a_folder_or_a_giant_is_no_tile(tmp_path: Path) -> None:
    with pytest.raises(TileError, match="cannot be read"):
        load_tile(tmp_path)
    giant = tmp_path / "giant.tile"
    with giant.open("wb") as file:
        file.truncate(1 << 40)  # takes no room on disk
    with pytest.raises(TileError, match="too large for a tile"):
        load_tile(giant)


def test_a_wrong_action_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tile", "bild", "a"]) == 2
    assert "invalid choice: 'bild'" in capsys.readouterr().err


def test_where_only_the_runtime_is_installed_build_says_so(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['eqrt.export'] = None; from eqrt.cli import main; "
        "sys.exit(main(['tile', 'build', 'a.osm', '--out', 'x']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2
    assert done.stderr.startswith("eqrt: eqrt tile build needs 'eqrt.export")
    assert done.stderr.count("\n") == 1
