"""Test the forecast engine from messages to forecasts: learning, plans, and the effect of a faulty state of charge."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast import filter_state, soc_filter, soc_reading
from socast.core.forecast.engine import SHORT_SHIFT
from socast.core.forecast.learning.car_driver import DRIVER_SD, compute_driver_code
from socast.core.forecast.outlook import OVERTIME, PLAN_LEAD
from socast.core.forecast.soc_ahead import EMPTY_SOC
from socast.core.pipeline import Pipeline
from tests.support.fleet_days import (
    CAPACITY,
    CARS,
    DAY,
    DAYS,
    PERIOD,
    RESERVE,
    SETTINGS,
    SHIFT,
    START,
    columns,
    days,
    forecasts,
    idle_morning,
    merged,
    plan,
    shift,
    trained_pipeline,
)
from tests.support.telemetry import leaf, make_message, observed

pytestmark = pytest.mark.long

BEGIN = START + DAY * DAYS
SAMPLES = int(SHIFT / PERIOD) + 1
EACH = SETTINGS._replace(forecast_time=3.0)
"""Settings with a forecast for every sample."""
LEAST = 1.0 - 1e-6
"""Smallest ratio of the width of an interval to its width without the fault."""


def driven(car="c", sent=None, messages=None, settings=SETTINGS):
    """Return the pipeline and the forecasts of a car's shift on the day after the training days."""
    pipeline = trained_pipeline(settings=settings)
    out = pipeline.push([m for _, m in shift(car, DAYS, sent)] if messages is None else messages)
    return pipeline, forecasts(out, car)


@cache
def without_fault(car):
    """Return the forecasts for every sample of a car's shift without faults."""
    return driven(car, settings=EACH)[1]


def width(forecast):
    end = forecast.soc_end_of_shift_pct
    return end.p95 - end.p05


@pytest.mark.parametrize("car", CARS)
def test_end_of_shift_is_forecast_and_its_interval_shrinks(car):
    _, published = driven(car)
    end = columns(car, DAYS)["soc_pct"][-1]
    known = [each for each in published.values() if each.soc_end_of_shift_pct is not None]
    assert len(known) > 0.95 * len(published)
    for each in known:
        assert each.soc_end_of_shift_pct.p05 <= each.soc_end_of_shift_pct.mean <= each.soc_end_of_shift_pct.p95
        assert each.range_km.p05 <= each.range_km.mean <= each.range_km.p95
        assert each.reserve_risk == pytest.approx(0.0, abs=0.05)
    quarters = [[width(each) for each in part] for part in (known[:30], known[-60:-30], known[-25:])]
    assert np.mean(quarters[0]) > 1.3 * np.mean(quarters[1]) > 1.3**2 * np.mean(quarters[2])
    assert known[0].soc_end_of_shift_pct.mean == pytest.approx(end, abs=9.0)
    assert known[0].soc_end_of_shift_pct.p05 < end < known[0].soc_end_of_shift_pct.p95
    assert known[-1].soc_end_of_shift_pct.mean == pytest.approx(end, abs=1.0)


def test_higher_reserve_raises_risk_and_reduces_range():
    last = None
    for reserve in (10.0, 50.0, 55.0, 60.0, 95.0):
        messages = [m for _, m in shift("c", DAYS)]
        messages[1] = plan("c", DAYS, BEGIN + 14.0, reserve_soc_pct=reserve)
        _, published = driven(messages=messages[:60])
        now = list(published.values())[-1]
        if last is not None:
            assert now.reserve_risk >= last.reserve_risk
            assert now.range_km.mean < last.range_km.mean
            assert now.soc_end_of_shift_pct == last.soc_end_of_shift_pct
        last = now
    assert last.reserve_risk == pytest.approx(1.0, abs=0.02)


# faulty state of charge


