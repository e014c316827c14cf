"""What a user can get wrong: one line that says what, where, what was found and what to do."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drives import TILE
from eqrt.cli import main
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.decoding import profile as profiles
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from own_network import own_network
from processes import environment, eqrt
from source_tree import ROOT

LOG = str(ROOT / "tests/data/can/srr520/candump.log.gz")
ARS408 = Path(profiles.__file__).parent / "profiles" / "ars408.toml"
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="these are Linux's")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that are wrong, each in its own way; commands run where they lie."""
    folder = tmp_path_factory.mktemp("bad")
    ars408 = ARS408.read_text()
    texts = {
        "broken.toml": 'description = "no end\n',
        "empty.toml": 'description = "nothing in it"\n',
        "badkey.toml": f'framming = "counted"\n{ars408}',
        "baddbc.toml": ars408.replace('"ars408.dbc"', '"bad.dbc"'),
        "nodbc.toml": ars408.replace('"ars408.dbc"', '"missing.dbc"'),
        "bad.dbc": 'VERSION ""\n\nBO_ 1 is not what a DBC has',
        "notes.tile": "lanes: many",
        "notes.log": "no message\nin any line\n",
        "drive.mf4": "",
        "file": "",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "binary.toml").write_bytes(bytes(range(128, 256)))
    tile = TILE.read_bytes()
    (folder / "cut.tile").write_bytes(tile[: len(tile) // 2])
    (folder / "flipped.tile").write_bytes(tile[:5000] + b"\x55" + tile[5001:])
    damaged = folder / "damaged-model"
    damaged.mkdir()
    content = bytearray((DEFAULT_ARTIFACT / "model.onnx").read_bytes())
    content[1000] ^= 1
    (damaged / "model.onnx").write_bytes(content)
    shutil.copy(DEFAULT_ARTIFACT / "SHA256SUMS", damaged)
    other = folder / "other-model"
    other.mkdir()
    (other / "model.onnx").write_bytes(b"not ONNX")
    checksum = hashlib.sha256(b"not ONNX").hexdigest()
    (other / "SHA256SUMS").write_text(f"{checksum}  model.onnx\n")
    return folder


SERVE = "serve --can c --can-interface eqrt_local --profile ars408"
REPLAY = f"replay {LOG} --profile srr520 --out out.jsonl"

CASES: list[tuple[str, int, str]] = [  # command line, status, what is said
    # Buses
    (
        "serve --can c --profile ars408 --can-interface usbcan",
        1,
        r"no CAN interface 'usbcan'; known",
    ),
    (
        "serve --can c --profile ars408 --can-interface slcan",
        1,
        r"'c' through slcan \(.+\); is its",
    ),
    ("serve --can d=c --profile ars408", 2, r"--can d=c: the profile has no bus 'd', only radar"),
    ("serve --can a --can b --profile toyota-rav4", 2, r"say what each is: --can radar=CHANNEL"),
    (
        "serve --can radar=c --profile toyota-rav4",
        2,
        r"no channel for the bus 'car'; add --can car=",
    ),
    ("serve --can radar= --profile toyota-rav4", 2, r"--can 'radar=' names no channel; write"),
    (f"{REPLAY} --can lidar=can0", 2, r"the profile has no bus 'lidar', only radar"),
    # Profiles
    ("serve --can c --profile ars409", 1, r"no profile 'ars409'; built in are ars408, .*, or give"),
    ("serve --can c --profile missing.toml", 1, r"no profile 'missing\.toml'; built in are"),
    ("serve --can c --profile broken.toml", 1, r"broken\.toml is not TOML: .*line 1"),
    ("serve --can c --profile binary.toml", 1, r"binary\.toml is not TOML"),
    (
        "serve --can c --profile empty.toml",
        1,
        r"empty\.toml: there is neither a \[\[sensor\]\] nor",
    ),
    (
        "serve --can c --profile badkey.toml",
        1,
        r"badkey\.toml: unknown key 'framming'; the keys are",
    ),
    (
        "serve --can c --profile baddbc.toml",
        1,
        r"the DBC bad\.dbc does not parse: .*line 3, column 10",
    ),
    (
        "serve --can c --profile nodbc.toml",
        1,
        r"nodbc\.toml: there is no DBC 'missing\.dbc' beside",
    ),
    (
        f"can check {'long' * 100}.log --profile ars408",
        1,
        r"(cannot read .*File name too long|does not exist; give)",
    ),
    (
        f"serve --can c --profile {'long' * 100}.toml",
        1,
        r"(cannot read .*File name too long|no profile 'long.*built in are)",
    ),
    (f"replay {LOG} --profile srr520 --out {'long' * 100}", 1, r"cannot .*File name too long"),
    # Models
    (f"{SERVE} --model missing", 1, r"missing/model\.onnx: No such file or directory; a model is"),
    (f"{SERVE} --model file", 1, r"file/model\.onnx: Not a directory; a model is a folder"),
    (
        f"{SERVE} --model damaged-model",
        1,
        r"damaged-model/model\.onnx: its SHA-256 is .*copy it again",
    ),
    (f"{SERVE} --model other-model", 1, r"other-model/model\.onnx: onnxruntime \S+ cannot load it"),
    # Tiles
    (f"{SERVE} --tile missing.tile", 1, r"missing\.tile: no such tile file; build one with"),
    (f"{SERVE} --tile notes.tile", 1, r"notes\.tile: not a tile .*; build one from a map with"),
    (f"{SERVE} --tile cut.tile", 1, r"cut\.tile: the tile is cut short .*; copy it again"),
    (f"{SERVE} --tile flipped.tile", 1, r"flipped\.tile: .*(damaged|checksum)"),
    (f"{SERVE} --tile .", 1, r"the tile cannot be read \(Is a directory\)"),
    ("tile info cut.tile", 1, r"cut\.tile: the tile is cut short"),
    # Where predictions go
    (
        f"{SERVE} --out-can none",
        2,
        r"--out-can none, no --datagrams, no --record: .* would go nowhere",
    ),
    (f"{SERVE} --datagrams here", 2, r"cannot send datagrams to 'here' .*give HOST:PORT, such as"),
    (
        f"{SERVE} --datagrams 127.0.0.1:99999",
        2,
        r"datagrams to '127\.0\.0\.1:99999' .*give HOST:PORT",
    ),
    (
        f"{SERVE} --datagrams nowhere.invalid:9",
        1,
        r"datagrams to 'nowhere\.invalid:9' \(.+\); give",
    ),
    # Logs
    (
        "replay missing.log --profile ars408 --out -",
        1,
        r"the log missing\.log does not exist; give",
    ),
    (
        "replay . --profile ars408 --out -",
        1,
        r"\.: there is no recording of eqrt in it \(eqrt-\*\.mcap\); give a recorded CAN log or",
    ),
    (
        "replay drive.mf4 --profile ars408 --out -",
        1,
        r"drive\.mf4: unknown log format '\.mf4'; known are \.log, .*; from MF4",
    ),
    (
        "replay notes.log --profile ars408 --out -",
        1,
        r"notes\.log: there is no CAN message .*candump -L",
    ),
    (
        "play missing.log --can c --can-interface eqrt_local",
        1,
        r"the log missing\.log does not exist",
    ),
    # Outputs
    (
        f"replay {LOG} --profile srr520 --out missing/out.jsonl",
        1,
        r"cannot write missing/out\.jsonl \(",
    ),
    (
        f"replay {LOG} --profile srr520 --out file/out.jsonl",
        1,
        r"cannot write file/out\.jsonl \(Not a",
    ),
    (
        f"replay {LOG} --profile srr520 --out .",
        1,
        r"cannot write \. \(Is a directory\); give --out a",
    ),
    ("demo --seconds 0", 2, r"--seconds is 0\.0; give a number above 0"),
    ("demo --seconds nan", 2, r"--seconds is nan; give a number above 0"),
]


@pytest.mark.parametrize(("line", "status", "said"), CASES, ids=[line for line, _, _ in CASES])
def test_a_mistake_is_explained_in_one_line(
    *,
    line: str,
    status: int,
    said: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    assert main(line.split()) == status
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("eqrt: ")
    assert err.count("\n") == 1
    assert re.search(said, err), err
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("line", "status", "said"),
    [
        (f"{SERVE} --model damaged-model", 1, "its SHA-256 is"),
        ("serve --can c --profile baddbc.toml", 1, "does not parse"),
        ("replay missing.log --profile ars408 --out -", 1, "does not exist"),
        (f"{SERVE} --out-can none", 2, "would go nowhere"),
    ],
)
def test_the_shell_gets_the_same_line_and_status(
    line: str, status: int, said: str, folder: Path
) -> None:
    """No traceback, nothing beside it; the rest of the cases are run in this process."""
    done = eqrt(*line.split(), cwd=folder)
    assert (done.returncode, done.stdout) == (status, "")
    assert done.stderr.startswith("eqrt: ")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


@LINUX
@pytest.mark.parametrize("command", ["serve --profile ars408", f"play {LOG}"])
def test_a_missing_channel_says_how_to_get_one(
    command: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """Where the kernel has CAN, how to make the channel; elsewhere how to load it."""
    assert main([*command.split(), "--can", "nosuchcan"]) == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert re.fullmatch(
        r"eqrt: .*CAN channel 'nosuchcan'.*(deploy/vcan\.sh nosuchcan|modprobe).*\n", err
    )


@LINUX
def test_a_full_disk_is_said(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", LOG, "--profile", "srr520", "--out", "/dev/full"]) == 1
    assert capfd.readouterr().err == (
        "eqrt: cannot write /dev/full (No space left on device); "
        "give --out a file that can be written\n"
    )


@LINUX
@pytest.mark.parametrize(
    ("prepare", "said"),
    [
        ("pass", "no loopback network .*; switch it on: ip link set lo up"),
        (
            "up(); taken.bind(('', 43114))",
            "another program keeps UDP port 43114 for itself; end it",
        ),
    ],
)
def test_a_local_bus_that_cannot_be_had_is_explained(prepare: str, said: str) -> None:
    """In a network of its own: without loopback, and with a program that keeps the port."""
    program = f"""
import fcntl, socket, struct, sys
from eqrt.cli import main
def up():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, 0x8914, struct.pack("16sH14x", b"lo", 1))  # SIOCSIFFLAGS, IFF_UP
taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
{prepare}
sys.exit(main(["serve", "--can", "c", "--can-interface", "{LOCAL}", "--profile", "ars408"]))
"""
    done = subprocess.run(
        [*own_network(), sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=environment(),
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(f"eqrt: cannot open CAN channel 'c' through {LOCAL}: {said}\n", done.stderr)
