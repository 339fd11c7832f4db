"""Stop the active one of two consumers on standby, again and again, measure how long no forecast comes, and compare the
forecasts with those of an uninterrupted run.

`python -m tests.support.takeovers --rounds 10` prints one JSON object. Router and consumers are separate processes.
`--rate` gives the samples of each car per second; a consumer that is away for longer than 64 of them loses the others.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any

from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream.health import HttpAddress
from socast.stream.zenoh_session import find_free_port
from socast.stream.zenoh_sink import ZenohSink
from tests.support.live_consumers import consumers, logged
from tests.support.recorded_shift import shift
from tests.support.router_process import RouterProcess
from tests.support.service import ask_page
from tests.support.zenoh_sessions import eventually

RATE = 4.0
"""Samples of each car per second; 64 of them, which caches hold, are 16 s."""


class Takeovers:
    """Run a router, a publisher of three cars and two consumers.

    Parameters
    ----------
    folder : Path
        Folder for the files of the consumers.
    rate : float
        Samples of each car per second. [1/s]

    Attributes
    ----------
    received : list of (float, str)
        Monotonic time and Zenoh session of each forecast. [s]
    forecasts : set of (str, bytes)
        Key and payload of each forecast.
    """

    def __init__(self, folder: Path, rate: float = RATE) -> None:
        self._folder, self._rate, self._router = folder, rate, RouterProcess()
        self.received: list[tuple[float, str]] = []
        self.forecasts: set[tuple[str, bytes]] = set()
        self._published = list[Message]()
        self._stop = Event()
        self._consumers = consumers(folder)
        self._start = self._consumers.__enter__()
        self._node = self._router.join()
        self._node.session.declare_subscriber("fleet/*/forecast", self._take)
        self._addresses = [HttpAddress("127.0.0.1", find_free_port()) for _ in range(2)]
        self.pair = [self.start(0), self.start(1)]
        self._thread = Thread(target=self._publish)
        self._thread.start()
        assert eventually(lambda: self.received)

    def start(self, number: int) -> tuple[subprocess.Popen[bytes], Path]:
        """Start a consumer with files of its own."""
        files = "--state", self._folder / f"{number}.state", "--record", self._folder / f"kept-{number}"
        return self._start(
            "--connect", self._router.endpoint, "--standby", "--metrics", self._addresses[number], *files
        )

    def ask_roles(self) -> list[str]:
        """Return what each consumer says of itself."""
        return [ask_page(address, "/readyz")[1] for address in self._addresses]

    def find_active(self) -> int:
        """Return the place of the consumer that published last."""
        zid = self.received[-1][1]
        return next(n for n, (_, log) in enumerate(self.pair) if self.tokens(log) and zid in self.tokens(log)[-1])

    def tokens(self, log: Path, event: str = "active") -> list[str]:
        """Return the tokens with which a consumer became active, or passive."""
        return [str(line["token"]) for line in logged(log) if line["event"] == event]

    def interrupt(self, number: signal.Signals) -> float:
        """Send a signal to the active consumer; return the time until the other publishes. [s]

        A consumer that was stopped continues then, and must publish nothing before it has noticed.
        """
        active, old, seen = self.find_active(), self.received[-1][1], len(self.received)
        process, log = self.pair[active]
        passive = len(self.tokens(log, "passive"))
        began = time.monotonic()
        process.send_signal(number)
        assert eventually(lambda: any(zid != old for _, zid in self.received[seen:]))
        first = next(at for at, zid in self.received[seen:] if zid != old)
        if number == signal.SIGSTOP:
            resumed = len(self.received)
            process.send_signal(signal.SIGCONT)
            assert eventually(lambda: len(self.tokens(log, "passive")) > passive)
            assert eventually(lambda: len(self.received) > resumed + 3)
            assert not [at for at, zid in self.received if at > first and zid == old], "the old one published"
        else:
            process.wait()
        self._last = active
        return first - began

    def replace_killed(self) -> None:
        """Start the consumer that was killed last, and give it time to take part."""
        self.pair[self._last] = self.start(self._last)
        time.sleep(1.5)

    def end(self) -> list[int]:
        """Stop the publisher and then the consumers that run; return the number of samples that each has lost."""
        self._stop.set()
        self._thread.join()
        running = [(process, log) for process, log in self.pair if process.poll() is None]
        for process, _ in running:
            process.terminate()
        assert [process.wait(60) for process, _ in running] == [0] * len(running)
        return [int(line.get("lost", 0)) for _, log in running for line in logged(log) if line["event"] == "finished"]

    def close(self) -> None:
        """End everything; a second call has no effect."""
        self._stop.set()
        self._thread.join()
        self._consumers.__exit__(None, None, None)
        self._node.close()
        self._router.kill()

    def count_different(self) -> int:
        """Return the number of forecasts that an uninterrupted run does not make."""
        reference = Pipeline(EXTENDED_PHYSICAL).push(self._published)
        return len(self.forecasts - {(message.key, message.payload) for message in reference})

    def _take(self, sample: Any) -> None:
        self.received.append((time.monotonic(), str(sample.source_info.source_id.zid)))
        self.forecasts.add((str(sample.key_expr), sample.payload.to_bytes()))

    def _publish(self) -> None:
        sink, messages = ZenohSink(self._node), shift(6000)
        for start, end in [(0, 4), *((first, first + 3) for first in range(4, len(messages), 3))]:
            sink.put(messages[start:end])
            self._published += messages[start:end]
            if self._stop.wait(1.0 / self._rate):
                return


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.takeovers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--rate", type=float, default=RATE)
    options = parser.parse_args()
    with TemporaryDirectory() as made:
        pair = Takeovers(Path(made), options.rate)
        try:
            stopped = [pair.interrupt(signal.SIGSTOP) for _ in range(options.rounds)]
            different = pair.count_different()
            killed = []
            for _ in range(options.rounds):
                killed.append(pair.interrupt(signal.SIGKILL))
                pair.replace_killed()
            lost = pair.end()
        finally:
            pair.close()
    result: dict[str, Any] = {
        name: {"median_s": round(statistics.median(times), 3), "max_s": round(max(times), 3)}
        for name, times in (("stopped", stopped), ("killed", killed))
    }
    result |= {
        "forecasts": len(pair.forecasts),
        "different": different,
        "different_with_kills": pair.count_different(),
        "lost": lost,
    }
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
