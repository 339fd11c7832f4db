"""Test the report of cars that deviate or change: sentences, commands and figures."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from socast.core.diagnose.inference.window_columns import CAR_DIRECTIONS, SHAPES
from socast.core.diagnose.records import EstimatedCoefficient, UnknownCause
from socast.tools.commands.diagnose import insert_commands
from socast.tools.report.diagnosis.figures import draw_deviations
from socast.tools.report.diagnosis.finding_words import (
    DIRECTIONS,
    describe_deviation,
    describe_deviations,
    describe_spread,
)
from socast.tools.report.diagnosis.page import print_step
from socast.tools.report.diagnosis.sentences import (
    describe_next_step,
    describe_suggestion,
    describe_unknown,
    describe_verdict,
)
from socast.tools.terminal.ride_source import RideSource
from tests.support.diagnosis_result import (
    make_deviation,
    make_diagnosis,
    make_empty_diagnosis,
    make_ranked_car,
    make_unknown_cause,
)


def test_change_is_stated_with_size_date_and_causes():
    first, sure, amounts, *remedies = describe_deviation(make_deviation())
    assert first == (
        "taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): "
        "low tyre pressure 52 %, brake drag 41 %"
    )
    assert sure == "- real with a probability of more than 99.9 %"
    assert amounts == "- +6.2 Wh/km, +12.1 kWh per month of the rides that were diagnosed"
    assert remedies == [
        "- to distinguish the causes, record drives with loads that differ",
        "- if it is low tyre pressure: soft tyres: rolling resistance is higher by 16 ± 5 % of 0.010",
    ]


def test_ramp_is_stated_as_a_rate():
    rate = {"share_per_month": 0.02, "share_per_month_ci95": [0.01, 0.03]}
    first, *_ = describe_deviation(make_deviation(kind="ramp", **rate))
    assert first.startswith("taxi-005 uses 2.0 ± 1.0 % more each month since 14 November 2018")


def test_short_ramp_is_stated_by_its_days_and_not_by_months():
    rate = {"share_per_month": 0.02, "share_per_month_ci95": [0.01, 0.03]}
    first, _, amounts, *_ = describe_deviation(make_deviation(kind="ramp", days=6.0, **rate))
    assert first.startswith("taxi-005 uses 0.4 ± 0.2 % more after a growth over 6 days, since 14 November 2018")
    assert amounts == "- +6.2 Wh/km, +0.398 kWh a day of the rides that were diagnosed"
    assert "month" not in first + amounts


def test_less_energy_of_all_cars_is_called_less():
    changed = make_deviation(of="all", who="all", share=-0.03, share_ci95=[-0.04, -0.02])
    assert describe_deviation(changed)[0].startswith("All cars use 3.0 ± 1.0 % less since")


def make_change(**changes):
    """Return a diagnosis that finds no effect but a change."""
    none = [{"effect": "none", "probability": 0.97}]
    return make_empty_diagnosis(causes=none, unknown=[make_unknown_cause()], deviations=[make_deviation(**changes)])


def test_change_is_the_headline_and_its_command_the_next_step():
    result = insert_commands(make_change(), "base.json", RideSource([Path("tables")]))
    first, sure, common = describe_verdict(result)[:3]
    assert first.startswith("Finding: taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018")
    assert "probability of more than 99.9 %" in sure
    assert common.startswith("No effect of the library is missing in all cars (97 %)")
    advice, command = describe_next_step(result)
    assert advice.endswith("add tyre_pressure in taxi-005 since 2018-11-14.")
    assert command == result.deviations[0].command


def test_change_follows_the_effect_that_is_missing_everywhere():
    result = make_diagnosis()
    assert describe_verdict(result)[0].startswith("cold_rolling or air_density is missing in all cars")
    assert any(line.startswith("Finding: taxi-005") for line in describe_verdict(result))
    assert any(line.startswith("Then test the finding") for line in describe_next_step(result))


def test_headline_says_what_the_size_of_a_change_means():
    several = describe_verdict(make_change())[0]
    assert several.endswith(
        "If it is low tyre pressure: soft tyres: rolling resistance is higher by 16 ± 5 % of 0.010."
    )
    causes = [{"effect": "tyre_pressure", "probability": 1.0}]
    assert describe_verdict(make_change(causes=causes))[0].endswith(
        "low tyre pressure 100 %. Soft tyres: rolling resistance is higher by 16 ± 5 % of 0.010."
    )


def test_interval_that_contains_zero_is_given_by_its_ends():
    result = make_change(share_ci95=[-0.01, 0.05])
    assert describe_deviations(result)[0].startswith("taxi-005 uses 4.1 % more (95 % interval −1.0 to 5.0 %) since")


def test_step_of_the_automatic_loop_states_the_change_that_it_adds():
    console = Console(width=200, file=StringIO())
    print_step(make_change(), 1, make_change().deviations[0], console)
    assert "Finding: taxi-005 uses 4.1 ± 0.9 % more" in console.file.getvalue()


def test_change_of_uncertain_size_is_neither_headline_nor_next_step():
    result = make_change(share_ci95=[-0.01, 0.05])
    assert not any("Finding" in line for line in describe_verdict(result))
    assert describe_next_step(result) == [
        "Record more rides: how much taxi-005 uses more or less is not certain.",
        *describe_next_step(make_empty_diagnosis())[1:],
    ]
    assert any("contains zero: record more rides" in line for line in describe_deviations(result))


@pytest.mark.parametrize(("changes", "held"), [({"kind": "ramp"}, "a growth"), ({"of": "group"}, "a group")])
def test_change_that_no_term_holds_is_to_be_checked(changes, held):
    rate = {"share_per_month": 0.02, "share_per_month_ci95": [0.01, 0.03]}
    (line,) = describe_next_step(make_change(columns=[], **changes, **rate))
    assert line.startswith("Check taxi-005 for low tyre pressure since 2018-11-14")
    assert f"no term of a model holds {held}" in line


def test_effect_of_implausible_size_is_told_as_a_cause_outside_the_library():
    cause = UnknownCause(
        formula="cold_rolling at 5.0 times its largest plausible coefficient",
        probability=1.0,
        energy_share=0.07,
        energy_share_ci95=(0.05, 0.09),
        coefficient=EstimatedCoefficient(value=0.0015, unit="1/K"),
        resembles="cold_rolling",
    )
    result = make_empty_diagnosis(unknown=[cause])
    (line,) = describe_unknown(cause)
    assert "of the energy, like cold_rolling at 5.0 times its largest plausible coefficient; c = 0.0015" in line
    assert "resembles" not in line
    assert describe_suggestion(result) == []
    assert "--suggest" not in describe_next_step(result)[0]


def test_many_causes_are_counted():
    causes = [{"effect": f"cause_{i}", "probability": 0.2, "shown_by": ""} for i in range(5)]
    assert describe_deviation(make_deviation(causes=causes))[0].endswith(
        ": cause 0 20 %, cause 1 20 %, cause 2 20 %, or one of 2 others"
    )


def test_small_or_uncertain_deviation_of_a_car_is_not_described():
    assert describe_spread(make_ranked_car("taxi-1", 0.01)) == ""
    assert describe_spread(make_ranked_car("taxi-1", 0.03)).startswith("taxi-1 rolls harder than its siblings by 1.2")


def test_every_direction_in_which_cars_differ_has_words():
    assert set(DIRECTIONS) == {*SHAPES, *CAR_DIRECTIONS}


def test_nothing_found_is_said():
    quiet = make_diagnosis(deviations=[], cars=[make_ranked_car("taxi-1", 0.001)])
    assert describe_deviations(quiet) == [
        "No car deviates from its siblings beyond the spread between cars, and nothing changed."
    ]
    assert describe_deviations(make_empty_diagnosis()) == []


def test_command_adds_a_step_and_not_a_ramp():
    result = make_diagnosis(deviations=[make_deviation(), make_deviation(kind="ramp", columns=[])])
    result = insert_commands(result, "base.json", RideSource())
    step, ramp = result.deviations
    assert "socast add tyre_pressure" in step.command
    assert "--scope vehicle=taxi-005 --scope since=2018-11-14" in step.command
    assert ramp.command is None


def test_figures_show_cars_and_the_change_with_their_intervals():
    cars, change = draw_deviations(make_diagnosis())
    (points,) = cars.figure.data
    assert list(points.y) == ["taxi-005 (named)", "taxi-002"]
    assert points.error_x.array[0] > 0.0
    step = change.figure.data[-1]
    assert (min(step.y), max(step.y)) == pytest.approx((0.0, 4.1))
    assert change.caption.startswith("taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018")
