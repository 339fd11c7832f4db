"""Where predictions fail: by vehicle model, distance, temperature, season and driver; and how far intervals hold."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.evaluate.binning import Binning
from core.evaluate.paper.held_out import HeldOutPredictions
from core.evaluate.ride_filter import CLUSTERS, LEAST_RIDES, EvaluatedRides
from core.stats import scores
from core.stats.scores import Codes

TEMPERATURES: Final = tuple(range(-35, 45, 5))
"""Ends of the bins of outside temperature; the first and last one are open. [°C]"""
LEAST_DRIVER_RIDES: Final = 30
"""Rides for a driver to be a bin of his own."""
BUFFER_SHARES: Final = (95, 99)
"""Rides that a buffer is to keep above their reserve. [%]"""


def bin_evaluated_rides(judged: EvaluatedRides) -> dict[str, Binning]:
    """Return what errors are shown against: of each ride its bin, -1 where it is in none, and the bins' names."""
    rides = judged.rides
    return {
        "distance": Binning(judged.cluster, CLUSTERS),
        "temperature": _temperature(rides["ambient_c"].to_numpy(np.float64)),
        "season": _season(rides),
        "driver": _driver(rides),
    }


def _temperature(ambient_c: Floats) -> Binning:
    """Return bins of 5 °C."""
    names = [f"below {TEMPERATURES[0]}", *(f"{t} to {t + 5}" for t in TEMPERATURES[:-1]), f"from {TEMPERATURES[-1]}"]
    codes = np.searchsorted(np.array(TEMPERATURES, dtype=np.float64), ambient_c, side="right")
    return Binning(np.where(np.isnan(ambient_c), -1, codes).astype(np.int64), tuple(names))


def _season(rides: pd.DataFrame) -> Binning:
    """Return winter and summer, as Table 1 of the paper has them."""
    winter = rides["winter"].to_numpy(np.float64)
    return Binning(np.where(np.isnan(winter), -1, 1 - (winter > 0.0)).astype(np.int64), ("winter", "summer"))


def _driver(rides: pd.DataFrame) -> Binning:
    """Return a bin for each driver of many rides; none where the table does not tell who drove."""
    if "driver_id" not in rides:
        return Binning(np.full(len(rides), -1, dtype=np.int64), ())
    count = rides["driver_id"].value_counts()
    names = sorted(str(name) for name, n in count.items() if n >= LEAST_DRIVER_RIDES)
    codes = pd.Index(names, dtype=object).get_indexer(pd.Index(rides["driver_id"], dtype=object))
    return Binning(codes.astype(np.int64), tuple(names))


def _enough(codes: Codes, rows: Codes) -> Codes:
    """Return the bin of each prediction, -1 where fewer than `LEAST` rides of it were held out.

    Parameters
    ----------
    codes : (rides,) int64
        Bin of each ride of the table.
    rows : (n,) int64
        Rides that were predicted; one may stand several times.
    """
    own = codes[np.unique(rows)]
    rides = np.bincount(own[own >= 0], minlength=int(codes.max(initial=0)) + 1)
    return np.where((codes >= 0) & (rides[np.maximum(codes, 0)] >= LEAST_RIDES), codes, -1)[rows]


def compute_errors_by_bin(
    held: HeldOutPredictions, judged: EvaluatedRides
) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return errors against each of `bin_evaluated_rides`, of each recipe.

    A ride that was held out in several repeats is counted in each, so `n` is of predictions.
    """
    rows = held.pooled
    energy = judged.energy[rows]
    return {
        name: {
            recipe: scores.compute_bin_errors(energy, held.all_of(recipe), _enough(codes, rows), labels)
            for recipe in held.recipes
        }
        for name, (codes, labels) in bin_evaluated_rides(judged).items()
    }


def compute_overall_errors(held: HeldOutPredictions, judged: EvaluatedRides) -> dict[str, Any]:
    """Return `bias` and `rmse` by vehicle model, relative-error `bands`, `buffer_kwh`, and the same by cluster."""
    rows = held.pooled
    energy, model, cluster = judged.energy[rows], judged.model[rows], _enough(judged.cluster, rows)
    found: dict[str, Any] = {"bias": {}, "rmse": {}, "bands": {}, "buffer_kwh": {}, "buffer_by_cluster": {}}
    for recipe in held.recipes:
        said = held.all_of(recipe)
        own = [(name, model == i) for i, name in enumerate(judged.vehicle_models)]
        found["bias"][recipe] = {name: scores.compute_bias(energy[at], said[at]) for name, at in own}
        found["rmse"][recipe] = {name: scores.compute_rmse(energy[at], said[at]) for name, at in own}
        found["bands"][recipe] = scores.compute_band_shares(energy, said)
        found["buffer_kwh"][recipe] = _buffers(energy, said)
        found["buffer_by_cluster"][recipe] = {
            name: _buffers(energy[cluster == i], said[cluster == i])
            for i, name in enumerate(CLUSTERS)
            if np.any(cluster == i)
        }
    return found


def _buffers(measured: Floats, predicted: Floats) -> dict[str, float]:
    return {str(share): scores.compute_buffer(measured, predicted, share / 100.0) for share in BUFFER_SHARES}


def compute_interval_coverage(held: HeldOutPredictions, judged: EvaluatedRides) -> dict[str, dict[str, Any]]:
    """Return, of recipes that have intervals, the share of rides inside them, and their mean width.

    `compute_overall_errors`, `cluster`, `season` and `vehicle_model` are shares of rides, where at least `LEAST` were
    held out.
    """
    rows = held.pooled
    energy = judged.energy[rows]
    season, seasons = _season(judged.rides)
    found: dict[str, dict[str, Any]] = {}
    for recipe in held.bounds:
        lower, upper = held.all_bounds(recipe)
        inside = ((lower <= energy) & (energy <= upper)).astype(np.float64)
        found[recipe] = {
            "overall": scores.compute_coverage(energy, lower, upper),
            "cluster": _shares(inside, _enough(judged.cluster, rows), CLUSTERS),
            "season": _shares(inside, _enough(season, rows), seasons),
            "vehicle_model": _shares(inside, _enough(judged.model, rows), judged.vehicle_models),
            "width_kwh": float(np.mean(upper - lower)) if len(energy) else np.nan,
        }
    return found


def _shares(inside: Floats, groups: Codes, names: Sequence[str]) -> dict[str, float]:
    """Return the share inside, of each group that has any."""
    means = scores.compute_group_means(inside, groups, len(names))
    return {name: float(mean) for name, mean in zip(names, means, strict=True) if not np.isnan(mean)}
