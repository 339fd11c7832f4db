"""Test the progress of plans: only rides use up legs, and later plans wait for their shift."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.outlook import OVERTIME
from socast.core.forecast.plan_tracker import PLAN_LAG, PROLONGATION, SHORTEST_RIDE, ActivePlan, PlanTracker
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Leg, Plan
from tests.support.fleet_days import (
    CARS,
    DAY,
    DAYS,
    LEG,
    LEGS,
    PERIOD,
    RESERVE,
    RIDE,
    SHIFT,
    START,
    columns,
    plan,
    shift,
    speeds,
    trained_pipeline,
)
from tests.support.telemetry import make_message

CAR = "c"
LANE = CARS.index(CAR)
BEGIN = float(columns(CAR, DAYS)["time_s"][0])
LENGTHS = RIDE * speeds(CAR, DAYS) / 1000.0
"""Length of each leg. [km]"""


def at(passed, pipeline=None, sent=None, inserted=()):
    """Return a pipeline that has received a shift up to a time [s], with messages inserted at other times."""
    pipeline = pipeline or trained_pipeline()
    stream = [*shift(CAR, DAYS, sent), *((BEGIN + time, message) for time, message in inserted)]
    pipeline.push([m for time, m in sorted(stream, key=lambda each: each[0]) if time <= BEGIN + passed])
    return pipeline


def known(pipeline, lane=LANE):
    """Return what is left of the plan."""
    return pipeline.engine.plans.get_remaining_legs(lane, float(pipeline.engine.state["time"][lane])).plan


def left(pipeline):
    """Return the lengths of the legs that are left. [km]"""
    return [leg.distance_km for leg in known(pipeline).legs]


@given(st.floats(PERIOD, SHIFT))
def test_remaining_legs_are_the_planned_less_the_driven(passed):
    done, into = int(min(passed // LEG, LEGS - 1)), min(passed % LEG, RIDE)
    lengths = left(at(passed))
    if passed % LEG > RIDE + PERIOD:
        assert lengths == pytest.approx(LENGTHS[done + 1 :])
    elif into < RIDE - PERIOD and into > 2.0 * PERIOD:
        assert lengths[1:] == pytest.approx(LENGTHS[done + 1 :])
        driven = speeds(CAR, DAYS)[done] * into / 1000.0
        assert lengths[0] == pytest.approx(LENGTHS[done] - driven, abs=1.3)  # later by a forecast and a sample


def test_leg_in_progress_keeps_its_pace_and_climb():
    legs = [{"distance_km": 6.0, "duration_s": 600.0, "gained_m": 80.0}, {"distance_km": 2.0, "duration_s": 300.0}]
    inserted = [(1.0, make_message("plan", CAR, BEGIN, shift_end_s=BEGIN + SHIFT, reserve_soc_pct=RESERVE, legs=legs))]
    first, second = known(at(300.0, inserted=inserted)).legs
    share = first.distance_km / 6.0
    assert 0.2 < share < 0.8
    assert (first.duration_s, first.gained_m, first.lost_m) == (
        pytest.approx(600.0 * share),
        pytest.approx(80.0 * share),
        None,
    )
    assert (second.distance_km, second.duration_s) == (2.0, 300.0)


def test_ride_longer_than_its_leg_uses_up_only_that_leg():
    legs = [{"distance_km": 1.0, "duration_s": 100.0}, {"distance_km": 2.0, "duration_s": 300.0}]
    inserted = [(1.0, make_message("plan", CAR, BEGIN, shift_end_s=BEGIN + SHIFT, reserve_soc_pct=RESERVE, legs=legs))]
    assert left(at(RIDE - PERIOD, inserted=inserted)) == [0.0, 2.0]
    assert left(at(RIDE + 2.0 * PERIOD, inserted=inserted)) == [2.0]


def test_more_rides_than_legs_leave_no_legs():
    inserted = [(1.0, plan(CAR, DAYS, BEGIN + 1.0, 1))]
    pipeline = at(SHIFT, inserted=inserted)
    assert left(pipeline) == []
    assert pipeline.engine.plans.progress[LANE]["planned"] == 1.0
    assert pipeline.engine.plans.progress[LANE]["leg_km"] == 0.0


def test_false_start_uses_up_no_leg():
    sent = columns(CAR, DAYS)
    pause = int((RIDE + 4.0 * PERIOD) / PERIOD)
    sent["ride_id"][pause : pause + 3] = "by mistake"
    sent["speed_kmh"][pause : pause + 2] = 3.6 * SHORTEST_RIDE * 1000.0 / (6.0 * PERIOD)
    assert left(at(LEG - PERIOD, sent=sent)) == pytest.approx(LENGTHS[1:])
    far = sent["speed_kmh"].copy()
    far[pause : pause + 2] = 60.0
    assert left(at(LEG - PERIOD, sent=sent | {"speed_kmh": far})) == pytest.approx(LENGTHS[2:])


@pytest.mark.parametrize("before", [-30.0, 0.0, 0.5 * PLAN_LAG, 2.0 * PLAN_LAG, 0.9 * RIDE])
def test_plan_sent_as_a_ride_ends_keeps_its_first_leg(before):
    """`before` is the time from the plan of the remaining legs to the end of the first ride. [s]"""
    came = RIDE - before
    pipeline = at(LEG - PERIOD, inserted=[(came, plan(CAR, DAYS, BEGIN + came, LEGS - 1))])
    meant = LEGS - 1 if before < PLAN_LAG else LEGS - 2
    assert left(pipeline) == pytest.approx(LENGTHS[LEGS - meant :])


@pytest.mark.parametrize("came", [0.5 * RIDE, RIDE - PERIOD, RIDE + 1.0, RIDE + 40.0, RIDE + 200.0])
def test_distance_before_a_plan_does_not_count_for_its_legs(came):
    """A ride in progress counts from the arrival of the plan; the next one counts from its beginning."""
    pipeline = trained_pipeline()
    at(came, pipeline, inserted=[(came, plan(CAR, DAYS, BEGIN + came, LEGS))])
    assert left(pipeline) == pytest.approx(LENGTHS, abs=0.9)
    if came > RIDE:
        pipeline = at(LEG + 0.5 * RIDE, inserted=[(came, plan(CAR, DAYS, BEGIN + came, LEGS))])
        driven = speeds(CAR, DAYS)[1] * 0.5 * RIDE / 1000.0
        assert left(pipeline)[0] == pytest.approx(max(LENGTHS[0] - driven, 0.0), abs=1.0)


def test_newest_plan_replaces_the_one_before():
    pipeline = at(20.0 * PERIOD, inserted=[(10.0 * PERIOD, plan(CAR, DAYS, BEGIN + 150.0, 2, reserve_soc_pct=33.0))])
    assert known(pipeline).reserve_soc_pct == 33.0
    assert len(known(pipeline).legs) == 2


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_plan_with_wrong_clock_blocks_no_later_plan_even_after_restart(factor):
    """The wrong clock counts milliseconds or nanoseconds."""
    pipeline, wrong = at(20.0 * PERIOD), factor * BEGIN
    pipeline.push([make_message("plan", CAR, wrong, shift_end_s=wrong, reserve_soc_pct=44.0, legs=[])])
    kept = Pipeline(settings=pipeline.settings)
    kept.restore(pipeline.snapshot())
    now = BEGIN + 21.0 * PERIOD
    kept.push([plan(CAR, DAYS, now, 2, reserve_soc_pct=33.0)])
    assert (known(kept).reserve_soc_pct, len(known(kept).legs)) == (33.0, 2)
    kept.push([plan(CAR, DAYS, now - 1.0, 3, reserve_soc_pct=55.0)])
    assert known(kept).reserve_soc_pct == 33.0
    assert kept.quality()["undecodable"] == {"plan_in_the_past": 1}


def tomorrow(came, last=LEGS, **changed):
    """Return the plan of the next day's shift, sent on this day."""
    fields = {"shift_end_s": START + DAY * (DAYS + 1) + SHIFT, "reserve_soc_pct": 44.0}
    return plan(CAR, DAYS + 1, BEGIN + came, last, **(fields | changed))


