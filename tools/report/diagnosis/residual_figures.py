"""Draw the mean remaining error along each feature, and by car, driver and hour of the day, on one common scale."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Final

import plotly.graph_objects as go
from msgspec.structs import replace

from socast.core.diagnose.records import Diagnosis, ResidualProfile
from socast.tools.report.diagnosis.partial_figures import AFTER, BEFORE
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.figure_style import REFERENCE_LINE, escape_label, make_figure

TITLES: Final = {
    "ambient_c": "outside temperature",
    "average_speed_kmh": "average speed",
    "precipitation_mm_h": "precipitation",
    "wind_speed_kmh": "wind speed",
    "soc_start_pct": "state of charge",
    "battery_temperature_c": "battery temperature",
    "elapsed_s": "time since the ride began",
    "parked_s": "time parked before the ride",
    "occupants": "occupants",
    "odometer_km": "odometer",
    "start_s": "date",
    "vehicle_id": "car",
    "driver_id": "driver",
    "hour": "hour of the day",
}
"""What each feature is, in words."""
AXES: Final = {"vehicle_id": "Car", "driver_id": "Driver", "hour": "Local solar time [h]", "start_s": "Date [UTC]"}
"""Axis titles that are not a feature and its unit."""
SCALES: Final = {"elapsed_s": (60.0, "min"), "parked_s": (3600.0, "h"), "odometer_km": (1000.0, "1000 km")}
"""Size of the unit of an axis in units of the feature, and the unit."""
WIDEST: Final = 2.0
"""Widest interval that the common scale shows whole, relative to the largest mean."""
ROW: Final = 26
"""Height of a row of names. [px]"""
CAPTION: Final = (
    "Filled: without what is named. Outlines: with it, with 95 % intervals. All these figures have one scale, "
    "which an interval may leave. Parentheses: the number of windows. Bins of too few vehicle-days "
    "for an interval are not drawn."
)
BY_CAR: Final = "The terms are refitted for each car, so the mean of a car is nearly zero whatever its error was."


def draw_profiles(result: Diagnosis) -> list[Illustration]:
    """Draw the mean residual along each feature and by each category, in bins that have an interval."""
    known = [_keep_known_bins(part) for part in result.profiles]
    parts = [part for part in known if len(part.x) > 1]
    limit = _find_limit(parts)
    return [_draw_profile(part, limit, several=bool(result.missing or result.deviations)) for part in parts]


def _keep_known_bins(part: ResidualProfile) -> ResidualProfile:
    """Return a profile without the bins whose interval is unknown."""
    kept = [i for i, half in enumerate(part.ci95_w) if half is not None]
    columns = ("x", "before_w", "after_w", "ci95_w", "windows", "days")
    return replace(part, **{name: [getattr(part, name)[i] for i in kept] for name in columns})


def _find_limit(parts: Sequence[ResidualProfile]) -> float:
    """Return the end of the common scale, which shows every mean, and most intervals whole. [W]"""
    means = [abs(value) for part in parts for value in (*part.before_w, *part.after_w)]
    most = max(means, default=1.0) or 1.0
    ends = [
        abs(mean) + half
        for part in parts
        for mean, half in zip(part.after_w, part.ci95_w, strict=True)
        if half is not None
    ]
    return 1.05 * float(max([most, *(end for end in ends if end <= WIDEST * most)]))


def _draw_profile(part: ResidualProfile, limit: float, *, several: bool) -> Illustration:
    """Draw one feature along the horizontal axis, or one category with a row for each name."""
    feature = part.feature
    title = TITLES.get(feature, feature.replace("_", " "))
    unit = part.unit
    named = not unit
    size, unit = SCALES.get(feature, (1.0, unit))
    x = _name_rows(part) if named else [_place(feature, at, size) for at in part.x]
    traces = []
    if several:
        traces.append(_draw_means("without what is named", BEFORE, part, "before_w", x, named=named))
    name = "with what is named" if several else "remaining"
    traces.append(_draw_means(name, AFTER, part, "after_w", x, named=named))
    made = make_figure(traces, 110 + ROW * len(x) if named else 320)
    power = "Measured less predicted [W]"
    along = AXES.get(feature, f"{title[:1].upper()}{title[1:]} [{unit}]")
    if named:
        made.update_xaxes(title_text=power, range=[-limit, limit])
        made.update_yaxes(title_text=escape_label(along), type="category", autorange="reversed")
        made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1})
    else:
        made.update_xaxes(title_text=escape_label(along))
        made.update_yaxes(title_text=power, range=[-limit, limit])
        made.add_hline(y=0.0, line={**REFERENCE_LINE, "width": 1})
    caption = BY_CAR if feature == "vehicle_id" else CAPTION
    return Illustration(f"profile-{feature}", f"Remaining error by {title}", caption, made, small=True)


def _name_rows(part: ResidualProfile) -> list[str]:
    """Return the names of categories, with the number of windows in parentheses."""
    return [escape_label(f"{name} ({count:,})") for name, count in zip(part.x, part.windows, strict=True)]


def _place(feature: str, value: Any, size: float) -> Any:
    """Return a coordinate: a time for the date, a number for all else."""
    return datetime.fromtimestamp(value, UTC) if feature == "start_s" else value / size


def _draw_means(name: str, look: Any, part: ResidualProfile, key: str, x: list[Any], *, named: bool) -> go.Scatter:
    """Return the means of the bins, with intervals for those that remain."""
    values = getattr(part, key)
    spread = list(part.ci95_w) if key == "after_w" else []
    bars = {"type": "data", "array": spread, "thickness": 1.2, "width": 3} if any(spread) else None
    counts = zip(part.windows, part.days, strict=False)
    return go.Scatter(
        name=name,
        x=values if named else x,
        y=x if named else values,
        mode="markers",
        marker={"symbol": look.symbol, "size": 8, "color": look.colour, "line": {"width": 1.5, "color": look.colour}},
        **{"error_x" if named else "error_y": bars},
        text=[f"{windows:,} windows of {days:,} vehicle-days" for windows, days in counts],
        hovertemplate=f"%{{{'x' if named else 'y'}:.3g}} W, %{{text}}<extra></extra>",
    )
