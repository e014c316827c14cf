"""What a model is: the scene it reads, and the network that reads it. Travels in its checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec

from eqrt.core.contract import LANE_CHOICES, MAX_SIZE, ModelContract
from eqrt.training.tables import check_choice

Size = Annotated[int, msgspec.Meta(ge=1, le=MAX_SIZE)]
Points = Annotated[int, msgspec.Meta(ge=2, le=MAX_SIZE)]
"""Places, of which one alone leads nowhere."""
UNIT_M = 10.0
"""Network units: features of traffic (speeds per second, gaps) are about 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """The sizes of the contract: what the network reads and writes. Table [scene]."""

    num_agents: Size
    """N, the target first."""
    history_steps: Points
    """T, the last is now."""
    num_centerlines: Size
    """Q."""
    centerline_points: Points
    """L."""
    lane_choice: str
    """`routes` through the lane graph, or the `nearest` lanes (`eqrt.core.contract`)."""
    horizon_steps: Size
    """H."""
    num_modes: Size
    """K."""
    dt_s: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]

    def __post_init__(self) -> None:
        check_choice("lane_choice", self.lane_choice, LANE_CHOICES)

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
