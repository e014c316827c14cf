"""A bus as real ones are: it carries so many bits a second, and its interface has room for few.

vcan takes everything at once; netem on top of it makes it slow. Prints as JSON what was sent on
vcan0, with a receiver that waits meanwhile, and what `eqrt serve` sent on vcan1.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import can

from crowd import crowd
from drives import Car, cycle
from eqrt.core.frames import Pose2
from eqrt.runtime.bus.links import open_link, opener
from eqrt.runtime.bus.receiver import Receiver
from eqrt.runtime.output.publish_can import CanPublisher

EQRT = [sys.executable, "-m", "eqrt"]
SERVE = [*EQRT, "serve", "--can", "vcan0", "--out-can", "vcan1", "--no-fd", "--quiet"]
ROOM = 10  # messages; what the kernel gives a CAN interface unless told otherwise
CLASSIC, FD = "500kbit", "1440kbit"  # 0.26 ms for 16 bytes of the kernel, 0.4 ms for 72
TOO_SLOW = "20kbit"
CYCLES, OBJECTS, PERIOD_S = 10, 32, 0.2
CYCLE_S = 0.1  # of a sensor
STATUS, OBJECT, POINT, NUM_OBJECTS_BYTE = 0x6E2, 0x6E4, 0x6E5, 3  # of eqrt.dbc
PATIENCE_S, ANSWER_S = 20.0, 2.0
CARS = [Car(object_id=i, x_m=10.0 + 5.0 * i, y_m=3.0) for i in range(6)]


def slow_down(channel: str, rate: str) -> None:
    netem = ["netem", "rate", rate, "limit", str(ROOM)]
    subprocess.run(["tc", "qdisc", "replace", "dev", channel, "root", *netem], check=True)


@contextmanager
def listening(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(channel, "socketcan", fd=True) as bus:
        yield bus


def published(rate: str, *, fd: bool, period_s: float) -> object:
    """How many messages of each id came of every cycle, and what the publisher counted."""
    slow_down("vcan0", rate)
    with (
        listening("vcan0") as ear,
        Receiver(opener(None, fd=fd), {"vcan0": ()}, print) as receiver,
    ):
        publisher = CanPublisher(receiver.connection("vcan0").outbox)
        cycles = []
        for number in range(CYCLES):
            publisher.publish(crowd(number, OBJECTS))
            end_s = time.monotonic() + period_s
            while (left_s := end_s - time.monotonic()) > 0.0:
                receiver.recv(left_s)
            cycles.append(
                Counter(f"{m.arbitration_id:X}" for m in iter(lambda: ear.recv(0.0), None))
            )
        publisher.publish(crowd(CYCLES, 0))  # gives up what is left
        return {"cycles": cycles, "failed": publisher.failed}


def served() -> object:
    """What came on the slow bus of a service for each object list: status, objects, points."""
    subprocess.run(["tc", "qdisc", "del", "dev", "vcan0", "root"], check=True)
    slow_down("vcan1", CLASSIC)
    serve = subprocess.Popen([*SERVE, "--profile", "generic"], stdout=subprocess.PIPE, text=True)
    assert serve.stdout is not None
    assert serve.stdout.readline().startswith("eqrt serve: ")
    sensor = open_link("vcan0", None, fd=False, receive=())
    answers = []
    with listening("vcan1") as ear:
        for step in range(CYCLES):
            next_s = time.monotonic() + CYCLE_S  # cycles that come closer share a prediction
            for message in cycle(CARS, CYCLE_S * step, pose=Pose2()):
                sensor.send(message)
            answers.append(answer(ear))
            time.sleep(max(0.0, next_s - time.monotonic()))
    sensor.shutdown()
    serve.send_signal(signal.SIGTERM)
    return {"status": serve.wait(PATIENCE_S), "answers": [one for one in answers if one[0]]}


def answer(ear: can.BusABC) -> list[int]:
    """From a status that announces objects on, until all have come, or the next status has."""
    found = Counter[int]()
    end_s = time.monotonic() + ANSWER_S  # a list that took too long to send has none
    while (found[STATUS] or time.monotonic() < end_s) and (
        message := ear.recv(PATIENCE_S)
    ) is not None:
        if message.arbitration_id == STATUS and (found[STATUS] or message.data[NUM_OBJECTS_BYTE]):
            found[STATUS] += 1
        if found[STATUS] and message.arbitration_id in (OBJECT, POINT):
            found[message.arbitration_id] += 1
        if found[STATUS] > 1 or found.total() == 1 + 4 * len(CARS):
            break
    return [found[STATUS], found[OBJECT], found[POINT]]


if __name__ == "__main__":
    print(
        json.dumps(
            {
                "classic": published(CLASSIC, fd=False, period_s=PERIOD_S),
                "fd": published(FD, fd=True, period_s=PERIOD_S),
                "too slow": published(TOO_SLOW, fd=False, period_s=PERIOD_S),
                "serve": served(),
            }
        )
    )
