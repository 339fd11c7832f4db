"""Compare two sets of rides: the rides, their consumption, and the errors of models on each.

A model that explains why one set used more energy has the difference in its terms; what it does not explain appears as
a difference of its error. The difference in measured consumption is therefore split into terms and a remainder, each
per 100 km and with an interval. The sets are assumed to be independent.
"""

from collections.abc import Mapping
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.evaluate.binning import bin_rides
from socast.core.evaluate.compare.models import ComparedRides
from socast.core.evaluate.compare.records import (
    ContrastBin,
    DatasetContrast,
    ModelContrast,
    PropertyContrast,
    SetContrast,
    TermContrast,
)
from socast.core.evaluate.records import hold_estimate
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


def compare_datasets(first: ComparedRides, second: ComparedRides, models: Mapping[str, LinearModel]) -> DatasetContrast:
    """Return the differences between two sets of rides, as second less first."""
    return DatasetContrast(
        shared=_shared(first.rides, second.rides),
        properties=_properties(first, second),
        consumption=_contrast(_per_distance(first, first.measured), _per_distance(second, second.measured)),
        models={label: _model(label, model, first, second) for label, model in models.items()},
    )


def _contrast(one: Estimate, other: Estimate) -> SetContrast:
    """Return two estimates and their difference, with its interval and probability."""
    apart = subtract(other, one)
    return SetContrast(
        first=hold_estimate(one), second=hold_estimate(other), difference=hold_estimate(apart), p=apart.p
    )


def _shared(one: pd.DataFrame, other: pd.DataFrame) -> int:
    """Return the number of rides that are in both sets."""
    both = one[list(IDENTITY_COLUMNS)].merge(other[list(IDENTITY_COLUMNS)], how="inner", on=list(IDENTITY_COLUMNS))
    return len(both)


def _per_distance(compared: ComparedRides, energy: Floats) -> Estimate:
    """Return an energy per distance. [kWh/100 km]"""
    return compute_clustered_ratio(
        100.0 * energy, compared.rides["distance_km"].to_numpy(np.float64), compared.clusters
    )


def _properties(first: ComparedRides, second: ComparedRides) -> list[PropertyContrast]:
    """Return the properties of both sets, ordered by their difference relative to the spread between rides."""
    entries: list[dict[str, Any]] = []
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
        contrast = msgspec.structs.asdict(_contrast(one, other))
        entries.append({"name": name, "unit": unit, "in_spreads": apart} | contrast)
    rates = adjust_false_discovery(np.array([entry["p"] for entry in entries], dtype=np.float64)).tolist()
    made = [PropertyContrast(**entry, q=rate) for entry, rate in zip(entries, rates, strict=True)]
    return sorted(made, key=lambda entry: -(entry.in_spreads or 0.0))


def _values(rides: pd.DataFrame, column: str, per: str) -> Floats:
    """Return a property of each ride; NaN where it is unknown."""
    values = rides[column].to_numpy(np.float64)
    if per:
        below = rides[per].to_numpy(np.float64)
        return np.divide(values, below, out=np.full(len(values), np.nan), where=below > 0.0)
    return values / SECONDS_PER_MINUTE if column == "duration_s" else values


def _model(label: str, model: LinearModel, first: ComparedRides, second: ComparedRides) -> ModelContrast:
    """Return the errors of a model on both sets and how much of the difference in consumption it explains."""
    both = (first, second)
    one, other = (side.predicted[label] - side.measured for side in both)
    parts = [model.predict_parts(side.rides) for side in both]
    contrasts = {
        name: _contrast(*(_per_distance(side, each[name]) for side, each in zip(both, parts, strict=True)))
        for name in parts[0]
    }
    terms = [TermContrast(name=name, **msgspec.structs.asdict(contrast)) for name, contrast in contrasts.items()]
    every = tuple(np.arange(len(side.measured)) for side in both)
    return ModelContrast(
        **_errors(first, second, one, other, every),
        explained=_contrast(*(_per_distance(side, side.predicted[label]) for side in both)),
        unexplained=_contrast(_per_distance(first, -one), _per_distance(second, -other)),
        terms=sorted(terms, key=lambda term: -abs(term.difference.value or 0.0)),
        by=_by_condition(first, second, one, other),
    )


def _by_condition(
    first: ComparedRides, second: ComparedRides, one: Floats, other: Floats
) -> dict[str, list[ContrastBin]]:
    """Return bias, error and `consumption` of both sets in each bin that either set has, and `q` of the bias."""
    together = pd.concat([first.rides, second.rides], ignore_index=True)
    here = np.arange(len(together)) < len(first.rides)
    bins = [
        (name, labels[code], (np.flatnonzero(codes[here] == code), np.flatnonzero(codes[~here] == code)))
        for name, (codes, labels) in bin_rides(together).items()
        for code in np.unique(codes[codes >= 0]).tolist()
    ]
    errors = [_errors(first, second, one, other, rows) for *_, rows in bins]
    rates = adjust_false_discovery(np.array([each["bias_kwh"].p for each in errors], dtype=np.float64)).tolist()
    kilometres = [side.rides["distance_km"].to_numpy(np.float64) for side in (first, second)]
    made: dict[str, list[ContrastBin]] = {}
    for (name, label, rows), figures, q in zip(bins, errors, rates, strict=True):
        consumption = _contrast(
            *(
                compute_clustered_ratio(100.0 * side.measured[at], km[at], side.clusters[at])
                for side, at, km in zip((first, second), rows, kilometres, strict=True)
            )
        )
        entry = ContrastBin(bin=label, n=[len(at) for at in rows], **figures, consumption=consumption, q=q)
        made.setdefault(name, []).append(entry)
    return made


def _errors(
    first: ComparedRides, second: ComparedRides, one: Floats, other: Floats, at: tuple[Ints, ...]
) -> dict[str, SetContrast]:
    """Return bias and mean absolute error of some rides of both sets."""
    sets = list(zip((first, second), (one, other), at, strict=True))
    return {
        "bias_kwh": _contrast(*(compute_clustered_mean(off[rows], side.clusters[rows]) for side, off, rows in sets)),
        "mae_kwh": _contrast(
            *(compute_clustered_mean(np.abs(off[rows]), side.clusters[rows]) for side, off, rows in sets)
        ),
    }
