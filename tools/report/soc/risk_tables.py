"""Build the tables of the risk of ending below a reserve: reliability, alarms, and comparison with baselines."""

from typing import Final

from socast.core.evaluate.soc.baselines import BASELINES, LEAST_ERRORS, REGRESSION
from socast.core.evaluate.soc.records import BaselineRisk, ClusteredShare, RiskClass, RiskFigures, SocEvaluation
from socast.core.evaluate.soc.reserve_risk import ALARM, LEVELS, PLANNED
from socast.tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent
from socast.tools.report.soc.tables import HEADS, SHARE_NOTE, format_share, tabulate

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
    tables = (of_plan, of_levels, tabulate_told(result), tabulate_alarms(result), tabulate_baselines(result))
    return [table for table in tables if table.rows]


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
    rows = tuple(
        Row(
            name,
            tuple(
                Cell(text)
                for each in (ours[name], theirs.get(name))
                for text in (format_count(each.n if each else 0), format_share(each.fell) if each else UNKNOWN)
            ),
        )
        for name in ours
        if theirs
    )
    heads = ("cases", "fell below", "cases, regression", "fell below, regression")
    return ReportTable("Risk beside that of the regression", "risk", heads, rows, (LEVEL_NOTE, SHARE_NOTE))


def tabulate_alarms(result: SocEvaluation) -> ReportTable:
    """Return the performance of alarms, by level and time ahead."""
    pooled = f"{LEVELS[0]} to {LEVELS[-1]} %"
    groups = {format_level(level): by_hours for level, by_hours in result.reserve.levels.items()}
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
    notes = (ALARM_NOTE, SHARE_NOTE)
    made: ReportTable = tabulate("Alarms", shown, RiskFigures, corner="level, before the end", more=more, notes=notes)
    return made._replace(rows=tuple(row._replace(total=row.name.startswith(f"{pooled},")) for row in made.rows))


def _counted(some: int, share: ClusteredShare) -> str:
    rate = format_share(share)
    return UNKNOWN if rate == UNKNOWN else f"{format_count(some)}: {rate}"


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


def format_level(level: str) -> str:
    """Return the name of a level, for readers."""
    return "the plan's reserve" if level == PLANNED else f"{level} %"
