"""Draw each missing effect against its regressor and by car, and the mean remaining error along each feature."""

from collections.abc import Sequence
from datetime import UTC, datetime
from math import log10
from typing import Any, Final

import plotly.graph_objects as go
from msgspec.structs import replace
from plotly.subplots import make_subplots

from socast.core.diagnose.records import (
    CarResidual,
    Diagnosis,
    EstimatedCoefficient,
    NamedEffect,
    PartialResidual,
    ResidualBins,
    ResidualProfile,
)
from socast.tools.report.diagnosis.finding_words import format_unit
from socast.tools.report.document import Illustration
from socast.tools.report.figure_style import (
    REFERENCE_LINE,
    Style,
    apply_layout,
    draw_interval_rows,
    escape_label,
    find_limit,
    get_style,
    make_error_bars,
    make_figure,
)

POWER: Final = {"h": "W", "km": "Wh/km"}
"""Unit of the residual, by what it is divided by."""
NAMES: Final = {"h": "power", "km": "energy per km"}
BAND: Final = "rgba(31,158,119,0.2)"
"""Colour of the band around a fitted line."""
SHADE: Final = "rgba(138,138,138,0.2)"
"""Colour of a plausible range."""
BEFORE: Final = Style("#d1571f", "solid", "circle", "")
AFTER: Final = Style("#0b76c4", "dot", "square-open", "")
LINE: Final = "#1f9e77"
PANEL: Final = 170
"""Height of the panel of one car. [px]"""
MOST_UNEVEN: Final = 8
"""Ratio of the numbers of windows in bins above which they are drawn on a logarithmic axis."""
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
    "vehicle_id": "car",
    "driver_id": "driver",
    "hour": "hour of the day",
}
"""What each feature is, in words."""
AXES: Final = {"vehicle_id": "Car", "driver_id": "Driver", "hour": "Local solar time [h]", "start_s": "Date [UTC]"}
"""Axis titles that are not a feature and its unit."""
SCALES: Final = {"elapsed_s": (60.0, "min"), "parked_s": (3600.0, "h"), "odometer_km": (1000.0, "1000 km")}
"""Size of the unit of an axis in units of the feature, and the unit."""
WIDEST: Final = 2.0
"""Widest interval that the common scale shows whole, relative to the largest mean."""
ROW: Final = 26
"""Height of a row of names. [px]"""
CAPTION: Final = (
    "Filled: without what is named. Outlines: with it, with 95 % intervals. All these figures have one scale, "
    "which an interval may leave. Parentheses: the number of windows. Bins of too few vehicle-days "
    "for an interval are not drawn."
)
BY_CAR: Final = "The terms are refitted for each car, so the mean of a car is nearly zero whatever its error was."


def name_figure(place: int) -> str:
    """Return the key of the figure of the missing effect at a place, from 0."""
    return f"partial-{place}"


def is_drawn(part: PartialResidual) -> bool:
    """Return whether a partial residual has all that its figure shows."""
    return bool(part.x) and part.slope is not None


def draw_partial_residuals(result: Diagnosis) -> list[Illustration]:
    """Draw the partial residual of each missing effect, all cars together and car by car."""
    shown = []
    for place, one in enumerate(result.missing):
        part = one.partial_residual
        if not is_drawn(part):
            continue
        name, per = one.name, part.per
        shown.append(
            Illustration(
                name_figure(place),
                f"{place + 1}. {name}: measured less predicted, before and after it is added",
                f"Measured less predicted {NAMES[per]} of windows, in bins of the {NAMES[per]} that {name} takes per "
                f"unit of its coefficient, {describe_coefficient(part)}. Filled: by the model without {name}. "
                "Outlines: with it. The slope of the line is the coefficient; points that bend away from it show that "
                "the formula does not hold. Error bars and band: 95 % intervals; a point of too few vehicle-days has "
                "none. Below: the windows in each bin.",
                _draw_all_cars(part),
            )
        )
        cars = [car for car in part.cars if car.x and car.before]
        if len(cars) > 1:
            shown.append(
                Illustration(
                    f"partial-cars-{place}",
                    f"{place + 1}. {name}, car by car",
                    "The same for each car, without the effect, with the number of windows in parentheses. The line is "
                    "that of all cars. Error bars: 95 % intervals.",
                    _draw_cars(part, cars),
                )
            )
            shown += _draw_slopes(place, name, one, part, cars)
    return shown


