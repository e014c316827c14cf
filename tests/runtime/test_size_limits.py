"""Absurd sizes and counts are refused in one line, and cost no memory."""

from __future__ import annotations

import gzip
import shutil
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from can_recordings import messages_of
from eqrt.core.contract import ModelContract
from eqrt.core.errors import ContractError, EqrtError, LogError, ProfileError, TileError
from eqrt.core.tile import MAX_FILE_BYTES
from eqrt.runtime.bus.logs import MAX_BLOCK_BYTES, MAX_LINE, read_log
from eqrt.runtime.decoding import dbc_files, toml_tables
from eqrt.runtime.decoding.dbc_files import load_dbc
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.datagrams import decode_datagram
from eqrt.runtime.prediction.artifact_limits import (
    MAX_MODEL_BYTES,
    MAX_TENSOR_AXES,
    MAX_TENSOR_BYTES,
    MAX_TEXT_BYTES,
)
from eqrt.runtime.prediction.model_file import read_model_file
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor
from eqrt.runtime.prediction.protobuf import nested, number
from eqrt.runtime.prediction.tensor_proto import read_tensor
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.verify.files import check_files

CHEAP_BYTES = 4 << 20
"""What refusing something may cost."""


@pytest.fixture(autouse=True)
def cheap() -> Iterator[None]:
    """No test of this module may take much memory."""
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < CHEAP_BYTES + 4 * MAX_BLOCK_BYTES


def sparse(path: Path, size: int) -> Path:
    """A file of zeros that takes no disk."""
    with path.open("wb") as stream:
        stream.truncate(size)
    return path


@pytest.mark.parametrize(
    ("name", "limit", "read", "error"),
    [
        ("a.tile", MAX_FILE_BYTES, load_tile, TileError),
        ("a.toml", toml_tables.MAX_BYTES, lambda path: load_profile(str(path)), ProfileError),
        ("a.dbc", dbc_files.MAX_BYTES, load_dbc, ProfileError),
        ("model.onnx", MAX_MODEL_BYTES, read_model_file, ContractError),
        ("input_0.pb", MAX_TENSOR_BYTES, read_tensor, ContractError),
    ],
)
def test_a_file_that_is_too_large_is_refused_unread(
    name: str, limit: int, read: Callable[[Path], object], error: type[EqrtError], tmp_path: Path
) -> None:
    tracemalloc.reset_peak()
    with pytest.raises(error, match=r"too large|no such file has more than") as refusal:
        read(sparse(tmp_path / name, limit + 1))
    assert tracemalloc.get_traced_memory()[1] < CHEAP_BYTES
    assert "\n" not in str(refusal.value)
    assert str(tmp_path / name) in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "limit"), [("SHA256SUMS", MAX_TEXT_BYTES), ("model.onnx", MAX_MODEL_BYTES)]
)
def test_an_artifact_with_a_file_that_is_too_large_is_refused(
    name: str, limit: int, tmp_path: Path
) -> None:
    artifact = tmp_path / "artifact"
    shutil.copytree(DEFAULT_ARTIFACT, artifact)
    sparse(artifact / name, limit + 1)
    with pytest.raises(ContractError, match=rf"{name}: .* no such file has more than"):
        Predictor.load(artifact)
    found = check_files(artifact)
    assert any("no such file has more than" in failure for failure in found.failures)


def test_a_contract_that_is_too_long_or_too_deep_is_refused() -> None:
    with pytest.raises(ContractError, match="characters are no model contract"):
        ModelContract.from_json(" " * (1 << 17), "contract.json")
    with pytest.raises(ContractError, match="contract is not JSON"):
        ModelContract.from_json("[" * 60_000, "contract.json")
    with pytest.raises(ContractError, match="contract is not JSON"):
        ModelContract.from_json(f'{{"schema": {"9" * 5_000}}}', "contract.json")


def test_a_tensor_of_many_axes_is_refused(tmp_path: Path) -> None:
    """Multiplying their sizes would take longer than the whole service lives."""
    dims = b"".join(number(1, (1 << 64) - 1) for _ in range(MAX_TENSOR_AXES + 1))
    path = tmp_path / "input_0.pb"
    path.write_bytes(dims + number(2, 1) + nested(9, bytes(4)))
    with pytest.raises(ContractError, match="a tensor of 9 axes"):
        read_tensor(path)
    path.write_bytes(nested(7, nested(5, dims + number(2, 1))))
    with pytest.raises(ContractError, match="a tensor of 9 axes"):
        read_model_file(path)


