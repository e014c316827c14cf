"""Recordings as files: what is written is read, a map is stored once, bad files are refused."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eqrt.core.errors import LogError
from eqrt.core.lanes import Lane, LaneMap, build_lane_map
from eqrt.training.recordings.recording import Recording, Source, TrackGrid
from eqrt.training.recordings.recording_file import (
    RecordingFileReader,
    load_recording,
    save_recording,
)

SOURCE = Source(name="drawn", credits="drawn by hand", license="CC0-1.0", non_commercial=False)


def road(length_m: float = 50.0) -> LaneMap:
    lines = [np.array([(700.0, y), (700.0 + length_m, y)]) for y in (0.0, 3.5)]
    lanes = [Lane(lane_id=i, centerline=line, left=i + 1) for i, line in enumerate(lines)]
    return build_lane_map(lanes, "drawn")


def drive(lanes: LaneMap | None, name: str = "drive") -> Recording:
    """Three tracks, one of them never seen, 80 km from the map's origin."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(-3.0, 3.0, (3, 40))
    heading[0, :5] = np.nan
    valid = rng.random((3, 40)) < 0.7
    valid[2] = False
    return Recording(
        name=name,
        group="morning",
        dt_s=0.1,
        tracks=TrackGrid(80_000.0 + rng.uniform(-100.0, 100.0, (3, 40, 2)), heading, valid),
        track_ids=("7", "äpfel", "x"),
        may_be_target=np.array([True, False, True]),
        focal=np.array([False, True, False]),
        now_steps=(19, 25),
        lanes=lanes,
    )


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.recording.npz"
    written = drive(road())
    save_recording(path, written, SOURCE)
    read, source = load_recording(path)
    assert source == SOURCE
    for name in ("name", "group", "dt_s", "track_ids", "now_steps"):
        assert getattr(read, name) == getattr(written, name)
    for name in ("may_be_target", "focal"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    seen = written.tracks.valid
    np.testing.assert_array_equal(read.tracks.valid, seen)
    np.testing.assert_allclose(read.tracks.positions[seen], written.tracks.positions[seen], 0, 1e-5)
    np.testing.assert_allclose(
        read.tracks.heading_rad[seen], written.tracks.heading_rad[seen], 0, 1e-6
    )
    assert np.isnan(read.tracks.heading_rad[~seen]).all()


def test_what_was_not_seen_is_not_written(tmp_path: Path) -> None:
    recording = drive(road())
    recording.tracks.positions[~recording.tracks.valid] = np.nan
    save_recording(tmp_path / "a.recording.npz", recording, SOURCE)
    read, _ = load_recording(tmp_path / "a.recording.npz")
    assert np.isfinite(read.tracks.positions).all()


def test_a_recording_without_map_or_tracks_survives(tmp_path: Path) -> None:
    nobody = dataclasses.replace(
        drive(None),
        tracks=TrackGrid.empty(0, 12),
        track_ids=(),
        may_be_target=np.zeros(0, np.bool_),
        focal=np.zeros(0, np.bool_),
        now_steps=None,
    )
    save_recording(tmp_path / "a.recording.npz", nobody, SOURCE)
    read, _ = load_recording(tmp_path / "a.recording.npz")
    assert read.lanes is None
    assert read.now_steps is None
    assert read.tracks.valid.shape == (0, 12)


def test_recordings_on_one_map_share_it_on_disk_and_in_memory(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_recording(tmp_path / f"{name}.recording.npz", drive(road(), name), SOURCE)
    save_recording(tmp_path / "c.recording.npz", drive(road(80.0), "c"), SOURCE)
    assert len(list(tmp_path.glob("*.tile"))) == 2
    reader = RecordingFileReader.open(tmp_path)
    a, b, c = (next(iter(reader.read(part))) for part in reader.parts(tmp_path))
    assert a.lanes is b.lanes
    assert a.lanes is not c.lanes
    assert a.lanes is not None
    for field in dataclasses.fields(LaneMap):
        found, expected = getattr(a.lanes, field.name), getattr(road(), field.name)
        np.testing.assert_array_equal(found, expected)


def test_the_same_recording_gives_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        path = tmp_path / f"{name}.recording.npz"
        save_recording(path, drive(road()), SOURCE)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


def test_a_reader_crosses_processes_and_reads_one_file_too(tmp_path: Path) -> None:
    path = tmp_path / "a.recording.npz"
    save_recording(path, drive(road()), SOURCE)
    reader = pickle.loads(pickle.dumps(RecordingFileReader.open(path)))
    assert reader.source == SOURCE
    [part] = reader.parts(path)
    assert [recording.name for recording in reader.read(part)] == ["drive"]


def test_recordings_of_different_sources_are_not_mixed(tmp_path: Path) -> None:
    save_recording(tmp_path / "a.recording.npz", drive(None), SOURCE)
    other = dataclasses.replace(SOURCE, non_commercial=True)
    save_recording(tmp_path / "b.recording.npz", drive(None, "b"), other)
    with pytest.raises(LogError, match=r"b\.recording\.npz: its source .*non_commercial: True"):
        RecordingFileReader.open(tmp_path)
    reader = RecordingFileReader(SOURCE)
    with pytest.raises(LogError, match="different folders"):
        list(reader.read(reader.parts(tmp_path)[1]))


def test_nothing_is_left_of_a_recording_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"ends with \.recording\.npz"):
        save_recording(tmp_path / "a.npz", drive(None), SOURCE)
    with pytest.raises(LogError, match="cannot write"):
        save_recording(tmp_path / "nowhere" / "a.recording.npz", drive(None), SOURCE)
    (tmp_path / "a.recording.npz").mkdir()
    with pytest.raises(LogError, match="cannot write"):
        save_recording(tmp_path / "a.recording.npz", drive(None), SOURCE)
    assert [path.name for path in tmp_path.iterdir()] == ["a.recording.npz"]


def test_an_empty_folder_and_a_missing_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"no recordings .*eqrt simulate"):
        RecordingFileReader.open(tmp_path)
    with pytest.raises(LogError, match=r"gone\.recording\.npz: no such recording"):
        load_recording(tmp_path / "gone.recording.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY not really"])
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.recording.npz"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"a\.recording\.npz: not a whole recording"):
        load_recording(path)


