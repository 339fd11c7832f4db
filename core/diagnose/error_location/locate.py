"""Locate the error of a model: between rides, days, drivers, dates or cars, and in which kind of load.

No library of effects is needed. The fixed columns are those of the diagnosed model (`BaseProjection`), and a smooth
function of temperature multiplied by time: what is located is beyond the weather that every drive knows. Beside them,
each unit of each level may have a load of its own of each kind: per second, per km, per km and speed squared, per metre
climbed, per braking, and at the beginning of a ride. Restricted likelihood gives their variances, each beside the
others. A load is claimed if the criterion requires it and its interval lies above what simulated fleets without any
hidden load show (`FLOORS`).
"""

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.error_location.absent_signals import count_absent_signals
from socast.core.diagnose.error_location.floors import FLOORS
from socast.core.diagnose.error_location.kinds import Kind
from socast.core.diagnose.error_location.location_model import (
    LocationModel,
    build_car_model,
    build_location_model,
    get_drivers,
)
from socast.core.diagnose.error_location.selection import RIVAL, LoadSearch, Place, SelectedLoad
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import ErrorLocation, LocatedLoad
from socast.core.fit.measurement_noise import compute_noise_variance
from socast.core.stats.variances import Variances


def locate_error(windows: Windows, base: BaseProjection) -> ErrorLocation:
    """Return where the error of a model lives."""
    counts, rides = count_absent_signals(windows.rides), len(windows.rides)
    absent, partial = tuple(counts), {name: (count, rides) for name, count in counts.items() if count}
    located = build_location_model(windows, base)
    if located is None:
        return ErrorLocation(absent_signals=absent, partial_signals=partial)
    search = LoadSearch(located)
    selected = search.select()
    places = [load.place for load in selected]
    best = search.fit(places)
    loads = [_describe(load, located, search, places, best) for load in selected]
    loads = [_raise_level(load, place, places, located, best) for load, place in zip(loads, places, strict=True)]
    rest = [_describe_limit(place, located, search, best) for place in np.ndindex(search.shape) if place not in places]
    claims = {place for load, place in zip(loads, places, strict=True) if load.claimed}
    shares, limited = _share_error(located, best, {place: loads[places.index(place)].level for place in claims})
    loads += _locate_cars(located, best)
    claimed = tuple(sorted((load for load in loads if load.claimed), key=lambda load: -load.size_w))
    levels = tuple(dict.fromkeys([*located.levels.names, *(load.level for load in loads)]))
    return ErrorLocation(
        claimed, (*loads, *rest), shares, levels, located.kinds.dropped, absent, partial, noise_limited=limited
    )


def _describe(
    load: SelectedLoad, located: LocationModel, search: LoadSearch | None, places: Sequence[Place], best: Variances
) -> LocatedLoad:
    """Return a selected load in the unit of its kind, with its rivals where it is claimed."""
    level, kind, power = _read_place(load.place, located)
    claimed = load.low_kw / power > _get_floor(level, kind)
    rivals = search.find_rivals(load.place, places, best) if claimed and search is not None else []
    made = _make(level, kind, power, (load.size_kw, load.low_kw, load.high_kw), load.gain, claimed=claimed)
    kinds = tuple(located.kinds.kinds[k].name for i, k in rivals if i == load.place[0])
    levels = tuple(located.levels.names[i] for i, k in rivals if i != load.place[0])
    return replace(made, other_kinds=kinds, other_levels=levels)


def _describe_limit(place: Place, located: LocationModel, search: LoadSearch, best: Variances) -> LocatedLoad:
    """Return a load that was not selected."""
    level, kind, power = _read_place(place, located)
    return _make(level, kind, power, search.find_limit(place, best), 0.0, claimed=False)


