"""Test the answers of outlook queries: the queried ride, the legs after it, and why a figure is unknown."""

from functools import cache
from math import nan

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from socast.core.errors import AskError
from socast.core.forecast.learning.consumption_terms import WAITING
from socast.core.forecast.learning.plan_outcomes import PlanOutcomes
from socast.core.forecast.outlook import DEFAULT_RESERVE
from socast.core.forecast.plan_tracker import LONGEST_SHIFT
from socast.core.wire.messages import Interval, Leg, Plan, encode
from tests.support.fleet_days import (
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
    columns,
    forecasts,
    shift,
    speeds,
    trained_pipeline,
)
from tests.support.telemetry import make_message

CAR = "c"
BEGIN = float(columns(CAR, DAYS)["time_s"][0])
QUERIED_RIDE = Leg(8.0, 700.0)


def at(passed, number=DAYS, planned=True):
    """Return a pipeline that has received a shift up to a time [s], and its forecasts, one per sample."""
    pipeline = trained_pipeline(
        number, planned=planned and number == DAYS, settings=SETTINGS._replace(forecast_time=3.0)
    )
    begin = float(columns(CAR, number)["time_s"][0])
    sent = shift(CAR, number, planned=planned)
    out = pipeline.push([m for time, m in sent if time <= begin + passed])
    return pipeline, forecasts(out, CAR)


@cache
def one_at(passed):
    """Return a pipeline as `at` does, for queries only."""
    return at(passed)[0]


def left(pipeline):
    """Return what is left of the plan."""
    lane = CARS.index(CAR)
    return pipeline.engine.plans.get_remaining_legs(lane, float(pipeline.engine.state["time"][lane])).plan


def means(legs):
    return [leg.soc_pct.mean for leg in legs]


def moments(planned=True, number=DAYS, inserted=()):
    """Yield a pipeline every few minutes of a shift, with its newest forecast."""
    pipeline = trained_pipeline(number, planned=planned, settings=SETTINGS._replace(forecast_time=3.0))
    sent = [*shift(CAR, number, planned=planned), *inserted]
    messages = [message for _, message in sorted(sent, key=lambda each: each[0])]
    for start in range(0, len(messages), 11):
        published = forecasts(pipeline.push(messages[start : start + 11]), CAR)
        yield pipeline, published[max(published)]


def same(answer, newest):
    """Return whether an answer equals a forecast, up to the rounding of sums in another order."""
    figures = []
    for each in (answer, newest):
        end = each.soc_end_of_shift_pct or Interval(nan, nan, nan)
        risk = nan if each.reserve_risk is None else each.reserve_risk
        figures.append((each.time_s, end.mean, end.p05, end.p95, risk))
    return figures[0] == pytest.approx(figures[1], rel=1e-9, abs=1e-9, nan_ok=True)


def test_query_without_ride_equals_forecast_throughout_the_shift():
    for pipeline, newest in moments():
        answer = pipeline.ask(CAR)
        assert (answer.vehicle_id, answer.asked, answer.why_not) == (CAR, None, None)
        assert same(answer, newest)
        assert answer.soc_pct == pytest.approx(newest.soc_pct)
        assert answer.soc_sd_pct == pytest.approx(newest.soc_sd_pct)
        assert answer.reserve_soc_pct == RESERVE
        assert answer.shift_end_s == pytest.approx(START + DAY * DAYS + SHIFT, abs=60.0)
        assert answer.consumption_scale == pytest.approx(1.0, abs=0.4)
        assert 20.0 < answer.usable_capacity_kwh < 26.0
        assert answer.usable_capacity_sd_kwh > 0.0


def test_legs_and_waiting_take_the_energy_by_which_the_charge_falls():
    for pipeline, _ in moments():
        answer = pipeline.ask(CAR)
        fall = 0.01 * (answer.soc_pct - answer.soc_end_of_shift_pct.mean) * answer.usable_capacity_kwh
        legs = sum(leg.energy_kwh.mean for leg in answer.legs)
        assert legs + answer.waiting_energy_kwh == pytest.approx(fall, abs=0.15 + 0.02 * fall)
        assert answer.waiting_energy_kwh >= 0.0
    assert pipeline.ask(CAR, QUERIED_RIDE).waiting_energy_kwh is not None
    assert at(0.0, planned=False)[0].ask(CAR).waiting_energy_kwh is None


def test_query_with_the_remaining_plan_equals_forecast():
    for pipeline, newest in moments():
        assert same(pipeline.ask(CAR, None, left(pipeline)), newest)


