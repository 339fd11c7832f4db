"""Show how cars are doing: in the terminal in words and as a table, and as a page with a figure of each car."""

from collections.abc import Sequence
from datetime import date
from typing import Any, Final

import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.core.condition.records import CarCondition, CarEvent, ConditionStep, FleetCondition, Trend
from socast.core.formatting import format_minus, word_date, word_since
from socast.core.records import ConfidenceInterval
from socast.core.stats.scores import NORMAL_95
from socast.tools.report.document import Illustration, Report, Section, print_section
from socast.tools.report.figure_style import REFERENCE_LINE, escape_label, get_style, make_figure
from socast.tools.report.table import UNKNOWN, ReportTable, format_count, tabulate

TITLE: Final = "Condition of the cars"
MOST_DESCRIBED: Final = 8
"""Largest number of cars whose findings are told in words."""
MOST_DRAWN: Final = 24
"""Number of cars that have a figure."""
NOTE: Final = (
    "Consumption: measured energy over that of the model, beside the mean of the other cars of the vehicle model on "
    "the same dates, as of the last date; a car without two siblings is compared with the model alone, and the weather "
    "that the model lacks then counts as the car's. Rate: change without sudden ones; a dash where the dates are too "
    "few. Usable: capacity at mild temperature, of that of the catalogue. In parentheses: 95 % intervals."
)
STEP_NOTE: Final = (
    "Changed: the first date after a sudden change whose probability is at least 80 %. Cars with a finding come first, "
    "and of these the one that takes most."
)
LEAST_COLD_LOSS: Final = 0.02
"""Least loss of capacity in the cold that is told. [%/K]"""
BAND_NOTE: Final = "Band: 95 % interval of the level."
EVENT_NOTE: Final = "Dotted vertical lines: known events."
CLEAR: Final = "as expected, within the interval."
"""What is said of a car without a finding."""
ROWS: Final = 3
"""Largest number of rows of words of events above a figure; further events have a line alone, and stand below it."""
ROW_PX: Final = 15
"""Height of such a row. [px]"""
LONGEST: Final = 24
"""Largest number of characters of the words of an event in a figure."""
LEAST_LONG: Final = 10
"""Number of them that must have room to the right of its line; else the words stand to the left."""
ROOM: Final = 40
"""Number of characters that have room in a row."""


def show(result: FleetCondition, console: Console) -> None:
    """Print the table of cars, and then the worst cars in words."""
    report = build_report(result)
    print_section(report.sections[0]._replace(title=TITLE), console)
    for line in report.lead:
        console.print(Text(line))


def build_report(result: FleetCondition) -> Report:
    """Return the report of the cars."""
    drawn, cars = min(MOST_DRAWN, len(result.cars)), len(result.cars)
    title = "Each car" if drawn == cars else f"The first {drawn} of {cars} cars"
    sections = [
        Section("cars", "All cars", _describe_data(result), [tabulate_cars(result)]),
        Section("each", title, f"{BAND_NOTE} {EVENT_NOTE}" if _has_events(result) else BAND_NOTE, []),
    ]
    if _has_events(result):
        sections.append(Section("events", "Known events", "", [_tabulate_events(result)]))
    figures = {"each": _illustrate}
    return Report("condition", "condition", TITLE, sections, describe_fleet(result), (), result, figures)


def _describe_data(result: FleetCondition) -> str:
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
    lines = [" ".join([describe_car(car), *_list_known(car.events)]) for car in found[:MOST_DESCRIBED]]
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


def describe_car(car: CarCondition) -> str:
    """Return what is found of a car in a sentence, empty where nothing is."""
    parts = []
    if (trend := car.consumption) is not None:
        if trend.ci95_pct[0] > 0.0 or trend.ci95_pct[1] < 0.0:
            beside = "its siblings" if car.siblings else "the model predicts"
            parts.append(f"takes {_word_change(trend.level_pct, trend.ci95_pct)} than {beside}")
        parts += [f"takes {_word_step(step)}" for step in trend.steps]
        parts += [f"takes {rate} each year" for rate in _word_rate(trend)]
    if (trend := car.capacity) is not None:
        if trend.ci95_pct[1] < 0.0:
            parts.append(f"its battery holds {_word_change(trend.level_pct, trend.ci95_pct)} than in the catalogue")
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
        "Cars, the worst first",
        "car",
        rows,
        [
            ("days", lambda car: format_count(car.consumption.days if car.consumption else None)),
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


def _illustrate(result: FleetCondition) -> list[Illustration]:
    """Return a figure of each of the first cars."""
    return [
        Illustration(
            f"car-{place}",
            car.vehicle_id,
            " ".join([describe_car(car) or f"{car.vehicle_id}: {CLEAR}", *_list_known([*car.events, *result.events])]),
            draw_car(car, result.events),
            small=True,
        )
        for place, car in enumerate(result.cars[:MOST_DRAWN])
    ]


def draw_car(car: CarCondition, of_all: Sequence[CarEvent] = ()) -> go.Figure:
    """Return a figure of the consumption and the usable capacity of a car over the dates, with known events."""
    traces: list[dict[str, Any]] = []  # plotly checks traces of its own types twice
    parts = (("consumption", car.consumption, 2, "solid"), ("usable capacity", car.capacity, 4, "dot"))
    for name, trend, place, dash in parts:  # the reference line is dashed
        if trend is None:
            continue
        look = get_style(place)
        middle = [each or 0.0 for each in trend.path_pct]
        spread = [NORMAL_95 * (each or 0.0) for each in trend.path_sd_pct]
        band = [m + s for m, s in zip(middle, spread, strict=True)]
        band += [m - s for m, s in zip(reversed(middle), reversed(spread), strict=True)]
        traces += [
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
            {
                "x": trend.dates,
                "y": trend.measured_pct,
                "mode": "markers",
                "marker": {"size": 5, "color": look.colour, "symbol": look.symbol, "opacity": 0.6},
                "name": f"{name}, day",
            },
            {
                "x": trend.dates,
                "y": middle,
                "mode": "lines",
                "line": {"color": look.colour, "dash": dash},
                "name": name,
            },
        ]
    made = make_figure(traces, 280, x={"title_text": "date [UTC]"}, y={"title_text": "beside expected [%]"})
    made.add_hline(y=0.0, line=REFERENCE_LINE)
    days = [each for trend in (car.consumption, car.capacity) if trend for each in trend.dates]
    _mark_events(made, sorted([*car.events, *of_all], key=lambda each: each.date), days)
    return made


def _mark_events(made: go.Figure, events: Sequence[CarEvent], days: Sequence[str]) -> None:
    """Draw events as dotted vertical lines through a figure of these dates, with their words in rows above it.

    The last event is lowest, so that the lines of the others pass to the left of its words.
    """
    if not events:
        return
    places = [date.fromisoformat(each).toordinal() for each in (*days, *(event.date for event in events))]
    first, room = min(places) - 1, max(places) - min(places) + 2
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
    made.update_xaxes(range=[date.fromordinal(each).isoformat() for each in (first, first + room)])
