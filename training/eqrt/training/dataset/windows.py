"""Training windows: recordings cut into scenes, by the code that builds them in the car."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from eqrt.core.contract import ModelContract
from eqrt.core.errors import LogError
from eqrt.core.lane_choice import centerline_source
from eqrt.core.lanes import MAX_COORDINATE_M, LaneMap
from eqrt.core.scene import AgentHistories, CenterlineSource, Scene, build_scene, tile_origin
from eqrt.training.recordings.recording import Recording

Bool = NDArray[np.bool_]
Rows = NDArray[np.intp]

MIN_HISTORY_STEPS = 2
MIN_FUTURE_STEPS = 10
"""A window whose target is seen for less than a second afterwards teaches nothing about 3 s."""
MIN_DRIVE_M = 5.0
"""A complete track that moves less, from its first step to its last, stands."""
TARGETS = ("focal", "complete", "all")
_KNOWN_MAPS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """W windows: scenes, what happened next, and where they are from.

    Axes as in `eqrt.core.scene`.
    """

    history: NDArray[np.float32]
    """(W, N, T, 2) metres, tile frame."""
    history_valid: Bool
    """(W, N, T)"""
    heading: NDArray[np.float32]
    """(W, 2)"""
    centerlines: NDArray[np.float32]
    """(W, Q, L, 2) metres, tile frame."""
    centerlines_valid: Bool
    """(W, Q, L)"""
    future: NDArray[np.float32]
    """(W, H, 2) metres, tile frame; 0 where not seen."""
    future_valid: Bool
    """(W, H)"""
    focal: Bool
    """(W,) the dataset itself is evaluated on this target."""
    origin: NDArray[np.float64]
    """(W, 2) map position of the tile frame's zero."""
    recording: NDArray[np.int32]
    """(W,) index in the caller's list of recordings."""
    agent: NDArray[np.int32]
    """(W,) the target's row in its recording's tracks."""
    step: NDArray[np.int32]
    """(W,) the recording's step that is now."""

    def __len__(self) -> int:
        return len(self.history)

    def complete(self) -> Windows:
        """The windows whose target was seen at every step of history and future."""
        seen = np.concatenate([self.history_valid[:, 0], self.future_valid], axis=1)
        return self.select(np.flatnonzero(np.all(seen, axis=1)))

    def select(self, rows: Rows) -> Windows:
        """The windows `rows`."""
        return Windows(**{name: getattr(self, name)[rows] for name in COLUMNS})

    def checksum(self, before: int = 0) -> int:
        """Of every bit, going on from that of what came before."""
        for name in COLUMNS:
            before = zlib.crc32(np.ascontiguousarray(getattr(self, name)).tobytes(), before)
        return before

    def tensors(self) -> dict[str, Tensor]:
        """Inputs and futures as torch tensors, no copy."""
        return {name: torch.from_numpy(getattr(self, name)) for name in TENSORS}


COLUMNS = tuple(Windows.__annotations__)
TENSORS = COLUMNS[:7]
"""What training reads; the other columns say where it is from."""


def join(parts: Sequence[Windows]) -> Windows:
    """All windows of `parts`."""
    return Windows(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in COLUMNS})


def no_windows(contract: ModelContract) -> Windows:
    """Zero windows."""
    spec: dict[str, tuple[str, tuple[int | str, ...]]] = {
        **contract.inputs,
        "future": ("float32", ("B", contract.horizon_steps, 2)),
        "future_valid": ("bool", ("B", contract.horizon_steps)),
        "focal": ("bool", ("B",)),
        "origin": ("float64", ("B", 2)),
        **dict.fromkeys(("recording", "agent", "step"), ("int32", ("B",))),
    }
    empty = {
        name: np.zeros([0 if size == "B" else int(size) for size in shape], kind)
        for name, (kind, shape) in spec.items()
    }
    return Windows(**empty)


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowOptions:
    """Which windows are cut."""

    stride: int | None = None
    """Steps between windows, beside those where the dataset says now; None = there only, or where
    it does not say it, every 5 steps."""
    targets: str = "all"
    """`focal`: the dataset's own targets. `complete`: every track that is seen at each step of its
    window and drives. `all`: every track seen now with a little past and future."""

    def __post_init__(self) -> None:
        if self.targets not in TARGETS:
            raise ValueError(f"targets are {self.targets!r}, expected one of {TARGETS}")


