"""Show how cars are doing: in the terminal in words and as a table, and as a page with a figure of each car."""

from collections.abc import Sequence
from datetime import date
from typing import Any, Final, NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from rich.console import Console
from rich.text import Text

from socast.core.condition.car_condition import LEAST_DAYS
from socast.core.condition.car_days import LEAST_FALL
from socast.core.condition.records import CarCondition, CarEvent, ConditionStep, FleetCondition, Trend
from socast.core.formatting import format_minus, word_date, word_since
from socast.core.records import ConfidenceInterval
from socast.core.stats.scores import NORMAL_95
from socast.tools.report.document import Illustration, Report, Section, print_section
from socast.tools.report.figure_style import (
    DATES,
    REFERENCE_LINE,
    Style,
    apply_layout,
    escape_label,
    find_robust_range,
    get_style,
    tell_outside,
)
from socast.tools.report.table import UNKNOWN, ReportTable, format_count, tabulate

TITLE: Final = "Condition of the cars"
MOST_DESCRIBED: Final = 8
"""Largest number of cars whose findings are told in words."""
MOST_DRAWN: Final = 24
"""Number of cars that have a figure."""
NOTE: Final = (
    "Days: dates with a consumption/with a usable capacity. Consumption: measured energy over "
    "that of the model, beside the mean of the other cars of the vehicle model on the same dates, as of the last date; "
    "a car without two siblings is compared with the model alone, and the weather that the model lacks then counts as "
    "the car's. Rate: change without sudden ones; a dash where the dates are too few. Usable: capacity at mild "
    "temperature as of the last date, of that of the catalogue, from rides of known voltage and current; a dash where "
    f"the display fell by {LEAST_FALL:g} % or more on fewer than {LEAST_DAYS} dates. In parentheses: 95 % intervals."
)
STEP_NOTE: Final = (
    "Changed: the first date after a sudden change whose probability is at least 80 %. Cars with a finding come first: "
    "those that take more or less beyond the interval, changed, change or lack capacity. Among them, and among the "
    "others, the one that takes most comes first."
)
LEAST_COLD_LOSS: Final = 0.02
"""Least loss of capacity in the cold that is told. [%/K]"""
FIGURE_NOTE: Final = (
    "Points: days. Line: their level, with its 95 % interval as a band. Consumption is beside the siblings, usable "
    "capacity beside the catalogue. All cars have the same axes."
)
EVENT_NOTE: Final = "Dotted vertical lines: known events."
CLEAR: Final = "as expected, within the interval."
"""What is said of a car without a finding."""
ROWS: Final = 3
"""Largest number of rows of words of events above a figure; further events have a line alone, and stand below it."""
HEIGHT: Final = 280
"""Height of the figure of a car with one quantity. [px]"""
PANEL: Final = 150
"""Height that a second one adds. [px]"""
ROW_PX: Final = 15
"""Height of such a row. [px]"""
LONGEST: Final = 24
"""Largest number of characters of the words of an event in a figure."""
LEAST_LONG: Final = 10
"""Number of them that must have room to the right of its line; else the words stand to the left."""
ROOM: Final = 40
"""Number of characters that have room in a row."""


def show(result: FleetCondition, console: Console) -> None:
    """Print the table of cars, and then those with a finding in words."""
    report = build_report(result)
    print_section(report.sections[0]._replace(title=TITLE), console)
    for line in report.lead:
        console.print(Text(line))


def build_report(result: FleetCondition) -> Report:
    """Return the report of the cars."""
    drawn, cars = min(MOST_DRAWN, len(result.cars)), len(result.cars)
    title = "Each car" if drawn == cars else f"The first {drawn} of {cars} cars"
    sections = [
        Section("cars", "All cars", describe_data(result), [tabulate_cars(result)]),
        Section("each", title, f"{FIGURE_NOTE} {EVENT_NOTE}" if _has_events(result) else FIGURE_NOTE, []),
    ]
    if _has_events(result):
        sections.append(Section("events", "Known events", "", [_tabulate_events(result)]))
    figures = {"each": _illustrate}
    return Report("condition", "condition", TITLE, sections, describe_fleet(result), (), result, figures)


