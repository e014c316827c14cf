"""Fields and conditions of a profile, read from the values that messages decode to.

The messages that describe one object (or the ego vehicle) are its parts; a `Reference` says which
part, and which row of the values that are decoded from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eqrt.runtime.decoding.conditions import Evaluate

Values = Sequence[Any]
"""By part, then by row of the part: floats, or arrays with one element per object."""

_NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Reference:
    """A column of a part."""

    part: int
    row: int


@dataclass(frozen=True, slots=True)
class BoundCondition:
    """A condition of the profile, and where its operands come from."""

    evaluate: Evaluate
    operands: tuple[Reference, ...]

    def holds(self, values: Values) -> Any:
        """Truth, one per object if the values are arrays."""
        return self.evaluate([values[operand.part][operand.row] for operand in self.operands])


@dataclass(frozen=True, slots=True)
class BoundField:
    """A field of the profile in SI units: the mean of some columns, where `when` holds."""

    columns: tuple[Reference, ...]
    when: BoundCondition | None

    def number(self, values: Values) -> float:
        """The value, where `values` are floats; NaN = it is not there."""
        if self.when is not None and not self.when.holds(values):
            return _NAN
        return float(self._mean(values))

    def array(self, values: Values) -> NDArray[np.float64]:
        """One value per object, where `values` are arrays; NaN = it is not there."""
        mean: NDArray[np.float64] = self._mean(values)
        return mean if self.when is None else np.where(self.when.holds(values), mean, _NAN)

    def _mean(self, values: Values) -> Any:
        first, *others = [values[column.part][column.row] for column in self.columns]
        return sum(others, first) / len(self.columns) if others else first