def add_fault(sent, fault, begin, lasting, by):
    """Return a shift whose reported charge is faulty from a sample on, and the end of the fault [s]."""
    bad = {name: values.copy() for name, values in sent.items()}
    charge, end = bad["soc_pct"], min(begin + lasting, SAMPLES - 1)
    if fault == "frozen":
        charge[begin:end] = charge[begin - 1]
    elif fault == "absent":
        charge[begin:end] = np.nan
    elif fault == "spike":
        charge[begin] += by
        end = begin + 1
    else:
        charge[begin:] += by
        end = min(begin + int(soc_reading.JUMP_CONFIRMATION / PERIOD), SAMPLES - 1)
    return bad, sent["time_s"][end]


@pytest.mark.parametrize("car", ["a", "c"])
@pytest.mark.parametrize("fault", ["frozen", "absent", "spike", "jump"])
@given(begin=st.integers(2, SAMPLES - 3), lasting=st.integers(1, SAMPLES), by=st.sampled_from([-12.0, -7.0, 4.0]))
def test_faulty_soc_never_narrows_interval(car, fault, begin, lasting, by):
    sent = columns(car, DAYS)
    bad, over = add_fault(sent, fault, begin, lasting, by)
    good, (_, published) = without_fault(car), driven(car, bad, settings=EACH)
    assert good.keys() == published.keys()
    last = np.inf if fault in ("spike", "jump") else over
    for time in [t for t in good if sent["time_s"][begin] <= t < last]:
        assert published[time].soc_sd_pct >= LEAST * good[time].soc_sd_pct
        if good[time].soc_end_of_shift_pct is not None:
            assert width(published[time]) >= width(good[time]) - 0.05  # [%]; the present charge limits the upper bound


@pytest.mark.parametrize("fault", ["frozen", "absent", "spike", "jump"])
def test_forecast_recovers_after_faulty_soc(fault):
    sent = columns("c", DAYS)
    by = -7.0 if fault == "jump" else 0.0
    bad, over = add_fault(sent, fault, 150, 100, -7.0)
    (_, good), (_, published) = driven("c", sent), driven("c", bad)
    for time in [t for t in good if t > over + 1200.0 and t in published]:
        assert published[time].soc_pct - by == pytest.approx(good[time].soc_pct, abs=0.5)
        assert published[time].soc_end_of_shift_pct.mean - by == pytest.approx(
            good[time].soc_end_of_shift_pct.mean, abs=2.0
        )
        assert width(published[time]) < 1.6 * width(good[time]) or fault == "jump"  # either value may be right


def test_without_reported_soc_there_is_no_soc_forecast():
    sent = columns("c", DAYS) | {"soc_pct": np.full(SAMPLES, np.nan)}
    _, published = driven("c", sent)
    assert published
    assert all(each.soc_pct is None and each.soc_end_of_shift_pct is None for each in published.values())
    assert all(each.reserve_risk is None for each in published.values())


def test_filter_restarts_at_reported_soc_after_charging():
    sent = columns("c", DAYS)
    rests = np.flatnonzero(sent["ride_id"] == None)  # noqa: E711 - of each element
    plugged = rests[(rests > 220) & (rests < 245)][2:-2]
    sent["charging"] = np.isin(np.arange(SAMPLES), plugged)
    sent["soc_pct"] = sent["soc_pct"].copy()
    sent["soc_pct"][plugged] += np.linspace(1.0, 20.0, len(plugged)).round()
    sent["soc_pct"][plugged[-1] + 1 :] += 20.0
    pipeline, published = driven("c", sent)
    for time in [t for t in published if t > sent["time_s"][plugged[-1]]]:
        at = int(np.searchsorted(sent["time_s"], time))
        assert published[time].soc_pct == pytest.approx(sent["soc_pct"][at], abs=0.6)
    state = pipeline.engine.state[CARS.index("c")]
    assert state["charged"] == pytest.approx(sent["time_s"][plugged[-1]], abs=61.0)
    stepwise = trained_pipeline()
    for _, message in shift("c", DAYS, sent):
        stepwise.push([message])
        assert np.isnan(stepwise.engine.state["suspect"][CARS.index("c")])


