"""Build the tables of the risk of ending below a reserve: reliability, alarms, and comparison with baselines."""

from collections.abc import Mapping
from typing import Any, Final

from socast.core.evaluate.soc.baselines import BASELINES, LEAST_ERRORS, REGRESSION
from socast.core.evaluate.soc.reserve_risk import ALARM, LEVELS, PLANNED
from socast.core.formatting import format_minus
from socast.tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent
from socast.tools.report.evaluation.result import Result, get_half_width, get_mapping, get_number, get_part
from socast.tools.report.soc.tables import HEADS, SHARE_NOTE, format_share

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


def describe_reserve(result: Result) -> str:
    """Return how many forecasts preceded a fall below the reserve, in words."""
    pooled = get_mapping(result, "reserve", "levels", PLANNED, "pooled")
    if not pooled:
        return "No plan named a reserve."
    fell, n = int(pooled["fell"]), int(pooled["n"])
    return (
        f"{format_count(fell)} of {format_count(n)} forecasts were of shifts that later fell below the "
        "reserve of their plan."
    )


def tabulate_risk(result: Result) -> list[ReportTable]:
    """Return the tables of the section."""
    of_plan = tabulate_reliability(result, PLANNED, "Forecast risk of falling below the plan's reserve", ())
    of_levels = tabulate_reliability(result, "levels", "Risk of falling below other levels", (LEVEL_NOTE,))
    tables = (of_plan, of_levels, tabulate_told(result), tabulate_alarms(result), tabulate_baselines(result))
    return [table for table in tables if table.rows]


def tabulate_reliability(result: Result, key: str, title: str, notes: tuple[str, ...]) -> ReportTable:
    """Return how often shifts fell below levels, by forecast risk."""
    rows = tuple(
        Row(
            f"{format_percent(risk_class['low'], 0)} to {format_percent(risk_class['high'], 0)}",
            (
                Cell(format_count(risk_class["n"])),
                Cell(format_count(risk_class["shifts"])),
                Cell(format_percent(risk_class["told"])),
                Cell(format_share(risk_class["fell"])),
            ),
        )
        for risk_class in get_part(result, "reserve", "reliability", key) or ()
    )
    heads = ("cases", "shifts", "mean forecast risk", "fell below")
    return ReportTable(title, "risk", heads, rows, (*notes, SHARE_NOTE))


def tabulate_told(result: Result) -> ReportTable:
    """Return how often shifts fell below levels by coarser classes of risk, beside the risk of the regression."""
    told = {name: get_part(result, "reserve", "told", name) or () for name in ("risk", REGRESSION)}
    by_class = {name: {(each["low"], each["high"]): each for each in classes} for name, classes in told.items()}
    rows = tuple(
        Row(
            f"{format_percent(low, 0)} to {format_percent(high, 0)}",
            tuple(
                Cell(text)
                for classes in by_class.values()
                for each in (classes.get((low, high)),)
                for text in (format_count(each["n"] if each else 0), format_share(each["fell"]) if each else UNKNOWN)
            ),
        )
        for low, high in by_class["risk"]
        if by_class[REGRESSION]
    )
    heads = ("cases", "fell below", "cases, regression", "fell below, regression")
    return ReportTable("Risk beside that of the regression", "risk", heads, rows, (LEVEL_NOTE, SHARE_NOTE))


def tabulate_alarms(result: Result) -> ReportTable:
    """Return the performance of alarms, by level and time ahead."""
    of_levels = get_mapping(result, "reserve", "levels")
    groups = [(format_level(level), by_hours, False) for level, by_hours in of_levels.items()]
    groups.append((f"{LEVELS[0]} to {LEVELS[-1]} %", get_mapping(result, "reserve", "overall"), True))
    rows = tuple(
        Row(f"{name}, {hours} h", _alarms(by_hours[hours]), total)
        for name, by_hours, total in groups
        for hours in SHOWN
        if hours in by_hours and (by_hours[hours]["fell"] or get_part(by_hours[hours], "alarms", "false_alarms"))
    )
    heads = ("cases", "fell below", "caught", "missed", "false alarms")
    return ReportTable("Alarms", "level, before the end", heads, rows, (ALARM_NOTE, SHARE_NOTE))


def _alarms(group: Mapping[str, Any]) -> tuple[Cell, ...]:
    counts = get_mapping(group, "alarms")
    return (
        Cell(format_count(group["n"])),
        Cell(format_count(group["fell"])),
        Cell(_counted(counts["caught"], counts["hit_rate"])),
        Cell(format_count(counts["missed"])),
        Cell(_counted(counts["false_alarms"], counts["false_alarm_rate"])),
    )


def _counted(some: int, share: Any) -> str:
    rate = format_share(share)
    return UNKNOWN if rate == UNKNOWN else f"{format_count(some)}: {rate}"


def tabulate_baselines(result: Result) -> ReportTable:
    """Return the scores of the risk beside those of the baselines."""
    rows = tuple(
        Row(f"{HEADS[name]}, {hours} h", _person(group))
        for hours in SHOWN
        for name in BASELINES
        if (group := get_mapping(result, "reserve", "overall", hours, "baselines", name)) and group["fell"]
    )
    heads = (
        "cases",
        "fell",
        "Brier, baseline",
        "forecast",
        "skill",
        "caught, baseline",
        "forecast",
        "false alarms, baseline",
        "forecast",
    )
    notes = (PERSON_NOTE, BRIER_NOTE, LEVEL_NOTE)
    return ReportTable("Forecast risk against baselines", "baseline, before the end", heads, rows, notes)


def _person(group: Mapping[str, Any]) -> tuple[Cell, ...]:
    counts = [
        get_part(group, whose, what) for what in ("caught", "false_alarms") for whose in ("alarms", "forecast_alarms")
    ]
    return (
        Cell(format_count(group["n"])),
        Cell(format_count(group["fell"])),
        *(Cell(f"{group[name]:.4f}") for name in ("brier", "forecast_brier")),
        Cell(format_skill(group["skill"])),
        *(Cell(format_count(n)) for n in counts),
    )


def format_skill(skill: Any) -> str:
    """Return a skill with its interval.

    Examples
    --------
    >>> format_skill({"value": 0.412, "ci95": 0.12})
    '+41 ± 12 %'
    """
    value, ci95 = get_number(skill), get_half_width(skill)
    if value is None:
        return UNKNOWN
    return format_minus(f"{100 * value:+.0f}{'' if ci95 is None else f' ± {100 * ci95:.0f}'} %")


def format_level(level: str) -> str:
    """Return the name of a level, for readers."""
    return "the plan's reserve" if level == PLANNED else f"{level} %"
