"""Draw the figures of an evaluation of state-of-charge forecasts: errors, coverage, width, risk and example shifts."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import plotly.graph_objects as go

from socast.core.evaluate.soc.baselines import BASELINES
from socast.core.evaluate.soc.report import NOMINAL
from socast.core.formatting import format_minus
from socast.core.stats.clustered import LEAST_CLUSTERS
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.result import (
    Result,
    get_half_width,
    get_mapping,
    get_number,
    get_part,
    get_vehicle_name,
)
from socast.tools.report.figure_style import REFERENCE_LINE, Style, draw_curve, escape_label, get_style, make_figure
from socast.tools.report.soc.tables import SHOWN_AT, format_bin

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
FEW: Final = f"A line without a point: the interval of a share of fewer than {LEAST_CLUSTERS} vehicle-days."
WIDEST: Final = 1.5
"""Widest interval that is drawn, relative to the largest value of a figure."""
SHADE: Final = "rgba(128,128,128,0.25)"


def select_interval_widths(biases: Sequence[Any], among: Sequence[Any]) -> list[float | None]:
    """Return half widths of intervals; None where an interval would dwarf the figure."""
    most = WIDEST * max((abs(get_number(bias) or 0.0) for bias in among), default=0.0)
    widths = [get_half_width(bias) for bias in biases]
    return [width if width is not None and width <= most else None for width in widths]


def illustrate_time(result: Result) -> list[Illustration]:
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
            draw_coverage(_hours(result), BEFORE),
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
    if SHOWN_AT in get_mapping(result, "overall", "hours"):
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


def _hours(result: Result) -> dict[str, Any]:
    return dict(get_mapping(result, "overall", "hours"))


def draw_errors(result: Result) -> go.Figure:
    """Return a figure of the mean absolute error of forecasts and baselines against the time ahead."""
    by_hours = _hours(result)
    x = [int(hours) for hours in by_hours]
    lines = {"forecast": (FORECAST, [get_part(group, "mae_pct") for group in by_hours.values()])}
    lines |= {
        meaning: (LOOKS[name], [get_part(group, "baselines", name, "mae_pct") for group in by_hours.values()])
        for name, meaning in BASELINES.items()
    }
    among = [value for _, values in lines.values() for value in values]
    traces = [
        _from_zero(
            draw_curve(
                escape_label(name), look, x, [get_number(v) for v in values], select_interval_widths(values, among)
            )
        )
        for name, (look, values) in lines.items()
    ]
    made = make_figure(traces, 380)
    made.update_xaxes(title_text=BEFORE, tickvals=x)
    made.update_yaxes(title_text="Mean absolute error [% of charge]", rangemode="tozero")
    return made


def draw_coverage(groups: Mapping[str, Any], axis: str) -> go.Figure:
    """Return a figure of the coverage of groups, with its interval, and of the target coverage."""
    x, shares = [escape_label(name) for name in groups], [get_part(group, "coverage") for group in groups.values()]
    made = make_figure(_points("coverage", FORECAST, x, shares), 380)
    for share in AIMED:
        made.add_hline(y=share, line=REFERENCE_LINE)
    made.add_hline(y=100.0 * NOMINAL, line={**REFERENCE_LINE, "dash": "solid", "width": 1})
    made.update_layout(showlegend=False)
    made.update_xaxes(title_text=axis, type="category", categoryorder="array", categoryarray=x)
    made.update_yaxes(title_text="Outcomes inside the 90 % interval [%]")
    return made


def _points(name: str, look: Style, x: Sequence[Any], shares: Sequence[Any]) -> list[Any]:
    """Return shares as points with their intervals; where there are too few clusters, the interval alone."""
    enough = [(get_number(get_part(share, "clusters")) or 0.0) >= LEAST_CLUSTERS for share in shares]
    values = [_percent(share, "value") if known else None for share, known in zip(shares, enough, strict=True)]
    points = draw_curve(name, look, list(x), values).update(mode="markers", error_y=_bars(shares))
    alone = [
        (place, [_percent(share, end) for end in ("low", "high")])
        for place, share, known in zip(x, shares, enough, strict=True)
        if not known
    ]
    lines = go.Scatter(
        name=f"{name}: interval of too few vehicle-days",
        x=[place for one, _ in alone for place in (one, one, None)],
        y=[end for _, ends in alone for end in (*ends, None)],
        mode="lines",
        line={"color": look.colour, "dash": look.dash, "width": 2},
        showlegend=False,
        hovertemplate="%{fullData.name}, to %{y:.1f} %<extra></extra>",
    )
    return [points, lines] if alone else [points]


def _from_zero(trace: Any) -> Any:
    """Return a curve whose intervals end at 0, because no value is negative."""
    if trace.error_y.array is not None:
        reach = [None if up is None else min(up, y) for up, y in zip(trace.error_y.array, trace.y, strict=True)]
        trace.error_y.update(symmetric=False, arrayminus=reach)
    return trace


def _bars(shares: Sequence[Any]) -> dict[str, Any]:
    """Return the error bars of shares."""
    low, high = ([_reach(share, end) for share in shares] for end in ("low", "high"))
    return {"symmetric": False, "arrayminus": low, "array": high, "thickness": 1, "width": 3}


def _percent(share: Any, end: str) -> float | None:
    known = get_number(get_part(share, end))
    return None if known is None else 100.0 * known


def _reach(share: Any, end: str) -> float:
    """Return the distance of an end of the interval from a share; 0 where unknown. [%]"""
    value, known = _percent(share, "value"), _percent(share, end)
    return 0.0 if value is None or known is None else abs(known - value)


def draw_width(result: Result) -> go.Figure:
    """Return a figure of the width of the interval against the time ahead."""
    by_hours = _hours(result)
    widths = [get_part(group, "width_pct") for group in by_hours.values()]
    x = [int(hours) for hours in by_hours]
    trace = draw_curve("width", FORECAST, x, [get_number(w) for w in widths], select_interval_widths(widths, widths))
    made = make_figure([_from_zero(trace)], 380)
    made.update_layout(showlegend=False)
    made.update_xaxes(title_text=BEFORE, tickvals=x)
    made.update_yaxes(title_text="Width of the 90 % interval [% of charge]", rangemode="tozero")
    return made


def draw_scatter(result: Result) -> go.Figure:
    """Return a figure of forecasts against outcomes at one time ahead; those outside their interval are marked."""
    forecasts = get_mapping(result, "forecasts")
    rows = [i for i, hours in enumerate(forecasts["hours"]) if str(hours) == SHOWN_AT]
    rows = rows[:: -(-len(rows) // MOST_POINTS)]
    mean, low, high, became = (forecasts[name] for name in ("soc_mean", "soc_p05", "soc_p95", "soc_end"))
    inside = [row for row in rows if low[row] <= became[row] <= high[row]]
    outside = sorted(set(rows) - set(inside))
    traces = [
        go.Scatter(
            name=name,
            x=[mean[row] for row in places],
            y=[became[row] for row in places],
            text=[escape_label(f"{forecasts['vehicle_id'][row]}, shift {forecasts['shift'][row]}") for row in places],
            mode="markers",
            marker={"symbol": symbol, "size": 7, "color": look.colour, "line": {"width": 1}},
            hovertemplate="%{text}: forecast %{x:.1f}, outcome %{y:.1f} %<extra></extra>",
        )
        for name, symbol, look, places in (
            ("inside the interval", "circle-open", FORECAST, inside),
            ("outside", "x", LOOKS["linear"], outside),
        )
    ]
    ends = [min(min(mean[row], became[row]) for row in rows), max(max(mean[row], became[row]) for row in rows)]
    line = {"width": 1.5, "color": REFERENCE_LINE["color"]}
    traces.append(go.Scatter(name="equal", x=ends, y=ends, mode="lines", line=line, hoverinfo="skip"))
    made = make_figure(traces, 400)
    made.update_xaxes(title_text="Forecast of the state of charge at the end [%]")
    made.update_yaxes(title_text="State of charge at the end [%]")
    return made


def illustrate_conditions(result: Result) -> list[Illustration]:
    """Return the coverage by temperature and vehicle model, pooled over times ahead."""
    axes = {"temperature": "Mean outside temperature of the shift [°C]", "vehicle model": "Vehicle model"}
    caption = f"Share of outcomes inside the 90 % interval, all times ahead pooled, with its own 95 % interval. {FEW}"
    shown = []
    for i, (name, axis) in enumerate(axes.items()):
        bins = {
            format_bin(name, str(part["bin"])): get_part(part, "pooled") for part in get_part(result, "by", name) or ()
        }
        if len(bins) > 1:
            made = draw_coverage(bins, axis)
            shown.append(Illustration(f"soc-by-{i}", f"Coverage by {name}", caption, made, small=True))
    return shown


def illustrate_risk(result: Result) -> list[Illustration]:
    """Return forecast risk against outcomes."""
    caption = (
        "Each point is a class of forecast risk, pooled over all times ahead, with the 95 % interval of "
        "the observed share. Line: observed share equals forecast risk. Right of the broken line: alarm. "
        f"{FEW}"
    )
    return [Illustration("soc-risk", "Forecast risk against outcome", caption, draw_risk(result), small=True)]


def draw_risk(result: Result) -> go.Figure:
    """Return a figure of how often shifts fell below a level against the forecast risk."""
    names = {"levels": (FORECAST, "levels"), "plan": (LOOKS["linear"], "the plan's reserve")}
    traces: list[Any] = []
    for key, (look, name) in names.items():
        classes = get_part(result, "reserve", "reliability", key) or ()
        forecast_risks = [100.0 * risk_class["told"] for risk_class in classes]
        points, *alone = _points(name, look, forecast_risks, [get_part(risk_class, "fell") for risk_class in classes])
        points.update(text=[f"{risk_class['n']:,} cases" for risk_class in classes])
        points.update(hovertemplate="%{text}: forecast %{x:.1f}, fell %{y:.1f} %<extra></extra>")
        traces += [points, *alone]
    line = {"width": 1.5, "color": REFERENCE_LINE["color"]}
    equal = go.Scatter(name="equal", x=[0, 100], y=[0, 100], mode="lines", line=line, hoverinfo="skip")
    made = make_figure([*traces, equal], 400)
    made.add_vline(x=100.0 * result["reserve"]["alarm"], line=REFERENCE_LINE)
    made.update_xaxes(title_text="Forecast risk of falling below [%]")
    made.update_yaxes(title_text="Share that fell below [%]")
    return made


def illustrate_examples(result: Result) -> list[Illustration]:
    """Return example shifts."""
    caption = (
        "State of charge, and the forecast of its value at the end, as published at each time: mean "
        "(line) and 90 % interval (shaded). Star: outcome. Broken line: reserve."
    )
    return [
        Illustration(f"soc-example-{i}", _title(shift), caption, draw_example(shift), small=True)
        for i, shift in enumerate(get_part(result, "examples") or ())
    ]


def _title(shift: Mapping[str, Any]) -> str:
    ambient = get_number(shift["ambient_c"])
    warmth = "" if ambient is None else format_minus(f", {ambient:.0f} °C")
    car = f"{shift['vehicle_id']} ({get_vehicle_name(shift['vehicle_model'])})"
    return f"{shift['why'].capitalize()}: {car}, {shift['date']}{warmth}"


def draw_example(shift: Mapping[str, Any]) -> go.Figure:
    """Return a figure of a shift: its state of charge, and how the forecast of its end narrowed."""
    x: Sequence[Any] = shift["hours_ahead"]
    thin = {"width": 1, "color": FORECAST.colour}
    upper = go.Scatter(name="95 %", x=x, y=shift["soc_p95_pct"], mode="lines", line=thin, showlegend=False)
    lower = go.Scatter(
        name="90 % interval", x=x, y=shift["soc_p05_pct"], mode="lines", line=thin, fill="tonexty", fillcolor=SHADE
    )
    mean = draw_curve("forecast of the end", FORECAST, list(x), shift["soc_mean_pct"]).update(mode="lines")
    soc = draw_curve("state of charge", LOOKS["model_mean"], list(x), shift["soc_pct"]).update(mode="lines")
    became = go.Scatter(
        name="the end", x=[0.0], y=[shift["soc_end_pct"]], mode="markers", marker={"symbol": "star", "size": 13}
    )
    made = make_figure([upper, lower, mean, soc, became.update(marker_color=LOOKS["linear"].colour)], 360)
    if (reserve := get_number(shift["reserve_soc_pct"])) is not None:
        made.add_hline(y=reserve, line=REFERENCE_LINE)
    made.update_xaxes(title_text=BEFORE, autorange="reversed")
    made.update_yaxes(title_text=CHARGE, rangemode="tozero")
    return made
