"""Show whether the consumption of cars changed with a campaign: in the terminal, and as a page."""

from collections.abc import Sequence
from datetime import UTC, datetime
from operator import itemgetter
from typing import Any, Final

import numpy as np
import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.core.batch import Floats, Ints
from socast.core.condition.campaign import SIZES
from socast.core.condition.campaign_records import INTERVAL, BeforeAfter, CarChange, CarSeries, LevelPath
from socast.core.formatting import format_count as count_things
from socast.core.formatting import format_minus, word_date
from socast.tools.report.document import Illustration, Report, Section, print_report
from socast.tools.report.figure_style import (
    DATES,
    add_reference_line,
    escape_label,
    find_robust_range,
    get_style,
    make_figure,
    tell_outside,
)
from socast.tools.report.table import (
    FORMATS,
    ReportTable,
    format_count,
    format_digits,
    format_percent,
    format_signed,
    tabulate,
    tabulate_records,
)

SIDES: Final = (("before", "off", 1), ("after", "on", 4))
"""Name of the days before and after, the same of days off and on, and the place of their style."""
PLACEBOS: Final = (
    "The same estimate for cars without a campaign, and for earlier dates of its own cars. Where their spread exceeds "
    "that of the model, it widens the interval. Neighbouring dates share most of their days, so the number of "
    "independent placebo campaigns is smaller."
)
MEASURE: Final = (
    "The change is of the consumption of a day at equal conditions. Days count by how well they are "
    "measured: those with little energy, and those far off, count less."
)
BINS: Final = 31
"""Number of bars of the placebo campaigns."""


def show(result: BeforeAfter, console: Console) -> None:
    """Print the change of each car, then the answer in words."""
    report = build_report(result)
    print_report(report, console)
    console.print()
    for line in report.lead:
        console.print(Text(line))


def build_report(result: BeforeAfter) -> Report:
    """Return the report of a campaign."""
    sections, lead = _build_sections(result), describe_campaign(result)
    return Report("before-after", "before-after", "Before and after", sections, lead, (), result, FIGURES)


def describe_campaign(result: BeforeAfter) -> list[str]:
    """Return the answer, how long a change takes to be seen where that helps, and what limits the answer."""
    is_found = result.change is not None and result.change.is_shown
    is_planned = any(each.size not in SIZES for each in result.detection)
    detection = [] if is_found and not is_planned else [_describe_detection(result)]
    return [_describe_change(result), *_describe_measure(result), *detection, *result.notes]


def _describe_change(result: BeforeAfter) -> str:
    """Return the change of all cars together, with its interval and the placebo campaigns."""
    what = f" ({result.what})" if result.what else ""
    change = result.change
    if change is None:
        ends = f"The rides end on {word_date(result.last_date)}"
        return f"{ends}, before {word_date(result.at or '')}{what}: nothing can be compared yet."
    cars, several = " and ".join(result.vehicles), len(result.vehicles) > 1
    when = "on days on" if result.at is None else f"since {word_date(result.at)}"
    until = f" until {word_date(result.until)}" if result.until else ""
    words = f"90 % interval {format_change_interval(change.ci90)}. {_describe_placebos(result)}"
    if change.is_shown:
        return f"{cars} {'take' if several else 'takes'} {_word_change(change.change)} {when}{until}{what}: {words}"
    return f"No change of {cars} is shown {when}{until}{what}: {_word_change(change.change)}, {words}"


def _describe_measure(result: BeforeAfter) -> list[str]:
    """Return what the percentage is of, and what it is in energy."""
    if result.change is None:
        return []
    words = [MEASURE]
    if (extra := result.change.extra_per_100km_kwh) is not None:
        days = "days on" if result.at is None else "days after"
        middle, low, high = (format_signed(each, 2) for each in extra)
        words.append(
            f"At the {result.change.per_100km_kwh:.1f} kWh/100 km of the {days}, it makes {middle} kWh/100 km "
            f"({low} to {high})."
        )
    return [" ".join(words)]


