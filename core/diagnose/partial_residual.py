"""Compute the data of pictures: measured less predicted against the regressor of each missing effect.

The regressor of an effect is its power, or its energy per kilometre where it acts through the motion of the car, per
unit of its coefficient. The partial residual is what the model and all missing effects leave, plus the contribution of
this effect. Plotted against the regressor, it scatters around a line through the origin whose slope is the coefficient,
if the formula of the effect holds; a bend shows that it does not.

References
----------
Larsen and McCleary, Technometrics 14 (1972) 781, DOI 10.1080/00401706.1972.10488966.
"""

from typing import Any, Final

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.add.holdout import drop_dates, select_final_days
from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import CarResidual, PartialResidual
from socast.core.diagnose.selection import MissingEffect, Selection
from socast.core.errors import ModelError
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.models import LinearModel
from socast.core.records import ConfidenceInterval, make_interval
from socast.core.stats.bin_means import average_in_bins, split_at_quantiles
from socast.core.stats.evidence import ClusterSums, compute_evidence

BINS: Final = 12
"""Largest number of bins of a picture."""
BINS_OF_CAR: Final = 5
"""Largest number of bins of the picture of one car."""
MOST_CARS: Final = 12
"""Largest number of cars that are shown one by one: those with the most windows."""
LEAST_WINDOWS: Final = 5
"""Least mean number of windows in a bin."""
LEAST_KM: Final = 0.02
"""Distance below which a window has no energy per kilometre. [km]"""
WH: Final = 1000.0
"""Watt-hours in a kilowatt-hour. [Wh/kWh]"""


def compute_partial_residual(selection: Selection, finding: MissingEffect) -> PartialResidual:
    """Return the partial residual of a missing effect in bins of its regressor, of each car in fewer bins.

    Notes
    -----
    All other coefficients have the values that they have beside the effect, so both series have the same interval.
    """
    base, seen = selection.base, selection.base.windows
    effect = effects.get(finding.variant)
    per = "km" if effect.per == "distance" else "h"
    amount = get_numbers(seen.table, "distance_km") if per == "km" else get_numbers(seen.table, "duration_s") / 3600.0
    column, value = finding.column[:, 0], finding.size.value
    left = base.convert_to_energy(selection.compute_residual(selection.build_basis()))
    rows = np.flatnonzero(amount > (LEAST_KM if per == "km" else 0.0))
    regressor, after = (WH * energy[rows] / amount[rows] for energy in (column, left))
    weight = base.weight[rows] * amount[rows] ** 2
    low, high = finding.size.interval

    def bin_rows(at: Ints, most: int) -> dict[str, Any]:
        return _bin(regressor[at], after[at], value, weight[at], seen.day[rows][at], most)

    space = selection.build_space(finding)
    projected = space.project_out(finding.column)
    names = get_names(seen.table, "vehicle_id")
    cars = []
    for car in _list_cars(seen.vehicle):
        here = np.flatnonzero(seen.vehicle == car)
        slope, ends = _fit_slope(space.residual[here], projected[here], seen.day[here])
        name = str(names[here[0]])
        of_car = bin_rows(np.flatnonzero(seen.vehicle[rows] == car), BINS_OF_CAR)
        cars.append(CarResidual(car=name, slope=slope, slope_ci95=ends, **of_car))
    return PartialResidual(
        per=per,
        quantity=effect.coefficient,
        summary=effect.summary,
        unit=effect.unit,
        variant=finding.variant,
        slope=value,
        slope_ci95=make_interval(low, high),
        **bin_rows(np.arange(len(rows)), BINS),
        cars=sorted(cars, key=lambda each: each.car),
    )


def compute_candidate_residual(
    rides: pd.DataFrame, windows: pd.DataFrame, model: LinearModel, effect: str
) -> PartialResidual:
    """Return the partial residual of one candidate, tested alone beside a model, whether it is missing or not.

    Parameters
    ----------
    rides, windows : DataFrame
        The tables of the same rides. Those of the final hold-out are not used, as in a diagnosis.
    effect : str
        Name of an effect. Of its variants, the one that explains most on held-out days is shown.
    """
    name = effects.get(effect).base
    with threadpool_limits(1):
        final = select_final_days(model.history, get_names(rides, "date"))
        seen = gather_windows(*drop_dates(rides, windows, final), model)
        candidates = build_candidates(seen, model)
        if name not in candidates.names:
            raise ModelError(f"{name} is no candidate: it is {candidates.excluded.get(name, 'in the road load')}")
        base, clusters = BaseProjection(seen, model), [ClusterSums(seen.day), ClusterSums(seen.date)]
        at = np.flatnonzero(candidates.effects == candidates.names.index(name))
        off, whole = base.project_out(candidates.columns[:, at]), base.apply_weights(candidates.columns[:, at])
        size = (off**2).sum(axis=0)
        if not (size > LEAST_LEFT * (whole**2).sum(axis=0)).any():
            raise ModelError(f"{name} is not identifiable: the model can reproduce it with its own terms")
        fall = np.divide((off.T @ base.residual) ** 2, size, out=np.zeros(len(at)), where=size > 0.0)
        best = int(at[np.argmax(fall)])
        column = candidates.columns[:, [best]]
        base = base.reweight(column)
        evidence = compute_evidence(base.residual, base.project_out(column), np.zeros(1, dtype=np.int64), clusters[0])
        found = MissingEffect(candidates.variants[best], column, evidence.get_estimate(0), 1.0, {})
        return compute_partial_residual(Selection(base, clusters, (found,)), found)


def _list_cars(vehicle: Ints) -> list[int]:
    """Return the codes of the cars with the most windows."""
    count = np.bincount(vehicle)
    return [int(car) for car in np.argsort(-count, kind="stable")[:MOST_CARS] if count[car] >= 2 * LEAST_WINDOWS]


def _fit_slope(residual: Floats, column: Floats, day: Ints) -> tuple[float | None, ConfidenceInterval | None]:
    """Return the coefficient that weighted, projected windows of one car show, with its interval; None if unknown."""
    evidence = compute_evidence(residual, column, np.zeros(1, dtype=np.int64), ClusterSums(day))
    slope = evidence.get_estimate(0)
    known = float((column**2).sum()) > 0.0
    return (slope.value, make_interval(*slope.interval)) if known else (None, None)


def _bin(x: Floats, after: Floats, slope: float, weight: Floats, day: Ints, most: int) -> dict[str, Any]:
    """Return the residual with and without the contribution of an effect, in bins of its regressor."""
    if not len(x):
        return {}
    place, bins = split_at_quantiles(x, max(1, min(most, len(x) // LEAST_WINDOWS)))
    means = average_in_bins(place, bins, after, weight, day)
    middle = np.bincount(place, weight * x, bins) / np.bincount(place, weight, bins)
    return {
        "x": middle.tolist(),
        "before": (means.value + slope * middle).tolist(),
        "after": means.value.tolist(),
        "ci95": means.ci95.tolist(),
        "windows": means.windows.tolist(),
        "days": means.days.tolist(),
    }
