"""List what may be missing: each effect of the library in all cars, in one car or group, always or since a date.

A family holds alternatives of which at most one is true: the variants of an effect in all cars, or the effects and
dates of one change of one car. So a change of a car has one explanation.
"""

from collections.abc import Mapping, Sequence
from math import inf
from typing import Final, Literal, NamedTuple, cast

import numpy as np

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.inference.events import KnownEvent
from socast.core.diagnose.inference.window_columns import WindowColumns
from socast.core.diagnose.records import UNKNOWN
from socast.core.effects.declaration import VARIANT

Kind = Literal["always", "step", "ramp"]
Of = Literal["all", "car", "group"]
CHANGING: Final = (
    "standby",
    "tyre_pressure",
    "brake_drag",
    "roof_load",
    "payload",
    "cabin_heating",
    "cabin_cooling",
    "drivetrain_loss_torque",
    "battery_resistance",
    "cold_regen_limit",
)
"""Effects that may begin at a date. Those of the weather and of the road do not: they come and go."""
PRIOR_EFFECT: Final = 0.1
"""Probability beforehand that all cars lack an effect."""
PRIOR_GUESSED: Final = 0.05
"""The same for an effect of the battery's temperature where the outside temperature has to stand for that."""
PRIOR_UNKNOWN: Final = 0.2
"""Probability beforehand that something outside the library is missing."""
PRIOR_CAR: Final = 0.01
"""Probability beforehand that a car differs from its siblings by more than cars do."""
PRIOR_CHANGE: Final = 0.3
"""Number of cars expected beforehand to have changed; each car has an equal share."""
PRIOR_ALL: Final = 0.05
"""Probability beforehand that all cars, or a group, changed."""
PRIOR_EVENT: Final = 0.15
"""Probability beforehand that something changed at a known event, such as a visit to a workshop or new tyres."""
ALWAYS_SIZE, SCOPED_SIZE = 0.5, 0.25
"""Standard deviation of a coefficient over the upper end of its plausible range, in all cars and within a scope. [1]"""
LEAST_DATES: Final = 3
"""Least number of dates before and after a change."""
MOST_DATES: Final = 40
"""Largest number of dates at which a change is tested."""
LEAST_SIBLINGS: Final = 2
"""Least number of other cars of the same model against which a car is held."""


class Timing(NamedTuple):
    """Hold when an effect acts, within the days of a family.

    Parameters
    ----------
    weight : (d,) float
        Size of the effect on each of these vehicle-days. [1]
    since, before : str, optional
        First date with it, and the last one without it. [UTC]
    begin : float, optional
        Begin of the first vehicle-day with it. [Unix s]
    """

    kind: Kind
    weight: Floats
    since: str | None = None
    before: str | None = None
    begin: float | None = None


