"""The common style of all tables in the terminal."""

from collections.abc import Sequence
from typing import NamedTuple

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text


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


def make_table(columns: Sequence[Column], title: str = "", caption: str = "", *, expand: bool = False) -> Table:
    """Return an empty table in the common style, with horizontal rules only, which leaves more width for numbers.

    Parameters
    ----------
    columns : sequence of Column
        Columns from left to right.
    title, caption : str
        Text above and below the table. It is printed unchanged, without markup.
    expand : bool
        Whether the table takes the whole width of the console.

    Returns
    -------
    rich.table.Table
    """
    table = Table(
        title=Text(title, style="bold") if title else None,
        caption=Text(caption) if caption else None,
        title_justify="left",
        caption_justify="left",
        header_style="",
        box=box.HORIZONTALS,
        padding=(0, 1, 0, 0),
        expand=expand,
    )
    for column in columns:
        table.add_column(
            Text(column.head),
            justify="right" if column.number else "left",
            overflow="ellipsis" if column.fixed else "fold",
            no_wrap=column.fixed,
            min_width=column.min_width,
            ratio=column.ratio,
        )
    return table


def make_description(entries: Sequence[tuple[str, RenderableType]]) -> Table:
    """Return a table of names, each with its description on the right.

    Parameters
    ----------
    entries : sequence of tuple
        Pairs of name and description.

    Returns
    -------
    rich.table.Table
    """
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True, style="bold")
    table.add_column(ratio=1)
    for name, description in entries:
        table.add_row(name, description)
    return table
