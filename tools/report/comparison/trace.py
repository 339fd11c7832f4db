"""Show the trace of a ride: measured and predicted energy, window by window, as tables and figures."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any, Final

import plotly.graph_objects as go
from rich.console import Console

from socast.core.evaluate.compare.records import Comparison, Divergence, RideTrace, TracedModel
from socast.core.formatting import format_half_width
from socast.tools.report.comparison.figures import get_model_style
from socast.tools.report.comparison.ride_figures import (
    MEASURED,
    SECONDS,
    accumulate_error,
    convert_to_power,
    draw_conditions,
    draw_ride,
    list_maps,
)
from socast.tools.report.comparison.tables import name_ride
from socast.tools.report.document import Illustration, Report, Section, print_section
from socast.tools.report.figure_style import Style, draw_bars, escape_label, get_style, make_figure, make_stacked_figure
from socast.tools.report.table import (
    UNKNOWN,
    Cell,
    ReportTable,
    format_energy,
    format_estimate,
    format_signed,
    tabulate,
    tabulate_records,
)

MOST_TERMS: Final = 6
"""Number of terms that are drawn one by one; the others are summed."""
LEAST_SHOWN: Final = 0.001
"""Terms below this energy everywhere are left out of tables. [kWh]"""
OTHERS: Final = "other terms"
AXES: Final = {"end_min": "Time since the start [min]", "end_km": "Distance [km]"}
"""Columns of the x axis -> its titles."""
CONDITIONS: Final = (
    "Means of each window. Elevation is the sum of climbs and descents since the start. Wind against the car is "
    "positive, from behind negative."
)
MAP: Final = (
    "Each window is a straight line between its ends. Blue: predicted too little. Orange: predicted too much. The bar "
    "gives the scale; north is up."
)
HERE: Final = "◄"
"""Mark of the windows where model and measurement diverge."""


def show(trace: RideTrace, console: Console) -> None:
    """Print the trace of a ride, from its windows to the predictions of the ride."""
    for section in reversed(build_report(trace).sections):
        print_section(section, console)


def build_report(trace: RideTrace) -> Report:
    """Return the report of a ride."""
    terms = [tabulate_terms(name, of_model) for name, of_model in trace.models.items()]
    sections = [
        Section("trace", "Prediction and measurement along the ride", describe_ride(trace), [tabulate_models(trace)]),
        Section("terms", "Terms of the predictions", "", terms),
        Section("windows", "Window by window", "", [tabulate_windows(trace)]),
    ]
    title, drawn = f"Ride {trace.ride.ride_key}", {"trace": illustrate_trace}
    return Report("compare", "compare", title, sections, result=trace, figures=drawn)


def describe_ride(trace: RideTrace) -> str:
    """Return the description of the ride."""
    ride = trace.ride
    half = format_half_width(ride.energy_sd_kwh, 3)
    spread = f"{half} (95 % interval)" if half else ""
    conditions = (
        f"{format_estimate(ride.distance_km)} km in {format_estimate((ride.duration_s or 0.0) / 60.0)} min "
        f"at {format_estimate(ride.ambient_c)} °C, {format_energy(ride.energy_kwh)} kWh{spread}"
    )
    unfit = f"; unfit for training: {ride.unfit_reason.replace('_', ' ')}" if ride.unfit_reason else ""
    return f"{', '.join(filter(None, [ride.vehicle_model, ride.date, conditions]))}{unfit}."


def tabulate_models(trace: RideTrace) -> ReportTable:
    """Return the prediction of each model, with a description of where it diverges from the measurement."""
    notes = (*(f"{name} {one.words}." for name, one in trace.models.items()), *trace.notes)
    return tabulate_records("Predictions of the ride", trace.models, TracedModel, corner="model", notes=notes)


def tabulate_terms(model: str, of_model: TracedModel) -> ReportTable:
    """Return the terms of a model, largest first."""
    place, start = of_model.place, of_model.start_terms
    at = slice(place.first, place.last + 1) if place else slice(0, 0)
    figures = {
        name: (start[name] + sum(energy), start[name], sum(energy[at])) for name, energy in of_model.terms.items()
    }
    shown = [name for name, energies in figures.items() if max(map(abs, energies)) >= LEAST_SHOWN]
    rows = [(name, figures[name]) for name in sorted(shown, key=lambda name: -abs(figures[name][0]))]
    columns = [("whole ride", lambda energies: format_signed(energies[0]))]
    if any(start[name] for name in shown):
        columns.append(("before the start", lambda energies: format_signed(energies[1])))
    if place:
        columns.append((f"divergence, {place.minutes:.1f} min", lambda energies: format_signed(energies[2])))
    small = len(figures) - len(shown)
    notes = (f"{small} other terms are below {LEAST_SHOWN} kWh.",) if small else ()
    return tabulate(f"{model}: terms of the prediction, kWh", "term", rows, columns, notes)


def tabulate_windows(trace: RideTrace) -> ReportTable:
    """Return the ride window by window."""
    windows, models = trace.windows, trace.models
    measured = convert_to_power(trace, windows.measured_kwh)

    def show_speed(i: int) -> str:
        seconds = windows.duration_s[i]
        return format_estimate(SECONDS * windows.distance_km[i] / seconds, 0) if seconds else UNKNOWN

    def show_power(power: Sequence[float | None], i: int) -> str:
        return format_estimate(power[i])

    def show_error(errors: Sequence[float], place: Divergence | None, i: int) -> Cell:
        here = place is not None and place.first <= i <= place.last
        return Cell(f"{format_signed(errors[i])}{f' {HERE}' if here else ''}", strong=here)

    columns: list[tuple[str, Callable[[int], Cell | str]]] = [
        ("km", lambda i: format_estimate(windows.end_km[i])),
        ("km/h", show_speed),
        ("measured, kW", partial(show_power, measured)),
    ]
    for name, one in models.items():
        columns.append((f"{name}, kW", partial(show_power, convert_to_power(trace, one.energy_kwh))))
    for name, one in models.items():
        errors = accumulate_error(trace, name)[1:]
        columns.append((f"{name}: error so far, kWh", partial(show_error, errors, one.place)))
    rows = [(f"{minute:.1f}", i) for i, minute in enumerate(windows.end_min)]
    note = f"Mean power of each window, which ends at the given minute. {HERE}: prediction and measurement diverge."
    return tabulate("Window by window", "minute", rows, columns, (note,))


def illustrate_trace(trace: RideTrace) -> list[Illustration]:
    """Return the figures of energy and error along the ride, of power, and of the terms of each model."""
    note = "Shaded: where the first model and the measurement diverge."
    along = [
        Illustration(
            f"along-{axis.removeprefix('end_')}",
            f"Energy and error against {name}",
            f"{caption} {note}",
            draw_cumulative(trace, axis),
        )
        for axis, name, caption in (
            ("end_min", "time", "Energy used so far, measured and predicted, and predicted less measured."),
            ("end_km", "distance", "The same against the distance driven."),
        )
    ]
    power = Illustration("power", "Power along the ride", f"Mean power of each window. {note}", draw_powers(trace))
    stacks = [
        Illustration(
            f"terms-{i}",
            f"{name}: terms of the prediction",
            "Mean power of each term in each window, stacked. Line: measured power.",
            draw_terms(trace, name),
        )
        for i, name in enumerate(trace.models)
    ]
    drawn = draw_conditions(trace)
    conditions = [] if drawn is None else [Illustration("conditions", "Conditions along the ride", CONDITIONS, drawn)]
    maps = [
        Illustration(f"map-{i}", f"{name}: map of the ride by error", MAP, made, small=True)
        for i, (name, made) in enumerate(list_maps(trace))
    ]
    return [*along, power, *conditions, *maps, *stacks]


def illustrate_traces(result: Comparison) -> list[Illustration]:
    """Return a figure and the maps of each of the traced rides."""
    shown = []
    for i, (key, trace) in enumerate((result.traces or {}).items()):
        words = " ".join(f"{name} {of_model.words}." for name, of_model in trace.models.items())
        shown.append(Illustration(name_ride(i), f"Ride {key}", f"{describe_ride(trace)} {words}", draw_ride(trace)))
        shown += [
            Illustration(f"{name_ride(i)}-map-{j}", f"Ride {key}: error of {name}", MAP, made, small=True)
            for j, (name, made) in enumerate(list_maps(trace))
        ]
    return shown


def draw_cumulative(trace: RideTrace, axis: str) -> go.Figure:
    """Return a figure of the energy so far above and the error so far below."""
    made = make_stacked_figure(("", ""), 600)
    x = [0.0, *getattr(trace.windows, axis)]
    sums = list(accumulate(trace.windows.measured_kwh, initial=0.0))
    made.add_trace(_draw_steps("measured", MEASURED, x, sums, width=3), row=1, col=1)
    for place, (name, of_model) in enumerate(trace.models.items()):
        label, look = escape_label(name), get_model_style(place)
        sums = list(accumulate(of_model.energy_kwh, initial=of_model.start_kwh))
        made.add_trace(_draw_steps(label, look, x, sums), row=1, col=1)
        made.add_trace(_draw_steps(label, look, x, accumulate_error(trace, name), showlegend=False), row=2, col=1)
    _shade(made, trace, x)
    made.update_xaxes(title_text=AXES[axis])
    return made.update_layout(yaxis_title_text="Energy so far [kWh]", yaxis2_title_text="Error so far [kWh]")


def draw_powers(trace: RideTrace) -> go.Figure:
    """Return a figure of the mean power of each window, measured and predicted."""
    traces = [_draw_power("measured", MEASURED, trace, trace.windows.measured_kwh, width=3)]
    for place, (name, of_model) in enumerate(trace.models.items()):
        traces.append(_draw_power(escape_label(name), get_model_style(place), trace, of_model.energy_kwh))
    made = make_figure(traces, 400, x={"title_text": AXES["end_min"]}, y={"title_text": "Mean power of a window [kW]"})
    _shade(made, trace, [0.0, *trace.windows.end_min])
    return made


def draw_terms(trace: RideTrace, model: str) -> go.Figure:
    """Return a figure of the terms of a model, stacked, and of the measured power."""
    ends = [0.0, *trace.windows.end_min]
    middle = [(a + b) / 2.0 for a, b in pairwise(ends)]
    width = [0.92 * (b - a) for a, b in pairwise(ends)]
    traces: list[Any] = []
    order = list(dict.fromkeys(name for of_model in trace.models.values() for name in _largest(of_model.terms)))
    for name, energy in _largest(trace.models[model].terms).items():
        look = get_style(1 + order.index(name))  # a term has one pattern, whichever model it is of
        power = convert_to_power(trace, energy)
        traces.append(draw_bars(escape_label(name), look, power, middle, orientation=None, width=width))
    traces.append(_draw_power("measured", MEASURED, trace, trace.windows.measured_kwh, width=3))
    return make_figure(
        traces,
        420,
        x={"title_text": AXES["end_min"]},
        y={"title_text": "Mean power of a window [kW]"},
        barmode="relative",
    )


def _largest(energies: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    """Return the largest terms, and the sum of the others."""
    order = sorted(energies, key=lambda name: -sum(abs(value) for value in energies[name]))
    made = {name: list(energies[name]) for name in order[:MOST_TERMS]}
    if rest := order[MOST_TERMS:]:
        made[OTHERS] = [sum(values) for values in zip(*(energies[name] for name in rest), strict=True)]
    return made


def _draw_steps(
    name: str, look: Style, x: Sequence[float], y: Sequence[Any], *, width: float = 2, **more: Any
) -> go.Scatter:
    """Return a line through the values at the end of each window."""
    line = {"color": look.colour, "dash": look.dash, "width": width}
    marker = {"symbol": look.symbol, "size": 5, "color": look.colour}
    return go.Scatter(
        name=name, x=list(x), y=list(y), mode="lines+markers", line=line, marker=marker, legendgroup=name, **more
    )


def _draw_power(name: str, look: Style, trace: RideTrace, energy: Sequence[float], *, width: float = 2) -> go.Scatter:
    """Return the mean power of an energy as a line that is constant over each window."""
    line = {"color": look.colour, "dash": look.dash, "width": width, "shape": "hv"}
    power = convert_to_power(trace, energy)
    return go.Scatter(name=name, x=[0.0, *trace.windows.end_min], y=[*power, power[-1]], mode="lines", line=line)


def _shade(made: go.Figure, trace: RideTrace, x: Sequence[float]) -> None:
    """Shade the windows in which the first model and the measurement diverge."""
    if place := next(iter(trace.models.values())).place:
        shade = {"fillcolor": "rgba(138,138,138,0.25)", "line": {"width": 0}, "layer": "below"}
        made.add_vrect(x0=x[place.first], x1=x[place.last + 1], **shade)
