"""Evaluate the risk of ending below a reserve, and the alarms that follow from it.

Few shifts fall below the reserve of their plan. The same evaluation is therefore made for other levels: the same
multiples of 10 % of charge for all shifts, whatever their outcome. Forecasts do not state the risk of falling below
these; it follows from their interval: two halves of normal distributions meet at the mean, the lower one with 5 % below
`soc_p05_pct`, the upper one with 5 % above `soc_p95_pct`.

Baselines have no risk. Each is given the risk that follows from its earlier errors
(`socast.core.evaluate.soc.baselines.compute_empirical_risk`).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from socast.core.batch import Floats
from socast.core.evaluate.records import EstimatedValue, hold_estimate
from socast.core.evaluate.soc.baselines import BASELINES, REGRESSION, compute_empirical_risk
from socast.core.evaluate.soc.cases import HOURS_AHEAD, SHIFT_KEY
from socast.core.evaluate.soc.records import (
    AlarmFigures,
    BaselineRisk,
    ClusteredShare,
    ReserveRisk,
    RiskClass,
    RiskFigures,
)
from socast.core.stats.clustered import compute_clustered_ratio, compute_clustered_share
from socast.core.stats.scores import Codes

LEVELS: Final = (20, 30, 40, 50, 60)
"""Levels that stand in for a reserve. [%]"""
PLANNED: Final = "plan"
"""Key of the reserve of the plan, whose risk the forecasts state."""
ALARM: Final = 0.05
"""Risk from which on an alarm is raised."""
BINS: Final = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
"""Edges of the classes of risk; a class includes its lower edge."""
TOLD: Final = (0.0, 0.05, 0.2, 0.5, 0.8, 1.0)
"""Edges of the coarser classes of risk in which forecasts and regression are compared."""
BOUND: Final = float(ndtri(0.95))
"""Distance from the mean of a normal distribution to its 95th percentile, in standard deviations."""


def evaluate_reserve_risk(cases: pd.DataFrame) -> ReserveRisk:
    """Return the reliability of risks and the performance of alarms.

    Notes
    -----
    A case is a forecast and a level that the vehicle had not yet fallen below when the forecast was made. The time
    ahead 0 has no cases.
    """
    rows = tabulate_levels(cases)
    hours = [h for h in HOURS_AHEAD if h > 0]
    of_levels = rows[rows["level"] != PLANNED]
    each = {name: rows[rows["level"] == name] for name in (PLANNED, *map(str, LEVELS))}
    return ReserveRisk(
        alarm=ALARM,
        reliability={PLANNED: compute_reliability(each[PLANNED]), "levels": compute_reliability(of_levels)},
        told={name: compute_reliability(of_levels, TOLD, name) for name in ("risk", REGRESSION)},
        levels={name: evaluate_by_hours(group, hours) for name, group in each.items() if len(group)},
        overall=evaluate_by_hours(of_levels, hours),
    )


def tabulate_levels(cases: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each forecast and each level.

    Returns
    -------
    DataFrame
        `level`, `hours`, `shift` and `cluster` (int), `fell` (whether the charge was below the level later), `risk` of
        the forecast, and the risk of each baseline.
    """
    open_ = cases[cases["hours"] > 0].reset_index(drop=True)
    by_level = {PLANNED: (_numbers(open_, "reserve_soc_pct"), _numbers(open_, "reserve_risk"))}
    by_level |= {str(level): (np.full(len(open_), float(level)), compute_risk_below(open_, level)) for level in LEVELS}
    levels = np.column_stack([level for level, _ in by_level.values()])
    persons = {name: _by_hour(open_, name, levels) for name in BASELINES}
    end, soc = _numbers(open_, "soc_end_pct"), _numbers(open_, "soc_pct")
    charged = np.isfinite(_numbers(open_, "charged_s"))  # the lowest charge may be from before the car charged
    lowest = np.where(charged, end, np.fmin(end, _numbers(open_, "soc_lowest_pct")))
    shift = open_.groupby(SHIFT_KEY, sort=False).ngroup()
    parts = []
    for place, (name, (level, risk)) in enumerate(by_level.items()):
        part = pd.DataFrame(
            {"level": name, "hours": open_["hours"], "shift": shift, "cluster": open_["cluster"]}
            | {"fell": lowest < level, "risk": risk}
            | {person: its[:, place] for person, its in persons.items()}
        )
        parts.append(part[np.isfinite(risk) & (soc >= level)])
    return pd.concat(parts, ignore_index=True)


def _by_hour(cases: pd.DataFrame, baseline: str, levels: Floats) -> Floats:
    """Return a baseline's risk at each level, (n, levels), from its earlier errors at the same time ahead."""
    out = np.full(levels.shape, np.nan)
    for rows in cases.groupby("hours").indices.values():
        some = cases.iloc[rows]
        expected, became = _numbers(some, baseline), _numbers(some, "soc_end_pct")
        out[rows] = compute_empirical_risk(
            expected, became, _numbers(some, "time_s"), _numbers(some, "end_s"), levels[rows]
        )
    return out