def _describe_placebos(result: BeforeAfter) -> str:
    """Return how many placebo campaigns show as much."""
    all_of_them, as_large = len(result.placebo.campaigns), result.placebo.as_large
    if not all_of_them:
        return "There are no placebo campaigns."
    number = "None" if as_large == 0 else format_count(as_large)
    return f"{number} of {format_count(all_of_them)} placebo campaigns {'show' if as_large > 1 else 'shows'} as much."


def _describe_detection(result: BeforeAfter) -> str:
    """Return how long changes take to be seen, in one line, and what lets smaller ones be seen."""
    when, before = ("of days on", "days off") if result.at is None else ("after the date", "days before it")
    seen = {each.size: count_things(each.days, "day") for each in result.detection if each.days is not None}
    unseen = [each.size for each in result.detection if each.days is None]
    remedy = f"takes more than a year, unless there are more {before} or more cars"
    if not seen:
        return f"To see even {100.0 * unseen[-1]:g} % {remedy}."
    first, *others = (f"{100.0 * size:g} % takes about {days}" for size, days in seen.items())
    rest = f"; {100.0 * unseen[-1]:g} % or less {remedy}" if unseen else ""
    return f"To see {', '.join([f'{first} {when}', *others])} (in 4 of 5 cases){rest}."


def format_change_interval(interval: tuple[float, float]) -> str:
    """Return the interval of a change in words.

    Examples
    --------
    >>> format_change_interval((-0.056, -0.026)), format_change_interval((-0.009, 0.025))
    ('2.6 to 5.6 % less', '0.9 % less to 2.5 % more')
    """
    low, high = interval
    if low * high < 0.0:
        return f"{_word_change(low)} to {_word_change(high)}"
    near, far = sorted((abs(low), abs(high)))
    return f"{100.0 * near:.1f} to {100.0 * far:.1f} % {'less' if high <= 0.0 else 'more'}"


def _word_change(change: float) -> str:
    return f"{format_percent(abs(change))} {'less' if change < 0.0 else 'more'}"


def _build_sections(result: BeforeAfter) -> list[Section]:
    """Return the sections of the report."""
    formats = {**FORMATS, INTERVAL: lambda value: format_minus(f"{100.0 * value[0]:+.1f} to {100.0 * value[1]:+.1f} %")}
    every = [*result.cars, result.change] if result.change and len(result.cars) > 1 else result.cars
    changes = tabulate_records("Change of consumption", every, CarChange, totals=("all",), formats=formats)
    about = (
        f"Measured over predicted energy (model {result.model}) of each day, less that of other cars of the same "
        "vehicle model on the same dates."
    )
    return [
        *([Section("change", "Change of consumption", about, [changes])] if every else []),
        Section("placebo", "Placebo campaigns", PLACEBOS, [_tabulate_placebos(result)]),
    ]


def _tabulate_placebos(result: BeforeAfter) -> ReportTable:
    """Return what the placebo campaigns say of the standard error."""
    placebo, as_large = result.placebo, "" if result.change is None else format_count(result.placebo.as_large)
    texts = {
        "number": format_count(len(placebo.campaigns)),
        "independent": format_count(round(placebo.independent)),
        "spread / model's": format_digits(placebo.spread),
        "factor of interval": format_digits(placebo.scale),
        "show as much": as_large,
    }
    return tabulate(
        "Placebo campaigns", "", [("placebo campaigns", texts)], [(head, itemgetter(head)) for head in texts]
    )


def _illustrate_days(result: BeforeAfter) -> list[Illustration]:
    """Return a figure of the days of each car."""
    if not result.series:
        return []
    drawn, (low, high) = [], _find_range(result.series)
    for place, one in enumerate(result.series):
        outside = sum(not low <= 100.0 * each <= high for each in one.deviation)
        dashed = "" if result.at is None else " Dashed: the date."
        caption = (
            "Points: measured over predicted energy of a day, beside the other cars and the car before. Lines: "
            f"their smoothed mean with its 90 % band.{dashed}{tell_outside(outside)}"
        )
        title = f"{one.vehicle_id}, day by day"
        drawn.append(Illustration(f"days-{place}", title, caption, draw_days(result, one, (low, high))))
    return drawn


