"""The naive export: what `torch.onnx.export` makes of a network, and nothing else."""

from __future__ import annotations

import logging
import warnings

import torch
from torch import nn

from eqrt.core.contract import METADATA_KEY, ModelContract

_BATCH = 3  # of the example: any size above 1, which would be taken for a constant


def naive(network: nn.Module, contract: ModelContract, metadata: dict[str, str]) -> bytes:
    """What `torch.onnx.export` makes of the network, with the contract's names and B dynamic.

    Of the metadata, only what the runtime asks for is added: it changes no node.
    """
    example = tuple(
        torch.zeros([_BATCH, *map(int, shape[1:])], dtype=getattr(torch, kind))
        for kind, shape in contract.inputs.values()
    )
    batch = torch.export.Dim("B")
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        program = torch.onnx.export(
            network.eval(),
            example,
            dynamo=True,
            input_names=list(contract.inputs),
            output_names=list(contract.outputs),
            dynamic_shapes=tuple({0: batch} for _ in example),
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    for key, text in {METADATA_KEY: contract.to_json(), **metadata}.items():
        proto.metadata_props.add(key=key, value=text)
    return bytes(proto.SerializeToString(deterministic=True))