def _make(
    level: str, kind: Kind, power: float, kw: tuple[float, float, float], gain: float, *, claimed: bool
) -> LocatedLoad:
    """Return a load from its size and interval in kW of mean power."""
    scale = (1000.0 if kind.unit == "W" else 100.0) / power
    size, low, high = (float(scale * each) for each in kw)
    size_w, low_w, high_w = (1000.0 * float(each) for each in kw)
    floor_w = 1000.0 * power * _get_floor(level, kind)
    sizes = (size, low, high, kind.unit, size_w, low_w, high_w)
    return LocatedLoad(level, kind.name, *sizes, float(gain), bool(claimed), floor_w=floor_w)


def _get_floor(level: str, kind: Kind) -> float:
    """Return the size that drives show without a load; drivers and dates stand in place of vehicle-days."""
    return FLOORS["day" if level in {"driver", "date"} else level][kind.name]


def _read_place(place: Place, located: LocationModel) -> tuple[str, Kind, float]:
    """Return the level, the kind and its mean power at nominal size. [kW]"""
    level, kind = place
    return located.levels.names[level], located.kinds.kinds[kind], float(located.kinds.power[kind])


def _raise_level(
    load: LocatedLoad, place: Place, places: Sequence[Place], located: LocationModel, best: Variances
) -> LocatedLoad:
    """Return a load of vehicle-days, or that of drivers or dates in its stead where this explains the data better."""
    if not load.claimed or load.level != "day":
        return load
    tops = {"driver": get_drivers(located.windows), "date": located.windows.date}
    others = [each for each in places if each != place]
    for name, unit in tops.items():
        above = None if unit is None else located.replace_top(name, unit)
        if above is None:
            continue
        there = LoadSearch(above)
        start = Variances(np.vstack([best.relative, np.zeros(there.shape[1])]), best.criterion)
        rise = there.replace(place, (place[0] + 1, place[1]), others, start)
        if rise < -RIVAL:
            size = next(each for each in there.measure([*others, (place[0] + 1, place[1])]) if each.place[0] > place[0])
            kind = located.kinds.kinds[place[1]]
            kw = (size.size_kw, size.low_kw, size.high_kw)
            made = _make(name, kind, float(located.kinds.power[place[1]]), kw, load.gain - rise, claimed=True)
            load = replace(made, other_kinds=load.other_kinds)
        elif rise < RIVAL:
            load = replace(load, other_levels=(*load.other_levels, name))
    return load


def _locate_cars(located: LocationModel, best: Variances) -> list[LocatedLoad]:
    """Return the loads that differ between cars of a vehicle model."""
    cars = build_car_model(located, best)
    if cars is None:
        return []
    return [_describe(load, cars, None, (), best) for load in LoadSearch(cars).select()]


def _share_error(
    located: LocationModel, best: Variances, claimed: Mapping[Place, str]
) -> tuple[dict[str, float], bool]:
    """Return the shares of the squared error of rides, and whether the scatter of windows limits that of noise.

    Loads without a claimed level count as scatter.
    """
    windows, rides = located.windows, len(located.windows.rides)
    parts = {"measurement": 0.0, "scatter": 0.0}
    parts["scatter"] = best.criterion.scale * float(np.mean(located.noise.sum_ride_variances(rides)))
    energy = [float(np.mean(windows.by_ride(column) ** 2)) for column in located.kinds.columns.T]
    for place, size in np.ndenumerate(best.deviations):
        level = claimed.get((place[0], place[1]), "scatter")
        parts[level] = parts.get(level, 0.0) + float(size) ** 2 * energy[place[1]]
    stated = compute_noise_variance(windows.rides)
    stated = stated[np.isfinite(stated)]
    noise = float(np.mean(stated)) if len(stated) else 0.0
    limited = noise > parts["scatter"]
    parts["measurement"] = min(noise, parts["scatter"])
    parts["scatter"] -= parts["measurement"]
    total = sum(parts.values())
    return ({name: part / total for name, part in parts.items()} if total > 0.0 else {}), limited