def _find_range(series: Sequence[CarSeries]) -> tuple[float, float]:
    """Return the range that the figures of all cars have, so that they can be compared. [%]"""
    levels = [path.level for one in series for path in (one.level_before, one.level_after)]
    return find_robust_range(100.0 * np.concatenate([one.deviation for one in series]), 100.0 * np.concatenate(levels))


def draw_days(result: BeforeAfter, one: CarSeries, shown: tuple[float, float]) -> go.Figure:
    """Return a figure of the daily deviation of a car from its siblings over the date, in the `shown` range. [%]"""
    traces: list[Any] = []
    for place, (path, side) in enumerate(zip((one.level_before, one.level_after), SIDES, strict=True)):
        name, look = side[1 if result.at is None else 0], get_style(side[2])
        chosen = [i for i, after in enumerate(one.after) if after == bool(place)]
        marker = {"symbol": look.symbol if place else f"{look.symbol}-open", "size": 7, "color": look.colour}
        traces += [
            _draw_band(path, look.colour),
            go.Scatter(
                name=f"day {name}",
                x=[one.date[i] for i in chosen],
                y=[100.0 * one.deviation[i] for i in chosen],
                mode="markers",
                marker=marker,
            ),
            go.Scatter(
                name=f"smoothed, {name}",
                x=path.date,
                y=[100.0 * each for each in path.level],
                mode="lines",
                line={"color": look.colour, "width": 2.5, "dash": "solid" if place else "dash"},
            ),
        ]
    y = {"title_text": "consumption beside siblings [%]", "range": shown}
    figure = make_figure(traces, 420, x=DATES, y=y)
    if result.at is not None:
        milliseconds = 1000.0 * datetime.fromisoformat(result.at).replace(tzinfo=UTC).timestamp()
        add_reference_line(figure, escape_label(result.what or result.at), milliseconds)
    return figure


def _draw_band(path: LevelPath, colour: str) -> go.Scatter:
    """Return the band of a level."""
    return go.Scatter(
        x=[*path.date, *reversed(path.date)],
        y=[100.0 * each for each in (*path.high, *reversed(path.low))],
        fill="toself",
        mode="lines",
        line={"width": 0, "color": colour},
        opacity=0.3,
        hoverinfo="skip",
        showlegend=False,
    )


def _illustrate_placebos(result: BeforeAfter) -> list[Illustration]:
    """Return the figure of the placebo campaigns."""
    if result.change is None or not result.placebo.campaigns:
        return []
    caption = (
        "Number of placebo campaigns by their estimate, at the precision of this campaign. Dashed: the estimate of "
        "this campaign."
    )
    return [Illustration("placebo", "What chance does", caption, draw_placebos(result, result.change))]


def count_placebos(result: BeforeAfter, change: CarChange) -> tuple[Ints, Floats]:
    """Return the numbers of placebo campaigns by their estimate, and the edges of its intervals [%]."""
    error = float(np.log1p(change.change)) / change.ratio
    estimates = 100.0 * np.expm1(error * np.array([each.ratio for each in result.placebo.campaigns]))
    reach = 1.05 * max(float(np.abs(estimates).max()), abs(100.0 * change.change))
    return np.histogram(estimates, BINS, (-reach, reach))


def draw_placebos(result: BeforeAfter, change: CarChange) -> go.Figure:
    """Return the distribution of placebo estimates with the estimate marked."""
    counts, edges = count_placebos(result, change)
    look = get_style(1)
    bars = go.Bar(
        name="placebo campaigns",
        x=(0.5 * (edges[1:] + edges[:-1])).tolist(),
        y=counts.tolist(),
        marker={"color": look.colour},
    )
    x, y = {"title_text": "estimated change [%]"}, {"title_text": "placebo campaigns [1]"}
    figure = make_figure([bars], 320, x, y, bargap=0.05)
    add_reference_line(figure, "estimate", 100.0 * change.change)
    return figure


FIGURES: Final = {"change": _illustrate_days, "placebo": _illustrate_placebos}
"""Key of a section -> function that draws its figures."""
