"""A fleet of OVMS modules whose broker is restarted; nothing that the broker had acknowledged may be lost.

    python -m tests.support.mqtt_outage --cars 1000 --minutes 10 --speed 1

`socast bridge ovms` runs in a process of its own between a mosquitto broker and a Zenoh router. The modules publish
with QoS 1, and this process notes which of their messages the broker acknowledges and which values come out as
telemetry.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from socast.stream.zenoh_session import Node
from tests.support.mqtt_broker import MqttBroker
from tests.support.paths import ROOT
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

BEGIN: Final = 1_700_000_000
"""Time of the first samples. [Unix s]"""
METRICS: Final = {
    "v/b/current": "battery_current_a",
    "v/b/soc": "soc_pct",
    "v/b/voltage": "battery_voltage_v",
    "v/p/latitude": "latitude_deg",
    "v/p/longitude": "longitude_deg",
    "v/p/odometer": "odometer_km",
    "v/p/speed": "speed_kmh",
}
"""Metric -> field that it gives, in the order in which a module sends them, after its clock."""


class Said(NamedTuple):
    """A value that a module published."""

    car: str
    time_s: int
    field: str
    value: float


class _Connection:
    """A connection to the broker that notes which values are acknowledged."""

    def __init__(self, port: int, name: str) -> None:
        self.acknowledged: set[Said] = set()
        self._waiting: dict[int, Said | None] = {}
        self._early: set[int] = set()
        self._packets: deque[int] = deque()  # that were acknowledged; their thread must not wait for a lock
        self._held: deque[tuple[str, str, Said | None]] = deque()
        self._is_lost = False
        self._client = Client(CallbackAPIVersion.VERSION2, name, clean_session=False)
        self._client.max_inflight_messages_set(1000)
        self._client.reconnect_delay_set(1, 2)
        self._client.on_publish = lambda _, __, packet, ___, ____: self._packets.append(packet)
        self._client.on_disconnect = lambda *_: setattr(self, "_is_lost", True)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def send(self, topic: str, text: str, said: Said | None) -> None:
        """Publish a message, after all messages before.

        After a reconnection, the client would publish a new message before those that it has to send again.
        """
        self._held.append((topic, text, said))
        if self._is_lost:
            self._note()
            self._is_lost = bool(self._waiting) or not self._client.is_connected()
        while self._held and not self._is_lost:
            self._publish(*self._held.popleft())

    def count_unacknowledged(self) -> int:
        """Return the number of messages that the broker has not acknowledged so far."""
        if self._held:
            self.send(*self._held.pop())
        self._note()
        return len(self._waiting) + len(self._held)

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()
        self._client.loop_stop()

    def _publish(self, topic: str, text: str, said: Said | None) -> None:
        packet = self._client.publish(topic, text, qos=1).mid
        if packet in self._waiting:  # the number is used again
            self._note()
        if packet in self._early:
            self._early.remove(packet)
            self._keep(said)
        else:
            self._waiting[packet] = said

    def _note(self) -> None:
        while self._packets:
            packet = self._packets.popleft()
            if packet in self._waiting:
                self._keep(self._waiting.pop(packet))
            else:
                self._early.add(packet)

    def _keep(self, said: Said | None) -> None:
        if said is not None:
            self.acknowledged.add(said)


class Modules:
    """The OVMS modules of a fleet, which share some connections.

    Parameters
    ----------
    port : int
        Port of the broker.
    cars : int
        Number of cars.
    connections : int
        Number of connections.
    """

    def __init__(self, port: int, cars: int, connections: int = 4) -> None:
        self.published = 0
        self._cars = [f"car-{number:04}" for number in range(cars)]
        self._connections = [_Connection(port, f"modules-{number}") for number in range(connections)]

    @property
    def acknowledged(self) -> set[Said]:
        """Return the values that the broker has acknowledged, as of the last count."""
        return set().union(*(each.acknowledged for each in self._connections))

    def publish(self, step: int, period_s: int) -> None:
        """Publish one sample of each car."""
        time_s = BEGIN + step * period_s
        clock = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(time_s))
        for number, car in enumerate(self._cars):
            send = self._connections[number % len(self._connections)].send
            send(f"ovms/user/{car}/metric/m/time/utc", clock, None)
            for place, (metric, field) in enumerate(METRICS.items()):
                value = round(10.0 + place + 0.01 * step + 0.001 * (number % 10), 3)
                send(f"ovms/user/{car}/metric/{metric}", str(value), Said(car, time_s, field, value))
            self.published += 1 + len(METRICS)

    def count_unacknowledged(self) -> int:
        """Return the number of messages that the broker has not acknowledged so far."""
        return sum(each.count_unacknowledged() for each in self._connections)

    def close(self) -> None:
        """Disconnect."""
        for each in self._connections:
            each.close()


class Outcome(NamedTuple):
    """What came of a run."""

    published: int
    acknowledged: int
    rows: int
    lost: list[Said]
    again: int
    seconds: float
    bridge: dict[str, Any]


@contextmanager
def bridge_process(broker: MqttBroker, endpoint: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run `socast bridge ovms` in a process of its own, with its log on standard error."""
    command = [
        sys.executable,
        "-m",
        "socast",
        "bridge",
        "ovms",
        "--broker",
        broker.url,
        "--connect",
        endpoint,
    ]
    process = subprocess.Popen([*command, "--json-log", *options], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class Received:
    """The telemetry that a plain subscriber receives."""

    def __init__(self, node: Node, period_s: int) -> None:
        self._period_s = period_s
        self.rows = 0
        self.again = 0
        self.values: set[Said] = set()
        self._payloads: set[bytes] = set()
        self._subscriber = node.session.declare_subscriber("fleet/*/telemetry", self._take)

    def _take(self, sample: Any) -> None:
        payload = sample.payload.to_bytes()
        self.rows += 1
        self.again += payload in self._payloads
        self._payloads.add(payload)
        row = json.loads(payload)
        # what comes more than a second after the rest of its transmission is a row of its own, a little later
        time_s = BEGIN + int(row["time_s"] - BEGIN) // self._period_s * self._period_s
        for field in METRICS.values():
            if field in row:
                self.values.add(Said(row["vehicle_id"], time_s, field, row[field]))


def run_outage(cars: int, minutes: float, *, speed: float = 1.0, period_s: int = 10, folder: Path) -> Outcome:
    """Run a fleet with a restart of the broker in the middle.

    Parameters
    ----------
    cars : int
        Number of cars.
    minutes : float
        Time on the clocks of the cars. [min]
    speed : float
        Times real time.
    period_s : int
        Time between two samples of a car, on its clock. [s]
    folder : Path
        Folder for what the broker keeps.
    """
    began, steps = time.monotonic(), max(4, round(60 * minutes / period_s))
    with ExitStack() as stack:
        broker = stack.enter_context(MqttBroker(folder))
        router = stack.enter_context(RouterProcess())
        received = Received(stack.enter_context(router.join()), period_s)
        bridge = stack.enter_context(bridge_process(broker, router.endpoint))
        wait_for_line(bridge, "broker joined")
        modules = Modules(broker.port, cars)
        stack.callback(modules.close)
        for step in range(steps):
            due = began + step * period_s / speed
            if step == steps // 2:
                broker.stop()
            if step == steps // 2 + max(1, steps // 20):
                broker.start()
            modules.publish(step, period_s)
            time.sleep(max(0.0, due - time.monotonic()))
        assert eventually(lambda: modules.count_unacknowledged() == 0, 600.0)
        acknowledged = modules.acknowledged
        eventually(lambda: len(received.values) >= len(acknowledged) and acknowledged <= received.values, 300.0)
        bridge.terminate()
        log = [json.loads(line) for line in bridge.communicate(timeout=60)[1].splitlines()]
        end = next(line for line in log if line["event"] == "bridge ends")
        lost = sorted(acknowledged - received.values)
        return Outcome(
            modules.published,
            len(acknowledged),
            received.rows,
            lost,
            received.again,
            time.monotonic() - began,
            end,
        )


def wait_for_line(bridge: subprocess.Popen[str], words: str) -> None:
    """Read the log of a bridge up to a line that holds some words."""
    assert bridge.stderr is not None
    assert any(words in line for line in bridge.stderr), f"the bridge ended without saying {words}"


def main() -> None:
    """Run a fleet and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--speed", type=float, default=1.0, help="times real time")
    parser.add_argument("--period", type=int, default=10, help="time between two samples of a car [s]")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_outage(given.cars, given.minutes, speed=given.speed, period_s=given.period, folder=Path(folder))
    print(
        f"{outcome.published:,} messages of {given.cars:,} cars in {outcome.seconds:.0f} s; of the "
        f"{outcome.acknowledged:,} values that the broker had acknowledged, {len(outcome.lost):,} were lost; "
        f"{outcome.rows:,} rows, {outcome.again:,} of them twice"
    )
    print(json.dumps(outcome.bridge))
    for said in outcome.lost[:10]:
        print("lost:", said)
    raise SystemExit(bool(outcome.lost))


if __name__ == "__main__":
    main()
