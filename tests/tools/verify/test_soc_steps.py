"""Test which steps of the filter of the charge are compared, which are passed over, and that errors are seen."""

import numpy as np
import pytest

from socast.core.batch import Lanes
from socast.core.forecast import filter_state, soc_filter
from socast.tools.verify import soc_steps, soc_witness
from socast.tools.verify.records import GOAL
from socast.tools.verify.soc_steps import SocSteps
from tests.support.soc_shifts import BEGIN, NIGHT, PRIOR, STEP, name_driver, shift


def verify(events, *more):
    """Return the differences of a car whose state begins with its first event."""
    events = np.concatenate([np.ravel(each) for each in (events, *more)])
    steps = SocSteps(Lanes(["car"]))
    out = np.empty(len(events), filter_state.SOC_ESTIMATE), np.empty(len(events), filter_state.CLOSED_SHIFT)
    prior = np.array([(0.0, PRIOR)], filter_state.LOG_FACTOR_PRIOR)
    steps.filter_events(events, filter_state.create_filter_state(1), prior, *out)
    return steps.tallies.summarise("soc")


@pytest.mark.parametrize("metered", [False, True])
def test_every_step_after_the_first_of_an_undisturbed_shift_is_compared(metered):
    events, _ = shift(1, 2.0, 0.005, metered=metered)
    result = verify(events)
    assert result.steps == events.size
    assert result.compared == events.size - 1
    assert result.passed_over == {soc_steps.BEGINNING: 1}
    assert max(result.mean, result.covariance) < GOAL
    assert result.meets_goal


def test_frozen_value_and_the_step_that_ends_it_are_compared():
    events, _ = shift(1, 2.0, 0.005)
    events["soc"][0, 100:300] = events["soc"][0, 100]
    result = verify(events)
    assert result.meets_goal
    assert set(result.passed_over) <= {soc_steps.BEGINNING, soc_steps.UNTRUSTED}


def test_each_kind_of_step_that_no_linear_filter_describes_is_counted_by_its_cause():
    events, _ = shift(1, 1.0, 0.01, full=0.7)
    events["soc"][0, 100:110] += 0.3
    events["since_charge"][0, 150:160] = 0.0
    events["level"] = np.where(np.arange(events.size) < 200, 0.0, 0.1)
    late, _ = shift(1, 0.2, 0.01, begin=BEGIN + 3600.0 + 900.0, full=0.6)
    late["level"], late["soc"][0, 0] = 0.1, np.nan
    late["level_sd"] = events["level_sd"] = 0.02
    next_day, _ = shift(1, 0.1, 0.01, begin=BEGIN + NIGHT)
    next_day["level"] = 0.1
    next_day["level_sd"] = np.nan
    named = [name_driver(code, 0.0, 0.001) for code in (1, 2)]
    result = verify(events[0, :50], named[0], events[0, 50:70], named[1], events[0, 70:], late, next_day)
    assert result.passed_over == {
        soc_steps.UNTRUSTED: 10,
        soc_steps.CHARGING: 10,
        soc_steps.BEGINNING: 2,
        soc_steps.STATISTICS: 1,
        soc_steps.SILENCE: 1,
        soc_steps.UNKNOWN: 1,
    }
    assert result.steps == result.compared + result.passed == events.size + late.size + next_day.size
    assert result.meets_goal


def test_drivers_are_compared_the_first_one_and_those_who_take_over():
    events, _ = shift(1, 1.0, 0.01)
    named = [name_driver(code, 0.05 * code, 0.001) for code in (1, 2)]
    result = verify(events[0, :50], named[0], events[0, 50:100], named[1], events[0, 100:])
    assert result.passed_over == {soc_steps.BEGINNING: 1}
    assert result.compared == events.size - 1
    assert result.meets_goal


@pytest.mark.parametrize("name", ["next_driver_mean", "next_driver_variance"])
@pytest.mark.parametrize("first", [True, False])
def test_driver_who_is_off_by_a_millionth_misses_the_goal(name, first, monkeypatch):
    take = soc_witness.SocWitness.take_driver

    def take_another(witness, car):
        if first == (car["driver"] < 0.0):
            car = car.copy()
            car[name] *= 1.0 + 1e-6
        take(witness, car)

    monkeypatch.setattr(soc_witness.SocWitness, "take_driver", take_another)
    events, _ = shift(1, 1.0, 0.01)
    named = [name_driver(code, 0.05 * code, 0.001) for code in (1, 2)]
    assert verify(events[0, :50], named[0], events[0, 50:100], named[1], events[0, 100:]).meets_goal is False


def test_events_are_filtered_as_without_a_listener():
    events, _ = shift(1, 1.0, 0.01)
    events, outs = events[0], []
    for run in (soc_filter.filter_events, SocSteps(Lanes(["car"])).filter_events):
        state = filter_state.create_filter_state(1)
        out = np.zeros(len(events), filter_state.SOC_ESTIMATE), np.zeros(len(events), filter_state.CLOSED_SHIFT)
        run(events, state, np.array([(0.0, PRIOR)], filter_state.LOG_FACTOR_PRIOR), *out)
        outs.append((state.tobytes(), out[0].tobytes()))
    assert outs[0] == outs[1]


@pytest.mark.parametrize("name", ["CONSUMPTION_WANDER", "READING_SD", "METER_SAMPLING_SD"])
def test_filter_that_is_off_by_a_millionth_misses_the_goal(name, monkeypatch):
    monkeypatch.setattr(soc_witness, name, (1.0 + 1e-6) * getattr(soc_witness, name))
    events, _ = shift(1, 1.0, 0.01, metered=True)
    result = verify(events)
    assert result.meets_goal is False
    assert result.covariance > GOAL


def test_stretch_is_what_the_totals_gained_since_the_state():
    events, _ = shift(1, 1.0, 0.01, metered=True)
    before = filter_state.create_filter_state(1)[0]
    for name in ("predicted", "metered", "meter_time"):
        before[f"seen_{name}"] = events[name][0, 3]
    before["seen_time"], before["begin"], before["soc"] = events["duration"][0, 3], BEGIN, 0.9
    stretch = soc_steps.measure_stretch(before, events[0, 5])
    assert stretch.duration == pytest.approx(2.0 * STEP)
    assert stretch.predicted == pytest.approx(events["predicted"][0, 5] - events["predicted"][0, 3])
    assert stretch.used == pytest.approx(events["metered"][0, 5] - events["metered"][0, 3])
