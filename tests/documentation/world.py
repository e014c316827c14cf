"""What a reader has before typing: a checkout, and files under the names that our pages use.

Small real ones stand for large ones: two NGSIM recordings for the dataset, three hand-made scenes
for Argoverse, 20 s of an ARS408 for a drive.
"""

from __future__ import annotations

import gzip
import os
import re
import shutil
from pathlib import Path

import numpy as np

from drives import first_seconds
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.training.recordings.commonroad_recordings import CommonRoadReader
from eqrt.training.recordings.recording_file import save_recording
from packed_scenes import PackedScene, straight, write_packed
from processes import PATIENCE_S, Serving, playing
from source_tree import ROOT

_LINKED = ("runtime", "export", "constraints.txt", "pyproject.toml")
_RECORDINGS = ("USA_Peach-4_8_T-1.xml.gz", "USA_Peach-2_1_T-1.xml.gz")
_HELD_OUT = ["USA_Peach-2"]
_CONFIGS = ROOT / "training/configs"
_DEMO_TILE = ROOT / "runtime/eqrt/runtime/demo/data/ngsim.tile"
_LOG_LINES = 3_500


def build(folder: Path) -> Path:
    """Everything that can be had without a training."""
    for name in _LINKED:
        (folder / name).symlink_to(ROOT / name)
    (folder / "docs").mkdir()
    _write_deploy(folder / "deploy")
    _write_configs(folder / "training/configs")
    _write_recordings(folder)
    _write_drive(folder)
    _write_profile(folder)
    _write_maps(folder)
    for name in ("ARTIFACT", "DIR", "A"):
        (folder / name).symlink_to(DEFAULT_ARTIFACT)
    (folder / "B").symlink_to(ROOT / "deploy/models/eqrt-small-6")
    return folder


def record(folder: Path) -> Path:
    """Two seconds of a drive as a service records them; the file."""
    channel = f"docs-recorded-{os.getpid()}"
    log = folder.with_suffix(".log")
    log.write_text(first_seconds(ROOT / "tests/data/can/ars408/candump.log.gz", 2.0))
    on = ["--can", channel, "--can-interface", LOCAL, "--profile", "ars408"]
    with Serving(*on, "--record", str(folder)) as service:
        with playing(log, "--can", channel) as player:
            assert player.wait(PATIENCE_S) == 0
        status, _, errors = service.end()
        assert status == 0, errors
    (file,) = folder.glob("*.mcap")
    return file


def _write_deploy(folder: Path) -> None:
    """Ours, but for the budgets: a p99 takes minutes, one target's median takes two seconds."""
    folder.mkdir()
    for path in (ROOT / "deploy").iterdir():
        (folder / path.name).symlink_to(path)
    (folder / "budgets.toml").unlink()
    text = (ROOT / "deploy/budgets.toml").read_text(encoding="utf-8")
    duty, *tables = re.split(r"^(?=\[)", text, flags=re.MULTILINE)
    kept = [t for t in tables if re.match(r"\[(targets|service\.objects)\.1\]", t)]
    medians = [re.sub(r"^p99_ms.*\n", "", table, flags=re.MULTILINE) for table in kept]
    assert len(medians) == 2
    (folder / "budgets.toml").write_text("".join([duty, *medians]), encoding="utf-8")


def _write_configs(folder: Path) -> None:
    """Ours, but for what is held out: those recordings are not all here; and for the batches."""
    for path in _CONFIGS.rglob("*.toml"):
        text = path.read_text(encoding="utf-8")
        text = re.sub(r"^held_out = .*$", f"held_out = {_HELD_OUT!r}", text, flags=re.MULTILINE)
        text = re.sub(r"^epochs = .*$", "steps = 2", text, flags=re.MULTILINE)
        text = re.sub(r"^batch_size = .*$", "batch_size = 16", text, flags=re.MULTILINE)
        copy = folder / path.relative_to(_CONFIGS)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(text, encoding="utf-8")


def _write_recordings(folder: Path) -> None:
    for name in ("NGSIM_FOLDER", "DATA", "tests/data/ngsim", "bologna"):
        (folder / name).mkdir(parents=True)
        for recording in _RECORDINGS:
            (folder / name / recording).symlink_to(ROOT / "tests/data/ngsim" / recording)
    (folder / "tests/data/can").symlink_to(ROOT / "tests/data/can")
    lane = np.array([[-60.0, 0.0], [0.0, 0.5], [120.0, 0.0]])
    scenes = [
        PackedScene([straight(4.0 + i), straight(8.0)[:, ::-1] + 3.0], [lane]) for i in range(12)
    ]
    write_packed(folder / "train.npz", scenes)
    _write_sequences(folder / "argoverse1")
    shutil.copy(folder / "train.npz", folder / "argoverse1/train.npz")
    _write_fleet(folder / "fleet")


def _write_sequences(folder: Path) -> None:
    """Argoverse 1's official form, one target that drives straight on."""
    folder.mkdir()
    for number in range(12):
        lines = ["TIMESTAMP,TRACK_ID,OBJECT_TYPE,X,Y,CITY_NAME"]
        for step in range(50):
            lines.append(f"{step / 10},000-0,AV,{1000 + step}.0,2000.0,PIT")
            lines.append(f"{step / 10},000-7,AGENT,{1010 + (1 + number / 4) * step},2004.0,PIT")
        (folder / f"{number}.csv").write_text("\n".join(lines) + "\n")


def _write_fleet(folder: Path) -> None:
    """What `eqrt simulate` writes, of recorded traffic."""
    folder.mkdir()
    reader = CommonRoadReader()
    for name in _RECORDINGS:
        for part in reader.parts(ROOT / "tests/data/ngsim" / name):
            for recording in reader.read(part):
                save_recording(folder / f"{recording.name}.recording.npz", recording, reader.source)


def _write_drive(folder: Path) -> None:
    with gzip.open(ROOT / "tests/data/can/ars408/candump.log.gz", "rt") as log:
        (folder / "drive.log").write_text("".join(log.readlines()[:_LOG_LINES]))


def _write_profile(folder: Path) -> None:
    """What the reader of docs/radar-ins-map.md saves."""
    page = (ROOT / "docs/radar-ins-map.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"Save this as.*?^```toml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    (folder / "radar-ins.toml").write_text(block, encoding="utf-8")


def _write_maps(folder: Path) -> None:
    packed = ROOT / "tests/data/maps/lanelet2_example/mapping_example.osm.gz"
    (folder / "map.osm").write_bytes(gzip.decompress(packed.read_bytes()))
    for name in ("city.tile", "area.tile"):
        shutil.copy(_DEMO_TILE, folder / name)