def test_query_without_plan_equals_forecast_by_history():
    published = [(same(pipeline.ask(CAR), newest), newest) for pipeline, newest in moments(False, 7)]
    assert all(agrees for agrees, _ in published)
    assert sum(newest.reserve_risk is not None for _, newest in published) > 0.9 * len(published)


@pytest.mark.parametrize("passed", [RIDE / 2.0, RIDE + 100.0, 4.0 * LEG + 250.0, SHIFT - 20.0])
def test_queried_ride_equals_a_plan_with_that_ride(passed):
    pipeline, _ = at(passed)
    pipeline.engine.statistics.plan_outcomes = PlanOutcomes()  # rides of a question are driven, those of plans may not
    rest, answer = left(pipeline), pipeline.ask(CAR, QUERIED_RIDE)
    under_way = passed % LEG < RIDE
    with_it = [*rest.legs[:under_way], QUERIED_RIDE, *rest.legs[under_way:]]
    planned = pipeline.ask(CAR, None, msgspec.structs.replace(rest, legs=with_it))
    assert astuple(answer.soc_end_of_shift_pct) == pytest.approx(astuple(planned.soc_end_of_shift_pct))
    assert answer.reserve_risk == pytest.approx(planned.reserve_risk)
    assert answer.shift_end_s == planned.shift_end_s
    plan = make_message("plan", CAR, answer.time_s, **msgspec.to_builtins(msgspec.structs.replace(rest, legs=with_it)))
    pipeline.push([plan])
    with_plan = pipeline.ask(CAR)
    assert astuple(with_plan.soc_end_of_shift_pct) == pytest.approx(astuple(answer.soc_end_of_shift_pct))


@pytest.mark.parametrize("minutes", [2.0, 15.0, 40.0, 120.0])
def test_ride_that_takes_time_only_never_raises_the_end_where_cars_drive_home(minutes):
    pipeline, _ = at(RIDE + 100.0)
    outcomes = PlanOutcomes()
    for _ in range(50):
        outcomes.add_shift(np.array([[4.0, 1.0, 0.8]]), np.array([5.8]))
    outcomes.apply_daily_update()
    assert outcomes.factor[2] > 0.5
    pipeline.engine.statistics.plan_outcomes = outcomes
    without, with_ride = pipeline.ask(CAR), pipeline.ask(CAR, Leg(0.5, 60.0 * minutes))
    assert with_ride.soc_end_of_shift_pct.mean <= without.soc_end_of_shift_pct.mean


@pytest.mark.parametrize("planned", [True, False])
def test_ride_of_the_length_of_the_range_reaches_the_reserve_with_even_odds(planned):
    pipeline, published = at(4.0 * LEG + RIDE + 100.0, planned=planned)  # between two rides
    km = published[max(published)].range_km
    pace = pipeline.engine.statistics.get_tables(CARS.index(CAR)).ride_pace

    def risk_of(distance):
        return pipeline.ask(CAR, Leg(distance, 60.0 * pace * distance)).asked.reserve_risk

    assert km.p05 < km.mean < km.p95
    assert risk_of(km.mean) == pytest.approx(0.5, abs=0.1)
    assert risk_of(km.p05) == pytest.approx(0.05, abs=0.1)  # the spread is that at the mean
    assert risk_of(km.p95) == pytest.approx(0.95, abs=0.25)


@pytest.mark.parametrize("legs", [[], [Leg(4.0, 400.0), Leg(6.0, 600.0)]])
def test_without_time_left_the_last_ride_ends_the_shift(monkeypatch, legs):
    """Empty ways count for each leg as they do for the end of the shift."""
    pipeline = one_at(RIDE + 100.0)
    now, usual = pipeline.ask(CAR).time_s, pipeline.engine.statistics.compute_usual
    near, far = [], []
    for approach, answers in ((0.0, near), (0.5, far)):
        changed = {"approach_energy": np.array([approach])}
        monkeypatch.setattr(
            pipeline.engine.statistics, "compute_usual", lambda *of, changed=changed: usual(*of)._replace(**changed)
        )
        answer = pipeline.ask(CAR, QUERIED_RIDE, Plan(CAR, now, now, RESERVE, legs))
        last, end = [answer.asked, *answer.legs][-1].soc_pct, answer.soc_end_of_shift_pct
        assert last.mean == pytest.approx(end.mean)
        assert end.p05 <= last.p05 <= last.p95 <= end.p95 + 0.1  # [%]; how far the car drives home is not certain
        answers[:] = means([answer.asked, *answer.legs])
    assert [a - b > 1.0 * number for number, (a, b) in enumerate(zip(near, far, strict=True), 1)] == [True] * len(near)


