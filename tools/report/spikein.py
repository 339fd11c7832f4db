"""Show how well a diagnosis finds known effects in a recording: in the terminal, and as a page."""

from collections.abc import Sequence
from math import log
from pathlib import Path
from typing import Final

import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.tools.report.cells import Cell, ReportTable, Row, format_chance, format_count, format_percent
from socast.tools.report.diagnosis.tables import format_coefficient
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.figure_style import apply_layout, escape_label, get_style
from socast.tools.report.page import escape_text, render_document, save
from socast.tools.report.record_table import FORMATS, format_digits, tabulate_records
from socast.tools.spikein.records import VISIBLE, FoundShare, PlaceboName, SpikeScore, SpikeScores

TITLE: Final = "Known effects put into a recording"
FOUND: Final = "found"
"""Key of the section that is printed last."""
OUTCOMES: Final = (
    ("named first", "circle"),
    ("named", "diamond"),
    ("not named", "x"),
    ("not named: no formula of the library shows it here", "x-open"),
    ("not visible in these data", "circle-open"),
)
"""Outcomes of a spike, the best first, with the symbols of the figure."""


def show(result: SpikeScores, console: Console) -> None:
    """Print the scores, with the principal sentence last."""
    for section in sorted(build_sections(result), key=lambda section: section.key == FOUND):
        print_section(section, console)
    for line in describe(result):
        console.print(Text(line))


def write(result: SpikeScores, path: Path) -> None:
    """Write the scores as a self-contained page."""
    lead = "".join(f"<p>{escape_text(line)}</p>" for line in describe(result))
    foot = "<p>Made by <code>socast spikein --score</code>.</p>"
    page = render_document(
        "spikein-score", TITLE, lead, build_sections(result), lambda key: _illustrate(result, key), foot
    )
    save(page, path)


def describe(result: SpikeScores) -> list[str]:
    """Return what of each size is found, and what the recording shows without any effect put in."""
    parts = [
        f"{each.named} of {each.visible} at a size of {format_percent(each.size)}"
        for each in result.found
        if each.visible
    ]
    lines = []
    if parts:
        lines.append(f"Of the effects that these data can show, the diagnosis names {', '.join(parts)}.")
    else:
        lines.append("These data can show none of the effects at these sizes: try larger ones, or record more days.")
    if result.placebo:
        names = ", ".join(f"{each.effect} ({each.where})" for each in result.placebo)
        lines.append(f"Without any effect put in, the diagnosis names: {names}. Nobody put them in.")
    else:
        lines.append("Without any effect put in, the diagnosis names none.")
    return lines


def build_sections(result: SpikeScores) -> list[Section]:
    """Return the sections of the scores."""
    about = (
        f"{format_count(result.rides)} rides of {format_count(result.cars)} {'car' if result.cars == 1 else 'cars'} on "
        f"{format_count(result.days)} vehicle-days; the diagnosed model is {result.recipe}, fitted to each recording."
    )
    placebo = tabulate_records(
        "The recording as it is", result.placebo, PlaceboName, formats={**FORMATS, "coefficient": format_coefficient}
    )
    refused = ReportTable(
        "Not put in", "effect", ("why",), tuple(Row(name, (Cell(why),)) for name, why in result.refused.items())
    )
    explained = (
        "The data can show an effect if the likelihood ratio of the true energies, in the recording with the effect "
        "and in that without, exceeds 20, and if an effect of the library with a coefficient in its plausible range "
        "resembles it. Ranks count the names that the recording without the effect does not have."
    )
    return [
        Section(FOUND, "What is found", explained, [_tabulate_found(result.found)]),
        Section("scores", "Each effect", "", [_tabulate_scores(result.scores)]),
        Section("placebo", "Without any effect", about, [placebo]),
        *([Section("refused", "Not possible in this recording", "", [refused])] if result.refused else []),
    ]


