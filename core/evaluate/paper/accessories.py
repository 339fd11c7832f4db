"""Compute Figure 1 of the paper: accessory power against outside temperature, and the curve fitted to it."""

from typing import Any, Final

import msgspec
import numpy as np

from socast.core.errors import SocastError
from socast.core.evaluate.paper.records import AccessoryPoint, AccessoryPower
from socast.core.evaluate.ride_filter import LEAST_RIDES, EvaluatedRides
from socast.core.fit.recipes import RECIPES
from socast.core.models import BASIC_PHYSICAL
from socast.core.stats.scores import compute_group_means

RECIPE: Final = "extended_physical"
BIN_K: Final = 2.0
"""Width of a bin of outside temperature. [K]"""


def compute_figure_1(evaluated: EvaluatedRides) -> dict[str, AccessoryPower]:
    """Return the accessory power of each vehicle model: what its rides used beyond the basic physical model."""
    rides: Any = evaluated.rides
    try:
        fits = RECIPES[RECIPE].fit(rides).fits
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
