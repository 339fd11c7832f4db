"""What surrounds a live service, for tests: its snapshot, its web pages and the socket of systemd."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from socast.stream.service_snapshot import ServiceSnapshot, VehicleSnapshot

FULL = ServiceSnapshot(
    messages=9,
    forecasts=4,
    received={"telemetry": 8},
    rejected={"not_json": 1},
    flagged={"late": 2},
    duplicates=3,
    lost=5,
    recovered=6,
    missed=7,
    recorded=9,
    unrecorded=0,
    dropped={"queue_bytes": 1},
    is_catching_up=False,
    queue_messages=2,
    queue_bytes=300,
    newest_sample_s=100.0,
    vehicles=2,
    active_vehicles=1,
    rides=2,
    unfit_rides={"too_short": 1},
    faulty_loggers={"current_inverted": 1},
    unpredicted_rides={"unknown_model": 1},
    refused_forecasts={"not_finite": 1},
    answered=3,
    refused_queries={"unknown_vehicle": 1},
    interval_outcomes={("plan", "below"): 1, ("plan", "inside"): 18, ("plan", "above"): 1},
    model_interval_outcomes={("a/1", "inside"): 2},
    model_rides={("a/1", "predicted"): 2, ("a/1", "unpredicted"): 0},
    model_mae_kwh={"a/1": 0.25},
    model_bias_kwh={"a/1": -0.125},
    model_mae_ratio={"a/1": 0.1},
    saved_s=90.0,
    recorded_s=99.0,
    publishes=True,
    overlapping=("shard 3/3",),
    shards=2,
    of_vehicles=VehicleSnapshot(("car-1", "car-2"), (100.0, 40.0), (5, 0), (1.05, None), (26.5, 27.0)),
    assessed_s=80.0,
)
"""Snapshot with a value of every metric."""


class Clock:
    """Stand for a clock that a test moves."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def ask_page(address: object, page: str, method: str = "GET", accept: str = "") -> tuple[int, str]:
    """Return the code and the content of a page."""
    request = Request(f"http://{address}{page}", method=method, headers={"Accept": accept})
    try:
        with urlopen(request, timeout=10.0) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def read_metrics(text: str) -> dict[str, float]:
    """Return the samples of a text of metrics: `name{label="value"}` -> value."""
    lines = (line.rpartition(" ") for line in text.splitlines() if line and not line.startswith("#"))
    return {name: float(value) for name, _, value in lines}


class SystemdSocket:
    """Receive what a service tells systemd."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self.lines: list[str] = []

    def read(self) -> list[str]:
        """Return all lines received so far."""
        while True:
            try:
                self.lines += self._socket.recv(65_536).decode().splitlines()
            except BlockingIOError:
                return self.lines

    def close(self) -> None:
        self._socket.close()


@contextmanager
def systemd_socket(folder: Path) -> Iterator[tuple[SystemdSocket, str]]:
    """Give a socket that stands for systemd, and its address."""
    address = str(folder / "notify")
    receiver = SystemdSocket(address)
    try:
        yield receiver, address
    finally:
        receiver.close()
