"""The form of `model.onnx`: what any runtime can load, with the tensors of its contract."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eqrt.core.contract import METADATA_KEY, UNITS, ModelContract
from eqrt.core.errors import ContractError
from eqrt.core.files import read_at_most
from eqrt.runtime.prediction.artifact_limits import MAX_TEXT_BYTES
from eqrt.runtime.prediction.model_file import ModelFile
from eqrt.runtime.prediction.stored_vectors import TensorSpecs
from eqrt.runtime.verify.check import Check, check_of

OPSETS = (17, 18)
MAX_IR_VERSION = 8
"""What onnxruntime 1.15 and its contemporaries read."""


def check_format(model: ModelFile, path: Path) -> Check:
    """Versions, standard operators only, all weights in the file itself."""
    failures = []
    if not 1 <= model.ir_version <= MAX_IR_VERSION:
        failures.append(f"{path}: IR version {model.ir_version}, allowed 1 to {MAX_IR_VERSION}")
    if model.opsets.get("") not in OPSETS:
        failures.append(f"{path}: opset {model.opsets.get('')}, allowed {_either(OPSETS)}")
    failures += [
        f"{path}: operators of {domain!r}, allowed are ONNX's own"
        for domain in model.opsets
        if domain
    ]
    failures += [
        f"{path}: the values of tensor {name!r} lie in another file, allowed is none"
        for name in model.external
    ]
    figure = f"IR {model.ir_version}, opset {model.opsets.get('')}, {len(model.external)} external"
    return check_of("format", failures, figure, f"IR <= 8, opset {_either(OPSETS)}, 0 external")


def read_contract(model: ModelFile, folder: Path) -> ModelContract:
    """The contract in the file itself. Raises ContractError if there is none of this version."""
    text = model.metadata.get(METADATA_KEY)
    if text is None:
        raise ContractError(
            f"{folder / 'model.onnx'}: no {METADATA_KEY!r} metadata, so this is not an eqrt model"
        )
    return ModelContract.from_json(text, str(folder / "model.onnx"))


def check_contract(model: ModelFile, contract: ModelContract, folder: Path) -> Check:
    """The contract in the file is the one beside it, and the graph's tensors are as it says."""
    inside = json.loads(model.metadata[METADATA_KEY])
    failures = _beside(inside, folder / "contract.json")
    failures += _stated(inside, contract, folder / "model.onnx")
    failures += _tensors(model.inputs, contract.inputs, "input", folder / "model.onnx")
    failures += _tensors(model.outputs, contract.outputs, "output", folder / "model.onnx")
    found = len(model.inputs) + len(model.outputs)
    expected = len(contract.inputs) + len(contract.outputs)
    return check_of("contract", failures, f"{found} tensors", f"{expected}, only B not fixed")


def _beside(inside: Any, path: Path) -> list[str]:
    try:
        beside = json.loads(read_at_most(MAX_TEXT_BYTES, path).decode("utf-8"))
    except OSError as error:
        return [f"{path}: {error.strerror}"]
    except (ValueError, RecursionError) as error:
        return [f"{path}: not JSON ({error})"]
    if beside == inside:
        return []
    if not isinstance(beside, Mapping):
        return [f"{path}: not a JSON object"]
    keys = [k for k in sorted(inside.keys() | beside.keys()) if inside.get(k) != beside.get(k)]
    return [f"{path}: {k} is {beside.get(k)!r}, model.onnx says {inside.get(k)!r}" for k in keys]


def _stated(inside: Mapping[str, Any], contract: ModelContract, path: Path) -> list[str]:
    """What the contract's text says of tensors and units, against what its version means."""
    expected = json.loads(contract.to_json())
    failures = [
        f"{path}: the contract's {side} are not those of its own sizes"
        for side in ("inputs", "outputs")
        if inside.get(side) != expected[side]
    ]
    units = inside.get("units")
    if not isinstance(units, Mapping) or any(UNITS.get(key) != unit for key, unit in units.items()):
        failures.append(f"{path}: the contract's units are {units!r}, allowed {UNITS!r}")
    return failures


def _tensors(found: TensorSpecs, expected: TensorSpecs, side: str, path: Path) -> list[str]:
    failures = []
    for name, (kind, shape) in expected.items():
        if name not in found:
            failures.append(f"{path}: {side} {name!r} is missing")
            continue
        actual_kind, actual = found[name]
        if actual_kind != kind or actual[1:] != shape[1:] or not actual:
            failures.append(
                f"{path}: {side} {name!r} is {actual_kind} {_shape(actual)}, "
                f"the contract says {kind} {_shape(shape)}"
            )
        elif isinstance(actual[0], int):
            failures.append(f"{path}: {side} {name!r} takes {actual[0]} targets only, not any B")
    failures += [
        f"{path}: {side} {name!r} is not in the contract" for name in found if name not in expected
    ]
    if not failures and list(found) != list(expected):
        failures.append(f"{path}: {side}s in the order {', '.join(found)}, allowed as listed")
    return failures


def _shape(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))})"


def _either(versions: tuple[int, ...]) -> str:
    return " or ".join(map(str, versions))
