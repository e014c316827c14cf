"""`eqrt replay-fleet`: every log as `eqrt replay` does it, and only once."""

from __future__ import annotations

import argparse
import gzip
import json
import os
from pathlib import Path

import pytest

from drives import DRIVES, first_seconds
from eqrt.core.errors import EqrtError, LogError, ProfileError, UsageError
from eqrt.export import replay_fleet
from eqrt.runtime import replay

NGSIM = DRIVES["ngsim"]
LOGS = ("monday/a.log", "monday/b.log.gz", "c.log")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three logs of different lengths."""
    folder = tmp_path / "logs"
    for seconds, name in enumerate(LOGS, start=1):
        text = first_seconds(NGSIM.log, seconds / 2).encode()
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    (folder / "readme.txt").write_text("no log")
    return folder


def run(folder: Path, out: Path, *options: str) -> int:
    parser = argparse.ArgumentParser()
    replay_fleet.add_arguments(parser)
    one_job = [] if "--jobs" in options else ["--jobs", "1"]
    arguments = [str(folder), "--out", str(out), *NGSIM.options, *one_job, *options]
    return replay_fleet.run(parser.parse_args(arguments))


def replay_alone(log: Path, out: Path) -> bytes:
    parser = argparse.ArgumentParser()
    replay.add_arguments(parser)
    assert replay.run(parser.parse_args([str(log), "--out", str(out), *NGSIM.options])) == 0
    return out.read_bytes()


def files_in(out: Path) -> list[str]:
    return sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file())


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_each_log_gets_what_replay_writes(jobs: str, folder: Path, tmp_path: Path) -> None:
    """Byte by byte, under its own name, in however many processes."""
    out = tmp_path / "out"
    assert run(folder, out, "--jobs", jobs) == 0
    assert files_in(out) == sorted(f"{log}.{kind}" for log in LOGS for kind in ("json", "jsonl"))
    for log in LOGS:
        alone = replay_alone(folder / log, tmp_path / "alone.jsonl")
        assert (out / f"{log}.jsonl").read_bytes() == alone
        assert alone


def test_the_table_counts_what_is_in_the_files(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(folder, out) == 0
    head, *rows, total = capsys.readouterr().out.splitlines()
    assert head.split() == ["messages", "cycles", "predictions", "fallbacks", "unusable"]
    table = {row.split()[-1]: [int(cell) for cell in row.split()[:5]] for row in rows}
    assert sorted(table) == sorted(LOGS)
    for log, (_, cycles, predictions, _, unusable) in table.items():
        lines = (out / f"{log}.jsonl").read_text().splitlines()
        assert predictions == len(lines) > 0
        assert cycles >= len({json.loads(line)["cycle"] for line in lines}) > 0
        assert unusable == 0
    sums = [sum(column) for column in zip(*table.values(), strict=True)]
    assert total.split() == [*map(str, sums), "3", "logs,", "0", "failed"]


def test_what_is_whole_is_not_done_again(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor counted differently; a file whose page is missing was not whole."""
    out = tmp_path / "out"
    assert run(folder, out) == 0
    first = capsys.readouterr().out
    old = {name: (out / name).read_bytes() for name in files_in(out)}
    for name in old:
        os.utime(out / name, ns=(0, 0))
    (out / "c.log.json").unlink()
    (out / "c.log.jsonl").write_text("half a li")
    assert run(folder, out) == 0
    assert capsys.readouterr().out == first
    assert {name: (out / name).read_bytes() for name in files_in(out)} == old
    done_again = {name for name in old if (out / name).stat().st_mtime_ns}
    assert done_again == {"c.log.json", "c.log.jsonl"}


def test_another_tile_or_a_longer_log_is_done_again(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(folder, out) == 0
    before = {log: (out / f"{log}.jsonl").read_bytes() for log in LOGS}
    (folder / "c.log").write_text(first_seconds(NGSIM.log, 2.0))
    assert run(folder, out) == 0
    after = {log: (out / f"{log}.jsonl").read_bytes() for log in LOGS}
    assert [log for log in LOGS if after[log] != before[log]] == ["c.log"]
    parser = argparse.ArgumentParser()
    replay_fleet.add_arguments(parser)
    without_tile = [str(folder), "--out", str(out), "--profile", "generic", "--jobs", "1"]
    assert replay_fleet.run(parser.parse_args(without_tile)) == 0
    assert all((out / f"{log}.jsonl").read_bytes() != after[log] for log in LOGS)


def test_a_bad_log_stops_all_or_is_counted(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It leaves nothing behind, and the others are there."""
    (folder / "monday/a.log").write_text("no message here\n")
    with pytest.raises(LogError, match=r"a\.log: there is no CAN message in it"):
        run(folder, tmp_path / "stopped")
    assert run(folder, tmp_path / "out", "--keep-going") == 0
    printed = capsys.readouterr()
    assert "a.log: there is no CAN message in it" in printed.err
    assert printed.out.splitlines()[-1].endswith("  2 logs, 1 failed")
    good = sorted(f"{log}.{kind}" for log in LOGS[1:] for kind in ("json", "jsonl"))
    assert files_in(tmp_path / "out") == good


def test_a_log_that_ends_in_a_line_says_so_in_its_row(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (folder / "c.log").read_text()
    (folder / "c.log").write_text(text[: len(text) // 2 + 5])
    assert run(folder, tmp_path / "out") == 0
    rows = capsys.readouterr().out.splitlines()
    assert ["ends in the middle of line" in row for row in rows].count(True) == 1


def test_what_no_log_could_be_replayed_with_is_said_at_once(folder: Path, tmp_path: Path) -> None:
    """Not once per log, and --keep-going does not go on."""
    for options, error in (
        (("--profile", "radar-of-tomorrow"), ProfileError),
        (("--can", "lidar=can0"), UsageError),
    ):
        with pytest.raises(error):
            run(folder, tmp_path / "out", "--keep-going", *options)
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written_is_one_line(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(EqrtError, match=r"cannot write into .*; give --out a folder"):
        run(folder, tmp_path / "out")


def test_a_log_without_predictions_counts_as_failed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of another sensor: the reason is said, and nothing is left that looks done."""
    (folder / "other.log").write_text(first_seconds(DRIVES["ars408"].log, 1.0))
    assert run(folder, tmp_path / "out", "--keep-going") == 0
    out, err = capsys.readouterr()
    assert "other.log: no predictions: none of the " in err
    assert out.splitlines()[-1].endswith(f"{len(LOGS)} logs, 1 failed")
    assert not [name for name in files_in(tmp_path / "out") if name.startswith("other")]
    with pytest.raises(LogError, match="no predictions"):
        run(folder, tmp_path / "out")
