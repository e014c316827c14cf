"""What a training tells while it runs: a bar or plain lines for people, JSON lines for programs."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from eqrt.core.files import write_whole
from eqrt.training.files import writing

Numbers = Mapping[str, float]


class Display(Protocol):
    """Shows a training to people. A context manager; lines may be written at any time in it."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None: ...

    def advance(self, step: int, loss: float | None, samples_per_s: float | None) -> None:
        """`step` steps are done; numbers that are not known yet are None."""

    def line(self, text: str) -> None:
        """A line that stays."""


class Lines:
    """Plain lines, for logs."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        sys.stdout.flush()

    def advance(self, step: int, loss: float | None, samples_per_s: float | None) -> None:
        """Says nothing; evaluations do."""

    def line(self, text: str) -> None:
        """At once, also into a pipe."""
        print(text, flush=True)


class Silence(Lines):
    """For the processes that are not the first."""

    def line(self, text: str) -> None:
        """Says nothing."""


class Bar:
    """A progress bar with the loss, the speed and the time that is left; lines go above it."""

    def __init__(self, steps: int, console: Console) -> None:
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]}  {task.fields[speed]} samples/s"),
            TimeRemainingColumn(),
            console=console,
        )
        self._task = self._progress.add_task("training", total=steps, loss="-", speed="-")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._progress.stop()

    def advance(self, step: int, loss: float | None, samples_per_s: float | None) -> None:
        """Move the bar."""
        self._progress.update(self._task, completed=step)
        if loss is not None and samples_per_s is not None:
            self._progress.update(self._task, loss=f"{loss:.3f}", speed=f"{samples_per_s:.0f}")

    def line(self, text: str) -> None:
        """Above the bar."""
        self._progress.console.print(text, highlight=False, markup=False, soft_wrap=True)


def new_display(steps: int) -> Display:
    """A bar on a terminal, lines elsewhere."""
    console = Console()
    return Bar(steps, console) if console.is_terminal and not console.is_dumb_terminal else Lines()


class MetricsLog:
    """`metrics.jsonl`: one object per line, each with the `step` that it was written after."""

    def __init__(self, path: Path, after: int) -> None:
        """Append to the log at `path`, as it was after step `after`; 0 = a new log.

        A training that was killed may have logged steps that it will now do again. Raises EqrtError
        if the disk does not take it, and so does `write`.
        """
        self._path = path
        kept = [line for line in read_lines(path) if line["step"] <= after] if after else []
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, "".join(map(_as_line, kept)).encode())
            self._file: IO[str] = path.open("a", encoding="utf-8")

    def write(self, values: Numbers) -> None:
        """At once: whoever watches the file sees whole lines."""
        with writing(self._path):
            self._file.write(_as_line(values))
            self._file.flush()

    def close(self) -> None:
        """No more lines."""
        with contextlib.suppress(OSError):  # of a line that `write` could not write
            self._file.close()


def read_lines(path: Path) -> list[dict[str, float]]:
    """The whole lines of a metrics log; none if there is no such file.

    A last line that is cut off (the process was killed, or the disk is full) is left out.
    """
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


def _as_line(values: Numbers) -> str:
    return json.dumps(values) + "\n"
