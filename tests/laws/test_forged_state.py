"""Test that a state with a valid checksum and any content is refused in one line, or leads to plausible forecasts."""

import copy
import json
import random
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from typing import Any

import msgspec
import numpy as np
import pytest

from core.errors import SocastError
from core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from core.pipeline import Pipeline
from core.snapshot import SCHEMAS
from stream.mcap_reader import McapSource
from tests.support.paths import ROOT

MUTATIONS = 6
"""Number of mutations of each leaf, chosen by a fixed seed."""
MESSAGES = 250
"""Number of messages that a restored pipeline takes."""
COMPONENTS = sorted(SCHEMAS.keys() - {"deferred"})


def make_pipeline(**options: Any) -> Pipeline:
    return Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL], **options)


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


def find_leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield each part of a state; of long lists and mappings only some."""
    yield path, value
    if isinstance(value, dict):
        for name in list(value)[:3]:
            yield from find_leaves(value[name], (*path, name))
    elif isinstance(value, list):
        for place in range(len(value)) if len(value) <= 8 else (0, len(value) // 2, len(value) - 1):
            yield from find_leaves(value[place], (*path, place))


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
    """Restore a state and run it; return whether it was refused."""
    pipeline, messages = make_pipeline(), read_recording(name)
    try:
        pipeline.restore(seal(content))
    except SocastError as error:
        if "\n" in str(error) or len(str(error)) > 500:
            pytest.fail(f"not one short line: {error}")
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


@pytest.mark.parametrize("name", ["shift.mcap", "autumn.mcap"])
def test_state_that_was_not_forged_is_accepted(name):
    assert not run(make_content(name), name)


def test_every_component_has_a_schema():
    deferred = Pipeline(keep_forecasts=False, two_sided=True)
    for pipeline in (make_pipeline(), deferred):
        assert SCHEMAS.keys() >= pipeline._components().keys()
    assert SCHEMAS.keys() == {*make_pipeline()._components(), *deferred._components()}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("component", COMPONENTS)
def test_forged_part_of_a_state_is_refused_or_harmless(component):
    name = "autumn.mcap"
    content, rng = make_content(name), random.Random(component)
    refused = tried = 0
    for path, value in find_leaves(content["state"][component], (component,)):
        for mutation in rng.sample(list_mutations(value), MUTATIONS):
            tried += 1
            refused += run(content | {"state": replace(content["state"], path, mutation)}, name)
    assert refused > 0.3 * tried


@pytest.mark.parametrize("state", [None, [], "x", {}, {"lanes": []}, nest(200), dict.fromkeys(COMPONENTS)], ids=repr)
def test_state_without_its_components_is_refused(state):
    assert run(make_content("shift.mcap") | {"state": state}, "shift.mcap")


def test_unknown_and_missing_components_are_refused():
    content = make_content("shift.mcap")
    assert run(content | {"state": content["state"] | {"intake": []}}, "shift.mcap")
    for component in COMPONENTS:
        rest = {name: value for name, value in content["state"].items() if name != component}
        assert run(content | {"state": rest}, "shift.mcap")


@pytest.mark.parametrize(
    "packed", [b"", b"\xc1", b"\x91" * 5000, b"\x80", b"\x93\x01\x02\x03", b"\xdf\xff\xff\xff\xff"]
)
def test_checksum_over_anything_else_is_refused(packed):
    with pytest.raises(SocastError):
        make_pipeline().restore(sha256(packed).digest() + packed)


@pytest.mark.parametrize("key", ["version", "fields", "effects", "model"])
@pytest.mark.parametrize("value", [None, 5, [], {}, "x" * 10_000, nest(100)], ids=lambda value: str(value)[:20])
def test_forged_head_is_refused_or_harmless(key, value):
    run(make_content("shift.mcap") | {key: value}, "shift.mcap")
