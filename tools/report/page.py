"""Render a report as one HTML file: tables and figures, with nothing loaded from elsewhere."""

import re
from collections import Counter
from collections.abc import Sequence
from html import escape
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from plotly.offline import get_plotlyjs

from socast.tools.report.document import Drawing, Illustration, Report, Section, place_notes
from socast.tools.report.table import Cell, ReportTable, Row
from socast.tools.terminal.output import REPORT_VERSIONS, write_file

WORDS: Final = ' class="words"'
"""Attribute of the cells of a column of words."""
COMMAND: Final = "socast "
"""Begin of a line that is a command."""
POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
    "font-src data:"
)
"""Content security policy of the page: nothing may be loaded from the network."""
UNIT_SPACE: Final = re.compile(
    r"(?<=\d) (?=(?:%|kWh|Wh|kW|W|km|m²|m|s|min|h|kg|N|K|°C)(?![\w²]))|(?<=±) (?=\d)|(?<=\d) (?=± \d)"
)
"""The space between a number and its unit, and those around ±."""
NO_BREAK: Final = "\u00a0"


def write_report(report: Report, path: Path) -> None:
    """Write a report as a self-contained page."""
    write_file(path, render_report(report).encode())


def render_report(report: Report) -> str:
    """Return the page of a report."""
    links = "".join(f'<li><a href="#{section.key}">{escape(section.title)}</a></li>' for section in report.sections)
    body = "".join(_section(section, report.draw(section.key)) for section in place_notes(report.sections))
    notes = "".join(f"<li>{escape_text(note)}</li>" for note in report.notes)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="socast-format" content="{report.name} {REPORT_VERSIONS[report.name]}">
