"""Training that goes on from the weights of another one, on other data or with other settings.

Whatever the other one's data asked for, the new weights owe it, too: credits and licences are those
of both.
"""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

from torch import Tensor

from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import load_checkpoint, load_tensors
from eqrt.training.configuration import TrainConfig, differences
from eqrt.training.dataset.store import join_sources
from eqrt.training.recordings.recording import Source
from eqrt.training.state import TrainingState


@dataclass(frozen=True, slots=True)
class Start:
    """Weights to begin with."""

    path: Path
    """Of the checkpoint that they come from."""
    tensors: dict[str, Tensor]
    source: Source
    """Of the data behind them."""
    trained_on: tuple[str, ...]
    """Likewise, the groups (`Card.trained_on`)."""

    def fingerprint(self) -> dict[str, int]:
        """The same for the same weights, and hardly ever for others."""
        checksum = 0
        for name in sorted(self.tensors):
            checksum = zlib.crc32(self.tensors[name].contiguous().numpy().tobytes(), checksum)
        return {"start": checksum}

    def begin(self, state: TrainingState) -> None:
        """Give a new training these weights; EqrtError says which do not fit."""
        load_tensors(self.path, state.network, self.tensors)
        load_tensors(self.path, state.average, self.tensors)


def open_start(path: Path, config: TrainConfig) -> Start:
    """The weights of the checkpoint at `path`, for a training of `config`.

    Raises EqrtError if it is none, or reads or writes something else than `config` asks for.
    """
    found = load_checkpoint(path)
    different = differences(asdict(found.config.scene), asdict(config.model.scene))
    if different:
        raise EqrtError(
            f"{path}: is of another scene: {'; '.join(different)}; make [scene] the same, or start "
            "without it"
        )
    card = found.card
    source = Source(
        name=card.name,
        credits=card.data,
        license=card.license,
        non_commercial=card.non_commercial,
    )
    return Start(path, dict(found.network.state_dict()), source, card.trained_on)


def credited(data: Source, start: Start | None) -> Source:
    """Whose data is in weights that are trained on `data`, from `start` on (None = random ones)."""
    return data if start is None else join_sources([data, start.source])
