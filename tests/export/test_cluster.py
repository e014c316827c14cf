"""Pieces of work on processes and on Dask: each exactly once, whatever dies."""

from __future__ import annotations

import argparse
import importlib
import itertools
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cluster_pieces import Piece, dies_at_4, dies_once_at_4, is_wrong, square, worker_of
from eqrt.core.errors import EqrtError, LogError, UsageError
from eqrt.export import cluster
from eqrt.export.cluster import PIECES_PER_WORKER, Outcome, add_worker_arguments, run_pieces
from processes import PATIENCE_S, environment
from source_tree import ROOT


def pieces_in(folder: Path, count: int) -> list[Piece]:
    return [Piece(number, folder) for number in range(count)]


def begun_in(folder: Path) -> int:
    return len(list(folder.iterdir()))


def by_index(outcomes: Iterator[Outcome[int]]) -> dict[int, Outcome[int]]:
    """Also that no piece came twice."""
    found = list(outcomes)
    assert len({outcome.index for outcome in found}) == len(found)
    return {outcome.index: outcome for outcome in found}


@pytest.fixture(scope="module")
def dask_cluster() -> Iterator[Any]:
    """Two worker processes of one thread each; their scheduler gives a piece up at one death."""
    distributed: Any = importlib.import_module("distributed")  # its calls carry no types
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it tells of every worker killed
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        scheduler_kwargs={"allowed_failures": 0},
    ) as cluster_of_two:
        yield cluster_of_two


def test_one_job_works_here_and_in_order(tmp_path: Path) -> None:
    """And begins a piece only when the one before has been taken."""
    outcomes = run_pieces(worker_of, pieces_in(tmp_path, 4), jobs=1, scheduler=None)
    for count, outcome in enumerate(outcomes):
        assert outcome == Outcome(index=count, value=os.getpid(), error=None)
        assert begun_in(tmp_path) == count + 1


def test_several_jobs_are_other_processes(tmp_path: Path) -> None:
    outcomes = by_index(run_pieces(worker_of, pieces_in(tmp_path, 12), jobs=2, scheduler=None))
    workers = {outcome.value for outcome in outcomes.values()}
    assert sorted(outcomes) == list(range(12))
    assert len(workers) == 2
    assert os.getpid() not in workers


def test_an_error_of_a_piece_is_its_outcome(tmp_path: Path, dask_cluster: Any) -> None:
    """Wherever it ran; the other pieces go on."""
    ways: list[tuple[int, str | None]] = [(1, None), (2, None), (1, dask_cluster.scheduler_address)]
    for jobs, scheduler in ways:
        outcomes = by_index(
            run_pieces(square, pieces_in(tmp_path, 12), jobs=jobs, scheduler=scheduler)
        )
        assert sorted(outcomes) == list(range(12))
        for number, outcome in outcomes.items():
            if number % 5 == 0:
                assert isinstance(outcome.error, LogError)
                assert str(outcome.error) == f"piece {number} is a multiple of 5"
                assert outcome.value is None
            else:
                assert outcome == Outcome(index=number, value=number**2, error=None)


def test_a_fault_of_the_program_is_raised(tmp_path: Path, dask_cluster: Any) -> None:
    """It would be the same for every piece."""
    ways: list[tuple[int, str | None]] = [(1, None), (2, None), (1, dask_cluster.scheduler_address)]
    for jobs, scheduler in ways:
        with pytest.raises(ValueError, match=r"piece \d is wrong"):
            list(run_pieces(is_wrong, pieces_in(tmp_path, 4), jobs=jobs, scheduler=scheduler))


def test_few_pieces_are_under_way(tmp_path: Path, dask_cluster: Any) -> None:
    """A caller that is slow to take outcomes is not overrun, however many pieces there are."""
    ways: list[tuple[int, str | None]] = [(2, None), (1, dask_cluster.scheduler_address)]
    for way, (jobs, scheduler) in enumerate(ways):
        folder = tmp_path / str(way)
        folder.mkdir()
        outcomes = run_pieces(square, pieces_in(folder, 1000), jobs=jobs, scheduler=scheduler)
        for taken, _ in enumerate(itertools.islice(outcomes, 30)):
            assert begun_in(folder) <= taken + 2 * PIECES_PER_WORKER
        outcomes.close()  # type: ignore[attr-defined]  # an iterator that is a generator
        assert begun_in(folder) <= 30 + 2 * PIECES_PER_WORKER


