"""A real browser, once for all tests of the page."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator

import pytest

from browser import PROGRAMS, Browser


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """Chromium without a window. CI installs it; elsewhere these tests need it to be there."""
    lacking = [name for name in PROGRAMS if shutil.which(name) is None]
    if lacking and "CI" not in os.environ:
        pytest.skip(f"no {lacking[0]} on this machine")
    assert not lacking
    with Browser() as browser:
        browser.resize(1280, 720)
        yield browser


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    """On an empty page, with nothing to complain of yet."""
    yield chromium
    chromium.open("about:blank")
    chromium.console()
