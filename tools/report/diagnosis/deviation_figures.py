"""Draw cars against the spread between them, and changes of single cars over time."""

from datetime import UTC, date, datetime
from typing import Final

import plotly.graph_objects as go

from socast.core.diagnose.deviation_words import PERCENT
from socast.core.diagnose.records import CarDeviation, Diagnosis
from socast.tools.report.diagnosis.deviations import describe_deviation
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.figure_style import add_reference_line, escape_label, get_style, make_figure

ROW: Final = 26
"""Height of a row of a chart. [px]"""
MOST_CARS: Final = 40
"""Largest number of cars that are drawn."""
MONTH_S: Final = 365.25 / 12.0 * 86_400.0
"""Length of a month. [s]"""


def draw_deviations(result: Diagnosis) -> list[Illustration]:
    """Return the figures of cars and changes."""
    changes = [(one, one.since) for one in result.deviations if one.shifts and one.since]
    return [*_draw_cars(result), *(_draw_change(place, one, since) for place, (one, since) in enumerate(changes))]


def _draw_cars(result: Diagnosis) -> list[Illustration]:
    """Draw the energy of each car beyond that of its siblings with its interval, over the spread between cars."""
    known = [(car, car.share, car.share_ci95) for car in result.cars if car.share is not None and car.share_ci95]
    rows = sorted(known[:MOST_CARS], key=lambda row: -row[1])
    if not rows:
        return []
    named = {one.who for one in result.deviations}
    labels = [escape_label(f"{car.car}{' (named)' if car.car in named else ''}") for car, *_ in rows]
    shares = [PERCENT * share for _, share, _ in rows]
    look = get_style(2)
    points = go.Scatter(
        name="car",
        x=shares,
        y=labels,
        mode="markers",
        marker={"symbol": look.symbol, "size": 10, "color": look.colour},
        error_x={
            "type": "data",
            "symmetric": False,
            "array": [PERCENT * (high - share) for _, share, (_, high) in rows],
            "arrayminus": [PERCENT * (share - low) for _, share, (low, _) in rows],
            "thickness": 1.5,
            "width": 4,
        },
    )
    made = make_figure([points], 110 + ROW * len(rows))
    spread = PERCENT * sum(car.share_spread or 0.0 for car, *_ in rows) / len(rows)
    made.add_vrect(x0=-spread, x1=spread, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    add_reference_line(made, "", 0.0)
    made.update_xaxes(title_text="Energy beyond that of the siblings [% of the energy of the car]")
    made.update_yaxes(title_text="Car", type="category", autorange="reversed")
    caption = (
        "Points: what each car uses more than the others of its model under the same conditions; lines: 95 % "
        "intervals. Shaded: one standard deviation between cars. A car may be named for what it uses in some "
        "conditions, such as cold or wind, while its total is usual."
    )
    return [Illustration("cars", "Cars beside their siblings", caption, made)]


def _draw_change(place: int, one: CarDeviation, since: str) -> Illustration:
    """Draw what a car uses more in each shift, with the step or ramp that was found and its interval."""
    shifts = one.shifts
    time = [datetime.fromtimestamp(shift.start_s, UTC) for shift in shifts]
    look, line = get_style(2), get_style(4)
    points = go.Scatter(
        name="shift",
        x=time,
        y=[PERCENT * shift.share for shift in shifts],
        mode="markers",
        marker={"symbol": look.symbol, "size": 7, "color": look.colour},
        error_y={"type": "data", "array": [PERCENT * shift.error for shift in shifts], "thickness": 1.0, "width": 0},
    )
    last = max((shift.start_s for shift in shifts), default=0.0)
    value, low, high = (PERCENT * share for share in _get_full_share(one, since, last))
    size = [shift.size for shift in shifts]
    shape = "linear" if one.kind == "ramp" else "hv"
    ends = [
        go.Scatter(
            x=time, y=[end * each for each in size], mode="lines", showlegend=False, hoverinfo="skip",
            line={"width": 0.0, "shape": shape, "color": line.colour}, fill="tonexty" if second else None,
        )
        for second, end in enumerate((low, high))
    ]  # fmt: skip
    change = go.Scatter(
        name=one.kind,
        x=time,
        y=[value * each for each in size],
        mode="lines",
        line={"color": line.colour, "dash": line.dash, "width": 2, "shape": shape},
    )
    made = make_figure([*ends, points, change], 340)
    begin, finish = one.since_ci90 or (since, since)
    made.add_vrect(x0=begin, x1=finish, fillcolor="#8a8a8a", opacity=0.18, line_width=0)
    made.update_xaxes(title_text="Date [UTC]")
    made.update_yaxes(title_text="Energy beyond the model [% of the energy]", zeroline=True)
    caption = (
        f"{describe_deviation(one)[0]}. Points: each shift by itself, with its standard error, for the most probable "
        "cause. Line: the change with its 95 % interval. Shaded dates: the 90 % range of its begin."
    )
    return Illustration(f"change-{place}", f"Change of {one.who}", caption, made)


def _get_full_share(one: CarDeviation, since: str, last: float) -> tuple[float, float, float]:
    """Return the share of the energy at the last shift, and the ends of its interval."""
    value = one.share or 0.0
    limits = one.share_ci95 or (value, value)
    rate = one.share_per_month
    if one.kind != "ramp" or rate is None:
        return value, limits[0], limits[1]
    begin = datetime.combine(date.fromisoformat(since), datetime.min.time(), UTC).timestamp()
    months = (last - begin) / MONTH_S
    low, high = one.share_per_month_ci95 or (rate, rate)
    return rate * months, low * months, high * months
