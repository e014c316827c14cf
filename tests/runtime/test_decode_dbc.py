"""Bit tables against cantools, which reads the same DBCs message by message."""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eqrt.runtime.decoding.profile
from eqrt.runtime.decoding.dbc_files import Dbc, load_dbc
from eqrt.runtime.decoding.dbc_tables import Column, SignalTable

FOLDER = Path(eqrt.runtime.decoding.profile.__file__).parent / "dbc"
SHIPPED = [
    "ars408.dbc",
    "srr520.dbc",
    "eqrt_objects.dbc",
    "opendbc/toyota_adas.dbc",
    "opendbc/toyota_new_mc_pt_generated.dbc",
]

# Everything that the shipped ones have not: little-endian across bytes, multiplexing (of two
# levels), IEEE floats, 64 bits, more than 8 bytes.
ODD = """VERSION ""

NS_ :

BS_:

BU_: R

BO_ 1 WIDE: 8 R
 SG_ ALL : 7|64@0+ (1,0) [0|0] "" R

BO_ 2 WIDE_SIGNED: 8 R
 SG_ ALL : 0|64@1- (0.5,3) [0|0] "" R

BO_ 3 REALS: 16 R
 SG_ SINGLE : 0|32@1- (1,0) [0|0] "" R
 SG_ DOUBLE : 39|64@0- (2,1) [0|0] "" R

BO_ 4 LONG: 64 R
 SG_ A : 3|12@1- (1,0) [0|0] "" R
 SG_ B : 250|33@1+ (0.25,-7) [0|0] "" R
 SG_ C : 302|37@0- (1,0) [0|0] "" R
 SG_ D : 504|8@1+ (1,0) [0|0] "" R

BO_ 5 CHOICE: 8 R
 SG_ WHICH M : 0|2@1+ (1,0) [0|0] "" R
 SG_ ZERO m0 : 2|14@1- (1,0) [0|0] "" R
 SG_ ONE m1M : 2|3@1+ (1,0) [0|0] "" R
 SG_ ONE_FIVE m5 : 16|16@1+ (1,0) [0|0] "" R
 SG_ ONE_TWO m2 : 23|16@0+ (1,0) [0|0] "" R
 SG_ ALWAYS : 40|20@1+ (1,0) [0|0] "" R

BO_ 2566834709 EXTENDED: 3 R
 SG_ A : 5|11@0- (-0.125,0.5) [0|0] "" R

SIG_VALTYPE_ 3 SINGLE : 1;
SIG_VALTYPE_ 3 DOUBLE : 2;
SG_MUL_VAL_ 5 ONE_FIVE ONE 5-6, 1-1;
SG_MUL_VAL_ 5 ONE_TWO ONE 2-2;
SG_MUL_VAL_ 5 ONE WHICH 1-1, 3-3;
"""


@cache
def both(path: Path) -> tuple[Dbc, Any]:
    return load_dbc(path), cantools.database.load_file(str(path), strict=False)


@pytest.fixture(params=[*SHIPPED, "odd.dbc"])
def dbc_path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    name = str(request.param)
    if name in SHIPPED:
        return FOLDER / name
    path = tmp_path_factory.getbasetemp() / name
    path.write_text(ODD)
    return path


def table_of(dbc: Dbc, message: str) -> SignalTable:
    signals = dbc.messages[message].signals.values()
    return SignalTable([Column(signal, signal.scale, signal.offset) for signal in signals])


def assert_as_cantools(table: SignalTable, oracle: Any, payloads: list[bytes]) -> None:
    """Vectorised, one by one, and cantools: the same numbers, NaN for a signal not selected."""
    values = table.decode(payloads)
    for i, payload in enumerate(payloads):
        try:
            expected = oracle.decode_simple(payload, decode_choices=False)
        except cantools.database.DecodeError:  # a multiplexer value that the DBC does not list
            continue
        for column, value in zip(table.columns, values[:, i], strict=True):
            right = expected.get(column.signal.name, np.nan)
            assert value == pytest.approx(right, rel=1e-12, abs=1e-12, nan_ok=True), column
            assert column.read(payload) == pytest.approx(value, rel=1e-15, nan_ok=True), column


