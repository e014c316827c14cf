"""Predictions and status on zenoh: `PREFIX/forecasts` and `PREFIX/status` (docs/bridges.md).

Forecasts are the service's datagrams byte for byte (docs/output.md); status is JSON. Unless its
user says otherwise, the session speaks with this machine alone: it listens on loopback, does not
scout by multicast, and does not follow the addresses that peers gossip about.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Self

import msgspec
import zenoh

from eqrt.core.errors import UsageError
from eqrt.runtime.output.datagrams import Datagram
from eqrt.runtime.view.hearing import Ear

_ENCODER = msgspec.json.Encoder()


class ToZenoh:
    """A zenoh session with two publishers, from `with` on."""

    def __init__(self, config: zenoh.Config, *, key: str) -> None:
        """Raises UsageError if `key` cannot begin a key, or the session cannot be opened."""
        self._forecasts_key, self._status_key = _keys(key)
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise UsageError(
                f"cannot open a zenoh session ({_words(error)}); if another program listens there, "
                "choose another endpoint with --listen, or join it with --connect"
            ) from error
        self._forecasts = self._session.declare_publisher(
            self._forecasts_key,
            encoding="application/msgpack",
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._status = self._session.declare_publisher(
            self._status_key,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._datagrams = self._statuses = 0
        endpoints = [
            *json.loads(config.get_json("listen/endpoints") or "[]"),
            *json.loads(config.get_json("connect/endpoints") or "[]"),
        ]
        self.where = f"zenoh: {self._forecasts_key} and {self._status_key} at {_listed(endpoints)}"
        """For the command's first line."""

    def pass_on(self, ear: Ear) -> None:
        """Everything that has come since."""
        for payload, heard in ear.datagrams():
            if isinstance(heard, Datagram):
                self._forecasts.put(payload)
                self._datagrams += 1
            else:
                self._status.put(_ENCODER.encode(heard))
                self._statuses += 1

    def told(self) -> str:
        """What was passed on."""
        return f"{self._datagrams} datagrams and {self._statuses} statuses"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


def session_config(
    *, file: str | None, listens: Sequence[str] | None, connects: Sequence[str] | None
) -> zenoh.Config:
    """A session of `file`, else of a peer that speaks with nobody whom it was not told of.

    `listens`, `connects`: endpoints, such as `tcp/127.0.0.1:7447`; None = as they are. Raises
    UsageError.
    """
    try:
        config = _closed_config() if file is None else zenoh.Config.from_file(file)
        for name, endpoints in (("listen", listens), ("connect", connects)):
            if endpoints is not None:
                config.insert_json5(f"{name}/endpoints", json.dumps(list(endpoints)))
    except zenoh.ZError as error:
        what = f"--zenoh-config {file}" if file is not None else "--listen or --connect"
        raise UsageError(
            f"{what}: zenoh refuses it ({_words(error)}); endpoints are like tcp/127.0.0.1:7447"
        ) from error
    return config


def _closed_config() -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


def _keys(prefix: str) -> tuple[str, str]:
    try:
        if set(prefix) & set("*$"):
            raise ValueError("it has a wildcard")
        keys = [str(zenoh.KeyExpr(f"{prefix}/{name}")) for name in ("forecasts", "status")]
    except (zenoh.ZError, ValueError) as error:
        raise UsageError(
            f"--key {prefix!r} is no beginning of a zenoh key ({_words(error)}); give one such as "
            "eqrt or vehicle7/eqrt"
        ) from error
    return keys[0], keys[1]


def _words(error: Exception) -> str:
    """What zenoh says, without the lines of its source that say it."""
    return re.sub(r" at \S+\.rs:\d+\.?", "", str(error))


def _listed(endpoints: Sequence[str]) -> str:
    return ", ".join(map(str, endpoints)) or "what its configuration says"
