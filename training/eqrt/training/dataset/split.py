"""Which recordings are trained on, and which only measure.

The side of a recording is a number drawn from its group's name and a seed, so it depends neither on
the order of the recordings nor on what else is in the dataset: a sample of it, or more of it, is
split the same way. Recordings that share vehicles share a group, and so a side.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from eqrt.core.errors import EqrtError

TRAIN, VAL = "train", "val"
SIDES = (TRAIN, VAL, "all")


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """How a dataset is split."""

    seed: int = 0
    held_out_share: float = 0.2
    """Of the groups, in 0 to 1, on average: few groups may come out far from it."""
    held_out: tuple[str, ...] = ()
    """Recordings or groups that are held out, and no others; empty = drawn. A recording takes its
    whole group with it."""
    others_elsewhere: bool = False
    """What of `held_out` is not here is in another dataset: a training configuration names what is
    held out of all of them."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.held_out_share <= 1.0:
            raise ValueError(f"the share held out is {self.held_out_share}, expected 0 to 1")

    def sides(self, recordings: Sequence[tuple[str, str]]) -> list[str]:
        """TRAIN or VAL for each (name, group).

        Raises EqrtError if something is held out that is not among them, unless it is elsewhere.
        """
        if not self.held_out:
            return [split_of(group, self.seed, self.held_out_share) for _, group in recordings]
        wanted = set(self.held_out)
        unknown = sorted(wanted.difference(*recordings))
        if unknown and not self.others_elsewhere:
            raise EqrtError(f"held out is {unknown[0]!r}, which is no recording or group here")
        groups = {group for name, group in recordings if wanted & {name, group}}
        return [VAL if group in groups else TRAIN for _, group in recordings]


def split_of(group: str, seed: int, held_out_share: float) -> str:
    """TRAIN or VAL."""
    return VAL if _drawn(f"{seed}:{group}") < held_out_share else TRAIN


def in_share(group: str, share: float) -> bool:
    """Whether a group is among the `share` of all that a training may use.

    Whatever is in a smaller share is in every larger one; it has nothing to do with the sides.
    """
    return _drawn(f"share:{group}") < share


def group_digest(source: str, group: str) -> str:
    """How a model remembers a group of a source's that it was trained on: 12 hexadecimal digits.

    Names of recordings may be private, and a model gets about.
    """
    return hashlib.sha256(f"{source}\n{group}".encode()).hexdigest()[:12]


def _drawn(text: str) -> float:
    """A number, uniform in [0, 1)."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") / 2**64
