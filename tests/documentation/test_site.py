"""The pages as a site: every link leads somewhere, and nothing is loaded from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from source_tree import ROOT


def build(folder: Path, config: Path = ROOT / "mkdocs.yml") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(config)]
    return subprocess.run(
        [*command, "--site-dir", str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONDONTWRITEBYTECODE": "1"},
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = build(folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_in_it_and_in_its_navigation(site: Path) -> None:
    pages = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    start = (site / "index.html").read_text()
    for page in pages:
        place = page.with_suffix(".html").as_posix()
        assert (site / place).is_file()
        assert f'href="{place}"' in start, f"{page} is not in the navigation of mkdocs.yml"


def test_it_loads_nothing_from_elsewhere(site: Path) -> None:
    loads = re.compile(r"<(?:script|link|img|iframe)[^>]*?(?:src|href)=\"?(https?:)?//[^>]*>")
    for page in site.rglob("*.html"):
        assert not loads.search(page.read_text()), page
    for style in site.rglob("*.css"):
        assert "url(http" not in style.read_text(), style


def test_links_to_source_files_become_their_paths(site: Path) -> None:
    text = (site / "output.html").read_text()
    assert "runtime/eqrt/runtime/output/forecasts.py" in text
    assert 'href="../runtime' not in text


@pytest.mark.parametrize("link", ["nowhere.md", "design.md#nowhere"])
def test_a_dead_link_fails_the_build(tmp_path: Path, link: str) -> None:
    """A page of its own beside copies of ours would be slow: one page, the same rules."""
    config = (ROOT / "mkdocs.yml").read_text()
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/index.md").write_text(f"# Start\n\n[there]({link})\n")
    (tmp_path / "docs/design.md").write_text("# Design\n")
    without = config[: config.index("\nnav:")].replace("hooks: [docs/outside_pages.py]\n", "")
    (tmp_path / "mkdocs.yml").write_text(without)
    done = build(tmp_path / "site", tmp_path / "mkdocs.yml")
    assert done.returncode == 1
    assert "nowhere" in done.stderr
