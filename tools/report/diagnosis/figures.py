"""Draw a diagnosis: error against noise, slices, effects with their intervals, and the remaining error."""

from collections.abc import Sequence
from typing import Any, Final

import plotly.graph_objects as go

from socast.core.diagnose.add.terms import name_scoped
from socast.core.diagnose.records import Diagnosis, ErrorAfterEffect, NamedEffect
from socast.core.records import ConfidenceInterval
from socast.tools.report.cells import format_count
from socast.tools.report.diagnosis.partial_figures import (
    describe_coefficient,
    draw_coefficient_rows,
    draw_partial_residuals,
)
from socast.tools.report.diagnosis.residual_figures import draw_profiles
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.figure_style import add_reference_line, escape_label, get_style, make_figure

ROW: Final = 34
"""Height of a row of a chart. [px]"""
PERCENT: Final = 100.0


def draw_errors(result: Diagnosis) -> list[Illustration]:
    """Draw the error of the model as given, refitted, and with each missing effect added, against the noise."""
    errors = result.error
    rows: list[tuple[str, float | None, Any]] = [("as given", errors.mae_kwh, None)]
    steps = [step for step in result.steps if step.mae_kwh is not None]
    rows += [(_step(step), step.mae_kwh, step.mae_ci95_kwh) for step in steps]
    if not steps:
        rows.append(("same terms refitted", errors.mae_refitted_kwh, None))
    known = [(what, float(value), spread) for what, value, spread in rows if value is not None]
    if not known:
        return []
    values = [value for _, value, _ in known]
    spans = [_span(value, spread) for _, value, spread in known]
    made = _forest("error", [what for what, _, _ in known], values, spans, place=2)
    if (floor := errors.noise_floor_kwh) is not None:
        made.add_vrect(x0=0.0, x1=floor, fillcolor="#8a8a8a", opacity=0.15, line_width=0, layer="below")
        add_reference_line(made, "measurement noise", floor)
    made.update_xaxes(title_text="Mean absolute error of a ride [kWh]", rangemode="tozero")
    made.update_yaxes(title_text="Step")
    caption = (
        "Lines: 95 % intervals, where rides of one vehicle-day may resemble each other. Shaded: error that measurement "
        "noise alone causes. From the second row on, the terms of the model are refitted to these rides for each car "
        "(in sample). Each effect is fitted to other days than those it is evaluated on."
    )
    return [Illustration("errors", "Error against measurement noise, step by step", caption, made)]


def draw_slices(result: Diagnosis) -> list[Illustration]:
    """Draw the bias of each slice with its interval."""
    rows = result.slices
    if not rows:
        return []
    spans = [one.ci95 for one in rows]
    names = [f"{one.where} ({format_count(one.rides)})" for one in rows]
    made = _forest("bias", names, [one.bias_kwh for one in rows], spans, place=4)
    made.update_xaxes(title_text="Bias less that of other rides [kWh]")
    made.update_yaxes(title_text="Rides")
    add_reference_line(made, "", 0.0)
    caption = (
        "Points: mean over the rides that confirmed the slice. Lines: 95 % intervals. Left of 0: predicted too little. "
        "In parentheses: the number of rides."
    )
    return [Illustration("slices", "Where the model fails", caption, made)]


def draw_effects(result: Diagnosis) -> list[Illustration]:
    """Draw the gain of each missing effect with its interval."""
    rows = [one for one in result.missing if one.gain is not None]
    if not rows:
        return []
    names = [f"{i}. {name_scoped(one.name, one.scope)}" for i, one in enumerate(rows, start=1)]
    gains = [PERCENT * (one.gain or 0.0) for one in rows]
    limits = [one.gain_ci95 for one in rows]
    spans = [None if pair is None else (PERCENT * pair[0], PERCENT * pair[1]) for pair in limits]
    made = _forest("gain", names, gains, spans, place=5)
    low = min(0.0, *gains, *(pair[0] for pair in spans if pair))
    high = max(0.0, *gains, *(pair[1] for pair in spans if pair))
    room = 0.04 * (high - low)
    title = "Reduction of the squared error on held-out days [%]"
    made.update_xaxes(title_text=title, range=[low - room, high + room])
    made.update_yaxes(title_text="Effect")
    add_reference_line(made, "", 0.0)
    caption = (
        "Each effect beside the others, as a share of the error that the terms of the model cannot explain. "
        "Lines: 95 % intervals."
    )
    gains_figure = Illustration("effects", "Missing effects, plausible ones first", caption, made)
    return [gains_figure, *draw_coefficients(rows), *draw_partial_residuals(result)]


def draw_coefficients(rows: Sequence[NamedEffect]) -> list[Illustration]:
    """Draw each coefficient with its interval in its own unit, over its plausible range."""
    shown = []
    for place, one in enumerate(rows):
        coefficient = one.coefficient
        value, low, high = coefficient.value, coefficient.low, coefficient.high
        if value is None or low is None or high is None or high <= low:
            continue
        name = one.name
        quantity = describe_coefficient(one.partial_residual)
        made = draw_coefficient_rows([(one.effect, value, coefficient.ci95)], coefficient, quantity, "Effect")
        caption = "Line: 95 % interval. Shaded: the plausible range. A coefficient outside it may have another cause."
        title = f"{place + 1}. {name}: coefficient and plausible range"
        shown.append(Illustration(f"coefficient-{place}", title, caption, made, small=True))
    return shown


def draw_remainder(result: Diagnosis) -> list[Illustration]:
    """Draw the energy of each cause outside the library with its interval, and the remaining error by feature."""
    rows = [one for one in result.unknown if one.energy_share is not None]
    shown = []
    if rows:
        limits = [one.energy_share_ci95 for one in rows]
        spans = [None if pair is None else (PERCENT * pair[0], PERCENT * pair[1]) for pair in limits]
        names = [f"{i}. {one.formula.removeprefix('P = c · ')}" for i, one in enumerate(rows, start=1)]
        made = _forest("energy", names, [PERCENT * (one.energy_share or 0.0) for one in rows], spans, place=3)
        made.update_xaxes(title_text="Share of the measured energy [%]")
        made.update_yaxes(title_text="Form")
        add_reference_line(made, "", 0.0)
        caption = "Each form beside the others and beside what is named. Lines: 95 % intervals."
        shown.append(Illustration("unknown", "Causes outside the library", caption, made))
    return [*shown, *draw_profiles(result)]


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


def _span(value: float, half: float | None) -> ConfidenceInterval | None:
    """Return the ends of an interval that is given by half its width."""
    return None if half is None else (value - half, value + half)


def _step(step: ErrorAfterEffect) -> str:
    return "same terms refitted" if not step.effect else f"with {name_scoped(step.effect, step.scope)}"
