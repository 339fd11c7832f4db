"""Evaluate forecasts of the state of charge at the end of a shift, against outcomes and against simple baselines.

Errors are in percent of charge. Each shift gives one forecast at each time ahead. Figures that pool times ahead, and
all intervals, treat the shifts of a vehicle on one day as one cluster.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.errors import ModelError
from socast.core.evaluate.binning import Binning, bin_names, bin_values
from socast.core.evaluate.records import EstimatedValue, hold_estimate
from socast.core.evaluate.soc.baselines import BASELINES, PERSONS, compute_baselines
from socast.core.evaluate.soc.cases import (
    HOURS_AHEAD,
    SHIFT_KEY,
    ForecastCases,
    count_impossible_bounds,
    normalise_keys,
    replace_outcomes,
    select_cases,
)
from socast.core.evaluate.soc.planned_charges import select_charge_cases
from socast.core.evaluate.soc.recorders import MINUTES
from socast.core.evaluate.soc.records import (
    BaselineErrors,
    BestBaseline,
    ConditionFigures,
    EvaluatedShifts,
    ExampleShift,
    FiguresByTime,
    ForecastBin,
    ForecastColumns,
    ForecastFigures,
    ImpossibleBounds,
    RegressionIntervals,
    SocEvaluation,
)
from socast.core.evaluate.soc.regression import NOMINAL
from socast.core.evaluate.soc.reserve_risk import evaluate_reserve_risk, hold_share
from socast.core.stats.clustered import compute_clustered_mean
from socast.core.stats.scores import Codes

TEMPERATURES: Final = (-20, -10, 0, 10, 20, 30)
"""Edges of the bands of a shift's mean outside temperature; the first and the last band are open. [°C]"""
NOVELTIES: Final = (1, 2, 5, 10)
"""Edges of the bands of the distance of a temperature from those met on earlier days. [K]"""
SEEN: Final = (25, 50, 100, 200, 400)
"""Edges of the bands of the number of shifts of the fleet that had ended."""
HEALTHY: Final = "healthy"
MOST_POINTS: Final = 240
"""Maximum number of forecasts in an example."""
EXAMPLE_HOURS_AHEAD: Final = 2
"""Time ahead of the forecasts by which examples are selected. [h]"""
EXAMPLE_COLUMNS: Final = ("soc_pct", "soc_mean_pct", "soc_p05_pct", "soc_p95_pct")
"""Columns of forecasts that an example contains."""
FIGURE_COLUMNS: Final = (
    *("soc_end_pct", "soc_mean_pct", "soc_p05_pct", "soc_p95_pct", "regression_p05", "regression_p95"),
    *BASELINES,
)
"""Numbers of a case that its figures need."""


@dataclass(frozen=True)
class FigureCases:
    """Hold what the figures of cases need, as arrays: figures are computed for many parts of the same cases.

    Parameters
    ----------
    numbers : dict of str to (n,) float
        `FIGURE_COLUMNS` by name.
    shift, cluster : (n,) int64
        Shift and vehicle-day of each case.
    """

    numbers: Mapping[str, Floats]
    shift: Codes
    cluster: Codes

    @classmethod
    def gather(cls, cases: pd.DataFrame) -> "FigureCases":
        """Return the cases of a table."""
        shift = cases.groupby(SHIFT_KEY, sort=False, dropna=False).ngroup()
        numbers = {name: cases[name].to_numpy(np.float64) for name in FIGURE_COLUMNS}
        return cls(numbers, np.asarray(shift, np.int64), cases["cluster"].to_numpy(np.int64))

    def __len__(self) -> int:
        """Return the number of cases."""
        return len(self.shift)

    def only(self, kept: NDArray[np.bool_]) -> "FigureCases":
        """Return a part of the cases."""
        numbers = {name: values[kept] for name, values in self.numbers.items()}
        return FigureCases(numbers, self.shift[kept], self.cluster[kept])


