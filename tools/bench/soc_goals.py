"""State the goals of forecasts of the state of charge, and measure them on judged fleets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.evaluate.binning import bin_values
from socast.core.evaluate.soc.baselines import PERSONS, REGRESSION
from socast.core.evaluate.soc.records import ImpossibleBounds
from socast.core.evaluate.soc.report import TEMPERATURES, compute_interval_score
from socast.core.evaluate.soc.reserve_risk import ALARM, PLANNED, tabulate_levels
from socast.core.stats.clustered import compute_clustered_share
from socast.tools.bench.figures.published import write_goal, write_verdict
from socast.tools.bench.soc_reference import REFERENCE
from socast.tools.simulator.settings import COLD_SNAP, FLEETS

MAIN: Final = ("autumn", "small", "preset")
"""Fleets on which settled weather and all days count."""
AHEAD: Final = 2
"""Time ahead at which forecasts are compared. [h]"""
FEWEST: Final = 30
"""Number of forecasts from which a temperature band counts."""
FIRST_DAYS: Final = 3
NEW_CAR_DAYS: Final = 5
"""Days for which a car that has joined counts as new."""
FAULTY: Final = {"frozen": "frozen SOC", "absent": "absent SOC", "jumping": "jumping SOC"}
FEWEST_SHOWN: Final = 10
"""Number of forecasts from which a time ahead is shown."""
FEWEST_FAULTY: Final = 20
"""Number of forecasts without which a fault counts as not forecast."""
TROUBLES: Final = {
    "autumn-no-plan": "no plan",
    "autumn-no-shows": "no-shows",
    "autumn-plans": "plans 50 % wrong",
    "autumn-way-home": "unplanned way home",
}
NO_PLANS: Final = ", no plans"
"""Ends the name of a recording whose plans were left out."""
NO_CHARGES: Final = FLEETS["autumn"]
"""Fleet without planned charges."""
MOST_CHANGE: Final = 1.0
"""Largest change of the forecast of a healthy car through faults of others. [%]"""
CHANGED: Final = {"forecasts": ("soc_mean_pct",), "bounds": ("soc_p05_pct", "soc_p95_pct")}
"""What may change -> its columns."""

OURS: Final = "soc"
"""Begins the columns of the forecaster, as the name of a baseline begins its own."""
COMPARED: Final = ["vehicle_id", "time_s", "soc_mean_pct", "soc_p05_pct", "soc_p95_pct"]
"""Columns of the forecasts that are compared between a fleet with and without faults."""


@dataclass(frozen=True)
class Judged:
    """Hold what a fleet with one seed gave.

    Parameters
    ----------
    first_day_s : float
        Midnight before its first day. [Unix s]
    cases, unlearned : DataFrame
        Forecasts with outcome and baselines, and those without an interval, of `socast.core.evaluate.soc.cases`.
    seconds : float
        Time that simulation and forecasts took. [s]
    to_charge, over_charge : DataFrame
        Forecasts around planned charges with outcome and baselines, of `socast.core.evaluate.soc.planned_charges`.
    """

    fleet: str
    seed: int
    first_day_s: float
    cases: pd.DataFrame
    unlearned: pd.DataFrame
    legs: pd.DataFrame
    forecasts: pd.DataFrame
    bounds: ImpossibleBounds
    seconds: float
    to_charge: pd.DataFrame = field(default_factory=pd.DataFrame)
    over_charge: pd.DataFrame = field(default_factory=pd.DataFrame)


class Line(NamedTuple):
    """Hold a goal, what was measured, and whether the goal is met (`met`, `missed`, or empty without a goal)."""

    fleet: str
    what: str
    goal: str
    measured: str
    verdict: str


def check_goals(judged: Sequence[Judged]) -> list[Line]:
    """Return a line for each goal that the judged fleets can measure."""
    lines: list[Line] = []
    for fleet in dict.fromkeys(one.fleet for one in judged):
        mine = [one for one in judged if one.fleet == fleet]
        cases = _pool(mine, "cases")
        if not len(cases):
            lines.append(Line(fleet, "forecasts with an interval", "", "none", "missed"))
            continue
        if fleet in MAIN:
            lines += _check_main(fleet, cases)
            lines += _check_risk(fleet, cases)
        if fleet not in FLEETS and fleet not in MAIN:
            lines += _check_recording(fleet, cases)
        lines += _check_days(fleet, mine, cases)
        lines += _check_trouble(fleet, cases)
        if FLEETS.get(fleet, NO_CHARGES).conditions.planned_charges:
            lines += _check_last_legs(fleet, _pool(mine, "legs"))
            lines += _check_to_charge(fleet, _pool(mine, "to_charge"))
            lines += _check_over_charge(fleet, _pool(mine, "over_charge"))
        lines.append(_check_bounds(fleet, mine))
    return lines + _check_healthy(judged)


def _pool(judged: Sequence[Judged], name: str) -> pd.DataFrame:
    """Return a table of several seeds, with clusters and days of their own."""
    parts, base = [], 0
    for one in judged:
        part = getattr(one, name)
        if not len(part):
            continue
        day = np.floor((part["begin_s"] - one.first_day_s) / SECONDS_PER_DAY) if one.first_day_s else np.nan
        names = part["vehicle_id"].astype(str) + f"/{one.seed}"
        parts.append(part.assign(day=day, seed=one.seed, vehicle_id=names, cluster=part["cluster"] + base))
        base += int(part["cluster"].max()) + 1
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _check_main(fleet: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield error, score, coverage and width, beside those of the baselines."""
    for hours in (0.5, 1, AHEAD, 4):
        rows, goals = cases[cases["hours"] == hours], hours == AHEAD
        if len(rows) < FEWEST_SHOWN:
            continue
        where = f"{hours:g} h ahead"
        for baseline, less in ((REGRESSION, 0.20), (REFERENCE, 0.10)):
            yield _less(fleet, f"{where}: MAE against {baseline}", less if goals else None, *_both(rows, baseline))
        yield from _beat_persons(fleet, where, 0.40 if goals else None, rows)
        both = rows[rows["regression_p05"].notna()]
        if len(both):
            scores = _score(both, OURS), _score(both, REGRESSION)
            yield _less(fleet, f"{where}: interval score against regression", 0.25 if goals else None, *scores)
            yield _share(fleet, f"{where}: coverage of regression", None, _held(both, REGRESSION), both)
            yield _width(fleet, where, both, whose=REGRESSION)
        yield _share(fleet, f"{where}: coverage", (0.88, 0.92), _held(rows), rows)
        yield _width(fleet, where, rows, 9.0 if goals and fleet == "autumn" else None)
        yield from _check_bands(fleet, rows, where, goals)


