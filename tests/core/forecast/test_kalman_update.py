"""Test the updates of the filter against filterpy, by the identity of a driver, and by a change of drivers."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from socast.core.forecast import filter_state, soc_filter
from socast.tools.verify.differences import measure_differences
from socast.tools.verify.records import GOAL
from socast.tools.verify.soc_witness import SocWitness, Stretch, get_covariance, get_mean
from tests.support.soc_shifts import (
    BEGIN,
    CAPACITY,
    NIGHT,
    PRIOR,
    STEP,
    compute_coverage,
    name_driver,
    noise,
    run_filter,
    shift,
)

CARS = 200
QUANTA = (0.001, 0.005, 0.01)
STRANGER = soc_filter.DRIVER_SD**2
"""Variance of the part of an unknown driver."""
parts = st.tuples(st.floats(-0.1, 0.1), st.floats(0.05, 0.999).map(lambda share: share * STRANGER))
KNOWN = (
    *("soc", "log_consumption", "log_capacity", "p_ss", "p_sa", "p_sc", "p_aa", "p_ac", "p_cc"),
    *("usual", "usual_variance", "driver"),
)


@given(
    seed=st.integers(0, 10_000),
    quantum=st.sampled_from(QUANTA),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    a=st.floats(-0.3, 0.3),
)
def test_filter_equals_filterpy(seed, quantum, share, a):
    events, _ = shift(1, 0.5, quantum, a, metered=True, seed=seed)
    events = events[0]
    rng = np.random.default_rng(seed)
    predicted, used = np.diff(events["predicted"]), np.diff(events["metered"])
    used[rng.random(len(used)) >= share] = np.nan
    events["metered"] = np.r_[0.0, np.nan_to_num(used).cumsum()]
    events["meter_time"] = STEP * np.r_[0.0, np.isfinite(used).cumsum()]
    state = run_filter(events[:1]).state
    witness, steps = SocWitness(state[0]), 0
    for i in range(1, len(events)):
        before = state.copy()
        state = run_filter(events[i : i + 1], before).state
        witness.predict(Stretch(predicted[i - 1], used[i - 1], STEP, CAPACITY, noise(STEP * i)))
        assume(np.isnan(state["suspect"][0]))
        if state["reported"][0] != before["reported"][0]:
            steps += 1
            witness.update_with_step(before["reported"][0], events["soc"][i], quantum)
        witness.note_reading()
    assert steps > 0
    found = get_mean(state[0]), get_covariance(state[0])
    assert max(measure_differences(*found, witness.mean, witness.covariance)) < GOAL


@given(parts, st.integers(1, 200))
def test_driver_identified_late_equals_driver_known_from_the_beginning(part, at):
    events, _ = shift(1, 1.0, 0.01, seed=13)
    mean, variance = part
    after = run_filter(np.r_[events[0, :at], name_driver(3, *part), events[0, at : at + 1]])
    before = run_filter(events[:, : at + 1], prior=(mean, PRIOR - STRANGER + variance))
    assert after.state["driver"][0] == 3.0
    for name, loose in (("log_factor", 0.02), ("log_factor_variance", 0.06 * PRIOR), ("soc", 0.002)):
        assert after.at(name)[0, -1] == pytest.approx(before.at(name)[0, -1], abs=loose), name
    again = np.r_[name_driver(3, *part), events[0, at + 1 : at + 2]]
    assert run_filter(again, after.state).state.tobytes() == run_filter(again[1:], after.state).state.tobytes()


@given(parts)
def test_driver_named_between_shifts_drives_the_next_shift(part):
    first, second = (shift(1, 1.0, 0.01, seed=13, begin=BEGIN + NIGHT * day)[0][0] for day in range(2))
    events = np.r_[name_driver(2, 0.0, 0.5 * STRANGER), first, name_driver(3, *part), second, name_driver(4, *part)]
    result = run_filter(np.r_[events, shift(1, 0.1, 0.01, begin=BEGIN + 2.0 * NIGHT)[0][0]])
    assert result.shifts["driver"].tolist() == [2.0, 3.0]
    assert result.state["driver"][0] == 4.0
    at = 1 + len(first) + 1
    scale, spread = (result.at(name)[0, at] for name in ("log_factor", "log_factor_variance"))
    assert (scale, spread) == pytest.approx((part[0], PRIOR - STRANGER + part[1]), abs=1e-9)


@given(parts, parts)
def test_driver_replaced_before_any_data_leaves_no_trace(one, other):
    (events,), _ = shift(1, 0.5, 0.01, seed=13)
    events["predicted"][:2] = 0.0
    events["duration"][:2] = 0.0
    both = run_filter(np.r_[name_driver(1, *one), events[:1], name_driver(2, *other), events[1:]]).state
    alone = run_filter(np.r_[name_driver(2, *other), events]).state
    for name in KNOWN:
        assert both[name] == pytest.approx(alone[name], rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("metered", [False, True])
@given(seed=st.integers(0, 1000), one=parts, other=parts, at=st.integers(1, 238))
def test_two_drivers_never_reduce_variance_below_that_of_one(metered, seed, one, other, at):
    (events,), _ = shift(1, 1.0, 0.005, metered=metered, seed=seed)
    both = run_filter(np.r_[name_driver(1, 0.0, one[1]), events[:at], name_driver(2, 0.0, other[1]), events[at:]])
    alone = run_filter(np.r_[name_driver(2, 0.0, other[1]), events])
    assert both.at("log_factor_variance")[0, -1] >= (1.0 - 1e-9) * alone.at("log_factor_variance")[0, -1]
    assert np.linalg.eigvalsh(get_covariance(both.state[0])).min() > 0.0
    ended = run_filter(shift(1, 0.1, 0.01, begin=BEGIN + NIGHT)[0], both.state).shifts
    assert ended["driver"].tolist() == [-1.0]


@pytest.mark.parametrize("metered", [False, True])
def test_interval_covers_truth_after_a_change_of_drivers(metered):
    rng = np.random.default_rng(4)
    variances = np.array([[0.3 * STRANGER], [STRANGER]])
    means = 0.05 * rng.normal(size=(2, CARS))
    takes = means + np.sqrt(variances) * rng.normal(size=(2, CARS))
    rest = rng.normal(0.0, np.sqrt(PRIOR - STRANGER), CARS)
    first, early = shift(CARS, 2.0, 0.005, rest + takes[0], metered=metered, seed=5)
    begin = first["time"][0, -1]
    then, late = shift(CARS, 2.0, 0.005, early.a[:, -1] - takes[0] + takes[1], metered=metered, seed=6, begin=begin)
    then["soc"] += first["soc"][:, -1:] - then["soc"][:, :1]
    first["kind"][:, -1] = filter_state.CLOSED
    names = [[name_driver(who, means[who, car], variances[who, 0], car) for car in range(CARS)] for who in (0, 1)]
    events = [np.concatenate([names[0][i], first[i], names[1][i], then[i]]) for i in range(CARS)]
    result = run_filter(np.concatenate(events))
    for at, truth in ((first.shape[1] + 2, late.a[:, 0]), (-1, late.a[:, -1])):
        scale, spread = (result.at(name, CARS)[:, at] for name in ("log_factor", "log_factor_variance"))
        assert 0.84 <= compute_coverage(scale, spread, truth) <= 0.96