class WindowCutter:
    """Cuts recordings into windows for one model contract."""

    def __init__(self, contract: ModelContract, options: WindowOptions) -> None:
        self._contract = contract
        self._options = options
        self._sources: list[tuple[LaneMap, CenterlineSource]] = []

    def cut(self, recording: Recording, index: int) -> Windows:
        """The windows of one recording, by step and then by track; `index` names it in them.

        Raises LogError if its clock is not the model's, or its tracks lie farther apart than any
        drive: float32 would make them infinite, or too coarse to learn from.
        """
        if not np.isclose(recording.dt_s, self._contract.dt_s, rtol=1e-3):
            raise LogError(
                f"{recording.name}: time step {recording.dt_s} s, the model's is "
                f"{self._contract.dt_s} s; resample the recording"
            )
        seen = recording.tracks.positions[recording.tracks.valid]
        if len(seen) and not np.ptp(seen, axis=0).max() <= MAX_COORDINATE_M:  # nor if it is NaN
            raise LogError(
                f"{recording.name}: positions lie more than {MAX_COORDINATE_M / 1e3:.0f} km apart; "
                "the recording is damaged"
            )
        source = None if recording.lanes is None else self._source(recording.lanes)
        parts = [self._cut_at(recording, index, step, source) for step in self._steps(recording)]
        parts = [part for part in parts if len(part)]
        return join(parts) if parts else no_windows(self._contract)

    def _steps(self, recording: Recording) -> Sequence[int]:
        """With a stride also the dataset's own: of a short scene, others are hardly complete."""
        own = recording.now_steps or ()
        if own and self._options.stride is None:
            return own
        last = recording.tracks.num_steps - MIN_FUTURE_STEPS
        return sorted({*range(MIN_HISTORY_STEPS - 1, last, self._options.stride or 5), *own})

    def _cut_at(
        self, recording: Recording, index: int, step: int, source: CenterlineSource | None
    ) -> Windows:
        contract = self._contract
        agents = recording.tracks.histories(step, contract.history_steps)
        future, future_valid = recording.tracks.future(step, contract.horizon_steps)
        targets = np.flatnonzero(self._are_targets(recording, agents, future, future_valid))
        if not len(targets):
            return no_windows(contract)
        origin = tile_origin(agents.positions[targets[0], -1])
        scene = build_scene(agents, targets, contract, source, origin)
        count = len(targets)
        columns: dict[str, Any] = {**scene.inputs()}
        return Windows(
            **columns,
            **_future(scene, future[targets], future_valid[targets]),
            focal=recording.focal[targets],
            origin=np.tile(origin, (count, 1)),
            recording=np.full(count, index, np.int32),
            agent=targets.astype(np.int32),
            step=np.full(count, step, np.int32),
        )

    def _are_targets(
        self,
        recording: Recording,
        agents: AgentHistories,
        future: NDArray[np.float64],
        future_valid: Bool,
    ) -> Bool:
        usable: Bool = (
            recording.may_be_target
            & agents.valid[:, -1]
            & (agents.valid.sum(axis=1) >= MIN_HISTORY_STEPS)
            & (future_valid.sum(axis=1) >= MIN_FUTURE_STEPS)
        )
        if self._options.targets == "focal":
            usable = np.logical_and(usable, recording.focal)
        if self._options.targets == "complete":
            drive = future[:, -1] - agents.positions[:, 0]
            seen = agents.valid.all(axis=1) & future_valid.all(axis=1)
            usable = np.logical_and(usable, seen & (np.hypot(*drive.T) >= MIN_DRIVE_M))
        return usable

    def _source(self, lanes: LaneMap) -> CenterlineSource:
        """What finds centerlines on `lanes`; the last few maps are kept, most share one."""
        for known, source in self._sources:
            if known is lanes:
                return source
        source = centerline_source(lanes, self._contract)
        self._sources = [*self._sources[1 - _KNOWN_MAPS :], (lanes, source)]
        return source


def _future(scene: Scene, future: NDArray[np.float64], valid: Bool) -> dict[str, NDArray[Any]]:
    seen = np.where(valid[..., None], future - scene.origin, 0.0)
    return {"future": seen.astype(np.float32), "future_valid": valid}
