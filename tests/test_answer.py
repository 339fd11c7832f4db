"""Answers: the ride that is asked for, the legs after it, and why a figure is not known."""

import pytest
from conftest import told
from fleet_days import (
    CARS,
    DAY,
    DAYS,
    LEG,
    LEGS,
    RESERVE,
    RIDE,
    SETTINGS,
    SHIFT,
    START,
    again,
    columns,
    forecasts,
    shift,
    speeds,
)
from hypothesis import given
from hypothesis import strategies as st

from core.codec import Leg, Plan, encode
from core.errors import AskError

CAR = "c"
BEGIN = float(columns(CAR, DAYS)["time_s"][0])
RIDE_ASKED = Leg(8.0, 700.0)


def at(passed, number=DAYS, planned=True):
    """Return a pipeline that has heard a shift so far [s], and the forecasts of it, one a sample."""
    pipeline = again(number, planned=planned and number == DAYS, settings=SETTINGS._replace(forecast_time=3.0))
    begin = float(columns(CAR, number)["time_s"][0])
    sent = shift(CAR, number, planned=planned)
    out = pipeline.push([m for time, m in sent if time <= begin + passed])
    return pipeline, forecasts(out, CAR)


def means(legs):
    return [leg.soc_pct.mean for leg in legs]


@pytest.mark.parametrize("passed", [60.0, RIDE / 2.0, RIDE + 100.0, 4.0 * LEG + 250.0, SHIFT - 200.0])
def test_without_a_ride_it_says_what_the_forecast_says(passed):
    pipeline, told_so_far = at(passed)
    newest, answer = told_so_far[max(told_so_far)], pipeline.ask(CAR)
    assert (answer.vehicle_id, answer.time_s, answer.asked, answer.why_not) == (CAR, newest.time_s, None, None)
    assert answer.soc_pct == pytest.approx(newest.soc_pct)
    assert answer.soc_sd_pct == pytest.approx(newest.soc_sd_pct)
    for name in ("mean", "p05", "p95"):
        said, foretold = (getattr(each.soc_end_of_shift_pct, name) for each in (answer, newest))
        assert said == pytest.approx(foretold, abs=0.3), name  # the rest of a ride is a ride of its own in the answer
    assert answer.reserve_risk == pytest.approx(newest.reserve_risk, abs=0.001)
    assert (answer.reserve_soc_pct, answer.shift_end_s) == (RESERVE, START + DAY * DAYS + SHIFT)
    assert answer.consumption_scale == pytest.approx(1.0, abs=0.4)
    assert 20.0 < answer.usable_capacity_kwh < 26.0
    assert answer.usable_capacity_sd_kwh > 0.0


@given(st.floats(1.0, 30.0), st.floats(0.1, 10.0), st.sampled_from([60.0, 700.0, 2.0 * LEG + 300.0]))
def test_the_ride_that_is_asked_for_lowers_the_end_and_a_longer_one_lowers_it_more(km, more, passed):
    pipeline, _ = at(passed)
    plain, one, longer = (
        pipeline.ask(CAR, leg) for leg in (None, Leg(km, 90.0 * km), Leg(km + more, 90.0 * (km + more)))
    )
    assert plain.soc_end_of_shift_pct.mean > one.soc_end_of_shift_pct.mean > longer.soc_end_of_shift_pct.mean
    assert plain.reserve_risk <= one.reserve_risk <= longer.reserve_risk
    assert one.asked.energy_kwh.mean < longer.asked.energy_kwh.mean
    assert (one.asked.distance_km, one.asked.duration_s) == (km, 90.0 * km)
    assert one.asked.energy_kwh.p05 <= one.asked.energy_kwh.mean <= one.asked.energy_kwh.p95


