"""What a model is: the scene it reads, and the network that reads it. Travels in its checkpoint."""

from __future__ import annotations

from dataclasses import dataclass

from eqrt.core.contract import ModelContract

UNIT_M = 10.0
"""Network units: features of traffic (speeds per second, gaps) are about 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """The sizes of the contract: what the network reads and writes. Table [scene]."""

    num_agents: int
    """N, the target first."""
    history_steps: int
    """T, the last is now."""
    num_centerlines: int
    """Q."""
    centerline_points: int
    """L."""
    lane_choice: str
    """`routes` through the lane graph, or the `nearest` lanes (`eqrt.core.contract`)."""
    horizon_steps: int
    """H."""
    num_modes: int
    """K."""
    dt_s: float

    def contract(self, name: str, version: str) -> ModelContract:
        """The contract an artifact of this network promises."""
        return ModelContract(
            name=name,
            version=version,
            num_agents=self.num_agents,
            history_steps=self.history_steps,
            num_centerlines=self.num_centerlines,
            centerline_points=self.centerline_points,
            lane_choice=self.lane_choice,
            horizon_steps=self.horizon_steps,
            num_modes=self.num_modes,
            dt_s=self.dt_s,
        )
