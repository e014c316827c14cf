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

PATIENCE_S = 60.0
PROGRAMS = ("chromium", "chromedriver")
_ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # how WebDriver calls a reference to an element
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # which root has not; it shows pages of this checkout only
    "--disable-dev-shm-usage",
    "--disable-gpu",
)

KEYS = {
    "Escape": "\ue00c",
    "ArrowLeft": "\ue012",
    "ArrowRight": "\ue014",
    "Tab": "\ue004",
    "Enter": "\ue007",
}
"""How WebDriver writes keys that are no letters."""


class Browser:
    """A session, for as long as its `with` block."""

    def __init__(self, *more: str, size: tuple[int, int] = (1050, 1000)) -> None:
        """`more`: options of Chromium's. `size`: of the window, in pixels."""
        self._options = [*_OPTIONS, f"--window-size={size[0]},{size[1]}", *more]

    def __enter__(self) -> Self:
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
        options = {"binary": shutil.which("chromium"), "args": self._options}
        wanted = {
            "browserName": "chrome",
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        session = self._ask("POST", "", {"capabilities": {"alwaysMatch": wanted}})
        self._url += f"/{session['sessionId']}"
        capabilities = session["capabilities"]
        self.version = str(capabilities["browserVersion"])
        self.pid = int(capabilities["goog:processID"])
        """Of the browser, the parent of all its processes."""
        return self

    def __exit__(self, *_: object) -> None:
        self._ask("DELETE", "")
        self._driver.terminate()
        self._driver.communicate(timeout=PATIENCE_S)

    def processes(self) -> list[int]:
        """The ids of all processes of the browser."""
        return _family(self.pid)

    def open(self, url: str) -> None:
        """Load a page."""
        self._ask("POST", "/url", {"url": url})

    def click(self, selector: str) -> None:
        """Click an element, as a person would."""
        self._ask("POST", f"/element/{self._find(selector)}/click", {})

    def press(self, *keys: str) -> None:
        """Press keys one after the other: letters, or names of KEYS."""
        strokes = [KEYS.get(key, key) for key in keys]
        actions = [{"type": kind, "value": key} for key in strokes for kind in ("keyDown", "keyUp")]
        self._ask("POST", "/actions", {"actions": [{"type": "key", "id": "k", "actions": actions}]})

    def click_at(self, x: float, y: float) -> None:
        """Click a point of the page, in pixels from its corner."""
        pointer = [
            {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        self._ask(
            "POST", "/actions", {"actions": [{"type": "pointer", "id": "p", "actions": pointer}]}
        )

    def drag(self, x: float, y: float, to_x: float, to_y: float) -> None:
        """Drag from one point of the page to another."""
        moves = [
            {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerMove", "duration": 50, "x": round(to_x), "y": round(to_y)},
            {"type": "pointerUp", "button": 0},
        ]
        self._ask(
            "POST", "/actions", {"actions": [{"type": "pointer", "id": "p", "actions": moves}]}
        )

    def console(self) -> list[str]:
        """Warnings and errors that the page has caused since this was asked last."""
        entries = self._ask("POST", "/se/log", {"type": "browser"})
        return [one["message"] for one in entries if one["level"] in {"WARNING", "SEVERE"}]

    def resize(self, width: int, height: int) -> None:
        """Give the page so many pixels."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._cdp("Emulation.setDeviceMetricsOverride", size)

    def emulate(self, **features: str) -> None:
        """What the page is told that its reader prefers, such as `prefers_color_scheme="dark"`."""
        named = [{"name": k.replace("_", "-"), "value": v} for k, v in features.items()]
        self._cdp("Emulation.setEmulatedMedia", {"features": named})

    def see_as(self, deficiency: str) -> None:
        """As a reader sees it who is colour-blind, in Chromium's words; "none" is as before."""
        self._cdp("Emulation.setEmulatedVisionDeficiency", {"type": deficiency})

    def _cdp(self, command: str, parameters: object) -> None:
        self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

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


def _family(pid: int) -> list[int]:
    """A process and all that it has started."""
    below = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(one for child in below for one in _family(int(child)))]
