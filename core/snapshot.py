"""Encode the state of every vehicle as bytes with a checksum, decode it, and check it.

A checksum shows damage, not intent: anybody can make one. `SCHEMAS` therefore declares the form of each component's
state, and `load_components` refuses a state of another form before compiled code uses it as an index. A new field of
a component is declared here too; the tests refuse a component without schema.
"""

from collections.abc import Mapping, Sequence
from hashlib import sha256
from math import inf, pi
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.batch import Stateful
from socast.core.cleaning.fleet_clock import FLEET_CLOCK
from socast.core.cleaning.kernel import STATE
from socast.core.cleaning.quality import CAUSES
from socast.core.columns import SECONDS_PER_DAY, SPEED_BINS
from socast.core.errors import SocastError
from socast.core.files import UNREADABLE
from socast.core.forecast.conformal import BASES, DISTANCE_CLASSES, LEVELS, SCORES
from socast.core.forecast.day_rollover import CAR_CLOCK, RECENT_SAMPLES, WINDOW_SAMPLES
from socast.core.forecast.filter_state import FILTER_STATE, LOG_FACTOR_PRIOR
from socast.core.forecast.forecast_rows import NEWEST_FORECAST
from socast.core.forecast.learning.consumption_terms import TERMS
from socast.core.forecast.learning.daily_cycle import HOURS
from socast.core.forecast.learning.forecast_errors import FORECAST_RECORDS
from socast.core.forecast.learning.shift_patterns import SHIFT_PATTERNS
from socast.core.forecast.planned_legs import PLAN_PROGRESS
from socast.core.monitoring.running_error import RIDE_SUMS, VEHICLE_DAY
from socast.core.totals.accumulator import AMOUNTS, DURATION, EDGES, OPEN_WINDOW
from socast.core.totals.display_yield import LANE_YIELD, LARGEST_CURVE
from socast.core.wire.sample_losses import SAMPLE_LOSS
from socast.core.wire.state_schema import (
    Anything,
    ByName,
    Fault,
    Many,
    Maybe,
    Number,
    Packed,
    Row,
    Schema,
    Sizes,
    Text,
)

SNAPSHOT: Final = 33
"""Version of the format of a snapshot."""
FIELDS: Final = [*(STATE.names or ()), *AMOUNTS, *EDGES, *CAUSES, *(NEWEST_FORECAST.names or ())]
"""Names of the fields in the arrays of a snapshot."""
_DIGEST: Final = sha256().digest_size


def seal_snapshot(state: dict[str, Any]) -> bytes:
    """Return a state as bytes with a checksum."""
    content = msgspec.msgpack.encode({"version": SNAPSHOT, "fields": FIELDS} | state)
    return sha256(content).digest() + content


def open_snapshot(snapshot: bytes) -> dict[str, Any]:
    """Return the state that `seal_snapshot` encoded."""
    digest, content = snapshot[:_DIGEST], snapshot[_DIGEST:]
    if sha256(content).digest() != digest:
        raise SocastError("not a snapshot of this product, or a damaged one: start without it")
    try:
        state: dict[str, Any] = msgspec.msgpack.decode(content, type=dict[str, Any])
    except UNREADABLE as error:
        raise SocastError(f"a snapshot of another form: {error}; start without it") from error
    if tuple(map(state.get, ("version", "fields"))) != (SNAPSHOT, FIELDS):
        found = str(state.get("version"))[:20]
        why = "its fields are others" if found == str(SNAPSHOT) else f"its form is {found}, and this one {SNAPSHOT}"
        raise SocastError(f"snapshot made by another version of socast: {why}; start without it")
    effects = state.get("effects")
    if not isinstance(effects, list) or not all(isinstance(name, str) for name in effects):
        raise SocastError("a snapshot without the names of its effects; start without it")
    return state


