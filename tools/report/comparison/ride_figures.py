"""Draw a ride: its conditions along the way, and a map of it coloured by the error of a model."""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import cos, floor, log10, radians
from typing import Any, Final

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from socast.core.evaluate.compare.records import RideTrace
from socast.tools.report.comparison.figures import get_model_style
from socast.tools.report.figure_style import Style, apply_layout, escape_label, get_style

MEASURED: Final = Style("#8a8a8a", "solid", "circle", "")
"""Look of measurements."""
TIME: Final = "Time since the start [min]"
ROW: Final = 125
"""Height of one of several plots above each other. [px]"""
SECONDS: Final = 3600.0
"""Seconds in an hour. [s]"""
WATTS: Final = 1000.0
"""Watts in a kilowatt. [W/kW]"""
KM_PER_DEGREE: Final = 111.2
"""Length of a degree of latitude. [km/degree]"""
SCALE: Final = ((0.0, "#0b76c4"), (0.5, "#a9a9a5"), (1.0, "#d1571f"))
"""Colours from too little to too much predicted."""
CLASSES: Final = 9
"""Number of colours of the line of a map."""
LEAST_KM: Final = 0.2
"""Extent of a ride below which it has no map. [km]"""
POSITIONS: Final = ("latitude_start_deg", "longitude_start_deg", "latitude_end_deg", "longitude_end_deg")


def draw_conditions(trace: RideTrace) -> go.Figure | None:
    """Draw speed, elevation, temperature and wind along a ride, as far as they are known."""
    return _stack(trace, list_conditions(trace))


def draw_ride(trace: RideTrace) -> go.Figure:
    """Draw power and error of all models along a ride, above its conditions."""
    power = [("measured", MEASURED, convert_to_power(trace, trace.windows.measured_kwh))]
    errors = []
    for place, (name, of_model) in enumerate(trace.models.items()):
        look = get_model_style(place)
        power.append((name, look, convert_to_power(trace, of_model.energy_kwh)))
        errors.append((name, look, accumulate_error(trace, name)))
    made = _stack(trace, [("Power [kW]", power), ("Error<br>so far [kWh]", errors), *list_conditions(trace)])
    assert made is not None  # a trace has windows
    return made


def list_conditions(trace: RideTrace) -> list[tuple[str, list[tuple[str, Style, list[Any]]]]]:
    """Return the title, and the name, look and values of each curve, of every known condition of a ride."""
    windows = trace.windows
    speed = [SECONDS * km / s if s else None for km, s in zip(windows.distance_km, windows.duration_s, strict=True)]
    rows = [("Speed [km/h]", [("speed", get_style(7), speed)])]
    if windows.gained_m is not None and windows.lost_m is not None:
        climbs = [(up or 0.0) - (down or 0.0) for up, down in zip(windows.gained_m, windows.lost_m, strict=True)]
        if any(climbs):  # without a source of elevation, all climbs are zero
            heights: list[Any] = list(accumulate(climbs, initial=0.0))
            rows.append(("Elevation<br>from the start [m]", [("elevation", get_style(8), heights)]))
    rows.append(("Temperature [°C]", [("temperature", get_style(4), windows.ambient_c or [])]))
    wind = [
        ("wind speed", get_style(5), windows.wind_speed_kmh or []),
        ("against the car", get_style(10), windows.headwind_kmh or []),
    ]
    rows.append(("Wind [km/h]", wind))
    known = [
        (title, [curve for curve in curves if any(value is not None for value in curve[2])]) for title, curves in rows
    ]
    return [(title, curves) for title, curves in known if curves]


def accumulate_error(trace: RideTrace, model: str) -> list[float]:
    """Return the error so far at the start of the ride and after each window. [kWh]"""
    return list(accumulate(_subtract_measured(trace, model), initial=trace.models[model].start_kwh))


def _subtract_measured(trace: RideTrace, model: str) -> list[float]:
    """Return the error of each window. [kWh]"""
    energy = zip(trace.models[model].energy_kwh, trace.windows.measured_kwh, strict=True)
    return [predicted - measured for predicted, measured in energy]


