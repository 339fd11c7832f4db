"""Render the report of an evaluation as one HTML file: tables and figures, with nothing loaded from elsewhere."""

from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from plotly.offline import get_plotlyjs

from core.errors import SettingsError
from core.evaluate.paper import published
from core.evaluate.paper.results import to_json_values
from tools.report.cells import Cell, ReportTable, Row
from tools.report.evaluation.illustrations import Illustration, build_illustrations
from tools.report.evaluation.result import Result, get_mapping
from tools.report.evaluation.sections import Section, build_sections
from tools.terminal.output import REPORT_VERSIONS

TITLE: Final = "Evaluation of consumption models"

POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
    "font-src data:"
)
"""Content security policy of the page: nothing may be loaded from the network."""


def write(result: Any, path: Path) -> None:
    """Write the result of an evaluation as a self-contained page.

    Parameters
    ----------
    result : mapping
        Result of the evaluation; what it lacks is left out.
    path : Path
        File to write.

    Raises
    ------
    SettingsError
        Where the file cannot be written.
    """
    save(render_page(result), path)


def save(text: str, path: Path) -> None:
    """Write a page.

    Parameters
    ----------
    text : str
        HTML.
    path : Path
        File to write.

    Raises
    ------
    SettingsError
        Where the file cannot be written.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"{path} cannot be written: {error.strerror}; name a file in an existing folder") from error


def render_page(result: Any) -> str:
    """Return the page of an evaluation."""
    values = to_json_values(result)
    return render_document(
        "evaluate",
        TITLE,
        _lead(values),
        build_sections(values),
        lambda key: build_illustrations(values, key),
        _foot(values),
    )


def render_document(
    report: str,
    title: str,
    lead: str,
    shown: Sequence[Section],
    drawn: Callable[[str], Sequence[Illustration]],
    foot: str,
) -> str:
    """Return a page of sections.

    Parameters
    ----------
    report : str
        Name of the report, a key of `tools.terminal.output.REPORT_VERSIONS`.
    title : str
        Title of the page.
    lead, foot : str
        HTML above and below the sections.
    shown : sequence of Section
        Sections, in order.
    drawn : callable
        Returns the figures of a section, by its key.
    """
    links = "".join(f'<li><a href="#{section.key}">{escape(section.title)}</a></li>' for section in shown)
    body = "".join(_section(section, drawn(section.key)) for section in shown)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="socast-format" content="{report} {REPORT_VERSIONS[report]}">
<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">
<title>{escape(title)}</title>
<style>{_shipped("page.css")}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the figures</a>
<nav aria-label="Sections"><ol>{links}</ol></nav>
<main id="main">
<header><h1>{escape(title)}</h1>{lead}</header>
<noscript><p>Figures are drawn by JavaScript; without it, their data are below each of them.</p></noscript>
{body}
<footer>{foot}</footer>
</main>
<script>{get_plotlyjs()}</script>
<script>{_shipped("page.js")}</script>
</body>
</html>
"""


def _shipped(name: str) -> str:
    """Return a file of this package."""
    return resources.files("tools.report").joinpath(name).read_text(encoding="utf-8")


def _lead(result: Result) -> str:
    """Return how many rides were evaluated, and what the figures of the paper are."""
    about = get_mapping(result, "about")
    rides = f"{about['fit']:,} rides. " if isinstance(about.get("fit"), int | float) else ""
    text = (
        f"{rides}Figures in parentheses and outlines are from “{published.load_paper().title}”. They are "
        "from other data (the rides of one company), for orientation only."
    )
    return f"<p>{escape(text)}</p>"


def _foot(result: Result) -> str:
    """Return the notes of the evaluation and the name of the command."""
    about = get_mapping(result, "about")
    notes = [*(result.get("notes") or ()), *(about.get("notes") or ())]
    items = "".join(f"<li>{escape(str(note))}</li>" for note in notes)
    return (f"<ul>{items}</ul>" if items else "") + "<p>Made by <code>socast evaluate</code>.</p>"


def _section(section: Section, shown: Sequence[Illustration]) -> str:
    """Return a section: its text, its figures, its tables."""
    drawn = "".join(
        f'<div class="{"small" if small else "wide"}">{"".join(_figure(one) for one in group)}</div>'
        for small, group in groupby(shown, key=lambda one: one.small)
    )
    text = f"<p>{escape(section.text)}</p>" if section.text else ""
    filled = [table for table in section.tables if table.rows]
    tables = "".join(_table(table, captioned=table.title != section.title) for table in filled)
    if section.folded:
        tables = f"<details><summary>As tables</summary>{tables}</details>"
    return f'<section id="{section.key}"><h2>{escape(section.title)}</h2>{text}{drawn}{tables}</section>\n'


def _figure(one: Illustration) -> str:
    """Return a figure, its caption and its data."""
    content = one.figure.to_json().replace("<", "\\u003c")
    label = escape(f"{one.title}. {one.caption}")
    return (
        f'<figure id="figure-{one.key}"><h3>{escape(one.title)}</h3>'
        f'<div class="plot" role="img" aria-label="{label}" style="height:{one.figure.layout.height}px"></div>'
        f'<script type="application/json">{content}</script>'
        f"<figcaption>{escape(one.caption)}</figcaption>{_figures_data(one)}</figure>"
    )


def _figures_data(one: Illustration) -> str:
    """Return the points of a figure as a folded table; a matrix already has a table below the figure."""
    rows = "".join(
        f"<tr><th scope=row>{trace.name}</th><td>{_number(x)}</td><td>{_number(y)}</td></tr>"
        for trace in one.figure.data
        if trace.type != "heatmap" and trace.hoverinfo != "skip"
        for x, y in zip(trace.x, trace.y, strict=True)
        if x is not None and y is not None
    )
    if not rows:
        return ""
    head = "<tr><th scope=col>curve</th><th scope=col>x</th><th scope=col>y</th></tr>"
    return f"<details><summary>Its data</summary><table><thead>{head}</thead><tbody>{rows}</tbody></table></details>"


def _number(value: Any) -> str:
    """Return a coordinate as text; names are already escaped."""
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _table(table: ReportTable, *, captioned: bool) -> str:
    """Return a table in a frame that scrolls sideways where the table is too wide."""
    title = escape(table.title)
    caption = f"<caption>{title}</caption>" if captioned else ""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in (table.corner, *table.columns))
    rows = "".join(_row(row) for row in table.rows)
    notes = "".join(f"<p>{escape(note)}</p>" for note in table.all_notes)
    return (
        f'<div class="table"><div class="scroll" role="region" tabindex="0" aria-label="{title}"><table>{caption}'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>{notes}</div>"
    )


def _row(row: Row) -> str:
    kind = ' class="total"' if row.total else ""
    name = f'<a href="#{escape(row.link)}">{escape(row.name)}</a>' if row.link else escape(row.name)
    return f'<tr{kind}><th scope="row">{name}</th>{"".join(_cell(cell) for cell in row.cells)}</tr>'


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    paper = f' <span class="paper">({escape(cell.paper)})</span>' if cell.paper else ""
    return f"<td>{f'<b>{text}</b>' if cell.strong else text}{paper}</td>"
