"""Whether odometer and fixes of a ride agree with the distance that was counted."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats
from core.totals.accumulator import Totals

MOST_DISPUTED: Final = 0.03
"""Largest share of its distance that witnesses may dispute in a ride fit for training. [1]"""
HINT: Final = 0.02
"""Logarithm of a ratio from which a witness supports another one. [1]"""
OFF: Final = 0.03
"""Largest deviation of the odometer, beyond its resolution: tyres and calibration take some percent. [1]"""
STALE: Final = 300.0
"""Distance that a car drives between two reports of its odometer. [m]"""
SHORTER: Final = 0.08
"""Share by which the distance may be shorter than the sum of its sections between fixes, by their noise. [1]"""
FIRST_FIXES: Final = 100.0
"""Distance by which the first fixes of a ride may wander, before the receiver is sure of its place. [m]"""
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
    Where there are two witnesses, one must contradict clearly, and the other must be off in the same direction.
    Distance that was disputed during the ride contradicts by itself.
    """
    distance = totals.amount("distance")
    of_odometer, clear_odometer = _compare_odometer(totals)
    of_fixes, clear_fixes = _compare_fixes(totals)
    same_side = (of_odometer * of_fixes > 0.0) & (np.minimum(abs(of_odometer), abs(of_fixes)) > HINT)
    alone = np.isnan(of_odometer) | np.isnan(of_fixes)
    return np.asarray(
        (totals.amount("disputed") > MOST_DISPUTED * distance) | ((clear_odometer | clear_fixes) & (alone | same_side))
    )


def _compare_odometer(totals: Totals) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the logarithm of distance over that of the odometer, NaN where it cannot tell, and where it is clear."""
    first, last = totals.at_first("odometer"), totals.at_last("odometer")
    driven, step, distance = last - first, _find_resolution(first, last), totals.amount("distance")
    known = (np.nan_to_num(driven) > 2.0 * step) & (distance > 0.0)
    ratio = np.log(np.divide(distance, driven, out=np.full(len(driven), np.nan), where=known))
    return ratio, known & (np.abs(distance - np.nan_to_num(driven)) > OFF * np.nan_to_num(driven) + step + STALE)


def _find_resolution(first: Floats, last: Floats) -> Floats:
    """Return the step in which an odometer counts, by two readings. [m]"""
    step = np.zeros(len(first))
    for size in reversed(RESOLUTIONS):
        is_multiple = np.abs(np.stack([first, last]) / size - np.round(np.stack([first, last]) / size)) * size < 1.0
        step[is_multiple.all(axis=0)] = size
    return step


def _compare_fixes(totals: Totals) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the logarithm of distance over that of the fixes, NaN where they cannot tell, and where it is clear."""
    path, run = totals.amount("path"), totals.amount("path_run")
    known = (path > LEAST_PATH) & (run > LEAST_PART * totals.amount("distance"))
    ratio = np.log(np.divide(run, path, out=np.full(len(path), np.nan), where=known))
    return ratio, known & ((run < (1.0 - SHORTER) * path - FIRST_FIXES) | (run > (1.0 + LONGER) * path + FIRST_FIXES))