def describe_data(result: FleetCondition) -> str:
    """Return what the condition is of, in a few sentences."""
    rides = ", ".join(f"{n:,} {why}" for why, n in result.left_out.items())
    days, share = result.car_days_left_out, 100.0 * result.energy_left_out
    left = f" Left out: {days:,} car-days with too little energy, {share:.1f} % of the energy." if days else ""
    cold = ""
    if result.cold_loss_pct is not None and result.cold_loss_pct >= LEAST_COLD_LOSS:
        cold = f" Each kelvin below 10 °C lowers the usable capacity by {result.cold_loss_pct:.2f} %."
    return (
        f"{result.rides:,} rides on {result.car_days:,} car-days from {result.first_date} to "
        f"{result.last_date}{f' ({rides} left out)' if rides else ''}; model {result.model}."
        f"{left} On a usual day, the consumption of a car differs from its level "
        f"by {result.day_sd_pct:.1f} % (standard deviation).{cold}"
    )


def describe_fleet(result: FleetCondition) -> list[str]:
    """Return the cars with findings in words, and how many others there are."""
    found = [car for car in result.cars if car.has_finding]
    unknown = [car.vehicle_id for car in result.cars if car.consumption is None]
    rest = len(result.cars) - len(found) - sum(car.consumption is None and not car.has_finding for car in result.cars)
    lines = [
        " ".join([describe_car(car, result.last_date), *describe_known(car, car.events)])
        for car in found[:MOST_DESCRIBED]
    ]
    if more := len(found) - MOST_DESCRIBED:
        lines += [f"{more} more {'car differs' if more == 1 else 'cars differ'}: see the table."] if more > 0 else []
    if rest:
        which = "other " if found else ""
        lines.append(
            f"{rest} {which}{'car takes' if rest == 1 else 'cars take'} what is expected, within the interval."
        )
    if unknown:
        others = " and others" if len(unknown) > MOST_DESCRIBED else ""
        lines.append(f"Too few dates tell of {', '.join(unknown[:MOST_DESCRIBED])}{others}.")
    return lines + _describe_further_events(result)


def _describe_further_events(result: FleetCondition) -> list[str]:
    """Return the events of cars without a finding and of all cars in words, and how many others there are."""
    clear = [car for car in result.cars if car.events and not car.has_finding]
    lines = [line for car in clear[:MOST_DESCRIBED] for line in _list_known(car.events, f" of {car.vehicle_id}")]
    if len(clear) > MOST_DESCRIBED:
        lines.append(f"Known events of {len(clear) - MOST_DESCRIBED:,} more cars: see the page of --html.")
    lines += _list_known(result.events, " of all cars")
    if left := result.events_left_out:
        which = "1 known event is" if left == 1 else f"{left:,} known events are"
        lines.append(f"{which} of other cars, or outside the dates, and left out.")
    return lines


def _list_known(events: Sequence[CarEvent], of: str = "") -> list[str]:
    """Return a sentence with all events, nothing without any."""
    return [f"Known{of}: {'; '.join(map(describe_event, events))}."] if events else []


def describe_event(event: CarEvent) -> str:
    """Return an event in words, such as `new tyres on 20 November 2018, 8 days after the step`."""
    after = event.days_after_step
    if after is None:
        return _name_event(event)
    days = f"{abs(after)} day{'' if abs(after) == 1 else 's'} {'after' if after > 0 else 'before'}"
    return f"{_name_event(event)}, {days if after else 'the date of'} the step"


def _name_event(event: CarEvent) -> str:
    """Return what happened, and when."""
    return f"{event.what or 'event'} on {word_date(event.date)}"


def describe_known(car: CarCondition, events: Sequence[CarEvent]) -> list[str]:
    """Return a sentence with the events that the words of a car do not hold, nothing without any."""
    steps = [step for trend in (car.consumption, car.capacity) if trend for step in trend.steps]
    told = {(each.date, each.what) for step in steps for each in step.events}
    return _list_known([each for each in events if (each.date, each.what) not in told])


