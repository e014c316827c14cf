"""The commands that our pages tell their readers to type."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from source_tree import ROOT

_BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Command:
    """One line of a block of shell commands."""

    page: str
    line: int
    text: str
    """Without its comment."""

    @property
    def words(self) -> list[str]:
        """As the shell splits them."""
        return shlex.split(self.text, comments=True)

    @property
    def program(self) -> str:
        """The first word that is not a setting of its environment."""
        return next(word for word in self.words if not re.match(r"[A-Z]+=", word))

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text}"


def pages() -> list[Path]:
    """Every page that a reader may type from."""
    found = [ROOT / "README.md", *ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    return sorted(
        {*found, *ROOT.glob("deploy/**/*.md")} - set(ROOT.glob("**/node_modules/**/*.md"))
    )


def commands_of(page: Path) -> Iterator[Command]:
    """In the order of the page."""
    text = page.read_text(encoding="utf-8")
    name = page.relative_to(ROOT).as_posix()
    for block in _BLOCK.finditer(text):
        first = text.count("\n", 0, block.start(1)) + 1
        for offset, line in enumerate(block[1].splitlines()):
            if shlex.split(line, comments=True):
                yield Command(name, first + offset, re.sub(r"\s+#.*$", "", line).strip())
