"""For mkdocs: pages that lie outside docs/ join the site, and links are made to fit.

On the forge every page links to files of the repository by their place in it. In the site, docs/ is
the root, deploy/ lies below it, and source files are not there: a link to one becomes its path.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
OUTSIDE = {"README.md": "about.md", "SECURITY.md": "security.md"} | {
    path.relative_to(ROOT).as_posix(): path.relative_to(ROOT).as_posix()
    for pattern in ("deploy/*.md", "deploy/examples/*.md", "deploy/models/*.md")
    for path in ROOT.glob(pattern)
}
"""Page in the repository -> its place in the site."""

_LINK = re.compile(r"(!?)\[([^]]*)\]\(([^)\s]+)\)")
_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages."""
    for inside, place in OUTSIDE.items():
        text = (ROOT / inside).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Make the links of one page fit the site."""
    place = page.file.src_uri
    parts = _FENCE.split(markdown)
    return "".join(
        part if part.startswith("```") else _LINK.sub(lambda link: _fitted(link, place), part)
        for part in parts
    )


def _fitted(link: re.Match[str], place: str) -> str:
    mark, text, target = link.groups()
    if re.match(r"[a-z]+:|#", target):
        return link[0]
    path, hash_sign, anchor = target.partition("#")
    found = posixpath.normpath(posixpath.join(posixpath.dirname(_in_repository(place)), path))
    if not (ROOT / found).exists():
        raise FileNotFoundError(f"{_in_repository(place)} links to {target}, which is not there")
    if (in_site := _in_site(found)) is None:
        return text if posixpath.basename(found) in text else f"{text} (`{found}`)"
    relative = posixpath.relpath(in_site, posixpath.dirname(place) or ".")
    return f"{mark}[{text}]({relative}{hash_sign}{anchor})"


def _in_repository(place: str) -> str:
    back = {place: inside for inside, place in OUTSIDE.items()}
    return back.get(place, f"docs/{place}")


def _in_site(found: str) -> str | None:
    """None for what is not part of the site."""
    if found in OUTSIDE:
        return OUTSIDE[found]
    if (ROOT / found).is_dir() and f"{found}/README.md" in OUTSIDE:
        return OUTSIDE[f"{found}/README.md"]
    return found.removeprefix("docs/") if found.startswith("docs/") else None
