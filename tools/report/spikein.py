"""Show how well a diagnosis finds known effects in a recording: in the terminal, and as a page."""

from collections.abc import Sequence
from math import log
from typing import Final

import plotly.graph_objects as go
from rich.console import Console
from rich.text import Text

from socast.core.formatting import format_count as count_things
from socast.tools.report.diagnosis.tables import format_coefficient
from socast.tools.report.document import Illustration, Report, Section, print_report
from socast.tools.report.figure_style import escape_label, get_style, make_figure
from socast.tools.report.table import (
    FORMATS,
    UNKNOWN,
    ReportTable,
    format_chance,
    format_count,
    format_percent,
    tabulate,
    tabulate_records,
)
from socast.tools.spikein.records import VISIBLE, FoundShare, PlaceboName, SpikeScore, SpikeScores

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
    report = build_report(result)
    print_report(report, console, last=FOUND)
    for line in report.lead:
        console.print(Text(line))


def build_report(result: SpikeScores) -> Report:
    """Return the report of the scores."""
    title, sections = "Known effects put into a recording", build_sections(result)
    drawn = {FOUND: _illustrate}
    return Report("spikein-score", "spikein --score", title, sections, describe(result), (), result, drawn)


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
        f"{result.rides:,} rides of {count_things(result.cars, 'car')} on "
        f"{result.days:,} vehicle-days; the diagnosed model is {result.recipe}, fitted to each recording."
    )
    placebo = tabulate_records(
        "The recording as it is", result.placebo, PlaceboName, formats={**FORMATS, "coefficient": format_coefficient}
    )
    refused = tabulate("Not put in", "effect", list(result.refused.items()), [("why", str)])
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
    return tabulate(
        "Effects by size",
        "size",
        [(format_percent(each.size), each) for each in found],
        [
            ("tried", lambda each: format_count(each.tried)),
            ("visible", lambda each: format_count(each.visible)),
            ("named", lambda each: format_count(each.named)),
            ("named first", lambda each: format_count(each.first)),
            ("named, 95 % interval", _format_share),
        ],
    )


def _format_share(each: FoundShare) -> str:
    """Return the share of visible effects that are named, with its interval."""
    if each.share is None or each.share_ci95 is None:
        return UNKNOWN
    low, high = each.share_ci95
    return f"{format_percent(each.share, 0)} ({format_percent(low, 0)} to {format_percent(high, 0)})"


def _tabulate_scores(scores: Sequence[SpikeScore]) -> ReportTable:
    """Return a row for each effect and size."""
    return tabulate(
        "Effects put in",
        "effect",
        [(each.effect, each) for each in scores],
        [
            ("size", lambda each: format_percent(each.size)),
            ("outcome", judge),
            ("rank", lambda each: format_count(each.new_rank)),
            ("probability", lambda each: format_chance(each.probability)),
            ("size found / put in", _format_ratio),
            ("of the way", lambda each: format_percent(each.way, 0)),
            ("date", lambda each: each.found_since or ""),
            ("also named", lambda each: ", ".join(each.others)),
        ],
    )


def _format_ratio(each: SpikeScore) -> str:
    """Return how much of an effect is found, and whether its interval holds the truth."""
    if each.ratio is None:
        return UNKNOWN
    return f"{each.ratio:.2f}{'' if each.covered else ' (interval misses 1)'}"


def judge(score: SpikeScore) -> str:
    """Return the outcome of a spike, one of `OUTCOMES`."""
    if score.new_rank is not None:
        return OUTCOMES[0][0] if score.new_rank == 1 else OUTCOMES[1][0]
    if not score.visible:
        return OUTCOMES[4][0]
    return OUTCOMES[2][0] if score.plausible and (score.form_evidence or 0.0) > log(VISIBLE) else OUTCOMES[3][0]


def _illustrate(result: SpikeScores) -> list[Illustration]:
    """Return the outcomes as a figure."""
    if not result.scores:
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
    sizes, title = sorted({100.0 * score.size for score in scores}), "Energy of the effect over that of the cars [%]"
    return make_figure(
        traces,
        120 + 24 * len(names),
        x={"tickvals": sizes, "title_text": title},
        y={"categoryorder": "array", "categoryarray": [escape_label(name) for name in names]},
        showlegend=True,  # plotly hides the legend of a single outcome
    )
