"""Measure the workbench: processor time and bytes per browser for a large fleet, and the first load of its pages.

`python -m socast.tools.bench.workbench` prints the figures. The server runs in a process of its own. All cars of its
board change every second, as if each car sent a sample and the service a forecast.
"""

import argparse
import asyncio
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from threading import Event, Thread
from typing import Any, Final

import numpy as np

from socast.core.errors import SettingsError
from socast.core.wire.messages import Forecast, Interval, Message, Outlook, QualityCounts, Telemetry, encode
from socast.tools.workbench.fleet.board import Board

CARS: Final = 1000
ROUNDS: Final = 60
"""Number of seconds of messages that are made before the measurement."""
SETTLE_S: Final = 3.0
MEASURE_S: Final = 12.0
CLIENTS: Final = (0, 1, 20)
LOADS: Final = 5
"""Number of first loads, of which the median counts."""


class BoardSource:
    """Show a board that somebody else fills."""

    def __init__(self, board: Board) -> None:
        self.board = board

    def show(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def describe(self) -> dict[str, Any]:
        """Return the state of a live service."""
        return {
            "mode": "live",
            "endpoint": "benchmark",
            "time_s": None,
            "received": 0,
            "dropped": 0,
            "refused": {},
            "problem": "",
        }

    def ask(self, vehicle_id: str, parameters: Mapping[str, str]) -> Outlook:
        """Refuse: there is no pipeline."""
        raise SettingsError(f"{vehicle_id} cannot be asked about: no service runs; start one ({len(parameters)} given)")

    def list_ask_options(self) -> None:
        """Return None: no command answers for a replay."""

    def get_parts(self, vehicle_id: str) -> dict[str, float] | None:  # noqa: ARG002 - as in the protocol
        """Return None: there is no model."""
        return None


def make_fleet_messages(cars: int, second: float, rng: np.random.Generator) -> list[Message]:
    """Return a sample and a forecast of each of many cars in a city; all values differ from second to second.

    Units: second [s].
    """
    out = []
    places = rng.normal((45.5, -73.6), 0.05, (cars, 2)).tolist()
    for i, soc in enumerate(rng.uniform(10.0, 100.0, cars).tolist()):
        name, time_s, (latitude, longitude) = f"taxi-{i:04d}", 1.7e9 + second, places[i]
        sample = Telemetry(name, time_s, latitude_deg=latitude, longitude_deg=longitude, speed_kmh=30.0)
        forecast = Forecast(
            vehicle_id=name,
            time_s=time_s,
            ride_id="ride",
            model="model/1",
            ride_distance_km=3.0 + second / 60.0,
            ride_duration_s=300.0 + second,
            ride_energy_predicted_kwh=0.5,
            ride_energy_measured_kwh=0.6,
            soc_pct=soc,
            soc_sd_pct=0.2,
            range_km=Interval(90.0, 60.0, 120.0),
            soc_end_of_shift_pct=Interval(soc - 8.0, soc - 10.0, soc),
            reserve_risk=i / cars,
            quality=QualityCounts(1, 0, 0, 0, 0),
        )
        out.append(Message(f"fleet/{name}/telemetry", encode(sample), int(time_s * 1e9)))
        out.append(Message(f"fleet/{name}/forecast", encode(forecast), int(time_s * 1e9)))
    return out


def serve_cars(cars: int, entries: int) -> None:
    """Serve a board of cars that changes every second until the end of input, and print the first addresses."""
    from socast.tools.workbench.jobs import Jobs  # noqa: PLC0415 - an extra
    from socast.tools.workbench.json_routes import Workbench  # noqa: PLC0415 - an extra
    from socast.tools.workbench.server import WorkbenchServer  # noqa: PLC0415 - an extra
    from socast.tools.workbench.workspace import Workspace  # noqa: PLC0415 - an extra

    rng, board = np.random.default_rng(7), Board()
    rounds = [make_fleet_messages(cars, float(second), rng) for second in range(ROUNDS)]
    addresses: list[str] = []

    def announce(address: str) -> None:
        addresses.append(address)
        if len(addresses) <= entries:
            print(address, flush=True)

    server = WorkbenchServer(
        Workbench(Workspace(), Jobs(), fleet=BoardSource(board)),
        "127.0.0.1",
        0,
        announce,
    )
    stop = Event()

    def change() -> None:
        number = 0
        while not stop.is_set():
            board.take(rounds[number % ROUNDS])
            number += 1
            stop.wait(1.0)

    def await_end() -> None:
        sys.stdin.read()
        server.stop()

    Thread(target=change, daemon=True).start()
    Thread(target=await_end, daemon=True).start()
    server.run()
    stop.set()


async def receive(origin: str, cookie: str, clients: int, seconds: float) -> list[int]:
    """Return the bytes that each of several browsers receives in some seconds."""
    from websockets.asyncio.client import connect  # noqa: PLC0415 - an extra
    from websockets.typing import Origin  # noqa: PLC0415 - an extra

    async def listen() -> int:
        count = 0
        address = f"ws{origin.removeprefix('http')}/fleet.socket"
        async with connect(
            address, origin=Origin(origin), additional_headers={"Cookie": cookie}, compression=None, proxy=None
        ) as opened:
            until = time.monotonic() + seconds
            while (wait_s := until - time.monotonic()) > 0:
                try:
                    count += len(await asyncio.wait_for(opened.recv(), wait_s))
                except TimeoutError:
                    break
        return count

    return list(await asyncio.gather(*(listen() for _ in range(clients))))


def measure_clients(process: int, origin: str, cookie: str, clients: int) -> tuple[float, float]:
    """Return the share of a core that the server uses, and the rate per browser [kB/s], with so many browsers."""
    import psutil  # noqa: PLC0415 - for development

    server = psutil.Process(process)
    watched: list[float] = []

    def watch() -> None:
        for pause in (SETTLE_S, MEASURE_S):
            time.sleep(pause)
            used = server.cpu_times()
            watched.append(used.user + used.system)

    thread = Thread(target=watch)
    thread.start()
    seconds = SETTLE_S + MEASURE_S
    sizes = asyncio.run(receive(origin, cookie, clients, seconds)) if clients else []
    thread.join()
    return (watched[1] - watched[0]) / MEASURE_S, (max(sizes) / seconds / 1000.0 if sizes else 0.0)


def measure_first_load(address: str) -> dict[str, float]:
    """Return the time until the cars are in the table, and the bytes that were loaded; nothing without Chromium."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - for development

    executable = shutil.which("chromium")
    if executable is None:
        return {}
    arguments = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=arguments)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        begun = time.perf_counter()
        page.goto(address)
        page.wait_for_selector("tr.car")
        seconds = time.perf_counter() - begun
        size = page.evaluate(
            "[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]"
            ".reduce((sum, each) => sum + each.transferSize, 0)"
        )
        browser.close()
    return {"first_load_s": seconds, "first_load_bytes": size}


def enter(address: str) -> str:
    """Return the cookie of a new session."""
    import http.client  # noqa: PLC0415 - only here
    from urllib.parse import urlsplit  # noqa: PLC0415 - only here

    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.netloc)
    connection.request("GET", f"{parts.path}?{parts.query}")
    cookie = connection.getresponse().headers["set-cookie"].partition(";")[0]
    connection.close()
    return str(cookie)


def measure_workbench(cars: int) -> dict[str, float]:
    """Return all figures."""
    command = [sys.executable, "-m", "socast.tools.bench.workbench", "--serve", "--cars", str(cars)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:  # noqa: S603
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        origin, cookie = address.partition("/enter")[0], enter(address)
        figures: dict[str, float] = {"cars": cars}
        idle = 0.0
        for clients in CLIENTS:
            share, rate = measure_clients(server.pid, origin, cookie, clients)
            idle = idle if clients else share
            figures[f"core_pct_{clients}_clients"] = 100.0 * share
            if clients:
                figures[f"core_pct_per_client_of_{clients}"] = 100.0 * (share - idle) / clients
                figures[f"kb_per_s_of_each_of_{clients}"] = rate
        loads = [measure_first_load(server.stdout.readline().strip()) for _ in range(LOADS)]
        for name in ("first_load_s", "first_load_bytes"):
            known = sorted(load[name] for load in loads if name in load)
            if known:
                figures[name] = known[len(known) // 2]
        server.communicate("")
    return figures


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(prog="python -m socast.tools.bench.workbench", description=__doc__)
    parser.add_argument("--cars", type=int, default=CARS)
    parser.add_argument("--serve", action="store_true", help="serve only; used by the measurement itself")
    given = parser.parse_args()
    if given.serve:
        serve_cars(given.cars, LOADS + 1)
        return
    print(json.dumps({name: round(value, 3) for name, value in measure_workbench(given.cars).items()}, indent=2))


if __name__ == "__main__":
    main()
