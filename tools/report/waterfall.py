"""Show where the measured energy of rides went: in the terminal, and as one page with a waterfall of its parts."""

from collections.abc import Sequence
from functools import partial
from textwrap import wrap
from typing import Final, NamedTuple

import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.core.condition.energy_parts import UNEXPLAINED
from socast.core.condition.energy_split import (
    MEASURED,
    CarEnergyFactor,
    EnergySaving,
    EnergyShare,
    EnergySplit,
    GroupEnergy,
)
from socast.core.evaluate.records import EstimatedValue
from socast.core.formatting import format_count, format_minus
from socast.tools.report.document import Illustration, Report, Section, print_report
from socast.tools.report.figure_style import draw_bars, escape_label, get_style, make_error_bars, make_figure
from socast.tools.report.table import (
    FORMATS,
    UNKNOWN,
    Figure,
    ReportTable,
    format_percent,
    get_half_width,
    get_value,
    tabulate,
    tabulate_records,
)

TITLE: Final = "Where the energy goes"
PARTS: Final = "parts"
"""Key of the section that is printed last."""
MOST_STEPS: Final = 12
"""Largest number of parts in the picture; smaller ones are summed."""
MOST_COLUMNS: Final = 8
"""Largest number of parts in the table of groups."""
MOST_NAMED: Final = 3
"""Largest number of parts that a sentence names."""
WIDTHS: Final = (16, 60)
"""Smallest and largest number of characters of the bars in a terminal."""
LABEL_WIDTH: Final = 38
"""Largest number of characters of the name of a part in a terminal."""
FIGURE_LABEL_WIDTH: Final = 24
"""Largest number of characters of a line of such a name in the figure, which leaves room for bars on a telephone."""
STEP_HEIGHT: Final = 34
"""Height of a bar with its space. [px]"""
TAKEN, RETURNED = "taken", "returned"
LOOKS: Final = {TAKEN: 2, RETURNED: 5, UNEXPLAINED: 4, MEASURED: 0}
"""Kind of a bar -> its place in the order of styles."""
BLOCKS: Final = {TAKEN: "█", RETURNED: "░", UNEXPLAINED: "▓", MEASURED: "█"}
"""Kind of a bar -> its character in a terminal."""
FIELDS: Final = ("what", "name", "energy_kwh", "share", "per_100km_kwh", "range_km")
SAVING_FIELDS: Final = ("what", "energy_kwh", "share", "per_100km_kwh", "range_km")
PRICE_FIELDS: Final = ("cost", "cost_per_100km")
NOTE: Final = (
    "The parts add up to the measured energy. ±: half of the 95 % interval, where the model holds standard errors: by "
    "these, by what no data reduce (5 %, of air drag 20 %), and by unknown heights. km: the energy of the part over "
    "the present mean consumption. Negative: given back, to the motion or to the battery; of what is unexplained, that "
    "the model predicts too much. waiting: what acts over time, such as heating, while the car stands within rides."
)


class Step(NamedTuple):
    """Hold a bar of the waterfall, from the sum of the parts before it to the sum with it. [kWh/100 km]"""

    what: str
    kind: str
    start: float
    change: float
    ci95: float | None = None

    @property
    def amount(self) -> str:
        """Change of the step with its interval, in words."""
        return format_amount(EstimatedValue(value=self.change, ci95=self.ci95), 2)


def format_amount(figure: Figure, digits: int = 1) -> str:
    """Return an amount, and its interval where it has one.

    Examples
    --------
    >>> format_amount(-1064.42), format_amount(EstimatedValue(value=7.1413, ci95=0.1517), 2), format_amount(None)
    ('−1,064.4', '7.14 ± 0.15', '–')
    """
    known, half = get_value(figure), get_half_width(figure)
    if known is None:
        return UNKNOWN
    return format_minus(f"{known:,.{digits}f}" + ("" if half is None else f" ± {half:,.{digits}f}"))


FORMATS_OF_AMOUNTS: Final = {
    **FORMATS,
    "amount": format_amount,
    "two decimals": lambda value: format_amount(value, 2),
    "three decimals": lambda value: format_amount(value, 3),
}


def show(result: EnergySplit, console: Console) -> None:
    """Print the split, with the table of the parts, the picture and the principal sentences last."""
    report = build_report(result)
    print_report(report._replace(notes=()), console, last=PARTS)
    console.print()
    for line in draw_picture(list_steps(result.fleet), console.width):
        console.print(line, highlight=False)
    for note in report.notes:
        console.print(Text(note, style="yellow"))
    for sentence in report.lead:
        console.print(Text(sentence, style="bold"), highlight=False)


