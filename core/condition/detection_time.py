"""Foresee how many days after a campaign a change of consumption takes to be seen."""

from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np
from scipy.special import ndtri

from socast.core.batch import Ints
from socast.core.condition.campaign import BEFORE, States
from socast.core.condition.campaign_records import DetectionTime
from socast.core.condition.step_fit import DeviationPanel, compute_wander, weigh_step

POWER: Final = 0.8
"""Probability with which the 90 % interval then excludes zero. [1]"""
LONGEST_DAYS: Final = 366
"""Longest time after which a change may be seen. [d]"""


def foresee_detection(
    panel: DeviationPanel, states: States, rows: list[int], siblings: Ints, scale: float, sizes: tuple[float, ...]
) -> list[DetectionTime]:
    """Return how many days after the date changes of these sizes take to be seen."""
    errors = [_foresee_error(panel, row, states[row]) for row in rows]
    shared = 1.0 / (float(siblings[rows].min()) + 1.0)  # of the error of several cars beside the same siblings

    @cache  # the search for each size begins with the same days
    def compute_error(days: int) -> float:
        variance = float(np.mean([error(days) ** 2 for error in errors]))
        return scale * (variance * (shared + (1.0 - shared) / len(rows))) ** 0.5

    factor = float(ndtri(0.95) + ndtri(POWER))
    return [DetectionTime(size=size, days=_search(compute_error, np.log1p(size) / factor)) for size in sizes]


def _foresee_error(panel: DeviationPanel, row: int, state: States) -> Callable[[int], float]:
    """Return the function that gives the standard error of the change of a car after some days. [d]"""
    known = np.isfinite(panel.value[row])
    used = known & (state == BEFORE)
    used[: np.flatnonzero(used)[-1] - LONGEST_DAYS + 1 if used.sum() > LONGEST_DAYS else 0] = False
    dates = panel.dates[known]
    a_day = len(dates) / float(dates[-1] - dates[0] + 1)
    noise = 1.0 / float(np.mean(1.0 / panel.noise[row, known])) / a_day
    before = panel.dates[used]

    def compute_error(days: int) -> float:
        later = before[-1] + 1 + np.arange(1, days + 1)
        wander = compute_wander(np.concatenate((before, later)), panel.found)
        variances = np.concatenate((panel.noise[row, used], np.full(days, noise)))
        return weigh_step(wander, variances, np.arange(len(variances)) >= len(before))[1] ** 0.5

    return compute_error


def _search(compute_error: Callable[[int], float], largest: float) -> int | None:
    """Return the least number of days after which the error is small enough."""
    low, high = 0, LONGEST_DAYS
    if compute_error(high) > largest:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if compute_error(middle) <= largest else (middle, high)
    return high