class Family(NamedTuple):
    """Hold alternatives of which at most one is true.

    Parameters
    ----------
    who : str
        The effect in all cars, else the name of the car or the group, or `all`.
    effects : tuple of int
        Columns of `WindowColumns.effects`.
    days : (k,) int64
        Vehicle-days on which they may act.
    prior : float
        Probability beforehand that one of them is true; families of forms share `PRIOR_UNKNOWN`. [1]
    size : float
        Standard deviation of a coefficient over the upper end of its plausible range. [1]
    lowest : float
        Smallest plausible coefficient over the largest: 0 where it cannot be negative; of no meaning for forms. [1]
    """

    who: str
    of: Of
    effects: tuple[int, ...]
    days: Ints
    places: tuple[Timing, ...]
    prior: float
    size: float
    lowest: float

    @property
    def is_unknown(self) -> bool:
        """Whether its alternatives are forms outside the library."""
        return self.who == UNKNOWN

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest plausible coefficient in standard deviations beforehand; any of a form. [1]"""
        return (-inf, inf) if self.is_unknown else (self.lowest / self.size, 1.0 / self.size)

    @property
    def is_scoped(self) -> bool:
        """Whether the effects act in some cars, or since a date only."""
        return self.of != "all" or self.places[0].kind != "always"


def list_families(
    columns: WindowColumns,
    inside: Sequence[str],
    groups: Sequence[tuple[str, Ints]] = (),
    events: Sequence[KnownEvent] = (),
    *,
    scopes: bool = True,
) -> list[Family]:
    """Return the families of everything that may be missing.

    Parameters
    ----------
    inside : sequence of str
        Effects that the model has, which are tested within scopes only.
    groups : sequence of (str, (k,) int64)
        Name and vehicle-days of each group.
    events : sequence of KnownEvent
        Known events, each a step of its own.
    scopes : bool
        Whether single cars, groups and dates are tested.
    """
    everywhere = np.arange(len(columns.start))
    variants: dict[str, list[int]] = {}
    for at, name in enumerate(columns.names):
        variants.setdefault(name.partition(VARIANT)[0], []).append(at)
    expected = {each.effect for each in columns.expected}
    always = (Timing("always", np.ones(len(everywhere))),)
    out = []
    for name, members in variants.items():
        if name in expected or name in inside:
            continue
        effect = effects.get(name)
        prior = PRIOR_GUESSED if columns.guessed & set(effect.arguments) else PRIOR_EFFECT
        lowest = min(effect.low, 0.0) / effect.largest
        out.append(Family(name, "all", tuple(members), everywhere, always, prior, ALWAYS_SIZE, lowest))
    if scopes:
        declared = {columns.names[at]: at for at in range(len(columns.names)) if columns.names[at] in variants}
        out += _list_scoped(columns, declared, groups)
        out += _list_events(columns, declared, events)
    return out


def list_unknown(columns: WindowColumns) -> list[Family]:
    """Return the families of forms outside the library: those of the same load and variables, in all cars."""
    everywhere = np.arange(len(columns.start))
    forms: dict[tuple[str, frozenset[str]], list[int]] = {}
    for at, form in enumerate(columns.unknown, len(columns.names)):
        forms.setdefault((form.term.carrier.name, form.term.variables), []).append(at)
    always = (Timing("always", np.ones(len(everywhere))),)
    return [
        Family(UNKNOWN, "all", tuple(members), everywhere, always, PRIOR_UNKNOWN, 1.0, lowest=-1.0)
        for members in forms.values()
    ]


def _list_events(columns: WindowColumns, declared: Mapping[str, int], events: Sequence[KnownEvent]) -> list[Family]:
    """Return the families of known events that lie between dates with drives of the cars concerned."""
    out: list[Family] = []
    changing = tuple(declared[name] for name in CHANGING if name in declared)
    for event in events:
        cars = [event.vehicle] if event.vehicle in columns.cars else [] if event.vehicle else list(columns.cars)
        days = np.flatnonzero(np.isin(columns.car_of_day, [columns.cars.index(car) for car in cars]))
        there = np.array([columns.dates[date] >= event.date for date in columns.date_of_day[days].tolist()], dtype=bool)
        if not changing or min(len(set(columns.date_of_day[days[side]])) for side in (there, ~there)) < LEAST_DATES:
            continue
        before = columns.dates[int(columns.date_of_day[days[~there]].max())]
        place = Timing("step", there.astype(np.float64), event.date, before, float(columns.start[days[there]].min()))
        who, of = (cars[0], "car") if len(cars) == 1 else ("all", "all")
        out.append(_scope(who, cast("Of", of), changing, days, (place,), PRIOR_EVENT))
    return out


def _list_scoped(
    columns: WindowColumns, declared: Mapping[str, int], groups: Sequence[tuple[str, Ints]]
) -> list[Family]:
    """Return the families of cars, groups and dates."""
    out: list[Family] = []
    whole = tuple(declared.values())
    changing = tuple(declared[name] for name in CHANGING if name in declared)
    cars = len(columns.cars)
    kinds = [int(columns.kind_of_day[columns.car_of_day == car][0]) for car in range(cars)]
    for car, name in enumerate(columns.cars):
        days = np.flatnonzero(columns.car_of_day == car)
        if kinds.count(kinds[car]) > LEAST_SIBLINGS:
            out.append(_scope(name, "car", whole, days, _always(days), PRIOR_CAR))
        places = _list_changes(columns, days, ramps=True)
        if places and changing:
            out.append(_scope(name, "car", changing, days, places, PRIOR_CHANGE / cars))
    for name, days in groups:
        out.append(_scope(name, "group", whole, days, _always(days), PRIOR_ALL / len(groups)))
        places = _list_changes(columns, days)
        if places and changing:
            out.append(_scope(name, "group", changing, days, places, PRIOR_ALL / len(groups)))
    everywhere = np.arange(len(columns.start))
    if cars > 1 and changing and (places := _list_changes(columns, everywhere)):
        out.append(_scope("all", "all", changing, everywhere, places, PRIOR_ALL))
    return out


def _scope(who: str, of: Of, which: tuple[int, ...], days: Ints, places: tuple[Timing, ...], prior: float) -> Family:
    """Return a family within a scope, whose coefficients may have either sign."""
    return Family(who, of, which, days, places, prior, SCOPED_SIZE, lowest=-1.0)


def _always(days: Ints) -> tuple[Timing, ...]:
    """Return the place of an effect that acts on all of some days."""
    return (Timing("always", np.ones(len(days))),)


def _list_changes(columns: WindowColumns, days: Ints, *, ramps: bool = False) -> tuple[Timing, ...]:
    """Return the steps, and the ramps where they are wanted, at dates of some vehicle-days."""
    date, start = columns.date_of_day[days], columns.start[days]
    dates = np.unique(date)
    firsts = np.arange(LEAST_DATES, len(dates) - LEAST_DATES + 1)
    if len(firsts) > MOST_DATES:
        firsts = np.unique(np.round(np.linspace(firsts[0], firsts[-1], MOST_DATES)).astype(np.int64))
    out = []
    for first in firsts.tolist():
        there = date >= dates[first]
        name, before = columns.dates[dates[first]], columns.dates[dates[first - 1]]
        out.append(Timing("step", there.astype(np.float64), name, before, float(start[there].min())))
    for first in [0, *firsts.tolist()] if ramps and len(firsts) else []:
        if first >= len(dates) - LEAST_DATES:
            continue
        begin = float(start[date >= dates[first]].min())
        weight = np.maximum(start - begin, 0.0) / max(float(start.max()) - begin, SECONDS_PER_DAY)
        name, before = columns.dates[dates[first]], columns.dates[dates[max(first - 1, 0)]]
        out.append(Timing("ramp", weight, name, before, begin))
    return tuple(out)
