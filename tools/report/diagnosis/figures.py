"""Draw a diagnosis: error against noise, slices, effects with their intervals, and the remaining error."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import plotly.graph_objects as go

from tools.report.diagnosis import sentences
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, get_mapping, get_number, get_part
from tools.report.figure_style import add_reference_line, draw_bars, draw_curve, escape_label, get_style, make_figure

ROW: Final = 34
"""Height of a row of a chart. [px]"""
PERCENT: Final = 100.0


def draw_errors(result: Result) -> list[Illustration]:
    """Draw the error of the model as given, refitted, and with each missing effect added, against the noise."""
    errors = get_mapping(result, "error")
    bars = [("as given", errors.get("mae_kwh"))]
    steps = [step for step in result.get("steps") or () if get_number(step.get("mae_kwh")) is not None]
    if steps:
        bars += [(_step(step), step["mae_kwh"]) for step in steps]
    else:
        bars.append(("same terms refitted", errors.get("mae_refitted_kwh")))
    known = [(escape_label(what), value) for what, value in bars if get_number(value) is not None]
    if not known:
        return []
    names, values = [what for what, _ in known], [value for _, value in known]
    made = make_figure([draw_bars("error", get_style(2), names, values)], 90 + ROW * len(known))
    if (floor := get_number(errors.get("noise_floor_kwh"))) is not None:
        add_reference_line(made, "measurement noise", floor)
    made.update_xaxes(title_text="Mean absolute error of a ride [kWh]", rangemode="tozero")
    made.update_yaxes(title_text="Model", type="category", autorange="reversed")
    caption = (
        "Dashed line: error that measurement noise alone causes. From the second bar on, the terms of the model are "
        "refitted to these rides for each car (in sample). Each effect is fitted to other days than those it is "
        "evaluated on."
    )
    return [Illustration("errors", "Error against measurement noise", caption, made)]


def draw_slices(result: Result) -> list[Illustration]:
    """Draw the bias of each slice with its interval."""
    rows = [one for one in result.get("slices") or () if get_number(one.get("bias_kwh")) is not None]
    if not rows:
        return []
    spans = [_span(one["bias_kwh"], one.get("ci95")) for one in rows]
    made = _forest("bias", [str(one.get("where")) for one in rows], [one["bias_kwh"] for one in rows], spans, place=4)
    made.update_xaxes(title_text="Bias less that of other rides [kWh]")
    made.update_yaxes(title_text="Rides")
    add_reference_line(made, "", 0.0)
    caption = (
        "Points: mean over the rides that confirmed the slice. Lines: 95 % intervals. Left of 0: predicted too little."
    )
    return [Illustration("slices", "Where the model fails", caption, made)]


def draw_effects(result: Result) -> list[Illustration]:
    """Draw the gain of each missing effect with its interval."""
    rows = [one for one in result.get("missing") or () if get_number(one.get("gain")) is not None]
    if not rows:
        return []
    names = [f"{i}. {sentences.name_effect(one)}{_scope(one)}" for i, one in enumerate(rows, start=1)]
    gains = [PERCENT * one["gain"] for one in rows]
    limits = [sentences.read_interval(one.get("gain_ci95")) for one in rows]
    spans = [None if pair is None else (PERCENT * pair[0], PERCENT * pair[1]) for pair in limits]
    made = _forest("gain", names, gains, spans, place=5)
    made.update_xaxes(title_text="Reduction of the squared error on held-out days [%]")
    made.update_yaxes(title_text="Effect")
    add_reference_line(made, "", 0.0)
    caption = (
        "Each effect in the presence of those above it, as a share of the error that the terms of the model cannot "
        "explain. Lines: 95 % intervals."
    )
    return [Illustration("effects", "Missing effects, best first", caption, made), *draw_coefficients(rows)]


def draw_coefficients(rows: Sequence[Mapping[str, Any]]) -> list[Illustration]:
    """Draw each coefficient with its interval over its plausible range."""
    names, values, spans = [], [], []
    for one in rows:
        coefficient = get_mapping(one, "coefficient")
        value, low, high = (get_number(coefficient.get(key)) for key in ("value", "low", "high"))
        if value is None or low is None or high is None or high <= low:
            continue
        limits = sentences.read_interval(coefficient.get("ci95"))
        names.append(
            f"{sentences.name_effect(one)}, {low:g} to {high:g} {coefficient.get('unit') or ''}".removesuffix(" 1")
        )
        values.append((value - low) / (high - low))
        spans.append(None if limits is None else tuple((end - low) / (high - low) for end in limits))
    if not names:
        return []
    made = _forest("coefficient", names, values, spans, place=6)
    made.add_vrect(x0=0.0, x1=1.0, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    made.update_xaxes(title_text="Coefficient: 0 and 1 are the ends of its plausible range [1]")
    made.update_yaxes(title_text="Effect")
    caption = "Shaded: the plausible range. A coefficient outside it may stand for another cause."
    return [Illustration("coefficients", "Coefficients against their plausible ranges", caption, made)]


TITLES: Final = {
    "ambient_c": "outside temperature",
    "average_speed_kmh": "average speed",
    "precipitation_mm_h": "precipitation",
    "wind_speed_kmh": "wind speed",
    "soc_start_pct": "state of charge",
    "battery_temperature_c": "battery temperature",
    "elapsed_s": "time since the ride began",
    "parked_s": "time parked before the ride",
    "occupants": "occupants",
    "odometer_km": "odometer",
    "start_s": "date",
}
"""Axis title of each feature that an error may depend on."""
WH: Final = 1000.0
"""Watt-hours in a kilowatt-hour. [Wh/kWh]"""


def draw_remainder(result: Result) -> list[Illustration]:
    """Draw how much of the remaining error can be predicted, and its mean along each feature."""
    part = get_mapping(result, "structure")
    bars = [
        ("before the missing effects", get_number(part.get("before"))),
        ("after them", get_number(part.get("after"))),
    ]
    known = [(what, PERCENT * max(value, 0.0)) for what, value in bars if value is not None]
    shown = []
    if any(share for _, share in known):
        trace = draw_bars("predictable", get_style(3), [what for what, _ in known], [value for _, value in known])
        made = make_figure([trace], 90 + ROW * len(known))
        made.update_xaxes(title_text="Predictable share of the variance [%]", rangemode="tozero")
        made.update_yaxes(title_text="Error", type="category", autorange="reversed")
        caption = "Predicted by boosted trees on days to which they were not fitted. A predictable error has a cause."
        shown.append(Illustration("structure", "Predictable part of the error", caption, made))
    shapes = [one for one in get_part(result, "structure", "shapes") or () if one.get("x") and one.get("y_kwh")]
    return shown + [_shape(i, one) for i, one in enumerate(shapes)]


def _shape(place: int, part: Mapping[str, Any]) -> Illustration:
    """Draw the mean remaining error along one feature of the windows."""
    feature, unit = str(part.get("feature")), str(part.get("unit") or "1")
    title = TITLES.get(feature, feature.replace("_", " "))
    left = [WH * value for value in part["y_kwh"]]
    x = [datetime.fromtimestamp(at, UTC) for at in part["x"]] if feature == "start_s" else list(part["x"])
    made = make_figure([draw_curve(escape_label(title), get_style(2 + place), x, left)], 320)
    made.update_layout(showlegend=False)
    made.update_xaxes(title_text=escape_label(title if feature == "start_s" else f"{title} [{unit}]"))
    made.update_yaxes(title_text="Measured less predicted [Wh]", zeroline=True)
    caption = "Mean remaining error of a window, for each twelfth of the windows. Scatter between points is chance."
    return Illustration(f"shape-{place}", f"Remaining error by {title}", caption, made, small=True)


def _forest(name: str, names: list[str], values: list[float], spans: Sequence[Any], *, place: int) -> go.Figure:
    """Draw one point per row with an interval that need not be symmetric."""
    look = get_style(place)
    up = [None if span is None else span[1] - value for span, value in zip(spans, values, strict=True)]
    down = [None if span is None else value - span[0] for span, value in zip(spans, values, strict=True)]
    wide = {"type": "data", "array": up, "arrayminus": down, "symmetric": False, "thickness": 1.5, "width": 4}
    points = go.Scatter(
        name=name,
        x=values,
        y=[escape_label(each) for each in names],
        mode="markers",
        marker={"symbol": look.symbol, "size": 10, "color": look.colour},
        error_x=wide if any(each is not None for each in up) else None,
    )
    made = make_figure([points], 100 + ROW * len(names))
    made.update_yaxes(type="category", autorange="reversed")
    return made


def _span(value: float, ci95: Any) -> tuple[float, float] | None:
    """Return the ends of an interval that is given by its ends or by half its width."""
    if (limits := sentences.read_interval(ci95)) is not None:
        return limits
    half = get_number(ci95)
    return None if half is None else (value - half, value + half)


def _scope(part: Mapping[str, Any]) -> str:
    scope = str(part.get("scope") or "all")
    return "" if scope == "all" else f", {scope}"


def _step(step: Mapping[str, Any]) -> str:
    return "same terms refitted" if not step.get("effect") else f"with {step['effect']}{_scope(step)}"
