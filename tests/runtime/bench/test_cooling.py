"""How cold a core goes while it waits."""

from __future__ import annotations

import time

from eqrt.runtime.bench.cooling import cooling
from eqrt.runtime.bench.environment import read_environment


def test_it_is_a_ratio_of_two_times_that_were_measured_and_takes_a_second() -> None:
    begun_s = time.process_time()
    found = cooling()
    assert 0.2 < found < 1e4  # whoever else is busy here
    assert time.process_time() - begun_s > 0.3  # it waits busily: nobody else gets the core


def test_it_is_told_of_the_machine() -> None:
    told = read_environment().cooling
    assert told is not None
    assert told > 0.2