def describe_coefficient(part: PartialResidual) -> str:
    """Return the meaning of a coefficient, with its unit if it has one."""
    unit = format_unit(part.unit)
    return f"the {part.quantity}{f' [{unit}]' if unit else ''}"


def _title_regressor(part: PartialResidual) -> str:
    """Return the title of the axis of the regressor, with its unit."""
    unit, per = format_unit(part.unit), part.per
    what = f" per {unit}" if unit else " at a coefficient of 1"
    divided = divide_units(POWER[per], unit)
    return escape_label(f"{NAMES[per].capitalize()}{what} [{divided}]")


def divide_units(above: str, below: str) -> str:
    """Return the unit of a quotient.

    Examples
    --------
    >>> divide_units("W", "m²"), divide_units("Wh/km", "m²"), divide_units("Wh/km", "1/K"), divide_units("W", "J/K")
    ('W/m²', 'Wh/(km m²)', 'Wh K/km', 'W K/J')
    >>> divide_units("W", ""), divide_units("W", "W m^-2 K")
    ('W', 'W/(W m^-2 K)')
    """
    over, _, under = above.partition("/")
    top, _, bottom = below.partition("/")
    if " " in below or "/" in bottom or "(" in below:
        return f"{above}/({below})"
    factors = [unit for unit in (under, top) if unit and unit != "1"]
    left = f"{over} {bottom}".strip()
    return f"{left}/{factors[0]}" if len(factors) == 1 else f"{left}/({' '.join(factors)})" if factors else left


def _draw_all_cars(part: PartialResidual) -> go.Figure:
    """Draw the points before and after, the fitted line with its band, and the counts below."""
    per = part.per
    made = make_subplots(rows=2, cols=1, shared_xaxes=True, row_heights=[0.8, 0.2], vertical_spacing=0.06)
    for trace in _draw_line(part, part.x):
        made.add_trace(trace, row=1, col=1)
    for name, look, values in (
        ("before it is added", BEFORE, part.before),
        ("after it is added", AFTER, part.after),
    ):
        made.add_trace(_draw_points(name, look, part, values), row=1, col=1)
    counts, span = list(part.windows), max(part.x) - min(part.x)
    made.add_trace(
        go.Bar(
            name="windows",
            x=list(part.x),
            y=counts,
            marker={"color": "#8a8a8a", "pattern": {"shape": ""}},
            showlegend=False,
            width=span / 60.0 if span > 0.0 else 1.0,  # visible, and apart where that is possible
            hovertemplate="%{y} windows<extra></extra>",
        ),
        row=2,
        col=1,
    )
    apply_layout(made, 500)
    made.add_hline(y=0.0, line={**REFERENCE_LINE, "width": 1}, row=1, col=1)
    made.update_xaxes(title_text=_title_regressor(part), row=2, col=1)
    made.update_yaxes(title_text=f"Measured less predicted [{POWER[per]}]", row=1, col=1)
    made.update_yaxes(title_text="Windows [1]", rangemode="tozero", nticks=3, row=2, col=1)
    if max(counts) > MOST_UNEVEN * min(counts):
        ends = [log10(min(counts)) - 0.7, log10(max(counts)) + 0.2]
        made.update_yaxes(type="log", dtick=1, range=ends, row=2, col=1)
    return made


def _draw_line(part: PartialResidual, x: Sequence[float], *, legend: bool = True) -> list[go.Scatter]:
    """Return the fitted line through the origin, and its band."""
    slope, ends = part.slope, part.slope_ci95
    if slope is None:
        return []
    low, high = min(0.0, *x), max(0.0, *x)
    across = [low, 0.0, high]
    traces = []
    if ends is not None:
        upper = [max(end * at for end in ends) for at in across]
        lower = [min(end * at for end in ends) for at in across]
        traces.append(
            go.Scatter(
                name="95 % band",
                x=[*across, *across[::-1]],
                y=[*upper, *lower[::-1]],
                mode="lines",
                line={"width": 0},
                fill="toself",
                fillcolor=BAND,
                hoverinfo="skip",
                showlegend=legend,
            )
        )
    line = {"color": LINE, "width": 2, "dash": "solid"}
    traces.append(
        go.Scatter(
            name="fitted line",
            x=across,
            y=[slope * at for at in across],
            mode="lines",
            line=line,
            showlegend=legend,
            hoverinfo="skip",
        )
    )
    return traces


