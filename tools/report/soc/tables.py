"""Build the tables of an evaluation of state-of-charge forecasts: by time ahead, condition and leg, and of the risk."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, Final

from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.soc.baselines import BASELINES, LEAST_ERRORS, REGRESSION
from socast.core.evaluate.soc.records import (
    BaselineRisk,
    BestBaseline,
    ClusteredShare,
    ForecastFigures,
    RegressionIntervals,
    RiskClass,
    RiskFigures,
    SocEvaluation,
)
from socast.core.evaluate.soc.regression import NOMINAL
from socast.core.evaluate.soc.reserve_risk import ALARM, LEVELS, PLANNED
from socast.core.formatting import format_minus
from socast.core.stats.clustered import LEAST_CLUSTERS
from socast.tools.report import table
from socast.tools.report.evaluation.result import get_vehicle_name
from socast.tools.report.table import (
    UNKNOWN,
    ReportTable,
    format_change,
    format_count,
    format_difference,
    format_estimate,
    format_percent,
    keep_filled,
    tabulate_records,
)

HEADS: Final[Mapping[str, str]] = MappingProxyType(
    {"linear": "pace", "model_mean": "kWh/km", "rating": "rating", "regression": "regression"}
)
"""Headings of the errors of baselines."""
FIGURES: Final = ("n", "mae_pct", "bias_pct", "coverage", "width_pct")
"""Figures of forecasts that every table shows."""
SHOWN_AT: Final = "2"
"""Time ahead at which conditions are compared with the baselines. [h]"""
PERCENT_NOTE: Final = (
    "n: number of forecasts. MAE, bias (forecast less outcome) and width are in % of charge. ± is half "
    "of the 95 % interval, clustered by vehicle-day."
)
UNITS: Final[Mapping[str, str]] = MappingProxyType({"temperature": ", °C", "new weather": ", K outside"})
"""Unit of each condition that has one."""
SHARE_NOTE: Final = (
    "In parentheses: 95 % interval (Wilson, clustered). A dash before it: too few cases for a figure, fewer than "
    f"{LEAST_CLUSTERS} independent ones. Cases of one vehicle-day (one car on one day) resemble each other, and count "
    "for less."
)
COVERAGE_NOTE: Final = "Coverage: share of outcomes inside the 90 % interval."
SCORE_NOTE: Final = (
    "Interval score: width of the 90 % interval, and 20 times what an outcome misses it by; small is good. The "
    "regression has an interval once twenty shifts have ended."
)
LEG_BASELINES: Final = ("model_mean", "rating", "regression")
"""Baselines that apply to legs."""
LEG_NOTE: Final = (
    "Each car is queried at most every half hour. Each leg of the answer is compared with the ride that "
    "followed, unless the car charged before its end. Where a plan states no charge, later time at a "
    "charger counts as waiting."
)
BEST_NOTE: Final = (
    "To best: error relative to that of the best baseline other than the regression, on forecasts for which these "
    f"have a value; none of fewer than {LEAST_CLUSTERS} vehicle-days, or 0 h ahead, when every baseline equals the "
    "display."
)
SHOWN: Final = ("1", "2")
"""Times ahead at which alarms are shown. [h]"""
LEVEL_NOTE: Final = (
    f"Levels: {', '.join(map(str, LEVELS))} % for every shift. A case is a forecast and a level that the car was not "
    "yet below. The risk is read from the interval, as two halves of a normal distribution that meet at the mean."
)
ALARM_NOTE: Final = (
    f"Alarm: a risk of {format_percent(ALARM, 0)} or more. Caught: cases that fell below and had an "
    "alarm. False alarms: cases that had an alarm and did not fall below. Rows without either are left "
    "out."
)
BRIER_NOTE: Final = (
    "Brier score: mean square of risk less outcome. Skill: reduction of the baseline's score by the "
    "forecast, ± half of its 95 % interval (clustered); 0 % is no better, 100 % is perfect."
)
PERSON_NOTE: Final = (
    f"{'; '.join(f'{HEADS[name]}: {meaning}' for name, meaning in BASELINES.items())}. The risk of a "
    f"baseline follows from its earlier errors, once {LEAST_ERRORS} shifts have ended. The forecast is "
    "evaluated on the same cases."
)


def format_share(share: ClusteredShare) -> str:
    """Return a share with its interval, and a dash with the interval where cases are too few.

    Examples
    --------
    >>> format_share(ClusteredShare(value=0.9, low=0.871, high=0.92, clusters=300))
    '90.0 % (87.1 to 92.0)'
    >>> format_share(ClusteredShare(value=0.571, low=0.25, high=0.842, clusters=7))
    '– (25.0 to 84.2)'
    """
    if not share.clusters:
        return UNKNOWN
    value = format_percent(share.value) if share.is_firm else UNKNOWN
    if share.low is None or share.high is None:
        return value
    return f"{value} ({100 * share.low:.1f} to {100 * share.high:.1f})"


def format_skill(skill: EstimatedValue) -> str:
    """Return a skill with its interval.

    Examples
    --------
    >>> format_skill(EstimatedValue(value=0.412, ci95=0.12))
    '+41 ± 12 %'
    """
    if skill.value is None:
        return UNKNOWN
    return format_minus(f"{100 * skill.value:+.0f}{'' if skill.ci95 is None else f' ± {100 * skill.ci95:.0f}'} %")


FORMATS: Final[Mapping[str, Callable[[Any], str]]] = MappingProxyType(
    {
        **table.FORMATS,
        "charge": lambda value: format_estimate(value, 2),
        "difference": lambda value: format_difference(value, 2),
        "value": lambda estimate: format_estimate(estimate.value, 1),
        "clustered share": format_share,
        "skill": format_skill,
    }
)
"""Formats of the fields of these tables."""
tabulate: Final = partial(tabulate_records, formats=FORMATS, totals=("all",))
"""Return a table of records of this evaluation."""


def tabulate_figures(
    title: str, corner: str, groups: Mapping[str, ForecastFigures], notes: tuple[str, ...], **options: Any
) -> ReportTable:
    """Return a table of the figures of forecasts."""
    return tabulate(
        title,
        groups,
        ForecastFigures,
        corner=corner,
        notes=notes,
        strong=lambda name, *_: name == "mae_pct",
        **{"fields": FIGURES} | options,
    )


def tabulate_by_time(result: SocEvaluation) -> ReportTable:
    """Return errors, coverage and width by the time ahead."""
    groups = {**result.overall.hours, "all": result.overall.pooled}
    best = [compare_with_best(group.best if hours != "0" else None) for hours, group in groups.items()]
    more = [*_list_baseline_errors(groups.values(), HEADS), ("to best", best)]
    meanings = "; ".join(f"{HEADS[name]}: {meaning}" for name, meaning in BASELINES.items())
    notes = (PERCENT_NOTE, COVERAGE_NOTE, SHARE_NOTE, f"Baselines (MAE only): {meanings}.", BEST_NOTE)
    title = "Forecasts of the state of charge at the shift's end"
    return tabulate_figures(title, "before", groups, notes, more=more, label=format_hours)


def describe_result(result: SocEvaluation) -> list[str]:
    """Return how far forecasts were off beside the best simple rule, and whether their intervals hold the outcomes."""
    hours = SHOWN_AT if SHOWN_AT in result.overall.hours else list(result.overall.hours)[-1]
    group = result.overall.hours[hours]
    when = "At the end of a shift" if hours == "0" else f"{format_hours(hours)} before the end of a shift"
    off = f"{when}, forecasts of the charge at its end were off by {format_estimate(group.mae_pct, 2)} % on average"
    best, share = group.best, group.coverage
    if hours != "0" and best is not None and compare_with_best(best) != UNKNOWN:
        less = best.share_less or 0.0
        beside = f"{format_percent(abs(less), 0)} {'less' if less >= 0.0 else 'more'} than the best simple rule"
        off = f"{off}, {beside} ({BASELINES[best.name]})"
    if share.low is None or share.high is None:
        return [f"{off}.", "Too few shifts to tell whether the 90 % intervals hold the outcomes."]
    ends = f"{100 * share.low:.1f} to {100 * share.high:.1f}"
    inside = f"{format_percent(share.value)} of the outcomes ({ends})" if share.is_firm else f"{ends} % of the outcomes"
    fits = share.low <= NOMINAL <= share.high
    verdict = "which agrees with 90 %" if fits else f"so it is too {'narrow' if share.high < NOMINAL else 'wide'}"
    return [f"{off}.", f"Their 90 % interval held {inside}, {verdict}."]


def format_hours(hours: str) -> str:
    """Return a time ahead with its unit, `all` as it is. [h]"""
    return hours if hours == "all" else f"{hours} h"


def _list_baseline_errors(groups: Iterable[ForecastFigures], names: Iterable[str]) -> list[tuple[str, list[str]]]:
    """Return the columns of the errors of baselines."""
    return [(HEADS[name], [format_estimate(of.baselines[name].mae_pct.value, 2) for of in groups]) for name in names]


def tabulate_intervals(result: SocEvaluation) -> ReportTable:
    """Return the intervals of forecasts and regression side by side, by the time ahead."""
    groups = {**result.overall.hours, "all": result.overall.pooled}
    both = {hours: group.regression for hours, group in groups.items() if hours != "0" and group.regression.n}
    title, notes = "Intervals beside those of the regression", (SCORE_NOTE, SHARE_NOTE)
    return tabulate(title, both, RegressionIntervals, corner="before", label=format_hours, notes=notes)


def compare_with_best(best: BestBaseline | None) -> str:
    """Return the forecasts' error relative to the best baseline's, where there are enough vehicle-days."""
    if best is None or best.vehicle_days < LEAST_CLUSTERS:
        return UNKNOWN
    return format_change(best.forecast_mae_pct, best.mae_pct)


def tabulate_conditions(result: SocEvaluation) -> list[ReportTable]:
    """Return the figures by each condition in which the shifts differ."""
    notes = (PERCENT_NOTE, "All columns but the last two pool all times ahead.", COVERAGE_NOTE, SHARE_NOTE, BEST_NOTE)
    tables = []
    for name, bins in result.by.items():
        at = [part.hours.get(SHOWN_AT) for part in bins]
        errors = [format_estimate(each.mae_pct.value, 2) if each else UNKNOWN for each in at]
        best = [compare_with_best(each.best if each else None) for each in at]
        more = [(f"MAE, {SHOWN_AT} h", errors), (f"to best, {SHOWN_AT} h", best)]
        options = {"fields": ("vehicle_days", *FIGURES), "more": more, "label": partial(format_bin, name)}
        groups = {part.bin: part.pooled for part in bins}
        if len(bins) > 1:
            corner = f"{name}{UNITS.get(name, '')}"
            tables.append(tabulate_figures(f"By {name}", corner, groups, notes, **options))
    return tables


def tabulate_legs(result: SocEvaluation) -> list[ReportTable]:
    """Return the figures of single legs and around planned charges, by the time ahead."""
    titles = {
        "without a charge": "State of charge at the end of single legs",
        "charged later": "The same where the car charged later in the shift",
        "to the next charge": "The last of these legs before the next charge",
        "to the charge": "State of charge when the next planned charge begins",
        "over the charge": "State of charge at the end of a shift with a planned charge",
    }
    parts = {**result.legs, **result.charges}
    tables = []
    for key, title in titles.items():
        if bins := {each.bin: each for each in parts.get(key, ())}:
            corner, first = ("minutes ahead", (LEG_NOTE,)) if key in result.legs else ("time ahead", ())
            more = _list_baseline_errors(bins.values(), LEG_BASELINES)
            notes = (*first, PERCENT_NOTE, COVERAGE_NOTE, SHARE_NOTE)
            fields = ("vehicle_days", *FIGURES)
            tables.append(tabulate_figures(title, corner, bins, notes, fields=fields, more=more))
    return tables


def format_bin(condition: str, name: str) -> str:
    """Return the name of a bin of a condition, for readers."""
    return get_vehicle_name(name) if condition == "vehicle model" else format_minus(name)


def describe_reserve(result: SocEvaluation) -> str:
    """Return how many forecasts preceded a fall below the reserve, in words."""
    pooled = result.reserve.levels.get(PLANNED, {}).get("pooled")
    if pooled is None:
        return "No plan named a reserve."
    return (
        f"{format_count(pooled.fell)} of {format_count(pooled.n)} forecasts were of shifts that later fell below the "
        "reserve of their plan."
    )


def tabulate_risk(result: SocEvaluation) -> list[ReportTable]:
    """Return the tables of the section."""
    of_plan = tabulate_reliability(result, PLANNED, "Forecast risk of falling below the plan's reserve", ())
    of_levels = tabulate_reliability(result, "levels", "Risk of falling below other levels", (LEVEL_NOTE,))
    rest = (tabulate_told(result), tabulate_alarms(result), tabulate_baselines(result))
    return keep_filled(of_plan, of_levels, *rest)


def _name_classes(classes: list[RiskClass]) -> dict[str, RiskClass]:
    """Return classes of risk by their edges."""
    return {f"{format_percent(each.low, 0)} to {format_percent(each.high, 0)}": each for each in classes}


def tabulate_reliability(result: SocEvaluation, key: str, title: str, notes: tuple[str, ...]) -> ReportTable:
    """Return how often shifts fell below levels, by forecast risk."""
    classes = _name_classes(result.reserve.reliability.get(key, []))
    return tabulate(title, classes, RiskClass, corner="risk", notes=(*notes, SHARE_NOTE))


def tabulate_told(result: SocEvaluation) -> ReportTable:
    """Return how often shifts fell below levels by coarser classes of risk, beside the risk of the regression."""
    ours, theirs = (_name_classes(result.reserve.told.get(name, [])) for name in ("risk", REGRESSION))
    rows = [(name, name) for name in ours if theirs]
    return table.tabulate(
        "Risk beside that of the regression",
        "risk",
        rows,
        [
            ("cases", lambda name: format_count(ours[name].n)),
            ("fell below", lambda name: format_share(ours[name].fell)),
            ("cases, regression", lambda name: format_count(theirs[name].n if name in theirs else 0)),
            ("fell below, regression", lambda name: format_share(theirs[name].fell) if name in theirs else UNKNOWN),
        ],
        (LEVEL_NOTE, SHARE_NOTE),
    )


def tabulate_alarms(result: SocEvaluation) -> ReportTable:
    """Return the performance of alarms, by level and time ahead."""
    pooled = f"{LEVELS[0]} to {LEVELS[-1]} %"
    groups = {
        "the plan's reserve" if level == PLANNED else f"{level} %": by_hours
        for level, by_hours in result.reserve.levels.items()
    }
    shown = {
        f"{name}, {hours} h": by_hours[hours]
        for name, by_hours in {**groups, pooled: result.reserve.overall}.items()
        for hours in SHOWN
        if hours in by_hours and (by_hours[hours].fell or by_hours[hours].alarms.false_alarms)
    }
    alarms = [each.alarms for each in shown.values()]
    more = (
        ("caught", [_counted(each.caught, each.hit_rate) for each in alarms]),
        ("missed", [format_count(each.missed) for each in alarms]),
        ("false alarms", [_counted(each.false_alarms, each.false_alarm_rate) for each in alarms]),
    )
    notes, totals = (ALARM_NOTE, SHARE_NOTE), [name for name in shown if name.startswith(f"{pooled},")]
    corner = "level, before the end"
    return tabulate("Alarms", shown, RiskFigures, corner=corner, more=more, notes=notes, totals=totals)


def _counted(some: int, share: ClusteredShare) -> str:
    """Return a count with the share that it is; the count alone where the share has no interval."""
    if not share.clusters:
        return UNKNOWN
    return format_count(some) if share.low is None else f"{format_count(some)}: {format_share(share)}"


def tabulate_baselines(result: SocEvaluation) -> ReportTable:
    """Return the scores of the risk beside those of the baselines."""
    groups = {
        f"{HEADS[name]}, {hours} h": group
        for hours in SHOWN
        for name, group in (result.reserve.overall[hours].baselines if hours in result.reserve.overall else {}).items()
        if group.fell
    }
    more = [
        (
            f"{words}, baseline" if whose == "alarms" else "forecast",
            [format_count(getattr(getattr(group, whose), what)) for group in groups.values()],
        )
        for what, words in (("caught", "caught"), ("false_alarms", "false alarms"))
        for whose in ("alarms", "forecast_alarms")
    ]
    title, corner = "Forecast risk against baselines", "baseline, before the end"
    notes = (PERSON_NOTE, BRIER_NOTE, LEVEL_NOTE)
    return tabulate(title, groups, BaselineRisk, corner=corner, more=more, notes=notes)
