"""`eqrt prepare`, as a user runs it: what comes out, and what a kill or a bad file leaves."""

from __future__ import annotations

import gzip
import json
import os
import resource
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from eqrt.cli import main
from eqrt.export.formats import FORMATS
from eqrt.training.claim import claimed
from eqrt.training.configuration import load_config
from eqrt.training.dataset import prepared
from eqrt.training.dataset.split import Split
from eqrt.training.dataset.store import open_data
from eqrt.training.recordings.formats import find_format
from packed_scenes import PackedScene, straight, write_packed
from processes import EQRT, environment
from source_tree import ROOT
from tiny_training import DATA, tiny, tiny_file
from window_samples import CONTRACT, NGSIM, OPTIONS, SCENARIO, assert_same, packed_scenes

Contents = dict[str, bytes]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact, as far as it matters here."""
    folder = tmp_path_factory.mktemp("model")
    (folder / "contract.json").write_text(CONTRACT.to_json())
    return folder


@pytest.fixture
def drives(tmp_path: Path) -> Path:
    """Five small scenarios."""
    folder = tmp_path / "drives"
    folder.mkdir()
    for number in range(5):
        shutil.copy(SCENARIO, folder / f"USA_Peach-{number}_8_T-1.xml.gz")
    return folder


@pytest.fixture
def whole(tmp_path: Path, drives: Path, model: Path) -> Contents:
    """What comes of them if nothing happens."""
    assert prepare(drives, tmp_path / "whole", model) == 0
    return contents(tmp_path / "whole")


def prepare(data: Path, out: Path, model: Path, *options: str) -> int:
    """In this process, unless `options` say otherwise."""
    jobs = () if "--jobs" in options or "--scheduler" in options else ("--jobs", "1")
    arguments = ["prepare", str(data), "--out", str(out), "--model", str(model)]
    return main([*arguments, "--stride", "10", *jobs, *options])


def contents(folder: Path) -> Contents:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_prepared_folder_holds_the_windows_of_the_raw_data(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert prepare(NGSIM, tmp_path / "out", model, "--seed", "5") == 0
    said = capsys.readouterr().out
    ready = open_data(tmp_path / "out", CONTRACT)
    settings = json.loads((tmp_path / "out/dataset.json").read_text())["settings"]
    raw = open_data(NGSIM, CONTRACT, options=OPTIONS, split=Split(seed=5))
    rows = np.arange(len(raw))
    assert_same(ready.gather(rows), raw.gather(rows))
    assert ready.recordings == raw.recordings
    assert settings["format"] == "commonroad"
    assert settings["path"] == str(NGSIM)
    train, val = len(ready.rows("train")), len(ready.rows("val"))
    assert f"\nwindows        {len(raw)}: {train} train, {val} val\n" in said
    assert "scenes/s\n" in said
    assert "peak memory" in said
    assert "licence" not in said  # it may be used commercially
    assert "\nlanes " not in said  # there are some


def test_data_without_a_map_says_so(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Argoverse's maps are a download of their own, and easily forgotten."""
    data = write_packed(tmp_path / "scenes.npz", [PackedScene([straight(10.0)])])
    assert prepare(data, tmp_path / "out", model) == 0
    assert "\nlanes          none: no map was found" in capsys.readouterr().out


