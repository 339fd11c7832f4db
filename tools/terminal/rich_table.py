"""The common style of all tables in the terminal."""

import re
from collections.abc import Collection, Iterable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Final, NamedTuple

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.containers import Lines
from rich.measure import Measurement
from rich.table import Column as TableColumn
from rich.table import Table
from rich.text import Text

_UNIT: Final = r"(?:[kM]?Wh?|J/kg|V|kg|k?m[²³]?|km/h|m/s|min|s|h|K)(?!\w)"
_NUMBER: Final = r"[-−+]?\d"
_TIED: Final = (
    rf"(?<=\d) (?=[%×°*↓↑●○]|{_UNIT})|(?<=[±<]) (?=\d)"
    rf"|(?<=\d) (?=→ {_NUMBER})|(?<=→) (?={_NUMBER})"
    rf"|(?<=\d) (?=to {_NUMBER}[\d.,]*\))|(?<=\d to) (?={_NUMBER}[\d.,]*\))"
)
WHOLE: Final = re.compile(rf"{_TIED}|(?<=\d) (?=±)")
"""Spaces within a number."""
LOOSE: Final = re.compile(_TIED)
"""The same, but a line may end before the uncertainty, where columns are too narrow."""
ANY: Final = re.compile(r"(?!)")
"""None: a line may end at any space."""
_TIE: Final = "\ue000"
"""Stands for a space of a number while lines are broken, because rich breaks them at no-break spaces too."""


def measure_parts(text: str, tied: re.Pattern[str]) -> int:
    """Return the width of the longest part of a text that stays on one line.

    Units: returns [characters].

    Examples
    --------
    >>> [measure_parts("0.064 ± 0.011 (16.9 %)", tied) for tied in (WHOLE, LOOSE, ANY)]
    [13, 8, 5]
    """
    return max((cell_len(part) for part in tied.sub(_TIE, text).split()), default=0)