def test_any_cut_and_any_flipped_byte_is_refused_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "a.recording.npz"
    save_recording(path, drive(None), SOURCE)
    whole = path.read_bytes()
    for at in range(0, len(whole), 29):
        path.write_bytes(whole[:at])
        with pytest.raises(LogError):
            load_recording(path)
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            read, _ = load_recording(path)
        except LogError:
            continue
        assert np.isfinite(read.tracks.positions).all()


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    path = tmp_path / "a.recording.npz"
    with path.open("wb") as stream:
        np.savez(stream, texts=np.array([{"version": 1}], object))
    with pytest.raises(LogError, match="not a whole recording"):
        load_recording(path)


def rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> None:
    """Change the arrays and texts of a recording's file."""
    with np.load(path) as archive:
        arrays = dict(archive)
    texts = json.loads(arrays.pop("texts").tobytes())
    change(texts, arrays)
    texts_array = np.frombuffer(json.dumps(texts).encode(), np.uint8)
    with path.open("wb") as stream:
        np.savez(stream, texts=texts_array, **arrays)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda texts, _: texts.update(version=2), "version 2, this eqrt reads 1"),
        (lambda texts, _: texts.pop("group"), "lack group"),
        (lambda texts, _: texts["source"].pop("license"), "source is incomplete"),
        (lambda texts, _: texts.update(dt_s=0.0), "time step"),
        (lambda texts, _: texts.update(dt_s="fast"), "time step"),
        (lambda texts, _: texts.update(name=3), "not texts"),
        (lambda texts, _: texts.update(track_ids=["7", "7", "x"]), "track ids"),
        (lambda texts, _: texts.update(track_ids=["7"]), "track ids"),
        (lambda texts, _: texts.update(now_steps=[40]), "called now"),
        (lambda texts, _: texts.update(tile="../secret.tile"), "not a file's name"),
        (lambda texts, _: texts.update(tile="gone.tile"), "gone.tile: the recording's map"),
        (lambda _, arrays: arrays.pop("focal"), "focal"),
        (lambda _, arrays: arrays.update(focal=np.ones(2, np.bool_)), "flags"),
        (lambda _, arrays: arrays.update(focal=np.ones(3)), "focal is float64"),
        (lambda _, arrays: arrays.update(offsets=arrays["offsets"][1:]), "positions do not match"),
        (lambda _, arrays: arrays.update(headings=arrays["headings"][1:]), "headings do not match"),
        (lambda _, arrays: arrays["offsets"].fill(np.nan), "not finite"),
        (lambda _, arrays: arrays["headings"].fill(np.inf), "infinite"),
        (lambda _, arrays: arrays["origin"].fill(np.nan), "origin"),
    ],
)
def test_a_wrong_part_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None], reason: str
) -> None:
    path = tmp_path / "a.recording.npz"
    save_recording(path, drive(None), SOURCE)
    rewrite(path, change)
    with pytest.raises(LogError, match=reason):
        load_recording(path)


def test_a_damaged_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.recording.npz"
    save_recording(path, drive(road()), SOURCE)
    [tile] = tmp_path.glob("*.tile")
    tile.write_bytes(tile.read_bytes()[:-1])
    with pytest.raises(LogError, match=r"\.tile: the tile is cut short"):
        load_recording(path)