def test_filter_restarts_at_reported_soc_in_next_shift():
    pipeline, _ = driven("c")
    out = forecasts(pipeline.push([m for _, m in shift("c", DAYS + 1)][:10]), "c")
    first = out[min(out)]
    assert first.soc_pct == pytest.approx(95.0, abs=0.01)
    assert first.soc_sd_pct == pytest.approx(100.0 * np.hypot(0.005 / np.sqrt(12.0), soc_reading.READING_SD), rel=0.01)


# learning


def test_daily_update_keeps_consumption_factor_of_each_car():
    trained = trained_pipeline()
    prior = trained.engine.statistics.prior[: len(trained.lanes)]
    always = np.array([0.15 * np.sin(ord(car)) for car in CARS])
    assert np.corrcoef(prior["mean"], always)[0, 1] > 0.8
    assert (prior["variance"] < filter_state.CAPACITY_SD**2 + 0.0136).all()
    assert (prior["variance"] < Pipeline().engine.statistics.factors.expect(-1).variance).all()


def test_capacity_is_learned_from_voltage_and_current():
    state = trained_pipeline().engine.state
    nominal = trained_pipeline().cars.capacity[-1]
    assert np.exp(state["log_capacity"][:2]) * nominal == pytest.approx(np.full(2, CAPACITY), rel=0.01)
    assert (np.sqrt(state["p_cc"][:2]) < 0.02).all()
    assert (np.sqrt(state["p_cc"][2:]) > 0.05).all()
    outlook = trained_pipeline().ask("a")
    assert outlook.usable_capacity_kwh == pytest.approx(CAPACITY, rel=0.01)
    assert outlook.usable_capacity_sd_kwh > soc_filter.METER_GAIN_SD * outlook.usable_capacity_kwh


@pytest.mark.parametrize("days_before", [0, 1, 2])
def test_first_days_have_forecasts_with_wide_intervals(days_before):
    pipeline = trained_pipeline(days_before)
    published = forecasts(pipeline.push([m for _, m in shift("c", days_before)]), "c")
    known = [each for each in published.values() if each.soc_end_of_shift_pct is not None]
    assert len(known) > 0.95 * len(published)
    assert width(known[0]) > 1.3 * width(list(driven("c")[1].values())[2])
    end = columns("c", days_before)["soc_pct"][-1]
    assert known[-1].soc_end_of_shift_pct.mean == pytest.approx(end, abs=1.0)


@pytest.mark.parametrize("sends", [True, False])
def test_first_forecast_of_a_shift_knows_its_temperature(sends):
    """By the car or by a station; a car that has sent nothing before has no temperature of yesterday either."""
    sent = columns("c", DAYS)
    sent["ambient_c"] = np.full(len(sent["time_s"]), -15.0 if sends else np.nan)
    sky = observed(time=BEGIN, temperature_c=-15.0)
    messages = [plan("c", DAYS, BEGIN), *(m for _, m in shift("c", DAYS, sent, planned=False))]
    for pipeline in (trained_pipeline(settings=EACH), Pipeline(settings=EACH)):
        out = forecasts(pipeline.push([leaf("c", BEGIN), sky, *messages[:9]]), "c")
        first, second = (each.soc_end_of_shift_pct.mean for each in [*out.values()][:2])
        assert first == pytest.approx(second, abs=3.0)


def test_without_plan_forecast_uses_earlier_shifts():
    pipeline = trained_pipeline(7, planned=False)
    published = forecasts(pipeline.push([m for _, m in shift("c", 7, planned=False)]), "c")
    early = [each for time, each in published.items() if 600.0 < time - START - 7.0 * DAY < 0.5 * SHIFT]
    assert early
    for each in early:
        assert each.soc_end_of_shift_pct.mean == pytest.approx(columns("c", 7)["soc_pct"][-1], abs=12.0)
        assert 0.0 <= each.reserve_risk <= 0.2


