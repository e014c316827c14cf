"""Signals of a DBC that the decoder cannot read are refused when the profile is loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from eqrt.core.errors import ProfileError
from tiny_sensor import COUNTED, DBC, SENSOR, profile_of

_X = ' SG_ X : 0|16@1- (0.01,0) [0|0] "m" R\n'
_ID = ' SG_ ID : 32|8@1+ (1,0) [0|0] "" R\n'
_STATE = ' SG_ STATE : 44|4@1+ (1,0) [0|0] "" R\n'


def refused(tmp_path: Path, profile: str, dbc: str) -> str:
    with pytest.raises(ProfileError) as refusal:
        profile_of(tmp_path, profile, dbc)
    message = str(refusal.value)
    assert "\n" not in message
    assert "tiny.toml" in message
    return message


@pytest.mark.parametrize(
    ("signal", "kinds", "complaint"),
    [
        (' SG_ X : 0|24@1- (1,0) [0|0] "m" R\n', "SIG_VALTYPE_ 272 X : 1;\n", "a float of 24 bits"),
        (' SG_ X : 505|8@1- (1,0) [0|0] "m" R\n', "", "beyond the 64 bytes of a message"),
        (' SG_ X : 0|16@1- (1e999,0) [0|0] "m" R\n', "", "scale or offset that is not finite"),
        (' SG_ X : 0|16@1- (1,1e999) [0|0] "m" R\n', "", "scale or offset that is not finite"),
        (' SG_ X : 0|70@1- (1,0) [0|0] "m" R\n', "", "has 70 bits"),
    ],
)
def test_a_signal_that_cannot_be_read_is_refused(
    tmp_path: Path, signal: str, kinds: str, complaint: str
) -> None:
    dbc = DBC.replace(_X, signal) + kinds
    assert complaint in refused(tmp_path, COUNTED, dbc)


def test_a_signal_in_the_last_bit_of_can_fd_is_read(tmp_path: Path) -> None:
    dbc = DBC.replace(_X, ' SG_ X : 504|8@1- (1,0) [0|0] "m" R\n')
    assert profile_of(tmp_path, COUNTED, dbc).sensors[0].parts[0].table.needed_bytes == 64


def test_a_multiplexer_beyond_the_message_is_refused_as_well(tmp_path: Path) -> None:
    muxed = ' SG_ PAGE M : 600|8@1+ (1,0) [0|0] "" R\n SG_ X m0 : 0|16@1- (1,0) [0|0] "m" R\n'
    assert "beyond the 64 bytes" in refused(tmp_path, COUNTED, DBC.replace(_X, muxed))


@pytest.mark.parametrize(
    ("signal", "kinds"),
    [
        (' SG_ ID : 64|32@1- (1,0) [0|0] "" R\n', "SIG_VALTYPE_ 272 ID : 1;\n"),
        (' SG_ ID : 64|54@1+ (1,0) [0|0] "" R\n', ""),
    ],
)
def test_ids_that_would_not_stay_apart_are_refused(tmp_path: Path, signal: str, kinds: str) -> None:
    """Decoded as float64 and rounded, two of them could become one."""
    complaint = refused(tmp_path, COUNTED, DBC.replace(_ID, signal) + kinds)
    assert "fields.id: first.ID is no integer of up to 53 bits" in complaint


def test_a_table_over_a_float_is_refused(tmp_path: Path) -> None:
    """Its values would be places in the table, wherever they lie."""
    dbc = DBC.replace(_STATE, ' SG_ STATE : 64|16@1- (1,0) [0|0] "" R\n')
    text = f'{COUNTED}\n[sensor.fields.class]\nsignal = "first.STATE"\ntable = {{ 1 = "car" }}\n'
    said = refused(tmp_path, text, f"{dbc}SIG_VALTYPE_ 272 STATE : 1;\n")
    assert "first.STATE is a float; a table has integers" in said


@pytest.mark.parametrize(
    ("sign", "raw", "complaint"),
    [
        ("+", -1, "first.STATE is never -1: the DBC has it unsigned, 0 to 15"),
        ("+", 16, "first.STATE is never 16: the DBC has it unsigned, 0 to 15"),
        ("-", 15, "first.STATE is never 15: the DBC has it signed, -8 to 7"),
        ("-", -9, "first.STATE is never -9: the DBC has it signed, -8 to 7"),
    ],
)
def test_a_value_that_the_signal_never_has_is_refused_with_those_that_it_has(
    tmp_path: Path, sign: str, raw: int, complaint: str
) -> None:
    dbc = DBC.replace("STATE : 44|4@1+", f"STATE : 44|4@1{sign}")
    text = (
        f'{COUNTED}\n[sensor.fields.class]\nsignal = "first.STATE"\ntable = {{ {raw} = "car" }}\n'
    )
    assert refused(tmp_path, text, dbc).endswith(f"fields.class.table: {complaint}")


@pytest.mark.parametrize("kind", ["8|4@1+ (1,0)", "8|3@1- (1,0)", "8|3@1+ (2,0)", "8|3@1+ (1,1)"])
def test_a_table_over_objects_that_have_other_numbers_is_refused(tmp_path: Path, kind: str) -> None:
    """One table serves all of them."""
    kinds = f' SG_ O1_K : 120|3@1+ (1,0) [0|0] "" R\n SG_ O2_K : 12{kind} [0|0] "" R\n'
    dbc = DBC.replace(" SG_ O3_ID", f"{kinds} SG_ O3_ID")
    text = (
        SENSOR + 'framing = "single"\nobjects = { first = 1, last = 2 }\n'
        'messages = { p = "PACKED" }\n[sensor.fields]\nid = "O{object}_ID"\nx = "O{object}_X"\n'
        'y = "O{object}_Y"\nclass = { signal = "O{object}_K", table = { 1 = "car" } }\n'
    )
    said = refused(tmp_path, text, dbc)
    assert "fields.class: 'O{object}_K' differs from object to object in bits, sign or sc" in said


@pytest.mark.parametrize("number", ["9" * 30, f"-{'9' * 30}"])
def test_an_integer_beyond_64_bits_is_refused(tmp_path: Path, number: str) -> None:
    text = COUNTED.replace("timeout_s", f"object_id_offset = {number}\ntimeout_s")
    assert "object_id_offset is an integer of more than 64 bits" in refused(tmp_path, text, DBC)
