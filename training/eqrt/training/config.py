"""What a network is: sizes that travel in its checkpoint, and the unit it computes in."""

from __future__ import annotations

from dataclasses import dataclass

from eqrt.core.contract import ModelContract

UNIT_M = 10.0
"""Network units: features of traffic (speeds per second, gaps) are about 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """What the network is; travels in the checkpoint."""

    num_agents: int
    history_steps: int
    num_centerlines: int
    centerline_points: int
    horizon_steps: int
    num_modes: int
    dt_s: float
    layers: int
    """P, feature-learning layers."""
    channels: int
    """C, vectors per agent."""
    width: int
    """D, pattern width."""
    categories: int
    """R, interaction categories."""
    token_width: int
    """Width of a map token, a multiple of `heads`."""
    heads: int
    pointers: int
    """Lane vectors handed from the map to the target."""
    dropout: float
    """Share of pattern updates dropped while training."""

    def contract(self, name: str, version: str) -> ModelContract:
        """The contract an artifact of this network promises."""
        return ModelContract(
            name=name,
            version=version,
            num_agents=self.num_agents,
            history_steps=self.history_steps,
            num_centerlines=self.num_centerlines,
            centerline_points=self.centerline_points,
            horizon_steps=self.horizon_steps,
            num_modes=self.num_modes,
            dt_s=self.dt_s,
        )
