"""Signals that come at the worst moment, in a process of its own: it would wait for itself."""

from __future__ import annotations

import subprocess
import sys

from processes import PATIENCE_S, environment

AT_EVERY_LINE = """
import os, signal, sys
from eqrt.runtime.signals import asked_to_reload

seen = set()


def interrupt(frame, event, argument):
    place = frame.f_code, frame.f_lineno, event
    if place not in seen:
        seen.add(place)
        os.kill(os.getpid(), signal.SIGHUP)
    return interrupt


with asked_to_reload() as is_asked:
    assert not is_asked()
    os.kill(os.getpid(), signal.SIGHUP)
    sys.settrace(interrupt)
    answer = is_asked()
    sys.settrace(None)
    print(len(seen) > 3, answer, is_asked(), is_asked())
"""


def test_a_sighup_within_the_answer_to_another_holds_nobody_up() -> None:
    """One at every line that runs, those of the handler too. The last comes when the answer has
    been made, and is told with the next one.
    """
    done = subprocess.run(
        [sys.executable, "-c", AT_EVERY_LINE],
        capture_output=True,
        text=True,
        check=False,
        env=environment(),
        timeout=PATIENCE_S,
    )
    assert (done.stdout, done.stderr) == ("True True True False\n", "")