def evaluate_soc(
    outlooks: pd.DataFrame,
    shifts: pd.DataFrame,
    legs: pd.DataFrame | None = None,
    plans: pd.DataFrame | None = None,
    displays: pd.DataFrame | None = None,
) -> SocEvaluation:
    """Return the errors and the reliability of the forecasts of a pipeline."""
    if displays is not None:
        shifts = replace_outcomes(shifts, displays)
    selected = select_cases(outlooks, shifts)
    if not len(selected.cases):
        why = ", ".join(f"{count} {reason}" for reason, count in selected.left_out.items()) or "none made"
        raise ModelError(
            f"{selected.shifts} shifts ended and no forecast of theirs can be evaluated ({why}): "
            "give recordings of more days"
        )
    cases = pd.concat([selected.cases, compute_baselines(selected.cases, outlooks, shifts, plans)], axis=1)
    gathered, hours = FigureCases.gather(cases), cases["hours"].to_numpy(np.int64)
    bounds = count_impossible_bounds(outlooks, plans)
    charges = select_charge_cases(outlooks, shifts, plans)
    names = ("soc", "soc_mean", "soc_p05", "soc_p95", "soc_end")
    columns = {name: cases[f"{name}_pct"].tolist() for name in names}
    columns |= {name: cases[name].tolist() for name in ("vehicle_id", "shift", "hours", *BASELINES)}
    return SocEvaluation(
        about=_about(selected),
        overall=FiguresByTime(**compute_figures_by_time(gathered, hours)),
        by=compute_figures_by_condition(cases, gathered),
        bounds=bounds,
        reserve=evaluate_reserve_risk(cases),
        legs={} if legs is None or not len(legs) else compute_leg_figures(legs, outlooks, shifts, plans),
        charges={
            name: _bin_figures(group, group["hours"].to_numpy(), {h: f"{h} h" for h in sorted(set(group["hours"]))})
            for name, group in charges.items()
        },
        columns=ForecastColumns(**columns),
        examples=select_examples(cases, outlooks),
        notes=_notes(cases, bounds),
    )


def compute_figures_by_time(cases: FigureCases, hours: Ints) -> dict[str, Any]:
    """Return the fields of `FiguresByTime`, for each time ahead that has a case. [h]"""
    each = {str(ahead): cases.only(hours == ahead) for ahead in HOURS_AHEAD}
    return {
        "pooled": ForecastFigures(**compute_forecast_figures(cases)),
        "hours": {
            ahead: ForecastFigures(**compute_forecast_figures(group)) for ahead, group in each.items() if len(group)
        },
    }


def compute_leg_figures(
    legs: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None = None
) -> dict[str, list[ForecastBin]]:
    """Return the figures of single legs by the time until their end."""
    cases = pd.concat([legs, compute_baselines(legs, outlooks, shifts, plans)], axis=1)
    figures = {}
    later = cases[cases["charges"]]
    last = later.sort_values("leg", kind="stable").drop_duplicates(["vehicle_id", "time_s"], keep="last").sort_index()
    groups = {"without a charge": cases[~cases["charges"]], "charged later": later, "to the next charge": last}
    for name, group in groups.items():
        band = bin_values(group["minutes"].to_numpy(np.float64), MINUTES)
        labels = {code: band.labels[code] for code in np.unique(band.codes).tolist()}
        figures[name] = _bin_figures(group, band.codes, labels) if labels else []
    return figures


def _bin_figures(cases: pd.DataFrame, codes: NDArray[Any], labels: Mapping[int, str]) -> list[ForecastBin]:
    """Return the figures of cases in each bin; the last bin is `all`."""
    gathered = FigureCases.gather(cases)
    groups = {label: gathered.only(codes == code) for code, label in labels.items()} | {"all": gathered}
    return [ForecastBin(bin=label, **compute_forecast_figures(group)) for label, group in groups.items()]


def compute_figures_by_condition(cases: pd.DataFrame, gathered: FigureCases) -> dict[str, list[ConditionFigures]]:
    """Return the figures in the bins of each condition: weather, vehicle model, with and without a plan, and others."""
    bins = {
        "temperature": bin_values(cases["ambient_c"].to_numpy(np.float64), TEMPERATURES),
        "new weather": bin_values(cases["novelty_k"].to_numpy(np.float64), NOVELTIES),
        "shifts seen": bin_values(cases["seen"].to_numpy(np.float64), SEEN),
        "display": bin_names(cases.assign(fault=cases["fault"].replace("", HEALTHY)), "fault"),
        "vehicle model": bin_names(cases, "vehicle_model"),
        "plan": Binning(np.where(cases["planned"].to_numpy(bool), 0, 1), ("planned", "by habit")),
    }
    hours = cases["hours"].to_numpy(np.int64)
    return {
        name: [
            ConditionFigures(
                bin=labels[code], **compute_figures_by_time(gathered.only(codes == code), hours[codes == code])
            )
            for code in np.unique(codes[codes >= 0]).tolist()
        ]
        for name, (codes, labels) in bins.items()
        if name != "display" or len(labels) > 1
    }


