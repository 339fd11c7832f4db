"""The form of what the cars of a consumer contribute to a daily update, in a state and in what shards exchange.

A shard checks what others contribute before it uses it, as anybody may send to its key.
"""

from typing import Any, Final

import numpy as np

from socast.core.forecast.car_days import CAR_DAY, LAST_DAY, UNKNOWN_DAY
from socast.core.totals.accumulator import EDGES
from socast.core.wire.state_schema import Anything, ByName, Many, Maybe, Named, Number, Packed, Row, Schema, Text

MOST: Final = 2.0**53
"""Largest whole number that all numbers up to it can be told from."""
COUNT: Final = Number(0, MOST, whole=True)
"""A number of things."""
REAL: Final = Number()
"""Any number, or an unknown one."""
LANE: Final = Number(0, "lanes", whole=True)
"""A lane of this process."""
EXACT: Final = Packed("i8")
"""Exact sums, whose number `ExactSums.load` checks."""
FACTOR: Final = Row(REAL, REAL)
"""Mean and variance of the logarithm of a consumption factor."""
PATTERN: Final = Row(REAL, REAL)
"""Duration and intensity of a shift."""
_DAY: Final = Number(UNKNOWN_DAY, LAST_DAY, whole=True)
_EDGE: Final = np.dtype([(name, "f8") for name in EDGES])


def make_sums(**limits: Number) -> Schema:
    """Return the schema of the sums of a vehicle model, with limits of fields of its newest ride."""
    return Row(EXACT, *(Packed(_EDGE, count=1, limits=limits) for _ in range(2)))


def make_shift(lane: Number) -> Schema:
    """Return the schema of the energy of a shift, of a car in a lane."""
    return Row(lane, Maybe(COUNT), *4 * (REAL,), Text(), REAL, REAL, Number(0, 1))


def make_day(lane: Number, **limits: Number) -> Schema:
    """Return the schema of what cars contribute, see `socast.core.forecast.learning.fleet.FleetDay`."""
    sums = Named(conformal=EXACT, correction=EXACT, daily_cycle=EXACT, charged_soc=EXACT)
    return Row(ByName(make_sums(**limits)), sums, Many(make_shift(lane)), Many(Row(lane, PATTERN)))


SUMS: Final = make_sums(kind=Number(0.0, "kinds", unknown=False))
"""Sums of a vehicle model, with kinds of cars of this process."""
CONTENT: Final = Row(
    make_day(COUNT),
    ByName(ByName(Anything())),
    ByName(EXACT),
    Many(Row(Text(), FACTOR, Many(make_shift(COUNT)))),
    COUNT,
)
"""Contribution of a shard, whose lanes and kinds of cars are numbers of another process."""


def make_days(statistics: Schema) -> Schema:
    """Return the schema of the state of `socast.core.forecast.shard_days`, which may hold earlier statistics."""
    day: Any = make_day(LANE, kind=Number(0.0, "kinds", unknown=False))
    days = dict.fromkeys(("collects", "collected", "serves", "served", "frozen"), Number(UNKNOWN_DAY, LAST_DAY))
    return Row(
        Text(16),
        _DAY,
        _DAY,
        COUNT,
        Packed(CAR_DAY, by_lane="heard", limits=days),
        Maybe(statistics),
        Many(day, count=2),
        ByName(day),
        Many(Row(_DAY, Many(Row(COUNT, CONTENT)))),
    )