def describe_car(car: CarCondition, last_date: str) -> str:
    """Return what is found of a car in a sentence, empty where nothing is; levels are those of the last date."""
    parts, then = [], f"as of {word_date(last_date)}"
    if (trend := car.consumption) is not None:
        if trend.ci95_pct[0] > 0.0 or trend.ci95_pct[1] < 0.0:
            beside = "its siblings" if car.siblings else "the model predicts"
            parts.append(f"takes {_word_change(trend.level_pct, trend.ci95_pct)} than {beside} {then}")
        parts += [f"takes {_word_step(step)}" for step in trend.steps]
        parts += [f"takes {rate} each year" for rate in _word_rate(trend)]
    if (trend := car.capacity) is not None:
        if trend.ci95_pct[1] < 0.0:
            change = _word_change(trend.level_pct, trend.ci95_pct)
            parts.append(f"its battery holds {change} than in the catalogue {then}")
        parts += [f"its battery holds {_word_step(step)}" for step in trend.steps]
        parts += [f"its battery holds {rate} each year" for rate in _word_rate(trend)]
    return f"{car.vehicle_id}: {'; '.join(parts)}." if parts else ""


def _word_rate(trend: Trend) -> list[str]:
    """Return the rate in words, nothing where it may be chance or is unknown."""
    if not trend.is_changing or trend.rate_pct is None or trend.rate_ci95_pct is None:
        return []
    return [_word_change(trend.rate_pct, trend.rate_ci95_pct)]


def _word_change(percent: float, interval: ConfidenceInterval) -> str:
    """Return a change in words, such as `6.1 % more (4.0 to 8.2)`."""
    word = "more" if percent > 0.0 else "less"
    if interval[0] <= 0.0 <= interval[1]:
        return format_minus(f"{abs(percent):.1f} % {word} ({interval[0]:+.1f} to {interval[1]:+.1f})")
    low, high = sorted(abs(each) for each in interval)
    return f"{abs(percent):.1f} % {word} ({low:.1f} to {high:.1f})"


def _word_step(step: ConditionStep) -> str:
    """Return a sudden change in words."""
    since = word_since(step.since, step.interval)
    events = f", with {' and '.join(map(_name_event, step.events))}" if step.events else ""
    return f"{_word_change(step.change_pct, step.ci95_pct)} {since}{events}"


def tabulate_cars(result: FleetCondition) -> ReportTable:
    """Return a row for each car."""
    rows = [(car.vehicle_id, car) for car in result.cars]
    return tabulate(
        "Cars, those with a finding first",
        "car",
        rows,
        [
            ("days", _count_days),
            ("consumption, %", _format_level),
            ("rate, %/year", lambda car: _format_rate(car.consumption)),
            ("changed", _list_changes),
            ("usable, kWh", _format_usable),
            ("battery rate, %/year", lambda car: _format_rate(car.capacity)),
        ],
        (NOTE, STEP_NOTE),
    )


def _has_events(result: FleetCondition) -> bool:
    """Return whether any event is shown."""
    return bool(result.events) or any(car.events for car in result.cars)


def _tabulate_events(result: FleetCondition) -> ReportTable:
    """Return a row for each event, those of all cars last."""
    rows = [(car.vehicle_id, event) for car in result.cars for event in car.events]
    columns = [
        ("date", lambda event: event.date),
        ("what", lambda event: event.what or UNKNOWN),
        ("nearest step", lambda event: event.step_since or UNKNOWN),
        ("days after it", _format_days),
    ]
    notes = ("Nearest step: the first date after the sudden change of this car that is nearest to the event.",)
    return tabulate("Known events", "car", [*rows, *(("all cars", each) for each in result.events)], columns, notes)


def _format_days(event: CarEvent) -> str:
    """Return how many days after the nearest step an event is."""
    return UNKNOWN if event.days_after_step is None else format_minus(f"{event.days_after_step:+d}")


def _count_days(car: CarCondition) -> str:
    """Return the number of dates with a consumption, and of those with a capacity where it is told."""
    days = format_count(car.consumption.days if car.consumption else None)
    return f"{days}/{format_count(car.capacity.days)}" if car.capacity else days


