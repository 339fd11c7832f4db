"""Test forecasts with planned charges: until the next one, and over it to the end of the shift."""

from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.conformal import BASES, BY_PLAN, OVER_CHARGE, TO_CHARGE
from socast.core.wire.messages import Plan
from tests.support.fleet_days import (
    CARS,
    CHARGED_LEG,
    DAYS,
    LEG,
    LEGS,
    RESERVE,
    SETTINGS,
    columns,
    columns_with_charge,
    forecasts,
    idle_morning,
    plan,
    plan_with_charge,
    shift,
    trained_pipeline,
)
from tests.support.telemetry import chunked

CAR = "c"
LANE = CARS.index(CAR)
BEGIN = float(columns(CAR, DAYS)["time_s"][0])
ARRIVES = LEG * CHARGED_LEG + 60.0
DEPARTS = LEG * (CHARGED_LEG + 1)


def stream(to_pct=90.0, planned_pct=90.0, sends=True, also=()):
    """Return the messages of a shift with a charge and its plan, with their times."""
    first, *rest = shift(CAR, DAYS, columns_with_charge(CAR, DAYS, to_pct, sends), planned=False)
    told = (BEGIN, plan_with_charge(CAR, DAYS, BEGIN, planned_pct))
    return sorted([first, told, *rest, *also], key=lambda each: each[0])


def run(messages, cuts=(), pipeline=None):
    """Return a pipeline that has received messages, and its forecasts by time since the shift began."""
    pipeline = pipeline or trained_pipeline()
    out = [m for chunk in chunked([m for _, m in messages], cuts) for m in pipeline.push(chunk)]
    return pipeline, {time - BEGIN: each for time, each in forecasts(out, CAR).items()}


@cache
def whole_day(sends=True):
    return run(stream(sends=sends))


def progress(pipeline):
    return pipeline.engine.plans.progress[LANE]


def test_forecast_tells_the_next_charge_and_the_end_after_it():
    _, published = whole_day()
    before = [each for passed, each in published.items() if 60.0 < passed < ARRIVES - 60.0]
    arrival = columns_with_charge(CAR, DAYS)["soc_pct"][int(ARRIVES / 15.0) - 1]
    end = columns_with_charge(CAR, DAYS)["soc_pct"][-1]
    assert len(before) > 30
    for each in before:
        assert abs(each.next_charge.soc_pct.mean - arrival) < 4.0
        assert each.next_charge.soc_pct.p95 <= each.soc_pct + 1e-9
        assert abs(each.next_charge.time_s - BEGIN - ARRIVES) < 900.0
        assert each.soc_end_of_shift_pct.p05 < end < each.soc_end_of_shift_pct.p95
        assert abs(each.soc_end_of_shift_pct.mean - end) < 8.0
        assert 0.0 <= each.next_charge.reserve_risk <= each.reserve_risk + 1e-9


@pytest.mark.parametrize("sends", [True, False])
def test_charge_is_done_when_the_car_has_departed(sends):
    pipeline, published = whole_day(sends)
    later = [each for passed, each in published.items() if passed > DEPARTS + 180.0]
    assert len(later) > 20
    assert all(each.next_charge is msgspec.UNSET for each in later)
    assert all(each.soc_end_of_shift_pct.p95 <= each.soc_pct + 1e-9 for each in later)
    assert progress(pipeline)["charges"] == 0.0
    assert pipeline.engine.plans.plans[LANE].charged == 1


def test_car_at_the_charger_is_forecast_to_charge_as_planned():
    _, published = whole_day()
    there = [each for passed, each in published.items() if ARRIVES + 150.0 < passed < DEPARTS - 120.0]
    after = next(each for passed, each in published.items() if passed > DEPARTS + 180.0)
    assert there
    assert all(each.next_charge is msgspec.UNSET for each in there)
    assert all(abs(each.soc_end_of_shift_pct.mean - after.soc_end_of_shift_pct.mean) < 4.0 for each in there)


def test_charge_after_charging_is_not_below_the_charge_on_arrival():
    _, low = run(stream(planned_pct=30.0)[:60])
    _, none = run([*shift(CAR, DAYS)][:60])
    passed = max(low)
    assert low[passed].soc_end_of_shift_pct.mean > 50.0
    assert low[passed].soc_end_of_shift_pct.mean == pytest.approx(none[passed].soc_end_of_shift_pct.mean, abs=8.0)


def test_rides_and_charges_use_up_legs_in_whatever_order():
    other = plan_with_charge(CAR, DAYS, BEGIN)
    legs = msgspec.json.decode(other.payload)["legs"]
    legs.insert(0, legs.pop(CHARGED_LEG))
    first = [(time, m) for time, m in stream() if not m.key.endswith("/plan")]
    pipeline, _ = run([first[0], (BEGIN, plan(CAR, DAYS, BEGIN, legs=legs)), *first[1:]])
    active = pipeline.engine.plans.plans[LANE]
    assert (active.done, active.charged, progress(pipeline)["legs"]) == (LEGS - 1, 1, 0.0)


def test_short_plugging_in_and_a_charge_before_the_plan_use_up_no_charge():
    sent = columns_with_charge(CAR, DAYS)
    sent["charging"][:] = False
    sent["charging"][int(ARRIVES / 15.0) : int(ARRIVES / 15.0) + 2] = True
    first, *rest = shift(CAR, DAYS, sent | {"soc_pct": columns(CAR, DAYS)["soc_pct"]}, planned=False)
    pipeline, _ = run([first, (BEGIN, plan_with_charge(CAR, DAYS, BEGIN)), *rest])
    assert progress(pipeline)["charges"] == 1.0
    late = (BEGIN + DEPARTS - 30.0, plan_with_charge(CAR, DAYS, BEGIN + DEPARTS - 30.0))
    pipeline, _ = run(stream(also=[late]))
    assert progress(pipeline)["charges"] == 1.0


