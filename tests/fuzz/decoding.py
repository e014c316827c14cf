"""Fuzzed: messages of every built-in profile through the decoder, and through the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import islice

import can
import numpy as np

from can_recordings import feed_all, messages_of
from drives import DRIVES, TILE, Car, shipped_predictor
from drives import traffic as cars_on_the_bus
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.profile import Profile, builtin_profiles, load_profile
from eqrt.runtime.output.can_output import encode_classic, encode_fd
from eqrt.runtime.output.datagrams import Datagram, decode_datagram, encode_datagrams
from eqrt.runtime.output.forecasts import ForecastSet
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.replay import replay
from fuzz.target import Target
from fuzz.traffic import as_bytes, traffic
from soundness import assert_sound

_SEED_MESSAGES = 120


def addresses_of(profile: Profile) -> list[tuple[int, bool]]:
    """Every id of the profile, and whether it is an extended one, in a fixed order."""
    parts = [part.address for ego in profile.ego for part in ego.parts]
    for sensor in profile.sensors:
        parts += [address for part in sensor.parts for address in part.addresses]
        parts += [sensor.header.address] if sensor.header else []
    return sorted({(part.arbitration_id, part.is_extended) for part in parts})


@cache
def _profile(which: int) -> Profile:
    names = builtin_profiles()
    return load_profile(names[which % len(names)])


def decode_messages(data: bytes) -> None:
    """The first byte says which profile."""
    profile = _profile(data[0] if data else 0)
    decoder = Decoder(profile)
    messages = list(traffic(data[1:], addresses_of(profile)))
    assert_sound(decoder, feed_all(decoder, messages))


@cache
def _tile() -> Tile:
    return load_tile(TILE)


def predict_messages(data: bytes) -> None:
    """The first byte says which profile, and whether there is a map."""
    which = data[0] if data else 0
    profile = _profile(which & 0x7F)
    pipeline = Pipeline(
        profile, shipped_predictor(), _tile() if which & 0x80 else None, stationary=which % 2 == 0
    )
    for forecasts in replay(pipeline, traffic(data[1:], addresses_of(profile))):
        _publish(forecasts)


def _publish(forecasts: ForecastSet) -> None:
    """Every way out takes it, and nothing in it is half a number."""
    assert np.isfinite(forecasts.trajectories).all()
    assert np.isfinite(forecasts.probabilities).all()
    json_lines(forecasts)
    encode_fd(forecasts, 3)
    encode_classic(forecasts)
    parts = [decode_datagram(payload) for payload in encode_datagrams(forecasts)]
    counts = [part.forecasts.num_targets for part in parts if isinstance(part, Datagram)]
    assert sum(counts) == forecasts.num_targets


def _recorded() -> dict[str, list[can.Message]]:
    """Some messages for the built-in profiles of which there is a recording."""
    generic = read_log(DRIVES["ngsim"].log)
    cars = [Car(object_id=i, x_m=10.0 * i, y_m=3.0, speed_mps=8.0 + i) for i in range(4)]
    made = list(cars_on_the_bus(cars, 1.0, pose=Pose2(3.0, 4.0, 0.5)))
    return {
        "ars408": list(messages_of("ars408")[:_SEED_MESSAGES]),
        "toyota-rav4": list(messages_of("rav4")[:_SEED_MESSAGES]),
        "srr520": list(messages_of("srr520")[:_SEED_MESSAGES]),
        "generic": [*islice(generic, _SEED_MESSAGES), *made],
    }


def _seeds() -> Iterator[bytes]:
    recorded = _recorded()
    for which, name in enumerate(builtin_profiles()):
        ids = addresses_of(load_profile(name))
        messages = recorded.get(name) or [
            can.Message(arbitration_id=number, is_extended_id=extended, data=bytes(8))
            for number, extended in ids
        ]
        for part in (messages, messages[:3], messages[20:60]):
            yield bytes([which]) + as_bytes(part, ids)


def _pipeline_seeds() -> Iterator[bytes]:
    for seed in _seeds():
        yield seed
        yield bytes([seed[0] | 0x80]) + seed[1:]


TARGETS = [
    Target(name="messages", run=decode_messages, seeds=_seeds),
    Target(name="pipeline", run=predict_messages, seeds=_pipeline_seeds),
]
