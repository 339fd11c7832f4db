"""Test that forecasts are recorded and evaluated at the end of their shift, except those before a charging."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.conformal import ConformalIntervals
from socast.core.forecast.learning.forecast_errors import (
    FORECAST_RECORDS,
    LAST_RECORD,
    RECORD_PERIOD,
    ForecastLog,
    ForecastRecord,
    Outcome,
    compute_shift_errors,
)

END = 7200.0


def note(time, end=END, basis=0, mean=0.5, sd=0.02):
    return ForecastRecord(time, end, basis, 10.0, 15.0, mean, sd)


def evaluated(forecasts, soc, charged):
    """Return the errors of forecasts."""
    return compute_shift_errors(np.array(forecasts, FORECAST_RECORDS), Outcome(soc, charged))


def count(errors):
    """Return the number of forecasts with an outcome."""
    return int(np.isfinite(errors.scores).sum())


def noted(times, end=END, **of):
    """Return a log of one lane after a forecast at each time, and the times of those that it recorded."""
    log = ForecastLog()
    log.grow(1)
    for time in times:
        if log.is_due(np.array([0]), np.array([time]))[0]:
            log.record(0, note(time, end, **of))
    return log, log.get_records(0)["time"].tolist()


def test_forecast_is_recorded_every_ten_minutes_and_at_the_end():
    _, times = noted(np.arange(0.0, END + 1.0, 15.0))
    assert times[:3] == [0.0, RECORD_PERIOD, 2.0 * RECORD_PERIOD]
    assert times[-1] == END - LAST_RECORD
    assert np.diff(times[:-1]).min() >= RECORD_PERIOD


def test_every_record_is_evaluated_against_the_charge_at_the_end():
    log, times = noted(np.arange(0.0, END - 15.0, 15.0))
    assert log.evaluate_until(0, END - 1.0, Outcome(0.47)) == []
    assert log.is_due(np.array([0]), np.array([END])).all()
    (errors,) = log.evaluate_until(0, END, Outcome(0.47))
    assert count(errors) == len(times)
    assert errors.scores == pytest.approx(np.full(len(times), -1.5))
    assert errors.basis == 0
    assert log.evaluate_until(0, END + 1.0, Outcome(0.47)) == []
    assert log.evaluate_shift(0, Outcome(0.3)) == []


def test_interrupted_shift_is_evaluated_against_its_last_charge():
    log, times = noted(np.arange(0.0, 3000.0, 15.0))
    (errors,) = log.evaluate_shift(0, Outcome(0.56))
    assert errors.scores == pytest.approx(np.full(len(times), 3.0))
    assert log.is_due(np.array([0]), np.array([0.0])).all()


@given(st.floats(-100.0, 8000.0), st.lists(st.floats(0.0, END), min_size=1, max_size=20))
def test_only_forecasts_after_the_last_charging_are_evaluated(charged, times):
    of_shift = evaluated([note(time) for time in sorted(times)], 0.5, charged)
    assert sum(count(errors) for errors in of_shift) == sum(time > charged for time in times)


def test_nothing_is_evaluated_without_a_known_charge():
    (errors,) = evaluated([note(0.0)], np.nan, np.nan)
    assert count(errors) == 0


def shifts_to_empty(rng, lean, began, predicted, taken, n=300):
    """Yield forecasts of shifts that often run empty, and the charge that was left; the car stops there."""
    for energy, error in zip(rng.uniform(*predicted, n), rng.normal(size=n), strict=True):
        mean, sd = began - lean * energy, 0.1 * energy
        left = max(began - taken * energy - sd * error, 0.0)
        yield ForecastRecord(0.0, END, 0, 10.0, 15.0, mean, sd), left


@pytest.mark.parametrize("predicted", [(0.2, 1.0), (0.5, 2.0)], ids=["some empty", "most empty"])
def test_errors_of_cars_that_run_empty_are_learned_without_bias(predicted):
    """A forecast below an empty battery is right when the battery ends empty."""
    rng, conformal = np.random.default_rng(5), ConformalIntervals()
    for forecast, left in shifts_to_empty(rng, 1.0, 0.7, predicted, 1.0, 1000):
        for errors in filter(count, evaluated([forecast], left, np.nan)):
            conformal.add_shift(errors.basis, errors.records["ahead_km"], errors.scores)
            conformal.apply_daily_update()
    _, (low,), (high,) = conformal.get_quantiles(np.array([0]), np.array([10.0]))[1]
    assert -1.645 - 0.35 < low < -1.0  # errors below are cut off where the battery is empty
    assert high == pytest.approx(1.645, abs=0.35)
    inside = {True: [], False: []}
    for forecast, left in shifts_to_empty(rng, 1.0, 0.7, predicted, 1.0, 4000):
        low_end, high_end = (max(forecast.mean + forecast.sd * bound, 0.0) for bound in (low, high))
        inside[forecast.mean >= 0.0].append(low_end <= left <= high_end)
    assert np.mean(inside[True]) == pytest.approx(0.9, abs=0.04)
    assert np.mean(inside[False]) > 0.9


def test_what_was_done_of_a_plan_is_known_also_where_the_display_failed():
    planned = note(600.0)._replace(driving_kwh=4.0, waiting_kwh=1.0, way_home_kwh=0.5, predicted=2.0, level=0.1)
    ended = Outcome(0.4, faulty=900.0, predicted=6.6, level=0.0)
    (errors,) = compute_shift_errors(np.array([planned], FORECAST_RECORDS), ended)
    assert count(errors) == 0
    assert errors.records[["driving_kwh", "waiting_kwh", "way_home_kwh"]].tolist() == [(4.0, 1.0, 0.5)]
    assert errors.done == pytest.approx(6.6 * np.exp(0.1) - 2.0)
    (charged,) = compute_shift_errors(np.array([planned], FORECAST_RECORDS), ended._replace(charged=700.0))
    assert np.isnan(charged.done).all()


def test_forecasts_by_plan_and_by_history_are_evaluated_separately():
    of_shift = evaluated([note(0.0), note(600.0, basis=1, mean=0.4), note(1200.0)], 0.5, np.nan)
    assert [(errors.basis, count(errors)) for errors in of_shift] == [(0, 2), (1, 1)]
    assert of_shift[1].scores == pytest.approx([5.0])


def test_unknown_forecast_is_not_recorded():
    log, _ = noted([0.0], mean=np.nan)
    assert log.evaluate_shift(0, Outcome(0.5)) == []


def test_postponed_plan_is_evaluated_at_each_end():
    log, _ = noted([0.0, 700.0])
    log.record(0, note(1400.0, end=END + 3600.0))
    (first,) = log.evaluate_until(0, END, Outcome(0.5))
    (later,) = log.evaluate_until(0, END + 3600.0, Outcome(0.4))
    assert (count(first), count(later)) == (2, 1)


def test_loaded_state_continues_as_uninterrupted():
    one, _ = noted(np.arange(0.0, 3000.0, 15.0))
    other = ForecastLog()
    other.load(one.dump())
    assert other.dump() == one.dump()
    assert str(one.evaluate_until(0, END, Outcome(0.5))) == str(other.evaluate_until(0, END, Outcome(0.5)))


def test_outcomes_inside_the_published_interval_are_counted_by_basis():
    inside = note(0.0)._replace(lower=0.4, upper=0.5)
    forecasts = [inside, inside, note(600.0)._replace(lower=0.5, upper=0.6), note(700.0)]
    forecasts += [note(800.0, basis=1)._replace(lower=0.1, upper=0.44), note(900.0, basis=1)]
    by_plan, by_history = evaluated(forecasts, 0.45, np.nan)
    assert by_plan.outcomes.tolist() == [1, 2, 0]
    assert by_history.outcomes.tolist() == [0, 0, 1]