def dbc_with(tmp_path: Path, *, length: str = "8", place: str = "0|8", ranges: str = "1-1") -> Path:
    path = tmp_path / "absurd.dbc"
    path.write_text(
        f'VERSION ""\n\nBO_ 1 LONG: {length} X\n SG_ M M : 0|16@1+ (1,0) [0|0] "" X\n'
        f' SG_ S m1 : 32|8@1+ (1,0) [0|0] "" X\n SG_ FAR : {place}@1+ (1,0) [0|0] "" X\n\n'
        f"SG_MUL_VAL_ 1 S M {ranges};\n"
    )
    return path


@pytest.mark.parametrize(
    "length", ["2049", "4000000000", "9" * 5000, "+4000000000", "// long\n 4000000000"]
)
def test_a_dbc_with_an_absurdly_long_message_is_refused(length: str, tmp_path: Path) -> None:
    """cantools would make a text with a digit for each of its bits."""
    with pytest.raises(ProfileError, match=r"the message LONG has .* bytes; no message has more"):
        load_dbc(dbc_with(tmp_path, length=length))


@pytest.mark.parametrize("place", ["16385|8", "0|4000000000", f"{'9' * 5000}|8", "0\n|-4000000000"])
def test_a_dbc_with_a_signal_beyond_any_message_is_refused(place: str, tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="the signal FAR lies beyond the 2048 bytes"):
        load_dbc(dbc_with(tmp_path, place=place))


@pytest.mark.parametrize(
    "ranges",
    [
        *("0-4096", "0-2047, 3000-5048", "0-99999999999999", "-4000000000-0", f"1-{'9' * 5000}"),
        *("0+4000000000", "0 // all\n -4000000000"),
    ],
)
def test_a_multiplexer_of_absurdly_many_values_is_refused(ranges: str, tmp_path: Path) -> None:
    """cantools would list every one of them."""
    with pytest.raises(ProfileError, match="values of a multiplexer; no more than 4096 are read"):
        load_dbc(dbc_with(tmp_path, ranges=ranges))


def test_what_a_dbc_has_beside_its_layout_is_not_read(tmp_path: Path) -> None:
    """cantools would write out a number of 100 million digits."""
    path = dbc_with(tmp_path)
    path.write_text(
        path.read_text()
        + 'BA_DEF_ BO_ "Cycle" INT 0 1;\nBA_DEF_DEF_ "Cycle" "1e99999999";\n'
        + 'BA_ "Cycle" BO_ 1 1e99999999;\nCM_ BO_ 1 "\nBO_ 2 WORDS: 4000000000 X\n";\n'
    )
    assert list(load_dbc(path).messages) == ["LONG"]


def test_numbers_may_stand_close_to_words_and_keywords(tmp_path: Path) -> None:
    """As cantools splits a text."""
    path = tmp_path / "close.dbc"
    path.write_text("BS_:250BO_ 1 LONG: 8 X\n\nBO_ 51VER: 40000000X\n")
    with pytest.raises(ProfileError, match="the message VER has 40000000 bytes"):
        load_dbc(path)


def test_what_a_dbc_may_have_at_most_is_read(tmp_path: Path) -> None:
    path = dbc_with(tmp_path, length="2048", place="16376|8", ranges="0-4095")
    message = load_dbc(path).messages["LONG"]
    assert message.length == 2048
    assert message.signals["FAR"].last_byte == 2047
    assert len(message.signals["S"].selected_by) == 4096


def test_a_datagram_beyond_what_udp_carries_is_refused() -> None:
    with pytest.raises(ValueError, match="65508 bytes are no datagram"):
        decode_datagram(bytes(65_508))