def test_car_without_plan_and_earlier_shifts_gets_no_forecast():
    pipeline = trained_pipeline(planned=False)
    messages = [
        m._replace(key=m.key.replace("/c/", "/new/"), payload=m.payload.replace(b'"c"', b'"new"'))
        for _, m in shift("c", DAYS, planned=False)
    ]
    published = forecasts(
        pipeline.push([make_message("vehicle", "new", BEGIN, model="nissan-leaf-2013"), *messages]), "new"
    )
    assert published
    assert all(each.soc_end_of_shift_pct is None and each.reserve_risk is None for each in published.values())
    assert published[max(published)].soc_pct is not None


@pytest.mark.parametrize("ahead", [-1200.0, 0.0, 1500.0])
def test_plan_is_ignored_before_its_lead_and_after_its_overtime(ahead):
    """`ahead` is the time from the stamp of the plan to the samples beside it. [s]"""
    sent = [m for _, m in shift("c", DAYS, planned=False)]
    came = float(columns("c", DAYS)["time_s"][100]) - ahead
    end = came + (SHIFT if ahead <= 0.0 else 0.0)
    late = make_message("plan", "c", came, shift_end_s=end, reserve_soc_pct=RESERVE, legs=[])
    published = forecasts(trained_pipeline().push([*sent[:102], late, *sent[102:]]), "c")
    plain = forecasts(trained_pipeline().push(sent), "c")
    known = {time for time, each in published.items() if each != plain[time]}
    first = float(columns("c", DAYS)["time_s"][100])
    assert known == {t for t in published if t > first and came - PLAN_LEAD <= t <= end + OVERTIME}
    assert known
    assert known < set(published)


@pytest.mark.parametrize("hours", [0.4, 1.5])
def test_short_shift_does_not_update_consumption_factors(hours):
    pipeline, lane = trained_pipeline(), CARS.index("c")
    pipeline.push([m for _, m in shift("c", DAYS, columns("c", DAYS, hours=hours))])
    pipeline.push(idle_morning(DAYS + 1))
    before = pipeline.engine.statistics.factors.expect(lane)
    pipeline.push([m for _, m in shift("c", DAYS + 2)][:5])
    pipeline.push(idle_morning(DAYS + 3))
    after = pipeline.engine.statistics.factors.expect(lane)
    assert (after == before) == (hours < SHORT_SHIFT)


def driven_by(*names):
    """Return the consumption factors after a shift; each driver is named after a number of its samples."""
    pipeline = trained_pipeline()
    sent = [m for _, m in shift("c", DAYS)]
    del sent[2]  # who drives
    begin = float(columns("c", DAYS)["time_s"][0])
    for at, name in sorted(names, reverse=True):
        sent.insert(at, make_message("ride", "c", begin, ride_id="c", event="start", driver_id=name))
    pipeline.push(sent)
    pipeline.push([m for _, m in shift("c", DAYS + 1)][:5])
    pipeline.push(idle_morning(DAYS + 2))
    return pipeline.engine.statistics.factors


def test_driver_named_before_first_sample_has_driven_the_shift():
    before, after = driven_by((0, "ana")), driven_by((2, "ana"))
    assert before.get_driver(compute_driver_code("ana"))[1] < DRIVER_SD**2
    assert before.dump() == after.dump() != driven_by().dump()


def test_shift_of_two_drivers_updates_only_the_car():
    shared = driven_by((0, "ana"), (100, "bo"))
    assert (
        shared.get_driver(compute_driver_code("ana"))
        == shared.get_driver(compute_driver_code("bo"))
        == (0.0, DRIVER_SD**2)
    )
    assert shared.dump() == driven_by().dump()
    assert driven_by((0, "ana"), (100, "ana")).dump() == driven_by((0, "ana")).dump()


def test_other_cars_on_the_same_day_change_no_forecast():
    alone = driven("c")[1]
    together = forecasts(trained_pipeline().push(merged(*(shift(car, DAYS) for car in CARS))), "c")
    assert together == alone


def test_shifts_are_evaluated_as_they_end_and_bounds_move_at_daily_update():
    pipeline = trained_pipeline()
    conformal, before = pipeline.engine.statistics.conformal, count_evaluated_shifts(pipeline)
    bounds = conformal.table.copy()
    pipeline.push(days([DAYS]))
    assert count_evaluated_shifts(pipeline) >= before + len(CARS)
    assert conformal.table.tobytes() == bounds.tobytes()
    pipeline.push(idle_morning(DAYS + 1))
    assert conformal.table.tobytes() != bounds.tobytes()


