"""Recordings of telemetry for tests of the MCAP reader and writer."""

from pathlib import Path

from socast.core.wire.messages import Message, Telemetry, encode
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink

SECOND = 1_000_000_000
"""One second. [ns]"""
BEGIN = 1_700_000_000 * SECOND
"""Time of receipt of the first message. [ns]"""


def make_telemetry(count: int, cars: int = 3) -> list[Message]:
    """Return one telemetry message per second, in turn for each of some cars."""
    return [
        Message(
            f"fleet/car-{i % cars}/telemetry",
            encode(Telemetry(vehicle_id=f"car-{i % cars}", time_s=1.7e9 + i - 0.25, speed_kmh=float(i % 90))),
            BEGIN + i * SECOND,
        )
        for i in range(count)
    ]


def write_recording(path: Path, messages: list[Message], chunk_bytes: int = 4096) -> Path:
    """Write messages to a recording and return its path."""
    with McapSink(path, chunk_bytes) as sink:
        sink.put(messages)
    return path


def read_recording(path: Path) -> list[Message]:
    """Return all messages of a recording."""
    return [message for block in McapSource(path) for message in block]