class UnbrokenText(Text):
    """Text that keeps each number on one line."""

    tied: re.Pattern[str] = WHOLE

    @classmethod
    def of(cls, content: Any) -> Any:
        """Return text, with markup if it is a string, as such a text; any other content unchanged."""
        text = Text.from_markup(content) if isinstance(content, str) else content
        if not isinstance(text, Text):
            return content
        return cls(
            text.plain,
            style=text.style,
            justify=text.justify,
            overflow=text.overflow,
            no_wrap=text.no_wrap,
            end=text.end,
            spans=list(text.spans),
        )

    def wrap(self, console: Console, width: int, **options: Any) -> Lines:
        """Return the lines of the text, as `rich.text.Text.wrap` does."""
        tied = self.copy()
        tied.plain = self.tied.sub(_TIE, self.plain)
        lines = tied.wrap(console, width, **options)
        for line in lines:
            line.plain = line.plain.replace(_TIE, " ")
        return lines

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Return the least and the largest useful width."""
        return Measurement(measure_parts(self.plain, self.tied), super().__rich_measure__(console, options).maximum)


LEAST_WIDTH: Final = 6
"""Width down to which words are broken before numbers are. [characters]"""


class Breaking(NamedTuple):
    """State what may be broken where a part of a table is too wide for the terminal.

    Parameters
    ----------
    headings, texts : bool
        Whether words longer than `LEAST_WIDTH` may be broken in headings, and in cells of text.
    """

    tied: re.Pattern[str]
    headings: bool
    texts: bool


BREAKINGS: Final = tuple(
    Breaking(tied, headings, texts)
    for headings, texts in ((False, False), (True, False), (True, True))
    for tied in (WHOLE, LOOSE)
)
"""From what harms a reader least to what harms most."""
WORDS_WHOLE: Final = BREAKINGS[:2]
"""Those that break no word."""


class Column(NamedTuple):
    """Describe a column of a table in the terminal.

    Parameters
    ----------
    head : str
        Heading, with the unit. A newline splits it into lines.
    number : bool
        Whether the column holds numbers, which are aligned to the right.
    fixed : bool
        Whether the column keeps each row on one line and truncates text that does not fit.
    min_width : int, optional
        Smallest width. [characters]
    ratio : int, optional
        Share of the spare width that the column takes.
    """

    head: str
    number: bool = False
    fixed: bool = False
    min_width: int | None = None
    ratio: int | None = None


class _NumberTable(Table):
    """A table that is fitted to the terminal so that its words and numbers stay whole, where that is possible.

    A table that is too wide for it becomes several below each other, each of which begins with the same columns.
    """

    repeated: int

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """Add a row, as `rich.table.Table.add_row` does."""
        super().add_row(*(UnbrokenText.of(cell) for cell in cells), **options)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table, fitted to the width of the console."""
        if self.expand:
            yield from super().__rich_console__(console, options)
            return
        for part in self._split(options.max_width):
            part.fit(console, options)
            yield from super(_NumberTable, part).__rich_console__(console, options)

    def _split(self, width: int) -> list["_NumberTable"]:
        """Return the parts of the table, one where all columns fit; their numbers stay whole."""
        for breaking in WORDS_WHOLE:
            if measure_table([self._measure_least(column, breaking) for column in self.columns]) <= width:
                return [self]
        least = [self._measure_least(column, WORDS_WHOLE[0]) for column in self.columns]
        parts = [self._take(places) for places in split_columns(least, width, self.repeated)]
        for part in parts[1:]:
            part.title = None
        for part in parts[:-1]:
            part.caption = None
        return parts

    def _take(self, places: Sequence[int]) -> "_NumberTable":
        """Return a table of some of the columns."""
        part = copy(self)
        part.columns = [replace(self.columns[place], _index=i) for i, place in enumerate(places)]
        return part

    def fit(self, console: Console, options: ConsoleOptions) -> None:
        """Set the widths of columns if the table is too wide."""
        room = options.max_width - measure_table([0] * len(self.columns))
        most = [self._measure(console, options, number) for number in range(len(self.columns))]
        for column in self.columns:
            column.width = None
        if sum(most) <= room:
            return
        for breaking in BREAKINGS:
            self._tie(breaking.tied)
            least = [self._measure_least(column, breaking) for column in self.columns]
            if sum(least) <= room:
                unbroken = [
                    self._measure_least(column, breaking._replace(headings=False, texts=False))
                    for column in self.columns
                ]
                words = {i for i, column in enumerate(self.columns) if i and column.justify != "right"}  # 0: the names
                widths = distribute_width(least, unbroken, most, room, words)
                for column, width in zip(self.columns, widths, strict=True):
                    column.width = width
                return
        self._tie(ANY)

    def _tie(self, tied: re.Pattern[str]) -> None:
        """Set the spaces at which no line of a cell ends."""
        for column in self.columns:
            for cell in column.cells:
                if isinstance(cell, UnbrokenText):
                    cell.tied = tied

    def _measure(self, console: Console, options: ConsoleOptions, number: int) -> int:
        """Return the width of a column without any line break."""
        column = self.columns[number]
        return max(Measurement.get(console, options, each).maximum for each in (column.header, *column.cells))

    def _measure_least(self, column: TableColumn, breaking: Breaking) -> int:
        """Return the least width of a column."""
        if column.no_wrap:
            return max(cell_len(line) for cell in (column.header, *column.cells) for line in str(cell).split("\n"))
        heading = measure_parts(str(column.header), breaking.tied)
        cells = max((measure_parts(str(cell), breaking.tied) for cell in column.cells), default=0)
        if breaking.headings:
            heading = min(heading, LEAST_WIDTH)
        if breaking.texts and column.justify != "right":
            cells = min(cells, LEAST_WIDTH)
        return max(cells, heading)


