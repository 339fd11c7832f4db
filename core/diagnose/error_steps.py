"""Compute how the error of rides falls as missing effects are added one by one, with intervals."""

from collections.abc import Sequence

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.forward_selection import ForwardSelection, MissingEffect
from socast.core.diagnose.records import ErrorAfterEffect
from socast.core.stats.clustered import compute_clustered_mean


def compute_steps(
    selection: ForwardSelection, missing: Sequence[MissingEffect], floor: float
) -> list[ErrorAfterEffect]:
    """Return the error per ride as effects are added one by one, each fitted to other vehicle-days.

    The terms of the model are refitted to all windows of each car, also to those of the held-out days.

    Units: floor [kWh].

    The first step is the model without missing effects. Rides of one vehicle-day may resemble each other.
    """
    days = selection.base.windows.day_of_ride
    named, selection.selected = selection.selected, []
    rows: list[ErrorAfterEffect] = []
    before = np.empty(0)
    for finding in (None, *missing):
        if finding is not None:
            selection.selected = [*selection.selected, finding.selected]
        error = _compute_errors(selection)
        mean = compute_clustered_mean(error, days)
        change = compute_clustered_mean(error - before, days) if len(before) else None
        scope = () if finding is None else finding.selected.candidates.scope
        rows.append(
            ErrorAfterEffect(
                effect=None if finding is None else finding.selected.effect,
                scope=list(scope),
                mae_kwh=mean.value,
                mae_ci95_kwh=mean.ci95,
                change_kwh=None if change is None else change.value,
                change_ci95_kwh=None if change is None else change.ci95,
                noise_floor_kwh=floor,
            )
        )
        before = error
    selection.selected = named
    return rows


def _compute_errors(selection: ForwardSelection) -> Floats:
    """Return the absolute error of each ride beside the selected effects, (rides,). [kWh]"""
    left = selection.compute_held_out_residual(selection.build_basis())
    return np.asarray(np.abs(selection.base.windows.by_ride(selection.base.convert_to_energy(left))))
