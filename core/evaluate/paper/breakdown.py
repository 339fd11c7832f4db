"""Compute errors by vehicle model, distance, temperature, season and driver, the coverage of intervals, and Figure 1.

Figure 1 of the paper is the accessory power against outside temperature, and the curve fitted to it.

The paper states errors in kWh, and reductions relative to its basic physical model. Most of that model's error is bias,
which one fitted factor removes. Errors in percent, and reductions relative to the rescaled baselines, show what a model
explains beyond that.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.errors import SocastError
from socast.core.evaluate.binning import Binning, bin_names, bin_seasons, bin_values
from socast.core.evaluate.paper.records import (
    AccessoryPoint,
    AccessoryPower,
    BinErrors,
    IntervalCoverage,
    Numbers,
    PercentageErrors,
    SplitErrors,
)
from socast.core.evaluate.paper.results import HeldOutPredictions, Measured, compute_reductions
from socast.core.evaluate.records import RelativeErrors, hold_estimate
from socast.core.evaluate.relative_errors import (
    LEAST_ENERGY,
    compute_relative_figures,
    compute_share_below_least,
    divide_by_floor,
)
from socast.core.evaluate.ride_filter import CLUSTERS, LEAST_RIDES, EvaluatedRides
from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from socast.core.fit.recipes import BASELINES, RECIPES
from socast.core.models import BASIC_PHYSICAL
from socast.core.stats import scores
from socast.core.stats.scores import (
    Codes,
    Estimate,
    average_over_repeats,
    compute_group_means,
    compute_mae,
    compute_mape,
    compute_wmape,
)

CLUSTER_COLUMNS: Final = {"vehicle": "vehicle_id", "date": "date"}
"""Kind of split -> column of the units that it holds out together, within which errors resemble each other."""
CURVE_RECIPE: Final = "extended_physical"
BIN_K: Final = 2.0
"""Width of a bin of outside temperature. [K]"""
TEMPERATURES: Final = tuple(range(-35, 45, 5))
"""Edges of the temperature bins; the first and last bin are open. [°C]"""
LEAST_DRIVER_RIDES: Final = 30
"""Rides that a driver needs to have a bin."""
BUFFER_SHARES: Final = (95, 99)
"""Shares of rides that a buffer is to keep above their reserve. [%]"""


def bin_evaluated_rides(evaluated: EvaluatedRides) -> dict[str, Binning]:
    """Return the bins by which errors are reported."""
    rides = evaluated.rides
    return {
        "distance": Binning(evaluated.cluster, CLUSTERS),
        "temperature": bin_values(rides["ambient_c"].to_numpy(np.float64), TEMPERATURES),
        "season": bin_seasons(rides["winter"].to_numpy(np.float64)),
        "driver": bin_names(rides, "driver_id", LEAST_DRIVER_RIDES),
    }


def _enough(codes: Codes, rows: Codes) -> Codes:
    """Return the bin of each prediction, -1 where fewer than `LEAST_RIDES` rides of the bin were held out."""
    of_rows = codes[np.unique(rows)]
    rides = np.bincount(of_rows[of_rows >= 0], minlength=int(codes.max(initial=0)) + 1)
    return np.where((codes >= 0) & (rides[np.maximum(codes, 0)] >= LEAST_RIDES), codes, -1)[rows]


def compute_errors_by_bin(held: HeldOutPredictions, evaluated: EvaluatedRides) -> dict[str, dict[str, list[BinErrors]]]:
    """Return the errors of each recipe in each of the bins of `bin_evaluated_rides`.

    A ride that was held out in several repeats counts in each of them, so `n` is a number of predictions.
    """
    errors = {}
    for name, (codes, labels) in bin_evaluated_rides(evaluated).items():
        measure = partial(scores.compute_bin_errors, groups=_enough(codes, held.pooled), labels=labels)
        errors[name] = msgspec.convert(held.measure(evaluated, measure), dict[str, list[BinErrors]])
    return errors


def compute_errors_by_vehicle_model(
    held: HeldOutPredictions, evaluated: EvaluatedRides, measure: Callable[[Floats, Floats], float | None]
) -> Numbers:
    """Return an error of each recipe over the held-out rides of each vehicle model."""
    model = evaluated.model[held.pooled]
    rides_of = {name: model == i for i, name in enumerate(evaluated.vehicle_models)}
    return held.measure(evaluated, partial(_measure_groups, rides_of=rides_of, measure=measure))


def compute_buffers(measured: Floats, predicted: Floats) -> dict[str, float | None]:
    """Return the buffer for each of `BUFFER_SHARES`. [kWh]"""
    return {str(share): scores.compute_buffer(measured, predicted, share / 100.0) for share in BUFFER_SHARES}


def compute_buffers_by_cluster(held: HeldOutPredictions, evaluated: EvaluatedRides) -> dict[str, Numbers]:
    """Return the buffer of each recipe in each cluster of distance with enough rides. [kWh]"""
    cluster = _enough(evaluated.cluster, held.pooled)
    rides_of = {name: cluster == i for i, name in enumerate(CLUSTERS) if np.any(cluster == i)}
    return held.measure(evaluated, partial(_measure_groups, rides_of=rides_of, measure=compute_buffers))


def _measure_groups(
    measured: Floats,
    predicted: Floats,
    rides_of: Mapping[str, NDArray[np.bool_]],
    measure: Callable[[Floats, Floats], Measured],
) -> dict[str, Measured]:
    """Return a measure of each group of rides."""
    return {name: measure(measured[at], predicted[at]) for name, at in rides_of.items()}


def compute_interval_coverage(held: HeldOutPredictions, evaluated: EvaluatedRides) -> dict[str, IntervalCoverage]:
    """Return the share of rides inside their interval and its mean width, for each recipe with intervals."""
    rows = held.pooled
    energy = evaluated.energy[rows]
    season, seasons = bin_seasons(evaluated.rides["winter"].to_numpy(np.float64))
    coverage = {}
    for recipe in held.bounds:
        lower, upper = held.all_bounds(recipe)
        inside = ((lower <= energy) & (energy <= upper)).astype(np.float64)
        coverage[recipe] = IntervalCoverage(
            overall=scores.compute_coverage(energy, lower, upper),
            cluster=_shares(inside, _enough(evaluated.cluster, rows), CLUSTERS),
            season=_shares(inside, _enough(season, rows), seasons),
            vehicle_model=_shares(inside, _enough(evaluated.model, rows), evaluated.vehicle_models),
            width_kwh=float(np.mean(upper - lower)) if len(energy) else None,
        )
    return coverage


def _shares(inside: Floats, groups: Codes, names: Sequence[str]) -> dict[str, float | None]:
    """Return the share inside, for each group that has any."""
    means = scores.compute_group_means(inside, groups, len(names))
    return {name: float(mean) for name, mean in zip(names, means, strict=True) if not np.isnan(mean)}


def compute_figure_1(evaluated: EvaluatedRides) -> dict[str, AccessoryPower]:
    """Return the accessory power of each vehicle model: what its rides used beyond the basic physical model."""
    rides: Any = evaluated.rides
    try:
        fits = RECIPES[CURVE_RECIPE].fit(rides).fits
    except SocastError:
        return {}  # a table that no curve can be fitted to has no such figure
    time = (rides["duration_s"] * rides["accessory_scale"] / 3.6e6).to_numpy(np.float64)
    beyond = evaluated.energy - BASIC_PHYSICAL.predict_energy(rides)
    ambient = rides["ambient_c"].to_numpy(np.float64)
    known = np.isfinite(ambient) & np.isfinite(beyond) & (time > 0.0)
    figure = {}
    for i, name in enumerate(evaluated.vehicle_models):
        of_model = known & (evaluated.model == i)
        if name not in fits or not np.any(of_model) or fits[name].curve is None:
            continue
        codes = (ambient[of_model] // BIN_K).astype(np.int64)
        first, bins = int(codes.min()), int(np.ptp(codes)) + 1
        rides = np.bincount(codes - first, minlength=bins)
        sums = [compute_group_means(values[of_model], codes - first, bins) for values in (ambient, beyond, time)]
        points = [
            AccessoryPoint(ambient_c=sums[0][b], power_w=sums[1][b] / sums[2][b], rides=rides[b])
            for b in range(bins)
            if rides[b] >= LEAST_RIDES
        ]
        figure[name] = AccessoryPower(points=points, curve=msgspec.to_builtins(fits[name].curve))
    return figure


def compute_percentage_errors(held: Mapping[str, HeldOutPredictions], evaluated: EvaluatedRides) -> PercentageErrors:
    """Return the errors of each recipe by ride, by unseen car and by unseen date.

    Parameters
    ----------
    held : mapping of str to HeldOutPredictions
        Kind of split (`ride`, `vehicle` or `date`) -> predictions. Kinds without predictions are left out.

    Notes
    -----
    By ride, intervals cover the variation between repeated draws. By vehicle and by date, they are clustered by the
    unit that was held out.
    """
    variance = compute_noise_variance(evaluated.rides)
    splits = {}
    for kind, predictions in held.items():
        rows = predictions.pooled
        if not len(rows):
            continue
        energy, floor = evaluated.energy[rows], compute_noise_floor(variance[rows])
        splits[kind] = SplitErrors(
            rides=len(rows),
            energy_kwh=float(np.mean(energy)),
            below_least=compute_share_below_least(energy),
            noise_floor_kwh=floor,
            recipes={
                recipe: _compute_over_repeats(predictions, evaluated, recipe, floor)
                if kind not in CLUSTER_COLUMNS
                else compute_relative_figures(
                    energy,
                    predictions.all_of(recipe),
                    pd.factorize(evaluated.rides[CLUSTER_COLUMNS[kind]])[0][rows].astype(np.int64),
                    floor,
                )
                for recipe in predictions.recipes
            },
        )
    return PercentageErrors(least_energy_kwh=LEAST_ENERGY, **splits)


def _compute_over_repeats(
    held: HeldOutPredictions, evaluated: EvaluatedRides, recipe: str, floor: float
) -> RelativeErrors:
    """Return the figures of `compute_relative_figures`, averaged over repeated draws of the test rides."""
    pairs = [(evaluated.energy[rows], energy) for rows, energy in zip(held.rows, held.energy[recipe], strict=True)]

    def average(measure: Callable[[Floats, Floats], float]) -> Estimate:
        return average_over_repeats(np.array([measure(*pair) for pair in pairs]), held.overlap)

    mae = average(compute_mae)
    mape = average(lambda measured, predicted: compute_mape(measured, predicted, LEAST_ENERGY))
    return RelativeErrors(
        mae_kwh=hold_estimate(mae),
        wmape=hold_estimate(average(compute_wmape)),
        mape=hold_estimate(mape),
        over_floor=divide_by_floor(mae.value, floor),
    )


def compute_reductions_by_baseline(
    means: Mapping[str, Sequence[float]], vehicle_models: Sequence[str]
) -> dict[str, Numbers]:
    """Return by which share the error of each recipe is below that of each baseline.

    Units: means [kWh].

    Returns
    -------
    dict
        Baseline to recipe to vehicle model to share, with `average`, the mean over vehicle models. [1]

    Examples
    --------
    >>> errors = {"basic_physical": [1.0], "basic_rescaled": [0.5], "hybrid": [0.1]}
    >>> shares = compute_reductions_by_baseline(errors, ["leaf"])
    >>> [round(shares[name]["hybrid"]["leaf"], 3) for name in shares]
    [0.9, 0.8]
    """
    return {name: compute_reductions(means, vehicle_models, name) for name in BASELINES if name in means}