@pytest.mark.parametrize("came", [1.0, 0.5 * RIDE, LEG + RIDE + 100.0])
def test_plan_of_tomorrow_waits_and_keeps_the_plan_of_today(came):
    passed = came + 100.0
    plain, both = at(passed), at(passed, inserted=[(came, tomorrow(came))])
    assert known(both) == known(plain)
    assert both.ask(CAR) == plain.ask(CAR)
    assert both.engine.plans.later[LANE].reserve_soc_pct == 44.0


def test_plan_of_tomorrow_is_not_used_today_without_another_plan():
    answers = []
    for inserted in ([], [(BEGIN + 30.0, tomorrow(30.0))]):
        pipeline = trained_pipeline()
        sent = sorted([*shift(CAR, DAYS, planned=False), *inserted], key=lambda each: each[0])
        pipeline.push([m for time, m in sent if time <= BEGIN + LEG])
        answers.append(pipeline.ask(CAR))
    assert answers[0] == answers[1]
    assert answers[0].shift_end_s < START + DAY * (DAYS + 1)


def test_plan_of_today_may_arrive_after_that_of_tomorrow():
    inserted = [(1.0, tomorrow(1.0)), (30.0, plan(CAR, DAYS, BEGIN + 30.0, reserve_soc_pct=31.0))]
    assert known(at(60.0, inserted=inserted)).reserve_soc_pct == 31.0