def _draw_points(
    name: str, look: Style, part: ResidualBins, values: Sequence[Any], *, legend: bool = True
) -> go.Scatter:
    """Return the points of bins with their error bars and counts."""
    return go.Scatter(
        name=name,
        x=list(part.x),
        y=list(values),
        mode="markers",
        marker={"symbol": look.symbol, "size": 9, "color": look.colour, "line": {"width": 1.5, "color": look.colour}},
        error_y=make_error_bars(part.ci95, thickness=1.2, width=0),
        text=_count_windows(part),
        hovertemplate="%{y:.3g}, %{text}<extra></extra>",
        showlegend=legend,
    )


def _count_windows(part: ResidualBins | ResidualProfile) -> list[str]:
    """Return how many windows of how many vehicle-days each bin has."""
    counts = zip(part.windows, part.days, strict=False)
    return [f"{windows:,} windows of {days:,} vehicle-days" for windows, days in counts]


def _draw_cars(part: PartialResidual, cars: Sequence[CarResidual]) -> go.Figure:
    """Draw one panel for each car, with common axes."""
    columns = min(2, len(cars))
    rows = -(-len(cars) // columns)
    titles = [escape_label(f"{car.car} ({sum(car.windows):,})") for car in cars]
    height = 90 + PANEL * rows
    made = make_subplots(
        rows=rows,
        cols=columns,
        shared_xaxes="all",
        shared_yaxes="all",
        subplot_titles=titles,
        vertical_spacing=min(34 / (PANEL * rows), 1.0 / max(rows - 1, 1)),
        horizontal_spacing=0.04,
    )
    every = [x for car in cars for x in car.x]
    for i, car in enumerate(cars):
        at = {"row": i // columns + 1, "col": i % columns + 1}
        for trace in _draw_line(part, every, legend=i == 0):
            made.add_trace(trace, **at)
        made.add_trace(_draw_points("before it is added", BEFORE, car, car.before, legend=i == 0), **at)
    apply_layout(made, height)
    made.update_annotations(font_size=12)
    made.update_xaxes(nticks=4, tickangle=0)
    made.update_yaxes(nticks=5)
    made.add_annotation(
        text=_title_regressor(part), x=0.5, y=0, xref="paper", yref="paper", yshift=-30, yanchor="top", showarrow=False
    )
    if len(cars) % columns:
        made.update_xaxes(showticklabels=True, row=rows - 1, col=columns)
    unit = POWER[part.per]
    made.add_annotation(
        text=f"Measured less predicted [{unit}]",
        x=0,
        y=0.5,
        xref="paper",
        yref="paper",
        xshift=-58,
        textangle=-90,
        showarrow=False,
    )
    made.update_layout(margin={"l": 85})
    return made


def _draw_slopes(
    place: int, name: str, one: NamedEffect, part: PartialResidual, cars: Sequence[CarResidual]
) -> list[Illustration]:
    """Draw the coefficient that each car alone shows, over that of all cars and the plausible range."""
    known = [car for car in cars if car.slope is not None]
    if len(known) < 2:
        return []
    named = [*((car.car, car) for car in known), ("all cars", part)]
    rows = [(f"{who} ({sum(each.windows):,})", each.slope, each.slope_ci95) for who, each in named]
    made = draw_coefficient_rows(rows, one.coefficient, describe_coefficient(part), "Car")
    caption = (
        "Points: the coefficient that the windows of one car show, their number in parentheses. Lines: 95 % intervals. "
        "Shaded: the plausible range. "
        "An interval far from that of all cars suggests that the effect differs between cars. A wide one leaves the "
        "figure."
    )
    return [Illustration(f"partial-slopes-{place}", f"{place + 1}. {name}: coefficient by car", caption, made)]


def draw_coefficient_rows(
    rows: Sequence[tuple[str, Any, Any]], coefficient: EstimatedCoefficient, quantity: str, axis: str
) -> go.Figure:
    """Draw values of a coefficient with their intervals in its own unit, over its plausible range."""
    values = [float(value) for _, value, _ in rows]
    ends = [interval or (value, value) for value, (_, _, interval) in zip(values, rows, strict=True)]
    unit = format_unit(coefficient.unit) or "1"
    points = draw_interval_rows("coefficient", get_style(6), [name for name, *_ in rows], values, ends)
    made = make_figure(
        [points],
        100 + 30 * len(rows),
        y={"title_text": axis, "type": "category", "autorange": "reversed"},
        showlegend=False,
    )
    low, high = coefficient.low, coefficient.high
    if low is not None and high is not None:
        made.add_vrect(x0=low, x1=high, fillcolor=SHADE, line_width=0, layer="below")
    across = [*values, *(value for value in (low, high) if value is not None), 0.0]
    reach = max(across) - min(across) or 1.0
    near = [end for pair in ends for end in pair if min(across) - reach <= end <= max(across) + reach]
    across, room = [*across, *near], 0.04 * reach
    title = quantity.removeprefix("the ").partition(" [")[0]
    made.update_xaxes(
        title_text=escape_label(f"{title[:1].upper()}{title[1:]} [{unit}]"),
        range=[min(across) - room, max(across) + room],
    )
    return made


def draw_profiles(result: Diagnosis) -> list[Illustration]:
    """Draw the mean residual along each feature and by each category, in bins that have an interval."""
    known = [_keep_known_bins(part) for part in result.profiles]
    parts = [part for part in known if len(part.x) > 1]
    means = [mean for part in parts for mean in (*part.before_w, *part.after_w)]
    halves = [(mean, half) for part in parts for mean, half in zip(part.after_w, part.ci95_w, strict=True)]
    limit = find_limit(means, [abs(mean) + half for mean, half in halves if half is not None], WIDEST)
    return [_draw_profile(part, limit, several=bool(result.missing or result.deviations)) for part in parts]


def _keep_known_bins(part: ResidualProfile) -> ResidualProfile:
    """Return a profile without the bins whose interval is unknown."""
    kept = [i for i, half in enumerate(part.ci95_w) if half is not None]
    columns = ("x", "before_w", "after_w", "ci95_w", "windows", "days")
    return replace(part, **{name: [getattr(part, name)[i] for i in kept] for name in columns})


def _draw_profile(part: ResidualProfile, limit: float, *, several: bool) -> Illustration:
    """Draw one feature along the horizontal axis, or one category with a row for each name."""
    feature, named = part.feature, not part.unit
    title = TITLES.get(feature, feature.replace("_", " "))
    size, unit = SCALES.get(feature, (1.0, part.unit))
    x: list[Any] = list(part.x)
    if named:
        x = [escape_label(f"{name} ({count:,})") for name, count in zip(part.x, part.windows, strict=True)]
    elif feature == "start_s":
        x = [datetime.fromtimestamp(at, UTC) for at in x]
    else:
        x = [at / size for at in x]
    traces = []
    if several:
        traces.append(_draw_means("without what is named", BEFORE, part, "before_w", x, named=named))
    name = "with what is named" if several else "remaining"
    traces.append(_draw_means(name, AFTER, part, "after_w", x, named=named))
    made = make_figure(traces, 110 + ROW * len(x) if named else 320)
    power = "Measured less predicted [W]"
    along = AXES.get(feature, f"{title[:1].upper()}{title[1:]} [{unit}]")
    if named:
        made.update_xaxes(title_text=power, range=[-limit, limit])
        made.update_yaxes(title_text=escape_label(along), type="category", autorange="reversed")
        made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1})
    else:
        made.update_xaxes(title_text=escape_label(along))
        made.update_yaxes(title_text=power, range=[-limit, limit])
        made.add_hline(y=0.0, line={**REFERENCE_LINE, "width": 1})
    caption = BY_CAR if feature == "vehicle_id" else CAPTION
    return Illustration(f"profile-{feature}", f"Remaining error by {title}", caption, made, small=True)


def _draw_means(name: str, look: Any, part: ResidualProfile, key: str, x: list[Any], *, named: bool) -> go.Scatter:
    """Return the means of the bins, with intervals for those that remain."""
    values = getattr(part, key)
    bars = make_error_bars(part.ci95_w if key == "after_w" else None, thickness=1.2)
    return go.Scatter(
        name=name,
        x=values if named else x,
        y=x if named else values,
        mode="markers",
        marker={"symbol": look.symbol, "size": 8, "color": look.colour, "line": {"width": 1.5, "color": look.colour}},
        **{"error_x" if named else "error_y": bars},
        text=_count_windows(part),
        hovertemplate=f"%{{{'x' if named else 'y'}:.3g}} W, %{{text}}<extra></extra>",
    )
