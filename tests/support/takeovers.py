"""Stop the active one of two consumers on standby, again and again, and measure how long no forecast comes.

`python -m tests.support.takeovers --rounds 10` prints one JSON object. Router and consumers are separate processes.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any

from stream.zenoh_pubsub import ZenohSink
from stream.zenoh_session import Connection, Node, find_free_port
from tests.support.live_consumers import consumers, logged
from tests.support.outages import ROUTER
from tests.support.recorded_shift import shift
from tests.support.zenoh_sessions import eventually


class Takeovers:
    """Run a router, a publisher and two consumers; a context manager.

    Attributes
    ----------
    received : list of (float, str)
        Monotonic time and Zenoh session of each forecast. [s]
    payloads : dict
        Different forecasts for each vehicle and time.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._endpoint = folder, f"tcp/127.0.0.1:{find_free_port()}"
        self.received: list[tuple[float, str]] = []
        self.payloads: dict[tuple[str, float], set[bytes]] = defaultdict(set)
        self._stop = Event()
        self._router = subprocess.Popen([sys.executable, "-c", ROUTER, self._endpoint])
        self._consumers = consumers(folder)
        self._start = self._consumers.__enter__()
        self._node = self._open_node()
        self._node.session.declare_subscriber("fleet/*/forecast", self._take)
        self.pair = [self.start(0), self.start(1)]
        self._thread = Thread(target=self._publish)
        self._thread.start()
        assert eventually(lambda: self.received, 20.0)

    def start(self, number: int) -> tuple["subprocess.Popen[bytes]", Path]:
        """Start a consumer with files of its own."""
        files = "--state", self._folder / f"{number}.state", "--record", self._folder / f"kept-{number}"
        return self._start("--connect", self._endpoint, "--standby", *files)

    def find_active(self) -> int:
        """Return the place of the consumer that published last."""
        zid = self.received[-1][1]
        return next(n for n, (_, log) in enumerate(self.pair) if self.tokens(log) and zid in self.tokens(log)[-1])

    def tokens(self, log: Path) -> list[str]:
        """Return the tokens with which a consumer became active."""
        return [str(line["token"]) for line in logged(log) if line["event"] == "active"]

    def interrupt(self, number: signal.Signals) -> float:
        """Send a signal to the active consumer; return the time until the other publishes. [s]"""
        active = self.find_active()
        old = self.received[-1][1]
        began = time.monotonic()
        self.pair[active][0].send_signal(number)
        assert eventually(lambda: any(at > began and zid != old for at, zid in self.received[-50:]), 15.0)
        first = next(at for at, zid in self.received if at > began and zid != old)
        if number == signal.SIGSTOP:
            resumed = time.monotonic()
            self.pair[active][0].send_signal(signal.SIGCONT)
            time.sleep(2.0)
            assert not [at for at, zid in self.received if at > first and zid == old], "the old one published"
            assert any(at > resumed + 0.5 for at, _ in self.received), "no forecast after SIGCONT"
        else:
            self.pair[active][0].wait()
        self._last = active
        return first - began

    def replace_killed(self) -> None:
        """Start the consumer that was killed last, and give it time to take part."""
        self.pair[self._last] = self.start(self._last)
        time.sleep(1.5)

    def close(self) -> None:
        """End everything."""
        self._stop.set()
        self._thread.join()
        self._consumers.__exit__(None, None, None)
        self._node.close()
        self._router.kill()
        self._router.wait()

    def count_different(self) -> int:
        """Return the number of vehicles and times with more than one forecast."""
        return sum(len(payloads) > 1 for payloads in self.payloads.values())

    def _open_node(self) -> Node:
        """Connect once the router listens."""
        nodes: list[Node] = []

        def connect() -> bool:
            try:
                nodes.append(Node(Connection(connect=(self._endpoint,))))
            except Exception:  # noqa: BLE001 - not yet
                time.sleep(0.1)
            return bool(nodes)

        assert eventually(connect, 20.0)
        return nodes[0]

    def _take(self, sample: Any) -> None:
        payload = sample.payload.to_bytes()
        self.received.append((time.monotonic(), str(sample.source_info.source_id.zid)))
        self.payloads[str(sample.key_expr), json.loads(payload)["time_s"]].add(payload)

    def _publish(self) -> None:
        sink, messages = ZenohSink(self._node), shift(6000)
        sink.put(messages[:4])
        for first in range(4, len(messages), 3):
            sink.put(messages[first : first + 3])
            if self._stop.wait(0.1):
                return


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.takeovers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    rounds = parser.parse_args().rounds
    with TemporaryDirectory() as made:
        pair = Takeovers(Path(made))
        try:
            stopped = [pair.interrupt(signal.SIGSTOP) for _ in range(rounds)]
            different = pair.count_different()
            killed = []
            for _ in range(rounds):
                killed.append(pair.interrupt(signal.SIGKILL))
                pair.replace_killed()
        finally:
            pair.close()
    result = {
        name: {"median_s": round(statistics.median(times), 3), "max_s": round(max(times), 3)}
        for name, times in (("stopped", stopped), ("killed", killed))
    }
    forecasts = {
        "forecasts": len(pair.payloads),
        "different": different,
        "different_with_kills": pair.count_different(),
    }
    print(json.dumps(result | forecasts), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
