"""What this machine can do through onnxruntime: floating-point operations, and nodes.

Both are measured with graphs of our own, on as many threads as the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from eqrt.runtime.bench.schedule import CLOCK
from eqrt.runtime.prediction.graph_writer import Node, write_model
from eqrt.runtime.prediction.predictor import open_session

SIZE = 512
"""Rows and columns of the matrices: large enough for the peak, small enough for the cache."""
_CHAINS = (100, 500)  # nodes
_SECONDS = 0.5  # for each graph
_FEWEST_RUNS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Of onnxruntime on this machine."""

    flops_per_s: float
    """Floating-point operations of the fastest product of two matrices of SIZE."""
    node_ns: float
    """What one more node costs that computes next to nothing."""


def measure_limits(threads: int) -> Limits:
    """Takes about two seconds."""
    shortest_ns = min(_times_ns(_product(), np.ones((SIZE, SIZE), np.float32), threads))
    short, long = (
        float(np.median(_times_ns(_chain(count), np.ones(1, np.float32), threads)))
        for count in _CHAINS
    )
    return Limits(
        flops_per_s=round(2 * SIZE**3 / (shortest_ns / 1e9)),
        node_ns=round((long - short) / (_CHAINS[1] - _CHAINS[0]), 1),
    )


def _times_ns(model: bytes, fed: Any, threads: int) -> list[int]:
    session = open_session(model, threads)
    return _timed(lambda: session.run(["out"], {"in": fed}))


def _timed(run: Callable[[], object]) -> list[int]:
    end_ns = CLOCK() + round(1e9 * _SECONDS)
    found: list[int] = []
    while len(found) < 2 * _FEWEST_RUNS or CLOCK() < end_ns:
        started_ns = CLOCK()
        run()
        found.append(CLOCK() - started_ns)
    return found[_FEWEST_RUNS:]  # after the warm-up


def _product() -> bytes:
    weights = np.random.default_rng(1).normal(size=(SIZE, SIZE)).astype(np.float32)
    spec = ("float32", (SIZE, SIZE))
    return write_model(
        [("MatMul", ["in", "w"], "out", {})], {"w": weights}, {"in": spec}, {"out": spec}
    )


def _chain(count: int) -> bytes:
    """One number, to which one is added so many times."""
    names = ["in", *(f"n{place}" for place in range(1, count)), "out"]
    nodes: list[Node] = [("Add", [before, "one"], after, {}) for before, after in pairwise(names)]
    spec = ("float32", (1,))
    return write_model(nodes, {"one": np.ones(1, np.float32)}, {"in": spec}, {"out": spec})
