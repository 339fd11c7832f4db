"""Print a report in the terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from socast.tools.report.document import Report, Section
from socast.tools.report.table import PAPER_NOTE, Cell, ReportTable
from socast.tools.terminal.rich_table import Column, make_table


def print_report(report: Report, console: Console, last: str = "") -> None:
    """Print the sections of a report that have a table, the one with the key `last` after all others, and its notes."""
    shown = [section for section in report.sections if section.tables and not section.folded]
    for section in sorted(shown, key=lambda section: section.key == last):
        print_section(section, console)
    for note in report.notes:
        console.print(Text(note, style="yellow"))


def print_section(section: Section, console: Console) -> None:
    """Print the title and the tables of a section that have rows.

    A note that several tables share is printed once, below the last of them.
    """
    print_heading(section.title, console)
    if section.text:
        console.print(Text(section.text, style="italic"))
    filled = [table for table in section.tables if table.rows]
    last: dict[str, int] = {note: i for i, table in enumerate(filled) for note in table.all_notes}
    for i, table in enumerate(filled):
        console.print()
        console.print(_table(table))
        for note in table.all_notes:
            if last[note] == i or note == PAPER_NOTE:
                console.print(Text(note, style="dim"))


def print_heading(title: str, console: Console) -> None:
    """Print the title of a part."""
    console.print()
    console.rule(Text(title, style="bold"), align="left")


def _table(table: ReportTable) -> Table:
    """Return a table of a report as a table of rich."""
    made = make_table([Column(table.corner), *(Column(head, number=True) for head in table.columns)], table.title)
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
