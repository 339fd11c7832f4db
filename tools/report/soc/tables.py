"""Build the tables of an evaluation of state-of-charge forecasts: by time ahead, by condition, and by leg."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from socast.core.evaluate.soc.baselines import BASELINES
from socast.core.formatting import format_minus
from socast.core.stats.clustered import LEAST_CLUSTERS
from socast.tools.report.cells import (
    UNKNOWN,
    Cell,
    ReportTable,
    Row,
    format_change,
    format_count,
    format_difference,
    format_estimate,
    format_percent,
)
from socast.tools.report.evaluation.result import Result, get_mapping, get_number, get_part, get_vehicle_name

HEADS: Final[Mapping[str, str]] = MappingProxyType(
    {"linear": "pace", "model_mean": "kWh/km", "rating": "rating", "regression": "regression"}
)
"""Headings of the errors of baselines."""
FIGURES: Final = ("n", "MAE", "bias", "coverage", "width")
"""Headings of the figures of forecasts."""
SHOWN_AT: Final = "2"
"""Time ahead at which conditions are compared with the baselines. [h]"""
PERCENT_NOTE: Final = (
    "n: number of forecasts. MAE, bias (forecast less outcome) and width are in % of charge. ± is half "
    "of the 95 % interval, clustered by vehicle-day (one car on one day)."
)
UNITS: Final[Mapping[str, str]] = MappingProxyType({"temperature": ", °C", "new weather": ", K outside"})
"""Unit of each condition that has one."""
TOO_FEW: Final = "too few"
SHARE_NOTE: Final = (
    f"In parentheses: 95 % interval (Wilson, clustered). Too few: of fewer than {LEAST_CLUSTERS} "
    "vehicle-days, only the interval is shown."
)
COVERAGE_NOTE: Final = f"Coverage: share of outcomes inside the 90 % interval. {SHARE_NOTE}"
SCORE_NOTE: Final = (
    "Interval score: width of the 90 % interval, and 20 times what an outcome misses it by; small is good. The "
    "regression has an interval once twenty shifts have ended."
)
LEG_BASELINES: Final = ("model_mean", "rating", "regression")
"""Baselines that apply to legs."""
LEG_NOTE: Final = (
    "Each car is queried at most every half hour. Each leg of the answer is compared with the ride that "
    "followed, unless the car charged before its end. Plans do not state charging: later time at a "
    "charger counts as waiting."
)
BEST_NOTE: Final = (
    "To best: error relative to that of the best baseline other than the regression, on forecasts for which these "
    "have a value. A "
    f"dash: fewer than {LEAST_CLUSTERS} vehicle-days, or 0 h ahead, when every baseline equals the "
    "display."
)


def tabulate_by_time(result: Result) -> ReportTable:
    """Return errors, coverage and width by the time ahead."""
    by_hours = get_mapping(result, "overall", "hours")
    rows = [
        Row(f"{hours} h", _cells(group if hours != "0" else {**group, "best": None}))
        for hours, group in by_hours.items()
    ]
    rows.append(Row("all", _cells(get_mapping(result, "overall", "pooled")), total=True))
    heads = (*FIGURES, *HEADS.values(), "to best")
    meanings = "; ".join(f"{HEADS[name]}: {meaning}" for name, meaning in BASELINES.items())
    notes = (PERCENT_NOTE, COVERAGE_NOTE, f"Baselines (MAE only): {meanings}.", BEST_NOTE)
    title = "Forecasts of the state of charge at the shift's end"
    return ReportTable(title, "before", heads, tuple(rows), notes)


def tabulate_intervals(result: Result) -> ReportTable:
    """Return the intervals of forecasts and regression side by side, by the time ahead."""
    by_hours = {**get_mapping(result, "overall", "hours"), "all": get_mapping(result, "overall", "pooled")}
    rows = tuple(
        Row(
            hours if hours == "all" else f"{hours} h",
            (
                Cell(format_count(get_number(both["n"]) or 0)),
                *(Cell(format_share(both[f"{whose}coverage"])) for whose in ("forecast_", "")),
                *(
                    Cell(format_estimate(get_number(both[f"{whose}{figure}_pct"]), 1))
                    for figure in ("width", "interval_score")
                    for whose in ("forecast_", "")
                ),
            ),
            total=hours == "all",
        )
        for hours, group in by_hours.items()
        if hours != "0" and (both := get_mapping(group, "regression")) and both["n"]
    )
    heads = ("n", "coverage", "regression", "width", "regression", "interval score", "regression")
    return ReportTable("Intervals beside those of the regression", "before", heads, rows, (SCORE_NOTE, SHARE_NOTE))


def _cells(group: Mapping[str, Any]) -> tuple[Cell, ...]:
    return (
        *_figures(group),
        *(Cell(format_estimate(get_number(get_part(group, "baselines", name, "mae_pct")), 2)) for name in BASELINES),
        Cell(compare_with_best(group)),
    )


def _figures(group: Mapping[str, Any]) -> tuple[Cell, ...]:
    return (
        Cell(format_count(group["n"])),
        Cell(format_estimate(group["mae_pct"], 2), strong=True),
        Cell(format_difference(group["bias_pct"], 2)),
        Cell(format_share(group["coverage"])),
        Cell(format_estimate(get_number(group["width_pct"]), 1)),
    )


def format_share(share: Any) -> str:
    """Return a share with its interval, and only the interval where vehicle-days are too few.

    Examples
    --------
    >>> format_share({"value": 0.9, "low": 0.871, "high": 0.92, "clusters": 300})
    '90.0 % (87.1 to 92.0)'
    >>> format_share({"value": 0.571, "low": 0.25, "high": 0.842, "clusters": 7})
    'too few (25.0 to 84.2)'
    """
    low, high, clusters = (
        get_number(get_part(share, "low")),
        get_number(get_part(share, "high")),
        get_number(get_part(share, "clusters")),
    )
    if not clusters:
        return UNKNOWN
    value = format_percent(get_number(share)) if clusters >= LEAST_CLUSTERS else TOO_FEW
    return value + ("" if low is None or high is None else f" ({100 * low:.1f} to {100 * high:.1f})")


def compare_with_best(group: Mapping[str, Any]) -> str:
    """Return the forecasts' error relative to the best baseline's, where there are enough vehicle-days.

    Examples
    --------
    >>> best = {"forecast_mae_pct": 0.9, "mae_pct": 1.2, "vehicle_days": 30}
    >>> compare_with_best({"best": best}), compare_with_best({"best": best | {"vehicle_days": 29}})
    ('−25.0 %', '–')
    >>> compare_with_best({"best": None})
    '–'
    """
    best = get_mapping(group, "best")
    if not best or best["vehicle_days"] < LEAST_CLUSTERS:
        return UNKNOWN
    return format_change(get_number(get_part(best, "forecast_mae_pct")), get_number(get_part(best, "mae_pct")))


def tabulate_conditions(result: Result) -> list[ReportTable]:
    """Return the figures by each condition in which the shifts differ."""
    heads = ("vehicle-days", *FIGURES, f"MAE, {SHOWN_AT} h", f"to best, {SHOWN_AT} h")
    tables = []
    for name, bins in get_mapping(result, "by").items():
        rows = tuple(Row(format_bin(name, str(part["bin"])), _of_bin(part)) for part in bins)
        unit = UNITS.get(name, "")
        notes = (PERCENT_NOTE, "All columns but the last two pool all times ahead.", COVERAGE_NOTE, BEST_NOTE)
        if len(rows) > 1:
            tables.append(ReportTable(f"By {name}", f"{name}{unit}", heads, rows, notes))
    return tables


def _of_bin(part: Mapping[str, Any]) -> tuple[Cell, ...]:
    pooled, at = get_mapping(part, "pooled"), get_mapping(part, "hours", SHOWN_AT)
    return (
        Cell(format_count(pooled["vehicle_days"])),
        *_figures(pooled),
        Cell(format_estimate(get_number(at.get("mae_pct")), 2)),
        Cell(compare_with_best(at)),
    )


def tabulate_legs(result: Result) -> list[ReportTable]:
    """Return the figures of single legs and around planned charges, by the time ahead."""
    heads = (*FIGURES, *(HEADS[name] for name in LEG_BASELINES))
    titles = {
        "without a charge": "State of charge at the end of single legs",
        "charged later": "The same where the car charged later in the shift",
        "to the next charge": "The last of these legs before the next charge",
    }
    charge_titles = {
        "to the charge": "State of charge when the next planned charge begins",
        "over the charge": "State of charge at the end of a shift with a planned charge",
    }
    legs, charges = get_mapping(result, "legs"), get_mapping(result, "charges")
    notes = (PERCENT_NOTE, COVERAGE_NOTE)
    return [
        *(
            ReportTable(title, "minutes ahead", heads, tuple(map(_leg_row, legs[key])), (LEG_NOTE, *notes))
            for key, title in titles.items()
            if legs.get(key)
        ),
        *(
            ReportTable(title, "time ahead", heads, tuple(map(_leg_row, charges[key])), notes)
            for key, title in charge_titles.items()
            if charges.get(key)
        ),
    ]


def _leg_row(group: Mapping[str, Any]) -> Row:
    theirs = (
        Cell(format_estimate(get_number(get_part(group, "baselines", name, "mae_pct")), 2)) for name in LEG_BASELINES
    )
    return Row(group["bin"], (*_figures(group), *theirs), total=group["bin"] == "all")


def format_bin(condition: str, name: str) -> str:
    """Return the name of a bin of a condition, for readers."""
    return get_vehicle_name(name) if condition == "vehicle model" else format_minus(name)
