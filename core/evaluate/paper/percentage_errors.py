"""Compute percentage errors of held-out rides, cars and dates, and errors below those of the baselines.

The paper states errors in kWh, and reductions relative to its basic physical model. Most of that model's error is bias,
which one fitted factor removes. Reductions relative to the rescaled baselines show what a model explains beyond that.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.evaluate.paper.held_out import HeldOutPredictions
from socast.core.evaluate.paper.results import compute_reductions
from socast.core.evaluate.relative_errors import (
    LEAST_ENERGY,
    compute_relative_figures,
    compute_share_below_least,
    divide_by_floor,
)
from socast.core.evaluate.ride_filter import EvaluatedRides
from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from socast.core.fit.recipes import BASELINES
from socast.core.stats.scores import average_over_repeats, compute_mae, compute_mape, compute_wmape

CLUSTER_COLUMNS: Final = {"vehicle": "vehicle_id", "date": "date"}
"""Kind of split -> column of the units that it holds out together, within which errors resemble each other."""


def compute_percentage_errors(held: Mapping[str, HeldOutPredictions], evaluated: EvaluatedRides) -> dict[str, Any]:
    """Return the errors of each recipe by ride, by unseen car and by unseen date.

    Parameters
    ----------
    held : mapping of str to HeldOutPredictions
        Kind of split (`ride`, `vehicle` or `date`) -> predictions. Kinds without predictions are left out.

    Returns
    -------
    dict
        `least_energy_kwh`, and for each kind: `rides`, the number of predictions; `energy_kwh`, the mean measured
        energy; `below_least`, the share of rides that MAPE leaves out; `noise_floor_kwh`; and `recipes` with
        `mae_kwh`, `wmape` and `mape` with intervals, and `over_floor`.

    Notes
    -----
    By ride, intervals cover the variation between repeated draws. By vehicle and by date, they are clustered by the
    unit that was held out.
    """
    variance = compute_noise_variance(evaluated.rides)
    percentages: dict[str, Any] = {"least_energy_kwh": LEAST_ENERGY}
    for kind, predictions in held.items():
        rows = predictions.pooled
        if not len(rows):
            continue
        energy, floor = evaluated.energy[rows], compute_noise_floor(variance[rows])
        percentages[kind] = {
            "rides": len(rows),
            "energy_kwh": float(np.mean(energy)),
            "below_least": compute_share_below_least(energy),
            "noise_floor_kwh": floor,
            "recipes": {
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
        }
    return percentages


def _compute_over_repeats(
    held: HeldOutPredictions, evaluated: EvaluatedRides, recipe: str, floor: float
) -> dict[str, Any]:
    """Return the figures of `compute_relative_figures`, averaged over repeated draws of the test rides."""
    pairs = [(evaluated.energy[rows], energy) for rows, energy in zip(held.rows, held.energy[recipe], strict=True)]

    def average(measure: Callable[[Floats, Floats], float]) -> dict[str, float]:
        return average_over_repeats(np.array([measure(*pair) for pair in pairs]), held.overlap).figures()

    mae = average(compute_mae)
    return {
        "mae_kwh": mae,
        "wmape": average(compute_wmape),
        "mape": average(lambda measured, predicted: compute_mape(measured, predicted, LEAST_ENERGY)),
        "over_floor": divide_by_floor(mae["value"], floor),
    }


def compute_reductions_by_baseline(
    means: Mapping[str, Sequence[float]], vehicle_models: Sequence[str]
) -> dict[str, dict[str, dict[str, float]]]:
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
