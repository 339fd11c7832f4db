"""Compute percentage errors of held-out rides, cars and dates, and errors below those of the baselines.

The paper states errors in kWh, and reductions relative to its basic physical model. Most of that model's error is bias,
which one fitted factor removes. Reductions relative to the rescaled baselines show what a model explains beyond that.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.evaluate.paper.records import Numbers, PercentageErrors, SplitErrors
from socast.core.evaluate.paper.results import HeldOutPredictions, compute_reductions
from socast.core.evaluate.records import RelativeErrors, hold_estimate
from socast.core.evaluate.relative_errors import (
    LEAST_ENERGY,
    compute_relative_figures,
    compute_share_below_least,
    divide_by_floor,
)
from socast.core.evaluate.ride_filter import EvaluatedRides
from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from socast.core.fit.recipes import BASELINES
from socast.core.stats.scores import Estimate, average_over_repeats, compute_mae, compute_mape, compute_wmape

CLUSTER_COLUMNS: Final = {"vehicle": "vehicle_id", "date": "date"}
"""Kind of split -> column of the units that it holds out together, within which errors resemble each other."""


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
