"""The files that `make systems-table` compares, from configurations, with untrained weights.

    python -m bench.systems.exports NAME CONFIGS FOLDER

Weights are random, with a fixed seed: trained ones take as long.
NAME is a configuration in CONFIGS, exported as `eqrt export` does it; with `, naive`
behind it, as `torch.onnx.export` alone does it: the network as it was trained, by PyTorch's own
exporter with its own settings, and nothing done to the graph afterwards. Both files keep the
contract, and are verified against the network on the same test vectors.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import nn

from bench.systems.chosen import NAIVE, config_name
from bench.systems.naive import naive
from bench.systems.origin import note, origin_of
from eqrt.export.artifact import write_artifact
from eqrt.export.to_onnx import to_onnx
from eqrt.training.checkpoint import Card
from eqrt.training.configuration import load_config
from eqrt.training.networks.registry import ModelConfig, build_network

SEED = 1


def main(arguments: list[str]) -> int:
    """Export one."""
    name, configs, folder = arguments
    export(name, Path(configs) / f"{config_name(name)}.toml", Path(folder))
    return 0


def export(name: str, config: Path, folder: Path) -> None:
    """Write the artifact. Raises EqrtError if the file does not answer as the network does."""
    training = load_config(config)
    network = untrained(training.model)
    contract = training.model.contract(name, "0.0.0")
    card = Card(
        name=name,
        data="none: random weights, to measure times with",
        license="none",
        non_commercial=False,
        metrics={},
        baseline={},
        command="none",
        config_sha256=training.sha256,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        steps=0,
        seed=SEED,
    )
    translate = naive if name.endswith(NAIVE) else to_onnx
    write_artifact(network, contract, card, folder, translate=translate)
    note(origin_of(name, config), folder)


def untrained(config: ModelConfig) -> nn.Module:
    """The network with random weights, always the same."""
    torch.manual_seed(SEED)
    return build_network(config).eval()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
