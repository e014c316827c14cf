"""Shards: what is read is what was written, and a shard is whole or not there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eqrt.core.errors import EqrtError
from eqrt.training.dataset.shards import (
    PROVENANCE,
    Shard,
    ShardWriter,
    layout,
    open_shard,
    shard_folder,
)
from eqrt.training.dataset.windows import TENSORS, Windows, join, no_windows
from processes import files_of_at_most
from window_samples import CONTRACT, assert_same, scenario_windows


@pytest.fixture(scope="module")
def windows() -> Windows:
    return scenario_windows()


def write(folder: Path, *recordings: Windows) -> Shard:
    with ShardWriter(folder, 3, CONTRACT) as writer:
        for number, windows in enumerate(recordings):
            writer.add(f"drive {number}", "group", windows)
        writer.finish()
    return open_shard(shard_folder(folder, 3), CONTRACT)


def read(shard: Shard) -> Windows:
    rows = shard.windows().view(layout(CONTRACT, TENSORS))[:, 0]
    provenance = shard.provenance()
    return Windows(
        **{name: rows[name] for name in TENSORS}, **{n: provenance[n] for n in PROVENANCE}
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_windows_come_back_as_they_were_written(tmp_path: Path, windows: Windows) -> None:
    second = scenario_windows(number=1)
    shard = write(tmp_path, windows, second)
    assert_same(read(shard), join([windows, second]))
    assert [entry.name for entry in shard.index.recordings] == ["drive 0", "drive 1"]


def test_a_column_can_be_read_with_numpy_alone(tmp_path: Path, windows: Windows) -> None:
    shard = write(tmp_path, windows)
    future = np.load(shard.folder / "windows.npy", mmap_mode="r")["future"]
    np.testing.assert_array_equal(future, windows.future)


def test_the_same_windows_are_the_same_bytes(tmp_path: Path, windows: Windows) -> None:
    write(tmp_path / "one", windows)
    write(tmp_path / "other", windows)
    assert contents(tmp_path / "one") == contents(tmp_path / "other")


def test_what_is_skipped_is_noted(tmp_path: Path, windows: Windows) -> None:
    with ShardWriter(tmp_path, 0, CONTRACT) as writer:
        writer.skip("a.csv: no rows")
        writer.add("drive", "group", windows)
        index = writer.finish()
    assert index.skipped == ("a.csv: no rows",)
    assert open_shard(shard_folder(tmp_path, 0), CONTRACT).index == index


def test_a_shard_may_hold_no_window(tmp_path: Path) -> None:
    shard = write(tmp_path, no_windows(CONTRACT))
    assert len(shard.windows()) == len(shard.provenance()) == 0
    assert len(shard.index.recordings) == 1


def test_an_error_on_the_way_leaves_nothing(tmp_path: Path, windows: Windows) -> None:
    def fail_midway() -> None:
        with ShardWriter(tmp_path, 3, CONTRACT) as writer:
            writer.add("drive", "group", windows)
            raise EqrtError("the next recording cannot be read")

    with pytest.raises(EqrtError, match="the next recording"):
        fail_midway()
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_said_and_leaves_nothing(tmp_path: Path, windows: Windows) -> None:
    with (
        files_of_at_most(100_000),
        pytest.raises(EqrtError, match=r"shard-00003: cannot be written \(File too large\)"),
    ):
        write(tmp_path, *[windows] * 20)
    assert not list(tmp_path.iterdir())


def test_a_shard_that_is_not_whole_is_refused(tmp_path: Path, windows: Windows) -> None:
    """Whichever of its files was cut short, or is not there."""
    for file in ("windows.npy", "provenance.npy", "recordings.json"):
        for keep in (0.0, 0.001, 0.5, 0.999, None):
            path = write(tmp_path, windows).folder / file
            if keep is None:
                path.unlink()
            else:
                path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
            with pytest.raises(EqrtError, match="shard-00003: not a whole shard"):
                open_shard(path.parent, CONTRACT)


def test_a_damaged_shard_is_replaced(tmp_path: Path, windows: Windows) -> None:
    folder = write(tmp_path, windows).folder
    (folder / "windows.npy").write_bytes(b"")
    assert_same(read(write(tmp_path, windows)), windows)


def test_a_shard_of_another_geometry_is_refused(tmp_path: Path, windows: Windows) -> None:
    folder = write(tmp_path, windows).folder
    with pytest.raises(EqrtError, match="does not hold the"):
        open_shard(folder, replace(CONTRACT, num_agents=5))