def test_a_process_that_dies_once_costs_nothing(tmp_path: Path) -> None:
    outcomes = by_index(run_pieces(dies_once_at_4, pieces_in(tmp_path, 12), jobs=2, scheduler=None))
    assert {i: outcome.value for i, outcome in outcomes.items()} == {i: i for i in range(12)}


def test_a_piece_that_kills_its_workers_is_named_and_the_others_are_done(
    tmp_path: Path, dask_cluster: Any
) -> None:
    """Those that only shared a worker with it are not blamed."""
    ways: list[tuple[int, str | None]] = [(2, None), (1, dask_cluster.scheduler_address)]
    for jobs, scheduler in ways:
        outcomes = by_index(
            run_pieces(dies_at_4, pieces_in(tmp_path, 8), jobs=jobs, scheduler=scheduler)
        )
        blamed = outcomes.pop(4)
        assert isinstance(blamed.error, EqrtError)
        assert str(blamed.error).startswith("piece 4: its worker died, and again when it ran alone")
        others = {i: outcome.value for i, outcome in outcomes.items()}
        assert others == {i: i for i in range(8) if i != 4}


def test_a_dask_worker_killed_midway_costs_nothing(tmp_path: Path, dask_cluster: Any) -> None:
    """All pieces come, each once, also those whose result died with the worker."""
    killed = None
    outcomes: list[Outcome[int]] = []
    for outcome in run_pieces(
        worker_of, pieces_in(tmp_path, 40), jobs=1, scheduler=dask_cluster.scheduler_address
    ):
        outcomes.append(outcome)
        if len(outcomes) == 10:
            killed = outcome.value
            assert killed is not None
            os.kill(killed, signal.SIGKILL)
    assert sorted(outcome.index for outcome in outcomes) == list(range(40))
    assert all(outcome.error is None for outcome in outcomes)
    assert begun_in(tmp_path) == 40
    survivors = {outcome.value for outcome in outcomes[-10:]}
    assert killed not in survivors


def test_workers_end_with_the_process_they_work_for(tmp_path: Path) -> None:
    """Even when that one was killed and could not tell them."""
    program = (
        "from pathlib import Path\n"
        "from cluster_pieces import Piece, worker_of\n"
        "from eqrt.export.cluster import run_pieces\n"
        "if __name__ == '__main__':\n"
        f"    pieces = [Piece(i, Path({str(tmp_path)!r})) for i in range(10_000)]\n"
        "    for outcome in run_pieces(worker_of, pieces, jobs=2, scheduler=None):\n"
        "        print(outcome.value, flush=True)\n"
    )
    script = tmp_path / "program.py"
    script.write_text(program)
    paths = os.pathsep.join(str(ROOT / name) for name in ("runtime", "training", "export", "tests"))
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, env=environment(PYTHONPATH=paths)
    ) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) > 0
        process.kill()
        # The workers hold the pipe too: it ends when the last of them has.
        process.communicate(timeout=PATIENCE_S)


def test_without_dask_the_error_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"'distributed', which is not .* 'eqrt\[scale\]'"):
        list(run_pieces(square, pieces_in(tmp_path, 1), jobs=1, scheduler="tcp://127.0.0.1:9"))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "carrier-pigeon://roof"])
def test_a_scheduler_that_does_not_answer_is_one_line(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.2)
    with pytest.raises(EqrtError, match=f"^no Dask scheduler answers at '{address}'") as raised:
        list(run_pieces(square, pieces_in(tmp_path, 1), jobs=1, scheduler=address))
    assert "\n" not in str(raised.value)


def test_a_cluster_with_another_eqrt_is_refused(
    tmp_path: Path, dask_cluster: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_our_version", lambda: "99.0")
    outcomes = run_pieces(
        square, pieces_in(tmp_path, 1), jobs=1, scheduler=dask_cluster.scheduler_address
    )
    with pytest.raises(EqrtError, match=r"the scheduler of the Dask cluster has eqrt .* it is 99"):
        list(outcomes)


@pytest.mark.parametrize("jobs", ["0", "-1", "many", "1.5"])
def test_jobs_are_a_number_of_processes(jobs: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_worker_arguments(parser)
    assert parser.parse_args(["--jobs", "3"]).jobs == 3
    assert parser.parse_args([]).jobs == os.cpu_count()
    with pytest.raises(SystemExit):
        parser.parse_args([f"--jobs={jobs}"])
    assert "is not a number of processes" in capsys.readouterr().err
