"""Put other values into a saved state, and check that it is refused in one line or leads to plausible forecasts.

`python -m tests.support.forged_states --places 3 --mutations 30` tries every mutation at three of all equal parts.
"""

import argparse
import copy
import json
import random
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.errors import SocastError
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.snapshot import SCHEMAS
from socast.core.wire.state_schema import Anything, ByName, Many, Maybe, Row, Schema
from socast.stream.mcap_reader import McapSource
from tests.support.paths import ROOT

MESSAGES: Final = 250
"""Number of messages that a restored pipeline takes."""
COMPONENTS: Final = sorted(SCHEMAS.keys() - {"deferred"})
"""Components of a consumer: without those of tables."""

Path = tuple[Any, ...]


def make_pipeline() -> Pipeline:
    return Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])


@cache
def read_recording(name: str) -> list[Any]:
    return [message for block in McapSource(ROOT / "recordings" / name) for message in block]


@cache
def make_content(name: str) -> dict[str, Any]:
    """Return the state after most of a recording, with what nightly updates learn."""
    pipeline, messages = make_pipeline(), read_recording(name)
    pipeline.push(messages[: len(messages) * 3 // 4])
    pipeline.take_rides(), pipeline.take_windows()
    return msgspec.msgpack.decode(pipeline.snapshot()[32:])


def seal(content: dict[str, Any]) -> bytes:
    packed = msgspec.msgpack.encode(content)
    return sha256(packed).digest() + packed


def find_parts(schema: Schema, value: Any, places: int, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield each part of a state that has a schema of its own, and of equal parts only some.

    Parameters
    ----------
    schema : Schema
        Of the state.
    value : object
        The state.
    places : int
        Number of equal parts.
    path : tuple
        Path of the state in what holds it.
    """
    yield path, value
    if isinstance(schema, Maybe):
        schema = schema.part
    match schema:
        case Row(parts=parts) if value is not None:
            below = list(enumerate(parts))
        case Many(part=part) | ByName(part=part) if value is not None:
            below = [(place, part) for place in _choose(value, places)]
        case Anything() if isinstance(value, dict | list):
            below = [(place, schema) for place in _choose(value, max(places, 8))]
        case _:
            below = []
    for place, part in below:
        yield from find_parts(part, value[place], places, (*path, place))


def _choose(value: Any, count: int) -> list[Any]:
    """Return keys of a mapping or places of a list: those of the parts that hold most."""
    every = list(value) if isinstance(value, dict) else range(len(value))
    return sorted(every, key=lambda place: -len(repr(value[place])))[:count]


def replace(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    out = copy.copy(value)
    out[path[0]] = replace(value[path[0]], path[1:], new)
    return out


def nest(depth: int) -> Any:
    out: list[Any] = []
    for _ in range(depth):
        out = [out]
    return out


def list_mutations(value: Any) -> list[Any]:
    """Return values of other types, extremes and lengths in place of a value."""
    if isinstance(value, bytes):
        size, words = len(value), len(value) // 8
        filled = [np.full(words, number) for number in (10**6, 1e15, 1e300, -1.0, np.nan, np.inf)]
        lengths = [b"", value[:-1], value[:-8], value[: words // 2 * 8], value + value[:8], value + value]
        patterns = [b"\xff" * size, b"\x7f" * size, bytes(size), random.Random(size).randbytes(size)]
        return [None, "x", [], 5, *lengths, *patterns, *(each.tobytes() for each in filled)]
    others: list[Any] = [None, "x", [], {}, {"a": 1}, nest(200), b"", b"x" * 7]
    numbers = [-1, 0, 2**63 - 1, -(2**63), 2**64 - 1, float("nan"), float("inf"), 1e300, 5e-324]
    if isinstance(value, list):
        others += [value[:-1], value + value[-1:], value + value, value[:1], [None] * len(value), value[::-1]]
    elif isinstance(value, dict):
        others += [dict(list(value.items())[1:]), {**value, "new": 1}, {**value, "": []}]
    return others + numbers


def run(content: dict[str, Any], name: str) -> bool:
    """Restore a state and run it on a recording; return whether it was refused.

    Raises
    ------
    AssertionError
        Where the refusal is not one short line, or a forecast is implausible.
    """
    pipeline, messages = make_pipeline(), read_recording(name)
    try:
        pipeline.restore(seal(content))
    except SocastError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert "\n" not in refusal, f"not one line: {refusal}"
        assert len(refusal) <= 500, f"not one short line: {refusal}"
        return True
    begin = len(messages) * 3 // 4
    out = pipeline.push(messages[begin : begin + MESSAGES])
    pipeline.status(), pipeline.quality(), pipeline.model_errors(), pipeline.take_rides(), pipeline.take_windows()
    for vehicle in pipeline.lanes.names[:2]:
        try:
            pipeline.ask(vehicle)
        except SocastError:
            continue
    pipeline.snapshot()
    pipeline.finish()
    for message in out:
        forecast = json.loads(message.payload)
        assert forecast["soc_pct"] is None or 0.0 <= forecast["soc_pct"] <= 100.0
        for interval in (forecast["range_km"], forecast["soc_end_of_shift_pct"]):
            assert interval is None or interval["p05"] <= interval["mean"] <= interval["p95"]
    return False


def forge(component: str, places: int, mutations: int) -> tuple[int, int]:
    """Mutate each part of a component, and run each result.

    Parameters
    ----------
    component : str
    places : int
        Number of equal parts that are mutated.
    mutations : int
        Largest number of mutations of a part.

    Returns
    -------
    (refused, tried) : (int, int)
    """
    name, rng = "autumn.mcap", random.Random(component)
    content = make_content(name)
    refused = tried = 0
    for path, value in find_parts(SCHEMAS[component], content["state"][component], places, (component,)):
        every = list_mutations(value)
        for mutation in rng.sample(every, min(mutations, len(every))):
            tried += 1
            try:
                refused += run(content | {"state": replace(content["state"], path, mutation)}, name)
            except Exception as error:
                error.add_note(f"{path} is {str(mutation)[:100]}")
                raise
    return refused, tried


def main() -> None:
    """Forge each component, and print how often it was refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=3)
    parser.add_argument("--mutations", type=int, default=30)
    options = parser.parse_args()
    np.seterr(all="ignore")
    for component in COMPONENTS:
        refused, tried = forge(component, options.places, options.mutations)
        print(f"{component}: {tried} mutations, {refused} refused")


if __name__ == "__main__":
    main()
