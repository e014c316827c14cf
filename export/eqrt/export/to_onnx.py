"""A torch network -> the bytes of one clean, portable ONNX file."""

from __future__ import annotations

import json
import logging
import re
import warnings

import onnx
import onnxscript.optimizer
import torch
from torch import nn

from eqrt.core.contract import METADATA_KEY, ModelContract
from eqrt.core.errors import EqrtError
from eqrt.export.folded import folded

OPSET = 18
IR_VERSION = 8
"""What onnxruntime 1.15 and its contemporaries read."""
FORBIDDEN_OPS = {"Atan2", "Einsum", "IsInf", "NonZero", "Reciprocal"}
"""Missing or slow in at least one runtime that the artifact must load in."""
_FOLD_BYTES = 2**28
_TRACE_BATCH = 3  # any size above 1: 1 would be taken for a constant


def to_onnx(model: nn.Module, contract: ModelContract, metadata: dict[str, str]) -> bytes:
    """Export a network that speaks the contract; B stays dynamic.

    Raises EqrtError if the graph needs an operator that the artifact must not contain.
    """
    proto = _export(folded(model.eval(), contract.num_agents).eval(), contract)
    _clean(proto)
    _describe(proto, contract, metadata)
    forbidden = {node.op_type for node in proto.graph.node} & FORBIDDEN_OPS
    if forbidden:
        raise EqrtError(f"the exported graph contains {sorted(forbidden)}; rewrite that layer")
    onnx.checker.check_model(proto, full_check=True)
    return bytes(proto.SerializeToString(deterministic=True))


def _export(model: nn.Module, contract: ModelContract) -> onnx.ModelProto:
    example = tuple(
        torch.zeros([_TRACE_BATCH, *map(int, shape[1:])], dtype=getattr(torch, kind))
        for kind, shape in contract.inputs.values()
    )
    batch = torch.export.Dim("B")
    # It tells of every package that it would know operators of and that is not installed.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        program = torch.onnx.export(
            model,
            example,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(contract.inputs),
            output_names=list(contract.outputs),
            dynamic_shapes=tuple({0: batch} for _ in example),
            external_data=False,
            optimize=False,  # done below, with limits that fold more
            verbose=False,
        )
    if program is None:
        raise EqrtError("the exporter returned nothing")
    # What depends on weights alone is computed here, once, however large: networks fold by it.
    onnxscript.optimizer.optimize(
        program.model, input_size_limit=_FOLD_BYTES, output_size_limit=_FOLD_BYTES
    )
    return program.model_proto


def _clean(proto: onnx.ModelProto) -> None:
    """Drop what the exporter leaves of this machine, and give every node a plain name."""
    proto.ir_version = IR_VERSION
    proto.producer_name, proto.producer_version = "eqrt", ""
    for holder in (proto, proto.graph, *proto.graph.node, *proto.graph.input, *proto.graph.output):
        _strip(holder)
    for value in (*proto.graph.initializer, *proto.graph.value_info):
        _strip(value)
    del proto.graph.value_info[:]
    proto.graph.name = "eqrt"
    renamed = {
        name: f"v{index}"
        for index, name in enumerate(name for node in proto.graph.node for name in node.output)
    }
    for keep in (*proto.graph.input, *proto.graph.output):
        renamed.pop(keep.name, None)
    for index, node in enumerate(proto.graph.node):
        node.name = f"{node.op_type}_{index}"
        node.input[:] = [renamed.get(name, name) for name in node.input]
        node.output[:] = [renamed.get(name, name) for name in node.output]


def _strip(holder: object) -> None:
    for field in ("doc_string", "metadata_props"):
        if hasattr(holder, field):
            holder.ClearField(field)  # type: ignore[attr-defined]  # protobuf messages have it


def _describe(proto: onnx.ModelProto, contract: ModelContract, metadata: dict[str, str]) -> None:
    docs = {
        "history": "metres, tile frame; agent 0 is the target; the last step is now",
        "history_valid": "True = seen; values under False are never read",
        "heading": "measured unit heading of the target, tile frame; (0, 0) = not known",
        "centerlines": "metres, tile frame, in driving direction",
        "centerlines_valid": "True = exists; all False = no map",
        "trajectories": "metres, tile frame, steps of dt after now, most probable mode first",
        "probabilities": "of the modes; they sum to 1",
        "covariances": "square metres, tile frame, of the trajectories' positions",
    }
    specs = contract.inputs | contract.outputs
    for value in (*proto.graph.input, *proto.graph.output):
        value.doc_string = docs[value.name]
        dims = value.type.tensor_type.shape.dim
        for dim, size in zip(dims, specs[value.name][1], strict=True):
            dim.ClearField("dim_param")
            if isinstance(size, int):
                dim.dim_value = size
            else:
                dim.dim_param = size
    proto.doc_string = f"{contract.name} {contract.version}: trajectories of traffic, see README.md"
    entries = {METADATA_KEY: json.dumps(json.loads(contract.to_json())), **metadata}
    for key, text in sorted(entries.items()):
        if not re.fullmatch(r"[a-z_]+", key):
            raise ValueError(f"metadata key {key!r}")
        proto.metadata_props.add(key=key, value=text)
