"""Independent pieces of work spread over workers: here, in processes of this machine, or on Dask.

A piece is plain data (a `Part`, a path), its function a module's function or a picklable object;
both cross processes. Only a few pieces per worker are under way at any time, so memory does not
grow with their number, and outcomes come as they are done. A worker that dies takes nothing with
it: its pieces run again, and every piece has exactly one outcome.

On a Dask cluster, workers and scheduler need the same eqrt installed and must see the same files
under the same paths. Start the workers with one thread each (`dask worker --nthreads 1`): numpy
and onnxruntime code like this gains nothing from threads.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import wait as wait_for_any
from typing import Any, Generic, TypeVar

from eqrt.core.errors import EqrtError, UsageError

P = TypeVar("P")
R = TypeVar("R")

PIECES_PER_WORKER = 2
"""Under way at a time: one that runs, and one that is there when it is done."""
_CONNECT_S = 10  # a scheduler that is there answers in milliseconds


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R]):
    """What became of one piece: a value, or the reason why there is none."""

    index: int
    """Of the piece in the sequence."""
    value: R | None
    error: Exception | None
    """The EqrtError that the piece ended with; None = it is done."""


def add_worker_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of every command that spreads its work: `--jobs` and `--scheduler`."""
    parser.add_argument(
        "--jobs",
        type=_positive,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes on this machine (default: one per core, %(default)s here)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the Dask cluster of this scheduler instead, such as tcp://10.0.0.5:8786; it "
        "must see the same paths (extra: scale)",
    )


def run_pieces(
    function: Callable[[P], R], pieces: Sequence[P], *, jobs: int, scheduler: str | None
) -> Iterator[Outcome[R]]:
    """`function` of every piece, each exactly once, in the order in which they are done.

    One job and no scheduler: in this process and in order. Several: in so many new processes; with
    the address of a Dask scheduler: there, and `jobs` plays no part. An EqrtError of a piece is its
    outcome, and so is a worker that dies of it; any other error is a fault of the program and is
    raised. Raises UsageError if Dask is not installed, EqrtError if the scheduler does not answer.
    """
    if scheduler is not None:
        return _on_cluster(function, pieces, scheduler)
    if jobs == 1:
        return (_attempt(function, index, piece) for index, piece in enumerate(pieces))
    return _in_processes(function, pieces, min(jobs, max(len(pieces), 1)))


