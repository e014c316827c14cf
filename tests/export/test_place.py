"""What `eqrt export --out` replaces, what it leaves alone, and what a kill leaves behind."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from eqrt.core.errors import EqrtError
from eqrt.export.place import claim, put
from source_tree import ROOT, SOURCE_ROOTS

PUT_AND_DIE = """
import os, signal, sys
from pathlib import Path
from eqrt.export.place import claim, put

left = int(sys.argv[3])

def die(event, arguments):
    global left
    if event in ("os.rename", "shutil.rmtree", "os.remove", "os.rmdir"):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

draft, folder = map(Path, sys.argv[1:3])
claim(folder)
sys.addaudithook(die)
put(draft, folder)
"""
"""Killed before whatever it does to the disk after so many such things."""

Contents = dict[str, str]


def artifact(folder: Path, text: str) -> Path:
    """As far as it matters here."""
    files = {"contract.json": text, "test_data_set_0/name.txt": text}
    sums = ""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
        sums += f"{hashlib.sha256(content.encode()).hexdigest()}  {name}\n"
    (folder / "SHA256SUMS").write_text(sums)
    return folder


def contents(folder: Path) -> Contents:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def test_an_artifact_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    old, new = artifact(tmp_path / "artifact", "old"), artifact(tmp_path / "draft", "new")
    expected = contents(new)
    claim(old)
    put(new, old)
    assert contents(old) == expected
    assert list(tmp_path.iterdir()) == [old]


@pytest.mark.parametrize("there", ["nothing", "an empty folder"])
def test_a_new_place_is_taken(tmp_path: Path, there: str) -> None:
    folder = tmp_path / "artifact"
    if there == "an empty folder":
        folder.mkdir()
    claim(folder)
    put(artifact(tmp_path / "draft", "new"), folder)
    assert contents(folder)["contract.json"] == "new"
    assert list(tmp_path.iterdir()) == [folder]


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    for name in ("model.safetensors", "metrics.jsonl", "contract.json"):
        (tmp_path / name).write_text("precious")
        with pytest.raises(EqrtError, match="not empty, and not an artifact; choose another --out"):
            claim(tmp_path)
    assert set(contents(tmp_path).values()) == {"precious"}


def test_the_root_of_all_folders_is_refused() -> None:
    with pytest.raises(EqrtError, match="no place for an artifact"):
        claim(Path("/"))


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "artifact").write_text("precious")
    with pytest.raises(EqrtError, match="artifact: not a folder; choose another --out"):
        claim(tmp_path / "artifact")


def test_an_artifact_with_somebodys_files_in_it_is_refused(tmp_path: Path) -> None:
    folder = artifact(tmp_path / "artifact", "old")
    (folder / "notes").mkdir()
    (folder / "notes/mine.txt").write_text("precious")
    with pytest.raises(EqrtError, match=r"holds notes/mine\.txt, which is no part of the artifact"):
        claim(folder)
    assert contents(folder)["notes/mine.txt"] == "precious"


def test_whenever_it_is_killed_one_artifact_is_whole_and_the_next_export_tidies_up(
    tmp_path: Path,
) -> None:
    """A real process, and a real SIGKILL, before each thing that it does to the disk."""
    versions = [contents(artifact(tmp_path / name, name)) for name in ("old", "new")]
    moments = 0
    while True:
        place = tmp_path / str(moments)
        folder = artifact(place / "artifact", "old")
        if run_until(moments, artifact(place / "draft", "new"), folder) == 0:
            break
        whole = [contents(found) for found in place.iterdir() if contents(found) in versions]
        assert versions[0] in whole or contents(folder) == versions[1]
        claim(folder)
        assert contents(folder) in versions
        moments += 1
        put(artifact(place / "draft", "new"), folder)
        assert contents(folder) == versions[1]
        assert list(place.iterdir()) == [folder]
    assert moments >= 4  # aside, in, and a folder of files to delete


def run_until(moment: int, draft: Path, folder: Path) -> int:
    """Exit status of a process that puts an artifact in its place; 0 = it came to its end."""
    paths = ":".join(str(ROOT / name) for name in SOURCE_ROOTS)
    command = [sys.executable, "-c", PUT_AND_DIE, str(draft), str(folder), str(moment)]
    status = subprocess.run(command, env={"PYTHONPATH": paths}, check=False).returncode
    assert status in (0, -signal.SIGKILL)
    return status
