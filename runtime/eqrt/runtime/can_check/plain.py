"""Numbers as people read them, also those of a mapping that is wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LONG = 1e6
_HUGE = 1e30  # a double in the wrong byte order reaches 1e308, whose square no float holds


def plain(value: float | None, decimals: int = 0) -> str:
    """With so many decimals; very large ones by their power of ten, a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.{decimals}f}" if abs(value) < _LONG else f"{value:.3g}"


def bounded(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same up to 1e30, and that for larger ones: sums and products of them stay finite."""
    return np.where(np.isfinite(numbers), np.clip(numbers, -_HUGE, _HUGE), numbers)
