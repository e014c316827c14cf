"""A file is read whole, or refused for its size before it is read."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from eqrt.core.files import may_be_file, read_at_most, write_whole
from processes import environment, files_of_at_most

LINKS = pytest.mark.skipif(sys.platform != "linux", reason="of links as Linux has them")


def test_a_file_of_just_the_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "four"
    path.write_bytes(b"four")
    assert read_at_most(4, path) == b"four"


def test_one_byte_more_is_refused_and_the_sizes_are_told(tmp_path: Path) -> None:
    path = tmp_path / "five"
    path.write_bytes(b"5 ...")
    with pytest.raises(OSError, match="5 bytes, and no such file has more than 4") as refusal:
        read_at_most(4, path)
    assert refusal.value.errno == errno.EFBIG
    assert refusal.value.filename == str(path)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_at_most(4, tmp_path / "none")


def test_a_folder_or_nothing_is_no_file(tmp_path: Path) -> None:
    assert not may_be_file(tmp_path)
    assert not may_be_file(tmp_path / "none")
    (tmp_path / "some").touch()
    assert may_be_file(tmp_path / "some")


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="there, pathlib takes it for no file")
def test_what_cannot_be_told_may_be_a_file(tmp_path: Path) -> None:
    assert may_be_file(tmp_path / ("long" * 100))


def test_a_file_is_written_whole_or_stays_what_it_was(tmp_path: Path) -> None:
    path = tmp_path / "found.json"
    write_whole(path, b"old")
    with files_of_at_most(1 << 16), pytest.raises(OSError, match="File too large"):
        write_whole(path, bytes(1 << 17))
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path, b"")
    assert [one.name for one in tmp_path.iterdir()] == ["found.json"]


@LINKS
def test_a_link_stays_and_leads_to_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "linked").symlink_to("found.json")
    for content in (b"first", b"second"):  # where it leads to nothing yet, too
        write_whole(tmp_path / "linked", content)
        assert (tmp_path / "linked").is_symlink()
        assert (tmp_path / "found.json").read_bytes() == content


@LINKS
def test_the_link_to_our_own_output_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    """As /dev/stdout is one, which whoever may write in /dev would lose to all other programs."""
    link, taken = tmp_path / "stdout", tmp_path / "taken"
    link.symlink_to("/proc/self/fd/1")
    say = (
        "import sys; from pathlib import Path; from eqrt.core.files import write_whole; "
        "print('before', flush=True); write_whole(Path(sys.argv[1]), b'whole\\n'); print('after')"
    )
    with taken.open("wb") as stream:
        subprocess.run(
            [sys.executable, "-c", say, str(link)], stdout=stream, check=True, env=environment()
        )
    assert link.is_symlink()
    assert taken.read_bytes() == b"before\nwhole\nafter\n"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["stdout", "taken"]
