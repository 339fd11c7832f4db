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
from socast.core.evaluate.binning import list_bins
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
from socast.core.models.features import divide_by_distance
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

Sets = tuple[ComparedRides, ComparedRides]


def compare_datasets(first: ComparedRides, second: ComparedRides, models: Mapping[str, LinearModel]) -> DatasetContrast:
    """Return the differences between two sets of rides, as second less first."""
    sets, identity = (first, second), list(IDENTITY_COLUMNS)
    return DatasetContrast(
        shared=len(first.rides[identity].merge(second.rides[identity], how="inner", on=identity)),
        properties=_compare_properties(sets),
        consumption=_contrast(*(_per_distance(side, side.measured) for side in sets)),
        models={label: _compare_model(label, model, sets) for label, model in models.items()},
    )


def _contrast(one: Estimate, other: Estimate) -> SetContrast:
    """Return two estimates and their difference, with its interval and probability."""
    apart = subtract(other, one)
    return SetContrast(
        first=hold_estimate(one), second=hold_estimate(other), difference=hold_estimate(apart), p=apart.p
    )


def _per_distance(compared: ComparedRides, energy: Floats, rows: Ints | slice = slice(None)) -> Estimate:
    """Return an energy of some rides per distance. [kWh/100 km]"""
    distance = compared.rides["distance_km"].to_numpy(np.float64)
    return compute_clustered_ratio(100.0 * energy[rows], distance[rows], compared.clusters[rows])


def _compare_properties(sets: Sets) -> list[PropertyContrast]:
    """Return the properties of both sets, ordered by their difference relative to the spread between rides."""
    entries: list[dict[str, Any]] = []
    for name, unit, column, per in PROPERTIES:
        if any(wanted not in side.rides for wanted in (column, per) if wanted for side in sets):
            continue
        values = [_compute_property(side.rides, column, per) for side in sets]
        known = [np.isfinite(value) for value in values]
        if not all(each.any() for each in known):
            continue
        one, other = (
            compute_clustered_mean(value[at], side.clusters[at])
            for value, at, side in zip(values, known, sets, strict=True)
        )
        spread = float(np.sqrt(np.mean([np.var(value[at]) for value, at in zip(values, known, strict=True)])))
        apart = abs(other.value - one.value) / spread if spread > 0.0 else 0.0
        contrast = msgspec.structs.asdict(_contrast(one, other))
        entries.append({"name": name, "unit": unit, "in_spreads": apart} | contrast)
    rates = adjust_false_discovery(np.array([entry["p"] for entry in entries], dtype=np.float64)).tolist()
    made = [PropertyContrast(**entry, q=rate) for entry, rate in zip(entries, rates, strict=True)]
    return sorted(made, key=lambda entry: -(entry.in_spreads or 0.0))


def _compute_property(rides: pd.DataFrame, column: str, per: str) -> Floats:
    """Return a property of each ride; NaN where it is unknown."""
    values = rides[column].to_numpy(np.float64)
    if per:
        return divide_by_distance(values, rides[per].to_numpy(np.float64))
    return values / 60.0 if column == "duration_s" else values


def _compare_model(label: str, model: LinearModel, sets: Sets) -> ModelContrast:
    """Return the errors of a model on both sets and how much of the difference in consumption it explains."""
    one, other = (side.predicted[label] - side.measured for side in sets)
    parts = [model.predict_parts(side.rides) for side in sets]
    contrasts = {
        name: _contrast(*(_per_distance(side, each[name]) for side, each in zip(sets, parts, strict=True)))
        for name in parts[0]
    }
    terms = [TermContrast(name=name, **msgspec.structs.asdict(contrast)) for name, contrast in contrasts.items()]
    return ModelContrast(
        **_compare_errors(sets, (one, other), (slice(None), slice(None))),
        explained=_contrast(*(_per_distance(side, side.predicted[label]) for side in sets)),
        unexplained=_contrast(_per_distance(sets[0], -one), _per_distance(sets[1], -other)),
        terms=sorted(terms, key=lambda term: -abs(term.difference.value or 0.0)),
        by=_compare_by_condition(sets, (one, other)),
    )


def _compare_by_condition(sets: Sets, errors: tuple[Floats, Floats]) -> dict[str, list[ContrastBin]]:
    """Return bias, error and `consumption` of both sets in each bin that either set has, and `q` of the bias."""
    count = len(sets[0].rides)
    made: dict[str, list[ContrastBin]] = {}
    bins = [
        (name, label, (rows[rows < count], rows[rows >= count] - count))
        for name, label, rows in list_bins(pd.concat([side.rides for side in sets], ignore_index=True))
    ]
    figures = [_compare_errors(sets, errors, rows) for *_, rows in bins]
    rates = adjust_false_discovery(np.array([each["bias_kwh"].p for each in figures], dtype=np.float64)).tolist()
    for (name, label, rows), contrasts, q in zip(bins, figures, rates, strict=True):
        used = _contrast(*(_per_distance(side, side.measured, at) for side, at in zip(sets, rows, strict=True)))
        entry = ContrastBin(bin=label, n=[len(at) for at in rows], **contrasts, consumption=used, q=q)
        made.setdefault(name, []).append(entry)
    return made


def _compare_errors(
    sets: Sets, errors: tuple[Floats, Floats], rows: tuple[Ints | slice, Ints | slice]
) -> dict[str, SetContrast]:
    """Return bias and mean absolute error of some rides of both sets."""
    parts = [(error[at], side.clusters[at]) for side, error, at in zip(sets, errors, rows, strict=True)]
    return {
        "bias_kwh": _contrast(*(compute_clustered_mean(error, clusters) for error, clusters in parts)),
        "mae_kwh": _contrast(*(compute_clustered_mean(np.abs(error), clusters) for error, clusters in parts)),
    }
