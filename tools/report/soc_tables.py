"""Tables of an evaluation of state-of-charge forecasts: by time ahead, by condition, and what alarms were worth."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from core.evaluate.soc_baselines import BASELINES
from core.evaluate.soc_reserve import ALARM, PLANNED
from tools.report.cells import UNKNOWN, Cell, ReportTable, Row, change, count, percent
from tools.report.comparison_tables import off, within
from tools.report.result import Result, mapping, number, part, vehicle_name

HEADS: Final[Mapping[str, str]] = MappingProxyType({"linear": "pace", "model_mean": "kWh/km", "rating": "rating"})
"""Of the baselines, in the columns of their errors."""
FIGURES: Final = ("n", "MAE", "bias", "coverage", "width")
"""Heads of what is told of forecasts."""
SHOWN_AT: Final = "2"
"""Time ahead at which conditions are compared with the baselines. [h]"""
PERCENT_NOTE: Final = (
    "Of n forecasts MAE, bias (forecast less outcome) and width are in % of charge. ± is half of the 95 % interval; "
    "shifts of one car on one day are taken for alike."
)
COVERAGE_NOTE: Final = (
    "Coverage: share of outcomes inside the 90 % interval, in parentheses its own 95 % interval (binomial, clustered)."
)
BEST_NOTE: Final = (
    "To best: by how much the error is below or above that of the best baseline, where all have an answer; at the end "
    "everybody reads the display."
)
ALARM_NOTE: Final = (
    f"An alarm is a risk of {percent(ALARM, 0)} or more. Caught: of the shifts that fell below, those with an alarm; "
    "false alarms: of those that did not, those with one. Left out: shifts already below, and rows in which none fell "
    "and none had an alarm."
)
RISK_NOTE: Final = (
    "At 20, 30 and 40 % the risk is read from the interval: two halves of a normal distribution that meet at the mean."
)
BRIER_NOTE: Final = (
    "Brier score: mean square of risk less outcome; its reference tells every shift the share of those that fell."
)


def ahead(result: Result) -> ReportTable:
    """Return errors, coverage and width by the time ahead."""
    found = mapping(result, "overall", "hours")
    rows = [Row(f"{hours} h", _cells(own if hours != "0" else {**own, "best": None})) for hours, own in found.items()]
    rows.append(Row("all", _cells(mapping(result, "overall", "pooled")), total=True))
    heads = (*FIGURES, *HEADS.values(), "to best")
    meanings = "; ".join(f"{HEADS[name]}: {meaning}" for name, meaning in BASELINES.items())
    notes = (PERCENT_NOTE, COVERAGE_NOTE, f"Baselines, of which the MAE is shown: {meanings}.", BEST_NOTE)
    title = "Forecasts of the state of charge at the shift's end"
    return ReportTable(title, "before", heads, tuple(rows), notes)


def _cells(own: Mapping[str, Any]) -> tuple[Cell, ...]:
    return (
        *_figures(own),
        *(Cell(within(number(part(own, "baselines", name, "mae_pct")), 2)) for name in BASELINES),
        Cell(against_best(own)),
    )


def _figures(own: Mapping[str, Any]) -> tuple[Cell, ...]:
    return (
        Cell(count(own["n"])),
        Cell(within(own["mae_pct"], 2), strong=True),
        Cell(off(own["bias_pct"], 2)),
        Cell(covered(own["coverage"])),
        Cell(within(number(own["width_pct"]), 1)),
    )


def covered(share: Any) -> str:
    """Return a coverage with its interval.

    Examples
    --------
    >>> covered({"value": 0.9, "low": 0.871, "high": 0.92})
    '90.0 % (87.1–92.0)'
    """
    low, high = number(part(share, "low")), number(part(share, "high"))
    return percent(number(share)) + ("" if low is None or high is None else f" ({100 * low:.1f}–{100 * high:.1f})")


def against_best(own: Mapping[str, Any]) -> str:
    """Return by how much the forecasts' error is below or above the best baseline's."""
    best = mapping(own, "best")
    return change(number(part(best, "forecast_mae_pct")), number(part(best, "mae_pct")))


def condition_tables(result: Result) -> list[ReportTable]:
    """Return the figures by each condition that the shifts differ in."""
    heads = ("car-days", *FIGURES, f"MAE, {SHOWN_AT} h", f"to best, {SHOWN_AT} h")
    found = []
    for name, bins in mapping(result, "by").items():
        rows = tuple(Row(bin_name(name, str(own["bin"])), _of_bin(own)) for own in bins)
        unit = ", °C" if name == "temperature" else ""
        notes = (PERCENT_NOTE, "All times ahead are pooled, but in the last two columns.", COVERAGE_NOTE, BEST_NOTE)
        if len(rows) > 1:
            found.append(ReportTable(f"By {name}", f"{name}{unit}", heads, rows, notes))
    return found


def _of_bin(own: Mapping[str, Any]) -> tuple[Cell, ...]:
    pooled, at = mapping(own, "pooled"), mapping(own, "hours", SHOWN_AT)
    return (
        Cell(count(pooled["vehicle_days"])),
        *_figures(pooled),
        Cell(within(number(at.get("mae_pct")), 2)),
        Cell(against_best(at)),
    )


def bin_name(condition: str, name: str) -> str:
    """Return what people call a bin of a condition."""
    return vehicle_name(name) if condition == "vehicle model" else name.replace("-", "−")


def reserve_tables(result: Result) -> list[ReportTable]:
    """Return what alarms were worth, at each level and time ahead."""
    rows = tuple(
        Row(f"{level_name(level)}, {hours} h", _alarms(own))
        for level, of in mapping(result, "reserve").items()
        for hours, own in of.items()
        if own["fell"] or own["false_alarms"]
    )
    heads = ("shifts", "fell below", "caught", "false alarms", "Brier score", "reference")
    notes = (ALARM_NOTE, RISK_NOTE, BRIER_NOTE)
    return [ReportTable("Alarms", "level, before the end", heads, rows, notes)]


def _alarms(own: Mapping[str, Any]) -> tuple[Cell, ...]:
    fell, stayed = int(own["fell"]), int(own["shifts"]) - int(own["fell"])
    return (
        Cell(count(own["shifts"])),
        Cell(count(fell)),
        Cell(_share(int(own["caught"]), fell)),
        Cell(_share(int(own["false_alarms"]), stayed)),
        *(Cell(f"{value:.3f}") for value in (own["brier"], own["brier_base"])),
    )


def _share(some: int, of: int) -> str:
    return f"{count(some)} ({percent(some / of, 0)})" if of else UNKNOWN


def level_name(level: str) -> str:
    """Return what people call a level of reserve."""
    return "the plan's reserve" if level == PLANNED else f"{level} %"