def _check_recording(name: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield error, coverage and width of a recording of real cars."""
    if name.endswith(NO_PLANS):
        ahead = cases[cases["hours"] > 0]
        yield _share(name, "0.5 to 6 h ahead: coverage", (0.85, 1.0), _held(ahead), ahead)
        error = f"{_error(ahead, 'soc_mean_pct').mean():.1f}"
        yield Line(name, "0.5 to 6 h ahead: MAE", "", error, "")
        yield _bias(name, "0.5 to 6 h ahead", ahead)
        yield _width(name, "0.5 to 6 h ahead", ahead)
        return
    for hours in (0.5, 1, AHEAD):
        rows, where = cases[cases["hours"] == hours], f"{hours:g} h ahead"
        for baseline in ("rating", REGRESSION, REFERENCE):
            yield _less(name, f"{where}: MAE against {baseline}", 0.0, *_both(rows, baseline))
        if len(rows):
            yield _bias(name, where, rows)
        yield _share(name, f"{where}: coverage", (0.85, 0.93) if hours == 1 else None, _held(rows), rows)
        if len(rows):
            yield _width(name, where, rows, 15.0 if hours == 1 else None)


def _check_bands(fleet: str, rows: pd.DataFrame, where: str, goals: bool) -> Iterator[Line]:
    """Yield coverage, bias and error of each band of temperature with enough forecasts."""
    band = bin_values(rows["ambient_c"].to_numpy(np.float64), TEMPERATURES)
    for code in np.unique(band.codes[band.codes >= 0]).tolist() if goals else ():
        mine = rows[band.codes == code]
        if len(mine) >= FEWEST:
            what = f"{where}: coverage, {band.labels[code]} °C"
            yield _share(fleet, what, (0.85, 1.0), _held(mine), mine)
            yield _bias(fleet, f"{where}, {band.labels[code]} °C", mine)
            for baseline in (REGRESSION, REFERENCE):
                name = f"{where}: MAE against {baseline}, {band.labels[code]} °C"
                yield _less(fleet, name, 0.0, *_both(mine, baseline))


def _check_risk(fleet: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield how good alarms are, how often told risks happened, and the Brier score beside that of the regression."""
    rows = tabulate_levels(cases)
    planned, rows = rows[rows["level"] == PLANNED], rows[rows["level"] != PLANNED]
    for what, mine, bounds in (
        ("caught", planned[planned["fell"]], (0.98, 1.0)),
        ("false", planned[~planned["fell"]], (0.0, 0.02)),
    ):
        if len(mine):
            words = f"alarm at a risk of {100 * ALARM:.0f} % for the reserve of the plan: {what}"
            yield _share(fleet, words, bounds, mine["risk"].to_numpy() >= ALARM, mine)
    for (low, high), goal in {(0.05, 0.2): (0.03, 0.25), (0.5, 0.8): (0.45, 0.85)}.items():
        for column, name in {"risk": "", REGRESSION: " by the regression"}.items():
            told = rows[(rows[column] >= low) & (rows[column] < high)]
            if len(told):
                what = f"risk told {100 * low:.0f} to {100 * high:.0f} %{name}: happened"
                yield _share(fleet, what, None if name else goal, told["fell"].to_numpy(bool), told)
    known = rows[rows[REGRESSION].notna()]
    if len(known):
        fell = known["fell"].to_numpy(np.float64)
        squares = ((known["risk"] - fell) ** 2).to_numpy(), ((known[REGRESSION] - fell) ** 2).to_numpy()
        yield _less(fleet, "Brier score against regression", 0.0, *squares, digits=4)


def _check_days(fleet: str, judged: Sequence[Judged], cases: pd.DataFrame) -> Iterator[Line]:
    """Yield the coverage of the first days of a fleet, of a spell and of a car that has joined."""
    ahead = cases[cases["hours"] > 0]
    if fleet in MAIN and ahead["day"].notna().any():
        unlearned = _pool(judged, "unlearned")
        none = len(unlearned[(unlearned["hours"] > 0) & (unlearned["day"] < FIRST_DAYS)]) if len(unlearned) else 0
        early = ahead[ahead["day"] < FIRST_DAYS]
        what = f"first {FIRST_DAYS} days: coverage ({none} of {none + len(early)} forecasts have no interval)"
        if none + len(early):
            line = _share(fleet, what, (0.85, 1.0), _held(early), early)
            yield line._replace(verdict="missed" if none else line.verdict)
    if fleet in ("autumn", "autumn-heat"):
        spell = "cold snap" if fleet == "autumn" else "heat wave"
        for hours, name in ((AHEAD, f"{AHEAD} h ahead"), (None, "1 to 6 h ahead")):
            first = ahead[(ahead["day"] == COLD_SNAP.day) & ((ahead["hours"] == hours) | (hours is None))]
            if len(first):
                where = f"first day of the {spell}, {name}"
                yield _share(fleet, f"{where}: coverage", (0.8, 1.0), _held(first), first)
                yield _bias(fleet, where, first, 5.0)
                yield _width(fleet, where, first)
                known = first[first["regression_p05"].notna()]
                if len(known):
                    yield _share(fleet, f"{where}: coverage of regression", None, _held(known, REGRESSION), known)
                    yield _bias(fleet, where, known, whose=REGRESSION)
                empty = float((first["soc_end_pct"] <= 0.0).mean())
                yield Line(fleet, f"{where}: share that ended empty", "", f"{100 * empty:.0f} %", "")
    if fleet == "autumn":
        joined = ahead.groupby("vehicle_id")["day"].transform("min")
        new = ahead[(joined > FIRST_DAYS * 3) & (ahead["day"] < joined + NEW_CAR_DAYS)]
        if len(new):
            yield _share(fleet, f"new car, first {NEW_CAR_DAYS} days: coverage", (0.85, 1.0), _held(new), new)


def _check_trouble(fleet: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield the coverage of forecasts where plans or displays go wrong."""
    ahead = cases[cases["hours"] > 0]
    if fleet in TROUBLES:
        yield _share(fleet, f"{TROUBLES[fleet]}: coverage", (0.85, 1.0), _held(ahead), ahead)
        yield _less(fleet, f"{TROUBLES[fleet]}: MAE against regression", None, *_both(ahead, REGRESSION))
    for fault, name in FAULTY.items() if fleet == "autumn-faults" else ():
        mine = ahead[ahead["fault"] == fault]
        if len(mine):
            line = _share(fleet, f"{name}: coverage", (0.85, 1.0), _held(mine), mine)
            yield line._replace(verdict="missed" if len(mine) < FEWEST_FAULTY else line.verdict)
            yield _width(fleet, name, mine)
        else:
            yield Line(fleet, f"{name}: coverage", ">= 85 %", "no forecast with an interval", "missed")


def _check_last_legs(fleet: str, legs: pd.DataFrame) -> Iterator[Line]:
    """Yield coverage and error of the last leg before the next charge."""
    if not len(legs) or not legs["charges"].any():
        yield Line(fleet, "last leg before a charge: coverage", "88 to 92 %", "no forecast", "missed")
        return
    later = legs[legs["charges"]].sort_values("leg", kind="stable")
    last = later.drop_duplicates(["vehicle_id", "time_s"], keep="last")
    last = last[last["minutes"] >= 30.0]
    if len(last):
        yield _share(fleet, "last leg before a charge: coverage", (0.88, 0.92), _held(last), last)
        yield _less(fleet, "last leg before a charge: MAE against regression", 0.20, *_both(last, REGRESSION))


def _check_to_charge(fleet: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield coverage, error and width of forecasts of the charge when the next planned charge begins."""
    if not len(cases):
        yield Line(fleet, "to the next charge: coverage", "88 to 92 %", "no forecast", "missed")
        return
    for hours in (1, AHEAD, 4):
        rows, where = cases[cases["hours"] == hours], f"to the next charge, {hours} h ahead"
        if len(rows) < FEWEST_SHOWN:
            continue
        goals = hours == AHEAD
        yield _share(fleet, f"{where}: coverage", (0.88, 0.92) if goals else None, _held(rows), rows)
        yield _less(fleet, f"{where}: MAE against regression", 0.20 if goals else None, *_both(rows, REGRESSION))
        yield from _beat_persons(fleet, where, 0.40 if goals else None, rows)
        yield _width(fleet, where, rows)


def _check_over_charge(fleet: str, cases: pd.DataFrame) -> Iterator[Line]:
    """Yield coverage, error and width of forecasts for the end of the shift over a planned charge."""
    for hours in (1, AHEAD, 4) if len(cases) else ():
        rows, where = cases[cases["hours"] == hours], f"end after a planned charge, {hours} h ahead"
        if len(rows) < FEWEST_SHOWN:
            continue
        goals = hours == AHEAD
        yield _share(fleet, f"{where}: coverage", (0.88, 0.92) if goals else None, _held(rows), rows)
        what = f"{where}: MAE against a person (planned charge)"
        yield _less(fleet, what, 0.40 if goals else None, *_both(rows, "model_mean"))
        yield _width(fleet, where, rows)


def _beat_persons(fleet: str, where: str, goal: float | None, rows: pd.DataFrame) -> Iterator[Line]:
    """Yield the error beside that of the best rule of a person."""
    known = rows.dropna(subset=list(PERSONS))
    if len(known):
        best = min(PERSONS, key=lambda name: float(_error(known, name).mean()))
        yield _less(fleet, f"{where}: MAE against best person ({best})", goal, *_both(known, best))


def _bias(fleet: str, where: str, rows: pd.DataFrame, most: float | None = None, whose: str = OURS) -> Line:
    """Return the line of the mean error. [%]"""
    mean, of = (rows["soc_mean_pct"], "") if whose == OURS else (rows[whose], f" of {whose}")
    bias = float((mean - rows["soc_end_pct"]).mean())
    goal, verdict = ("", "") if most is None else (f"within {most:g}", write_verdict(abs(bias) <= most))
    return Line(fleet, f"{where}: bias{of}", goal, f"{bias:+.1f}", verdict)


def _width(fleet: str, where: str, rows: pd.DataFrame, most: float | None = None, whose: str = OURS) -> Line:
    """Return the line of the median width of intervals. [%]"""
    low, high = _find_ends(rows, whose)
    width, of = float((high - low).median()), "" if whose == OURS else f" of {whose}"
    goal, verdict = ("", "") if most is None else (f"<= {most:g}", write_verdict(width <= most))
    return Line(fleet, f"{where}: median width{of}", goal, f"{width:.1f}", verdict)


def _check_bounds(fleet: str, judged: Sequence[Judged]) -> Line:
    """Return how often an upper bound was above the present charge without a charge ahead."""
    above, n = (sum(getattr(one.bounds, name) for one in judged) for name in ("above", "n"))
    largest = max(one.bounds.largest for one in judged)
    told = f"{above:,} of {n:,}, at most by {largest:.1f}"
    return Line(fleet, "upper bound above the present charge", "never", told, write_verdict(above == 0))


def _check_healthy(judged: Sequence[Judged]) -> list[Line]:
    """Return how much the faults of other cars changed the forecasts of healthy cars."""
    pairs = [
        (faulty, healthy)
        for faulty in judged
        for healthy in judged
        if (faulty.fleet, healthy.fleet) == ("autumn-faults", "autumn-short") and faulty.seed == healthy.seed
    ]
    if not pairs:
        return []
    return [_compare_healthy(pairs, what, names) for what, names in CHANGED.items()]


def _compare_healthy(pairs: list[tuple[Judged, Judged]], what: str, names: Sequence[str]) -> Line:
    """Return how much columns of the forecasts of healthy cars differ between a fleet with faults and one without."""
    changes: list[Floats] = []
    for faulty, healthy in pairs:
        ill = set(faulty.cases.loc[faulty.cases["fault"] != "", "vehicle_id"]) | {"taxi-001", "taxi-002", "taxi-003"}
        both = faulty.forecasts.merge(healthy.forecasts, on=["vehicle_id", "time_s"], suffixes=("", "_healthy"))
        both = both[~both["vehicle_id"].isin(ill)]
        changes += [(both[name] - both[f"{name}_healthy"]).abs().to_numpy(np.float64) for name in names]
    change = np.concatenate(changes)
    change = change[np.isfinite(change)]
    largest, share = float(change.max(initial=0.0)), float(np.mean(change > MOST_CHANGE))
    told = f"at most {largest:.2f}, {100 * share:.1f} % by more than {MOST_CHANGE:g}"
    what = f"healthy cars: change of {what} through faults of half of the fleet"
    return Line("autumn-faults", what, f"<= {MOST_CHANGE:g}", told, write_verdict(largest <= MOST_CHANGE))


def _error(rows: pd.DataFrame, name: str) -> Floats:
    return (rows[name] - rows["soc_end_pct"]).abs().to_numpy(np.float64)


def _both(rows: pd.DataFrame, name: str) -> tuple[Floats, Floats]:
    """Return the errors of forecasts and of a baseline where it has a value."""
    known = rows[rows[name].notna()]
    return _error(known, "soc_mean_pct"), _error(known, name)


def _find_ends(rows: pd.DataFrame, whose: str = OURS) -> tuple[Any, Any]:
    """Return the ends of the intervals of the forecasts, or of a baseline. [%]"""
    unit = "_pct" if whose == OURS else ""
    return rows[f"{whose}_p05{unit}"], rows[f"{whose}_p95{unit}"]


def _score(rows: pd.DataFrame, whose: str) -> Floats:
    columns: list[Any] = [each.to_numpy(np.float64) for each in (*_find_ends(rows, whose), rows["soc_end_pct"])]
    return compute_interval_score(*columns)


def _held(rows: pd.DataFrame, whose: str = OURS) -> Any:
    """Return whether the outcome is inside the interval."""
    return rows["soc_end_pct"].between(*_find_ends(rows, whose)).to_numpy(bool)


def _share(fleet: str, what: str, goal: tuple[float, float] | None, holds: Any, rows: pd.DataFrame) -> Line:
    """Return the line of a share with its interval."""
    words = "" if goal is None else write_goal(*goal)
    if not len(rows):
        return Line(fleet, what, words, "none", "missed")
    share = compute_clustered_share(holds, rows["cluster"].to_numpy(np.int64))
    told = f"{100 * share['value']:.1f} % ({100 * share['low']:.0f} to {100 * share['high']:.0f}; n {len(rows)})"
    met = goal is None or goal[0] <= share["value"] <= goal[1]
    return Line(fleet, what, words, told, "" if goal is None else write_verdict(met))


def _less(fleet: str, what: str, goal: float | None, ours: Floats, theirs: Floats, digits: int = 2) -> Line:
    """Return the line of a mean that should be below that of a baseline by a share."""
    words = "" if goal is None else f"{-100 * goal:.0f} % or less" if goal else "below"
    if not len(ours):
        return Line(fleet, what, words, "none", "" if goal is None else "missed")
    change = float(ours.mean() / theirs.mean()) - 1.0
    told = f"{100 * change:+.0f} % ({ours.mean():.{digits}f} against {theirs.mean():.{digits}f}; n {len(ours)})"
    return Line(fleet, what, words, told, "" if goal is None else write_verdict(change <= -goal))
