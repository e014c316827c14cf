"""Playing logs: what is sent where, and when."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from eqrt.cli import main
from eqrt.core.errors import BusError, UsageError
from eqrt.runtime.bus.buses import LOCAL, open_bus
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.play import OTHERS, Player, parse_routes
from source_tree import ROOT

SRR520 = ROOT / "tests/data/can/srr520/candump.log.gz"
CHANNELS = (f"play-{number}-{time.monotonic_ns()}" for number in itertools.count())
SLACK_S = 0.4  # a busy machine may be that late; early it must never be
CLOCKS_S = 0.002  # stamps are on the wall clock, which is slewed


def never() -> bool:
    return False


def at(*times_s: float, channel: str = "can0") -> list[can.Message]:
    """Messages with these stamps; the id tells which is which."""
    return [
        can.Message(time_s, number, False, channel=channel) for number, time_s in enumerate(times_s)
    ]


class Ear:
    """A bus to play on, and who listens there."""

    def __init__(self, *, fd: bool = True) -> None:
        channel = next(CHANNELS)
        self.bus = open_bus(channel, "virtual", fd=fd)
        self._listener = open_bus(channel, "virtual", fd=fd)

    def heard(self) -> list[can.Message]:
        """What came, stamped with the time of sending."""
        return list(iter(lambda: self._listener.recv(0.0), None))

    def close(self) -> None:
        self.bus.shutdown()
        self._listener.shutdown()


@pytest.fixture
def ear() -> Iterator[Ear]:
    ear = Ear()
    yield ear
    ear.close()


def test_a_log_is_sent_whole_and_in_order(ear: Ear) -> None:
    """The bytes of the recording, CAN FD included."""
    player = Player({OTHERS: ear.bus})
    log = read_log(SRR520)
    player.play(log, never)
    for sent, recorded in zip(ear.heard(), log, strict=True):
        assert sent.equals(recorded, timestamp_delta=None, check_channel=False)
    assert (player.sent, player.left_out.total()) == (97, 0)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_messages_keep_their_distances(speed: float, ear: Ear) -> None:
    """No message is early; none is later than the machine makes it."""
    times_s = [100.0, 100.05, 100.05, 100.3]
    began_s = time.time()
    Player({OTHERS: ear.bus}, speed).play(at(*times_s), never)
    sent_s = [message.timestamp for message in ear.heard()]
    for sent, recorded_s in zip(sent_s, times_s, strict=True):
        due_s = (recorded_s - 100.0) / speed
        assert due_s - CLOCKS_S < sent - began_s < due_s + SLACK_S


def test_lateness_does_not_add_up(ear: Ear) -> None:
    """After a hold-up of 0.5 s the messages that are due follow at once, the others in time."""

    def slow() -> Iterator[can.Message]:
        for number, message in enumerate(at(0.0, 0.05, 0.1, 0.7)):
            if number == 1:
                time.sleep(0.5)
            yield message

    began_s = time.time()
    player = Player({OTHERS: ear.bus})
    player.play(slow(), never)
    sent_s = [message.timestamp for message in ear.heard()]
    for sent, due_s in zip(sent_s, (0.0, 0.5, 0.5, 0.7), strict=True):
        assert due_s - CLOCKS_S < sent - began_s < due_s + SLACK_S
    assert player.latest_s > 0.4


def test_no_speed_means_no_waiting(ear: Ear) -> None:
    started_s = time.monotonic()
    player = Player({OTHERS: ear.bus}, speed=0.0)
    player.play(at(0.0, 50.0, 10.0), never)
    assert time.monotonic() - started_s < SLACK_S
    assert len(ear.heard()) == 3
    assert "late" not in player.summary()


def test_a_clock_that_was_set_is_not_waited_for(ear: Ear) -> None:
    """An hour forward, a year back: both are jumps, and the distances after them hold."""
    started_s = time.monotonic()
    player = Player({OTHERS: ear.bus})
    player.play(at(3e7, 3e7 + 3600.0, 3e7 + 3600.1, 10.0, 10.1), never)
    assert 0.2 - CLOCKS_S < time.monotonic() - started_s < 0.2 + SLACK_S
    assert "2 jumps" in player.summary()


def test_a_stamp_slightly_out_of_order_moves_nothing(ear: Ear) -> None:
    """Recorders with several buses write such; the message is sent at once."""
    began_s = time.time()
    player = Player({OTHERS: ear.bus})
    player.play(at(0.0, 0.1, 0.09, 0.2), never)
    _, second, third, last = (message.timestamp for message in ear.heard())
    assert third - second < 0.1  # at once, as fast as a busy machine lets it
    assert 0.2 - CLOCKS_S < last - began_s < 0.2 + SLACK_S
    assert "jump" not in player.summary()


def test_a_log_played_again_keeps_its_distances(ear: Ear) -> None:
    """The first message of the second time is due with the last one of the first time."""
    began_s = time.time()
    player = Player({OTHERS: ear.bus})
    player.play(at(7.0, 7.1), never)
    player.play(at(7.0, 7.1), never)
    sent_s = [message.timestamp for message in ear.heard()]
    for sent, due_s in zip(sent_s, (0.0, 0.1, 0.1, 0.2), strict=True):
        assert due_s - CLOCKS_S < sent - began_s < due_s + SLACK_S


def test_log_channels_go_where_they_are_sent(ear: Ear) -> None:
    """can0 on one bus, can1 on another, can2 nowhere."""
    other = Ear()
    player = Player({"can0": ear.bus, "can1": other.bus})
    messages = [*at(0.0, 0.0), *at(0.0, channel="can1"), *at(0.0, 0.0, 0.0, channel="can2")]
    player.play(messages, never)
    assert (len(ear.heard()), len(other.heard())) == (2, 1)
    assert (player.sent, player.left_out.total()) == (3, 3)
    assert "; not sent: 3 of the log's channel can2, which no --can names" in player.summary()
    other.close()


def test_numbered_channels_are_named_by_their_number(ear: Ear) -> None:
    """As .asc, .blf and .trc logs have them."""
    player = Player({"1": ear.bus})
    player.play([can.Message(0.0, 1, channel=0), can.Message(0.0, 2, channel=1)], never)
    assert [message.arbitration_id for message in ear.heard()] == [2]


def test_bus_errors_are_not_sent(ear: Ear) -> None:
    player = Player({OTHERS: ear.bus})
    player.play([can.Message(0.0, 4, is_error_frame=True), *at(0.0)], never)
    assert (player.sent, player.left_out) == (1, {"bus errors": 1})


def test_can_fd_is_not_sent_on_a_classic_channel() -> None:
    ear = Ear(fd=False)
    player = Player({OTHERS: ear.bus})
    player.play([can.Message(0.0, 4, is_fd=True), *at(0.0)], never)
    assert (player.sent, player.left_out.total()) == (1, 1)
    assert "; not sent: 1 in CAN FD, for a channel" in player.summary()
    ear.close()


def test_told_to_stop_it_does_not_wait_for_the_next_message(ear: Ear) -> None:
    started_s = time.monotonic()
    Player({OTHERS: ear.bus}).play(at(0.0, 30.0), lambda: time.monotonic() > started_s + 0.1)
    assert time.monotonic() - started_s < 0.2 + SLACK_S
    assert len(ear.heard()) == 1


def test_a_bus_that_takes_nothing_ends_the_play(ear: Ear) -> None:
    """After a second of trying."""
    ear.close()
    with pytest.raises(BusError, match=r"took no message for 1 s .*closed bus"):
        Player({OTHERS: ear.bus}).play(at(0.0), never)


def test_routes_are_read_from_the_options() -> None:
    assert parse_routes(["vcan0"]) == {OTHERS: "vcan0"}
    assert parse_routes(["can0=vcan0", "vcan7", "1=vcan1"]) == {
        "can0": "vcan0",
        OTHERS: "vcan7",
        "1": "vcan1",
    }


@pytest.mark.parametrize("options", [["can0="], ["=vcan0"], [""], ["a", "b"], ["x=a", "x=b"]])
def test_routes_that_make_no_sense_are_refused(options: list[str]) -> None:
    with pytest.raises(UsageError, match="--can"):
        parse_routes(options)


def test_sigterm_ends_the_command_cleanly(tmp_path: Path) -> None:
    """`eqrt play --loop` in another process is heard here, told to end, and sums up."""
    path, channel = tmp_path / "drive.log", next(CHANNELS)
    path.write_text("(1.000000) can0 123#11\n(1.010000) can0 124#22\nnoise\n(1.020000) can0 1")
    options = ["--can", channel, "--can-interface", LOCAL, "--loop"]
    with (
        open_bus(channel, LOCAL) as bus,
        subprocess.Popen(
            [sys.executable, "-m", "eqrt", "play", str(path), *options],
            cwd=ROOT / "runtime",
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
    ):
        heard = [bus.recv(20.0) for _ in range(10)]
        process.send_signal(signal.SIGTERM)
        stdout, stderr = process.communicate(timeout=20.0)
    assert all(heard)
    assert process.returncode == 0
    assert stdout.startswith("eqrt play: sent ")
    assert stdout.count("\n") == 1
    assert stderr == (
        f"eqrt: {path}: lines without a message, skipped: 1 (the first is line 3: 'noise'); "
        "ends in the middle of line 4, read up to there (2 messages)\n"
    )


@pytest.mark.parametrize("more", [[], ["--loop"]])
def test_a_log_of_which_nothing_is_sent_is_no_success(
    more: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """And it ends."""
    options = ["--can-interface", LOCAL, "--speed", "0", *more]
    assert main(["play", str(SRR520), "--can", f"can7={next(CHANNELS)}", *options]) == 1
    said = capsys.readouterr().out
    assert said.startswith("eqrt play: sent 0 messages")
    assert "not sent: 97 of the log's channel can0, which no --can names" in said


@pytest.mark.parametrize("stamps", [(1.0,), (1.0, 1.0)])
def test_a_log_that_does_not_last_is_not_repeated(
    stamps: tuple[float, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It would fill the bus."""
    path = tmp_path / "moment.log"
    path.write_text("".join(f"({stamp:.6f}) can0 123#11\n" for stamp in stamps))
    options = ["--can", next(CHANNELS), "--can-interface", LOCAL, "--loop"]
    assert main(["play", str(path), *options]) == 2
    assert "all messages of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["missing.log", "--can", "x"], 1, "does not exist"),
        ([str(SRR520), "--can", "x", "--speed", "-1"], 2, "--speed is -1.0"),
        ([str(SRR520), "--can", "x", "--speed", "nan"], 2, "--speed is nan"),
        ([str(SRR520), "--can", "nosuchcan"], 1, "CAN channel 'nosuchcan'"),
        ([str(SRR520), "--can", "x", "--can-interface", "none"], 1, "no CAN interface 'none'"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(
    arguments: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["play", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("eqrt: ")
    assert said in err
    assert err.count("\n") == 1
