"""Show an evaluation of state-of-charge forecasts: in the terminal, and as one page of tables and figures."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.soc.baselines import BASELINES
from socast.core.evaluate.soc.records import ClusteredShare, EvaluatedShifts, ExampleShift, SocEvaluation
from socast.core.evaluate.soc.regression import NOMINAL
from socast.core.formatting import format_count, format_minus
from socast.core.stats.clustered import LEAST_CLUSTERS
from socast.tools.report.document import Illustration, Report, Section, print_report
from socast.tools.report.evaluation.result import get_vehicle_name
from socast.tools.report.figure_style import (
    REFERENCE_LINE,
    Style,
    draw_curve,
    draw_equality,
    escape_label,
    get_style,
    make_error_bars,
    make_figure,
    to_percent,
)
from socast.tools.report.soc import tables
from socast.tools.report.soc.tables import SHOWN_AT, format_bin
from socast.tools.report.table import keep_filled

TITLE: Final = "Forecasts of the state of charge"
AHEAD: Final = "ahead"
"""Key of the section that is printed last."""


def show(result: SocEvaluation, console: Console) -> None:
    """Print an evaluation, with its main result last."""
    report = build_report(result)
    print_report(report, console, last=AHEAD)
    for sentence in report.lead:
        console.print(Text(sentence, style="bold"), highlight=False)


def build_report(result: SocEvaluation) -> Report:
    """Return the report of an evaluation."""
    sections = build_sections(result)
    lead = tables.describe_result(result)
    return Report("evaluate-soc", "evaluate-soc", TITLE, sections, lead, result.notes, result, FIGURES)


def build_sections(result: SocEvaluation) -> list[Section]:
    """Return the sections of an evaluation that have something to show."""
    by_time = [tables.tabulate_by_time(result), *keep_filled(tables.tabulate_intervals(result))]
    sections = [
        Section(AHEAD, "Errors of the forecasts", describe_evaluation(result.about), by_time),
        Section("conditions", "Errors by condition", "", tables.tabulate_conditions(result)),
        Section("legs", "Leg by leg, and around charges", "", tables.tabulate_legs(result)),
        Section(
            "reserve",
            "The risk of ending below a reserve",
            tables.describe_reserve(result),
            tables.tabulate_risk(result),
        ),
    ]
    return [*(each for each in sections if keep_filled(*each.tables)), Section("examples", "Example shifts", "", [])]


def describe_evaluation(about: EvaluatedShifts) -> str:
    """Return which forecasts were evaluated, in words."""
    left = ", ".join(f"{n:,} {why}" for why, n in about.left_out.items())
    cars = f"{format_count(about.vehicles, 'car')} on {format_count(about.vehicle_days, 'vehicle-day')}"
    warm_up = f"{format_count(about.warm_up_shifts, 'shift')} ended before the first interval was available"
    return (
        f"{format_count(about.forecasts, 'forecast')} of {about.judged_shifts:,} of "
        f"{format_count(about.shifts, 'shift')}, by {cars}. "
        f"Evaluated from {about.first_date} to {about.last_date}; {warm_up}. "
        f"Forecasts left out: {left or 'none'}."
    )


FORECAST: Final = get_style(5)
LOOKS: Final = {"linear": get_style(4), "model_mean": get_style(2), "rating": get_style(0), "regression": get_style(1)}
"""Styles of the baselines."""
AIMED: Final = (88.0, 92.0)
"""Between these the coverage should be. [%]"""
MOST_POINTS: Final = 2000
"""Largest number of forecasts in a scatter plot."""
BEFORE: Final = "Time before the shift's end [h]"
CHARGE: Final = "State of charge [%]"
WIDE: Final = "Intervals far wider than the figure (few shifts) are left out."
FEW: Final = f"A line without a point: the interval of a share of fewer than {LEAST_CLUSTERS} independent cases."
WIDEST: Final = 1.5
"""Widest interval that is drawn, relative to the largest value of a figure."""
SHADE: Final = "rgba(128,128,128,0.25)"


def select_interval_widths(estimates: Sequence[EstimatedValue], among: Sequence[EstimatedValue]) -> list[float | None]:
    """Return half widths of intervals; None where an interval would dwarf the figure."""
    most = WIDEST * max((abs(each.value or 0.0) for each in among), default=0.0)
    return [each.ci95 if each.ci95 is not None and each.ci95 <= most else None for each in estimates]


def illustrate_time(result: SocEvaluation) -> list[Illustration]:
    """Return error, coverage and width by the time ahead, and forecasts against outcomes."""
    aim = f"{AIMED[0]:.0f} and {AIMED[1]:.0f} %"
    shown = [
        Illustration(
            "soc-error",
            "Error by time ahead",
            f"Mean absolute error of the forecast and of the baselines, with 95 % intervals. {WIDE}",
            draw_errors(result),
            small=True,
        ),
        Illustration(
            "soc-coverage",
            "Coverage by time ahead",
            f"Share of outcomes inside the 90 % interval, with its own 95 % interval; broken lines at {aim}. {FEW}",
            draw_coverage({name: each.coverage for name, each in result.overall.hours.items()}, BEFORE),
            small=True,
        ),
        Illustration(
            "soc-width",
            "Width by time ahead",
            f"Mean width of the 90 % interval, with 95 % intervals of that mean. {WIDE}",
            draw_width(result),
            small=True,
        ),
    ]
    if SHOWN_AT in result.overall.hours:
        caption = (
            f"Each point is a shift, {SHOWN_AT} h before its end. Line: forecast equals outcome. Crosses: "
            "outcome outside the 90 % interval."
        )
        shown.append(
            Illustration(
                "soc-scatter",
                f"Forecast against outcome, {SHOWN_AT} h ahead",
                caption,
                draw_scatter(result),
                small=True,
            )
        )
    return shown


def draw_errors(result: SocEvaluation) -> go.Figure:
    """Return a figure of the mean absolute error of forecasts and baselines against the time ahead."""
    x, groups = [int(hours) for hours in result.overall.hours], list(result.overall.hours.values())
    lines = {"forecast": (FORECAST, [group.mae_pct for group in groups])}
    lines |= {
        meaning: (LOOKS[name], [group.baselines[name].mae_pct for group in groups])
        for name, meaning in BASELINES.items()
    }
    among = [value for _, values in lines.values() for value in values]
    traces = [_draw_estimates(escape_label(name), look, x, values, among) for name, (look, values) in lines.items()]
    return make_figure(
        traces,
        380,
        x={"title_text": BEFORE, "tickvals": x},
        y={"title_text": "Mean absolute error [% of charge]", "rangemode": "tozero"},
    )


def draw_coverage(shares: Mapping[str, ClusteredShare], axis: str) -> go.Figure:
    """Return a figure of the coverage of groups, with its interval, and of the target coverage."""
    x = [escape_label(name) for name in shares]
    made = make_figure(
        _points("coverage", FORECAST, x, list(shares.values())),
        380,
        x={"title_text": axis, "type": "category", "categoryorder": "array", "categoryarray": x},
        y={"title_text": "Outcomes inside the 90 % interval [%]"},
        showlegend=False,
    )
    for share in AIMED:
        made.add_hline(y=share, line=REFERENCE_LINE)
    made.add_hline(y=100.0 * NOMINAL, line={**REFERENCE_LINE, "dash": "solid", "width": 1})
    return made


def _points(name: str, look: Style, x: Sequence[Any], shares: Sequence[ClusteredShare]) -> list[Any]:
    """Return shares as points with their intervals; where there are too few clusters, the interval alone."""
    enough = [share.is_firm for share in shares]
    values = [to_percent(share.value) if known else None for share, known in zip(shares, enough, strict=True)]
    low = [_reach(share.value, share.low) for share in shares]
    high = [_reach(share.value, share.high) for share in shares]
    points = draw_curve(name, look, list(x), values).update(mode="markers", error_y=make_error_bars(high, low))
    alone = [(place, share) for place, share, known in zip(x, shares, enough, strict=True) if not known]
    lines = go.Scatter(
        name=f"{name}: interval of too few cases",
        x=[place for one, _ in alone for place in (one, one, None)],
        y=[end for _, share in alone for end in (to_percent(share.low), to_percent(share.high), None)],
        mode="lines",
        line={"color": look.colour, "dash": look.dash, "width": 2},
        showlegend=False,
        hovertemplate="%{fullData.name}, to %{y:.1f} %<extra></extra>",
    )
    return [points, lines] if alone else [points]


def _draw_estimates(
    name: str, look: Style, x: list[int], values: Sequence[EstimatedValue], among: Sequence[EstimatedValue]
) -> Any:
    """Return a curve whose intervals end at 0, because no value is negative."""
    trace = draw_curve(name, look, x, [each.value for each in values], select_interval_widths(values, among))
    if trace.error_y.array is not None:
        reach = [None if up is None else min(up, y) for up, y in zip(trace.error_y.array, trace.y, strict=True)]
        trace.error_y.update(symmetric=False, arrayminus=reach)
    return trace


def _reach(share: float | None, end: float | None) -> float:
    """Return the distance of an end of the interval from a share; 0 where unknown. [%]"""
    return 0.0 if share is None or end is None else abs(100.0 * end - 100.0 * share)


def draw_width(result: SocEvaluation) -> go.Figure:
    """Return a figure of the width of the interval against the time ahead."""
    x = [int(hours) for hours in result.overall.hours]
    widths = [each.width_pct for each in result.overall.hours.values()]
    return make_figure(
        [_draw_estimates("width", FORECAST, x, widths, widths)],
        380,
        x={"title_text": BEFORE, "tickvals": x},
        y={"title_text": "Width of the 90 % interval [% of charge]", "rangemode": "tozero"},
        showlegend=False,
    )


def draw_scatter(result: SocEvaluation) -> go.Figure:
    """Return a figure of forecasts against outcomes at one time ahead; those outside their interval are marked."""
    shown = result.forecasts[lambda cases: cases["hours"] == int(SHOWN_AT)]
    shown = shown.iloc[:: -(-len(shown) // MOST_POINTS)]
    inside = shown["soc_end"].between(shown["soc_p05"], shown["soc_p95"])
    traces = [
        go.Scatter(
            name=name,
            x=cases["soc_mean"].tolist(),
            y=cases["soc_end"].tolist(),
            text=[
                escape_label(f"{car}, shift {n}") for car, n in zip(cases["vehicle_id"], cases["shift"], strict=True)
            ],
            mode="markers",
            marker={"symbol": symbol, "size": 7, "color": look.colour, "line": {"width": 1}},
            hovertemplate="%{text}: forecast %{x:.1f}, outcome %{y:.1f} %<extra></extra>",
        )
        for name, symbol, look, cases in (
            ("inside the interval", "circle-open", FORECAST, shown[inside]),
            ("outside", "x", LOOKS["linear"], shown[~inside]),
        )
    ]
    both = shown[["soc_mean", "soc_end"]].to_numpy()
    traces.append(draw_equality([float(both.min()), float(both.max())]))
    return make_figure(
        traces,
        400,
        x={"title_text": "Forecast of the state of charge at the end [%]"},
        y={"title_text": "State of charge at the end [%]"},
    )


def illustrate_conditions(result: SocEvaluation) -> list[Illustration]:
    """Return the coverage by temperature and vehicle model, pooled over times ahead."""
    axes = {"temperature": "Mean outside temperature of the shift [°C]", "vehicle model": "Vehicle model"}
    caption = f"Share of outcomes inside the 90 % interval, all times ahead pooled, with its own 95 % interval. {FEW}"
    shown = []
    for i, (name, axis) in enumerate(axes.items()):
        bins = {format_bin(name, part.bin): part.pooled.coverage for part in result.by.get(name, ())}
        if len(bins) > 1:
            made = draw_coverage(bins, axis)
            shown.append(Illustration(f"soc-by-{i}", f"Coverage by {name}", caption, made, small=True))
    return shown


def illustrate_risk(result: SocEvaluation) -> list[Illustration]:
    """Return forecast risk against outcomes."""
    caption = (
        "Each point is a class of forecast risk, pooled over all times ahead, with the 95 % interval of "
        "the observed share. Line: observed share equals forecast risk. Right of the broken line: alarm. "
        f"{FEW}"
    )
    return [Illustration("soc-risk", "Forecast risk against outcome", caption, draw_risk(result), small=True)]


def draw_risk(result: SocEvaluation) -> go.Figure:
    """Return a figure of how often shifts fell below a level against the forecast risk."""
    names = {"levels": (FORECAST, "levels"), "plan": (LOOKS["linear"], "the plan's reserve")}
    traces: list[Any] = []
    for key, (look, name) in names.items():
        classes = result.reserve.reliability.get(key, ())
        points, *alone = _points(name, look, [100.0 * each.told for each in classes], [each.fell for each in classes])
        points.update(text=[f"{each.n:,} cases" for each in classes])
        points.update(hovertemplate="%{text}: forecast %{x:.1f}, fell %{y:.1f} %<extra></extra>")
        traces += [points, *alone]
    made = make_figure(
        [*traces, draw_equality([0, 100])],
        400,
        x={"title_text": "Forecast risk of falling below [%]"},
        y={"title_text": "Share that fell below [%]"},
    )
    made.add_vline(x=100.0 * result.reserve.alarm, line=REFERENCE_LINE)
    return made


def illustrate_examples(result: SocEvaluation) -> list[Illustration]:
    """Return example shifts."""
    caption = (
        "State of charge, and the forecast of its value at the end, as published at each time: mean "
        "(line) and 90 % interval (shaded). Star: outcome. Broken line: reserve."
    )
    return [
        Illustration(f"soc-example-{i}", _title(shift), caption, draw_example(shift), small=True)
        for i, shift in enumerate(result.examples)
    ]


def _title(shift: ExampleShift) -> str:
    warmth = "" if shift.ambient_c is None else format_minus(f", {shift.ambient_c:.0f} °C")
    car = f"{shift.vehicle_id} ({get_vehicle_name(shift.vehicle_model)})"
    return f"{shift.why.capitalize()}: {car}, {shift.date}{warmth}"


def draw_example(shift: ExampleShift) -> go.Figure:
    """Return a figure of a shift: its state of charge, and how the forecast of its end narrowed."""
    x = shift.hours_ahead
    thin = {"width": 1, "color": FORECAST.colour}
    upper = go.Scatter(name="95 %", x=x, y=shift.soc_p95_pct, mode="lines", line=thin, showlegend=False)
    lower = go.Scatter(
        name="90 % interval", x=x, y=shift.soc_p05_pct, mode="lines", line=thin, fill="tonexty", fillcolor=SHADE
    )
    mean = draw_curve("forecast of the end", FORECAST, x, shift.soc_mean_pct).update(mode="lines")
    soc = draw_curve("state of charge", LOOKS["model_mean"], x, shift.soc_pct).update(mode="lines")
    became = go.Scatter(
        name="the end", x=[0.0], y=[shift.soc_end_pct], mode="markers", marker={"symbol": "star", "size": 13}
    )
    made = make_figure(
        [upper, lower, mean, soc, became.update(marker_color=LOOKS["linear"].colour)],
        360,
        x={"title_text": BEFORE, "autorange": "reversed"},
        y={"title_text": CHARGE, "rangemode": "tozero"},
    )
    if shift.reserve_soc_pct is not None:
        made.add_hline(y=shift.reserve_soc_pct, line=REFERENCE_LINE)
    return made


FIGURES: Final = {
    AHEAD: illustrate_time,
    "conditions": illustrate_conditions,
    "reserve": illustrate_risk,
    "examples": illustrate_examples,
}
"""Key of a section -> function that draws its figures."""
