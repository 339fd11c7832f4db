"""Figures of a diagnosis: error against noise, slices, effects with their intervals, and what remains."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import plotly.graph_objects as go

from tools.report.diagnosis import sentences
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, get_mapping, get_number, get_part
from tools.report.figure_style import add_reference_line, draw_bars, draw_curve, escape_label, get_style, make_figure

ROW: Final = 34
"""Height of a row. [px]"""
PERCENT: Final = 100.0


def draw_errors(result: Result) -> list[Illustration]:
    """Return the error as given, refitted, and with the named effects one after the other, above the noise."""
    found = get_mapping(result, "error")
    told = [("as given", found.get("mae_kwh"))]
    steps = [step for step in result.get("steps") or () if get_number(step.get("mae_kwh")) is not None]
    if steps:
        told += [(_step(step), step["mae_kwh"]) for step in steps]
    else:
        told.append(("its terms refitted", found.get("mae_refitted_kwh")))
    known = [(escape_label(what), value) for what, value in told if get_number(value) is not None]
    if not known:
        return []
    names, values = [what for what, _ in known], [value for _, value in known]
    made = make_figure([draw_bars("error", get_style(2), names, values)], 90 + ROW * len(known))
    if (floor := get_number(found.get("noise_floor_kwh"))) is not None:
        add_reference_line(made, "measurement noise", floor)
    made.update_xaxes(title_text="Mean absolute error of a ride [kWh]", rangemode="tozero")
    made.update_yaxes(title_text="Model", type="category", autorange="reversed")
    caption = (
        "Dashed: what a model without any error would seem to be off, by the measurement's own noise. From the second "
        "bar on the model's own terms are fitted to these rides, for each car; each effect is fitted to other days."
    )
    return [Illustration("errors", "Error against measurement noise", caption, made)]


def draw_slices(result: Result) -> list[Illustration]:
    """Return the bias of each slice with its interval."""
    found = [one for one in result.get("slices") or () if get_number(one.get("bias_kwh")) is not None]
    if not found:
        return []
    spans = [_span(one["bias_kwh"], one.get("ci95")) for one in found]
    made = _forest("bias", [str(one.get("where")) for one in found], [one["bias_kwh"] for one in found], spans, place=4)
    made.update_xaxes(title_text="Predicted less measured, less that of other rides [kWh]")
    made.update_yaxes(title_text="Rides")
    add_reference_line(made, "", 0.0)
    caption = "Points: mean over rides of the half that confirmed it; lines: 95 % intervals. Left of 0: too little."
    return [Illustration("slices", "Where the model fails", caption, made)]


def draw_effects(result: Result) -> list[Illustration]:
    """Return the gain of each missing effect with its interval."""
    found = [one for one in result.get("missing") or () if get_number(one.get("gain")) is not None]
    if not found:
        return []
    names = [f"{i}. {sentences.name_effect(one)}{_scope(one)}" for i, one in enumerate(found, start=1)]
    gains = [PERCENT * one["gain"] for one in found]
    limits = [sentences.read_interval(one.get("gain_ci95")) for one in found]
    spans = [None if pair is None else (PERCENT * pair[0], PERCENT * pair[1]) for pair in limits]
    made = _forest("gain", names, gains, spans, place=5)
    made.update_xaxes(title_text="Fall of the squared error on held-out days [%]")
    made.update_yaxes(title_text="Effect")
    add_reference_line(made, "", 0.0)
    caption = (
        "Each effect given those above it; of the error that the model's own terms could not take up. Lines: 95 % "
        "intervals."
    )
    return [Illustration("effects", "What is missing, best first", caption, made), *draw_coefficients(found)]


def draw_coefficients(found: Sequence[Mapping[str, Any]]) -> list[Illustration]:
    """Return each coefficient with its interval, over its plausible range."""
    names, values, spans = [], [], []
    for one in found:
        own = get_mapping(one, "coefficient")
        value, low, high = (get_number(own.get(key)) for key in ("value", "low", "high"))
        if value is None or low is None or high is None or high <= low:
            continue
        limits = sentences.read_interval(own.get("ci95"))
        names.append(f"{sentences.name_effect(one)}, {low:g} to {high:g} {own.get('unit') or ''}".removesuffix(" 1"))
        values.append((value - low) / (high - low))
        spans.append(None if limits is None else tuple((end - low) / (high - low) for end in limits))
    if not names:
        return []
    made = _forest("coefficient", names, values, spans, place=6)
    made.add_vrect(x0=0.0, x1=1.0, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    made.update_xaxes(title_text="Coefficient: 0 is the lower end of its plausible range, 1 the upper [1]")
    made.update_yaxes(title_text="Effect and range")
    caption = (
        "Shaded: what is plausible. A coefficient outside is a finding by itself: something else may hide behind it."
    )
    return [Illustration("coefficients", "Coefficients against what is plausible", caption, made)]


TITLES: Final = {
    "ambient_c": "outside temperature",
    "average_speed_kmh": "average speed",
    "precipitation_mm_h": "rain and snow that falls",
    "wind_speed_kmh": "wind speed",
    "soc_start_pct": "state of charge",
    "battery_temperature_c": "battery temperature",
    "elapsed_s": "time since the ride began",
    "parked_s": "time parked before the ride",
    "occupants": "people aboard",
    "odometer_km": "odometer",
    "start_s": "date",
}
"""What people call the things that an error may depend on."""
WH: Final = 1000.0
"""[Wh/kWh]"""


def draw_remainder(result: Result) -> list[Illustration]:
    """Return how much can be predicted of what is left, and the shapes of it."""
    found = get_mapping(result, "structure")
    told = [
        ("before the named effects", get_number(found.get("before"))),
        ("after them", get_number(found.get("after"))),
    ]
    known = [(what, PERCENT * max(value, 0.0)) for what, value in told if value is not None]
    shown = []
    if known:
        trace = draw_bars("predictable", get_style(3), [what for what, _ in known], [value for _, value in known])
        made = make_figure([trace], 90 + ROW * len(known))
        made.update_xaxes(title_text="Variance of what is left that can be predicted [%]", rangemode="tozero")
        made.update_yaxes(title_text="What is left", type="category", autorange="reversed")
        caption = "By boosted trees, on days that they were not fitted to. What they predict has a cause; 0 is nothing."
        shown.append(Illustration("structure", "Structure that remains", caption, made))
    shapes = [one for one in get_part(result, "structure", "shapes") or () if one.get("x") and one.get("y_kwh")]
    return shown + [_shape(i, one) for i, one in enumerate(shapes)]


def _shape(place: int, found: Mapping[str, Any]) -> Illustration:
    """Return what is left along one property of windows."""
    feature, unit = str(found.get("feature")), str(found.get("unit") or "1")
    title = TITLES.get(feature, feature.replace("_", " "))
    left = [WH * value for value in found["y_kwh"]]
    x = [datetime.fromtimestamp(at, UTC) for at in found["x"]] if feature == "start_s" else list(found["x"])
    made = make_figure([draw_curve(escape_label(title), get_style(2 + place), x, left)], 320)
    made.update_layout(showlegend=False)
    made.update_xaxes(title_text=escape_label(title if feature == "start_s" else f"{title} [{unit}]"))
    made.update_yaxes(title_text="Measured less predicted [Wh]", zeroline=True)
    caption = (
        "Mean of what the named effects leave of a window's energy, by twelfths of the windows; its scatter from one "
        "point to the next is chance."
    )
    return Illustration(f"shape-{place}", f"What is left by {title}", caption, made, small=True)


def _forest(name: str, names: list[str], values: list[float], spans: Sequence[Any], *, place: int) -> go.Figure:
    """Return points in rows with intervals that need not be symmetric."""
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
    """Return the ends of an interval that is given as such, or by half its width."""
    if (limits := sentences.read_interval(ci95)) is not None:
        return limits
    half = get_number(ci95)
    return None if half is None else (value - half, value + half)


def _scope(found: Mapping[str, Any]) -> str:
    said = str(found.get("scope") or "all")
    return "" if said == "all" else f", {said}"


def _step(step: Mapping[str, Any]) -> str:
    return "its terms refitted" if not step.get("effect") else f"with {step['effect']}{_scope(step)}"