def measure_table(widths: Sequence[int]) -> int:
    """Return the width of a table whose columns have some widths: with its edges, and a space beside each column."""
    return 1 + sum(width + 2 for width in widths)


def split_columns(least: Sequence[int], width: int, repeated: int = 1) -> list[list[int]]:
    """Return the places of the columns of each part of a table that is too wide, with the first, repeated ones in each.

    There are as few parts as possible, and they are about equally wide. A part with a single further column may be too
    wide, and so may be all parts where the repeated columns alone take more than half of the width.

    Units: width [characters].

    Examples
    --------
    >>> split_columns([8, 10, 10, 10, 10], width=47)
    [[0, 1, 2], [0, 3, 4]]
    >>> split_columns([90, 10, 10], width=47)
    [[0, 1], [0, 2]]
    """
    first = list(range(repeated))
    most = width // (2 * repeated)
    least = [*(min(each, most) for each in least[:repeated]), *least[repeated:]]

    def fill(room: int) -> list[list[int]]:
        parts = [list(first)]
        for place in range(repeated, len(least)):
            if parts[-1] != first and measure_table([least[i] for i in (*parts[-1], place)]) > room:
                parts.append(list(first))
            parts[-1].append(place)
        return parts

    return next(parts for room in range(width + 1) if len(parts := fill(room)) == len(fill(width)))


def distribute_width(
    least: Sequence[int], unbroken: Sequence[int], most: Sequence[int], room: int, words: Collection[int] = ()
) -> list[int]:
    """Return widths of columns that fill a room.

    As many columns as possible take the width at which no word is broken. What remains goes to the narrowest columns,
    to those of words last.

    Units: room [characters].

    Parameters
    ----------
    least, unbroken, most : sequence of int
        Width of each column that it needs at least, without broken words, and without line breaks. [characters]
    words : collection of int
        Places of the columns of words.

    Examples
    --------
    >>> distribute_width([8, 8, 5], [20, 10, 5], [40, 30, 5], room=25)
    [10, 10, 5]
    >>> distribute_width([8, 8, 5], [8, 8, 5], [9, 12, 5], room=25, words={0})
    [8, 12, 5]
    """
    widths = list(least)
    for i in sorted(range(len(widths)), key=lambda i: unbroken[i] - least[i]):
        if unbroken[i] - least[i] <= room - sum(widths):
            widths[i] = unbroken[i]
    for _ in range(room - sum(widths)):
        growing = [(i in words, width, i) for i, width in enumerate(widths) if width < most[i]]
        if growing:
            widths[min(growing)[-1]] += 1
    return widths


def make_table(
    columns: Sequence[Column],
    title: str = "",
    caption: str = "",
    *,
    rows: Iterable[Sequence[RenderableType]] = (),
    repeated: int = 1,
    expand: bool = False,
) -> Table:
    """Return a table in the common style, with horizontal rules only, which leaves more width for numbers.

    Parameters
    ----------
    repeated : int
        Number of columns with which each part begins if the table is too wide for the terminal.
    """
    table = _NumberTable(
        title=Text(title, style="bold") if title else None,
        caption=Text(caption) if caption else None,
        title_justify="left",
        caption_justify="left",
        header_style="",
        box=box.HORIZONTALS,
        padding=(0, 1, 0, 0),
        expand=expand,
    )
    table.repeated = repeated
    for column in columns:
        table.add_column(
            Text(column.head),
            justify="right" if column.number else "left",
            overflow="ellipsis" if column.fixed else "fold",
            no_wrap=column.fixed,
            min_width=column.min_width,
            ratio=column.ratio,
        )
    for row in rows:
        table.add_row(*row)
    return table


def make_description(entries: Sequence[tuple[str, RenderableType]]) -> Table:
    """Return a table of names, each with its description on the right."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True, style="bold")
    table.add_column(ratio=1)
    for name, description in entries:
        table.add_row(name, UnbrokenText.of(description))
    return table