def compute_risk_below(cases: pd.DataFrame, level: float) -> Floats:
    """Return the probability of ending below a level, from the interval.

    Units: level [%].

    Examples
    --------
    >>> known = pd.DataFrame({"soc_mean_pct": [30.0], "soc_p05_pct": [20.0], "soc_p95_pct": [35.0]})
    >>> [round(float(compute_risk_below(known, level)[0]), 3) for level in (20.0, 30.0, 35.0)]
    [0.05, 0.5, 0.95]
    """
    mean, low, high = (_numbers(cases, f"soc_{name}_pct") for name in ("mean", "p05", "p95"))
    spread = np.where(level < mean, mean - low, high - mean) / BOUND
    off = level - mean
    return np.asarray(ndtr(np.divide(off, spread, out=np.where(off > 0.0, np.inf, -np.inf), where=spread > 0.0)))


def evaluate_by_hours(rows: pd.DataFrame, hours: list[int]) -> dict[str, RiskFigures]:
    """Return the figures of `evaluate_risk` at each time ahead that has cases, and `pooled` over all."""
    by_hours = {str(h): evaluate_risk(group) for h in hours if len(group := rows[rows["hours"] == h])}
    return by_hours | ({"pooled": evaluate_risk(rows)} if len(rows) else {})


def evaluate_risk(rows: pd.DataFrame) -> RiskFigures:
    """Return the scores of risks, and of the alarms that follow from them."""
    fell, risk = rows["fell"].to_numpy(bool), _numbers(rows, "risk")
    clusters = rows["cluster"].to_numpy(np.int64)
    squares, share = (risk - fell) ** 2, float(fell.mean())
    persons = {}
    for name in BASELINES:
        its = _numbers(rows, name)
        known = np.isfinite(its)
        lost = (its - fell)[known] ** 2
        persons[name] = BaselineRisk(
            n=known.sum(),
            fell=fell[known].sum(),
            brier=lost.mean() if known.any() else None,
            forecast_brier=squares[known].mean() if known.any() else None,
            skill=compute_skill(squares[known], lost, clusters[known]),
            alarms=evaluate_alarms(its[known], fell[known], clusters[known]),
            forecast_alarms=evaluate_alarms(risk[known], fell[known], clusters[known]),
        )
    return RiskFigures(
        n=len(rows),
        shifts=rows["shift"].nunique(),
        fell=fell.sum(),
        alarms=evaluate_alarms(risk, fell, clusters),
        brier=squares.mean(),
        brier_base=share * (1.0 - share),
        skill=compute_skill(squares, (share - fell) ** 2, clusters),
        baselines=persons,
    )


def compute_skill(squares: Floats, reference: Floats, clusters: Codes) -> EstimatedValue:
    """Return by which share a mean square is below that of a reference."""
    return hold_estimate(compute_clustered_ratio(reference - squares, reference, clusters))


def hold_share(holds: NDArray[np.bool_], clusters: Codes) -> ClusteredShare:
    """Return the share of cases of which a condition holds."""
    return msgspec.convert(compute_clustered_share(holds, clusters), ClusteredShare)


def evaluate_alarms(risk: Floats, fell: NDArray[np.bool_], clusters: Codes) -> AlarmFigures:
    """Return the performance of alarms."""
    warned = risk >= ALARM
    return AlarmFigures(
        caught=int(np.sum(warned & fell)),
        missed=int(np.sum(~warned & fell)),
        false_alarms=int(np.sum(warned & ~fell)),
        hit_rate=hold_share(warned[fell], clusters[fell]),
        false_alarm_rate=hold_share(warned[~fell], clusters[~fell]),
    )


def compute_reliability(
    rows: pd.DataFrame, edges: Sequence[float] = BINS, risk_column: str = "risk"
) -> list[RiskClass]:
    """Return, for each class of risk that has cases, how often these fell below the level."""
    rows = rows[rows[risk_column].notna()]
    risk, clusters = _numbers(rows, risk_column), rows["cluster"].to_numpy(np.int64)
    place = np.clip(np.searchsorted(edges, risk, side="right") - 1, 0, len(edges) - 2)
    return [
        RiskClass(
            low=low,
            high=high,
            n=mine.sum(),
            shifts=rows["shift"][mine].nunique(),
            told=risk[mine].mean(),
            fell=hold_share(rows["fell"].to_numpy(bool)[mine], clusters[mine]),
        )
        for code, (low, high) in enumerate(pairwise(edges))
        if (mine := place == code).any()
    ]


def _numbers(cases: pd.DataFrame, column: str) -> Floats:
    return cases[column].to_numpy(np.float64)
