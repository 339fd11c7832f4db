"""Measure what a live consumer takes per sample and per car: processor time, memory, bytes of network and of disk.

`python -m socast.tools.bench.capacity --cars 1000 --rounds 100` prints one JSON object. Router, publisher and consumer
are separate processes on loopback. Times are processor times, which other work changes less than the clock. A consumer
that waits for samples takes processor time too: where the publisher is slow, its time per sample is too large.
"""

import argparse
import json
import multiprocessing
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil

from socast.stream.zenoh_session import Connection, find_free_port
from socast.tools.bench.live import WARM_UP, publish_stream, run_router

PATIENCE_S = 300.0


def count_bytes(port: int) -> dict[str, int]:
    """Return the bytes that the router has received and sent, of all its connections."""
    command = ["ss", "-tinH", f"sport = :{port}"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout  # noqa: S603 - constant words
    words = text.split()
    return {
        name: sum(int(word.partition(":")[2]) for word in words if word.startswith(f"{name}:"))
        for name in ("bytes_received", "bytes_sent")
    }


def count_samples(log: Path) -> int:
    """Return the number of samples that a consumer has taken, by its last line of counters."""
    lines = [json.loads(line) for line in log.read_text().splitlines(keepends=True) if line.endswith("\n")]
    return max((int(line.get("received.telemetry", 0)) for line in lines), default=0)


def wait_for(log: Path, samples: int) -> None:
    """Return once a consumer has taken a number of samples."""
    until = time.monotonic() + PATIENCE_S
    while count_samples(log) < samples:
        if time.monotonic() > until:
            raise TimeoutError(f"the consumer has taken {count_samples(log):,} of {samples:,} samples")
        time.sleep(0.2)


def measure(cars: int, rounds: int, folder: Path) -> dict[str, Any]:
    """Return the figures of a consumer of a number of cars that each send a number of samples."""
    context, port = multiprocessing.get_context("spawn"), find_free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    ready, go, stop = context.Event(), context.Event(), context.Event()
    listening = context.Event()
    router = context.Process(target=run_router, args=(Connection(listen=(endpoint,), mode="router"), listening, stop))
    router.start()
    listening.wait(PATIENCE_S)
    log, kept = folder / "consumer.log", folder / "kept"
    files = "--record", kept, "--state", folder / "fleet.state", "--report", 1.0, "--max-vehicles", 10_000_000
    command = [sys.executable, "-m", "socast", "live", "--connect", endpoint, "--json-log", *map(str, files)]
    with log.open("w") as file:
        consumer = subprocess.Popen(command, stderr=file, stdout=subprocess.DEVNULL)  # noqa: S603 - our own command
    connections = [Connection(connect=(endpoint,))]
    publisher = context.Process(target=publish_stream, args=(connections, cars, rounds, ready, go, stop))
    try:
        while '"listening"' not in log.read_text():
            time.sleep(0.2)
        process, empty = psutil.Process(consumer.pid), psutil.Process(consumer.pid).memory_info().rss
        publisher.start()
        ready.wait(PATIENCE_S)
        wait_for(log, cars * WARM_UP)
        time.sleep(5.0)
        idle, began = sum(process.cpu_times()[:2]), time.monotonic()
        time.sleep(5.0)
        idle_share = (sum(process.cpu_times()[:2]) - idle) / (time.monotonic() - began)
        before, cpu, router_cpu = count_bytes(port), process.cpu_times(), psutil.Process(router.pid).cpu_times()
        disk = sum(path.stat().st_size for path in kept.glob("*"))
        go.set()
        wait_for(log, cars * (WARM_UP + rounds))
        after, cpu_after = count_bytes(port), process.cpu_times()
        router_after = psutil.Process(router.pid).cpu_times()
        full = process.memory_info().rss
        consumer.terminate()
        consumer.wait(PATIENCE_S)
        disk = sum(path.stat().st_size for path in kept.glob("*")) - disk
    finally:
        stop.set()
        for each in (publisher, router):
            each.terminate()
        consumer.kill()
    samples = cars * rounds
    return {
        "cars": cars,
        "samples": samples,
        "idle_percent_of_a_core": 100.0 * idle_share,
        "consumer_us_per_sample": 1e6 * (sum(cpu_after[:2]) - sum(cpu[:2])) / samples,
        "router_us_per_sample": 1e6 * (sum(router_after[:2]) - sum(router_cpu[:2])) / samples,
        "to_router_bytes_per_sample": (after["bytes_received"] - before["bytes_received"]) / samples,
        "from_router_bytes_per_sample": (after["bytes_sent"] - before["bytes_sent"]) / samples,
        "recording_bytes_per_sample": disk / samples,
        "empty_mb": empty / 1e6,
        "full_mb": full / 1e6,
        "memory_bytes_per_car": (full - empty) / cars,
        "state_bytes_per_car": (folder / "fleet.state").stat().st_size / cars,
    }


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m socast.tools.bench.capacity", description=__doc__)
    parser.add_argument("--cars", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=100, help="samples of each car")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        figures = measure(options.cars, options.rounds, Path(folder))
    print(json.dumps({name: round(value, 1) for name, value in figures.items()}), flush=True)


if __name__ == "__main__":
    main()
