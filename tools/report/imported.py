"""Draw on one page whether distance and energy of imported cars agree with each other."""

from collections.abc import Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from socast.core.vehicles import load_catalogue
from socast.tools.importers.table.agreement import estimate_capacity
from socast.tools.importers.table.agreement_sums import CarSums
from socast.tools.importers.table.conversion import ImportSummary, list_lines
from socast.tools.report.document import Illustration, Report, Section
from socast.tools.report.figure_style import REFERENCE_LINE, apply_layout, draw_dots, escape_label, get_style
from socast.tools.report.table import UNKNOWN, ReportTable, tabulate

CAPTION = (
    "Each point is a car. Left: distance by odometer or positions over that by speed; on the dashed line they are "
    "equal. Right: energy of 100 % of the displayed charge, by power, over the energy per km."
)
FEWEST_KM = 1.0
"""Shortest distance of a car that is drawn. [km]"""


def build_report(summary: ImportSummary) -> Report:
    """Return the report of an import."""
    sections = [Section("agreement", "Do the values agree?", "", [_tabulate(summary)])]
    lead, drawn = [list_lines(summary)[0][0]], {"agreement": _illustrate}
    return Report("import", "import", "Imported data", sections, lead, (), summary, drawn)


def _illustrate(summary: ImportSummary) -> list[Illustration]:
    """Return the figure of all cars."""
    figure = draw_agreement(summary.cars)
    return [Illustration("agreement-of-cars", "Distance and energy of each car", CAPTION, figure)]


def draw_agreement(cars: Sequence[CarSums]) -> go.Figure:
    """Return the figure of the distances and energies of cars."""
    figure = make_subplots(rows=1, cols=2, subplot_titles=("Distance", "Energy"), horizontal_spacing=0.12)
    longest = 0.0
    for place, name in enumerate(("odometer", "fixes")):
        known = [car for car in cars if car.sums[f"speed_beside_{name}"] > FEWEST_KM * 1000.0]
        x = [car.sums[f"speed_beside_{name}"] / 1000.0 for car in known]
        y = [car.sums[name] / 1000.0 for car in known]
        longest = max([longest, *x, *y])
        title = "positions" if name == "fixes" else name
        figure.add_trace(_draw_points(f"by {title}", place, x, y, known), row=1, col=1)
    line = go.Scatter(
        x=[0.0, longest], y=[0.0, longest], mode="lines", line=REFERENCE_LINE, name="equal", showlegend=False
    )
    figure.add_trace(line, row=1, col=1)
    known = [car for car in cars if car.sums["distance"] > FEWEST_KM * 1000.0 and estimate_capacity(car) is not None]
    x = [car.sums["energy"] / 3600.0 / car.sums["distance"] for car in known]
    figure.add_trace(_draw_points("energy", 2, x, [estimate_capacity(car) for car in known], known), row=1, col=2)
    for key in sorted({car.model for car in known if car.model in load_catalogue()}, key=str):
        nominal = load_catalogue()[str(key)].nominal_capacity_kwh
        figure.add_hline(nominal, line=REFERENCE_LINE, annotation_text=escape_label(str(key)), row=1, col=2)
    figure.update_layout(
        xaxis_title_text="distance by speed, km",
        yaxis_title_text="distance, km",
        xaxis2_title_text="energy per km, kWh",
        yaxis2_title_text="energy per 100 %, kWh",
    )
    return apply_layout(figure, 420)


def _draw_points(
    name: str, place: int, x: Sequence[float], y: Sequence[float | None], cars: Sequence[CarSums]
) -> go.Scatter:
    """Return the points of cars with their names."""
    points = draw_dots(name, get_style(place), list(x), list(y))
    points.text = [escape_label(car.vehicle) for car in cars]
    return points


def _tabulate(summary: ImportSummary) -> ReportTable:
    """Return the table of the comparisons."""
    verdicts = {True: "agrees", False: "does not agree", None: "not checked"}
    rows = [(check.name, check) for check in summary.checks]
    lines = tuple(line for line, _ in list_lines(summary)[1:] if not line.startswith(tuple(verdicts.values())))
    return tabulate(
        "Do the values agree?",
        "comparison",
        rows,
        [
            ("verdict", lambda check: verdicts[check.passed]),
            ("found", lambda check: check.found),
            ("limit", lambda check: check.limit),
            ("remedy", lambda check: check.remedy or UNKNOWN),
        ],
        lines,
    )
