"""Whether the risk of ending below a reserve holds, and what alarms are worth.

Few shifts fall below the reserve of their plan, so the same is asked of other levels: every ten per cent of charge, the
same for all shifts, whatever became of them. The risk of falling below one of these is not told by a forecast; it
follows from its interval: two halves of a normal distribution meet at the mean, the lower one with 5 % below
`soc_p05_pct`, the upper one with 5 % above `soc_p95_pct`.

What a person would expect comes without a risk. It is given the one that a person has who remembers how far the same
reckoning was off so far, see `core.evaluate.soc.baselines.compute_empirical_risk`.
"""

from itertools import pairwise
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from core.batch import Floats
from core.evaluate.soc.baselines import BASELINES, compute_empirical_risk
from core.evaluate.soc.cases import HOURS_AHEAD, SHIFT_KEY
from core.stats.clustered import compute_clustered_ratio, compute_clustered_share
from core.stats.scores import Codes

LEVELS: Final = (20, 30, 40, 50, 60)
"""Levels that stand in for a reserve. [%]"""
PLANNED: Final = "plan"
"""Stands for the reserve of the plan, and the risk that forecasts tell."""
ALARM: Final = 0.05
"""A risk from which on a dispatcher is warned."""
BINS: Final = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
"""Ends of the classes of risk; the lower end belongs to a class."""
BOUND: Final = float(ndtri(0.95))
"""Standard deviations from the mean of a normal distribution to its 95th percentile."""


def evaluate_reserve_risk(cases: pd.DataFrame) -> dict[str, Any]:
    """Return whether risks hold, and what alarms are worth.

    Parameters
    ----------
    cases : DataFrame
        Of `core.evaluate.soc.cases.select_cases`, with what each baseline expects.

    Returns
    -------
    dict
        `alarm`, the risk from which on there is one; `compute_reliability` by class of risk, all times ahead pooled, of the
        plan's reserve and of all other `levels`; what risks were worth (`evaluate_risk`) by level and time ahead, `levels`, and
        by time ahead, `overall`, without the plan's. A case is a forecast and a level that the car was not below when
        it was made; at the end itself nothing is open.
    """
    rows = tabulate_levels(cases)
    hours = [h for h in HOURS_AHEAD if h > 0]
    of_levels = rows[rows["level"] != PLANNED]
    each = {name: rows[rows["level"] == name] for name in (PLANNED, *map(str, LEVELS))}
    return {
        "alarm": ALARM,
        "reliability": {PLANNED: compute_reliability(each[PLANNED]), "levels": compute_reliability(of_levels)},
        "levels": {name: evaluate_by_hours(own, hours) for name, own in each.items() if len(own)},
        "overall": evaluate_by_hours(of_levels, hours),
    }


def tabulate_levels(cases: pd.DataFrame) -> pd.DataFrame:
    """Return a row a forecast and a level that it is asked about.

    Columns: `level`, `hours`, `shift` and `cluster` (int, alike for those of the same), `fell` (whether the charge was
    below the level later), `risk` (told), and the risk by each baseline.
    """
    open_ = cases[cases["hours"] > 0].reset_index(drop=True)
    told = {PLANNED: (_numbers(open_, "reserve_soc_pct"), _numbers(open_, "reserve_risk"))}
    told |= {str(level): (np.full(len(open_), float(level)), compute_risk_below(open_, level)) for level in LEVELS}
    levels = np.column_stack([level for level, _ in told.values()])
    persons = {name: _by_hour(open_, name, levels) for name in BASELINES}
    lowest, soc = _lowest(open_), _numbers(open_, "soc_pct")
    shift = open_.groupby(SHIFT_KEY, sort=False).ngroup()
    parts = []
    for place, (name, (level, risk)) in enumerate(told.items()):
        part = pd.DataFrame(
            {"level": name, "hours": open_["hours"], "shift": shift, "cluster": open_["cluster"]}
            | {"fell": lowest < level, "risk": risk}
            | {person: its[:, place] for person, its in persons.items()}
        )
        parts.append(part[np.isfinite(risk) & (soc >= level)])
    return pd.concat(parts, ignore_index=True)


def _by_hour(cases: pd.DataFrame, baseline: str, levels: Floats) -> Floats:
    """Return a baseline's risk at each level, (n, levels), by its earlier errors as long before the end."""
    out = np.full(levels.shape, np.nan)
    for rows in cases.groupby("hours").indices.values():
        own = cases.iloc[rows]
        expected, became = _numbers(own, baseline), _numbers(own, "soc_end_pct")
        out[rows] = compute_empirical_risk(
            expected, became, _numbers(own, "time_s"), _numbers(own, "end_s"), levels[rows]
        )
    return out


