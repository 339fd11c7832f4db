"""Draw a diagnosis: error, slices, effects, probable causes, location of the error, cars, and what remains."""

from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from typing import Any, Final

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from socast.core.diagnose.add.terms import name_scoped
from socast.core.diagnose.records import CarDeviation, CauseProbability, Diagnosis, LocatedLoad, NamedEffect
from socast.core.records import ConfidenceInterval
from socast.tools.report.diagnosis.finding_words import describe_deviation
from socast.tools.report.diagnosis.location_sentences import LEVEL_NAMES
from socast.tools.report.diagnosis.residual_figures import (
    describe_coefficient,
    draw_coefficient_rows,
    draw_partial_residuals,
    draw_profiles,
)
from socast.tools.report.diagnosis.sentences import CAUSE_NAMES, LEAST_PROBABILITY
from socast.tools.report.document import Illustration
from socast.tools.report.figure_style import (
    add_reference_line,
    apply_layout,
    draw_bars,
    draw_interval_rows,
    escape_label,
    get_style,
    make_error_bars,
    make_figure,
)
from socast.tools.report.table import format_chance, format_count

PERCENT: Final = 100.0
ROW: Final = 34
"""Height of a row with an interval. [px]"""
CAUSE_ROW: Final = 28
"""Height of a bar of a cause. [px]"""
SMALL_ROW: Final = 26
"""Height of a row of a car or a load. [px]"""
GAP: Final = 46
"""Height between two panels. [px]"""
MOST: Final = 12
"""Largest number of bars of effects; the less probable effects share the last one."""
MOST_CARS: Final = 40
"""Largest number of cars that are drawn."""
MONTH_S: Final = 365.25 / 12.0 * 86_400.0
"""Length of a month. [s]"""
KINDS: Final = {
    "constant": "per second",
    "rolling": "per km",
    "drag": "per km × speed²",
    "climbing": "per metre climbed",
    "braking": "per braking",
    "beginning": "at the beginning",
}
"""Names of the kinds, which fit beside a narrow figure; they are rows of each panel in this order."""
LOCATION: Final = (
    "How much the rides, vehicle-days or vehicles differ in each kind of load that the model does not explain, all "
    "kinds in the same unit. Points: standard deviation between them. Lines: 95 % intervals. Ticks: what sampling "
    "alone, or the usual spread between vehicles, may cause. Filled: the data require the load beside the others, and "
    "its interval lies beyond the tick. Open: not so; each is estimated by itself and may take up what another causes."
)


def draw_errors(result: Diagnosis) -> list[Illustration]:
    """Draw the error of the model as given, refitted, and with each missing effect added, against the noise."""
    errors = result.error
    rows: list[tuple[str, float | None, float | None]] = [("as given", errors.mae_kwh, None)]
    for step in result.steps:
        what = f"with {name_scoped(step.effect, step.scope)}" if step.effect else "same terms refitted"
        rows.append((what, step.mae_kwh, step.mae_ci95_kwh))
    if all(step.mae_kwh is None for step in result.steps):
        rows.append(("same terms refitted", errors.mae_refitted_kwh, None))
    known = [(what, value, half) for what, value, half in rows if value is not None]
    if not known:
        return []
    spans = [None if half is None else (value - half, value + half) for _, value, half in known]
    names, values = [what for what, *_ in known], [value for _, value, _ in known]
    title = "Mean absolute error of a ride [kWh]"
    made = _draw_rows("error", names, values, spans, {"title_text": title, "rangemode": "tozero"}, "Step", place=2)
    if (floor := errors.noise_floor_kwh) is not None:
        made.add_vrect(x0=0.0, x1=floor, fillcolor="#8a8a8a", opacity=0.15, line_width=0, layer="below")
        add_reference_line(made, "measurement noise", floor)
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
    names = [f"{one.where} ({format_count(one.rides)})" for one in rows]
    values, spans = [one.bias_kwh for one in rows], [one.ci95 for one in rows]
    x = {"title_text": "Bias less that of other rides [kWh]"}
    made = _draw_rows("bias", names, values, spans, x, "Rides", place=4)
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
    spans = [_to_percent(one.gain_ci95) for one in rows]
    low = min(0.0, *gains, *(pair[0] for pair in spans if pair))
    high = max(0.0, *gains, *(pair[1] for pair in spans if pair))
    room = 0.04 * (high - low)
    title = "Reduction of the squared error on held-out days [%]"
    x = {"title_text": title, "range": [low - room, high + room]}
    made = _draw_rows("gain", names, gains, spans, x, "Effect", place=5)
    add_reference_line(made, "", 0.0)
    caption = (
        "Each effect beside the others, as a share of the error that the terms of the model cannot explain. "
        "Lines: 95 % intervals."
    )
    gains_figure = Illustration("effects", "Missing effects, in the order in which to add them", caption, made)
    return [gains_figure, *draw_coefficients(rows), *draw_partial_residuals(result)]