levels = st.tuples(st.floats(0.05, 40.0), st.floats(1.0, 10.0), st.none() | st.floats(0.0, 60.0))
descents = st.tuples(st.floats(1.0, 8.0), st.floats(1.0, 4.0), st.floats(600.0, 1500.0))


def leg_of(drawn):
    km, pace, lost = drawn
    return Leg(km, 60.0 * pace * km, None if lost is None else 0.0, lost)


@given(
    st.lists(st.one_of(levels, descents).map(leg_of), max_size=12),
    st.none() | levels.map(leg_of),
    st.floats(-250.0, 30_000.0),
    st.sampled_from([60.0, RIDE + 100.0, 4.0 * LEG + 250.0]),
)
def test_charge_never_rises_along_legs_and_shift_lasts_as_long_as_they_do(legs, query, ahead, passed):
    pipeline = one_at(passed)
    now = float(pipeline.engine.state["time"][CARS.index(CAR)])
    answer = pipeline.ask(CAR, query, Plan(CAR, now, now + ahead, RESERVE, legs))
    place = passed % LEG < RIDE and bool(legs)
    order = answer.legs if query is None else [*answer.legs[:place], answer.asked, *answer.legs[place:]]
    charges = [*(each.soc_pct for each in order), answer.soc_end_of_shift_pct]
    rises = [each.energy_kwh.mean < 0.0 for each in order[1:]]
    for rise, before, after in zip([*rises, False], charges[:-1], charges[1:], strict=False):
        assert after.p05 <= after.mean <= after.p95
        if not rise:
            assert before.p05 >= after.p05
            assert before.mean >= after.mean
            assert before.p95 >= after.p95
    assert answer.shift_end_s >= max(now, now + sum(each.duration_s for each in order) - 1e-6)
    assert answer.shift_end_s >= now + ahead
    for each, leg in zip(answer.legs, legs, strict=True):
        assert each.energy_kwh.p05 <= each.energy_kwh.mean <= each.energy_kwh.p95
        assert leg.lost_m or each.energy_kwh.p05 >= 0.0


def test_long_descent_returns_energy_and_raises_the_charge():
    pipeline = one_at(RIDE + 100.0)
    up, down = Leg(8.0, 900.0, 900.0, 0.0), Leg(8.0, 900.0, 0.0, 900.0)
    answer = pipeline.ask(CAR, None, Plan(CAR, BEGIN, BEGIN + SHIFT, RESERVE, [up, down]))
    first, second = answer.legs
    assert first.energy_kwh.mean > 2.0
    assert -3.9 < second.energy_kwh.mean < 0.0  # a car of 1.6 t returns at most this on 900 m
    assert second.soc_pct.mean > first.soc_pct.mean


@given(st.floats(1.0, 30.0), st.floats(0.1, 10.0), st.sampled_from([60.0, 700.0, 2.0 * LEG + 300.0]))
def test_longer_queried_ride_lowers_the_end_more(km, more, passed):
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
@pytest.mark.parametrize("leg", [None, QUERIED_RIDE])
def test_legs_are_in_order_and_charge_falls_leg_by_leg(passed, leg):
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


def test_uphill_ride_takes_more_energy():
    pipeline, _ = at(60.0)
    level, uphill = (pipeline.ask(CAR, Leg(8.0, 700.0, gained, 0.0)) for gained in (0.0, 300.0))
    assert uphill.asked.energy_kwh.mean > level.asked.energy_kwh.mean
    assert uphill.asked.soc_pct.mean < level.asked.soc_pct.mean


def test_query_changes_no_state():
    pipeline, _ = at(2.0 * LEG)
    before = pipeline.snapshot()
    other = Plan(CAR, BEGIN, BEGIN + SHIFT, 50.0, [Leg(3.0, 300.0)])
    answer = pipeline.ask(CAR, QUERIED_RIDE, other)
    assert pipeline.snapshot() == before
    assert [leg.distance_km for leg in answer.legs] == [3.0]
    assert answer.reserve_soc_pct == 50.0
    assert len(pipeline.ask(CAR).legs) == LEGS - 2
    assert answer.soc_end_of_shift_pct.mean > pipeline.ask(CAR, QUERIED_RIDE).soc_end_of_shift_pct.mean


