"""Fuzzed: what a user types, and what another program sends."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from eqrt.cli import COMMANDS, Parser
from eqrt.core.errors import ConfigError, UsageError
from eqrt.runtime import play, replay, serve, tile_command
from eqrt.runtime.bench import command as bench_command
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.demo import command as demo_command
from eqrt.runtime.output.datagrams import decode_datagram, encode_datagrams
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.play import parse_routes
from eqrt.runtime.settings import Setting, as_toml
from eqrt.runtime.verify import command as verify_command
from eqrt.runtime.verify import info
from forecast_sets import many, nobody
from fuzz.target import Target, assert_one_line, written
from source_tree import ROOT

_COMMANDS = (
    serve,
    replay,
    play,
    tile_command,
    demo_command,
    bench_command,
    verify_command,
    info,
)
_HELP = 0


def read_options(data: bytes) -> None:
    """Words between line ends; the first byte says which command they are for."""
    module = _COMMANDS[(data[0] if data else 0) % len(_COMMANDS)]
    words = data[1:].decode("utf-8", "replace").split("\n")
    parser = Parser(prog="eqrt command", allow_abbrev=False)
    module.add_arguments(parser)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            parser.parse_args(words)
    except UsageError as error:
        assert_one_line(error)
    except SystemExit as end:
        if end.code != _HELP:
            raise


def read_configuration(data: bytes) -> None:
    """One that is taken can be printed, and what is printed says the same."""
    try:
        settings = _settings_of(written("fuzzed.toml", data))
        printed = _settings_of(written("printed.toml", as_toml(settings).encode()))
    except ConfigError as error:
        assert_one_line(error)
        return
    assert {s.option.flag: repr(s.value) for s in printed} == {
        s.option.flag: repr(s.value) for s in settings
    }


def _settings_of(path: Path) -> list[Setting]:
    given = _serve_parser().parse_args(["--config", str(path)])
    resolved: list[Setting] = given.settings.resolve(given, is_complete=False)
    return resolved


@cache
def _serve_parser() -> Parser:
    parser = Parser(prog="eqrt serve", allow_abbrev=False)
    serve.add_arguments(parser)
    return parser


def read_channels(data: bytes) -> None:
    """Every role has a channel, or none has."""
    options = data.decode("utf-8", "replace").split("\n")
    roles = ("radar", "car")
    with contextlib.suppress(UsageError):
        assert set(parse_channels(options, roles)) == set(roles)
    with contextlib.suppress(UsageError):
        assert all(parse_routes(options).values())


def read_datagram(data: bytes) -> None:
    """The bytes themselves; then a good datagram with some values replaced, as the bytes say."""
    _read_datagram(data)
    wire = dict(_good_datagram())
    keys = list(wire)
    for at in range(0, min(len(data), 20) - 1, 2):
        wire[keys[data[at] % len(keys)]] = _ODD_VALUES[data[at + 1] % len(_ODD_VALUES)]
    _read_datagram(msgspec.msgpack.encode(wire))


def _read_datagram(data: bytes) -> None:
    """What comes out has one shape throughout."""
    try:
        datagram = decode_datagram(data)
    except ValueError as error:
        assert_one_line(error)
        return
    if isinstance(datagram, ServiceStatus):
        return
    forecasts = datagram.forecasts
    count, modes, steps, _ = forecasts.trajectories.shape
    assert min(count, modes, steps) >= 0
    assert forecasts.history.shape == (*forecasts.history_valid.shape, 2)
    assert len(forecasts.history) == count
    if forecasts.covariances is not None:
        assert forecasts.covariances.shape == (count, modes, steps, 2, 2)
    assert forecasts.position.shape == forecasts.velocity.shape == (count, 2)
    assert forecasts.probabilities.shape == (count, modes)
    for values in (
        forecasts.track_id,
        forecasts.object_id,
        forecasts.anchor_s,
        forecasts.agent_mode,
        forecasts.heading_rad,
        forecasts.object_class,
        forecasts.length_m,
        forecasts.width_m,
    ):
        assert values.shape == (count,)


@cache
def _good_datagram() -> dict[str, Any]:
    (payload,) = encode_datagrams(many(2, num_modes=3, horizon=5))
    wire: dict[str, Any] = msgspec.msgpack.decode(payload)
    return wire


_ODD_VALUES: list[Any] = [
    0, 1, -1, 255, 1 << 62, -(1 << 62), (1 << 64) - 1, math.nan, math.inf, 1e308, "", "x" * 99,
    None, b"", bytes(8), b"\xff" * 16, bytes(32), [], [0.0] * 2, [math.nan] * 2, [1e308] * 3,
    [0, 0, 0], [-1, 1, 1], [2, -1, 5], [2, 3, 5], [1 << 62, 0, 0], [1, 1, 1 << 62], {},
    [(1 << 64) - 1, 0, 0],
]  # fmt: skip


def _options() -> Iterator[bytes]:
    for which, line in enumerate(
        [
            "--can radar=can0 --profile ars408 --out-id 0x6e0 --out-modes 3 --datagrams [::1]:4",
            "a.log --profile generic --out - --tile a.tile --stationary",
            "a.log --can 1=vcan0 --speed 2.5 --loop --no-fd",
            "info a.tile",
            "--help",
            "model --seconds 1",
            "folder --json",
            "folder",
        ]
    ):
        yield bytes([which]) + line.replace(" ", "\n").encode()


def _configurations() -> Iterator[bytes]:
    yield (ROOT / "deploy" / "eqrt.toml").read_bytes()
    yield b'[serve]\ncan = ["radar=can0"]\nprofile = "ars408"\nquiet = true\nout_id = "0x6e0"\n'
    yield b'[recording]\ndir = "a"\nlimit = "20G"\n[realtime]\npriority = 10\ncpus = "0-1"\n'


def _channels() -> Iterator[bytes]:
    yield b"vcan0"
    yield b"radar=can1\ncar=can0"


def _datagrams() -> Iterator[bytes]:
    for forecasts in (nobody(), many(1, 2, 3), many(2, 3, 5)):
        yield from encode_datagrams(forecasts)


TARGETS = [
    Target(
        name="options",
        run=read_options,
        seeds=_options,
        words=("--", *(f"--{x}" for x in COMMANDS)),
    ),
    Target(
        name="configuration",
        run=read_configuration,
        seeds=_configurations,
        words=("[serve]", "[recording]", "[realtime]", "can = [", " = true", "profile = "),
    ),
    Target(
        name="channels", run=read_channels, seeds=_channels, words=("radar=", "car="), max_bytes=256
    ),
    Target(name="datagram", run=read_datagram, seeds=_datagrams),
]
