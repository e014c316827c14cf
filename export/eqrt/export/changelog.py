"""CHANGELOG.md of an artifact: its versions, the newest first, and what each changed.

It grows as artifacts are replaced: the new one takes over what the old one at its place tells.
"""

from __future__ import annotations

import re
from pathlib import Path

from eqrt.core.errors import EqrtError, UsageError

FILE = "CHANGELOG.md"
_TITLE = "# Changes\n"
_ENTRY = re.compile(r"^## (\S+)\n\n(.*?)\n*(?=^## |\Z)", re.MULTILINE | re.DOTALL)


def changelog(folder: Path, version: str, changes: str | None) -> str:
    """The text for `version` of the artifact that is to be at `folder`.

    A version that is there already keeps its place, and its words too unless `changes` has others.
    Raises UsageError for another version than those there without a word on what changed, EqrtError
    if what is there is no text.
    """
    entries = _entries(folder)
    if changes is None and version not in entries:
        if entries:
            raise UsageError(
                f"{folder}: holds version {next(iter(entries))}; say what {version} changes: "
                "--changes TEXT"
            )
        changes = "First version."
    if version in entries:
        entries[version] = entries[version] if changes is None else changes
    else:
        entries = {version: str(changes), **entries}
    return _TITLE + "".join(f"\n## {name}\n\n{text.strip()}\n" for name, text in entries.items())


def _entries(folder: Path) -> dict[str, str]:
    """Version -> words, the newest first; empty where there is no artifact yet."""
    path = folder / FILE
    if not path.exists():
        return {}
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise EqrtError(f"{path}: not UTF-8 any more ({error}); save it as UTF-8") from error
    return dict(_ENTRY.findall(text))
