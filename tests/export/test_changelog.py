"""What an artifact's CHANGELOG.md remembers when the artifact is exported again."""

from __future__ import annotations

from pathlib import Path

import pytest

from eqrt.core.errors import UsageError
from eqrt.export.changelog import FILE, changelog


def exported(folder: Path, version: str, changes: str | None = None) -> str:
    text = changelog(folder, version, changes)
    (folder / FILE).write_text(text, encoding="utf-8")
    return text


def test_the_first_version_needs_no_words(tmp_path: Path) -> None:
    assert exported(tmp_path, "1.0.0") == "# Changes\n\n## 1.0.0\n\nFirst version.\n"


def test_the_newest_version_comes_first_and_the_old_ones_stay(tmp_path: Path) -> None:
    exported(tmp_path, "1.0.0")
    exported(tmp_path, "1.1.0", "Twice as\nfast.")
    assert exported(tmp_path, "2.0.0", "16 agents.") == (
        "# Changes\n\n## 2.0.0\n\n16 agents.\n\n## 1.1.0\n\nTwice as\nfast.\n"
        "\n## 1.0.0\n\nFirst version.\n"
    )


def test_exporting_the_same_version_again_changes_no_byte(tmp_path: Path) -> None:
    exported(tmp_path, "1.0.0")
    before = exported(tmp_path, "1.1.0", "Twice as fast.")
    assert exported(tmp_path, "1.1.0") == before
    assert exported(tmp_path, "1.0.0") == before


def test_words_may_be_corrected(tmp_path: Path) -> None:
    exported(tmp_path, "1.0.0")
    assert "For NGSIM." in exported(tmp_path, "1.0.0", "For NGSIM.")


def test_a_new_version_without_a_word_on_what_changed_is_refused(tmp_path: Path) -> None:
    exported(tmp_path, "1.0.0")
    with pytest.raises(UsageError, match=r"holds version 1\.0\.0; say what 1\.1\.0 changes"):
        changelog(tmp_path, "1.1.0", None)