def _format_usable(car: CarCondition) -> str:
    """Return the usable capacity with its interval. [kWh]"""
    if car.capacity is None or car.nominal_kwh is None:
        return UNKNOWN
    low, high = (car.nominal_kwh * (1.0 + each / 100.0) for each in car.capacity.ci95_pct)
    return f"{car.usable_kwh:.1f} ({low:.1f} to {high:.1f}) of {car.nominal_kwh:.1f}"


def _format_level(car: CarCondition) -> str:
    """Return the level of the consumption with its interval."""
    return _format_interval(car.consumption.level_pct, car.consumption.ci95_pct) if car.consumption else UNKNOWN


def _format_rate(trend: Trend | None) -> str:
    """Return the rate with its interval."""
    if trend is None or trend.rate_pct is None or trend.rate_ci95_pct is None:
        return UNKNOWN
    return _format_interval(trend.rate_pct, trend.rate_ci95_pct)


def _format_interval(value: float, interval: ConfidenceInterval) -> str:
    """Return a percentage with its interval."""
    low, high = interval
    return format_minus(f"{value:+.1f} ({low:+.1f} to {high:+.1f})")


def _list_changes(car: CarCondition) -> str:
    """Return the dates of sudden changes."""
    changes = [f"{each.since} {each.change_pct:+.1f} %" for each in (car.consumption.steps if car.consumption else [])]
    changes += [
        f"{each.since} battery {each.change_pct:+.1f} %" for each in (car.capacity.steps if car.capacity else [])
    ]
    return format_minus(", ".join(changes)) or UNKNOWN


class Frame(NamedTuple):
    """Hold the axes that the figures of all cars have, so that they can be compared.

    Parameters
    ----------
    consumption, capacity : tuple of float, optional
        Range of the days and levels; None where no car has any. [%]
    """

    first_date: str
    last_date: str
    consumption: tuple[float, float] | None
    capacity: tuple[float, float] | None


def find_frame(result: FleetCondition) -> Frame:
    """Return the axes of the figures of all cars."""

    def find_range(trends: Sequence[Trend | None]) -> tuple[float, float] | None:
        known = [each for each in trends if each is not None]
        if not known:
            return None
        days, levels = (
            np.array([value for values in of for value in values if value is not None])
            for of in ([each.measured_pct for each in known], [each.path_pct for each in known])
        )
        return find_robust_range(days, levels)

    ranges = (find_range([getattr(car, name) for car in result.cars]) for name in ("consumption", "capacity"))
    return Frame(result.first_date, result.last_date, *ranges)


def count_outside(car: CarCondition, frame: Frame) -> int:
    """Return the number of dates of a car with a value outside the figure."""
    parts = ((car.consumption, frame.consumption), (car.capacity, frame.capacity))
    return len(
        {
            date
            for trend, ends in parts
            if trend and ends
            for date, value in zip(trend.dates, trend.measured_pct, strict=True)
            if value is not None and not ends[0] <= value <= ends[1]
        }
    )


def _illustrate(result: FleetCondition) -> list[Illustration]:
    """Return a figure of each of the first cars."""
    frame, drawn = find_frame(result), []
    for place, car in enumerate(result.cars[:MOST_DRAWN]):
        words = describe_car(car, result.last_date) or f"{car.vehicle_id}: {CLEAR}"
        caption = " ".join([words, *describe_known(car, [*car.events, *result.events])])
        caption += tell_outside(count_outside(car, frame))
        figure = draw_car(car, frame, result.events)
        drawn.append(Illustration(f"car-{place}", car.vehicle_id, caption, figure, small=True))
    return drawn


