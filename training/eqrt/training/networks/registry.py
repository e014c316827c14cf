"""Every kind of network by name, and how to build one from its configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from torch import nn

from eqrt.core.contract import ModelContract
from eqrt.training.networks.compact import CompactConfig, CompactPredictor
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.eqmotion import EqMotion, EqMotionConfig
from eqrt.training.networks.lstm import LstmBaseline, LstmConfig
from eqrt.training.tables import fill

NETWORKS: Mapping[str, tuple[type[Any], type[nn.Module]]] = {
    "compact": (CompactConfig, CompactPredictor),
    "eqmotion": (EqMotionConfig, EqMotion),
    "lstm": (LstmConfig, LstmBaseline),
}
"""Kind -> (its configuration, the network). A network is built from (SceneConfig, configuration)
and maps the contract's inputs, in order, to its outputs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """A scene and a network to read it: the tables [scene] and [network]."""

    scene: SceneConfig
    kind: str
    """A key of NETWORKS."""
    network: Any
    """That kind's configuration."""

    @classmethod
    def from_tables(cls, scene: object, network: object) -> ModelConfig:
        """Raises ValueError that names the table and what is missing, unknown or wrong in it."""
        if not isinstance(network, Mapping):
            raise ValueError(f"[network] is {network!r}, expected a table")
        kind = network.get("kind")
        if not isinstance(kind, str) or kind not in NETWORKS:
            kinds = ", ".join(NETWORKS)
            raise ValueError(f"[network] kind is {kind!r}, expected one of {kinds}")
        settings = {name: value for name, value in network.items() if name != "kind"}
        return cls(
            scene=fill(SceneConfig, scene, "scene"),
            kind=kind,
            network=fill(NETWORKS[kind][0], settings, "network"),
        )

    def to_tables(self) -> dict[str, dict[str, Any]]:
        """What `from_tables` reads."""
        return {
            "scene": asdict(self.scene),
            "network": {"kind": self.kind, **asdict(self.network)},
        }

    def contract(self, name: str, version: str) -> ModelContract:
        """The contract that an artifact of this network promises."""
        draws_spread = isinstance(self.network, CompactConfig) and self.network.uncertainty
        return replace(self.scene.contract(name, version), covariances=draws_spread)


def build_network(config: ModelConfig) -> nn.Module:
    """A new network with random weights (torch's global generator)."""
    return NETWORKS[config.kind][1](config.scene, config.network)
