"""What a training learns from besides its data: weights to begin with, and teachers.

Whatever the data behind these asked for, the new weights owe it, too: credits and licences are
those of all.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from torch import nn

from eqrt.core.errors import EqrtError
from eqrt.training.checkpoint import load_checkpoint, load_tensors
from eqrt.training.configuration import TrainConfig, differences
from eqrt.training.dataset.store import join_sources
from eqrt.training.recordings.recording import Source
from eqrt.training.state import TrainingState


@dataclass(frozen=True, slots=True)
class Origin:
    """A checkpoint, as something to learn from."""

    path: Path
    network: nn.Module
    """In evaluation mode."""
    source: Source
    """Of the data behind it."""
    trained_on: tuple[str, ...]
    """Likewise, the groups (`Card.trained_on`)."""

    def checksum(self) -> int:
        """The same for the same weights, and hardly ever for others."""
        checksum = 0
        for _, tensor in sorted(self.network.state_dict().items()):
            checksum = zlib.crc32(tensor.cpu().contiguous().numpy().tobytes(), checksum)
        return checksum


@dataclass(frozen=True, slots=True)
class Origins:
    """All that a training learns from besides its data; empty = it begins with random weights."""

    start: Origin | None = None
    """Weights to begin with."""
    teachers: tuple[Origin, ...] = ()
    """What they expect is a part of the lessons (`eqrt.training.teachers`)."""

    def begin(self, state: TrainingState) -> None:
        """Give a new training the weights to begin with; EqrtError says which do not fit."""
        if self.start is not None:
            tensors = self.start.network.state_dict()
            load_tensors(self.start.path, state.network, tensors)
            load_tensors(self.start.path, state.average, tensors)

    def fingerprint(self) -> dict[str, int]:
        """Tells trainings apart by what they learn from."""
        start = {} if self.start is None else {"start": self.start.checksum()}
        return start | {f"teacher {i + 1}": t.checksum() for i, t in enumerate(self.teachers)}

    def credited(self, data: Source) -> Source:
        """Whose data is in the weights, if they are trained on `data`."""
        return join_sources([data, *(origin.source for origin in self)])

    def trained_on(self, groups: Iterable[str]) -> tuple[str, ...]:
        """The groups of recordings behind the weights, if they are trained on `groups`."""
        return tuple(sorted({*groups, *(name for origin in self for name in origin.trained_on)}))

    def __iter__(self) -> Iterator[Origin]:
        if self.start is not None:
            yield self.start
        yield from self.teachers


def open_origin(path: Path, config: TrainConfig) -> Origin:
    """The checkpoint at `path`, for a training of `config`.

    Raises EqrtError if it is none, or reads or writes something else than `config` asks for.
    """
    found = load_checkpoint(path)
    different = differences(asdict(found.config.scene), asdict(config.model.scene))
    if different:
        raise EqrtError(
            f"{path}: is of another scene: {'; '.join(different)}; make [scene] the same, or train "
            "without it"
        )
    card = found.card
    source = Source(
        name=card.name,
        credits=card.data,
        license=card.license,
        non_commercial=card.non_commercial,
    )
    return Origin(path, found.network, source, card.trained_on)
