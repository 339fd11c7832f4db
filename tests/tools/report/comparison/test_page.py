"""Test which tables of a comparison the terminal and the page show."""

import msgspec
import pytest
from msgspec.structs import replace

from socast.core.evaluate.compare.records import Comparison, DatasetContrast, WorstRides
from socast.tools.report.comparison.figures import illustrate_conditions, illustrate_datasets
from socast.tools.report.comparison.page import PLACES, build_sections
from socast.tools.report.comparison.tables import tabulate_worst_rides
from tests.support.html_pages import assert_axes_are_titled


def compared(*q):
    """Return a result with two conditions of two bins; `q` are the false discovery rates of the second."""
    bins = [
        {"bin": label, "n": 9, "vehicle_days": 9, "bias_kwh": {"value": 0.1, "ci95": 0.05}, "q": rate}
        for label, rate in zip(("-5 to 0", "0 to 5"), q, strict=True)
    ]
    even = [entry | {"q": 0.9} for entry in bins]
    about = {
        "rides": 18, "read": 18, "left_out": {}, "measured": {"vi": 1.0}, "vehicles": 3, "vehicle_days": 18,
        "first_date": "2018-01-15", "last_date": "2018-01-20",
        "consumption_kwh": {"value": 0.4, "ci95": 0.1}, "per_100km_kwh": {"value": 15.0, "ci95": 1.0},
    }  # fmt: skip
    scores = {"by": {"distance": even, "temperature": bins}, "worst": {}, "n": 18}
    return msgspec.convert({"about": about, "models": {"basic": scores}}, Comparison)


def find_places(*q, commands):
    (section,) = (each for each in build_sections(compared(*q), commands=commands) if each.key == PLACES)
    return section


def test_terminal_shows_conditions_with_significant_bias_and_names_the_others():
    section = find_places(0.01, 0.9, commands=False)
    assert [table.title for table in section.tables] == ["Errors by temperature"]
    assert section.text.startswith("No significant bias by distance;")


def test_terminal_names_conditions_where_nothing_is_significant():
    section = find_places(0.9, 0.9, commands=False)
    assert not section.tables
    assert "distance, temperature" in section.text


def test_page_shows_every_condition_with_minus_signs():
    section = find_places(0.01, 0.9, commands=True)
    assert [table.title for table in section.tables] == ["Errors by distance", "Errors by temperature"]
    assert section.text == ""
    assert [row.name for row in section.tables[1].rows] == ["−5 to 0", "0 to 5"]


def test_dash_in_a_table_of_worst_rides_is_explained():
    known = {"ride": "m3#1", "vehicle_id": "m3", "vehicle_model": "m3", "date": "2023-05-06", "distance_km": 2.0}
    known |= {"ambient_c": 9.0, "average_speed_kmh": 20.0, "measured_kwh": 0.1, "predicted_kwh": 0.3, "error_kwh": 0.2}
    result = compared(0.9, 0.9)
    for relative, explained in ((None, True), (2.0, False)):
        rides = {"absolute": [known | {"relative": relative}], "relative": []}
        model = replace(result.models["basic"], worst=msgspec.convert(rides, WorstRides))
        table, _ = tabulate_worst_rides(replace(result, models={"basic": model}), "basic", commands=False)
        notes = [note for note in table.notes if note.startswith("–: unknown; a relative error is given only of rides")]
        assert bool(notes) == explained


def make_bins(*biases):
    return [
        {"bin": label, "n": 7, "bias_kwh": {"value": bias, "ci95": half}, "mae_kwh": 0.2, "mae_ci95_kwh": 0.05}
        for label, (bias, half) in zip(("-5 to 0", "0 to 5", "5 to 10"), biases, strict=True)
    ]


def test_conditions_are_points_with_intervals_and_counts_on_one_scale():
    cold, far = make_bins((0.1, 0.02), (-0.3, 0.1), (0.5, None)), make_bins((0.05, 0.9), (0.0, 0.01), (0.1, 0.1))
    drawn = illustrate_conditions(
        msgspec.convert({"models": {"basic": {"by": {"temperature": cold, "distance": far}}}}, Comparison)
    )
    assert [one.title for one in drawn] == ["Bias and error by temperature", "Bias and error by distance"]
    bias, error = drawn[0].figure.data
    assert list(bias.y) == ["−5 to 0 (7)", "0 to 5 (7)"]
    assert (list(bias.x), list(bias.error_x.array)) == ([0.1, -0.3], [0.02, 0.1])
    assert list(error.error_x.array) == [0.05, 0.05]
    assert {bias.mode, error.mode} == {"markers"}
    scales = [one.figure.layout.xaxis.range for one in drawn]
    assert scales[0] == scales[1] == pytest.approx((-0.42, 0.42))
    for one in drawn:
        assert_axes_are_titled(one.figure)


def test_bias_of_two_sets_is_drawn_where_it_has_an_interval():
    entry = {
        "bin": "0 to 5",
        "bias_kwh": {
            "first": {"value": 0.1, "ci95": 0.1}, "second": {"value": 0.9, "ci95": None},
            "difference": {"value": 0.8, "ci95": None},
        },
    }  # fmt: skip
    against = msgspec.convert({"models": {"basic": {"by": {"temperature": [entry]}}}}, DatasetContrast)
    [one] = illustrate_datasets(against)
    first, second = one.figure.data
    assert (list(first.y), list(second.y)) == (["0 to 5"], [])
    assert_axes_are_titled(one.figure)
