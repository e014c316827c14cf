"""What an artifact's CHANGELOG.md remembers when the artifact is exported again."""

from __future__ import annotations

from pathlib import Path

import pytest

from eqrt.cli import main
from eqrt.core.errors import EqrtError, UsageError
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


def test_words_that_are_no_text_any_more_are_named(tmp_path: Path) -> None:
    exported(tmp_path, "1.0.0")
    (tmp_path / FILE).write_bytes("## 1.0.0\n\nFür Städte.\n".encode("latin-1"))
    with pytest.raises(EqrtError, match=r"CHANGELOG\.md: not UTF-8 any more .*save it as UTF-8"):
        changelog(tmp_path, "1.1.0", "Faster.")


@pytest.mark.parametrize("version", ["1.1 beta", "", "1.1\n"])
def test_a_version_is_one_word(version: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The changelog would forget what another was about."""
    assert main(["export", "model.safetensors", "--out", "a", "--model-version", version]) == 2
    assert "is not one word, such as 1.1.0" in capsys.readouterr().err