def compute_forecast_figures(cases: FigureCases) -> dict[str, Any]:
    """Return the fields of `ForecastFigures` for some cases."""
    became, clusters = cases.numbers["soc_end_pct"], cases.cluster
    mean, low, high = (cases.numbers[f"soc_{name}_pct"] for name in ("mean", "p05", "p95"))
    error = np.abs(mean - became)
    return {
        "n": len(cases),
        "shifts": len(np.unique(cases.shift)),
        "vehicle_days": len(np.unique(clusters)),
        "mae_pct": _average(error, clusters),
        "bias_pct": _average(mean - became, clusters),
        "below": float(np.mean(became < low)),
        "above": float(np.mean(became > high)),
        **_evaluate_interval(cases, "soc_p05_pct", "soc_p95_pct"),
        "regression": _against_regression(cases),
        "baselines": {name: _against(cases.numbers[name], became, error, clusters) for name in BASELINES},
        "best": _best(cases, became, error, clusters),
    }


def _average(values: Floats, clusters: Codes) -> EstimatedValue:
    """Return a mean with its interval, clustered by vehicle-day."""
    return hold_estimate(compute_clustered_mean(values, clusters))


def _evaluate_interval(cases: FigureCases, lower: str, upper: str, prefix: str = "") -> dict[str, Any]:
    """Return coverage, width and score of intervals between two columns, by the names of their fields."""
    low, high, became, clusters = *(cases.numbers[name] for name in (lower, upper, "soc_end_pct")), cases.cluster
    return {
        f"{prefix}coverage": hold_share((low <= became) & (became <= high), clusters),
        f"{prefix}width_pct": _average(high - low, clusters),
        f"{prefix}interval_score_pct": _average(compute_interval_score(low, high, became), clusters),
    }


def compute_interval_score(low: Floats, high: Floats, became: Floats) -> Floats:
    """Return the interval score of 90 % intervals: their width, and 20 times what an outcome misses them by.

    References
    ----------
    Gneiting and Raftery (2007), J. Am. Stat. Assoc. 102:359, eq. 43 (Winkler 1972).

    Examples
    --------
    >>> compute_interval_score(np.array([10.0, 10.0]), np.array([20.0, 20.0]), np.array([15.0, 21.0])).round(6).tolist()
    [10.0, 30.0]
    """
    missed = np.maximum(low - became, 0.0) + np.maximum(became - high, 0.0)
    return np.asarray(high - low + 2.0 / (1.0 - NOMINAL) * missed)


def _against_regression(cases: FigureCases) -> RegressionIntervals:
    """Return the figures of the intervals of the regression and of the forecasts, where both are known."""
    both = cases.only(~np.isnan(cases.numbers["regression_p05"]) & ~np.isnan(cases.numbers["soc_p05_pct"]))
    figures = _evaluate_interval(both, "regression_p05", "regression_p95")
    return RegressionIntervals(
        n=len(both), **figures, **_evaluate_interval(both, "soc_p05_pct", "soc_p95_pct", "forecast_")
    )


def _against(expected: Floats, became: Floats, error: Floats, clusters: Codes) -> BaselineErrors:
    """Return the error of a baseline, and the error of the forecasts on the same cases."""
    known = np.isfinite(expected)
    its, forecast_error, of = np.abs(expected - became)[known], error[known], clusters[known]
    return BaselineErrors(
        n=int(known.sum()),
        mae_pct=_average(its, of),
        bias_pct=_average((expected - became)[known], of),
        forecast_mae_pct=_average(forecast_error, of),
        less_pct=_average(its - forecast_error, of),
        share_less=_share_less(its, forecast_error),
    )


def _best(cases: FigureCases, became: Floats, error: Floats, clusters: Codes) -> BestBaseline | None:
    """Return the person's baseline with the least error on cases that all of them cover, and the forecasts' error."""
    known = np.isfinite([cases.numbers[name] for name in PERSONS]).all(axis=0)
    if not known.any():
        return None
    errors = {name: np.abs(cases.numbers[name] - became)[known] for name in PERSONS}
    name = min(errors, key=lambda one: float(errors[one].mean()))
    return BestBaseline(
        name=name,
        n=int(known.sum()),
        vehicle_days=len(np.unique(clusters[known])),
        mae_pct=float(errors[name].mean()),
        forecast_mae_pct=float(error[known].mean()),
        share_less=_share_less(errors[name], error[known]),
    )


