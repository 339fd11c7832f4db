"""Compute how the error of rides falls as missing effects are added one by one, with intervals."""

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.records import ErrorAfterEffect
from socast.core.diagnose.selection import Selection
from socast.core.stats.clustered import compute_clustered_mean


def compute_steps(selection: Selection, floor: float) -> list[ErrorAfterEffect]:
    """Return the error per ride as effects are added one by one, each fitted to other vehicle-days.

    The terms of the model are refitted to all windows of each car, also to those of the held-out days.

    Units: floor [kWh].

    The first step is the model without missing effects. Rides of one vehicle-day may resemble each other.
    """
    days = selection.base.windows.day_of_ride
    rows: list[ErrorAfterEffect] = []
    before = np.empty(0)
    for count in range(len(selection.effects) + 1):
        error = compute_held_out_errors(selection.keep(selection.effects[:count]))
        mean = compute_clustered_mean(error, days)
        change = compute_clustered_mean(error - before, days) if len(before) else None
        rows.append(
            ErrorAfterEffect(
                effect=selection.effects[count - 1].effect if count else None,
                scope=[],
                mae_kwh=mean.value,
                mae_ci95_kwh=mean.ci95,
                change_kwh=None if change is None else change.value,
                change_ci95_kwh=None if change is None else change.ci95,
                noise_floor_kwh=floor,
            )
        )
        before = error
    return rows


def compute_held_out_errors(selection: Selection) -> Floats:
    """Return the absolute error of each ride beside the selected effects, (rides,). [kWh]"""
    left = selection.compute_held_out_residual(selection.build_basis())
    return np.asarray(np.abs(selection.base.windows.by_ride(selection.base.convert_to_energy(left))))