def test_every_signal_of_every_message_reads_as_in_cantools(dbc_path: Path) -> None:
    dbc, oracle = both(dbc_path)
    noise = random.Random(408)
    for message in oracle.messages:
        payloads = [noise.randbytes(message.length) for _ in range(8)]
        payloads += [bytes(message.length), b"\xff" * message.length]
        assert_as_cantools(table_of(dbc, message.name), message, payloads)


@given(data=st.data())
def test_any_payload_reads_as_in_cantools(data: st.DataObject) -> None:
    dbc, oracle = both(FOLDER / data.draw(st.sampled_from(SHIPPED)))
    message = data.draw(st.sampled_from(oracle.messages))
    size = message.length
    payloads = data.draw(st.lists(st.binary(min_size=size, max_size=size), max_size=4))
    assert_as_cantools(table_of(dbc, message.name), message, payloads)


def test_ids_and_lengths_are_those_of_cantools(dbc_path: Path) -> None:
    dbc, oracle = both(dbc_path)
    for message in oracle.messages:
        ours = dbc.messages[message.name]
        assert ours.arbitration_id == message.frame_id
        assert ours.is_extended == message.is_extended_frame
        assert ours.length == message.length


LONG_NAMES = """NS_ :
	CM_
	BA_
	SG_MUL_VAL_

BS_:

BU_: CAR

BO_ 7 SHORT: 8 CAR
 SG_ S : 0|8@1+ (1,0) [0|0] "" CAR
 SG_ OTHER : 8|8@1+ (1,0) [0|0] "" CAR

CM_ SG_ 7 S "as in SG_ X : 0|8@1+ (1,0) [0|0] \\"\\" CAR; BO_ 8 X: 8 CAR";
BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;
BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;
BA_DEF_DEF_ "SystemMessageLongSymbol" "";
BA_DEF_DEF_ "SystemSignalLongSymbol" "";
BA_ "SystemMessageLongSymbol" BO_ 7 "A_MESSAGE_OF_MORE_THAN_32_CHARACTERS";
BA_ "SystemSignalLongSymbol" SG_ 7 S "A_SIGNAL_OF_MORE_THAN_32_CHARACTERS";
"""


def test_names_of_more_than_32_characters_are_those_of_cantools(tmp_path: Path) -> None:
    path = tmp_path / "long.dbc"
    path.write_text(LONG_NAMES)
    dbc, oracle = both(path)
    assert list(dbc.messages) == [message.name for message in oracle.messages]
    assert dbc.messages["A_MESSAGE_OF_MORE_THAN_32_CHARACTERS"].signals.keys() == {
        *(signal.name for signal in oracle.messages[0].signals)
    }


LONG_ID = """BU_: CAR
BO_ {id} LONG: 8 CAR
 SG_ KIND M : 0|8@1+ (1,0) [0|0] "" CAR
 SG_ NUMBER m1 : 8|32@1- (1,0) [0|0] "" CAR
 SG_ OTHER m2M : 8|8@1+ (1,0) [0|0] "" CAR
 SG_ NESTED m3 : 16|8@1+ (1,0) [0|0] "" CAR
BA_ "SystemMessageLongSymbol" BO_ {id} "A_MESSAGE_OF_MORE_THAN_32_CHARACTERS";
SIG_VALTYPE_ {id} NUMBER : 1;
SG_MUL_VAL_ {id} NESTED OTHER 3-5;
"""


def test_an_id_of_29_bits_is_one_without_the_bit_that_says_so(tmp_path: Path) -> None:
    """As in DBCs of opendbc; everything else that speaks of the message finds it as well."""
    named: dict[str, int | str] = {"right.dbc": 0x12DD54A7 | 1 << 31, "without.dbc": 0x12DD54A7}
    named["signed.dbc"] = "+316495015"
    for name, number in named.items():
        (tmp_path / name).write_text(LONG_ID.format(id=number))
    right, without, signed = (load_dbc(tmp_path / name).messages for name in named)
    assert without == right == signed
    message = without["A_MESSAGE_OF_MORE_THAN_32_CHARACTERS"]
    assert (message.arbitration_id, message.is_extended) == (0x12DD54A7, True)
    assert message.signals["NUMBER"].is_float
    assert message.signals["NESTED"].selected_by == {3, 4, 5}


