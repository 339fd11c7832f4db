"""Draw by how much rides, days and vehicles differ in each kind of load."""

from typing import Final

import plotly.graph_objects as go

from tools.report.diagnosis.location_sentences import KIND_NAMES, LEVEL_NAMES, is_known
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, get_part
from tools.report.figure_style import escape_label, get_style, make_figure

ROW: Final = 26
"""Height of a row. [px]"""


def draw_location(result: Result) -> list[Illustration]:
    """Draw the size of each load with its interval, as a mean power, one row for each level and kind."""
    loads = [one for one in get_part(result, "error_location", "estimates") or () if is_known(one)]
    if not loads:
        return []
    order = list(LEVEL_NAMES)
    loads = sorted(loads, key=lambda one: (order.index(str(one["level"])), -float(one["high_w"])))
    traces = []
    for name, place, claimed in (("unexplained load", 2, True), ("not beyond sampling", 7, False)):
        mine = [one for one in loads if bool(one.get("claimed")) is claimed]
        look = get_style(place)
        spans = {
            "type": "data",
            "array": [one["high_w"] - one["size_w"] for one in mine],
            "arrayminus": [one["size_w"] - one["low_w"] for one in mine],
            "symmetric": False,
            "thickness": 1.5,
            "width": 4,
        }
        names = [_name(one) for one in mine]
        sizes = [one["size_w"] for one in mine]
        if mine:
            colour = {"color": look.colour, "opacity": 1.0 if claimed else 0.45}
            traces.append(go.Bar(name=name, y=names, x=sizes, orientation="h", marker=colour, error_x=spans))
    made = make_figure(traces, 130 + ROW * len(loads))
    made.update_layout(barmode="overlay")
    made.update_xaxes(title_text="Standard deviation between units, as a mean power [W]", rangemode="tozero")
    rows = [_name(one) for one in loads]
    made.update_yaxes(type="category", categoryorder="array", categoryarray=rows, autorange="reversed")
    caption = (
        "How much the units of each level (rides, vehicle-days, ...) differ in each kind of load that the model does "
        "not explain, all kinds in the same unit. Lines: 95 % intervals. Faint: no more than sampling alone causes."
    )
    return [Illustration("location", "Where the error lives", caption, made)]


def _name(one: dict[str, object]) -> str:
    """Return the name of a row."""
    return escape_label(f"{LEVEL_NAMES[str(one['level'])]}, {KIND_NAMES[str(one['kind'])]}")