def _positive(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes (1 or more)")
    return number


def _attempt(function: Callable[[P], R], index: int, piece: P) -> Outcome[R]:
    """What runs on the worker."""
    try:
        return Outcome(index, function(piece), None)
    except EqrtError as error:
        return Outcome(index, None, error)


_Pass = Callable[[Iterator[int], bool, list[int]], Iterator[Outcome[R]]]
"""(indices to do, alone?, where to note pieces whose worker died) -> outcomes of the others."""


def _each_once(pieces: Sequence[P], one_pass: _Pass[R]) -> Iterator[Outcome[R]]:
    """Passes over the pieces until each has its outcome.

    A worker that dies takes down all that it had been given, and which of that it died of nobody
    can tell. So each of these pieces runs once more, with nothing else under way.
    """
    todo = iter(range(len(pieces)))
    while True:
        lost: list[int] = []
        yield from one_pass(todo, False, lost)
        if not lost:
            return
        for index in lost:
            died: list[int] = []
            yield from one_pass(iter([index]), True, died)
            yield from (_died(i, pieces[i]) for i in died)


def _died(index: int, piece: object) -> Outcome[R]:
    error = EqrtError(
        f"{getattr(piece, 'name', piece)}: its worker died, and again when it ran alone (out of "
        "memory?); give the workers more memory, or leave this piece out"
    )
    return Outcome(index, None, error)


def _in_processes(
    function: Callable[[P], R], pieces: Sequence[P], jobs: int
) -> Iterator[Outcome[R]]:
    def one_pool(todo: Iterator[int], alone: bool, lost: list[int]) -> Iterator[Outcome[R]]:
        """Until there is no more to do, or a worker dies: that breaks its whole pool."""
        processes = 1 if alone else jobs
        under_way: dict[Future[Outcome[R]], int] = {}
        with _pool(processes) as pool:
            while True:
                while len(under_way) < PIECES_PER_WORKER * processes and not lost:
                    if (index := next(todo, None)) is None:
                        break
                    try:
                        future = pool.submit(_attempt, function, index, pieces[index])
                        under_way[future] = index
                    except BrokenProcessPool:
                        lost.append(index)
                if not under_way:
                    return
                yield from _done(under_way, lost)

    return _each_once(pieces, one_pool)


def _done(under_way: dict[Future[Outcome[R]], int], lost: list[int]) -> Iterator[Outcome[R]]:
    """Wait until something is done, and take it out of what is under way."""
    done, _ = wait(under_way, return_when=FIRST_COMPLETED)
    for future in done:
        index = under_way.pop(future)
        if isinstance(future.exception(), BrokenProcessPool):
            lost.append(index)
        else:
            yield future.result()


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes; what has not begun is dropped when the caller wants no more."""
    spawn = multiprocessing.get_context("spawn")  # a fork would copy locks that threads here hold
    pool = ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_begin_worker)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Ctrl-C ends a worker without a word, and so does the end of the process that it works for."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for_any([parent.sentinel])
        os._exit(1)


def _on_cluster(
    function: Callable[[P], R], pieces: Sequence[P], scheduler: str
) -> Iterator[Outcome[R]]:
    dask = _distributed()
    with _client(dask, scheduler) as client:

        def one_pass(todo: Iterator[int], alone: bool, lost: list[int]) -> Iterator[Outcome[R]]:
            """Until there is no more to do: Dask itself moves pieces to the workers left."""
            index_of: dict[object, int] = {}
            under_way = dask.as_completed(loop=client.loop)

            def fill() -> None:
                threads = 1 if alone else sum(client.nthreads().values())  # workers come and go
                while len(index_of) < PIECES_PER_WORKER * max(threads, 1):
                    if (index := next(todo, None)) is None:
                        break
                    future = client.submit(_attempt, function, index, pieces[index], pure=False)
                    index_of[future.key] = index
                    under_way.add(future)

            with _connected(scheduler):
                fill()
            for future in under_way:
                index = index_of.pop(future.key)
                with _connected(scheduler):
                    killed = isinstance(future.exception(), dask.KilledWorker)
                if killed:
                    lost.append(index)
                else:
                    yield future.result()
                with _connected(scheduler):
                    fill()

        yield from _each_once(pieces, one_pass)


def _distributed() -> Any:  # its calls carry no types
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--scheduler needs the package {error.name!r}, which is not installed; "
            "install it with: pip install 'eqrt[scale]'"
        ) from error


@contextmanager
def _client(dask: Any, scheduler: str) -> Iterator[Any]:
    """A connection of our own: it becomes nobody's default client."""
    try:
        client = dask.Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = str(error) or type(error).__name__
        raise EqrtError(
            f"no Dask scheduler answers at {scheduler!r} ({reason}); give --scheduler an address "
            "as `dask scheduler` prints it"
        ) from error
    with client:
        _check_versions(client)
        yield client


def _check_versions(client: Any) -> None:
    """Raise EqrtError unless the cluster runs the eqrt that we are."""
    ours = _our_version()
    version = partial(importlib.metadata.version, "eqrt")  # by reference: eqrt need not be there
    try:
        theirs = {"the scheduler": client.run_on_scheduler(version), **client.run(version)}
    except importlib.metadata.PackageNotFoundError as error:
        raise EqrtError(
            f"the Dask cluster at {client.scheduler.address} has no eqrt; install eqrt {ours} "
            "where its scheduler and where its workers run"
        ) from error
    for where, found in theirs.items():
        if found != ours:
            raise EqrtError(
                f"{where} of the Dask cluster has eqrt {found}, here it is {ours}; install the "
                "same version everywhere"
            )


def _our_version() -> str:
    return importlib.metadata.version("eqrt")


@contextmanager
def _connected(scheduler: str) -> Iterator[None]:
    """While the scheduler is spoken to; not while a piece's own errors come out."""
    try:
        yield
    except (OSError, CancelledError) as error:
        raise EqrtError(
            f"the Dask scheduler at {scheduler} has gone; start it and run the command again"
        ) from error