@pytest.mark.parametrize("passed", [60.0, RIDE + 100.0, 4.0 * LEG + 250.0])
@pytest.mark.parametrize("leg", [None, RIDE_ASKED])
def test_legs_come_in_order_and_the_charge_falls_leg_by_leg(passed, leg):
    pipeline, _ = at(passed)
    riding = passed % LEG < RIDE
    answer = pipeline.ask(CAR, leg)
    lengths = [each.distance_km for each in answer.legs]
    done = int(passed // LEG) + (not riding)
    planned = (RIDE * speeds(CAR, DAYS) / 1000.0).tolist()[done:]
    assert lengths[riding:] == pytest.approx(planned[riding:])
    assert lengths[0] <= planned[0] + 1e-9
    order = answer.legs if leg is None else [*answer.legs[:riding], answer.asked, *answer.legs[riding:]]
    charges = means(order)
    assert charges == sorted(charges, reverse=True)
    assert charges[0] < answer.soc_pct
    assert charges[-1] >= answer.soc_end_of_shift_pct.mean - 1e-9
    for each in order:
        assert each.soc_pct.p05 <= each.soc_pct.mean <= each.soc_pct.p95


def test_a_ride_uphill_takes_more():
    pipeline, _ = at(60.0)
    level, uphill = (pipeline.ask(CAR, Leg(8.0, 700.0, gained, 0.0)) for gained in (0.0, 300.0))
    assert uphill.asked.energy_kwh.mean > level.asked.energy_kwh.mean
    assert uphill.asked.soc_pct.mean < level.asked.soc_pct.mean


def test_a_question_changes_nothing():
    pipeline, _ = at(2.0 * LEG)
    before = pipeline.snapshot()
    other = Plan(CAR, BEGIN, BEGIN + SHIFT, 50.0, [Leg(3.0, 300.0)])
    asked = pipeline.ask(CAR, RIDE_ASKED, other)
    assert pipeline.snapshot() == before
    assert [leg.distance_km for leg in asked.legs] == [3.0]
    assert asked.reserve_soc_pct == 50.0
    assert len(pipeline.ask(CAR).legs) == LEGS - 2
    assert asked.soc_end_of_shift_pct.mean > pipeline.ask(CAR, RIDE_ASKED).soc_end_of_shift_pct.mean


def test_a_plan_in_the_question_that_is_the_known_one_is_answered_the_same():
    pipeline, _ = at(RIDE + 100.0)
    known, legs = pipeline.foresight.courses.left(CARS.index(CAR))
    same = Plan(CAR, known.time_s, known.shift_end_s, known.reserve_soc_pct, legs)
    assert pipeline.ask(CAR, RIDE_ASKED, same) == pipeline.ask(CAR, RIDE_ASKED)


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"shift_end_s": BEGIN - 7200.0}, "plan_in_the_past"),
        ({"shift_end_s": BEGIN + 60.0 * DAY}, "plan_too_far_ahead"),
        ({"reserve_soc_pct": -1.0}, "out_of_range"),
        ({"legs": [Leg(-1.0, 60.0)]}, "out_of_range"),
        ({"legs": [Leg(1.0, 60.0)] * 10_000}, "too_many_legs"),
    ],
)
def test_a_plan_that_cannot_be_used_is_refused(changed, cause):
    pipeline, _ = at(60.0)
    fields = {"shift_end_s": BEGIN + SHIFT, "reserve_soc_pct": RESERVE, "legs": []} | changed
    with pytest.raises(AskError) as caught:
        pipeline.ask(CAR, None, Plan(CAR, BEGIN, **fields))
    assert caught.value.cause == cause
    assert "\n" not in str(caught.value)


def test_a_car_that_has_sent_nothing_is_not_known():
    pipeline, _ = at(60.0)
    pipeline.push([told("vehicle", "mute", BEGIN, model="nissan-leaf-2013")])
    for name in ("nobody", "mute"):
        with pytest.raises(AskError, match="has sent nothing") as caught:
            pipeline.ask(name)
        assert caught.value.cause == "unknown_vehicle"


def silent():
    pipeline = again()
    sent = columns(CAR, DAYS)
    sent["soc_pct"][:] = float("nan")
    pipeline.push([m for _, m in shift(CAR, DAYS, sent)][:50])
    return pipeline


def unlearned():
    pipeline = again()
    sent = [m for _, m in shift(CAR, DAYS)][:50]
    pipeline.push([told("vehicle", CAR, BEGIN, model="kia-soul-ev-2015"), *sent])
    return pipeline


@pytest.mark.parametrize(
    ("pipeline", "why"),
    [
        (silent, "reports no state of charge"),
        (unlearned, "no day of rides of this vehicle model"),
        (lambda: at(900.0, 2, planned=False)[0], "no plan is known, and too few shifts"),
        (lambda: at(900.0, 2)[0], "too few shifts have ended"),
    ],
    ids=["no charge", "no rides", "no plan", "no errors"],
)
def test_it_says_why_a_figure_is_not_known(pipeline, why):
    answer = pipeline().ask(CAR, RIDE_ASKED)
    assert answer.soc_end_of_shift_pct is None
    assert answer.reserve_risk is None
    assert answer.asked.soc_pct is None
    assert why in answer.why_not
    assert "\n" not in answer.why_not


def test_without_a_plan_the_shift_goes_on_after_the_ride_as_it_usually_does():
    pipeline = again(7, planned=False)
    pipeline.push([m for _, m in shift(CAR, 7, planned=False)][:100])
    plain, asked = pipeline.ask(CAR), pipeline.ask(CAR, RIDE_ASKED)
    assert plain.why_not is None
    assert plain.legs == []
    assert asked.soc_end_of_shift_pct.mean < plain.soc_end_of_shift_pct.mean
    assert asked.asked.soc_pct.mean > asked.soc_end_of_shift_pct.mean


def test_an_answer_in_the_middle_of_a_leg_travels():
    pipeline = at(LEG + RIDE / 2.0)[0]
    assert encode(pipeline.ask(CAR, RIDE_ASKED)).startswith(b'{"vehicle_id"')
