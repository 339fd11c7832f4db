"""Define a report: sections with tables, which a terminal prints, and figures, which a page shows too."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import plotly.graph_objects as go
from rich.console import Console
from rich.table import Table
from rich.text import Text

from socast.tools.report.table import Cell, ReportTable
from socast.tools.terminal.rich_table import Column, make_table


class Illustration(NamedTuple):
    """Hold a figure of a report, with its title and caption.

    Parameters
    ----------
    key : str
        Unique key that is safe in HTML.
    title : str
        Title, with the paper's figure number where it has one.
    caption : str
        Description of the figure, also for readers who cannot see it.
    small : bool
        Whether the figure is one of several similar ones, which the page shows side by side where there is room.
    """

    key: str
    title: str
    caption: str
    figure: go.Figure
    small: bool = False


class Drawing(NamedTuple):
    """Hold a picture of a report that is an SVG, with its title and caption.

    Parameters
    ----------
    svg : str
        SVG that says in words what it shows.
    """

    key: str
    title: str
    caption: str
    svg: str
    small: bool = False


class Section(NamedTuple):
    """Hold a section of a report.

    Parameters
    ----------
    key : str
        Key of its figures, also used in links to it.
    folded : bool
        Whether its figures show the same as its tables. The page folds such tables away, the terminal leaves them out.
    closed : bool
        Whether the page folds the whole section away until a reader opens it.
    """

    key: str
    title: str
    text: str
    tables: list[ReportTable]
    folded: bool = False
    closed: bool = False


class Report(NamedTuple):
    """Hold a report.

    Parameters
    ----------
    name : str
        Name of the format, of `REPORT_VERSIONS`.
    command : str
        Command that made it.
    lead : sequence of str
        Sentences, and commands, with which the page begins.
    notes : sequence of str
        Sentences with which it ends.
    result : object
        Result from which the figures are drawn.
    figures : mapping of str to callable
        Key of a section -> function of the result that draws its figures.
    """

    name: str
    command: str
    title: str
    sections: Sequence[Section]
    lead: Sequence[str] = ()
    notes: Sequence[str] = ()
    result: Any = None
    figures: Mapping[str, Callable[[Any], Sequence[Illustration | Drawing]]] = MappingProxyType({})

    def draw(self, key: str) -> Sequence[Illustration | Drawing]:
        """Return the figures of a section."""
        draw = self.figures.get(key)
        return draw(self.result) if draw else ()


def place_notes(sections: Sequence[Section], *, last: bool = False) -> list[Section]:
    """Return sections in which a note that several tables share stands once: below the first of them, or the last.

    A note below a folded table also stands below the first that is not folded.
    """
    order, seen, placed = -1 if last else 1, set[str](), list[Section]()
    for section in sections[::order]:
        known = set(seen)
        tables = []
        for table in [table for table in section.tables if table.rows][::order]:
            tables.append(table._replace(notes=tuple(note for note in table.notes if note not in known)))
            known.update(table.notes)
        if not (section.folded or section.closed):
            seen = known
        placed.append(section._replace(tables=tables[::order]))
    return placed[::order]


def print_report(report: Report, console: Console, last: str = "") -> None:
    """Print the sections of a report that have a table, the one with the key `last` after all others, and its notes."""
    shown = [section for section in report.sections if section.tables and not section.folded]
    for section in place_notes(sorted(shown, key=lambda section: section.key == last), last=True):
        print_section(section, console)
    for note in report.notes:
        console.print(Text(note, style="yellow"))


def print_section(section: Section, console: Console) -> None:
    """Print the title and the tables of a section that have rows, with a note that several tables share once."""
    print_heading(section.title, console)
    if section.text:
        console.print(Text(section.text, style="italic"))
    (placed,) = place_notes([section], last=True)
    for table in placed.tables:
        console.print()
        console.print(_table(table))
        for note in table.all_notes:
            console.print(Text(note, style="dim"))


def print_heading(title: str, console: Console) -> None:
    """Print the title of a part."""
    console.print()
    console.rule(Text(title, style="bold"), align="left")


def _table(table: ReportTable) -> Table:
    """Return a table of a report as a table of rich."""
    columns = [Column(head, number=number) for head, number in zip(table.columns, table.numeric, strict=True)]
    made = make_table([Column(table.corner), *columns], table.title)
    for i, row in enumerate(table.rows):
        ends = row.total or (i + 1 < len(table.rows) and table.rows[i + 1].total)
        made.add_row(Text(row.name), *(_cell(cell) for cell in row.cells), end_section=ends)
    return made


def _cell(cell: Cell) -> Text:
    """Return the figure of this evaluation, and below it the paper's figure in parentheses."""
    text = Text(cell.text, style="bold" if cell.strong else "")
    if cell.paper:
        text.append("\n" if cell.text else "")
        text.append(f"({cell.paper})", style="not bold dim")
    return text
