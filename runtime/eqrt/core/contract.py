"""What a model file promises: sizes, units, names (contract version 1).

The contract travels twice: inside the ONNX file as metadata, and beside it as `contract.json` for
runtimes that cannot read ONNX metadata. docs/design.md holds the tensor table in words.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from eqrt.core.errors import ContractError

SCHEMA = 1
"""Version of this contract; changes when the inputs or their meaning change."""

METADATA_KEY = "eqrt_contract"
"""The ONNX metadata entry that holds the contract."""

MAX_CHARACTERS = 1 << 16
"""Of the contract's text; it has about 1,300."""

LANE_CHOICES = ("routes", "nearest")
"""`routes`: the ways through the lane graph that the target may go, then other lanes. `nearest`:
single lanes, the nearest first, as the papers have it. See the core modules of these names."""

UNITS = {
    "position": "m",
    "covariance": "m^2",
    "time": "s",
    "frame": "tile: x east, y north",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelContract:
    """Sizes and units the exported graph was built for. B (targets) is the only dynamic axis."""

    name: str
    """Which network this is, for example `eqrt-free`."""
    version: str
    """MAJOR.MINOR.PATCH of the artifact; MAJOR = inputs or meaning changed."""
    num_agents: int
    """N, the target first, padded."""
    history_steps: int
    """T, the last step is now."""
    num_centerlines: int
    """Q, padded."""
    centerline_points: int
    """L points per centerline."""
    horizon_steps: int
    """H, the first step is dt after now."""
    num_modes: int
    """K, most probable first."""
    dt_s: float
    """Time between steps; the same for history and horizon."""
    lane_choice: str = "routes"
    """How the centerlines are chosen: one of LANE_CHOICES."""
    covariances: bool = False
    """Whether there is a third output, how uncertain each position is (`eqrt.core.metrics`)."""

    def __post_init__(self) -> None:
        for name in _SIZES:
            if not 1 <= getattr(self, name) <= MAX_SIZE:
                raise ContractError(
                    f"model contract: {name} is {getattr(self, name)}, "
                    f"expected 1 to {MAX_SIZE}; re-export the model"
                )
        if not 0.0 < self.dt_s <= 1.0:
            raise ContractError(f"model contract: dt_s is {self.dt_s}, expected above 0 to 1 s")
        if self.lane_choice not in LANE_CHOICES:
            raise ContractError(
                f"model contract: lane_choice is {self.lane_choice!r}, expected one of "
                f"{', '.join(LANE_CHOICES)}; re-export the model with this version of eqrt"
            )

    @property
    def inputs(self) -> dict[str, tuple[str, tuple[int | str, ...]]]:
        """Input name -> (element type, shape), in order."""
        n, t, q, points = (
            self.num_agents,
            self.history_steps,
            self.num_centerlines,
            self.centerline_points,
        )
        return {
            "history": ("float32", ("B", n, t, 2)),
            "history_valid": ("bool", ("B", n, t)),
            "heading": ("float32", ("B", 2)),
            "centerlines": ("float32", ("B", q, points, 2)),
            "centerlines_valid": ("bool", ("B", q, points)),
        }

    @property
    def outputs(self) -> dict[str, tuple[str, tuple[int | str, ...]]]:
        """Output name -> (element type, shape), in order."""
        modes, steps = self.num_modes, self.horizon_steps
        outputs: dict[str, tuple[str, tuple[int | str, ...]]] = {
            "trajectories": ("float32", ("B", modes, steps, 2)),
            "probabilities": ("float32", ("B", modes)),
        }
        if self.covariances:
            outputs["covariances"] = ("float32", ("B", modes, steps, 2, 2))
        return outputs

    def to_json(self) -> str:
        """The text of `contract.json`, and of the `eqrt_contract` metadata entry."""
        tensors = {
            side: {name: {"type": kind, "shape": list(shape)} for name, (kind, shape) in spec}
            for side, spec in (("inputs", self.inputs.items()), ("outputs", self.outputs.items()))
        }
        return json.dumps({"schema": SCHEMA, **asdict(self), "units": UNITS, **tensors}, indent=2)

    @classmethod
    def from_json(cls, text: str, where: str) -> ModelContract:
        """Parse `to_json`'s text; `where` names the file in errors.

        Raises ContractError if it is not JSON, is another schema, or a field is missing or wrong.
        """
        if len(text) > MAX_CHARACTERS:
            raise ContractError(f"{where}: {len(text):,} characters are no model contract")
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:  # also for an endless number, or too deep
            raise ContractError(f"{where}: the model contract is not JSON ({error})") from error
        if not isinstance(values, Mapping):
            raise ContractError(f"{where}: the model contract is not a JSON object")
        if values.get("schema") != SCHEMA:
            raise ContractError(
                f"{where}: model contract schema {values.get('schema')} is not supported (this "
                f"runtime speaks {SCHEMA}); re-export the model with this version of eqrt"
            )
        # What artifacts from before these fields meant.
        values = {"lane_choice": "routes", "covariances": False, **values}
        arguments: dict[str, Any] = {f.name: _typed(values, f.name, where) for f in fields(cls)}
        return cls(**arguments)


_SIZES = (
    "num_agents",
    "history_steps",
    "num_centerlines",
    "centerline_points",
    "horizon_steps",
    "num_modes",
)
MAX_SIZE = 1024
"""Of an axis: far above any sensible model, low enough that a bad file cannot exhaust memory."""


def _typed(values: Mapping[str, object], name: str, where: str) -> object:
    kinds: dict[str, tuple[type, ...]] = {"dt_s": (int, float), "covariances": (bool,)}
    kind = kinds.get(name, (int,) if name in _SIZES else (str,))
    value = values.get(name)
    if not isinstance(value, kind) or (isinstance(value, bool) and bool not in kind):
        raise ContractError(
            f"{where}: model contract field {name!r} is {value!r}; re-export the model"
        )
    return value