def describe_model_change(content: Mapping[str, Any], model: str, effects: Sequence[str]) -> str:
    """Return how the model of a state and its effects differ from those of the pipeline; empty where they do not.

    Examples
    --------
    >>> describe_model_change({"model": "base/1", "effects": ["drag"]}, "base/2", ["drag", "snow"])
    'it was made with model base/1, now base/2; effects that are new: snow'
    """
    before = [str(name) for name in content["effects"]]
    words = [] if content["model"] == model else [f"it was made with model {content['model']}, now {model}"]
    for what, names in (("new", set(effects) - set(before)), ("not used any more", set(before) - set(effects))):
        words += [f"effects that are {what}: {', '.join(sorted(names))}"] if names else []
    return "; ".join(words)


class OpenTotals:
    """Require the open totals of each lane (`socast.core.totals`), of as many effects as the pipeline sums."""

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such bytes."""
        width = len(AMOUNTS) + int(sizes["effects"]) + SPEED_BINS
        edges = [f"{name} of {place}" for place in ("ride", "window", "end") for name in EDGES]
        parts = [("ride", "f8"), ("window", "f8"), ("amounts", "f8", (2 * width,)), *((name, "f8") for name in edges)]
        limits = {
            "ride": Number(-2.0, MOST),
            "window": Number(-2.0, MOST),
            **dict.fromkeys((name for name in edges if name.startswith("kind of")), Number(0, "kinds", unknown=False)),
            **dict.fromkeys((name for name in edges if name.startswith("code of")), _CODE),
        }
        dtype = np.dtype([*parts, ("quality", "f8", (len(CAUSES),))])
        Packed(dtype, by_lane="summed", limits=limits, vacant={"ride": Number(-2.0, -1.0)}).check(value, sizes)


MOST: Final = 2.0**53
"""Largest whole number that all numbers up to it can be told from."""
COUNT: Final = Number(0, MOST, whole=True)
"""A number of things."""
REAL: Final = Number()
"""Any number, or an unknown one."""
LANE: Final = Number(0, "lanes", whole=True)
"""A lane of this process."""
SUMS: Final = Packed("f8")
"""Sums of a day, whose number `DaySums.load` checks."""
FACTOR: Final = Row(REAL, REAL)
"""Mean and variance of the logarithm of a consumption factor."""
_SHIFT: Final = Row(LANE, Maybe(COUNT), *3 * (REAL,), Text(), *3 * (REAL,))
_ANYTHING, _TEXT, _UNIX = Anything(), Text(), Number(0.0, 4.3e9, unknown=False)
_KELVIN: Final = Number(100.0, 400.0, unknown=False)
_LATITUDE, _LONGITUDE = Number(-pi / 2, pi / 2, unknown=False), Number(-pi, pi, unknown=False)
_COUNTS, _CODE, _INDEX = ByName(COUNT), Number(-3.0, MOST), Number(0.0, MOST, unknown=False)


def _grid(*shape: int) -> Schema:
    """Return the schema of an array as nested lists."""
    return Many(_grid(*shape[1:]) if shape[1:] else REAL, count=shape[0])


def _pack(count: int, *, low: float = -inf) -> Schema:
    """Return the schema of an array as bytes, of known numbers."""
    return Packed("f8", count=count, limits={"": Number(low, unknown=False)})


_KNOWN: Final = Packed("f8", limits={"": Number(unknown=False)})
"""Known numbers as bytes."""
_REGRESSION: Final = Row(
    SUMS,
    SUMS,
    Many(Row(LANE, _pack(len(TERMS) + 2))),
    Many(Row(LANE, _KNOWN)),
    _pack(len(TERMS)),
    Number(-100.0, 100.0),
)
_CLASSES: Final = BASES * len(DISTANCE_CLASSES)
_CONFORMAL: Final = Row(SUMS, _pack(_CLASSES * len(SCORES), low=0.0), _pack(_CLASSES * len(LEVELS)))
_OUTCOMES: Final = Packed("i8", count=3, limits={"": COUNT})
_RECORDS: Final = Packed(FORECAST_RECORDS, limits={"basis": Number(0, BASES - 1, unknown=False)})
_SHIFT_ERRORS: Final = Row(_RECORDS, SUMS, SUMS, _OUTCOMES)
_STATISTICS: Final = Row(
    Row(
        ByName(_REGRESSION),
        Row(
            Many(Row(LANE, FACTOR)),
            Many(Row(COUNT, FACTOR)),
            FACTOR,
        ),
        _CONFORMAL,
        Row(SUMS, _grid(2, HOURS)),
        Row(SUMS, SUMS),
        Row(SUMS, SUMS),
    ),
    Many(_SHIFT),
    Many(Row(LANE, Maybe(Many(_SHIFT_ERRORS)))),
    Packed(LOG_FACTOR_PRIOR, by_lane="predicted", limits={"variance": Number(1e-9, 1e9)}),
    Packed(SHIFT_PATTERNS, by_lane="predicted"),
    Packed("i8", count=3 * BASES, limits={"": COUNT}),
)
_PLANS: Final = Row(
    Many(Row(LANE, ByName(_ANYTHING), COUNT, REAL, Maybe(Many(Packed("f8"), count=2)), COUNT)),
    Many(Row(LANE, ByName(_ANYTHING))),
    Packed(PLAN_PROGRESS, by_lane="predicted"),
    Many(REAL, by_lane="predicted"),
    Many(Number(0, 1), by_lane="predicted"),
    Many(Many(REAL, by_lane="predicted"), count=3),
)
_ERRORS: Final = Row(Packed(RIDE_SUMS, count=1), Row(_INDEX, _INDEX, *(REAL for _ in range(4))))
SCHEMAS: Final[dict[str, Schema]] = {
    "lanes": Many(Text(64), unique=True),
    "cars": Row(Many(ByName(_ANYTHING)), Many(Number(0, "kinds", whole=True)), _COUNTS),
    "duplicates": Row(Number(1, whole=True), Packed("<u8"), Packed("<u8")),
    "decoder": Row(
        Row(Many(Row(_CODE, Maybe(_TEXT))), COUNT),
        _COUNTS,
        _COUNTS,
        Packed(
            SAMPLE_LOSS,
            count="lanes",
            limits={**dict.fromkeys(("received", "lost"), _INDEX), "period": Number(0.0, 1e6, unknown=False)},
        ),
    ),
    "drivers": Row(ByName(_TEXT), Many(Row(COUNT, _TEXT, _TEXT, COUNT)), COUNT),
    "plans": Many(Row(LANE, REAL)),
    "day_rollover": Row(
        Number(-inf, 4.3e9 + SECONDS_PER_DAY, unknown=False),
        Number(0, WINDOW_SAMPLES - 1, whole=True),
        Packed("i8", count=WINDOW_SAMPLES, limits={"": Number(-1, "clocks")}),
        Packed(CAR_CLOCK, limits={"recent": Number(0, RECENT_SAMPLES), "window": Number(0, WINDOW_SAMPLES)}),
    ),
    "cleaner": Row(
        Packed(
            STATE,
            by_lane="heard",
            limits={
                **dict.fromkeys(("samples", "rides", "windows", "place"), _INDEX),
                **dict.fromkeys(("code", "ended"), _CODE),
            },
            vacant={"samples": Number(0.0, 0.0)},
        ),
        Packed(FLEET_CLOCK, count=1),
        Row(_TEXT, COUNT, _COUNTS),
    ),
    "stations": Many(Row(_TEXT, Many(_UNIX), Many(Many(REAL)), _LATITUDE, _LONGITUDE)),
    "accumulator": OpenTotals(),
    "displays": Row(
        Packed(
            LANE_YIELD,
            by_lane="summed",
            limits={"pooled_model": Number(-1, "models")},
        ),
        Many(_TEXT, unique=True),
        *(Many(Row(REAL, REAL), count=count) for count in (None, "pooled")),
    ),
    "counters": Row(Many(COUNT, count=len(CAUSES)), COUNT, _COUNTS, _COUNTS, ByName(_COUNTS)),
    "engine": Row(
        _STATISTICS,
        _PLANS,
        Many(Row(_TEXT, Many(Row(_UNIX, _UNIX, _KELVIN)))),
        Row(
            Many(Row(LANE, _RECORDS)),
            Packed("f8"),
            Packed("f8"),
            Packed("f8"),
        ),
        Packed(NEWEST_FORECAST, by_lane="predicted"),
        Packed(
            FILTER_STATE,
            by_lane="predicted",
            limits={
                "": Number(-1e15, 1e15),
                "curve": Number(-LARGEST_CURVE, LARGEST_CURVE),
                "car_capacity_variance": Number(0.0, 1e15, unknown=False),
            },
            vacant={"active": Number(0.0, 0.0), "shift": Number(-MOST, -1.0)},
        ),
    ),
    "silent_cars": Row(
        Number(-inf, MOST),
        COUNT,
        Packed("f8", by_lane="heard"),
        Packed("i8", count="noted", limits={"": Number(-MOST, MOST)}),
    ),
    "deferred": _ANYTHING,
    "shadows": Row(
        _TEXT,
        REAL,
        Many(_TEXT),
        ByName(
            Row(
                Many(_ERRORS),
                Packed(VEHICLE_DAY, limits={"group": Number(-1, "groups")}),
                Packed("i8", count=3, limits={"": COUNT}),
            )
        ),
        _COUNTS,
    ),
}
"""Form of the state of each component."""


def load_components(components: Mapping[str, Stateful], content: dict[str, Any], effects: Sequence[str]) -> None:
    """Check the state of all components, and then load it; rides in progress keep the sums of effects that remain."""
    name, state = "state", content.get("state")
    try:
        if not isinstance(state, dict) or (set(state) ^ set(components)) - {"deferred"}:
            raise Fault("it has other components than this version")
        name = "sizes"
        sizes = _measure_state(state) | {"effects": len(content["effects"])}
        for name in state:
            SCHEMAS[name].check(state[name], sizes)
        if (before := content["effects"]) != list(effects):
            name = "effects"
            if "deferred" in state:
                raise Fault(f"it holds sums of {', '.join(before)}, which tables need")
            state["accumulator"] = carry_totals(state["accumulator"], before, effects)
        for name in filter(state.__contains__, components):
            components[name].load(state[name])
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SocastError(f"snapshot with a wrong part {name!r}: {reason}; start without it") from error


def _measure_state(state: dict[str, Any]) -> dict[str, float]:
    """Return the sizes by which parts of a state are checked."""
    heard = np.flatnonzero(np.frombuffer(state["cleaner"][0], STATE)["samples"] > 0.0)
    last = int(heard[-1]) + 1 if len(heard) else 0
    return {
        "lanes": len(state["lanes"]),
        "heard": last,
        "summed": 0 if "deferred" in state else last,
        "predicted": last if state["engine"][-1] else 0,  # a pipeline may keep no forecasts
        "kinds": len(state["cars"][0]) + 1,
        "clocks": len(state["day_rollover"][3]) // CAR_CLOCK.itemsize,
        "models": len(state["displays"][1]),
        "pooled": len(state["displays"][2]),
        "noted": len(state["silent_cars"][2]) // 8,
        "groups": len(state["shadows"][2]),
    }


def carry_totals(state: bytes, before: Sequence[str], now: Sequence[str]) -> bytes:
    """Return open totals of other effects; what was not summed before is unknown until its ride ends."""
    head, width = OPEN_WINDOW + 1, len(AMOUNTS) + len(before) + SPEED_BINS
    rows = np.frombuffer(state).reshape(-1, head + 2 * width + 3 * len(EDGES) + len(CAUSES))
    place = {name: len(AMOUNTS) + number for number, name in enumerate(before)}
    parts = [rows[:, :head]]
    for begin in (head, head + width):  # of the window, and of the ride before it
        amounts = rows[:, begin : begin + width]
        unknown = np.where(amounts[:, DURATION] > 0.0, np.nan, 0.0)
        energies = [amounts[:, place[name]] if name in place else unknown for name in now]
        parts += [amounts[:, : len(AMOUNTS)], *(energy[:, None] for energy in energies), amounts[:, -SPEED_BINS:]]
    return np.hstack([*parts, rows[:, head + 2 * width :]]).tobytes()
