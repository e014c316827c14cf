"""`make view-picture`: docs/view.png, the page beside a service with the demo's motorway.

Wants Chromium, and a machine quiet enough for full service: the picture shows its latencies too.
"""

from __future__ import annotations

import sys
import time

from browser import Browser
from drives import DRIVES
from source_tree import ROOT
from viewing import watched

PICTURE = ROOT / "docs" / "view.png"
SIZE = (1280, 760)
WATCHED_S = 52.0  # the last minute's errors are of many predictions then
_MIDDLE = """
    const box = document.getElementById('scene').getBoundingClientRect();
    const off = a => Math.hypot(a.px - box.width / 2, a.py - box.height / 2);
    const ahead = window.eqrt.pixels.filter(a => a.px > box.width / 2 - 150);
    const a = ahead.sort((a, b) => off(a) - off(b))[0];
    return [a.px + box.left, a.py + box.top];
"""


def main() -> int:
    """Watch, stop where a car can be selected, take the picture."""
    drive = DRIVES["ngsim"]
    with watched(drive, drive.log) as (viewing, _, _), Browser() as browser:
        browser.resize(*SIZE)
        browser.open(viewing.address)
        time.sleep(WATCHED_S)
        browser.press("p")
        browser.click_at(*browser.evaluate(_MIDDLE))
        time.sleep(0.5)
        browser.screenshot(PICTURE)
    print(f"{PICTURE.relative_to(ROOT)} is new; look at it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
