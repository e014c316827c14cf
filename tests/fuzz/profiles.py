"""Fuzzed: profiles and DBCs, and what is decoded by those that load; conditions by themselves."""

from __future__ import annotations

import random
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

from can_recordings import feed_all
from eqrt.core.errors import ProfileError
from eqrt.runtime.decoding import profile as profiles
from eqrt.runtime.decoding.bindings import Binder
from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.conditions import ConditionError, parse_condition
from eqrt.runtime.decoding.dbc_files import Dbc, DbcMessage, load_dbc
from eqrt.runtime.decoding.dbc_tables import SignalTable
from eqrt.runtime.decoding.profile import builtin_profiles, load_profile
from fuzz.decoding import addresses_of
from fuzz.target import Target, assert_one_line, written
from fuzz.traffic import traffic
from soundness import assert_sound

_BUILTIN = Path(profiles.__file__).parent
_TRAFFIC_BYTES = 1500
_SMALL_DBC = """VERSION ""

BO_ 512 OBJECT: 8 RADAR
 SG_ ID m0 : 0|8@1+ (1,0) [0|255] "" CAR
 SG_ PAGE M : 8|2@1+ (1,0) [0|3] "" CAR
 SG_ X m0 : 16|12@1- (0.1,-5) [-200|200] "m" CAR
 SG_ Y m0 : 35|12@0- (0.1,0) [-200|200] "m" CAR
 SG_ V m1 : 16|32@1- (1,0) [0|0] "m/s" CAR

BO_ 2566844672 LONG: 64 RADAR
 SG_ Z : 448|64@1+ (1,0) [0|0] "km" CAR

CM_ SG_ 512 X "how far";
BA_DEF_ SG_ "Delay" FLOAT 0 10;
BA_DEF_DEF_ "Delay" 0;
BA_ "Delay" SG_ 512 X 2.5;
VAL_ 512 PAGE 0 "where" 1 "how fast" ;
SIG_VALTYPE_ 512 V : 1;
"""


def load(data: bytes) -> None:
    """A profile that loads decodes anything that comes over the bus."""
    path = written("profile.toml", data)
    try:
        with patch.object(profiles, "load_dbc", _builtin_dbc):  # parsed once, for speed
            profile = load_profile(str(path))
    except ProfileError as error:
        assert_one_line(error)
        return
    decoder = Decoder(profile)
    chance = random.Random(zlib.crc32(data))
    messages = traffic(chance.randbytes(_TRAFFIC_BYTES), addresses_of(profile))
    assert_sound(decoder, feed_all(decoder, messages))


@cache
def _builtin_dbc(path: Path) -> Dbc:
    """Parsed once: DBCs are what the other target is about."""
    return load_dbc(path)


def load_dbc_text(data: bytes) -> None:
    """Whatever signals a DBC has can be decoded, and one by one as all together."""
    path = written("small.dbc", data)
    try:
        messages = list(load_dbc(path).messages.values())
    except ProfileError as error:
        assert_one_line(error)
        return
    for message in messages:
        _decode(message, zlib.crc32(data))


def _decode(message: DbcMessage, seed: int) -> None:
    chance = random.Random(seed)
    binder = Binder("dbc", {"part": [message]})
    for name in message.signals:
        try:
            binder.reference("field", name)
            binder.reference("field", name, raw=True)
        except ProfileError as error:
            assert_one_line(error)
    columns = binder.columns(0)
    payloads = [chance.randbytes(chance.choice([0, 3, 8, 64])) for _ in range(5)]
    with np.errstate(all="ignore"):
        together = SignalTable(columns).decode(payloads)
        single = [[column.read(payload) for payload in payloads] for column in columns]
    np.testing.assert_array_equal(together, np.array(single).reshape(together.shape))


def parse(data: bytes) -> None:
    """A condition that parses can be evaluated."""
    try:
        condition = parse_condition(data.decode("utf-8", "replace"))
    except ConditionError:
        return
    numbers = [[float(i) for i, _ in enumerate(condition.operands)], [np.nan] * 100]
    for values in numbers:
        assert condition.evaluate(values) in (True, False)
    array = np.arange(3.0)
    truth = condition.evaluate([array for _ in condition.operands])
    assert truth.shape == array.shape
    assert truth.dtype == np.bool_


def _profiles() -> Iterator[bytes]:
    for name in builtin_profiles():
        yield (_BUILTIN / "profiles" / f"{name}.toml").read_bytes()


def _dbcs() -> Iterator[bytes]:
    yield _SMALL_DBC.encode()
    for name in ("ars408.dbc", "eqrt_objects.dbc"):
        text = (_BUILTIN / "dbc" / name).read_text()
        for block in text.split("\n\n")[:6]:
            if "BO_ " in block:
                yield f'VERSION ""\n\n{block}\n'.encode()


def _conditions() -> Iterator[bytes]:
    yield b"a.VALID == 1 and (a.LONG_DIST < 255 or not raw(a.STATE) == 0x7)"
    yield b"X != -1.5e-3"


TARGETS = [
    Target(
        name="profile",
        run=load,
        seeds=_profiles,
        words=("[[sensor]]", "[[ego]]", "[sensor.fields]", " = inf", " = nan", "0x", "{slot:02X}"),
    ),
    Target(
        name="dbc",
        run=load_dbc_text,
        seeds=_dbcs,
        words=("BO_ ", " SG_ ", "SIG_VALTYPE_", "SG_MUL_VAL_", "BA_ ", "VAL_ ", "CM_ ", "m1M"),
        max_bytes=2048,
    ),
    Target(
        name="condition",
        run=parse,
        seeds=_conditions,
        words=("and", "or", "not", "raw(", "==", "!=", "<=", ">=", "0x"),
        max_bytes=512,
    ),
]
