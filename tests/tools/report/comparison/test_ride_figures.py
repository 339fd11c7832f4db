"""Test the figures of a ride: the map's aspect, colours and scale, and conditions that are unknown."""

from math import cos, radians

import msgspec
import pytest

from socast.core.evaluate.compare.records import RideTrace
from socast.tools.report.comparison.ride_figures import draw_conditions, draw_map, draw_ride, list_maps
from tests.support.html_pages import assert_axes_are_titled


def make_trace(**changes):
    """Return the trace of a ride of three windows to the north and to the east, about 2 km each way."""
    windows = {
        "end_min": [1.0, 2.0, 3.0], "end_km": [1.0, 2.0, 2.0], "duration_s": [60.0, 60.0, 60.0],
        "distance_km": [1.0, 1.0, 0.0], "measured_kwh": [0.2, 0.1, 0.05], "ambient_c": [3.0, 3.0, 4.0],
        "gained_m": [10.0, 0.0, None], "lost_m": [0.0, 4.0, None], "wind_speed_kmh": [12.0, 12.0, 12.0],
        "headwind_kmh": [12.0, 0.0, None], "latitude_start_deg": [60.0, 60.02, 60.02],
        "longitude_start_deg": [10.0, 10.0, 10.04], "latitude_end_deg": [60.02, 60.02, 60.02],
        "longitude_end_deg": [10.0, 10.04, 10.04],
    } | changes  # fmt: skip
    model = {"energy_kwh": [0.25, 0.08, 0.05], "start_kwh": 0.01}
    return msgspec.convert({"windows": windows, "models": {"base": model}}, RideTrace)


def test_map_shows_each_window_in_true_proportions():
    made = draw_map(make_trace(), "base")
    assert made.layout.yaxis.scaleanchor == "x"
    assert made.layout.yaxis.scaleratio == pytest.approx(1.0 / cos(radians(60.0)), rel=0.01)
    (middles,) = (trace for trace in made.data if trace.name == "window")
    assert list(middles.marker.color) == pytest.approx([3000.0, -1200.0, 0.0])
    assert (middles.marker.cmin, middles.marker.cmax) == pytest.approx((-3000.0, 3000.0))
    assert middles.marker.colorbar.title.text == "Predicted less measured [W]"
    assert_axes_are_titled(made)


def test_scale_bar_has_its_length():
    (bar,) = (trace for trace in draw_map(make_trace(), "base").data if trace.name == "scale")
    km = 111.2 * cos(radians(60.0)) * (bar.x[2] - bar.x[0])
    assert bar.text[1].endswith("0.5 km")
    assert km == pytest.approx(0.5, rel=0.01)
    assert bar.y[0] < 60.0


def test_ride_without_positions_or_movement_has_no_map():
    assert list_maps(make_trace(latitude_end_deg=None)) == []
    still = {name: [60.0] * 3 for name in ("latitude_start_deg", "latitude_end_deg")}
    assert list_maps(make_trace(**still, longitude_start_deg=[10.0] * 3, longitude_end_deg=[10.0] * 3)) == []
    assert [name for name, _ in list_maps(make_trace())] == ["base"]


def test_conditions_have_one_titled_plot_each():
    made = draw_conditions(make_trace())
    titles = [made.layout[f"yaxis{i or ''}"].title.text for i in ("", 2, 3, 4)]
    assert titles == ["Speed<br>[km/h]", "Elevation<br>from the start<br>[m]", "Temperature<br>[°C]", "Wind<br>[km/h]"]
    curves = {trace.name: list(trace.y) for trace in made.data}
    assert curves["speed"] == [60.0, 60.0, 60.0, 60.0, 0.0, 0.0]
    assert curves["elevation"] == [0.0, 10.0, 6.0, 6.0]
    assert curves["against the car"] == [12.0, 12.0, 0.0, 0.0, None, None]
    assert_axes_are_titled(made)


def test_unknown_condition_has_no_empty_plot():
    unknown = {"ambient_c": [None] * 3, "wind_speed_kmh": None, "headwind_kmh": None, "gained_m": None}
    made = draw_conditions(make_trace(**unknown))
    assert {trace.name for trace in made.data} == {"speed"}
    assert "yaxis2" not in made.to_plotly_json()["layout"]
    flat = draw_conditions(make_trace(gained_m=[0.0] * 3, lost_m=[0.0] * 3))
    assert "elevation" not in {trace.name for trace in flat.data}


def test_ride_shows_power_and_error_of_each_model():
    curves = {(trace.name, trace.yaxis): list(trace.y) for trace in draw_ride(make_trace()).data}
    assert curves["measured", "y"] == pytest.approx([12.0, 12.0, 6.0, 6.0, 3.0, 3.0])
    assert curves["base", "y"] == pytest.approx([15.0, 15.0, 4.8, 4.8, 3.0, 3.0])
    assert curves["base", "y2"] == pytest.approx([0.01, 0.06, 0.04, 0.04])
