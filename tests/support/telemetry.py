"""A small maker of telemetry whose truth is known; its faults are planted by whoever asks for it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from socast.core.batch import Batch, Lanes
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message

START = 1_705_305_600.0
"""15 January 2024, 08:00 UTC: winter."""
PERIOD = 3.0
PLACE = (45.5, -73.6)
"""Where every drive begins. [deg]"""

Columns = dict[str, Any]


def profile(n: int, rng: np.random.Generator, top: float = 15.0) -> np.ndarray:
    """Return a speed a sample: cruising, slowing and stopping as in town. [m/s]"""
    speed = np.zeros(n)
    at = 1
    while at < n:
        cruise, length = rng.uniform(0.4, 1.0) * top, int(rng.integers(10, 30))
        shape = np.minimum(1.0, np.minimum(np.arange(length), np.arange(length)[::-1]) / 4)
        part = (cruise * shape)[: n - at]
        speed[at : at + len(part)] = part
        at += length + int(rng.integers(0, 6))
    return speed


def drive(n: int = 400, seed: int = 1, speed: Any = None, **columns: Any) -> Columns:
    """Return the samples of a drive as wire columns, without a fault in them.

    The car drives due north; `metres` is where it truly is: the trapezoid of the speed, as the product has it.
    """
    rng = np.random.default_rng(seed)
    v = profile(n, rng) if speed is None else np.broadcast_to(np.asarray(speed, float), (n,)).copy()
    metres = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * PERIOD)])
    made = {
        "time_s": START + PERIOD * np.arange(n),
        "seq": np.arange(n),
        "ride_id": np.full(n, "r1", dtype=object),
        "latitude_deg": PLACE[0] + np.degrees(metres / EARTH_RADIUS),
        "longitude_deg": np.full(n, PLACE[1]),
        "speed_kmh": v * 3.6,
        "metres": metres,
    }
    return made | {name: np.broadcast_to(np.asarray(value), (n,)).copy() for name, value in columns.items()}


def picked(columns: Mapping[str, Any], rows: Any) -> Columns:
    """Return some of the rows, in the order given."""
    return {name: values[rows] for name, values in columns.items()}


def without(columns: Mapping[str, Any], *names: str) -> Columns:
    """Return the columns but those named."""
    return {name: values for name, values in columns.items() if name not in names}


def joined(*parts: Mapping[str, Any]) -> Columns:
    """Return columns one after another."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def telemetry(columns: Mapping[str, Any], vehicle: str = "a") -> list[Message]:
    """Return one message a row; a value that is NaN is left out, a None is sent as null."""
    rows = zip(*(_encode_column(name, values) for name, values in columns.items() if name != "metres"), strict=True)
    begin, key = f'{{"vehicle_id": {json.dumps(vehicle)}', f"fleet/{vehicle}/telemetry"
    return [
        Message(key, f"{begin}{''.join(row)}}}".encode(), int((START + PERIOD * i) * 1e9)) for i, row in enumerate(rows)
    ]


def _encode_column(name: str, values: Any) -> list[str]:
    """Return the member of each row's JSON object that holds a value, with the comma before it; none for NaN."""
    begin, sent = f", {json.dumps(name)}: ", np.asarray(values).tolist()
    texts = json.dumps(sent, separators=("\n", ": "))[1:-1].split("\n")  # JSON has no line feed within a text
    return [begin + text if value == value else "" for value, text in zip(sent, texts, strict=True)]


def make_message(kind: str, vehicle: str = "a", time: float = START, **fields: Any) -> Message:
    """Return a message of another kind about a vehicle."""
    payload = json.dumps({"vehicle_id": vehicle, "time_s": time} | fields).encode()
    return Message(f"fleet/{vehicle}/{kind}", payload, int(time * 1e9))


def leaf(vehicle: str = "a", time: float = START, **fields: Any) -> Message:
    """Return what a Nissan Leaf of 2013 says of itself."""
    return make_message("vehicle", vehicle, time, model="nissan-leaf-2013", **fields)


def observed(
    station: str = "yul", time: float = START - 60.0, place: Sequence[float] = PLACE, **fields: Any
) -> Message:
    """Return an observation of the weather."""
    values = {"station_id": station, "time_s": time, "latitude_deg": place[0], "longitude_deg": place[1]} | fields
    return Message(f"weather/{station}", json.dumps(values).encode(), int(time * 1e9))


def decoded(messages: Sequence[Message]) -> Batch:
    """Return the rows of messages of any vehicles."""
    return Decoder(Lanes()).decode(messages)[0]


def cleaned(columns: Mapping[str, Any], limits: Settings | None = None, period: float = np.nan) -> Clean:
    """Send the samples of one car, which announces its period or none, through the codec and the kernel."""
    return Cleaner(limits or Settings()).clean(decoded(telemetry(columns)), 1, period=period)


def count(clean: Clean, bit: Quality) -> int:
    """Return how many samples have a quality bit."""
    return int(np.count_nonzero(clean.quality & bit))


def chunked(messages: Sequence[Message], cuts: Iterable[int]) -> list[list[Message]]:
    """Return the messages cut at some places."""
    edges = sorted({0, len(messages), *(min(cut, len(messages)) for cut in cuts)})
    return [list(messages[start:stop]) for start, stop in pairwise(edges)]


def ran(messages: Sequence[Message], cuts: Iterable[int] = (), **options: Any) -> tuple[Pipeline, list[Message]]:
    """Send messages through a pipeline of their own, to the end."""
    pipeline = Pipeline(**options)
    out = [forecast for chunk in chunked(messages, cuts) for forecast in pipeline.push(chunk)]
    return pipeline, out + pipeline.finish()
