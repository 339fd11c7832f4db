"""Test the report of cars that deviate or change: sentences, commands and figures."""

import pytest

from tests.support.diagnosis_result import make_deviation, make_diagnosis, make_empty_diagnosis, make_ranked_car
from tools.commands.diagnose import insert_commands
from tools.report.diagnosis.deviation_figures import draw_deviations
from tools.report.diagnosis.deviations import describe_deviation, describe_deviations, describe_spread


def test_change_is_stated_with_size_date_and_causes():
    first, amounts, *remedies = describe_deviation(make_deviation())
    assert first == (
        "taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): "
        "low tyre pressure 52 %, brake drag 41 %"
    )
    assert amounts == "- +6.2 Wh/km, +12.1 kWh per month of the rides that were diagnosed"
    assert remedies == ["- to distinguish the causes, record drives with loads that differ"]


def test_ramp_is_stated_as_a_rate():
    rate = {"share_per_month": 0.02, "share_per_month_ci95": [0.01, 0.03]}
    first, *_ = describe_deviation(make_deviation(kind="ramp", **rate))
    assert first.startswith("taxi-005 uses 2.0 ± 1.0 % more each month since 14 November 2018")


def test_less_energy_of_all_cars_is_called_less():
    changed = make_deviation(of="all", who="all", share=-0.03, share_ci95=[-0.04, -0.02])
    assert describe_deviation(changed)[0].startswith("All cars use 3.0 ± 1.0 % less since")


def test_many_causes_are_counted():
    causes = [{"effect": f"cause_{i}", "probability": 0.2, "shown_by": ""} for i in range(5)]
    assert describe_deviation(make_deviation(causes=causes))[0].endswith(
        ": cause 0 20 %, cause 1 20 %, cause 2 20 %, or one of 2 others"
    )


def test_small_or_uncertain_deviation_of_a_car_is_not_described():
    assert describe_spread(make_ranked_car("taxi-1", 0.01)) == ""
    assert describe_spread(make_ranked_car("taxi-1", 0.03)).startswith("taxi-1 rolls harder than its siblings by 1.2")


def test_nothing_found_is_said():
    quiet = make_diagnosis(deviations=[], cars=[make_ranked_car("taxi-1", 0.001)])
    assert describe_deviations(quiet) == [
        "No car deviates from its siblings beyond the spread between cars, and nothing changed."
    ]
    assert describe_deviations(make_empty_diagnosis()) == []


def test_command_adds_a_step_and_not_a_ramp():
    result = make_diagnosis(deviations=[make_deviation(), make_deviation(kind="ramp", columns=[])])
    insert_commands(result, "base.json", [])
    step, ramp = result["deviations"]
    assert "socast add tyre_pressure" in step["command"]
    assert "--scope vehicle=taxi-005 --scope since=2018-11-14" in step["command"]
    assert "command" not in ramp


def test_figures_show_cars_and_the_change_with_their_intervals():
    cars, change = draw_deviations(make_diagnosis())
    (points,) = cars.figure.data
    assert list(points.y) == ["taxi-005 (named)", "taxi-002"]
    assert points.error_x.array[0] > 0.0
    step = change.figure.data[-1]
    assert (min(step.y), max(step.y)) == pytest.approx((0.0, 4.1))
    assert change.caption.startswith("taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018")