def test_a_non_commercial_licence_is_printed(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = packed_scenes(tmp_path / "scenes.npz", scenes=3)
    assert prepare(data, tmp_path / "out", model) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("data licence: CC-BY-NC-SA-4.0, non-commercial; Argoverse 1")


def test_two_jobs_make_the_bytes_of_one(
    tmp_path: Path, drives: Path, model: Path, whole: Contents
) -> None:
    assert prepare(drives, tmp_path / "two", model, "--jobs", "2") == 0
    assert contents(tmp_path / "two") == whole


def test_a_dask_cluster_makes_the_same_bytes(
    tmp_path: Path, drives: Path, model: Path, whole: Contents
) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        assert prepare(drives, tmp_path / "dask", model, "--scheduler", address) == 0
    assert contents(tmp_path / "dask") == whole


def test_a_second_run_finds_all_done(
    tmp_path: Path, drives: Path, model: Path, whole: Contents, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert prepare(drives, tmp_path / "whole", model) == 0
    assert capsys.readouterr().out.startswith("already there")
    assert contents(tmp_path / "whole") == whole


@pytest.fixture
def killed(tmp_path: Path, drives: Path, model: Path) -> Path:
    """The folder of a run that was killed while it waited for the fourth scenario, a pipe."""
    pipe, out = drives / "USA_Peach-3_8_T-1.xml.gz", tmp_path / "out"
    pipe.unlink()
    os.mkfifo(pipe)
    command = ["prepare", str(drives), "--out", str(out), "--model", str(model)]
    command += ["--stride", "10", "--jobs", "1"]
    with (
        subprocess.Popen([*EQRT, *command], stdout=subprocess.DEVNULL, env=environment()) as run,
        pipe.open("wb"),  # returns when the run has opened the other end, to read
    ):
        run.send_signal(signal.SIGKILL)
        assert run.wait() == -signal.SIGKILL
    pipe.unlink()
    shutil.copy(SCENARIO, pipe)
    return out


def test_a_killed_run_leaves_whole_shards_and_says_that_it_is_unfinished(killed: Path) -> None:
    assert sorted(path.name for path in killed.glob("shard-*")) == [
        "shard-00000",
        "shard-00001",
        "shard-00002",
    ]
    assert len(list(killed.glob(".unfinished-*"))) == 1
    assert not (killed / "dataset.json").exists()


def test_a_killed_run_goes_on_where_it_was(
    killed: Path, drives: Path, model: Path, whole: Contents, capsys: pytest.CaptureFixture[str]
) -> None:
    """And in the end nothing tells that it was killed."""
    stamps = {path: path.stat().st_mtime_ns for path in killed.glob("shard-*/*")}
    capsys.readouterr()
    assert prepare(drives, killed, model) == 0
    assert "going on       3 of 5 shards are there" in capsys.readouterr().out
    assert contents(killed) == whole
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps  # not made again


def test_a_shard_that_the_disk_lost_is_made_again(
    killed: Path, drives: Path, model: Path, whole: Contents
) -> None:
    lost = killed / "shard-00001/windows.npy"
    lost.write_bytes(lost.read_bytes()[:5000])
    assert prepare(drives, killed, model) == 0
    assert contents(killed) == whole


def test_a_shard_that_a_finished_folder_lost_is_made_again(
    tmp_path: Path, drives: Path, model: Path, whole: Contents, capsys: pytest.CaptureFixture[str]
) -> None:
    """Who reads the folder is told to prepare it again."""
    out = tmp_path / "whole"
    shutil.rmtree(out / "shard-00001")
    lost = out / "shard-00003/provenance.npy"
    lost.write_bytes(lost.read_bytes()[:-8])
    capsys.readouterr()
    assert prepare(drives, out, model) == 0
    assert "going on       3 of 5 shards are there" in capsys.readouterr().out
    assert contents(out) == whole


def test_an_unfinished_folder_may_be_split_another_way(
    killed: Path, drives: Path, model: Path
) -> None:
    assert prepare(drives, killed, model, "--held-out", "1") == 0
    ready = open_data(killed, CONTRACT)
    assert len(ready.rows("val")) == len(ready)


@pytest.mark.parametrize(
    "case",
    [
        (["--targets", "complete"], "options.targets was all, now complete"),
        (["--seed", "1"], "split.seed was 0, now 1"),
        (["--license", "CC0-1.0"], "source.license was CC-BY-SA-4.0, now CC0-1.0"),
    ],
)
def test_other_settings_are_refused_and_named(
    drives: Path,
    model: Path,
    whole: Contents,
    case: tuple[list[str], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    options, told = case
    out = drives.parent / "whole"
    assert prepare(drives, out, model, *options) == 1
    assert told in capsys.readouterr().err
    assert contents(out) == whole


def test_files_that_came_since_are_noticed(
    tmp_path: Path,
    drives: Path,
    model: Path,
    whole: Contents,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copy(SCENARIO, drives / "USA_Peach-9_8_T-1.xml.gz")
    assert prepare(drives, tmp_path / "whole", model) == 1
    assert "parts was 5, sha256" in capsys.readouterr().err
    assert contents(tmp_path / "whole") == whole


def test_force_replaces_another_preparation_and_nothing_else(
    tmp_path: Path, drives: Path, model: Path, whole: Contents
) -> None:
    out = tmp_path / "whole"
    (out / "my notes.txt").write_text("keep")
    assert prepare(drives, out, model, "--targets", "complete", "--force") == 0
    assert open_data(out, CONTRACT).gather(np.arange(1)).future_valid.all()
    assert prepare(drives, out, model, "--force") == 0
    assert contents(out) == whole | {"my notes.txt": b"keep"}


def test_a_folder_of_something_else_is_not_touched(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.jpg").touch()
    for options in ([], ["--force"]):
        assert prepare(drives, tmp_path / "photos", model, *options) == 1
        assert "not empty, and not a prepared folder" in capsys.readouterr().err
    assert contents(tmp_path / "photos") == {"cat.jpg": b""}


def test_the_page_of_another_program_is_not_ours(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`dataset.json` and `shard-...` are names that others use, too."""
    theirs = tmp_path / "theirs"
    (theirs / "shard-00000").mkdir(parents=True)
    (theirs / "shard-00000/rows.bin").write_bytes(b"theirs")
    (theirs / "dataset.json").write_text('{"name": "theirs", "settings": {}}')
    before = contents(theirs)
    for options in ([], ["--force"]):
        assert prepare(drives, theirs, model, *options) == 1
        assert "not empty, and not a prepared folder" in capsys.readouterr().err
    assert contents(theirs) == before


def test_force_replaces_what_has_a_damaged_page(
    tmp_path: Path, drives: Path, model: Path, whole: Contents
) -> None:
    page = tmp_path / "whole/dataset.json"
    page.write_bytes(page.read_bytes()[:200])
    assert prepare(drives, tmp_path / "whole", model) == 1
    assert prepare(drives, tmp_path / "whole", model, "--force") == 0
    assert contents(tmp_path / "whole") == whole


def spoil(drives: Path, number: int) -> Path:
    """Cut a scenario short."""
    path = drives / f"USA_Peach-{number}_8_T-1.xml.gz"
    path.write_bytes(path.read_bytes()[:2000])
    return path


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_the_first_bad_file_ends_it_and_leaves_nothing_half_written(
    tmp_path: Path, drives: Path, model: Path, jobs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = spoil(drives, 0)
    assert prepare(drives, tmp_path / "out", model, "--jobs", jobs) == 1
    assert f"eqrt: {bad}: cannot be read" in capsys.readouterr().err
    left = contents(tmp_path / "out") if (tmp_path / "out").exists() else {}
    assert "dataset.json" not in left
    assert not [name for name in left if name.startswith(".")]
    if jobs == "1":  # it was the first of all
        assert not (tmp_path / "out").exists()


def test_a_repaired_file_lets_the_next_run_go_on(
    tmp_path: Path, drives: Path, model: Path, whole: Contents, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = spoil(drives, 2)
    assert prepare(drives, tmp_path / "out", model) == 1
    shutil.copy(SCENARIO, bad)
    capsys.readouterr()
    assert prepare(drives, tmp_path / "out", model) == 0
    assert "going on       2 of 5" in capsys.readouterr().out
    assert contents(tmp_path / "out") == whole


def test_keep_going_skips_counts_and_names_bad_files(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = [spoil(drives, 1), spoil(drives, 3)]
    text = gzip.decompress(SCENARIO.read_bytes())
    other_clock = drives / "USA_Peach-9_8_T-1.xml"
    other_clock.write_bytes(text.replace(b'timeStepSize="0.1"', b'timeStepSize="0.04"'))
    out = tmp_path / "out"
    assert prepare(drives, out, model, "--keep-going") == 0
    said = capsys.readouterr().out
    reasons = (out / "skipped.txt").read_text().splitlines()
    assert [reason.partition(": ")[0] for reason in reasons] == [
        str(bad[0]),
        str(bad[1]),
        "USA_Peach-9_8_T-1",
    ]
    assert f"skipped        3, all in {out / 'skipped.txt'}" in said
    assert all(reason in said for reason in reasons)
    ready = open_data(out, CONTRACT)
    assert [entry.name[:11] for entry in ready.recordings] == [f"USA_Peach-{n}" for n in (0, 2, 4)]
    assert set(ready.column("recording")) == {0, 1, 2}
    assert json.loads((out / "dataset.json").read_text())["totals"]["skipped"] == 3


def test_keep_going_skips_one_bad_scene_of_a_file_with_many(tmp_path: Path, model: Path) -> None:
    path = packed_scenes(tmp_path / "scenes.npz", scenes=40)
    with np.load(path) as file:
        arrays = dict(file)
    bad_track = arrays["scene_track_ptr"][17]
    arrays["track_xy"][arrays["track_pt_ptr"][bad_track]] = np.nan
    np.savez(path, **arrays)
    assert prepare(path, tmp_path / "out", model) == 1
    assert prepare(path, tmp_path / "out", model, "--keep-going") == 0
    names = [entry.name for entry in open_data(tmp_path / "out", CONTRACT).recordings]
    assert names == [str(number) for number in range(1, 41) if number != 18]
    assert "scene 18: " in (tmp_path / "out/skipped.txt").read_text()


def test_a_run_that_keeps_nothing_going_minds_what_an_earlier_one_skipped(
    tmp_path: Path, drives: Path, model: Path
) -> None:
    """The unfinished folder of a run with --keep-going hides no gap from one without."""
    spoil(drives, 1)
    out = tmp_path / "out"
    assert prepare(drives, out, model, "--keep-going") == 0
    page = json.loads((out / "dataset.json").read_text())
    (out / "unfinished.json").write_text(json.dumps(page | {"totals": None}))
    (out / "dataset.json").unlink()
    assert prepare(drives, out, model) == 1
    assert prepare(drives, out, model, "--keep-going") == 0


def test_a_full_disk_is_said_and_leaves_nothing_half_written(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        assert prepare(NGSIM, tmp_path / "out", model) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "shard-00000: cannot be written (File too large)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_another_run_works_on_is_left_to_it(
    tmp_path: Path, drives: Path, model: Path, whole: Contents, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    half_written = out / ".unfinished-shard-00003-of-the-other"
    with claimed(out):
        half_written.mkdir()
        assert prepare(drives, out, model) == 1
        assert f"{out}: another process is writing to it" in capsys.readouterr().err
        assert half_written.is_dir()
        half_written.rmdir()
        prepared.begin(out, prepared.read_dataset(tmp_path / "whole")[0], force=False)
        assert prepare(drives, out, model, "--force") == 1
    assert prepare(drives, out, model) == 0
    assert contents(out) == whole


def test_data_without_a_window_leaves_nothing(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert prepare(drives, tmp_path / "out", model, "--targets", "focal") == 1
    assert "no window in 5 recordings (targets focal" in capsys.readouterr().err
    assert prepare(drives, tmp_path / "out", model) == 0


def test_a_split_with_an_empty_side_is_said(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert prepare(drives, tmp_path / "out", model, "--held-out", "0") == 0
    assert "one side of the split is empty; as --held-out has it" in capsys.readouterr().out


def test_named_groups_are_held_out(
    tmp_path: Path, drives: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A name that is nowhere is an error, which the next run need not pay for again."""
    names = tmp_path / "held_out.txt"
    names.write_text("# by name, by group\nUSA_Peach-0_8_T-1\n\nUSA_Peach-4\nUSA_Peach-7\n")
    out = tmp_path / "out"
    assert prepare(drives, out, model, "--held-out-groups", str(names)) == 1
    assert "held out is 'USA_Peach-7'" in capsys.readouterr().err
    names.write_text("USA_Peach-0_8_T-1\nUSA_Peach-4\n")
    assert prepare(drives, out, model, "--held-out-groups", str(names)) == 0
    assert "going on       5 of 5" in capsys.readouterr().out
    sides = [entry.split for entry in open_data(out, CONTRACT).recordings]
    assert sides == ["val", "train", "train", "train", "val"]


@pytest.mark.parametrize(
    ("options", "held_out"),
    [
        ([], ["USA_Peach-2_1_T-1"]),
        (["--seed", "0", "--held-out", "0"], []),
        (["--held-out-groups", "names.txt"], ["USA_Peach-4_8_T-1"]),
    ],
)
def test_what_the_configuration_holds_out_is_held_out_unless_an_option_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], held_out: list[str]
) -> None:
    """So `eqrt eval --split val` measures on what is not trained on."""
    monkeypatch.chdir(tmp_path)
    Path("names.txt").write_text("USA_Peach-4")
    Path("data").mkdir()
    for scenario in DATA:
        shutil.copy(scenario, "data")
    config = tiny_file(tmp_path, ('["USA_Peach-2"]', '["USA_Peach-2", "of-another-dataset"]'))
    words = ["prepare", "data", "--out", "out", "--config", str(config), "--jobs", "1"]
    assert main([*words, *options]) == 0
    store = open_data(Path("out"), tiny().model.scene.contract("tiny", "0.0.0"))
    assert [entry.name for entry in store.recordings if entry.split == "val"] == held_out


def test_a_dataset_of_which_the_configuration_holds_nothing_out_is_all_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["prepare", str(DATA[0]), "--out", str(tmp_path / "out"), "--jobs", "1"]
    assert main([*words, "--config", str(tiny_file(tmp_path))]) == 0
    said = capsys.readouterr().out
    assert "recordings     1: 1 train, 0 val" in said
    assert "one side of the split is empty; as the configuration's held_out has it" in said


def test_a_can_log_is_prepared_through_the_service(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--stride counts the service's predictions then; licence and credits are the owner's."""
    log = ROOT / "tests/data/can/ars408/candump.log.gz"
    out = tmp_path / "out"
    owner = ["--license", "CC-BY-NC-4.0", "--credits", "Our fleet"]
    assert prepare(log, out, model, "--profile", "ars408", "--stationary", *owner) == 0
    assert "data licence: CC-BY-NC-4.0, non-commercial; Our fleet" in capsys.readouterr().out
    settings = json.loads((out / "dataset.json").read_text())["settings"]
    assert settings["format"] == "can"
    assert settings["reader"]["stride"] == "10"
    ready = open_data(out, CONTRACT)
    assert {entry.group for entry in ready.recordings} == {"candump.log.gz"}
    assert (ready.column("step") == CONTRACT.history_steps - 1).all()


def test_a_profile_that_was_edited_since_makes_other_windows(
    tmp_path: Path,
    model: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of a profile's file, its contents count, and not from where it was named."""
    log, out, profile = tmp_path / "drive.log", tmp_path / "out", tmp_path / "mine.toml"
    whole = gzip.decompress((ROOT / "tests/data/can/ars408/candump.log.gz").read_bytes())
    log.write_bytes(b"".join(whole.splitlines(keepends=True)[:2500]))
    text = (ROOT / "runtime/eqrt/runtime/decoding/profiles/ars408.toml").read_text()
    profile.write_text(text)
    monkeypatch.chdir(tmp_path)
    assert prepare(log, out, model, "--stationary", "--profile", "mine.toml") == 0
    monkeypatch.chdir("/")
    assert prepare(log, out, model, "--stationary", "--profile", str(profile)) == 0
    assert "already there" in capsys.readouterr().out
    assert "x_m = 0.0, y_m = 0.0" in text
    profile.write_text(text.replace("x_m = 0.0, y_m = 0.0", "x_m = 3.5, y_m = 0.0"))
    assert prepare(log, out, model, "--stationary", "--profile", str(profile)) == 1
    assert "prepared with other settings (reader was" in capsys.readouterr().err
    assert prepare(log, out, model, "--stationary", "--profile", str(profile), "--force") == 0
    seldom = ("--stride", "100000")
    assert prepare(log, tmp_path / "none", model, "--stationary", "--profile", "ars408", *seldom)
    assert "(targets all, stride 100000)" in capsys.readouterr().err


def test_a_training_configuration_says_for_which_model(tmp_path: Path) -> None:
    config = min((ROOT / "training/configs").glob("*.toml"))
    command = ["prepare", str(SCENARIO), "--out", str(tmp_path / "out"), "--stride", "20"]
    command += ["--targets", "all", "--jobs", "1", "--config", str(config)]
    assert main(command) == 0
    scene = load_config(config).model.scene
    assert len(open_data(tmp_path / "out", scene.contract("x", "0.0.0")))


@pytest.mark.parametrize(
    "case",
    [
        (["--format", "csv"], 2, "there is no format 'csv'; the formats are recording, argoverse1"),
        (["--maps", "maps"], 2, "--maps means nothing for the format commonroad; leave it out"),
        (["--format", "can"], 2, "CAN logs need --profile"),
        (["--stride", "0"], 2, "'0' is not a number of steps (1 or more)"),
        (["--held-out", "20"], 2, "'20' is not a share (0 to 1)"),
        (["--held-out-groups", "nowhere"], 2, "nowhere: cannot be read"),
    ],
)
def test_a_wrong_option_is_said_in_one_line(
    tmp_path: Path,
    drives: Path,
    model: Path,
    case: tuple[list[str], int, str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    options, status, told = case
    assert prepare(drives, tmp_path / "out", model, *options) == status
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_model_that_is_none_is_said(
    tmp_path: Path, drives: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert prepare(drives, tmp_path / "out", drives) == 1
    assert "give --model the folder of an artifact" in capsys.readouterr().err
    assert prepare(tmp_path / "nowhere", tmp_path / "out", tmp_path) == 1


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("1.csv", "argoverse1"),
        ("a/scenario_a.parquet", "argoverse2"),
        ("x.xml.gz", "commonroad"),
        ("x.recording.npz", "recording"),
        ("2024/05/drive.log.gz", "can"),
        ("drive.BLF", "can"),
    ],
)
def test_the_format_of_a_folder_is_told_by_its_files(tmp_path: Path, file: str, name: str) -> None:
    path = tmp_path / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    assert find_format(tmp_path, None, FORMATS).name == name


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("scenes.npz", "argoverse1-packed"),
        ("x.recording.npz", "recording"),
        ("1.csv", "argoverse1"),
        ("x.xml", "commonroad"),
        ("drive.asc", "can"),
        ("DRIVE.BLF", "can"),
    ],
)
def test_the_format_of_a_file_is_told_by_its_name(tmp_path: Path, file: str, name: str) -> None:
    (tmp_path / file).touch()
    assert find_format(tmp_path / file, None, FORMATS).name == name
