"""What onnxruntime's profiler says of every node: its kind, how long it took, its tensors' shapes.

The profiler slows a run down, and small nodes most, so its times are taken as shares. A time is cut
off to whole microseconds: half of one is added to each.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from eqrt.runtime.prediction.predictor import open_session

_CUT_OFF_US = 0.5
_KERNEL = "_kernel_time"
Shape = Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeTimes:
    """Of all nodes of one kind, summed over a profile."""

    operator: str
    calls: int
    time_us: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What a profile's nodes had to compute."""

    flops: int
    """In products of matrices, convolutions and recurrent cells: 2 for a multiply and add."""
    uncounted: tuple[str, ...]
    """Kinds of operators that multiply matrices too, but whose work cannot be told."""


def profiled(
    content: bytes, threads: int, use: Callable[[Any], None], *, prepack: bool = True
) -> list[dict[str, Any]]:
    """The profiler's node events of what `use` does with a session; no file stays behind.

    Without `prepack`, weights are among the input shapes.
    """
    with tempfile.TemporaryDirectory(prefix="eqrt-bench-") as folder:
        session = open_session(content, threads, profile=Path(folder) / "nodes", prepack=prepack)
        use(session)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    return [
        event
        for event in events
        if event.get("cat") == "Node" and event.get("name", "").endswith(_KERNEL)
    ]


def times_by_operator(events: Sequence[dict[str, Any]]) -> list[NodeTimes]:
    """The slowest kind first."""
    calls: Counter[str] = Counter()
    times: dict[str, float] = defaultdict(float)
    for event in events:
        operator = event["args"]["op_name"]
        calls[operator] += 1
        times[operator] += event["dur"] + _CUT_OFF_US
    found = [NodeTimes(operator=name, calls=calls[name], time_us=times[name]) for name in calls]
    return sorted(found, key=lambda one: (-one.time_us, one.operator))


def work_of(events: Sequence[dict[str, Any]]) -> Work:
    """Of the events of a session without prepacked weights."""
    flops, uncounted = 0, set()
    for event in events:
        operator, arguments = event["args"]["op_name"], event["args"]
        rule = _RULES.get(operator)
        try:
            if rule is not None:
                inputs, outputs = (
                    [next(iter(tensor.values())) for tensor in arguments[f"{side}_type_shape"]]
                    for side in ("input", "output")
                )
                flops += rule(inputs, outputs)
            elif operator in _ALSO_MULTIPLY:
                uncounted.add(operator)
        except (IndexError, KeyError):  # a shape that is not told
            uncounted.add(operator)
    return Work(flops=flops, uncounted=tuple(sorted(uncounted)))


def _product(inputs: Sequence[Shape], outputs: Sequence[Shape]) -> int:
    """(..., M, K) x (..., K, N), the first perhaps transposed."""
    left, out = inputs[0], outputs[0]
    inner = left[-1]
    if len(left) > 1 and len(out) > 1 and left[-2] != out[-2]:
        inner = left[-2]
    return 2 * prod(out) * inner


def _matmul(inputs: Sequence[Shape], outputs: Sequence[Shape]) -> int:
    return 2 * prod(outputs[0]) * inputs[0][-1]


def _convolution(inputs: Sequence[Shape], outputs: Sequence[Shape]) -> int:
    """Each number of the output takes a kernel (C / groups, ...) of the weights (M, C/g, ...)."""
    return 2 * prod(outputs[0]) * prod(inputs[1][1:])


def _recurrent(inputs: Sequence[Shape], _outputs: Sequence[Shape]) -> int:
    """Weights and recurrence weights, for every step (T, B, ...)."""
    steps, batch = inputs[0][0], inputs[0][1]
    return 2 * steps * batch * (prod(inputs[1]) + prod(inputs[2]))


_RULES: dict[str, Callable[[Sequence[Shape], Sequence[Shape]], int]] = {
    "MatMul": _matmul,
    "Gemm": _product,
    "FusedGemm": _product,
    "FusedMatMul": _product,
    "Conv": _convolution,
    "FusedConv": _convolution,
    "LSTM": _recurrent,
    "GRU": _recurrent,
    "RNN": _recurrent,
}
_ALSO_MULTIPLY = frozenset(
    {
        "Attention",
        "ConvTranspose",
        "DynamicQuantizeMatMul",
        "Einsum",
        "GroupQueryAttention",
        "MatMulInteger",
        "MatMulNBits",
        "MultiHeadAttention",
        "QLinearConv",
        "QLinearMatMul",
        "RotaryEmbedding",
    }
)
