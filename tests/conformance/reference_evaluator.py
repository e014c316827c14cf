"""The Python example, with ONNX's reference evaluator in place of onnxruntime.

Every operator of it is written in numpy as the ONNX standard has it: slow, and the last word.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from onnx.reference import ReferenceEvaluator

from python_example import main, read_contract


def load(artifact: Path) -> Callable[[Mapping[str, Any]], Sequence[Any]]:
    """The model in the reference evaluator."""
    evaluator = ReferenceEvaluator(str(artifact / "model.onnx"))
    names = list(read_contract(artifact)["outputs"])

    def run(inputs: Mapping[str, Any]) -> Sequence[Any]:
        return list(evaluator.run(names, dict(inputs)))

    return run


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], load))
