"""Define the tables of a report before they are printed or become HTML, make them of records, and format figures."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeVar

from socast.core.evaluate.paper.published import PublishedFigure
from socast.core.evaluate.records import EstimatedValue
from socast.core.formatting import format_minus, format_range
from socast.core.records import Record, Shown, list_shown

Item = TypeVar("Item")

PAPER_NOTE: Final = (
    "In parentheses: figures of the paper. They are from other data (the rides of one company), for orientation only."
)
"""Note below every table that shows figures of the paper."""

UNKNOWN: Final = "–"
"""Text where there is no figure."""
NUMBER: Final = re.compile(r"(?!\d{4}-\d\d-\d\d)(?:[<>~] ?|less than )?[-+−±]?\d")
"""Begin of a cell that is a number; a date is words."""


Figure = EstimatedValue | float | None
"""A number, which may have an interval; None where it is unknown."""


class Cell(NamedTuple):
    """Hold a cell of a table.

    Parameters
    ----------
    paper : str
        Figure of the paper; empty where there is none.
    strong : bool
        Whether the cell is emphasised, as the best of its column is.
    value : float, optional
        Number by which `tabulate` finds the least of a column.
    """

    text: str
    paper: str = ""
    strong: bool = False
    value: float | None = None


class Row(NamedTuple):
    """Hold a row: its name, its cells, whether it sums up the rows above, and the id that its name links to."""

    name: str
    cells: tuple[Cell, ...]
    total: bool = False
    link: str = ""


class ReportTable(NamedTuple):
    """Hold a table of a report.

    Parameters
    ----------
    title : str
        Title, ending with the paper's table number where there is one.
    corner : str
        Heading of the column of row names.
    columns : tuple of str
        Headings of the other columns, with units.
    """

    title: str
    corner: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    @property
    def beside_paper(self) -> bool:
        """Whether any cell shows a figure of the paper."""
        return any(cell.paper for row in self.rows for cell in row.cells)

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column but that of row names holds numbers, which are aligned to the right; else words."""
        return tuple(_holds_numbers([row.cells[i].text for row in self.rows]) for i in range(len(self.columns)))

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Notes of the table, with `PAPER_NOTE` where figures of the paper are shown."""
        return (*self.notes, PAPER_NOTE) if self.beside_paper else self.notes


def _holds_numbers(texts: Sequence[str]) -> bool:
    """Return whether at least half of the known cells of a column begin with a number."""
    known = [text for text in texts if text and not text.startswith(UNKNOWN)]
    return 2 * sum(NUMBER.match(text) is not None for text in known) >= len(known)


def get_value(figure: Figure) -> float | None:
    """Return a number, or the value of an estimate."""
    return figure.value if isinstance(figure, EstimatedValue) else figure


def get_half_width(figure: Figure) -> float | None:
    """Return half of the width of the 95 % interval of a figure, None where it has none."""
    return figure.ci95 if isinstance(figure, EstimatedValue) else None


def format_energy(value: Figure) -> str:
    """Return an energy, with its interval where it has one. [kWh]

    Examples
    --------
    >>> format_energy(EstimatedValue(value=0.3312, ci95=0.0052)), format_energy(1.25), format_energy(None)
    ('0.331 ± 0.0052', '1.250', '–')
    """
    known, ci95 = get_value(value), get_half_width(value)
    if known is None:
        return UNKNOWN
    if ci95 is None:
        return format_minus(f"{known:.3f}")
    return format_minus(f"{known:.3f} ± {ci95:.{4 if ci95 < 0.00995 else 3}f}")


def format_signed(value: Figure, digits: int = 3) -> str:
    """Return an energy with its sign. [kWh]

    Examples
    --------
    >>> format_signed(0.02), format_signed(-0.02)
    ('+0.020', '−0.020')
    """
    known = get_value(value)
    return UNKNOWN if known is None else format_minus(f"{known:+.{digits}f}")


def format_percent(share: Figure, digits: int = 1) -> str:
    """Return a share as a percentage.

    Examples
    --------
    >>> format_percent(0.517), format_percent(None)
    ('51.7 %', '–')
    """
    known = get_value(share)
    return UNKNOWN if known is None else format_minus(f"{100.0 * known:.{digits}f} %")


def format_chance(chance: float | None) -> str:
    """Return a probability as a percentage, with a decimal where it would else be rounded to certainty.

    Examples
    --------
    >>> format_chance(0.517), format_chance(0.9949), format_chance(0.99996), format_chance(None)
    ('52 %', '99.5 %', '100 %', '–')
    """
    return format_percent(chance, 1 if chance is not None and 0.99 < chance < 0.9995 else 0)


def format_change(value: float | None, reference: float | None) -> str:
    """Return by which percentage a figure is above a reference.

    Examples
    --------
    >>> format_change(1.1, 1.0), format_change(0.9, 1.0)
    ('+10.0 %', '−10.0 %')
    """
    if value is None or not reference:
        return UNKNOWN
    return format_minus(f"{100.0 * (value / reference - 1.0):+.1f} %")


def format_difference(estimate: Figure, digits: int = 3) -> str:
    """Return a difference with its sign, and its interval where it has one.

    Examples
    --------
    >>> format_difference(EstimatedValue(value=0.0123, ci95=0.004)), format_difference(-1.25, 1)
    ('+0.012 ± 0.004', '−1.2')
    """
    width = get_half_width(estimate)
    return format_signed(estimate, digits) + ("" if width is None else f" ± {width:.{digits}f}")


def format_estimate(estimate: Figure, digits: int = 1) -> str:
    """Return a figure, and its interval where it has one."""
    known, width = get_value(estimate), get_half_width(estimate)
    if known is None:
        return UNKNOWN
    return format_minus(f"{known:.{digits}f}") + ("" if width is None else f" ± {width:.{digits}f}")


def format_probability(value: Figure) -> str:
    """Return a probability.

    Examples
    --------
    >>> format_probability(0.0000001), format_probability(0.034), format_probability(None)
    ('< 0.001', '0.034', '–')
    """
    known = get_value(value)
    least = 0.001
    return UNKNOWN if known is None else f"< {least}" if known < least else f"{known:.3f}"


def format_count(value: Figure) -> str:
    """Return a count.

    Examples
    --------
    >>> format_count(12772.0)
    '12,772'
    """
    known = get_value(value)
    return UNKNOWN if known is None else f"{known:,.0f}"


def format_published(figure: PublishedFigure | None) -> str:
    """Return a figure of the paper as printed; empty where there is none."""
    return "" if figure is None else figure.text


def format_published_share(share: float | None, digits: int = 1) -> str:
    """Return a share that follows from the paper as a percentage; empty where it has none."""
    return "" if share is None else format_percent(share, digits)


def format_cluster(cluster: str) -> str:
    """Return a cluster of distance with its unit.

    Examples
    --------
    >>> format_cluster("0-5"), format_cluster("30+")
    ('0 to 5 km', '30+ km')
    """
    return f"{format_range(cluster)} km"


def format_digits(value: float | None, digits: int = 3) -> str:
    """Return a number with significant digits.

    Examples
    --------
    >>> format_digits(0.06234), format_digits(-1.0), format_digits(None)
    ('0.0623', '−1', '–')
    """
    return UNKNOWN if value is None else format_minus(f"{value:.{digits}g}")


FORMATS: Final[Mapping[str, Callable[[Any], str]]] = MappingProxyType(
    {
        "text": lambda value: UNKNOWN if value in {None, ""} else str(value),
        "names": lambda value: ", ".join(value) or UNKNOWN,
        "scope": lambda value: ", ".join(value) or "all",
        "number of": lambda value: format_count(len(value)),
        "count": format_count,
        "energy": format_energy,
        "estimate": format_estimate,
        "difference": format_difference,
        "difference, one decimal": lambda value: format_difference(value, 1),
        "difference, four decimals": lambda value: format_difference(value, 4),
        "four decimals": lambda value: format_estimate(value, 4),
        "probability": format_probability,
        "percent": format_percent,
        "chance": format_chance,
        "whole percent": lambda value: format_percent(value, 0),
        "fine percent": lambda value: format_percent(value, 2),
        "signed percent": lambda value: UNKNOWN if value is None else format_minus(f"{100.0 * value:+.1f} %"),
        "signed": format_signed,
        "score": lambda value: format_signed(value, 1),
        "three digits": format_digits,
        "two digits": lambda value: format_digits(value, 2),
    }
)
"""Formats that a field can declare, see `socast.core.records.declare`."""


def tabulate(
    title: str,
    corner: str,
    rows: Sequence[tuple[str, Item]],
    columns: Sequence[tuple[str, Callable[[Item], Cell | str]]],
    notes: tuple[str, ...] = (),
    *,
    totals: Collection[str] = (),
    links: Mapping[str, str] = MappingProxyType({}),
) -> ReportTable:
    """Return a table of a cell for each row and column, in which the least value of a column is emphasised.

    Parameters
    ----------
    rows : sequence of (str, item)
        Name of each row, and what its cells are made of.
    columns : sequence of (str, callable)
        Heading of each column, and the function that makes its cells.
    totals : collection of str
        Names of the rows that sum up others.
    links : mapping of str to str
        Name of a row -> id that it links to.
    """
    cells = [[cell if isinstance(cell := make(item), Cell) else Cell(cell) for _, item in rows] for _, make in columns]
    least = [min((cell.value for cell in column if cell.value is not None), default=None) for column in cells]
    shown = tuple(
        Row(
            name,
            tuple(
                cell._replace(strong=cell.value == low, value=None) if cell.value is not None else cell
                for cell, low in zip((column[i] for column in cells), least, strict=True)
            ),
            total=name in totals,
            link=links.get(name, ""),
        )
        for i, (name, _) in enumerate(rows)
    )
    return ReportTable(title, corner, tuple(head for head, _ in columns), shown, notes)


def keep_filled(*tables: ReportTable) -> list[ReportTable]:
    """Return the tables that have a row."""
    return [table for table in tables if table.rows]


def tabulate_records(
    title: str,
    records: Sequence[Record] | Mapping[str, Record],
    kind: type[Record],
    *,
    corner: str = "",
    fields: Sequence[str] = (),
    more: Sequence[tuple[str, Sequence[str]]] = (),
    label: Callable[[str], str] = str,
    notes: tuple[str, ...] = (),
    strong: Callable[[str, int, Any], bool] = lambda *_: False,
    numbered: bool = False,
    formats: Mapping[str, Callable[[Any], str]] = FORMATS,
    **options: Any,
) -> ReportTable:
    """Return a table with a row for each record and a column for each field that declares a head.

    Parameters
    ----------
    records : sequence or mapping of Record
        The keys of a mapping name the rows, below the head `corner`; otherwise the first field with a head does.
    more : sequence of (str, sequence of str)
        Heads of columns after those of fields, and the texts of their cells.
    strong : callable
        Function of the field, the place of the record and its value that returns whether a cell is emphasised.
    """
    shown_fields = list_shown(kind)
    columns = [(name, shown_fields[name]) for name in fields or shown_fields]
    if not isinstance(records, Mapping):
        (first, head), *columns = columns
        corner, named = head.head, [(str(getattr(each, first)), each) for each in records]
    else:
        named = list(records.items())

    def make_cell(name: str, shown: Shown, placed: tuple[int, Record]) -> Cell:
        place, record = placed
        value = getattr(record, name)
        text = formats[shown.format](value)
        if limits := getattr(record, shown.interval, None) if shown.interval else None:
            half = (limits[1] - limits[0]) / 2.0
            share = text.removesuffix(" %")
            text = f"{text} ± {half:.2g}" if share == text else f"{share} ± {100.0 * half:.2g} %"
        return Cell(text, strong=strong(name, place, value))

    rows = [
        (f"{f'{place}. ' if numbered else ''}{label(name)}", (place, record))
        for place, (name, record) in enumerate(named, start=1)
    ]
    of_fields = [(shown.head, partial(make_cell, name, shown)) for name, shown in columns]
    others = [(head, lambda placed, texts=texts: texts[placed[0] - 1]) for head, texts in more]
    return tabulate(title, corner, rows, [*of_fields, *others], notes, **options)
