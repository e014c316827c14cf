"""What decoding costs: start, memory, and every message."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import cantools.database

import eqrt.runtime.decoding.profile
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.cycles import Cycle
from eqrt.runtime.decoding.decoder_counters import DecoderCounters
from eqrt.runtime.decoding.objects import ObjectDecoder
from eqrt.runtime.decoding.profile import load_profile

DBC = Path(eqrt.runtime.decoding.profile.__file__).parent / "dbc" / "ars408.dbc"
HEADER, GENERAL, QUALITY, EXTENDED = 0x60A, 0x60B, 0x60C, 0x60D
NUM_OBJECTS = 100

CYCLE_BUDGET_S = 0.0005  # decode of a closed cycle of 100 objects, median
OTHER_MESSAGE_BUDGET_S = 2e-6  # a message that is not ours: a full bus has 4,000 of them a second


def ars408_messages() -> list[can.Message]:
    """One cycle of 100 objects with everything that the radar can send about them."""
    noise = random.Random(408)
    payloads = [(HEADER, bytes([NUM_OBJECTS, 0, 0, 16]))]
    for arbitration_id, length in ((GENERAL, 8), (QUALITY, 7), (EXTENDED, 8)):
        for i in range(NUM_OBJECTS):
            data = bytes([i]) + noise.randbytes(length - 1)
            if arbitration_id == QUALITY:
                data = data[:-1] + b"\xe8"  # exists, measured
            payloads.append((arbitration_id, data))
    return [
        can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False)
        for arbitration_id, data in payloads
    ]


def closed_cycle() -> Cycle:
    header, *objects = ars408_messages()
    payloads = [
        [one.data for one in objects if one.arbitration_id == part]
        for part in (GENERAL, QUALITY, EXTENDED)
    ]
    return Cycle(
        payloads=payloads,
        header=header.data,
        count=NUM_OBJECTS,
        first_s=0.0,
        last_s=0.0,
        complete=True,
    )


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Seconds of the fastest run: what the work costs when nothing else runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def test_a_cycle_of_100_objects_decodes_in_time(benchmark: Any) -> None:
    decoder = ObjectDecoder(load_profile("ars408").sensors[0], DecoderCounters())
    cycle = closed_cycle()
    detections = benchmark.pedantic(decoder.decode, (cycle,), rounds=1000, warmup_rounds=50)
    assert len(detections.object_id) == NUM_OBJECTS
    if benchmark.enabled:
        assert benchmark.stats.stats.median < CYCLE_BUDGET_S


def test_one_vectorised_decode_is_faster_than_cantools_message_by_message() -> None:
    decoder = ObjectDecoder(load_profile("ars408").sensors[0], DecoderCounters())
    cycle, messages = closed_cycle(), ars408_messages()
    database: Any = cantools.database.load_file(DBC)
    oracle = {
        m.arbitration_id: database.get_message_by_frame_id(m.arbitration_id) for m in messages
    }

    def one_by_one() -> None:
        for message in messages:
            oracle[message.arbitration_id].decode_simple(message.data, decode_choices=False)

    assert best_of(50, lambda: decoder.decode(cycle)) < 0.5 * best_of(20, one_by_one)


def test_messages_of_others_cost_next_to_nothing(benchmark: Any) -> None:
    decoder = Decoder(load_profile("ars408"))
    message = can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False)
    assert benchmark.pedantic(decoder.feed, (message, 0.0), rounds=1000, iterations=100) == []
    if benchmark.enabled:
        assert benchmark.stats.stats.median < OTHER_MESSAGE_BUDGET_S


def test_messages_of_a_cycle(benchmark: Any) -> None:
    """The whole way from 301 messages to 100 detections."""
    decoder = Decoder(load_profile("ars408"))
    messages = ars408_messages()

    def cycle() -> None:
        for message in messages:
            decoder.feed(message, 0.0)

    benchmark.pedantic(cycle, rounds=200, warmup_rounds=10)
    assert decoder.counters.objects == NUM_OBJECTS * decoder.counters.cycles > 0


def test_cantools_is_imported_only_when_a_profile_is_loaded() -> None:
    """It costs 50 ms and 3 MB."""
    program = (
        "import sys\n"
        "from eqrt.runtime.decoding.can_io import Decoder\n"
        "from eqrt.runtime.decoding.profile import load_profile\n"
        "assert 'cantools' not in sys.modules\n"
        "load_profile('generic')\n"
        "assert 'cantools' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
