"""Whether the forecasts warned of shifts that fell below a reserve, and how often for nothing.

Few shifts fall below the reserve of a plan, so other levels are looked at beside it. The risk of falling below one of
these is not told by a forecast; it follows from its interval: two halves of a normal distribution meet at the mean, the
lower one with 5 % below `soc_p05_pct`, the upper one with 5 % above `soc_p95_pct`.
"""

from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri

from core.batch import Floats
from core.evaluate.soc_judged import HOURS

LEVELS: Final = (20, 30, 40)
"""Levels that stand in for a reserve. [%]"""
PLANNED: Final = "plan"
"""Stands for the reserve of the plan, and the risk that forecasts tell."""
ALARM: Final = 0.05
"""A risk from which on a dispatcher is warned."""
BOUND: Final = float(ndtri(0.95))
"""Standard deviations from the mean of a normal distribution to its 95th percentile."""


def reserve(cases: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Return, of each level and each time ahead, what alarms were worth.

    Returns
    -------
    dict of str to dict
        Level -> hours -> `shifts` that were at or above it at the time of the forecast; those that `fell` below it
        later, of them `caught` with an alarm; `false_alarms` of the others; `brier` score of the risk, and
        `brier_base` of one who tells every shift the share of those that fell.
    """
    told = {PLANNED: (_numbers(cases, "reserve_soc_pct"), _numbers(cases, "reserve_risk"))}
    for level in LEVELS:
        told[str(level)] = (np.full(len(cases), float(level)), risk_below(cases, level))
    hours = cases["hours"].to_numpy()
    found = {
        name: {str(h): alarms(cases[hours == h], level[hours == h], risk[hours == h]) for h in HOURS}
        for name, (level, risk) in told.items()
    }
    asked = {name: {h: own for h, own in of.items() if own["shifts"]} for name, of in found.items()}
    return {name: of for name, of in asked.items() if of}


def risk_below(cases: pd.DataFrame, level: float) -> Floats:
    """Return the probability of ending below a level, by the interval.

    Parameters
    ----------
    cases : DataFrame
        With `soc_mean_pct`, `soc_p05_pct` and `soc_p95_pct`.
    level : float
        [%]

    Returns
    -------
    (n,) float64
        0 or 1 where the interval has no width.

    Examples
    --------
    >>> known = pd.DataFrame({"soc_mean_pct": [30.0], "soc_p05_pct": [20.0], "soc_p95_pct": [35.0]})
    >>> [round(float(risk_below(known, level)[0]), 3) for level in (20.0, 30.0, 35.0)]
    [0.05, 0.5, 0.95]
    """
    mean, low, high = (_numbers(cases, f"soc_{name}_pct") for name in ("mean", "p05", "p95"))
    spread = np.where(level < mean, mean - low, high - mean) / BOUND
    off = level - mean
    risk: Floats = ndtr(np.divide(off, spread, out=np.where(off > 0.0, np.inf, -np.inf), where=spread > 0.0))
    return risk


def alarms(cases: pd.DataFrame, level: Floats, risk: Floats) -> dict[str, Any]:
    """Return what alarms at one level and one time ahead were worth.

    Parameters
    ----------
    cases : DataFrame
    level : (n,) float
        [%]
    risk : (n,) float
        Told probability of falling below it; NaN where it is not told.
    """
    asked = np.isfinite(risk) & (_numbers(cases, "soc_pct") >= level)
    fell = (_lowest(cases) < level)[asked]
    warned, told = risk[asked] >= ALARM, risk[asked]
    n, crossed = len(fell), int(fell.sum())
    base = crossed / n if n else np.nan
    return {
        "shifts": n,
        "fell": crossed,
        "caught": int(np.sum(warned & fell)),
        "false_alarms": int(np.sum(warned & ~fell)),
        "brier": float(np.mean((told - fell) ** 2)) if n else np.nan,
        "brier_base": base * (1.0 - base),
    }


def _lowest(cases: pd.DataFrame) -> Floats:
    """Return the lowest state of charge after a forecast: after a charge the end's, as the lowest may be before it."""
    end, lowest = _numbers(cases, "soc_end_pct"), _numbers(cases, "soc_lowest_pct")
    return np.where(np.isfinite(_numbers(cases, "charged_s")), end, np.fmin(end, lowest))


def _numbers(cases: pd.DataFrame, column: str) -> Floats:
    return cases[column].to_numpy(np.float64)
