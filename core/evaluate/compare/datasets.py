"""Compare two sets of rides: the rides, their consumption, and the errors of models on each.

A model that explains why one set used more energy has the difference in its terms; what it does not explain appears as
a difference of its error. The difference in measured consumption is therefore split into terms and a remainder, each
per 100 km and with an interval. The sets are assumed to be independent.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.evaluate.binning import bin_rides
from socast.core.evaluate.compare.models import ComparedRides
from socast.core.evaluate.ride_filter import IDENTITY_COLUMNS
from socast.core.models import LinearModel
from socast.core.stats.clustered import compute_clustered_mean, compute_clustered_ratio, subtract
from socast.core.stats.multiple_testing import adjust_false_discovery
from socast.core.stats.scores import Estimate

PROPERTIES: Final = (
    ("distance", "km", "distance_km", ""),
    ("duration", "min", "duration_s", ""),
    ("average speed", "km/h", "average_speed_kmh", ""),
    ("outside temperature", "°C", "ambient_c", ""),
    ("wind speed", "km/h", "wind_speed_kmh", ""),
    ("precipitation", "mm/h", "precipitation_mm_h", ""),
    ("climb", "m/km", "gained_m", "distance_km"),
    ("stops", "1/km", "stops", "distance_km"),
    ("occupants", "1", "occupants", ""),
    ("mass", "kg", "mass_kg", ""),
    ("state of charge at the start", "%", "soc_start_pct", ""),
)
"""Properties in which rides may differ: name, unit, column, and the column that divides it."""
SECONDS_PER_MINUTE: Final = 60.0
"""Seconds in a minute. [s]"""


def compare_datasets(first: ComparedRides, second: ComparedRides, models: Mapping[str, LinearModel]) -> dict[str, Any]:
    """Return the differences between two sets of rides, as second less first.

    Parameters
    ----------
    first, second : ComparedRides
        Rides of both sets, with predictions of the same models.
    models : mapping of str to LinearModel
        Models by label.

    Returns
    -------
    dict
        `shared`: number of rides in both sets. `properties` of the rides. `consumption`, in kWh per 100 km. `models`:
        for each model `mae_kwh`, `bias_kwh`, the `terms` of the difference in consumption, the `explained` and
        `unexplained` parts of it, and bias and error `by` condition.
    """
    return {
        "shared": _shared(first.rides, second.rides),
        "properties": _properties(first, second),
        "consumption": _each(_per_distance(first, first.measured), _per_distance(second, second.measured)),
        "models": {label: _model(label, model, first, second) for label, model in models.items()},
    }


def _each(one: Estimate, other: Estimate) -> dict[str, Any]:
    """Return two estimates and their difference, with its interval and probability."""
    apart = subtract(other, one)
    return {"first": one.figures(), "second": other.figures(), "difference": apart.figures(), "p": apart.p}


def _shared(one: pd.DataFrame, other: pd.DataFrame) -> int:
    """Return the number of rides that are in both sets."""
    both = one[list(IDENTITY_COLUMNS)].merge(other[list(IDENTITY_COLUMNS)], how="inner", on=list(IDENTITY_COLUMNS))
    return len(both)


def _per_distance(compared: ComparedRides, energy: Floats) -> Estimate:
    """Return an energy per distance. [kWh/100 km]"""
    return compute_clustered_ratio(
        100.0 * energy, compared.rides["distance_km"].to_numpy(np.float64), compared.clusters
    )


def _properties(first: ComparedRides, second: ComparedRides) -> list[dict[str, Any]]:
    """Return the properties of both sets, ordered by their difference relative to the spread between rides."""
    entries = []
    for name, unit, column, per in PROPERTIES:
        wanted = [column for column in (column, per) if column]
        if any(name not in side.rides for name in wanted for side in (first, second)):
            continue
        values = [_values(side.rides, column, per) for side in (first, second)]
        known = [np.isfinite(value) for value in values]
        if not all(each.any() for each in known):
            continue
        one, other = (
            compute_clustered_mean(value[at], side.clusters[at])
            for value, at, side in zip(values, known, (first, second), strict=True)
        )
        spread = float(np.sqrt(np.mean([np.var(value[at]) for value, at in zip(values, known, strict=True)])))
        apart = abs(other.value - one.value) / spread if spread > 0.0 else 0.0
        entries.append({"name": name, "unit": unit, **_each(one, other), "in_spreads": apart})
    q = adjust_false_discovery(np.array([entry["p"] for entry in entries], dtype=np.float64))
    with_rates = [entry | {"q": float(rate)} for entry, rate in zip(entries, q, strict=True)]
    return sorted(with_rates, key=lambda entry: -entry["in_spreads"])


def _values(rides: pd.DataFrame, column: str, per: str) -> Floats:
    """Return a property of each ride; NaN where it is unknown."""
    values = rides[column].to_numpy(np.float64)
    if per:
        below = rides[per].to_numpy(np.float64)
        return np.divide(values, below, out=np.full(len(values), np.nan), where=below > 0.0)
    return values / SECONDS_PER_MINUTE if column == "duration_s" else values


def _model(label: str, model: LinearModel, first: ComparedRides, second: ComparedRides) -> dict[str, Any]:
    """Return the errors of a model on both sets and how much of the difference in consumption it explains."""
    both = (first, second)
    error = [side.predicted[label] - side.measured for side in both]
    parts = [model.predict_parts(side.rides) for side in both]
    terms = [
        {"name": name, **_each(*(_per_distance(side, each[name]) for side, each in zip(both, parts, strict=True)))}
        for name in parts[0]
    ]
    one, other = (compute_clustered_mean(off, side.clusters) for off, side in zip(error, both, strict=True))
    size, otherwise = (
        compute_clustered_mean(np.abs(off), side.clusters) for off, side in zip(error, both, strict=True)
    )
    return {
        "bias_kwh": _each(one, other),
        "mae_kwh": _each(size, otherwise),
        "explained": _each(*(_per_distance(side, side.predicted[label]) for side in both)),
        "unexplained": _each(*(_per_distance(side, -off) for side, off in zip(both, error, strict=True))),
        "terms": sorted(terms, key=lambda entry: -abs(entry["difference"]["value"])),
        "by": _by_condition(first, second, *error),
    }


def _by_condition(
    first: ComparedRides, second: ComparedRides, one: Floats, other: Floats
) -> dict[str, list[dict[str, Any]]]:
    """Return bias, error and `consumption` of both sets in each bin that either set has, and `q` of the bias."""
    together = pd.concat([first.rides, second.rides], ignore_index=True)
    here = np.arange(len(together)) < len(first.rides)
    made: dict[str, list[dict[str, Any]]] = {}
    for name, (codes, labels) in bin_rides(together).items():
        for code in np.unique(codes[codes >= 0]).tolist():
            at = np.flatnonzero(codes[here] == code), np.flatnonzero(codes[~here] == code)
            entry = {"bin": labels[code], "n": [len(rows) for rows in at]}
            made.setdefault(name, []).append(entry | _bins(first, second, one, other, at))
    entries = [entry for bins in made.values() for entry in bins]
    q = adjust_false_discovery(np.array([entry["bias_kwh"]["p"] for entry in entries], dtype=np.float64))
    for entry, rate in zip(entries, q.tolist(), strict=True):
        entry["q"] = rate
    return made


def _bins(
    first: ComparedRides, second: ComparedRides, one: Floats, other: Floats, at: tuple[Ints, Ints]
) -> dict[str, Any]:
    """Return bias, error and consumption of the rides of a bin, in both sets."""
    sets = [(side, off, rows) for side, off, rows in zip((first, second), (one, other), at, strict=True)]
    kilometres = [side.rides["distance_km"].to_numpy(np.float64) for side in (first, second)]
    return {
        "bias_kwh": _each(*(compute_clustered_mean(off[rows], side.clusters[rows]) for side, off, rows in sets)),
        "mae_kwh": _each(*(compute_clustered_mean(np.abs(off[rows]), side.clusters[rows]) for side, off, rows in sets)),
        "consumption": _each(
            *(
                compute_clustered_ratio(100.0 * side.measured[rows], km[rows], side.clusters[rows])
                for (side, _, rows), km in zip(sets, kilometres, strict=True)
            )
        ),
    }