def build_report(result: EnergySplit) -> Report:
    """Return the report of a split."""
    lead, drawn = describe(result), {PARTS: _illustrate}
    return Report("waterfall", "waterfall", TITLE, build_sections(result), lead, result.notes, result, drawn)


def describe(result: EnergySplit) -> list[str]:
    """Return how much the rides took, what takes most, what is returned, and what is unexplained."""
    fleet = result.fleet
    *parts, rest = fleet.shares
    largest = ", ".join(
        f"{part.what} ({format_percent(part.share)})" for part in parts[:MOST_NAMED] if not part.is_returned
    )
    consumption = (
        f"{format_count(fleet.rides, 'ride')} took {format_amount(fleet.measured.energy_kwh)} kWh over "
        f"{format_amount(fleet.distance_km, 0)} km, {format_amount(fleet.measured.per_100km_kwh, 2)} kWh/100 km."
    )
    lines = [f"{consumption} By {result.model}, the largest parts, over the measured energy, are {largest}."]
    if returned := [part.what for part in reversed(parts) if part.is_returned]:
        others = f" and {len(returned) - MOST_NAMED} more" if len(returned) > MOST_NAMED else ""
        by = f"{', '.join(returned[:MOST_NAMED])}{others}"
        given = format_amount(fleet.returned_kwh)
        lines.append(f"Given back to the motion or to the battery, of what the other parts took: {given} kWh by {by}.")
    lines.append(
        f"Unexplained: {format_amount(rest.energy_kwh)} kWh, {format_percent(rest.share)} of the measured energy."
    )
    return lines


def build_sections(result: EnergySplit) -> list[Section]:
    """Return the sections of the split that have something to show."""
    prices = PRICE_FIELDS if result.price is not None else ()
    fleet = result.fleet
    parts = tabulate_records(
        "All rides", [*fleet.shares, fleet.measured], EnergyShare, fields=(*FIELDS, *prices), totals=(MEASURED,),
        notes=(NOTE,), formats=FORMATS_OF_AMOUNTS,
    )  # fmt: skip
    savings = tabulate_records(
        "What other driving would save, by the model", result.savings, EnergySaving,
        fields=(*SAVING_FIELDS, *prices), notes=tuple(f"{each.what}: {each.assumption}" for each in result.savings),
        formats=FORMATS_OF_AMOUNTS,
    )  # fmt: skip
    cars = tabulate_records("Each car beside its siblings", result.cars, CarEnergyFactor, formats=FORMATS_OF_AMOUNTS)
    sections = [
        Section(PARTS, TITLE, _describe_rides(result), [parts]),
        Section("groups", f"By {_name_grouping(result.by)}", "", [_tabulate_groups(result)]),
        Section("savings", "If it were otherwise", "; ".join(result.impossible), [savings, cars]),
    ]
    return [section for section in sections if section.text or any(table.rows for table in section.tables)]


def _name_grouping(by: str) -> str:
    """Return the ways to group rides, in words."""
    words = {"model": "vehicle model", "speed": "mean speed"}
    return ", ".join(words.get(way, way) for way in by.split(","))


def _describe_rides(result: EnergySplit) -> str:
    """Return which rides count, in words."""
    fleet = result.fleet
    left = ", ".join(f"{n:,} {why}" for why, n in result.left_out.items())
    price = "" if result.price is None else f" Price: {result.price:g} per kWh."
    return (
        f"{fleet.rides:,} of {format_count(result.read, 'ride')} from {result.first_date} to "
        f"{result.last_date}, {format_count(fleet.vehicles, 'car')}. "
        f"Left out: {left or 'none'}.{price}"
    )


def _tabulate_groups(result: EnergySplit) -> ReportTable:
    """Return the consumption of each group with its largest parts; smaller ones are summed."""
    parts = [step.what for step in list_steps(result.fleet, MOST_COLUMNS)][:-1]

    def show_part(what: str, group: GroupEnergy) -> str:
        known = {share.what: share.per_100km_kwh.value or 0.0 for share in group.shares}
        return format_amount(known.get(what, sum(value for name, value in known.items() if name not in parts)), 2)

    rows = [(group.name, group) for group in result.groups]
    rows += [("all", result.fleet)] if rows else []
    title = "Consumption and its parts [kWh/100 km]"
    return tabulate(
        title,
        _name_grouping(result.by),
        rows,
        [
            ("rides", lambda group: f"{group.rides:,}"),
            ("km", lambda group: format_amount(group.distance_km, 0)),
            ("total", lambda group: format_amount(group.measured.per_100km_kwh.value, 2)),
            *((what, partial(show_part, what)) for what in parts),
        ],
        totals=("all",),
    )