def followed(cuts):
    """Return the pipeline and its forecasts of a day planned the day before, with batches cut at `cuts`."""
    pipeline = trained_pipeline()
    next_day = [m for _, m in shift(CAR, DAYS + 1, planned=False)]
    sent = sorted([*shift(CAR, DAYS), (BEGIN + LEG, tomorrow(LEG))], key=lambda each: each[0])
    messages, out = [*(m for _, m in sent), *next_day[: int(2.5 * LEG / PERIOD)]], []
    for start, stop in zip([0, *cuts], [*cuts, len(messages)], strict=True):
        out += pipeline.push(messages[start:stop])
        if stop == 600:
            kept = pipeline.snapshot()
            pipeline = trained_pipeline()
            pipeline.restore(kept)
    return pipeline, out


def test_plan_of_tomorrow_is_in_force_tomorrow():
    pipeline, out = followed([])
    assert known(pipeline).reserve_soc_pct == 44.0
    lengths = RIDE * speeds(CAR, DAYS + 1) / 1000.0
    assert left(pipeline)[1:] == pytest.approx(lengths[3:])
    assert LANE not in pipeline.engine.plans.later
    end = START + DAY * (DAYS + 1) + SHIFT
    assert pipeline.ask(CAR).shift_end_s == end
    for cuts in ([600], list(range(1, 700, 7))):
        assert followed(cuts)[1] == out


@given(st.floats(0.0, 0.5), st.floats(0.5, 1.0))
def test_later_of_two_plans_of_tomorrow_is_kept(first, second):
    inserted = [
        (first * SHIFT, tomorrow(first * SHIFT)),
        (second * SHIFT, tomorrow(second * SHIFT, reserve_soc_pct=55.0)),
    ]
    pipeline = at(SHIFT, inserted=inserted)
    assert pipeline.engine.plans.later[LANE].reserve_soc_pct == 55.0