def compute_risk_below(cases: pd.DataFrame, level: float) -> Floats:
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
    >>> [round(float(compute_risk_below(known, level)[0]), 3) for level in (20.0, 30.0, 35.0)]
    [0.05, 0.5, 0.95]
    """
    mean, low, high = (_numbers(cases, f"soc_{name}_pct") for name in ("mean", "p05", "p95"))
    spread = np.where(level < mean, mean - low, high - mean) / BOUND
    off = level - mean
    risk: Floats = ndtr(np.divide(off, spread, out=np.where(off > 0.0, np.inf, -np.inf), where=spread > 0.0))
    return risk


def evaluate_by_hours(rows: pd.DataFrame, hours: list[int]) -> dict[str, Any]:
    """Return what risks and alarms were worth at each time ahead that has cases, and `pooled` over all."""
    found = {str(h): evaluate_risk(own) for h in hours if len(own := rows[rows["hours"] == h])}
    return found | ({"pooled": evaluate_risk(rows)} if len(rows) else {})


def evaluate_risk(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the risks of some cases were worth, and alarms by them.

    Returns
    -------
    dict
        `n` cases, of `shifts`, of which so many `fell`; the `evaluate_alarms` (see `evaluate_alarms`); `brier` score of the risk,
        `brier_base` of one who tells all the share of those that fell, and `compute_skill` over it; of each of `baselines`,
        where it has a risk, `n`, `fell`, `brier`, `evaluate_alarms`, the forecasts' own `forecast_brier` and `forecast_alarms`
        there, and their `compute_skill` over it.
    """
    fell, risk = rows["fell"].to_numpy(bool), _numbers(rows, "risk")
    clusters = rows["cluster"].to_numpy(np.int64)
    own, share = (risk - fell) ** 2, float(fell.mean())
    persons = {}
    for name in BASELINES:
        its = _numbers(rows, name)
        known = np.isfinite(its)
        lost = (its - fell)[known] ** 2
        persons[name] = {
            "n": int(known.sum()),
            "fell": int(fell[known].sum()),
            "brier": float(lost.mean()) if known.any() else np.nan,
            "forecast_brier": float(own[known].mean()) if known.any() else np.nan,
            "skill": compute_skill(own[known], lost, clusters[known]),
            "alarms": evaluate_alarms(its[known], fell[known], clusters[known]),
            "forecast_alarms": evaluate_alarms(risk[known], fell[known], clusters[known]),
        }
    return {
        "n": len(rows),
        "shifts": int(rows["shift"].nunique()),
        "fell": int(fell.sum()),
        "alarms": evaluate_alarms(risk, fell, clusters),
        "brier": float(own.mean()),
        "brier_base": share * (1.0 - share),
        "skill": compute_skill(own, (share - fell) ** 2, clusters),
        "baselines": persons,
    }


def compute_skill(own: Floats, reference: Floats, clusters: Codes) -> dict[str, float]:
    """Return by how much, as a share, a mean square is below that of a reference, with half its 95 % interval."""
    return compute_clustered_ratio(reference - own, reference, clusters).figures()


def evaluate_alarms(risk: Floats, fell: NDArray[np.bool_], clusters: Codes) -> dict[str, Any]:
    """Return what alarms were worth.

    Returns
    -------
    dict
        How many were `caught` and `missed` of those that fell, and `false_alarms` of those that did not; of those that
        fell the share that was caught, `hit_rate`, and of those that did not the share with an alarm,
        `false_alarm_rate`, with intervals.
    """
    warned = risk >= ALARM
    return {
        "caught": int(np.sum(warned & fell)),
        "missed": int(np.sum(~warned & fell)),
        "false_alarms": int(np.sum(warned & ~fell)),
        "hit_rate": compute_clustered_share(warned[fell], clusters[fell]),
        "false_alarm_rate": compute_clustered_share(warned[~fell], clusters[~fell]),
    }


def compute_reliability(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return, of each class of told risk that has cases, how many there are and how often they fell.

    Returns
    -------
    list of dict
        Its ends `low` and `high`; `n` cases of `shifts`; mean risk that was `told`; `fell`, the share that did, with
        its interval.
    """
    risk, clusters = _numbers(rows, "risk"), rows["cluster"].to_numpy(np.int64)
    place = np.clip(np.searchsorted(BINS, risk, side="right") - 1, 0, len(BINS) - 2)
    found = []
    for code, (low, high) in enumerate(pairwise(BINS)):
        mine = place == code
        if mine.any():
            fell = compute_clustered_share(rows["fell"].to_numpy(bool)[mine], clusters[mine])
            shifts = int(rows["shift"][mine].nunique())
            told = float(risk[mine].mean())
            found.append({"low": low, "high": high, "n": int(mine.sum()), "shifts": shifts, "told": told, "fell": fell})
    return found


def _lowest(cases: pd.DataFrame) -> Floats:
    """Return the lowest state of charge after a forecast: after a charge the end's, as the lowest may be before it."""
    end, lowest = _numbers(cases, "soc_end_pct"), _numbers(cases, "soc_lowest_pct")
    return np.where(np.isfinite(_numbers(cases, "charged_s")), end, np.fmin(end, lowest))


def _numbers(cases: pd.DataFrame, column: str) -> Floats:
    return cases[column].to_numpy(np.float64)