def list_steps(group: GroupEnergy, most: int = MOST_STEPS) -> list[Step]:
    """Return the bars of a waterfall: at most `most` parts, the sum of smaller ones, what is unexplained, and the sum.

    Units: change of a step [kWh/100 km].
    """
    *parts, rest = group.shares
    ordered = sorted(parts, key=lambda part: -abs(part.energy_kwh.value or 0.0))
    kept = {part.name for part in (ordered if len(ordered) <= most else ordered[: most - 1])}
    bars = [(part.what, TAKEN, part.per_100km_kwh) for part in parts if part.name in kept]
    if small := [part.per_100km_kwh.value or 0.0 for part in parts if part.name not in kept]:
        bars.append((f"{len(small)} smaller terms", TAKEN, EstimatedValue(value=sum(small))))
    steps, at = list[Step](), 0.0
    for what, kind, change in (*bars, (rest.what, UNEXPLAINED, rest.per_100km_kwh)):
        value = change.value or 0.0
        steps.append(Step(what, RETURNED if kind == TAKEN and value < 0.0 else kind, at, value, change.ci95))
        at += value
    return [*steps, Step(MEASURED, MEASURED, 0.0, group.measured.per_100km_kwh.value or 0.0)]


def draw_picture(steps: Sequence[Step], columns: int) -> list[Text]:
    """Return a waterfall as lines of text."""
    ends = [end for step in steps for end in (step.start, step.start + step.change)]
    low, high = min(0.0, *ends), max(*ends, 1e-9)
    numbers = [step.amount for step in steps]
    wide = max(map(len, numbers))
    most = max(min(LABEL_WIDTH, columns - wide - WIDTHS[0] - 6), 8)
    names = [step.what if len(step.what) <= most else f"{step.what[: most - 1]}…" for step in steps]
    room = max(map(len, names))
    width = min(max(columns - room - wide - 6, WIDTHS[0]), WIDTHS[1])
    lines = [Text(f"{TITLE} [kWh/100 km]", style="bold")]
    for step, name, number in zip(steps, names, numbers, strict=True):
        first, last = sorted(
            round((end - low) / (high - low) * width) for end in (step.start, step.start + step.change)
        )
        bar = " " * first + BLOCKS[step.kind] * (last - first) if last > first else " " * min(first, width - 1) + "│"
        lines.append(Text(f"  {name:<{room}}  {number:>{wide}}  {bar}".rstrip()))
    kinds = dict.fromkeys(step.kind for step in steps if step.kind != MEASURED)
    return [*lines, Text(", ".join(f"{BLOCKS[kind]} {kind}" for kind in kinds), style="dim")]


def _illustrate(result: EnergySplit) -> list[Illustration]:
    """Return the waterfall of all rides."""
    caption = (
        "From top to bottom, each bar begins where the one above it ends: what the parts take, what is given back to "
        "the motion or to the battery, and what the model does not explain. The last bar is the measured consumption. "
        "Lines: 95 % intervals of the parts."
    )
    return [Illustration("waterfall", "Parts of the mean consumption", caption, draw_waterfall(result.fleet))]


def draw_waterfall(group: GroupEnergy) -> go.Figure:
    """Return a figure of the parts of the consumption, one below the other. [kWh/100 km]"""
    steps = list_steps(group)
    labels = ["<br>".join(escape_label(line) for line in wrap(step.what, FIGURE_LABEL_WIDTH)) for step in steps]
    traces = []
    for kind, place in LOOKS.items():
        chosen = [(label, step) for label, step in zip(labels, steps, strict=True) if step.kind == kind]
        if not chosen:
            continue
        halves = [step.ci95 for _, step in chosen]
        traces.append(
            draw_bars(
                kind,
                get_style(place),
                [label for label, _ in chosen],
                [step.change for _, step in chosen],
                base=[step.start for _, step in chosen],
                error_x=make_error_bars(halves),
                customdata=[step.amount for _, step in chosen],
                hovertemplate="%{y}: %{customdata} kWh/100 km<extra></extra>",
            )
        )
    return make_figure(
        traces,
        110 + STEP_HEIGHT * len(steps),
        x={"title_text": "Energy per distance [kWh/100 km]", "zeroline": True},
        y={"title_text": "Part", "type": "category", "categoryorder": "array", "categoryarray": labels[::-1]},
        barmode="overlay",
    )
