"""Draw by how much rides, days and vehicles differ in each kind of load."""

from collections.abc import Sequence
from typing import Final

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from socast.core.diagnose.records import Diagnosis, LocatedLoad
from socast.tools.report.diagnosis.location_sentences import LEVEL_NAMES
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.figure_style import apply_layout, get_style

ROW: Final = 26
"""Height of a row. [px]"""
GAP: Final = 46
"""Height between two panels. [px]"""
KINDS: Final = {
    "constant": "per second",
    "rolling": "per km",
    "drag": "per km × speed²",
    "climbing": "per metre climbed",
    "braking": "per braking",
    "beginning": "at the beginning",
}
"""Names of the kinds, which fit beside a narrow figure; they are rows of each panel in this order."""
CAPTION: Final = (
    "How much the rides, vehicle-days or vehicles differ in each kind of load that the model does not explain, all "
    "kinds in the same unit. Points: standard deviation between them. Lines: 95 % intervals. Ticks: what sampling "
    "alone, or the usual spread between vehicles, may cause. Filled: the data require the load beside the others, and "
    "its interval lies beyond the tick. Open: not so; each is estimated by itself and may take up what another causes."
)


def draw_location(result: Diagnosis) -> list[Illustration]:
    """Draw the size of each load with its interval, as a mean power: a panel for each level, a row for each kind."""
    loads = result.error_location.estimates
    levels = [level for level in LEVEL_NAMES if any(one.level == level for one in loads)]
    if not loads:
        return []
    panels = [
        sorted((one for one in loads if one.level == level), key=lambda one: list(KINDS).index(one.kind))
        for level in levels
    ]
    rows = [len(panel) for panel in panels]
    height = ROW * sum(rows) + GAP * (len(panels) - 1)
    made = make_subplots(
        rows=len(panels),
        cols=1,
        shared_xaxes=True,
        row_heights=rows,
        vertical_spacing=GAP / height if len(panels) > 1 else 0.0,
        subplot_titles=[f"Between {LEVEL_NAMES[level]}s" for level in levels],
    )
    for row, panel in enumerate(panels, start=1):
        for trace in (*_draw_sizes(panel), *_draw_floors(panel)):
            shown = trace.name not in {each.name for each in made.data}
            made.add_trace(trace.update(showlegend=shown, legendgroup=trace.name), row=row, col=1)
    apply_layout(made, 130 + height)
    made.update_annotations(font_size=12)
    made.update_xaxes(rangemode="tozero", tickangle=0, nticks=6)
    made.update_xaxes(title_text="Standard deviation, as a mean power [W]", row=len(panels), col=1)
    for row, panel in enumerate(panels, start=1):
        names = [KINDS[one.kind] for one in panel]
        made.update_yaxes(type="category", categoryorder="array", categoryarray=names, row=row, col=1)
        made.update_yaxes(title_text="Load", range=[len(names) - 0.5, -0.5], row=row, col=1)
    return [Illustration("location", "Location of the error", CAPTION, made)]


def _draw_sizes(panel: Sequence[LocatedLoad]) -> list[go.Scatter]:
    """Return the points of a level with their intervals, claimed ones filled."""
    traces = []
    for name, place, filled in (("unexplained load", 2, True), ("not claimed", 7, False)):
        mine = [one for one in panel if one.claimed is filled]
        look = get_style(place)
        symbol = "circle" if filled else "circle-open"
        spans = {
            "type": "data",
            "array": [one.high_w - one.size_w for one in mine],
            "arrayminus": [one.size_w - one.low_w for one in mine],
            "symmetric": False,
            "thickness": 1.5,
            "width": 4,
        }
        points = go.Scatter(
            name=name,
            x=[one.size_w for one in mine],
            y=[KINDS[one.kind] for one in mine],
            mode="markers",
            marker={"symbol": symbol, "size": 10, "color": look.colour, "line": {"width": 1.5, "color": look.colour}},
            error_x=spans,
            cliponaxis=False,
        )
        traces += [points] if mine else []
    return traces


def _draw_floors(panel: Sequence[LocatedLoad]) -> list[go.Scatter]:
    """Return the ticks of a level: the size of each load that drives show without any."""
    ticks = go.Scatter(
        name="limit of sampling",
        x=[one.floor_w for one in panel],
        y=[KINDS[one.kind] for one in panel],
        mode="markers",
        marker={"symbol": "line-ns-open", "size": 14, "color": "#8a8a8a", "line": {"width": 2.5}},
    )
    return [ticks]