def draw_coefficients(rows: Sequence[NamedEffect]) -> list[Illustration]:
    """Draw each coefficient with its interval in its own unit, over its plausible range."""
    shown = []
    for place, one in enumerate(rows):
        coefficient = one.coefficient
        value, low, high = coefficient.value, coefficient.low, coefficient.high
        if value is None or low is None or high is None or high <= low:
            continue
        quantity = describe_coefficient(one.partial_residual)
        made = draw_coefficient_rows([(one.effect, value, coefficient.ci95)], coefficient, quantity, "Effect")
        caption = "Line: 95 % interval. Shaded: the plausible range. A coefficient outside it may have another cause."
        title = f"{place + 1}. {one.name}: coefficient and plausible range"
        shown.append(Illustration(f"coefficient-{place}", title, caption, made, small=True))
    return shown


def draw_remainder(result: Diagnosis) -> list[Illustration]:
    """Draw the energy of each cause outside the library with its interval, and the remaining error by feature."""
    rows = [one for one in result.unknown if one.energy_share is not None]
    shown = []
    if rows:
        spans = [_to_percent(one.energy_share_ci95) for one in rows]
        names = [f"{i}. {one.formula.removeprefix('P = c · ')}" for i, one in enumerate(rows, start=1)]
        shares, x = (
            [PERCENT * (one.energy_share or 0.0) for one in rows],
            {"title_text": "Share of the measured energy [%]"},
        )
        made = _draw_rows("energy", names, shares, spans, x, "Form", place=3)
        add_reference_line(made, "", 0.0)
        caption = "Each form beside the others and beside what is named. Lines: 95 % intervals."
        shown.append(Illustration("unknown", "Causes outside the library", caption, made))
    return [*shown, *draw_profiles(result)]


def _draw_rows(
    name: str,
    names: Sequence[str],
    values: Sequence[float],
    spans: Sequence[ConfidenceInterval | None],
    x: Mapping[str, Any],
    axis: str,
    *,
    place: int,
) -> go.Figure:
    """Draw one point per row with an interval that need not be symmetric."""
    return make_figure(
        [draw_interval_rows(name, get_style(place), names, values, spans)],
        100 + ROW * len(names),
        x,
        {"type": "category", "autorange": "reversed", "title_text": axis},
    )


def _to_percent(span: ConfidenceInterval | None) -> ConfidenceInterval | None:
    """Return the ends of the interval of a share. [%]"""
    return None if span is None else (PERCENT * span[0], PERCENT * span[1])


def draw_causes(
    causes: Sequence[CauseProbability], *, key: str = "causes", title: str = "Probable causes"
) -> list[Illustration]:
    """Draw the probability of each cause as a bar: effects first, then a cause outside the library, then none."""
    known = [(one.effect, one.probability) for one in causes]
    rows = sorted(((name, p) for name, p in known if p is not None), key=lambda row: -row[1])
    named = [row for row in rows if row[0] not in CAUSE_NAMES]
    apart = [(CAUSE_NAMES[name], p) for name, p in sorted(rows, reverse=True) if name in CAUSE_NAMES]
    if not rows:
        return []
    named = _merge_improbable(named)
    traces = [
        draw_bars(
            name,
            get_style(style),
            [escape_label(label.replace("_", " ")) for label, _ in group],
            [PERCENT * p for _, p in group],
            text=[format_chance(p) if p >= LEAST_PROBABILITY else "< 0.5 %" for _, p in group],
            textposition="outside",
            cliponaxis=False,
        )
        for name, style, group in (("effect of the library", 2, named), ("no effect of the library", 0, apart))
        if group
    ]
    made = make_figure(
        traces,
        100 + CAUSE_ROW * (len(named) + len(apart)),
        x={"title_text": "Probability [%]", "range": [0.0, 108.0], "tickvals": [0, 20, 40, 60, 80, 100]},
        y={"title_text": "Cause", "type": "category", "autorange": "reversed"},
        barmode="overlay",
        showlegend=False,
    )
    caption = (
        "Blue: effects of the library. Grey: a cause outside the library, and that no effect is missing. Others: "
        "effects that are less probable than 0.5 %."
    )
    return [Illustration(key, title, caption, made)]