def count_evaluated_shifts(pipeline):
    """Return the number of shifts of this day whose forecasts were evaluated."""
    errors = pipeline.engine.statistics.errors.values()
    return sum(bool(np.isfinite(each.scores).any()) for of_lane in errors for each in of_lane)


def test_outcomes_of_published_intervals_are_counted_at_the_end_of_the_shift_and_kept():
    pipeline = trained_pipeline()
    before = pipeline.engine.statistics.interval_outcomes.copy()
    messages = [m for _, m in shift("c", DAYS)]
    published = forecasts(pipeline.push(messages), "c")
    pipeline.finish()
    known = [each.soc_end_of_shift_pct for each in published.values() if each.soc_end_of_shift_pct is not None]
    end = columns("c", DAYS)["soc_pct"][-1]
    below, inside, above = (pipeline.engine.statistics.interval_outcomes - before)[0].tolist()
    assert len(known) > below + inside + above > 0
    assert (inside > 0) == any(each.p05 <= end <= each.p95 for each in known)
    near = 0.2  # a recorded forecast may lie between two published ones [%]
    assert (below + above > 0) <= any(not each.p05 + near <= end <= each.p95 - near for each in known)
    other = Pipeline(settings=SETTINGS)
    other.restore(pipeline.snapshot())
    assert (other.engine.statistics.interval_outcomes == pipeline.engine.statistics.interval_outcomes).all()


def break_display(sent, fault):
    """Return the samples of a shift whose reading fails two hours before its end."""
    soc, late = sent["soc_pct"].copy(), sent["time_s"] > sent["time_s"][-1] - 7200.0
    soc[late] = {"frozen": soc[late][0], "absent": np.nan, "jumping": soc[late] - 20.0}[fault]
    return sent | {"soc_pct": soc}


def learn(messages):
    """Return how many shifts the intervals know after messages, and the factor of a car."""
    pipeline = trained_pipeline()
    pipeline.push(messages)
    pipeline.finish()
    shifts = count_evaluated_shifts(pipeline)
    pipeline.engine.apply_daily_update()
    return shifts, pipeline.engine.statistics.factors.expect(2)


@pytest.mark.parametrize("fault", ["frozen", "absent", "jumping"])
def test_shift_whose_reading_fails_teaches_nothing(fault):
    sent = columns("c", DAYS)
    shifts, factor = learn([])
    more, other = learn([m for _, m in shift("c", DAYS, sent)])
    assert more > shifts
    assert other != factor
    after, same = learn([m for _, m in shift("c", DAYS, break_display(sent, fault))])
    assert tuple(same) == pytest.approx(tuple(factor), abs=0.01)  # its rides change the tables a little
    assert shifts <= after <= more if fault == "jumping" else after == shifts  # after a jump, forecasts count again


def test_upper_bound_is_at_most_the_present_charge():
    published = forecasts(trained_pipeline().push([m for _, m in shift("c", DAYS)]), "c").values()
    known = [(each.soc_pct, each.soc_end_of_shift_pct) for each in published if each.soc_end_of_shift_pct is not None]
    assert known
    assert all(end.p95 <= now + 0.005 for now, end in known)


def test_display_of_an_empty_battery_may_show_some_charge():
    messages = [m for _, m in shift("c", DAYS)]
    legs = [{"distance_km": 20.0, "duration_s": 900.0}] * 24
    messages[1] = make_message("plan", "c", BEGIN + 14.0, shift_end_s=BEGIN + SHIFT, reserve_soc_pct=RESERVE, legs=legs)
    _, published = driven(messages=messages[:60])
    end = list(published.values())[-1].soc_end_of_shift_pct
    assert (end.mean, end.p05) == (0.0, 0.0)
    assert end.p95 >= 100.0 * EMPTY_SOC