def _share_less(its: Floats, forecast_error: Floats) -> float:
    """Return by which share the mean absolute error of the forecasts is below that of a baseline."""
    return 1.0 - float(forecast_error.mean() / its.mean()) if len(its) and its.mean() > 0.0 else nan


def _about(selected: ForecastCases) -> EvaluatedShifts:
    """Return counts and dates of the evaluated forecasts."""
    cases = selected.cases
    dates = pd.to_datetime(cases["begin_s"], unit="s").dt.strftime("%Y-%m-%d")
    return EvaluatedShifts(
        shifts=selected.shifts,
        judged_shifts=len(cases[SHIFT_KEY].drop_duplicates()),
        warm_up_shifts=selected.warm_up,
        forecasts=len(cases),
        left_out=selected.left_out,
        vehicles=cases["vehicle_id"].nunique(),
        vehicle_days=cases["cluster"].nunique(),
        vehicle_models=sorted(map(str, cases["vehicle_model"].unique())),
        first_date=str(dates.min()),
        last_date=str(dates.max()),
    )


def _notes(cases: pd.DataFrame, bounds: ImpossibleBounds) -> list[str]:
    """Return remarks for the reader."""
    notes = []
    if not cases["planned"].any():
        notes.append("no shift had a plan: of the baselines only the car's own pace applies")
    unrated = sorted(set(cases.loc[cases["rating"].isna() & cases["ahead_km"].notna(), "vehicle_model"].astype(str)))
    if unrated:
        notes.append(f"no official rating is known of {', '.join(unrated)}")
    if bounds.above:
        above, largest = f"{bounds.above:,} of {bounds.n:,}", f"{bounds.largest:.1f} %"
        notes.append(f"{above} upper bounds without a charge ahead are above the present charge, by up to {largest}")
    return notes


def select_examples(cases: pd.DataFrame, outlooks: pd.DataFrame) -> list[ExampleShift]:
    """Return example shifts: the coldest, the warmest, and those with the median and the worst forecast.

    They are selected among shifts with a forecast at `EXAMPLE_HOURS_AHEAD`. Where all times ahead are shorter, the
    longest of them is used.
    """
    ahead = min(EXAMPLE_HOURS_AHEAD, int(cases["hours"].max()))
    at_time = cases[cases["hours"] == ahead].reset_index(drop=True)
    error = (at_time["soc_mean_pct"] - at_time["soc_end_pct"]).abs()
    by_warmth = at_time["ambient_c"].dropna().sort_values(kind="stable").index.tolist()
    by_error = error.sort_values(kind="stable").index.tolist()
    extremes = {"worst": by_error[-1], "middling": by_error[len(by_error) // 2]}
    if by_warmth:
        extremes = {"coldest": by_warmth[0], "warmest": by_warmth[-1], **extremes}
    chosen: dict[int, str] = {}
    for why, place in extremes.items():
        chosen[place] = f"{chosen[place]}, {why}" if place in chosen else why
    made = normalise_keys(outlooks)
    return [_example(why, at_time.iloc[place], made) for place, why in chosen.items()]


def _example(why: str, case: "pd.Series[Any]", outlooks: pd.DataFrame) -> ExampleShift:
    """Return a shift and at most `MOST_POINTS` of its forecasts."""
    of_shift = outlooks[(outlooks[SHIFT_KEY[0]] == case[SHIFT_KEY[0]]) & (outlooks[SHIFT_KEY[1]] == case[SHIFT_KEY[1]])]
    of_shift = of_shift[of_shift["time_s"] <= case["end_s"]].sort_values("time_s", kind="stable")
    of_shift = of_shift.iloc[np.unique(np.linspace(0, len(of_shift) - 1, min(MOST_POINTS, len(of_shift))).astype(int))]
    reserve = of_shift["reserve_soc_pct"].dropna()
    return ExampleShift(
        why=why,
        date=str(pd.Timestamp(case["begin_s"], unit="s").date()),
        **{name: case[name] for name in ("vehicle_id", "vehicle_model", "shift", "ambient_c", "soc_end_pct")},
        reserve_soc_pct=reserve.iloc[-1] if len(reserve) else None,
        hours_ahead=((case["end_s"] - of_shift["time_s"]) / 3600.0).tolist(),
        **{name: of_shift[name].tolist() for name in EXAMPLE_COLUMNS},
    )
