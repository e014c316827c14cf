"""Opened datasets: rows come as they were cut, from wherever they lie, and only where they fit."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.dataset import prepared, store
from eqrt.training.dataset.pieces import Counts, RawData, ShardCutter, plan
from eqrt.training.dataset.prepared import Geometry, Settings
from eqrt.training.dataset.split import Split
from eqrt.training.dataset.store import WindowStore, join_sources, license_notice, open_data
from eqrt.training.dataset.windows import WindowCutter, WindowOptions, Windows, join
from eqrt.training.recordings.commonroad_recordings import NGSIM as NGSIM_SOURCE
from eqrt.training.recordings.formats import FORMATS, ReaderOptions
from packed_scenes import PackedScene, straight, write_packed
from window_samples import CONTRACT, OPTIONS, ROOMY, SCENARIO, assert_same, packed_scenes
from window_samples import NGSIM as NGSIM_FOLDER

WINDOW_OPTIONS = WindowOptions()


def raw_data(path: Path, contract: ModelContract, options: WindowOptions) -> RawData:
    return RawData.open(
        path,
        contract,
        options,
        formats=FORMATS,
        format_name=None,
        reader_options=ReaderOptions(),
    )


def prepare(data: RawData, folder: Path, *, finish: bool = True) -> Path:
    """What `eqrt prepare` does, in a few lines."""
    parts = data.reader.parts(data.path)
    settings = Settings(
        path=str(data.path),
        format=data.format,
        reader={},
        source=data.reader.source,
        geometry=Geometry.of(data.contract),
        options=data.options,
        split=Split(),
        parts=prepared.fingerprint(parts),
    )
    prepared.begin(folder, settings, force=False)
    pieces, counts = plan(parts), Counts()
    for piece in pieces:
        counts += ShardCutter(data=data, folder=folder, keep_going=False)(piece)
    if finish:
        prepared.finish(folder, settings, len(pieces), counts)
    return folder


def cut(data: RawData) -> Windows:
    """All windows of a dataset, recording by recording."""
    cutter = WindowCutter(data.contract, data.options)
    recordings = (r for part in data.reader.parts(data.path) for r in data.reader.read(part))
    return join([cutter.cut(recording, number) for number, recording in enumerate(recordings)])


@pytest.fixture(scope="module")
def packed_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed_scenes(tmp_path_factory.mktemp("somewhere") / "scenes.of.mine.npz")


@pytest.fixture(scope="module")
def ngsim(tmp_path_factory: pytest.TempPathFactory) -> tuple[WindowStore, Windows]:
    """NGSIM prepared, and the windows that should be in there."""
    data = raw_data(NGSIM_FOLDER, CONTRACT, OPTIONS)
    folder = prepare(data, tmp_path_factory.mktemp("ngsim") / "prepared")
    return open_data(folder, CONTRACT), cut(data)


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory, packed_file: Path) -> Path:
    """Scenes prepared for more agents and lanes than most tests ask for."""
    data = raw_data(packed_file, ROOMY, WINDOW_OPTIONS)
    return prepare(data, tmp_path_factory.mktemp("packed") / "prepared")


def some_rows(count: int, of: int, seed: int = 0) -> NDArray[np.intp]:
    return np.random.default_rng(seed).integers(0, of, count)


def test_rows_come_as_they_were_cut(ngsim: tuple[WindowStore, Windows]) -> None:
    """In any order, twice if asked for twice, from all nine shards."""
    opened, expected = ngsim
    rows = some_rows(500, len(expected))
    assert len(opened) == len(expected)
    assert len(np.unique(expected.recording[rows])) == 9
    assert len(np.unique(rows)) < len(rows)
    assert_same(opened.gather(rows), expected.select(rows))
    assert_same(opened.gather(rows[:1]), expected.select(rows[:1]))
    assert_same(opened.gather(rows[:0]), expected.select(rows[:0]))


def test_a_gathered_batch_is_the_callers_own(ngsim: tuple[WindowStore, Windows]) -> None:
    opened, expected = ngsim
    rows = np.arange(10)
    opened.gather(rows).future[:] = 0.0
    assert_same(opened.gather(rows), expected.select(rows))


def test_threads_share_a_store(ngsim: tuple[WindowStore, Windows]) -> None:
    opened, expected = ngsim
    wanted = [some_rows(64, len(expected), seed) for seed in range(40)]
    with ThreadPoolExecutor(4) as threads:
        for rows, windows in zip(wanted, threads.map(opened.gather, wanted), strict=True):
            assert_same(windows, expected.select(rows))


def test_there_may_be_more_shards_than_open_files(
    packed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = some_rows(200, len(open_data(packed, CONTRACT)))
    expected = open_data(packed, CONTRACT).gather(rows)
    monkeypatch.setattr(store, "MAX_OPEN_SHARDS", 1)
    assert len(list(packed.glob("shard-*"))) > 1
    assert_same(open_data(packed, CONTRACT).gather(rows), expected)


def test_a_row_that_is_not_there_is_a_mistake(ngsim: tuple[WindowStore, Windows]) -> None:
    opened, _ = ngsim
    for row in (-1, len(opened)):
        with pytest.raises(IndexError):
            opened.gather(np.array([row]))


def test_columns_say_where_windows_are_from(ngsim: tuple[WindowStore, Windows]) -> None:
    opened, expected = ngsim
    for name in ("recording", "agent", "step", "focal", "origin"):
        np.testing.assert_array_equal(opened.column(name), getattr(expected, name))
    names = [entry.name for entry in opened.recordings]
    assert names == sorted(names)
    assert opened.recordings[8].group == "USA_US101-5"


def test_every_row_is_on_one_side_and_a_group_on_the_same(
    ngsim: tuple[WindowStore, Windows],
) -> None:
    opened = ngsim[0].split_by(Split(held_out=("USA_US101-22_4_T-1", "USA_Lanker-2")))
    train, val = opened.rows("train"), opened.rows("val")
    assert sorted([*train, *val]) == list(range(len(opened)))
    held_out = {opened.recordings[number].name for number in opened.column("recording")[val]}
    assert held_out == {"USA_US101-22_4_T-1", "USA_US101-21_2_T-1", "USA_Lanker-2_23_T-1"}
    assert len(opened.rows()) == len(opened)
    with pytest.raises(ValueError, match="'test', expected one of"):
        opened.rows("test")


@pytest.mark.parametrize("lane_choice", ["routes", "nearest"])
@pytest.mark.parametrize("name", ["ngsim", "packed"])
def test_the_first_of_many_agents_and_lanes_are_those_of_few(
    tmp_path: Path, packed_file: Path, name: str, lane_choice: str
) -> None:
    """So one prepared folder serves every model that reads no more: nothing differs by a bit."""
    path = packed_file if name == "packed" else NGSIM_FOLDER
    few, many = (replace(contract, lane_choice=lane_choice) for contract in (CONTRACT, ROOMY))
    options = replace(OPTIONS, stride=20 if name == "ngsim" else None)
    folder = prepare(raw_data(path, many, options), tmp_path / "prepared")
    expected = cut(raw_data(path, few, options))
    assert_same(open_data(folder, few).gather(np.arange(len(expected))), expected)
    assert expected.centerlines_valid[:, -1].any()
    assert expected.history_valid[:, -1].any()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"num_agents": 8}, r"num_agents 7 \(the model's is 8\)"),
        ({"num_centerlines": 7}, r"num_centerlines 6 \(the model's is 7\)"),
        ({"history_steps": 10}, r"history_steps 20 \(the model's is 10\)"),
        ({"horizon_steps": 20}, r"horizon_steps 30 \(the model's is 20\)"),
        ({"centerline_points": 9}, r"centerline_points 8 \(the model's is 9\)"),
        ({"lane_choice": "nearest"}, r"lane_choice routes \(the model's is nearest\)"),
        ({"dt_s": 0.2}, r"dt_s 0\.1 \(the model's is 0\.2\)"),
    ],
)
def test_what_does_not_fit_the_model_is_named(
    packed: Path, change: dict[str, Any], told: str
) -> None:
    with pytest.raises(EqrtError, match=told):
        open_data(packed, replace(CONTRACT, **change))


def test_the_number_of_modes_does_not_matter(packed: Path) -> None:
    opened = open_data(packed, replace(CONTRACT, num_modes=6, name="other", version="2.0.0"))
    assert opened.contract.num_modes == 6


def test_other_windows_than_were_prepared_are_refused(packed: Path) -> None:
    assert len(open_data(packed, CONTRACT, options=WINDOW_OPTIONS))
    with pytest.raises(EqrtError, match="targets all, stride None, asked for are targets focal"):
        open_data(packed, CONTRACT, options=WindowOptions(targets="focal"))


def test_the_split_may_be_another_when_opening(packed: Path) -> None:
    entries = open_data(packed, CONTRACT).recordings
    assert {entry.split for entry in entries} == {"train", "val"}
    everything = open_data(packed, CONTRACT, split=Split(held_out_share=1.0))
    assert len(everything.rows("val")) == len(everything)


def test_a_packed_file_anywhere_is_cut_as_it_was_prepared(packed_file: Path, packed: Path) -> None:
    raw, from_disk = open_data(packed_file, CONTRACT), open_data(packed, CONTRACT)
    rows = np.arange(len(raw))
    assert_same(raw.gather(rows), from_disk.gather(rows))
    assert raw.recordings == from_disk.recordings
    assert raw.source == from_disk.source
    assert raw.column("focal").sum() == 70  # the target of each


def test_windows_of_a_raw_dataset_are_chosen_by_the_options(packed_file: Path) -> None:
    focal = open_data(packed_file, CONTRACT, options=WindowOptions(targets="focal"))
    assert len(focal) == 70
    assert focal.column("focal").all()


def test_datasets_are_joined(ngsim: tuple[WindowStore, Windows], packed: Path) -> None:
    """Rows and recordings count on; each stays split as it was; licences add up."""
    one, other = ngsim[0], open_data(packed, CONTRACT)
    both = WindowStore.concat([one, other])
    rows = np.array([len(one) + 5, 3, len(one) - 1, len(one), 3])
    expected = join([one.gather(rows[[1, 2]]), other.gather(np.array([5, 0]))])
    expected.recording[2:] += len(one.recordings)
    assert_same(both.gather(rows), expected.select(np.array([2, 0, 1, 3, 0])))
    assert both.recordings == one.recordings + other.recordings
    val = [*one.rows("val"), *(len(one) + other.rows("val"))]
    np.testing.assert_array_equal(both.rows("val"), val)
    assert both.source.license == "CC-BY-SA-4.0 AND CC-BY-NC-SA-4.0"
    assert both.source.non_commercial
    assert one.source.credits in both.source.credits
    assert other.source.credits in both.source.credits


def test_a_dataset_joined_with_itself_names_its_source_once() -> None:
    assert join_sources([NGSIM_SOURCE, NGSIM_SOURCE]) == NGSIM_SOURCE


def test_datasets_for_different_models_cannot_be_joined(packed: Path) -> None:
    with pytest.raises(ValueError, match="different contracts"):
        WindowStore.concat([open_data(packed, CONTRACT), open_data(packed, ROOMY)])


def test_a_non_commercial_licence_is_told(packed: Path) -> None:
    notice = license_notice(open_data(packed, CONTRACT).source)
    assert notice is not None
    assert notice.startswith("data licence: CC-BY-NC-SA-4.0, non-commercial; Argoverse 1")
    assert license_notice(NGSIM_SOURCE) is None


def test_a_wrong_path_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match=r"nowhere: no such file or folder; expected recorded"):
        open_data(tmp_path / "nowhere", CONTRACT)
    (tmp_path / "notes.txt").touch()
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(EqrtError, match=r"expected .*commonroad: CommonRoad scenarios"):
            open_data(path, CONTRACT)
    with pytest.raises(UsageError, match="no format 'csv'; the formats are recording, argoverse1"):
        open_data(tmp_path, CONTRACT, format_name="csv")


def test_an_option_that_means_nothing_is_said(packed_file: Path) -> None:
    with pytest.raises(UsageError, match="--maps means nothing for the format argoverse1-packed"):
        open_data(packed_file, CONTRACT, reader_options=ReaderOptions(maps=Path("maps")))


def test_a_bad_recording_ends_it(tmp_path: Path) -> None:
    for name in ("a.xml", "b.xml.gz"):
        (tmp_path / name).write_bytes(SCENARIO.read_bytes()[:1000])
    with pytest.raises(EqrtError, match=r"a\.xml: cannot be read"):
        open_data(tmp_path, CONTRACT)


def test_data_without_a_window_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match=r"no window in 9 recordings .* names no targets: try all"):
        open_data(NGSIM_FOLDER, CONTRACT, options=WindowOptions(targets="focal", stride=50))
    parked = drives(tmp_path / "parked.npz", 0.0, 0.0)
    with pytest.raises(EqrtError, match="no window in 2 recordings"):
        open_data(parked, CONTRACT, options=WindowOptions(targets="complete"))


def test_what_is_too_much_for_the_memory_is_to_be_prepared(
    packed_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "MAX_IN_MEMORY_BYTES", 100e3)
    with pytest.raises(EqrtError, match="make a prepared folder of it with `eqrt prepare`"):
        open_data(packed_file, CONTRACT)


def test_an_unfinished_folder_is_not_opened(tmp_path: Path, packed_file: Path) -> None:
    data = raw_data(packed_file, CONTRACT, WINDOW_OPTIONS)
    folder = prepare(data, tmp_path / "prepared", finish=False)
    with pytest.raises(EqrtError, match="cut short here; run the same command again"):
        open_data(folder, CONTRACT)


def drives(path: Path, *speeds_mps: float) -> Path:
    """A scene for each, of one car."""
    return write_packed(path, [PackedScene([straight(speed)]) for speed in speeds_mps])


def test_the_checksum_tells_data_apart_and_not_where_it_lies(tmp_path: Path) -> None:
    """As many windows of the same names from the same places: what they hold differs."""
    one = drives(tmp_path / "one.npz", 10.0, 12.0)
    folder = prepare(raw_data(one, CONTRACT, WINDOW_OPTIONS), tmp_path / "prepared")
    raw, ready = (open_data(p, CONTRACT, options=WINDOW_OPTIONS) for p in (one, folder))
    assert raw.checksum() == ready.checksum()
    other = open_data(drives(tmp_path / "other.npz", 10.0, 13.0), CONTRACT, options=WINDOW_OPTIONS)
    assert len(other) == len(raw)
    assert other.checksum() != raw.checksum()


def test_the_checksum_tells_recordings_by_their_names(tmp_path: Path) -> None:
    sums = set()
    for name in ("USA_Peach-4_8_T-1", "USA_Peach-5_8_T-1"):
        path = tmp_path / f"{name}.xml.gz"
        shutil.copy(SCENARIO, path)
        sums.add(open_data(path, CONTRACT, options=WINDOW_OPTIONS).checksum())
    assert len(sums) == 2


def test_a_page_of_another_version_or_damaged_is_refused(tmp_path: Path, packed_file: Path) -> None:
    data = raw_data(packed_file, CONTRACT, WINDOW_OPTIONS)
    page = prepare(data, tmp_path / "prepared") / "dataset.json"
    text = page.read_text()
    for wrong, told in (
        (text.replace('"schema": 1', '"schema": 2'), "schema 2, this version of eqrt reads 1"),
        (text.replace('"num_agents": 4', '"num_agents": "four"'), "Expected `int`, got `str`"),
        (text[:100], r"dataset\.json: not what `eqrt prepare` writes"),
    ):
        page.write_text(wrong)
        with pytest.raises(EqrtError, match=told):
            open_data(page.parent, CONTRACT)


def test_a_missing_shard_is_named(tmp_path: Path, packed_file: Path) -> None:
    folder = prepare(raw_data(packed_file, CONTRACT, WINDOW_OPTIONS), tmp_path / "prepared")
    (folder / "shard-00001").rename(folder / "elsewhere")
    with pytest.raises(EqrtError, match="shard-00001: not a whole shard"):
        open_data(folder, CONTRACT)