def _tabulate_found(found: Sequence[FoundShare]) -> ReportTable:
    """Return how many effects of each size are found."""
    rows = tuple(
        Row(
            format_percent(each.size),
            tuple(
                Cell(text)
                for text in (
                    format_count(each.tried),
                    format_count(each.visible),
                    format_count(each.named),
                    format_count(each.first),
                    _format_share(each),
                )
            ),
        )
        for each in found
    )
    return ReportTable(
        "Effects by size", "size", ("tried", "visible", "named", "named first", "named, 95 % interval"), rows
    )


def _format_share(each: FoundShare) -> str:
    """Return the share of visible effects that are named, with its interval."""
    if each.share is None or each.share_ci95 is None:
        return format_percent(None)
    low, high = each.share_ci95
    return f"{format_percent(each.share, 0)} ({format_percent(low, 0)} to {format_percent(high, 0)})"


def _tabulate_scores(scores: Sequence[SpikeScore]) -> ReportTable:
    """Return a row for each effect and size."""
    heads = ("size", "outcome", "rank", "probability", "size found / put in", "of the way", "date", "also named")
    rows = tuple(
        Row(
            each.effect,
            tuple(
                Cell(text)
                for text in (
                    format_percent(each.size),
                    judge(each),
                    format_count(each.new_rank),
                    format_chance(each.probability),
                    _format_ratio(each),
                    format_percent(each.way, 0),
                    each.found_since or "",
                    ", ".join(each.others),
                )
            ),
        )
        for each in scores
    )
    return ReportTable("Effects put in", "effect", heads, rows)


def _format_ratio(each: SpikeScore) -> str:
    """Return how much of an effect is found, and whether its interval holds the truth."""
    if each.ratio is None:
        return format_digits(None)
    return f"{each.ratio:.2f}{'' if each.covered else ' (interval misses 1)'}"


def judge(score: SpikeScore) -> str:
    """Return the outcome of a spike, one of `OUTCOMES`."""
    if score.new_rank is not None:
        return OUTCOMES[0][0] if score.new_rank == 1 else OUTCOMES[1][0]
    if not score.visible:
        return OUTCOMES[4][0]
    return OUTCOMES[2][0] if score.plausible and (score.form_evidence or 0.0) > log(VISIBLE) else OUTCOMES[3][0]


def _illustrate(result: SpikeScores, key: str) -> list[Illustration]:
    """Return the figure of a section."""
    if key != FOUND or not result.scores:
        return []
    caption = (
        "Each effect at each size that was put in: whether it is named first, named, not named, or not visible; "
        "and where the true energies are visible, but not the formula of the library that resembles them most."
    )
    return [Illustration("spikein-outcomes", "Outcome by effect and size", caption, draw_outcomes(result.scores))]


def draw_outcomes(scores: Sequence[SpikeScore]) -> go.Figure:
    """Return a figure of the outcome of each effect over its size."""
    names = sorted({score.effect for score in scores}, reverse=True)
    traces = []
    for place, (outcome, symbol) in enumerate(OUTCOMES):
        chosen = [score for score in scores if judge(score) == outcome]
        if chosen:
            traces.append(
                go.Scatter(
                    name=outcome,
                    x=[100.0 * score.size for score in chosen],
                    y=[escape_label(score.effect) for score in chosen],
                    mode="markers",
                    marker={"symbol": symbol, "size": 12, "color": get_style(place + 2).colour},
                )
            )
    figure = apply_layout(go.Figure(traces), 120 + 24 * len(names))
    figure.layout.showlegend = True  # plotly hides the legend of a single outcome
    figure.layout.xaxis.tickvals = sorted({100.0 * score.size for score in scores})
    figure.layout.xaxis.title.text = "Energy of the effect over that of the cars [%]"
    figure.layout.yaxis.categoryorder = "array"
    figure.layout.yaxis.categoryarray = [escape_label(name) for name in names]
    return figure
