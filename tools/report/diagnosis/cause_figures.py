"""Draw the probabilities of the effects that explain the same, or of those that may be missing."""

from collections.abc import Sequence
from typing import Final

from socast.core.diagnose.records import CauseProbability
from socast.tools.report.cells import format_chance
from socast.tools.report.diagnosis.sentences import CAUSE_NAMES, LEAST_PROBABILITY
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.figure_style import draw_bars, escape_label, get_style, make_figure

PERCENT: Final = 100.0
ROW: Final = 28
"""Height of a row. [px]"""
MOST: Final = 12
"""Largest number of bars of effects; the less probable effects share the last one."""


def draw_causes(
    causes: Sequence[CauseProbability], *, key: str = "causes", title: str = "Probable causes"
) -> list[Illustration]:
    """Draw the probability of each cause as a bar: effects first, then a cause outside the library, then none."""
    known = [(one.effect, one.probability) for one in causes]
    rows = sorted(((name, p) for name, p in known if p is not None), key=lambda row: -row[1])
    named = [row for row in rows if row[0] not in CAUSE_NAMES]
    apart = [(CAUSE_NAMES[name], p) for name, p in sorted(rows, reverse=True) if name in CAUSE_NAMES]
    if not rows:
        return []
    named = _merge_improbable(named)
    traces = [
        draw_bars(
            name,
            get_style(style),
            [escape_label(label.replace("_", " ")) for label, _ in group],
            [PERCENT * p for _, p in group],
            text=[_format_probability(p) for _, p in group],
            textposition="outside",
            cliponaxis=False,
        )
        for name, style, group in (("effect of the library", 2, named), ("no effect of the library", 0, apart))
        if group
    ]
    made = make_figure(traces, 100 + ROW * (len(named) + len(apart)))
    made.update_layout(barmode="overlay", showlegend=False)
    made.update_xaxes(title_text="Probability [%]", range=[0.0, 108.0], tickvals=[0, 20, 40, 60, 80, 100])
    made.update_yaxes(title_text="Cause", type="category", autorange="reversed")
    caption = (
        "Blue: effects of the library. Grey: a cause outside the library, and that no effect is missing. Others: "
        "effects that are less probable than 0.5 %."
    )
    return [Illustration(key, title, caption, made)]


def _merge_improbable(rows: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return sorted causes with the improbable ones, and those beyond the largest number of bars, in one row."""
    probable = [row for row in rows if row[1] >= LEAST_PROBABILITY]
    kept = probable if len(probable) < MOST else probable[: MOST - 1]
    rest = rows[len(kept) :]
    if len(rest) < 2:
        return rows
    return [*kept, (f"{len(rest)} others", sum(p for _, p in rest))]


def _format_probability(value: float) -> str:
    """Return a probability as a percentage, or that it is negligible."""
    return format_chance(value) if value >= LEAST_PROBABILITY else "< 0.5 %"
