"""Chromium without a window, driven through its own WebDriver: plain HTTP and JSON."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, Self

from conformance.environments import need

PATIENCE_S = 60.0
_ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # how WebDriver calls a reference to an element
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # which root has not; it shows pages of this checkout only
    "--disable-dev-shm-usage",
    "--disable-gpu",
    "--window-size=1050,1000",
)


class Browser:
    """A session, for as long as its `with` block."""

    def __enter__(self) -> Self:
        need("chromium", "chromedriver")
        self._driver = subprocess.Popen(
            ["chromedriver", "--port=0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._driver.stdout is not None
        ports = (
            re.search(r"started successfully on port (\d+)", line) for line in self._driver.stdout
        )
        port = next(match[1] for match in ports if match)
        self._url = f"http://127.0.0.1:{port}/session"
        options = {"binary": shutil.which("chromium"), "args": _OPTIONS}
        wanted = {"browserName": "chrome", "goog:chromeOptions": options}
        session = self._ask("POST", "", {"capabilities": {"alwaysMatch": wanted}})
        self._url += f"/{session['sessionId']}"
        self.version = str(session["capabilities"]["browserVersion"])
        return self

    def __exit__(self, *_: object) -> None:
        self._ask("DELETE", "")
        self._driver.terminate()
        self._driver.communicate(timeout=PATIENCE_S)

    def open(self, url: str) -> None:
        """Load a page."""
        self._ask("POST", "/url", {"url": url})

    def click(self, selector: str) -> None:
        """Click an element, as a person would."""
        self._ask("POST", f"/element/{self._find(selector)}/click", {})

    def wait_for(self, selector: str, pattern: str, problem: str) -> str:
        """The element's text, once `pattern` is in it. Raises if `problem` has any text."""
        end_s = time.monotonic() + PATIENCE_S
        while not re.search(pattern, text := self._text(selector)):
            if said := self._text(problem):
                raise RuntimeError(f"the page says: {said}")
            if time.monotonic() > end_s:
                raise RuntimeError(f"{selector} is {text!r} after {PATIENCE_S} s, not {pattern!r}")
            time.sleep(0.05)
        return text

    def evaluate(self, script: str) -> Any:
        """What a JavaScript function body returns."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def screenshot(self, path: Path) -> None:
        """A PNG of the page."""
        path.write_bytes(base64.b64decode(self._ask("GET", "/screenshot")))

    def _text(self, selector: str) -> str:
        return str(self._ask("GET", f"/element/{self._find(selector)}/text"))

    def _find(self, selector: str) -> str:
        found = self._ask("POST", "/element", {"using": "css selector", "value": selector})
        return str(found[_ELEMENT])

    def _ask(self, method: str, path: str, body: object = None) -> Any:
        content = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._url + path, content, method=method)
        request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(f"chromedriver: {json.load(error)['value']['message']}") from error