def test_query_with_the_published_plan_gives_the_same_answer():
    pipeline, _ = at(RIDE + 100.0)
    assert pipeline.ask(CAR, QUERIED_RIDE, left(pipeline)) == pipeline.ask(CAR, QUERIED_RIDE)


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"shift_end_s": BEGIN - 7200.0}, "plan_in_the_past"),
        ({"shift_end_s": BEGIN + 60.0 * DAY}, "plan_too_far_ahead"),
        ({"shift_end_s": BEGIN + LONGEST_SHIFT + 120.0}, "plan_too_far_ahead"),
        ({"reserve_soc_pct": -1.0}, "out_of_range"),
        ({"legs": [Leg(-1.0, 60.0)]}, "out_of_range"),
        ({"legs": [Leg(1.0, 60.0)] * 10_000}, "too_many_legs"),
    ],
)
def test_unusable_plan_of_a_query_is_refused(changed, cause):
    pipeline, _ = at(60.0)
    fields = {"shift_end_s": BEGIN + SHIFT, "reserve_soc_pct": RESERVE, "legs": []} | changed
    with pytest.raises(AskError) as caught:
        pipeline.ask(CAR, None, Plan(CAR, BEGIN, **fields))
    assert caught.value.cause == cause
    assert "\n" not in str(caught.value)


def test_car_without_samples_is_unknown():
    pipeline, _ = at(60.0)
    pipeline.push([make_message("vehicle", "mute", BEGIN, model="nissan-leaf-2013")])
    for name in ("nobody", "mute"):
        with pytest.raises(AskError, match="has sent nothing") as caught:
            pipeline.ask(name)
        assert caught.value.cause == "unknown_vehicle"


def silent():
    pipeline = trained_pipeline()
    sent = columns(CAR, DAYS)
    sent["soc_pct"][:] = float("nan")
    pipeline.push([m for _, m in shift(CAR, DAYS, sent)][:50])
    return pipeline


def of_model(model):
    """Return a pipeline to which a car of a vehicle model sent part of its shift."""
    pipeline = trained_pipeline()
    sent = [m for _, m in shift(CAR, DAYS)][:50]
    pipeline.push([make_message("vehicle", CAR, BEGIN, model=model), *sent])
    return pipeline


@pytest.mark.parametrize(
    ("pipeline", "why"),
    [
        (silent, "reports no state of charge"),
        (lambda: of_model("unheard-of"), "the vehicle model 'unheard-of' is not in the catalogue"),
        (lambda: at(900.0, 2, planned=False)[0], "no plan is known, and this car has ended too few shifts"),
    ],
    ids=["no charge", "no model", "no plan"],
)
def test_answer_states_why_a_figure_is_unknown(pipeline, why):
    answer = pipeline().ask(CAR, QUERIED_RIDE)
    assert answer.soc_end_of_shift_pct is None
    assert answer.reserve_risk is None
    assert answer.asked.soc_pct is None
    assert why in answer.why_not
    assert "\n" not in answer.why_not


def test_model_without_rides_has_a_forecast_with_a_wide_interval():
    first, learned = of_model("kia-soul-ev-2015").ask(CAR), of_model("nissan-leaf-2013").ask(CAR)
    assert first.why_not is None
    one, other = first.soc_end_of_shift_pct, learned.soc_end_of_shift_pct
    assert one.p95 - one.p05 > other.p95 - other.p05


def test_without_plan_the_shift_continues_as_usual_after_the_ride():
    pipeline = trained_pipeline(7, planned=False)
    pipeline.push([m for _, m in shift(CAR, 7, planned=False)][:100])
    plain, queried = pipeline.ask(CAR), pipeline.ask(CAR, QUERIED_RIDE)
    assert plain.why_not is None
    assert plain.legs == []
    assert queried.soc_end_of_shift_pct.mean < plain.soc_end_of_shift_pct.mean
    assert queried.asked.soc_pct.mean > queried.soc_end_of_shift_pct.mean


def test_shift_longer_than_usual_has_no_forecast_but_its_ride_has():
    pipeline, sent = trained_pipeline(7, planned=False), columns(CAR, 7, hours=SHIFT / 3600.0 + 2.0)
    messages = shift(CAR, 7, sent, planned=False)
    out = forecasts(pipeline.push([m for _, m in messages]), CAR)
    plain, queried = pipeline.ask(CAR), pipeline.ask(CAR, QUERIED_RIDE)
    assert out[max(out)].soc_end_of_shift_pct is plain.soc_end_of_shift_pct is plain.shift_end_s is None
    assert "already longer than every earlier one" in plain.why_not
    assert plain.reserve_soc_pct == queried.reserve_soc_pct == 100.0 * DEFAULT_RESERVE
    assert queried.shift_end_s == queried.time_s + QUERIED_RIDE.duration_s
    assert queried.soc_end_of_shift_pct == pytest.approx(queried.asked.soc_pct)
    assert 0.0 <= queried.reserve_risk <= 1.0
    assert queried.why_not is None


