"""Print the report of an evaluation in the terminal."""

from typing import Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.tools.report.cells import PAPER_NOTE, Cell, ReportTable
from socast.tools.report.evaluation.sections import Section, build_sections
from socast.tools.terminal.rich_table import Column, make_table

LAST: Final = "glance"
"""Key of the section that is printed last, where readers look first."""


def show(result: RecipeEvaluation, console: Console) -> None:
    """Print the tables of an evaluation, with the principal figures last."""
    shown = [section for section in build_sections(result) if not section.folded]
    for section in sorted(shown, key=lambda section: section.key == LAST):
        print_section(section, console)
    for line in (*result.about.notes, f"“The paper” is “{published.load_paper().title}”."):
        console.print(Text(line, style="yellow"))


def print_section(section: Section, console: Console) -> None:
    """Print the title and the tables of a section that have rows.

    A note that several tables share is printed once, below the last of them.
    """
    console.print()
    console.rule(Text(section.title, style="bold"), align="left")
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
