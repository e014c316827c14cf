"""Packed Argoverse 1 scenes as recordings, and files that are not what they should be."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eqrt.core.errors import LogError
from eqrt.training.recordings.argoverse1_packed import PackedArgoverse1Reader
from eqrt.training.recordings.recording import Recording
from packed_scenes import NOW, ORIGIN_M, PackedScene, straight, write_packed

READER = PackedArgoverse1Reader()


def recordings(path: Path) -> list[Recording]:
    return [recording for part in READER.parts(path) for recording in READER.read(part)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    late = straight(5.0)
    late[:12] = np.nan
    lanes = [
        np.array([[-20.0, 0.0], [10.0, 0.0]]),
        np.array([[10.3, 0.0], [40.0, 5.0]]),  # begins 0.3 m from the first one's end
        np.array([[11.0, 0.0], [40.0, -5.0]]),  # 1 m from it
    ]
    scenes = [PackedScene([straight(10.0), late], lanes), PackedScene([straight(3.0)])]
    return write_packed(tmp_path / "scenes.npz", scenes)


def test_a_scene_lies_where_its_city_has_it(path: Path) -> None:
    first, second = recordings(path)
    assert (first.name, first.group, second.name) == ("1", "1", "2")
    np.testing.assert_allclose(first.tracks.positions[0, NOW], ORIGIN_M)
    np.testing.assert_allclose(first.tracks.positions[0, NOW + 10], np.add(ORIGIN_M, (10.0, 0.0)))
    assert first.tracks.valid[1].tolist() == [False] * 12 + [True] * 38
    assert not np.isfinite(first.tracks.heading_rad).any()


def test_the_first_track_is_the_target_and_now_is_the_twentieth_step(path: Path) -> None:
    first, _ = recordings(path)
    assert first.focal.tolist() == [True, False]
    assert first.now_steps == (NOW,)
    assert first.track_ids == ("AGENT", "AV")
    assert READER.source.non_commercial


def test_lanes_follow_each_other_where_ends_meet(path: Path) -> None:
    first, second = recordings(path)
    assert first.lanes is not None
    assert first.lanes.successors_of(0).tolist() == [1]
    assert first.lanes.successors_of(1).tolist() == []
    np.testing.assert_allclose(first.lanes.lane_points(0)[0], np.add(ORIGIN_M, (-20.0, 0.0)))
    assert second.lanes is None


def changed(path: Path, **arrays: Any) -> Path:
    with np.load(path) as file:
        content = {name: file[name] for name in file.files} | arrays
    np.savez(path, **{name: array for name, array in content.items() if array is not None})
    return path


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"track_xy": None}, "no array track_xy"),
        ({"track_pt_ptr": np.array([0, 50, 40, 138])}, "track_pt_ptr does not rise"),
        ({"orig": np.zeros((1, 2))}, "orig has another length"),
        ({"seq_id": np.array(["a", "b"])}, "seq_id is <U1"),
        ({"track_step": np.full(138, 77)}, "scene 1: a step of track 0 is not within 0 to 49"),
        ({"track_xy": np.full((138, 2), np.nan)}, "scene 1: a position is not a number"),
        ({"scene_track_ptr": np.array([0, 0, 3])}, "scene 1: no tracks"),
        ({"orig": np.zeros((2, 3))}, "orig is float64 of shape (2, 3), expected numbers of shape"),
        ({"track_xy": np.zeros((138, 3))}, "track_xy is float64 of shape (138, 3)"),
        ({"seq_id": np.int64(1)}, "seq_id is int64 of shape ()"),
        ({"track_step": np.zeros(138, np.int16)}, "scene 1: track 0 is seen twice at one step"),
        ({"lane_xy": np.full((6, 2), np.nan)}, "scene 1: a point of a lane is not a number"),
    ],
)
def test_a_damaged_file_is_refused_with_its_name_and_the_reason(
    path: Path, arrays: dict[str, Any], said: str
) -> None:
    with pytest.raises(LogError) as refused:
        recordings(changed(path, **arrays))
    assert said in str(refused.value)
    assert str(refused.value).startswith(str(path))


@pytest.mark.parametrize("size", [0, 100, 2000])
def test_half_a_file_is_refused(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(LogError, match="not a readable"):
        recordings(path)


def test_damaged_compression_is_refused(path: Path) -> None:
    with np.load(path) as file:
        content = {name: file[name] for name in file.files}
    np.savez_compressed(path, **content)
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        begin = archive.getinfo("track_xy.npy").header_offset + 30 + len("track_xy.npy") + 20
    data[begin : begin + 8] = 8 * b"\xff"
    path.write_bytes(data)
    with pytest.raises(LogError, match="not a readable"):
        recordings(path)


def test_a_single_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "array.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(LogError, match=r"not a readable \.npz file \(it holds a single array"):
        recordings(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        recordings(tmp_path / "nothing.npz")