def draw_car(car: CarCondition, frame: Frame, of_all: Sequence[CarEvent] = ()) -> go.Figure:
    """Return a figure of a car over the dates: its consumption, below it its usable capacity, and known events."""
    parts = (
        ("consumption", car.consumption, frame.consumption, 2),
        ("usable capacity", car.capacity, frame.capacity, 4),
    )
    known = [part for part in parts if part[1] is not None] or list(parts[:1])
    made = make_subplots(rows=len(known), cols=1, shared_xaxes=True, vertical_spacing=0.08)
    apply_layout(made, HEIGHT + PANEL * (len(known) - 1))
    for row, (name, trend, ends, place) in enumerate(known, start=1):
        if trend is not None:
            made.add_traces(_draw_trend(name, trend, get_style(place)), rows=row, cols=1)
        made.update_yaxes(title_text=f"{name} [%]", range=ends, nticks=5, row=row, col=1)
    made.update_xaxes(**DATES | {"title_text": None})
    made.update_xaxes(title_text=DATES["title_text"], row=len(known), col=1)
    made.add_hline(y=0.0, line=REFERENCE_LINE)
    events = sorted([*car.events, *of_all], key=lambda each: each.date)
    _mark_events(made, events, (frame.first_date, frame.last_date))
    return made


def _draw_trend(name: str, trend: Trend, look: Style) -> list[dict[str, Any]]:
    """Return the band, the days and the level of a quantity; plotly checks traces of its own types twice."""
    middle = [each or 0.0 for each in trend.path_pct]
    spread = [NORMAL_95 * (each or 0.0) for each in trend.path_sd_pct]
    band = [m + s for m, s in zip(middle, spread, strict=True)]
    band += [m - s for m, s in zip(reversed(middle), reversed(spread), strict=True)]
    marker = {"size": 5, "color": look.colour, "symbol": look.symbol, "opacity": 0.6}
    return [
        {
            "x": [*trend.dates, *reversed(trend.dates)],
            "y": band,
            "fill": "toself",
            "mode": "none",
            "fillcolor": look.colour,
            "opacity": 0.25,
            "showlegend": False,
            "hoverinfo": "skip",
        },
        {"x": trend.dates, "y": trend.measured_pct, "mode": "markers", "marker": marker, "name": f"{name}, day"},
        {"x": trend.dates, "y": middle, "mode": "lines", "line": {"color": look.colour}, "name": name},
    ]


def _mark_events(made: go.Figure, events: Sequence[CarEvent], ends: tuple[str, str]) -> None:
    """Draw events as dotted vertical lines through a figure from one date to another, with words in rows above it.

    The last event is lowest, so that the lines of the others pass to the left of its words.
    """
    first, last = (date.fromisoformat(each).toordinal() for each in ends)
    first, room = first - 1, last - first + 2
    made.update_xaxes(range=[date.fromordinal(each).isoformat() for each in (first, first + room)])
    rows: list[list[tuple[float, float]]] = [[] for _ in range(ROWS)]
    line = {**REFERENCE_LINE, "dash": "dot"}
    for event in reversed(events):
        made.add_shape(type="line", x0=event.date, x1=event.date, y0=0, y1=1, yref="paper", line=line)
        at, text = (date.fromisoformat(event.date).toordinal() - first) / room, event.what or "event"
        right = int(ROOM * (1.0 - at))
        fits = right >= min(LEAST_LONG, len(text))
        longest = min(LONGEST, right) if fits else LONGEST
        text = text if len(text) <= longest else f"{text[: longest - 1]}…"
        wide = (len(text) + 1) / ROOM
        low = at if fits else at - wide
        free = (row for row, taken in enumerate(rows) if all(low >= to or low + wide <= since for since, to in taken))
        if (row := next(free, None)) is None:
            continue
        rows[row].append((low, low + wide))
        made.add_shape(
            type="line",
            x0=event.date,
            x1=event.date,
            y0=0,
            y1=ROW_PX * (row + 1),
            yref="paper",
            ysizemode="pixel",
            yanchor=1,
            line=line,
        )
        made.add_annotation(
            x=event.date,
            y=1.0,
            yref="paper",
            yshift=ROW_PX * row,
            yanchor="bottom",
            xanchor="left" if fits else "right",
            text=escape_label(text),
            showarrow=False,
            hovertext=escape_label(_name_event(event)),
        )
    above = ROW_PX * sum(map(bool, rows))
    made.layout.margin.t = above + 18
    made.layout.height += above