def learned_of(pipeline):
    """Return the number of forecasts by basis that the day's shifts have taught."""
    errors = pipeline.engine.statistics.errors.values()
    known = [each.basis for of_lane in errors for each in of_lane if np.isfinite(each.scores).any()]
    return [known.count(basis) for basis in range(BASES)]


def test_errors_before_and_over_a_charge_count_for_classes_of_their_own():
    pipeline, _ = run(stream())
    before = learned_of(pipeline)
    assert before[TO_CHARGE] == 1
    pipeline.engine.finish(interrupted=True)
    after = learned_of(pipeline)
    assert after[OVER_CHARGE] == 1
    plain, _ = run(shift(CAR, DAYS))
    plain.engine.finish(interrupted=True)
    assert learned_of(plain)[BY_PLAN] == after[BY_PLAN]  # once it has departed, no charge is ahead
    assert learned_of(plain)[TO_CHARGE] == learned_of(plain)[OVER_CHARGE] == 0


def test_errors_until_a_charge_are_those_of_the_reading_before_it():
    pipeline, _ = run([each for each in stream() if each[0] <= BEGIN + ARRIVES + 30.0])
    records = pipeline.engine.log.get_records(LANE)
    to_charge = records[records["basis"] == TO_CHARGE]
    assert len(to_charge) == (records["basis"] == OVER_CHARGE).sum() > 3
    arrival = columns_with_charge(CAR, DAYS)["soc_pct"][int(ARRIVES / 15.0) - 1] / 100.0
    run([each for each in stream() if each[0] > BEGIN + ARRIVES + 30.0], pipeline=pipeline)
    (scores,) = [each.scores for each in pipeline.engine.statistics.errors[LANE] if each.basis == TO_CHARGE]
    outcomes = to_charge["mean"] + scores * to_charge["sd"]
    assert outcomes == pytest.approx(np.full(len(scores), arrival), abs=0.0051)  # a step later than the last forecast


def test_what_charging_reaches_is_learned_for_the_next_day():
    pipeline, _ = run(stream(to_pct=80.0, planned_pct=95.0))
    learned = pipeline.engine.statistics.charged_soc
    assert learned.expect(np.array([0.95]))[0] == pytest.approx(0.95)
    pipeline.push(idle_morning(DAYS + 1))
    reached, variance = learned.expect(np.array([0.95]))
    assert 0.8 < reached[0] < 0.93
    assert 0.0 < variance[0] < 0.2**2


@cache
def forecast_whole(sends):
    """Return the messages of a stream, and its forecasts without cuts."""
    messages = [m for _, m in stream(sends=sends)]
    return messages, [m.payload for m in trained_pipeline().push(messages)]


@given(st.lists(st.integers(0, 490), max_size=5), st.booleans())
def test_cuts_and_restarts_change_no_forecast_with_charges(cuts, sends):
    messages, expected = forecast_whole(sends)
    pipeline, payloads = trained_pipeline(), []
    for chunk in chunked(messages, cuts):
        payloads += [m.payload for m in pipeline.push(chunk)]
        again = trained_pipeline()
        again.restore(pipeline.snapshot())
        pipeline = again
    assert payloads == expected


def test_query_equals_forecast_with_a_charge_ahead_and_at_the_charger():
    pipeline = trained_pipeline(settings=SETTINGS._replace(forecast_time=3.0))
    messages = [m for _, m in stream()]
    seen = set()
    for start in range(0, len(messages), 11):
        published = forecasts(pipeline.push(messages[start : start + 11]), CAR)
        newest, answer = published[max(published)], pipeline.ask(CAR)
        assert list_figures(answer) == pytest.approx(list_figures(newest), rel=1e-9, abs=1e-9)
        seen.add(newest.next_charge is msgspec.UNSET)
        levels = [leg.soc_pct for leg in answer.legs]
        assert all(0.0 <= level.p05 <= level.mean <= level.p95 <= 100.0 for level in levels)
        charges = [leg for leg in answer.legs if leg.is_charge()]
        assert all(leg.charge_to_soc_pct == 90.0 and leg.energy_kwh is None for leg in charges)
        assert len(charges) == int(progress(pipeline)["charges"])
    assert seen == {True, False}


def list_figures(told):
    """Return the figures that a forecast and an answer have in common."""
    charge, end = told.next_charge, told.soc_end_of_shift_pct
    until = (
        []
        if charge is msgspec.UNSET
        else [charge.time_s, charge.reserve_risk, *msgspec.structs.astuple(charge.soc_pct)]
    )
    return [told.reserve_risk, *msgspec.structs.astuple(end), *until]


def test_answer_without_time_for_a_charge_still_tells_the_rest():
    """The queried plan may begin and end with a charge, and have several."""
    pipeline, _ = run(stream()[:100])
    charge = {"duration_s": 600.0, "charge_to_soc_pct": 85.0}
    ride = {"distance_km": 6.0, "duration_s": 600.0}
    for legs in (
        [charge],
        [charge, ride],
        [ride, charge],
        [ride, charge, ride, charge, ride, charge],
        [charge, charge],
    ):
        given = plan(CAR, DAYS, BEGIN, legs=legs)
        told = msgspec.json.decode(given.payload) | {"reserve_soc_pct": RESERVE}
        answer = pipeline.ask(CAR, None, msgspec.convert(told, Plan))
        assert [not leg.is_charge() for leg in answer.legs] == ["distance_km" in leg for leg in legs]
        assert answer.why_not is None
        assert 40.0 < answer.soc_end_of_shift_pct.mean <= 100.0
        assert answer.next_charge.time_s > answer.time_s
