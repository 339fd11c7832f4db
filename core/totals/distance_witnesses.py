"""Whether odometer and fixes of a ride agree with the distance that was counted."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats
from core.totals.accumulator import Totals

MOST_DISPUTED: Final = 0.03
"""Largest share of its distance that witnesses may dispute in a ride fit for training. [1]"""
OFF: Final = 0.05
"""Largest deviation of the odometer, beyond its resolution: tyres and calibration take some percent. [1]"""
STALE: Final = 300.0
"""Distance that a car drives between two reports of its odometer. [m]"""
SHORTER: Final = 0.08
"""Share by which the distance may be shorter than the sum of its sections between fixes, by their noise. [1]"""
LONGER: Final = 0.25
"""Share by which the distance may be longer, by the bends of the road within sections. [1]"""
LEAST_PATH: Final = 1000.0
"""Sum of the sections from which they are a witness. [m]"""
LEAST_PART: Final = 0.5
"""Least share of the distance that the sections must cover to be a witness. [1]"""
RESOLUTIONS: Final = (1000.0, 500.0, 100.0, 50.0)
"""Steps in which odometers count; one that counts finer has none that matters. [m]"""


def find_contradicted_distance(totals: Totals) -> NDArray[np.bool_]:
    """Return where odometer or fixes contradict the distance of a ride.

    Parameters
    ----------
    totals : Totals
        Totals of n rides.

    Returns
    -------
    (n,) bool

    Notes
    -----
    Of two witnesses, both must contradict. Distance that was disputed during the ride contradicts by itself.
    """
    distance = totals.amount("distance")
    by_odometer, has_odometer = _contradict_by_odometer(totals)
    by_fixes, has_fixes = _contradict_by_fixes(totals)
    both = has_odometer & has_fixes
    return np.asarray(
        (totals.amount("disputed") > MOST_DISPUTED * distance)
        | np.where(both, by_odometer & by_fixes, (has_odometer & by_odometer) | (has_fixes & by_fixes))
    )


def _contradict_by_odometer(totals: Totals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the odometer shows another distance, and where it can tell."""
    first, last = totals.at_first("odometer"), totals.at_last("odometer")
    driven = last - first
    step = _find_resolution(first, last)
    known = np.nan_to_num(driven) > 2.0 * step
    return np.abs(totals.amount("distance") - driven) > OFF * driven + step + STALE, known


def _find_resolution(first: Floats, last: Floats) -> Floats:
    """Return the step in which an odometer counts, by two readings. [m]"""
    step = np.zeros(len(first))
    for size in reversed(RESOLUTIONS):
        is_multiple = np.abs(np.stack([first, last]) / size - np.round(np.stack([first, last]) / size)) * size < 1.0
        step[is_multiple.all(axis=0)] = size
    return step


def _contradict_by_fixes(totals: Totals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the fixes show another distance, and where they can tell."""
    path, run = totals.amount("path"), totals.amount("path_run")
    known = (path > LEAST_PATH) & (run > LEAST_PART * totals.amount("distance"))
    return (run < (1.0 - SHORTER) * path) | (run > (1.0 + LONGER) * path), known