def convert_to_power(trace: RideTrace, energy: Sequence[Any]) -> list[float | None]:
    """Return the mean power of each window. [kW]"""
    return [SECONDS * value / s if s else None for value, s in zip(energy, trace.windows.duration_s, strict=True)]


def _stack(trace: RideTrace, rows: Sequence[tuple[str, Sequence[tuple[str, Style, list[Any]]]]]) -> go.Figure | None:
    """Return plots above each other that share the time axis.

    A curve has the means of the windows, or one value more: those at the start and at the end of each window.
    """
    if not rows:
        return None
    ends = [0.0, *trace.windows.end_min]
    made = make_subplots(rows=len(rows), cols=1, shared_xaxes=True, vertical_spacing=0.25 / max(2 * len(rows), 3))
    seen: set[str] = set()
    for i, (title, curves) in enumerate(rows, start=1):
        for name, look, values in curves:
            label = escape_label(name)
            means = len(values) < len(ends)
            made.add_trace(
                go.Scatter(
                    name=label,
                    x=[at for pair in pairwise(ends) for at in pair] if means else ends,
                    y=[value for value in values for _ in range(2)] if means else values,
                    mode="lines",
                    line={"color": look.colour, "dash": look.dash, "width": 2},
                    legendgroup=label,
                    showlegend=len(curves) > 1 and label not in seen,
                ),
                row=i,
                col=1,
            )
            seen |= {label} if len(curves) > 1 else set()
        what, _, unit = title.partition(" [")
        made.update_yaxes(title_text=f"{what}<br>[{unit}", row=i, col=1)
    apply_layout(made, 90 + ROW * len(rows))
    made.update_xaxes(title_text=TIME, row=len(rows), col=1)
    made.update_yaxes(title_font_size=11, nticks=5)
    return made


def draw_map(trace: RideTrace, model: str) -> go.Figure | None:
    """Draw the way of a ride, coloured by the error of a model; None where positions are unknown.

    Notes
    -----
    A window is the straight line between its ends. A degree of longitude is shorter than one of latitude by the cosine
    of the latitude.
    """
    ends = [getattr(trace.windows, name) for name in POSITIONS]
    if any(values is None for values in ends):
        return None
    legs = [
        (*place, WATTS * error)
        for *place, error in zip(*ends, convert_to_power(trace, _subtract_measured(trace, model)), strict=True)
        if error is not None and all(value is not None for value in place)
    ]
    if not legs:
        return None
    latitudes = [value for leg in legs for value in (leg[0], leg[2])]
    longitudes = [value for leg in legs for value in (leg[1], leg[3])]
    shrink = cos(radians(sum(latitudes) / len(latitudes)))
    extent = (
        KM_PER_DEGREE * shrink * (max(longitudes) - min(longitudes)),
        KM_PER_DEGREE * (max(latitudes) - min(latitudes)),
    )
    if max(extent) < LEAST_KM:
        return None
    most = max(abs(leg[4]) for leg in legs) or 1.0
    made = go.Figure([*_draw_legs(legs, most), _draw_middles(legs, most), *_draw_ends(legs)])
    made.add_trace(_draw_scale_bar(min(longitudes), min(latitudes), extent, shrink))
    apply_layout(made, 460)
    made.update_xaxes(title_text="Longitude [°]", nticks=4, constrain="domain")
    made.update_yaxes(title_text="Latitude [°]", nticks=6, scaleanchor="x", scaleratio=1.0 / shrink)
    return made


