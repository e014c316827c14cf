"""Pieces of work for other processes, which import this module by its name."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import LogError


@dataclass(frozen=True, slots=True)
class Piece:
    """A number, and a folder for what the work leaves behind."""

    number: int
    folder: Path

    @property
    def name(self) -> str:
        """How errors call it."""
        return f"piece {self.number}"

    def first_time(self) -> bool:
        """Whether nobody worked on it before."""
        try:
            (self.folder / str(self.number)).touch(exist_ok=False)
        except FileExistsError:
            return False
        return True


def square(piece: Piece) -> int:
    """Notes that it was begun; multiples of 5 are refused."""
    piece.first_time()
    if piece.number % 5 == 0:
        raise LogError(f"{piece.name} is a multiple of 5")
    return piece.number**2


def worker_of(piece: Piece) -> int:
    """The process that did it, after a moment."""
    piece.first_time()
    time.sleep(0.05)
    return os.getpid()


def dies_once_at_4(piece: Piece) -> int:
    """Takes its process down the first time."""
    if piece.first_time() and piece.number == 4:
        os._exit(1)
    return piece.number


def dies_at_4(piece: Piece) -> int:
    """Takes down every process that works on it."""
    if piece.number == 4:
        os._exit(1)
    return piece.number


def is_wrong(piece: Piece) -> int:
    """A fault of the program."""
    raise ValueError(f"{piece.name} is wrong")
