"""Training windows: recorded scenarios cut into scenes, by the code that builds them in the car."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from eqrt.core.contract import ModelContract
from eqrt.core.errors import EqrtError
from eqrt.core.routes import RouteFinder
from eqrt.core.scene import AgentHistories, Scene, build_scene, tile_origin
from eqrt.training.commonroad import Scenario, lane_map, read_scenario

MIN_HISTORY_STEPS = 2
MIN_FUTURE_STEPS = 10
"""A window whose target is seen for less than a second afterwards teaches nothing about 3 s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """W windows: scenes and what happened next. Axes as in `eqrt.core.scene`."""

    history: NDArray[np.float32]
    history_valid: NDArray[np.bool_]
    heading: NDArray[np.float32]
    centerlines: NDArray[np.float32]
    centerlines_valid: NDArray[np.bool_]
    future: NDArray[np.float32]
    """(W, H, 2) tile frame; 0 where not seen."""
    future_valid: NDArray[np.bool_]
    """(W, H)"""

    def __len__(self) -> int:
        return len(self.history)

    def complete(self) -> Windows:
        """The windows whose target was seen at every step of history and future."""
        seen = np.concatenate([self.history_valid[:, 0], self.future_valid], axis=1)
        return self.select(np.flatnonzero(np.all(seen, axis=1)))

    def select(self, rows: NDArray[np.intp]) -> Windows:
        """The windows `rows`."""
        return Windows(**{name: getattr(self, name)[rows] for name in _FIELDS})

    def tensors(self) -> dict[str, Tensor]:
        """Every array as a torch tensor, no copy."""
        return {name: torch.from_numpy(getattr(self, name)) for name in _FIELDS}


_FIELDS = tuple(Windows.__annotations__)


def join(parts: Sequence[Windows]) -> Windows:
    """All windows of `parts`."""
    return Windows(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in _FIELDS})


def scenario_files(folder: Path) -> list[Path]:
    """The CommonRoad scenarios in a folder, by name."""
    files = sorted([*folder.glob("*.xml"), *folder.glob("*.xml.gz")])
    if not files:
        raise EqrtError(f"{folder}: no CommonRoad scenario (*.xml, *.xml.gz) here")
    return files


def scenario_name(path: Path) -> str:
    """The name a scenario file goes by, its suffixes dropped."""
    return path.name.removesuffix(".gz").removesuffix(".xml")


def load_windows(files: Sequence[Path], contract: ModelContract, stride: int) -> Windows:
    """Windows of all scenario files, one every `stride` steps."""
    return join([scenario_windows(read_scenario(path), contract, stride) for path in files])


def scenario_windows(scenario: Scenario, contract: ModelContract, stride: int) -> Windows:
    """One window for every target of every `stride`-th step with enough past and future."""
    if not np.isclose(scenario.dt_s, contract.dt_s):
        raise EqrtError(
            f"{scenario.name}: time step {scenario.dt_s} s, the model's is {contract.dt_s} s"
        )
    grid = TrackGrid.of(scenario)
    finder = RouteFinder(lane_map(scenario))
    steps = range(MIN_HISTORY_STEPS - 1, grid.num_steps - MIN_FUTURE_STEPS, stride)
    parts = [part for step in steps if (part := _windows_at(grid, step, contract, finder))]
    if not parts:
        return _no_windows(contract)
    return join(parts)


@dataclass(frozen=True, slots=True)
class TrackGrid:
    """A scenario's tracks on one clock: A agents, S steps."""

    positions: NDArray[np.float64]
    """(A, S, 2) map frame."""
    heading_rad: NDArray[np.float64]
    """(A, S)"""
    valid: NDArray[np.bool_]
    """(A, S)"""

    @classmethod
    def of(cls, scenario: Scenario) -> TrackGrid:
        """Spread every track over the scenario's steps."""
        count = len(scenario.tracks)
        steps = 1 + max((int(track.step.max()) for track in scenario.tracks), default=-1)
        grid = cls(
            np.zeros((count, steps, 2)),
            np.zeros((count, steps)),
            np.zeros((count, steps), np.bool_),
        )
        for row, track in enumerate(scenario.tracks):
            grid.positions[row, track.step] = track.position
            grid.heading_rad[row, track.step] = track.heading_rad
            grid.valid[row, track.step] = True
        return grid

    @property
    def num_steps(self) -> int:
        """S."""
        return int(self.valid.shape[1])

    def histories(self, step: int, history_steps: int) -> AgentHistories:
        """What was known at `step`: the last `history_steps` steps up to it."""
        steps = np.arange(step - history_steps + 1, step + 1)
        inside = steps >= 0
        heading = self.heading_rad[:, step]
        known = self.valid[:, step, None]
        return AgentHistories(
            positions=self.positions[:, np.maximum(steps, 0)],
            valid=self.valid[:, np.maximum(steps, 0)] & inside,
            heading=np.where(known, np.stack([np.cos(heading), np.sin(heading)], -1), 0.0),
        )

    def future(
        self, step: int, horizon_steps: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Positions (A, H, 2) after `step` and whether they were seen (A, H)."""
        steps = np.arange(step + 1, step + 1 + horizon_steps)
        inside = steps < self.num_steps
        steps = np.minimum(steps, self.num_steps - 1)
        return self.positions[:, steps], self.valid[:, steps] & inside


def _windows_at(
    grid: TrackGrid, step: int, contract: ModelContract, finder: RouteFinder
) -> Windows | None:
    agents = grid.histories(step, contract.history_steps)
    future, future_valid = grid.future(step, contract.horizon_steps)
    usable = (
        agents.valid[:, -1]
        & (agents.valid.sum(axis=1) >= MIN_HISTORY_STEPS)
        & (future_valid.sum(axis=1) >= MIN_FUTURE_STEPS)
    )
    targets = np.flatnonzero(usable)
    if not len(targets):
        return None
    origin = tile_origin(agents.positions[targets[0], -1])
    scene = build_scene(agents, targets, contract, finder, origin)
    return _as_windows(scene, future[targets] - origin, future_valid[targets])


def _as_windows(
    scene: Scene, future: NDArray[np.float64], future_valid: NDArray[np.bool_]
) -> Windows:
    seen = np.where(future_valid[..., None], future, 0.0).astype(np.float32)
    return Windows(
        history=scene.history,
        history_valid=scene.history_valid,
        heading=scene.heading,
        centerlines=scene.centerlines,
        centerlines_valid=scene.centerlines_valid,
        future=seen,
        future_valid=future_valid,
    )


def _no_windows(contract: ModelContract) -> Windows:
    horizon = ("B", contract.horizon_steps)
    spec = contract.inputs | {
        "future": ("float32", (*horizon, 2)),
        "future_valid": ("bool", horizon),
    }
    empty = {
        name: np.zeros([0 if size == "B" else int(size) for size in shape], kind)
        for name, (kind, shape) in spec.items()
    }
    return Windows(**empty)


def batches(
    windows: Windows, batch_size: int, generator: torch.Generator
) -> Iterator[dict[str, Tensor]]:
    """Shuffled batches without end; every window comes once per epoch, the rest is dropped."""
    tensors = windows.tensors()
    if len(windows) < batch_size:
        raise EqrtError(f"{len(windows)} training windows, fewer than one batch of {batch_size}")
    while True:
        order = torch.randperm(len(windows), generator=generator)
        for start in range(0, len(order) - batch_size + 1, batch_size):
            rows = order[start : start + batch_size]
            yield {name: tensor[rows] for name, tensor in tensors.items()}