@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc"])
@pytest.mark.parametrize("packed", [False, True])
def test_a_line_without_an_end_is_not_read_to_its_end(
    suffix: str, packed: bool, tmp_path: Path
) -> None:
    """Packed, 64 KiB of a file become 64 MiB of one line."""
    path = tmp_path / f"line{suffix}{'.gz' if packed else ''}"
    line = b"x" * (64 << 20)
    path.write_bytes(gzip.compress(line, 1) if packed else line)
    del line
    tracemalloc.reset_peak()
    with pytest.raises(LogError, match=rf"line 1 is longer than {MAX_LINE} characters"):
        list(read_log(path))
    assert tracemalloc.get_traced_memory()[1] < CHEAP_BYTES


def test_a_long_line_ends_a_log_after_what_came_before(tmp_path: Path) -> None:
    path = tmp_path / "long.log"
    path.write_text(f"(1.0) can0 123#11\n{'x' * MAX_LINE}\n(2.0) can0 123#22\n")
    reader = read_log(path)
    assert [message.timestamp for message in reader] == [1.0]
    assert reader.truncated == (
        f"line 2 is longer than {MAX_LINE} characters, read up to there (1 messages)"
    )


def a_blf(path: Path) -> bytes:
    """The header, then one container of ten messages."""
    with can.BLFWriter(path, compression_level=9) as log:
        for message in messages_of("ars408")[:10]:
            log.on_message_received(message)
    return path.read_bytes()


HEADER_BYTES = 144
_BASE = struct.Struct("<4sHHII")  # LOBJ, header's size and version, object's size and type


def container(content: bytes, *, method: int, unpacked: int = 0) -> bytes:
    """A container of a .blf; `method` 2 = packed by zlib."""
    body = struct.pack("<HxxxxxxIxxxx", method, unpacked) + content
    return _BASE.pack(b"LOBJ", 16, 1, 16 + len(body), 10) + body + bytes(len(body) % 4)


def test_a_container_that_unpacks_to_more_than_a_recorder_writes_is_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bomb.blf"
    whole = a_blf(path)
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(256)) + packer.flush()
    path.write_bytes(whole + container(bomb, method=2))
    reader = read_log(path)
    assert len(list(reader)) == 10
    assert reader.truncated is not None
    assert f"a block that unpacks to more than {MAX_BLOCK_BYTES}" in reader.truncated


@pytest.mark.parametrize("size", [0, 15, MAX_BLOCK_BYTES + 17, 0xFFFFFFFF])
def test_a_container_of_absurd_size_is_refused(size: int, tmp_path: Path) -> None:
    path = tmp_path / "size.blf"
    whole = a_blf(path)
    path.write_bytes(whole + _BASE.pack(b"LOBJ", 16, 1, size, 10) + bytes(100))
    reader = read_log(path)
    assert len(list(reader)) == 10
    assert reader.truncated is not None
    assert f"expected up to {MAX_BLOCK_BYTES}" in reader.truncated


def test_an_object_that_never_ends_is_not_collected(tmp_path: Path) -> None:
    """It says that it has 4 GiB, and goes on from container to container."""
    path = tmp_path / "endless.blf"
    whole = a_blf(path)
    first = container(_BASE.pack(b"LOBJ", 32, 1, 0xFFFFFFFF, 1) + bytes(1 << 20), method=0)
    with path.open("wb") as stream:
        stream.write(whole + first)
        for _ in range(40):
            stream.write(container(bytes(1 << 20), method=0))
    reader = read_log(path)
    assert len(list(reader)) == 10
    assert reader.truncated is not None
    assert f"an object of more than {MAX_BLOCK_BYTES} bytes" in reader.truncated


@pytest.mark.parametrize("size", [0, 15])
@pytest.mark.parametrize("cut", range(0, 17, 4))
def test_an_object_of_no_size_ends_the_log(size: int, cut: int, tmp_path: Path) -> None:
    """It would be read for ever; its header may lie in two containers."""
    path = tmp_path / "stuck.blf"
    whole = a_blf(path)
    stuck = _BASE.pack(b"LOBJ", 32, 1, size, 1) + bytes(32)
    parts = (container(part, method=0) for part in (stuck[:cut], stuck[cut:]))
    path.write_bytes(whole + b"".join(parts))
    reader = read_log(path)
    assert len(list(reader)) == 10
    assert reader.truncated is not None
    assert "an object smaller than its header" in reader.truncated