def test_waiting_plan_is_given_as_the_reason():
    pipeline, _ = at(900.0, 2, planned=False)
    later = START + DAY * 3 + SHIFT
    pipeline.push([make_message("plan", CAR, START + DAY * 2, shift_end_s=later, reserve_soc_pct=30.0, legs=[])])
    answer = pipeline.ask(CAR)
    assert "the plan that is known is of a later shift" in answer.why_not
    assert answer.reserve_soc_pct == 100.0 * DEFAULT_RESERVE


def test_after_all_legs_the_rest_of_the_shift_is_waiting():
    pipeline = one_at(60.0)
    now = pipeline.ask(CAR).time_s
    answer = pipeline.ask(CAR, None, Plan(CAR, now, now + 7200.0, RESERVE, []))
    waiting = 2.0 * pipeline.engine.statistics.get_tables(CARS.index(CAR)).standing_power.max()
    assert answer.legs == []
    assert 0.0 <= answer.soc_pct - answer.soc_end_of_shift_pct.mean < 100.0 * waiting / 20.0
    assert answer.shift_end_s == now + 7200.0


def pause_for(tables, hours):
    """Return tables in which an idle period lasts so long on average."""
    idle = tables.mix.idle.copy()
    idle[WAITING] = hours * tables.mix.idle_periods
    return tables._replace(mix=tables.mix._replace(idle=idle))


@pytest.mark.parametrize("passed", [60.0, RIDE + 100.0])
@pytest.mark.parametrize("usual", [0.0, 0.1, 0.4])
def test_wait_before_a_leg_is_never_longer_than_usual(monkeypatch, passed, usual):
    """The legs equal those of a shift with less spare time, and the end is that of the plan."""
    pipeline, lane = one_at(passed), CARS.index(CAR)
    tables, tracker = pipeline.engine.statistics.get_tables(lane), pipeline.engine.plans
    now = float(pipeline.engine.state["time"][lane])
    plan = Plan(CAR, now, now + 7200.0, RESERVE, [Leg(4.0, 480.0)] * 3)
    driving = tracker.get_remaining_legs(lane, now, plan).seconds.sum()
    waits = 3 - tracker.is_riding(lane)

    def answer_with(hours, pause):
        monkeypatch.setattr(pipeline.engine.statistics, "get_tables", lambda _: pause_for(tables, pause))
        end = now + driving + 3600.0 * hours * waits
        return pipeline.ask(CAR, None, msgspec.structs.replace(plan, shift_end_s=end))

    even, delayed, soon = answer_with(0.5, np.inf), answer_with(0.5, usual), answer_with(usual, np.inf)
    assert means(delayed.legs) == pytest.approx(means(soon.legs))
    assert means(delayed.legs)[-1] > means(even.legs)[-1]
    assert msgspec.structs.replace(delayed, legs=[]) == msgspec.structs.replace(even, legs=[])
    assert [each.energy_kwh for each in delayed.legs] == [each.energy_kwh for each in even.legs]
    assert answer_with(0.5, 0.6) == even


def test_energy_of_waiting_is_less_certain_than_that_of_driving(monkeypatch):
    """Of two answers with equal energies, the one that spends them on waits has the wider interval."""
    pipeline, answers = one_at(RIDE + 100.0), []
    lane, usual = CARS.index(CAR), pipeline.engine.statistics.compute_usual
    now, tables = float(pipeline.engine.state["time"][lane]), pipeline.engine.statistics.get_tables(lane)
    monkeypatch.setattr(pipeline.engine.statistics, "get_tables", lambda _: pause_for(tables, 0.5))
    plan = Plan(CAR, now, now + 3.0 * (480.0 + 1800.0), RESERVE, [Leg(4.0, 480.0)] * 3)
    for standing, approach in ((0.0, 0.6), (1.2, 0.0)):
        changed = {"standing_power": np.array([standing]), "approach_energy": np.array([approach])}
        monkeypatch.setattr(
            pipeline.engine.statistics, "compute_usual", lambda *of, changed=changed: usual(*of)._replace(**changed)
        )
        answers.append([leg.soc_pct for leg in pipeline.ask(CAR, None, plan).legs])
    surer, less = answers
    assert [each.mean for each in surer] == pytest.approx([each.mean for each in less])
    more = [(b.mean - b.p05) - (a.mean - a.p05) for a, b in zip(surer, less, strict=True)]
    assert min(more[:-1]) > 0.1  # the last leg ends with the shift, whose total waiting time is known


def test_answer_in_the_middle_of_a_leg_is_encoded():
    pipeline = at(LEG + RIDE / 2.0)[0]
    assert encode(pipeline.ask(CAR, QUERIED_RIDE)).startswith(b'{"vehicle_id"')
