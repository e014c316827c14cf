"""`eqrt demo` with the view beside it."""

from __future__ import annotations

import asyncio
import re
import subprocess
from pathlib import Path

import pytest
from websockets.asyncio.client import connect

from eqrt.cli import main
from eqrt.runtime.view.updates import decode_update
from processes import EQRT, PATIENCE_S, environment, eqrt


def test_the_demo_prints_an_address_where_its_traffic_is_shown(tmp_path: Path) -> None:
    command = [*EQRT, "demo", "--part", "rav4", "--seconds", "4", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as demo:
        assert demo.stdout is not None
        match = re.fullmatch(r"watch it at http://(127\.0\.0\.1:\d+)/\n", demo.stdout.readline())
        assert match is not None

        async def first_cycle() -> int:
            async with connect(f"ws://{match[1]}/stream") as page:
                while True:
                    message = await page.recv()
                    if isinstance(message, bytes) and decode_update(message)[0]["shape"][0]:
                        return int(decode_update(message)[0]["shape"][0])

        assert asyncio.run(asyncio.wait_for(first_cycle(), PATIENCE_S)) > 0
        assert demo.wait(PATIENCE_S) == 0
    with pytest.raises(OSError, match=r"refused|failed"):
        asyncio.run(first_cycle())


def test_a_demo_without_a_view_says_nothing_of_it(tmp_path: Path) -> None:
    done = eqrt("demo", "--no-view", "--part", "rav4", "--seconds", "1", "--out", str(tmp_path))
    assert done.returncode == 0
    assert "watch it" not in done.stdout
    assert "http" not in done.stdout


def test_a_view_that_is_wanted_and_not_installed_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert main(["demo", "--view", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        "eqrt: --view needs the extra `view`: pip install 'eqrt[view]'\n"
    )
