"""Whether some scenes take longer than others, whenever they come.

What disturbs a run hits any scene, and another one next time. A scene that was slow in one half of
its turns and in the other is slow by itself: its numbers become subnormal, say, for which some
processors stop.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eqrt.runtime.bench.percentiles import Int64

_QUICK = 0.1  # quantile of the scenes: all but the quickest may be slow
_SLOW = 1.5  # times as long as these
_FEW = 0.02  # of the scenes; fewer may have been disturbed twice


def slow_scenes(number: Int64, total_ns: Int64, scenes: int) -> Iterator[str]:
    """A line of advice, if there are any. Runs (R,) and how long they took; run n has scene n % S.

    Says nothing before every scene has come twice.
    """
    round_, scene = number // scenes, number % scenes
    halves = np.stack(
        [
            _quickest(scene[round_ % 2 == half], total_ns[round_ % 2 == half], scenes)
            for half in (0, 1)
        ]
    )
    if not np.isfinite(halves).all():
        return
    quick_ns = np.quantile(halves, _QUICK)
    slow = (halves > _SLOW * quick_ns).all(axis=0)
    if slow.mean() > _FEW:
        ratio = np.median(halves[:, slow]) / quick_ns
        yield (
            f"{slow.mean():.0%} of the scenes take {ratio:.1f} x as long as others, whenever "
            "they come: do exponentials become subnormal there? see docs/benchmarks.md"
        )


def _quickest(scene: Int64, total_ns: Int64, scenes: int) -> np.typing.NDArray[np.float64]:
    """(S,) the shortest run of each scene; infinite for one without."""
    quickest = np.full(scenes, np.inf)
    np.minimum.at(quickest, scene, total_ns)
    return quickest
