"""Forecasts are noted, held against what became of them, and those before a charge against nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.forecast.conformal import Conformal
from core.forecast.learning.forecast_errors import LAST_S, NOTE_S, Lean, Note, ShiftLog, judged

END = 7200.0


def note(time, end=END, kind=0, mean=0.5, sd=0.02):
    return Note(time, end, kind, 10.0, 15.0, mean, sd)


def noted(times, end=END, **of):
    """Return a log of one lane to which a forecast was shown at each time, and those that it took."""
    log = ShiftLog()
    log.grow(1)
    for time in times:
        if log.due(np.array([0]), np.array([time]))[0]:
            log.note(0, note(time, end, **of))
    return log, log.notes(0)[:, 0].tolist()


def test_a_forecast_is_noted_every_ten_minutes_and_once_at_the_end():
    _, times = noted(np.arange(0.0, END + 1.0, 15.0))
    assert times[:3] == [0.0, NOTE_S, 2.0 * NOTE_S]
    assert times[-1] == END - LAST_S
    assert np.diff(times[:-1]).min() >= NOTE_S


def test_at_the_end_every_note_is_held_against_the_charge_that_is_told():
    log, times = noted(np.arange(0.0, END - 15.0, 15.0))
    assert log.ended(0, END - 1.0, 0.47, np.nan) == []
    assert log.due(np.array([0]), np.array([END])).all()
    (errors,) = log.ended(0, END, 0.47, np.nan)
    assert len(errors.scores) == len(times)
    assert errors.scores == pytest.approx(np.full(len(times), -1.5))
    assert errors.kind == 0
    assert log.ended(0, END + 1.0, 0.47, np.nan) == []
    assert log.closed(0, 0.3, np.nan) == []


def test_a_shift_that_breaks_off_is_held_against_the_last_charge():
    log, times = noted(np.arange(0.0, 3000.0, 15.0))
    (errors,) = log.closed(0, 0.56, np.nan)
    assert errors.scores == pytest.approx(np.full(len(times), 3.0))
    assert log.due(np.array([0]), np.array([0.0])).all()


@given(st.floats(-100.0, 8000.0), st.lists(st.floats(0.0, END), min_size=1, max_size=20))
def test_only_forecasts_after_the_last_charge_are_judged(charged, times):
    found = judged(np.array([note(time) for time in sorted(times)]), 0.5, charged)
    assert sum(len(errors.scores) for errors in found) == sum(time > charged for time in times)


def test_where_no_charge_is_known_nothing_is_judged():
    assert judged(np.array([note(0.0)]), np.nan, np.nan) == []


def shifts_to_empty(rng, lean, began, foretold, taken, n=300):
    """Yield forecasts of shifts of a fleet that often runs empty, and what was left of each; the car stops there."""
    for energy, error in zip(rng.uniform(*foretold, n), rng.normal(size=n), strict=True):
        mean, sd = began - lean * energy, 0.1 * energy
        left = max(began - taken * energy - sd * error, 0.0)
        yield Note(0.0, END, 0, 10.0, 15.0, mean, sd, began, lean), left


@pytest.mark.parametrize("foretold", [(0.2, 1.0), (0.5, 2.0)], ids=["some empty", "most empty"])
def test_of_cars_that_run_empty_the_errors_are_learned_as_of_others(foretold):
    """The battery that ends at nothing would have ended below: that is no error of who foretold it."""
    rng, conformal = np.random.default_rng(5), Conformal()
    for note_, left in shifts_to_empty(rng, 1.0, 0.7, foretold, 1.0, 1000):
        for errors in judged(np.array([note_]), left, np.nan):
            conformal.learn(*errors[:4])
    conformal.settle()
    _, low, high = conformal.quantiles(np.array([0]), np.array([10.0]), np.array([15.0]))[1][0]
    assert -1.645 - 0.35 < low < -1.0  # errors below are cut off where the battery is empty
    assert high == pytest.approx(1.645, abs=0.35)
    inside = {True: [], False: []}
    for note_, left in shifts_to_empty(rng, 1.0, 0.7, foretold, 1.0, 4000):
        low_end, high_end = (max(note_.mean + note_.sd * bound, 0.0) for bound in (low, high))
        inside[note_.mean >= 0.0].append(low_end <= left <= high_end)
    assert np.mean(inside[True]) == pytest.approx(0.9, abs=0.04)
    assert np.mean(inside[False]) > 0.9


@pytest.mark.parametrize("taken", [0.85, 1.0, 1.2])
def test_what_forecasts_are_short_by_is_found_where_cars_run_empty(taken):
    rng, lean = np.random.default_rng(6), Lean()
    for _ in range(20):
        for note_, left in shifts_to_empty(rng, float(lean.factor[0]), 0.7, (0.3, 1.5), taken):
            for errors in judged(np.array([note_]), left, np.nan):
                lean.learn(errors)
        lean.settle()
    assert lean.factor[0] == pytest.approx(taken, abs=0.025)


def test_forecasts_by_plan_and_by_habit_are_judged_apart():
    found = judged(np.array([note(0.0), note(600.0, kind=1, mean=0.4), note(1200.0)]), 0.5, np.nan)
    assert [(errors.kind, len(errors.scores)) for errors in found] == [(0, 2), (1, 1)]
    assert found[1].scores == pytest.approx([5.0])


def test_a_forecast_that_knows_nothing_is_not_noted():
    log, _ = noted([0.0], mean=np.nan)
    assert log.closed(0, 0.5, np.nan) == []


def test_a_plan_that_was_put_off_is_judged_at_each_end():
    log, _ = noted([0.0, 700.0])
    log.note(0, note(1400.0, end=END + 3600.0))
    (first,) = log.ended(0, END, 0.5, np.nan)
    (later,) = log.ended(0, END + 3600.0, 0.4, np.nan)
    assert (len(first.scores), len(later.scores)) == (2, 1)


def test_what_was_dumped_goes_on_as_if_nothing_had_happened():
    one, _ = noted(np.arange(0.0, 3000.0, 15.0))
    other = ShiftLog()
    other.load(one.dump())
    assert other.dump() == one.dump()
    assert str(one.ended(0, END, 0.5, np.nan)) == str(other.ended(0, END, 0.5, np.nan))