def test_a_short_message_gives_what_is_there() -> None:
    """Four bytes of TRACK_A: distance and counter, no speed, which begins in byte 5."""
    dbc, _ = both(FOLDER / "opendbc" / "toyota_adas.dbc")
    table = table_of(dbc, "TRACK_A_0")
    whole = bytes.fromhex("9312C0FFF8020122")
    names = [column.signal.name for column in table.columns]
    values = dict(zip(names, table.decode([whole[:4], whole]), strict=True))
    assert values["COUNTER"].tolist() == [0x93, 0x93]
    assert values["LONG_DIST"].tolist() == [0.01 * (0x12C0 >> 1)] * 2
    assert np.isnan(values["REL_SPEED"]).tolist() == [True, False]
    assert [column.read(whole[:4]) for column in table.columns] == pytest.approx(
        table.decode([whole[:4]])[:, 0].tolist(), nan_ok=True
    )


def test_a_message_cut_anywhere_is_read_up_to_there(dbc_path: Path) -> None:
    """All at once and one by one are two ways to read; both give the same."""
    dbc, _ = both(dbc_path)
    noise = random.Random(64)
    for name, message in dbc.messages.items():
        table, whole = table_of(dbc, name), noise.randbytes(message.length)
        for end in range(message.length + 1):
            cut = whole[:end]
            expected = [column.read(cut) for column in table.columns]
            for values in (table.decode([cut]), table.decode([cut, whole])):
                np.testing.assert_allclose(values[:, 0], expected, rtol=1e-15)


@given(st.integers(0, 80), st.integers(0, 80))
def test_payloads_of_any_length_are_read_as_far_as_they_go(one: int, other: int) -> None:
    """A signal is there exactly if its last byte is."""
    dbc, _ = both(FOLDER / "srr520.dbc")
    table = table_of(dbc, "OBJECTS")
    there = ~np.isnan(table.decode([b"\x55" * one, b"\x55" * other]))
    last = np.array([[column.signal.last_byte] for column in table.columns])
    assert (there == (last < [one, other])).all()


def test_no_messages_give_no_values() -> None:
    dbc, _ = both(FOLDER / "ars408.dbc")
    assert table_of(dbc, "Obj_1_General").decode([]).shape == (7, 0)


def test_a_table_without_columns_decodes_to_nothing() -> None:
    table = SignalTable([])
    assert table.decode([bytes(8), b""]).shape == (0, 2)
    assert table.needed_bytes == 0


def test_a_table_needs_a_message_as_far_as_its_last_signal_goes(dbc_path: Path) -> None:
    """Not a byte more: a sensor may send less than its DBC says."""
    dbc, _ = both(dbc_path)
    for name, message in dbc.messages.items():
        ends = [signal.last_byte + 1 for signal in message.signals.values()]
        assert table_of(dbc, name).needed_bytes == max(ends, default=0)


def test_a_table_needs_the_multiplexer_that_lets_its_signal_through(tmp_path: Path) -> None:
    path = tmp_path / "behind.dbc"
    path.write_text(
        "BO_ 6 BEHIND: 8 R\n"
        ' SG_ WHICH M : 56|2@1+ (1,0) [0|0] "" R\n'
        ' SG_ VALUE m1 : 0|8@1+ (1,0) [0|0] "" R\n'
    )
    value = load_dbc(path).messages["BEHIND"].signals["VALUE"]
    table = SignalTable([Column(value, 1.0, 0.0)])
    assert table.needed_bytes == 8
    assert table.decode([bytes([9, 0, 0, 0, 0, 0, 0, 1])]).tolist() == [[9.0]]
    assert np.isnan(table.decode([bytes([9]), bytes(8)])).all()