def _draw_legs(legs: Sequence[tuple[float, ...]], most: float) -> list[go.Scatter]:
    """Return the way as lines, one trace for each class of error."""
    by_class: dict[int, list[tuple[float, ...]]] = {}
    for leg in legs:
        by_class.setdefault(round((leg[4] / most + 1.0) / 2.0 * (CLASSES - 1)), []).append(leg)
    return [
        go.Scatter(
            name="way",
            x=[value for leg in members for value in (leg[1], leg[3], None)],
            y=[value for leg in members for value in (leg[0], leg[2], None)],
            mode="lines",
            line={"color": _mix(place / (CLASSES - 1)), "width": 5},
            hoverinfo="skip",
            showlegend=False,
        )
        for place, members in sorted(by_class.items())
    ]


def _mix(at: float) -> str:
    """Return the colour at a place between 0 and 1 of the scale."""
    (low, start), (high, end) = (SCALE[0], SCALE[1]) if at <= SCALE[1][0] else (SCALE[1], SCALE[2])
    share = (at - low) / (high - low)
    parts = [round((1.0 - share) * int(start[i : i + 2], 16) + share * int(end[i : i + 2], 16)) for i in (1, 3, 5)]
    return "#" + "".join(f"{part:02x}" for part in parts)


def _draw_middles(legs: Sequence[tuple[float, ...]], most: float) -> go.Scatter:
    """Return the middle of each window, with the colour bar and the text of the pointer."""
    return go.Scatter(
        name="window",
        x=[(leg[1] + leg[3]) / 2.0 for leg in legs],
        y=[(leg[0] + leg[2]) / 2.0 for leg in legs],
        mode="markers",
        marker={
            "symbol": "circle",
            "size": 6,
            "color": [leg[4] for leg in legs],
            "cmin": -most,
            "cmax": most,
            "colorscale": [list(pair) for pair in SCALE],
            "colorbar": {
                "title": {"text": "Predicted less measured [W]", "side": "right"},
                "thickness": 12,
                "outlinewidth": 0,
            },
        },
        hovertemplate="%{marker.color:.0f} W<extra></extra>",
        showlegend=False,
    )


def _draw_ends(legs: Sequence[tuple[float, ...]]) -> list[go.Scatter]:
    """Return marks of the start and the end."""
    ends = (("start", "triangle-up", legs[0][1], legs[0][0]), ("end", "square", legs[-1][3], legs[-1][2]))
    return [
        go.Scatter(
            name=name,
            x=[x],
            y=[y],
            mode="markers",
            marker={"symbol": f"{symbol}-open", "size": 13, "color": "#8064c8", "line": {"width": 2.5}},
        )
        for name, symbol, x, y in ends
    ]


def _draw_scale_bar(west: float, south: float, extent: tuple[float, float], shrink: float) -> go.Scatter:
    """Return a bar of a round number of kilometres below the way."""
    length = choose_scale(max(extent))
    below = south - 0.12 * max(extent) / KM_PER_DEGREE
    east = west + length / (KM_PER_DEGREE * shrink)
    return go.Scatter(
        name="scale",
        x=[west, (west + east) / 2.0, east],
        y=[below] * 3,
        text=["", f"\u00a0<br>{length:g} km", ""],
        textposition="bottom center",
        mode="lines+markers+text",
        line={"color": "#8a8a8a", "width": 3},
        marker={"symbol": ["line-ns-open", "line-ns-open", "line-ns-open"], "size": [9, 0, 9], "color": "#8a8a8a"},
        hoverinfo="skip",
        showlegend=False,
    )


def choose_scale(extent_km: float) -> float:
    """Return 1, 2 or 5 times a power of ten, about a quarter of an extent. [km]

    Examples
    --------
    >>> choose_scale(9.0), choose_scale(3.0), choose_scale(0.5)
    (2.0, 0.5, 0.1)
    """
    aim = extent_km / 4.0
    power = 10.0 ** floor(log10(aim))
    return float(max(size * power for size in (1.0, 2.0, 5.0) if size * power <= aim))


def list_maps(trace: RideTrace) -> list[tuple[str, go.Figure]]:
    """Return the map of each model that has one."""
    maps = [(name, draw_map(trace, name)) for name in trace.models]
    return [(name, drawn) for name, drawn in maps if drawn is not None]
