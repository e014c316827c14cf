"""What of a DBC file says where bits lie: all that cantools is given of it.

cantools makes room for whatever a file's numbers ask for: lengths, ranges of multiplexers, and
attributes such as 1e99999999, which it writes out digit by digit. So a file is cut into its
statements first. Those that say where bits lie are measured and go on; comments, value tables
and attributes, which decoding does not need, are blanked out, and nothing in them can harm.
Format: "DBC File Format Documentation" of Vector Informatik, and the tokens of cantools.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from eqrt.core.errors import ProfileError

MAX_MESSAGE_BYTES = 2048
"""Of a message: CAN XL's, the longest there are; J1939's have up to 1,785."""
MAX_MULTIPLEXED = 1 << 12
"""Values of a multiplexer for which a signal is there: all that 12 bits can have."""

_TOKEN = re.compile(
    r"//[^\n]*"
    r'|"(?:\\"|[^"])*?"'
    r"|[-+]?[0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?"
    r"|[A-Za-z0-9_]+"
    r"|\S"
)
_UNENDED = frozenset({"VERSION", "NS_", "BS_", "BU_", "BO_", "SG_"})
"""Statements that no semicolon ends, but the next keyword."""
_KEYWORDS = _UNENDED.union(
    {"BA_", "BA_DEF_", "BA_DEF_DEF_", "BA_DEF_DEF_REL_", "BA_DEF_REL_", "BA_DEF_SGTYPE_"}
    | {"BA_REL_", "BA_SGTYPE_", "BO_TX_BU_", "CAT_", "CAT_DEF_", "CM_", "ENVVAR_DATA_", "EV_"}
    | {"EV_DATA_", "FILTER", "SGTYPE_", "SGTYPE_VAL_", "SG_MUL_VAL_", "SIGTYPE_VALTYPE_"}
    | {"SIG_GROUP_", "SIG_TYPE_REF_", "SIG_VALTYPE_", "VAL_", "VAL_TABLE_"}
)
_ID_AT = {"BO_": 1, "SIG_VALTYPE_": 1, "SG_MUL_VAL_": 1, "BA_": 3}
"""Which token of a statement is a message's id."""
_MAX_STANDARD_ID, _MAX_EXTENDED_ID, _IS_EXTENDED = 0x7FF, 0x1FFFFFFF, 1 << 31
_BLANKED = re.compile(r"[^\n]")
_LAYOUT = frozenset({"BO_", "SG_", "SIG_VALTYPE_", "SG_MUL_VAL_"})
_LONG_NAMES = frozenset({'"SystemMessageLongSymbol"', '"SystemSignalLongSymbol"'})
_DEFINITIONS = """
BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;
BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;
BA_DEF_DEF_ "SystemMessageLongSymbol" "";
BA_DEF_DEF_ "SystemSignalLongSymbol" "";
"""


def layout_of(text: str, where: str) -> str:
    """The DBC `text`, blank wherever it does not say where bits lie or what they are called.

    Lines and columns stay, for what cantools says of them. Raises ProfileError, led by `where`,
    if no message is described, and for sizes that none on a bus can have.
    """
    pieces = []
    for start, end, tokens in _statements(text):
        piece = text[start:end]
        if tokens[0] in _LAYOUT:
            _check_sizes(tokens, where)
        elif tokens[0] != "BA_" or not _LONG_NAMES.intersection(tokens[1:2]):
            piece = _BLANKED.sub(" ", piece)
        pieces.append(_with_whole_id(piece, tokens))
    layout = "".join(pieces)
    if "BO_" not in layout:
        raise ProfileError(f"{where} describes no message; is it a DBC?")
    return layout + _DEFINITIONS


def _statements(text: str) -> Iterator[tuple[int, int, list[str]]]:
    """The text cut into statements: from, to, tokens. The first is whatever leads them."""
    start, tokens = 0, [""]
    is_open = False  # until a semicolon
    for match in _TOKEN.finditer(text):
        token = match[0]
        if token.startswith("//"):
            continue
        # NS_ lists keywords, which open nothing there.
        can_start = _UNENDED if tokens[0] == "NS_" else _KEYWORDS
        if token in can_start and not is_open:
            yield start, match.start(), tokens
            start, tokens, is_open = match.start(), [token], token not in _UNENDED
        else:
            tokens.append(token)
            is_open = is_open and token != ";"
    yield start, len(text), tokens


def _with_whole_id(piece: str, tokens: list[str]) -> str:
    """The statement; an id above 0x7FF with the bit that says that it has 29, if it lacks that.

    DBCs of opendbc lack it, and cantools takes no such message, and so nothing of the file.
    """
    number = "".join(tokens[_ID_AT.get(tokens[0], 0) :][:1])
    if not _MAX_STANDARD_ID < _whole(number) <= _MAX_EXTENDED_ID:
        return piece
    as_written = rf"(?<!\w){re.escape(number)}\b"  # it may have a sign
    return re.sub(as_written, str(_whole(number) | _IS_EXTENDED), piece, count=1)


def _check_sizes(tokens: list[str], where: str) -> None:
    if tokens[0] == "BO_":  # BO_ 1024 Name : 8 Sender
        if _exceed(tokens[4:5], MAX_MESSAGE_BYTES):
            raise ProfileError(
                f"{where}: the message {_named(tokens[2])} has {tokens[4][:20]} bytes; no message "
                f"has more than {MAX_MESSAGE_BYTES}"
            )
    elif tokens[0] == "SG_":  # SG_ Name m0 : 7|16@0+ (1,0) [0|0] "m" Receiver
        place = tokens[tokens.index(":") :][1:4:2] if ":" in tokens else []
        if _exceed(place, 8 * MAX_MESSAGE_BYTES):
            raise ProfileError(
                f"{where}: the signal {_named(tokens[1])} lies beyond the {MAX_MESSAGE_BYTES} "
                "bytes that a message may have"
            )
    elif tokens[0] == "SG_MUL_VAL_":  # SG_MUL_VAL_ 1024 Name Multiplexer 1-5, 7-7 ;
        numbers = [token for token in tokens[4:-1] if token != ","]
        count = sum(map(_num_values, numbers[::2], numbers[1::2]))
        if count > MAX_MULTIPLEXED:
            raise ProfileError(
                f"{where}: SG_MUL_VAL_ of {_named(tokens[2])} lists {count:.3g} values of a "
                f"multiplexer; no more than {MAX_MULTIPLEXED} are read"
            )


def _named(token: str) -> str:
    """A name for a message; where it is a text that never ended, the beginning of it."""
    return " ".join(token[:60].split())


def _exceed(numbers: list[str], limit: int) -> bool:
    return any(abs(_whole(number)) > limit for number in numbers)


def _num_values(first: str, last: str) -> int:
    """How many values the range of two tokens "1", "-5" has; the second's sign is a dash."""
    return max(0, _whole(last[1:]) - _whole(first) + 1)


def _whole(token: str) -> int:
    """Of a token that is no whole number, which cantools refuses, 0."""
    if not re.fullmatch(r"[-+]?[0-9]+", token):
        return 0
    return int(token[:20]) if len(token) <= 20 else 10**20
