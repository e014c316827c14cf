"""`make soak`, for seconds."""

from __future__ import annotations

import numpy as np

from soak.run import Soak, real, simulated


def test_half_a_minute_on_a_virtual_clock() -> None:
    """Every cycle is predicted, in every mode that promises something."""
    soak = simulated(30.0, 4)
    assert sum(soak.modes.values()) == 300
    assert soak.modes["RUN"] > 280
    assert soak.targets["RUN"] > 0
    assert "CAN messages" in soak.notes


def test_some_seconds_in_real_time() -> None:
    soak = real(5.0, 4)
    assert 40 <= sum(soak.modes.values()) <= 51
    assert "bus_dropped 0" in soak.notes
    assert soak.resident_mib[0] > 30.0


def test_the_slopes_are_those_of_the_memory_after_the_warm_up() -> None:
    """A hundredth of a MiB a second of its own, half of that of files, after a jump."""
    soak = Soak("test", 100.0)
    soak.times_s = np.arange(0.0, 100.0, 1.0).tolist()
    soak.memory_mib = [
        (50.0 if t < 5.0 else 60.0 + 0.01 * t, 20.0 + 0.005 * t) for t in soak.times_s
    ]
    np.testing.assert_allclose(soak.slopes_mib_per_day(), (864.0, 432.0), rtol=1e-6)
    assert "slope: +1296.00 MiB a day, of which +864.00 its own data" in "\n".join(soak.lines())