<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">
<title>{escape(report.title)}</title>
<style>{_shipped("page.css")}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the figures</a>
<nav aria-label="Sections"><ol>{links}</ol></nav>
<main id="main">
<header><h1>{escape(report.title)}</h1>{"".join(map(_paragraph, report.lead))}</header>
<noscript><p>Figures are drawn by JavaScript; without it, their data are below each of them.</p></noscript>
{body}
<footer>{f"<ul>{notes}</ul>" if notes else ""}<p>Made by <code>socast {report.command}</code>.</p></footer>
</main>
<script>{get_plotlyjs()}</script>
<script>{_shipped("page.js")}</script>
</body>
</html>
"""


def render_tables(title: str, lines: Sequence[str], tables: Sequence[ReportTable]) -> str:
    """Return a title, sentences and tables as a part of a page, for notebooks."""
    text = "".join(f"<p>{escape_text(line)}</p>" for line in lines)
    shown = "".join(_table(table, captioned=True) for table in tables if table.rows)
    return f"<h4>{escape_text(title)}</h4>{text}{shown}"


def escape_text(text: str) -> str:
    """Return text for a page, with no line break between a number and its unit.

    Examples
    --------
    >>> escape_text("64 % of 0.1 kWh, 3 < 4").replace(NO_BREAK, "~")
    '64~% of 0.1~kWh, 3 &lt; 4'
    """
    return escape(keep_units(text))


def keep_units(text: str) -> str:
    """Return text with no-break spaces between numbers and their units, and around ±."""
    return UNIT_SPACE.sub(NO_BREAK, text)


def _shipped(name: str) -> str:
    """Return a file of this package."""
    return resources.files("socast.tools.report").joinpath(name).read_text(encoding="utf-8")


def _paragraph(line: str) -> str:
    """Return a sentence as a paragraph, and a command as code that can be copied."""
    if line.startswith(COMMAND):
        return f'<p class="command"><code>{escape(line)}</code></p>'
    return f"<p>{escape_text(line)}</p>"


def _section(section: Section, shown: Sequence[Illustration | Drawing]) -> str:
    """Return a section: its text, its figures, its tables."""
    drawn = "".join(
        _figures(list(group), section.title, "small" if small else "wide")
        for small, group in groupby(shown, key=lambda one: one.small)
    )
    text = f"<p>{escape_text(section.text)}</p>" if section.text else ""
    tables = "".join(_table(table, captioned=table.title != section.title) for table in section.tables)
    if section.folded:
        tables = f"<details><summary>As tables</summary>{tables}</details>"
    head, body = f"<h2>{escape_text(section.title)}</h2>", f"{text}{drawn}{tables}"
    if section.closed:
        return f'<section id="{section.key}"><details><summary>{head}</summary>{body}</details></section>\n'
    return f'<section id="{section.key}">{head}{body}</section>\n'


def _figures(shown: Sequence[Illustration | Drawing], heading: str, kind: str) -> str:
    """Return figures in a row or a column; a caption that several share stands once, above them."""
    count = Counter(one.caption for one in shown)
    shared = [caption for caption, times in count.items() if times > 1]
    above = "".join(f'<p class="caption">{escape_text(caption)}</p>' for caption in shared)
    figures = "".join(_figure(one, titled=one.title != heading, captioned=one.caption not in shared) for one in shown)
    return f'{above}<div class="{kind}">{figures}</div>'


def _figure(one: Illustration | Drawing, *, titled: bool, captioned: bool) -> str:
    """Return a figure, its caption and its data; the title is left out where it is that of the section."""
    drawn = one.svg if isinstance(one, Drawing) else _plot(one)
    data = "" if isinstance(one, Drawing) else _figures_data(one)
    return (
        f'<figure id="figure-{one.key}">{f"<h3>{escape_text(one.title)}</h3>" if titled else ""}{drawn}'
        f"{f'<figcaption>{escape_text(one.caption)}</figcaption>' if captioned else ''}{data}</figure>"
    )


def _plot(one: Illustration) -> str:
    """Return the place of a figure that a script draws, with what it draws."""
    content = one.figure.to_json().replace("<", "\\u003c")
    label = escape_text(f"{one.title}. {one.caption}")
    return (
        f'<div class="plot" role="img" aria-label="{label}" style="height:{one.figure.layout.height}px"></div>'
        f'<script type="application/json">{content}</script>'
    )


def _figures_data(one: Illustration) -> str:
    """Return the points of a figure as a folded table; a matrix already has a table below the figure."""
    shown = [trace for trace in one.figure.data if trace.type != "heatmap" and trace.hoverinfo != "skip"]
    rows = "".join(
        f"<tr><th scope=row>{name}</th><td>{_number(x)}</td><td>{_number(y)}</td></tr>"
        for name, points in [(trace.name, zip(trace.x, trace.y, strict=True)) for trace in shown]
        for x, y in points
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
    """Return a table in a frame that scrolls sideways where the table is too wide, below its title."""
    title = escape_text(table.title)
    caption = f'<p class="title">{title}</p>' if captioned else ""
    kinds = ["" if number else WORDS for number in table.numeric]
    columns = zip((table.corner, *table.columns), ("", *kinds), strict=True)
    head = "".join(f'<th scope="col"{kind}>{escape_text(name)}</th>' for name, kind in columns)
    rows = "".join(_row(row, kinds) for row in table.rows)
    notes = "".join(f"<p>{escape_text(note)}</p>" for note in table.all_notes)
    return (
        f'<div class="table">{caption}<div class="scroll" role="region" tabindex="0" aria-label="{title}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>{notes}</div>"
    )


def _row(row: Row, kinds: Sequence[str]) -> str:
    total = ' class="total"' if row.total else ""
    name = f'<a href="#{escape(row.link)}">{escape_text(row.name)}</a>' if row.link else escape_text(row.name)
    return f'<tr{total}><th scope="row">{name}</th>{"".join(map(_cell, row.cells, kinds))}</tr>'


def _cell(cell: Cell, kind: str) -> str:
    text = escape_text(cell.text)
    paper = f' <span class="paper">({escape_text(cell.paper)})</span>' if cell.paper else ""
    return f"<td{kind}>{f'<b>{text}</b>' if cell.strong else text}{paper}</td>"
