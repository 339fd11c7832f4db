"""What a driver who becomes known, and one who takes over, do to what is known of a car."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.forecast import filter_state, soc_filter
from tests.support.soc_shifts import BEGIN, NIGHT, PRIOR, covariance, covered, heard, named, shift

CARS = 200
STRANGER = soc_filter.DRIVER_SD**2
"""Variance of the part of a driver of whom nothing is known."""
parts = st.tuples(st.floats(-0.1, 0.1), st.floats(0.05, 0.999).map(lambda share: share * STRANGER))
KNOWN = (
    *("soc", "log_consumption", "log_capacity", "p_ss", "p_sa", "p_sc", "p_aa", "p_ac", "p_cc"),
    *("usual", "usual_variance", "driver"),
)


@given(parts, st.integers(1, 200))
def test_a_driver_who_becomes_known_is_as_if_known_from_the_beginning(part, at):
    events, _ = shift(1, 1.0, 0.01, seed=13)
    mean, variance = part
    after = heard(np.r_[events[0, :at], named(3, *part), events[0, at : at + 1]])
    before = heard(events[:, : at + 1], prior=(mean, PRIOR - STRANGER + variance))
    assert after.state["driver"][0] == 3.0
    for name, loose in (("log_factor", 0.02), ("log_factor_variance", 0.06 * PRIOR), ("soc", 0.002)):
        assert after.at(name)[0, -1] == pytest.approx(before.at(name)[0, -1], abs=loose), name
    again = np.r_[named(3, *part), events[0, at + 1 : at + 2]]
    assert heard(again, after.state).state.tobytes() == heard(again[1:], after.state).state.tobytes()


@given(parts)
def test_a_driver_who_is_named_while_the_car_sleeps_drives_the_shift_that_opens_next(part):
    first, second = (shift(1, 1.0, 0.01, seed=13, begin=BEGIN + NIGHT * day)[0][0] for day in range(2))
    told = np.r_[named(2, 0.0, 0.5 * STRANGER), first, named(3, *part), second, named(4, *part)]
    found = heard(np.r_[told, shift(1, 0.1, 0.01, begin=BEGIN + 2.0 * NIGHT)[0][0]])
    assert found.shifts["driver"].tolist() == [2.0, 3.0]
    assert found.state["driver"][0] == 4.0
    at = 1 + len(first) + 1
    scale, spread = (found.at(name)[0, at] for name in ("log_factor", "log_factor_variance"))
    assert (scale, spread) == pytest.approx((part[0], PRIOR - STRANGER + part[1]), abs=1e-9)


@given(parts, parts)
def test_who_is_replaced_before_anything_was_learned_leaves_nothing_behind(one, other):
    (events,), _ = shift(1, 0.5, 0.01, seed=13)
    events["predicted"][:2] = 0.0
    events["duration"][:2] = 0.0
    both = heard(np.r_[named(1, *one), events[:1], named(2, *other), events[1:]]).state
    alone = heard(np.r_[named(2, *other), events]).state
    for name in KNOWN:
        assert both[name] == pytest.approx(alone[name], rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("metered", [False, True])
@given(seed=st.integers(0, 1000), one=parts, other=parts, at=st.integers(1, 238))
def test_two_drivers_of_a_shift_never_make_anything_surer_than_one(metered, seed, one, other, at):
    (events,), _ = shift(1, 1.0, 0.005, metered=metered, seed=seed)
    both = heard(np.r_[named(1, 0.0, one[1]), events[:at], named(2, 0.0, other[1]), events[at:]])
    alone = heard(np.r_[named(2, 0.0, other[1]), events])
    assert both.at("log_factor_variance")[0, -1] >= (1.0 - 1e-9) * alone.at("log_factor_variance")[0, -1]
    assert np.linalg.eigvalsh(covariance(both.state)).min() > 0.0
    ended = heard(shift(1, 0.1, 0.01, begin=BEGIN + NIGHT)[0], both.state).shifts
    assert ended["driver"].tolist() == [-1.0]


@pytest.mark.parametrize("metered", [False, True])
def test_when_another_driver_takes_over_what_is_told_holds_the_truth_as_often_as_said(metered):
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
    names = [[named(who, means[who, car], variances[who, 0], car) for car in range(CARS)] for who in (0, 1)]
    told = [np.concatenate([names[0][i], first[i], names[1][i], then[i]]) for i in range(CARS)]
    found = heard(np.concatenate(told))
    for at, truth in ((first.shape[1] + 2, late.a[:, 0]), (-1, late.a[:, -1])):
        scale, spread = (found.at(name, CARS)[:, at] for name in ("log_factor", "log_factor_variance"))
        assert 0.84 <= covered(scale, spread, truth) <= 0.96