@pytest.mark.parametrize(("longer", "waits"), [(PROLONGATION - 60.0, False), (PROLONGATION + 60.0, True)])
def test_shift_is_prolonged_by_the_limit_at_most(longer, waits):
    end = START + DAY * DAYS + SHIFT + longer
    pipeline = at(60.0, inserted=[(30.0, plan(CAR, DAYS, BEGIN + 30.0, shift_end_s=end))])
    assert (LANE in pipeline.engine.plans.later) == waits
    assert pipeline.ask(CAR).shift_end_s == (START + DAY * DAYS + SHIFT if waits else end)


def test_shift_may_be_shortened_at_any_time():
    cut = plan(CAR, DAYS, BEGIN + 30.0, shift_end_s=BEGIN + 60.0, legs=[])
    assert at(90.0, inserted=[(30.0, cut)]).ask(CAR).legs == []


def test_plan_that_is_over_does_not_delay_the_next():
    """A plan is over at its end when all legs are done, and otherwise after its overtime."""
    tracker = at(SHIFT + 2.0 * PERIOD).engine.plans
    planned, over = tracker.plans[LANE], START + DAY * DAYS + SHIFT
    assert planned.is_over(over + 1.0)
    assert not planned.is_over(over - 1.0)
    late = planned._replace(done=LEGS - 1)
    assert not late.is_over(over + OVERTIME)
    assert late.is_over(over + OVERTIME + 1.0)


def test_unusable_plan_keeps_the_one_before():
    wrong = [
        plan(CAR, DAYS, BEGIN + 30.0, reserve_soc_pct=120.0),
        plan(CAR, DAYS, BEGIN + 30.0, shift_end_s=START),
        plan(CAR, DAYS, BEGIN + 30.0, legs=[{"distance_km": -3.0, "duration_s": 60.0}]),
    ]
    pipeline = at(20.0 * PERIOD, inserted=[(30.0, message) for message in wrong])
    assert known(pipeline).reserve_soc_pct == RESERVE
    assert sum(pipeline.quality()["undecodable"].values()) == 3


def test_plan_alone_makes_no_forecast_and_unknown_car_has_no_legs():
    pipeline = trained_pipeline()
    assert pipeline.engine.plans.get_remaining_legs(97, START) is None
    unheard = make_message("plan", "z", START, shift_end_s=START + SHIFT, reserve_soc_pct=RESERVE, legs=[])
    assert pipeline.push([unheard]) == []
    assert pipeline.engine.plans.get_remaining_legs(pipeline.lanes.find("z"), START).plan.legs == []


def test_state_whose_legs_have_fewer_energies_is_refused():
    plans, *others = msgspec.msgpack.decode(msgspec.msgpack.encode(at(300.0).engine.plans.dump()))
    assert plans
    for active in plans:
        active[4] = [each[: len(each) // 2] for each in active[4]]
    with pytest.raises(ValueError, match="reshape"):
        PlanTracker().load([plans, *others])


@pytest.mark.parametrize(
    ("km", "minutes", "done"),
    [
        (5.1, 11.0, 1),  # the next leg, with the errors of a plan
        (8.3, 16.0, 2),  # the leg after it, whose passenger came
        (3.1, 7.0, 3),
        (8.3, 40.0, 1),  # as long, but not as fast: another ride took the place of the next one
        (20.0, 30.0, 1),
    ],
)
def test_ride_is_the_leg_that_it_is_like(km, minutes, done):
    legs = [Leg(each, 60.0 * time) for each, time in ((5.0, 10.0), (8.0, 15.0), (3.0, 7.0), (20.0, 30.0))]
    assert ActivePlan(Plan(CAR, 0.0, 9000.0, RESERVE, legs)).count_done(km, 60.0 * minutes) == done


def test_last_legs_are_counted_once():
    plan = Plan(CAR, 0.0, 9000.0, RESERVE, [Leg(5.0, 600.0)])
    assert ActivePlan(plan, done=1).count_done(5.0, 600.0) == 1