def _merge_improbable(rows: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return sorted causes with the improbable ones, and those beyond the largest number of bars, in one row."""
    probable = [row for row in rows if row[1] >= LEAST_PROBABILITY]
    kept = probable if len(probable) < MOST else probable[: MOST - 1]
    rest = rows[len(kept) :]
    if len(rest) < 2:
        return rows
    return [*kept, (f"{len(rest)} others", sum(p for _, p in rest))]


def draw_location(result: Diagnosis) -> list[Illustration]:
    """Draw the size of each load with its interval, as a mean power: a panel for each level, a row for each kind."""
    loads = result.error_location.estimates
    levels = [level for level in LEVEL_NAMES if any(one.level == level for one in loads)]
    if not loads:
        return []
    panels = [
        sorted((one for one in loads if one.level == level), key=lambda one: list(KINDS).index(one.kind))
        for level in levels
    ]
    rows = [len(panel) for panel in panels]
    height = SMALL_ROW * sum(rows) + GAP * (len(panels) - 1)
    made = make_subplots(
        rows=len(panels),
        cols=1,
        shared_xaxes=True,
        row_heights=rows,
        vertical_spacing=GAP / height if len(panels) > 1 else 0.0,
        subplot_titles=[f"Between {LEVEL_NAMES[level]}s" for level in levels],
    )
    for row, panel in enumerate(panels, start=1):
        for trace in _draw_sizes(panel):
            shown = trace.name not in {each.name for each in made.data}
            made.add_trace(trace.update(showlegend=shown, legendgroup=trace.name), row=row, col=1)
    apply_layout(made, 130 + height)
    made.update_annotations(font_size=12)
    made.update_xaxes(rangemode="tozero", tickangle=0, nticks=6)
    made.update_xaxes(title_text="Standard deviation, as a mean power [W]", row=len(panels), col=1)
    for row, panel in enumerate(panels, start=1):
        names = [KINDS[one.kind] for one in panel]
        made.update_yaxes(type="category", categoryorder="array", categoryarray=names, row=row, col=1)
        made.update_yaxes(title_text="Load", range=[len(names) - 0.5, -0.5], row=row, col=1)
    return [Illustration("location", "Location of the error", LOCATION, made)]


def _draw_sizes(panel: Sequence[LocatedLoad]) -> list[go.Scatter]:
    """Return the points of a level with their intervals, claimed ones filled, and what sampling alone may cause."""
    traces = []
    for name, place, filled in (("unexplained load", 2, True), ("not claimed", 7, False)):
        mine = [one for one in panel if one.claimed is filled]
        look = get_style(place)
        symbol = "circle" if filled else "circle-open"
        up, down = [one.high_w - one.size_w for one in mine], [one.size_w - one.low_w for one in mine]
        points = go.Scatter(
            name=name,
            x=[one.size_w for one in mine],
            y=[KINDS[one.kind] for one in mine],
            mode="markers",
            marker={"symbol": symbol, "size": 10, "color": look.colour, "line": {"width": 1.5, "color": look.colour}},
            error_x=make_error_bars(up, down, thickness=1.5, width=4),
            cliponaxis=False,
        )
        traces += [points] if mine else []
    ticks = go.Scatter(
        name="limit of sampling",
        x=[one.floor_w for one in panel],
        y=[KINDS[one.kind] for one in panel],
        mode="markers",
        marker={"symbol": "line-ns-open", "size": 14, "color": "#8a8a8a", "line": {"width": 2.5}},
    )
    return [*traces, ticks]


def draw_deviations(result: Diagnosis) -> list[Illustration]:
    """Return the figures of cars and changes."""
    changes = [(one, one.since) for one in result.deviations if one.shifts and one.since]
    return [*_draw_cars(result), *(_draw_change(place, one, since) for place, (one, since) in enumerate(changes))]


def _draw_cars(result: Diagnosis) -> list[Illustration]:
    """Draw the energy of each car beyond that of its siblings with its interval, over the spread between cars."""
    known = [(car, car.share, car.share_ci95) for car in result.cars if car.share is not None and car.share_ci95]
    rows = sorted(known[:MOST_CARS], key=lambda row: -row[1])
    if not rows:
        return []
    named = {one.who for one in result.deviations}
    names = [f"{car.car}{' (named)' if car.car in named else ''}" for car, *_ in rows]
    spans = [(PERCENT * low, PERCENT * high) for *_, (low, high) in rows]
    points = draw_interval_rows("car", get_style(2), names, [PERCENT * share for _, share, _ in rows], spans)
    made = make_figure(
        [points],
        110 + SMALL_ROW * len(rows),
        x={"title_text": "Energy beyond that of the siblings [% of the energy of the car]"},
        y={"title_text": "Car", "type": "category", "autorange": "reversed"},
    )
    spread = PERCENT * sum(car.share_spread or 0.0 for car, *_ in rows) / len(rows)
    made.add_vrect(x0=-spread, x1=spread, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    add_reference_line(made, "", 0.0)
    caption = (
        "Points: what each car uses more than the others of its model under the same conditions; lines: 95 % "
        "intervals. Shaded: one standard deviation between cars. A car may be named for what it uses in some "
        "conditions, such as cold or wind, while its total is usual."
    )
    return [Illustration("cars", "Cars beside their siblings", caption, made)]


def _draw_change(place: int, one: CarDeviation, since: str) -> Illustration:
    """Draw what a car uses more in each shift, with the step or ramp that was found and its interval."""
    shifts = one.shifts
    time = [datetime.fromtimestamp(shift.start_s, UTC) for shift in shifts]
    look, line = get_style(2), get_style(4)
    points = go.Scatter(
        name="shift",
        x=time,
        y=[PERCENT * shift.share for shift in shifts],
        mode="markers",
        marker={"symbol": look.symbol, "size": 7, "color": look.colour},
        error_y=make_error_bars([PERCENT * shift.error for shift in shifts], width=0),
    )
    last = max((shift.start_s for shift in shifts), default=0.0)
    value, low, high = (PERCENT * share for share in _get_full_share(one, since, last))
    size = [shift.size for shift in shifts]
    shape = "linear" if one.kind == "ramp" else "hv"
    ends = [
        go.Scatter(
            x=time, y=[end * each for each in size], mode="lines", showlegend=False, hoverinfo="skip",
            line={"width": 0.0, "shape": shape, "color": line.colour}, fill="tonexty" if second else None,
        )
        for second, end in enumerate((low, high))
    ]  # fmt: skip
    change = go.Scatter(
        name=one.kind,
        x=time,
        y=[value * each for each in size],
        mode="lines",
        line={"color": line.colour, "dash": line.dash, "width": 2, "shape": shape},
    )
    made = make_figure(
        [*ends, points, change],
        340,
        x={"title_text": "Date [UTC]"},
        y={"title_text": "Energy beyond the model [% of the energy]", "zeroline": True},
    )
    begin, finish = one.since_ci90 or (since, since)
    made.add_vrect(x0=begin, x1=finish, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    caption = (
        f"{describe_deviation(one)[0]}. Points: each shift by itself, with its standard error, for the most probable "
        "cause. Line: the change with its 95 % interval. Shaded dates: the 90 % range of its begin."
    )
    return Illustration(f"change-{place}", f"Change of {one.who}", caption, made)


def _get_full_share(one: CarDeviation, since: str, last: float) -> tuple[float, float, float]:
    """Return the share of the energy at the last shift, and the ends of its interval."""
    value = one.share or 0.0
    limits = one.share_ci95 or (value, value)
    rate = one.share_per_month
    if one.kind != "ramp" or rate is None:
        return value, limits[0], limits[1]
    begin = datetime.combine(date.fromisoformat(since), datetime.min.time(), UTC).timestamp()
    months = (last - begin) / MONTH_S
    low, high = one.share_per_month_ci95 or (rate, rate)
    return rate * months, low * months, high * months
