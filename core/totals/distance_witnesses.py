"""Whether odometer and fixes of a ride agree with the distance that was counted."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.totals.accumulator import Totals

MOST_DISPUTED: Final = 0.03
"""Largest share of its distance that witnesses may dispute in a ride fit for training. [1]"""
HINT: Final = 0.02
"""Logarithm of a ratio beyond which two witnesses contradict each other, beyond what each may be off. [1]"""
OFF: Final = 0.03
"""Largest deviation of the odometer: tyres and calibration take some percent. [1]"""
MUCH: Final = 0.22
"""Logarithm of the ratio by which sections between fixes contradict a shorter distance whatever the odometer says. [1]

No road is shorter than the chords between its points. Speed and odometer may have the same wrong unit."""
LEAST_TICKED: Final = 500.0
"""Distance between its changes from which an odometer is a witness. [m]"""
SLACK: Final = 30.0
"""Distance by which an odometer may be late. [m]"""
LATE: Final = 1.0
"""The same in distances between two samples."""
STRAIGHT_OFF: Final = 0.06
"""Largest deviation of the fixes on long straight roads. [1]

On 35 drives of a real Leaf with more than 4 km of straight road it is 0 to 6 % (VED, arXiv:1905.02081)."""
STRAIGHT_SLACK: Final = 60.0
"""Distance that this may be off in addition. [m]"""
LEAST_STRAIGHT: Final = 1500.0
"""Distance of straight road from which its fixes are a witness. [m]"""
SLOW_OFF: Final = 0.12
"""Largest deviation of the distance of a slow logger from that by its speeds. [1]"""
SLOW_STEPS: Final = 3.0
"""The same in addition, in distances between two samples."""
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


def find_contradicted_distance(totals: Totals) -> NDArray[np.bool_]:
    """Return where odometer or fixes contradict the distance of a ride.

    Notes
    -----
    A witness alone does not count where the other one contradicts it. Distance that was disputed during the
    ride contradicts by itself.
    """
    distance = totals.amount("distance")
    by_odometer, odometer = _compare_odometer(totals), _find_ratio(totals, "ticked", "ticked_run", LEAST_TICKED)
    by_fixes, fixes = _compare_fixes(totals), _find_ratio(totals, "path", "path_run", LEAST_PATH)
    with np.errstate(invalid="ignore"):
        between = odometer - fixes  # of the fixes over the odometer
        apart = (between > OFF + HINT) | (between < -LONGER)
    contradicted = (by_odometer | by_fixes) & ~apart | (by_odometer & by_fixes)
    with np.errstate(invalid="ignore"):
        contradicted |= fixes < -MUCH
    disputed = totals.amount("disputed") > MOST_DISPUTED * distance + FIRST_FIXES
    return np.asarray(contradicted | disputed | _contradicts_speeds(totals))


def _find_ratio(totals: Totals, witness: str, run: str, least: float) -> Floats:
    """Return the logarithm of the distance that was counted over that of a witness, NaN where it knows too little."""
    known = (totals.amount(witness) > least) & (totals.amount(run) > 0.0)
    ratio = np.divide(totals.amount(run), totals.amount(witness), out=np.full(len(known), np.nan), where=known)
    return np.asarray(np.log(ratio))


def _compare_odometer(totals: Totals) -> NDArray[np.bool_]:
    """Return where the odometer clearly contradicts the distance."""
    ticked, run = totals.amount("ticked"), totals.amount("ticked_run")
    most = OFF * ticked + SLACK + LATE * totals.share("distance", "samples")
    return np.asarray((ticked > LEAST_TICKED) & (np.abs(run - ticked) > most))


def _contradicts_speeds(totals: Totals) -> NDArray[np.bool_]:
    """Return where odometer or fixes of a slow logger show another distance than its speeds by far."""
    slow, run = totals.amount("slow"), totals.amount("slow_run")
    return np.asarray(np.abs(slow - run) > SLOW_OFF * slow + SLOW_STEPS * totals.share("distance", "samples"))


def _compare_fixes(totals: Totals) -> NDArray[np.bool_]:
    """Return where the fixes clearly contradict the distance."""
    path, run = totals.amount("path"), totals.amount("path_run")
    known = (path > LEAST_PATH) & (run > LEAST_PART * totals.amount("distance"))
    off = known & ((run < (1.0 - SHORTER) * path - FIRST_FIXES) | (run > (1.0 + LONGER) * path + FIRST_FIXES))
    straight, run = totals.amount("straight"), totals.amount("straight_run")
    most = STRAIGHT_OFF * straight + STRAIGHT_SLACK
    return np.asarray(off | ((straight > LEAST_STRAIGHT) & (np.abs(run - straight) > most)))
