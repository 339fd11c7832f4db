"""Test the energy ahead of a car, and the charge and range that follow from it."""

from functools import cache

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.learning.consumption_terms import LOST, TEMPERATURES
from socast.core.forecast.learning.consumption_terms import START as STARTS
from socast.core.forecast.learning.leg_energy import RECOVERED_SHARE, STEEPEST_DESCENT
from socast.core.forecast.learning.shift_patterns import SHIFT_PATTERNS, SHIFT_SPREAD
from socast.core.forecast.outlook import (
    DEFAULT_RESERVE,
    FACTOR_DECAY_TIME,
    GRACE,
    OVERTIME,
    PLAN_LEAD,
    CarEstimate,
    EnergyAhead,
    MeanAndSd,
    compute_charge_between,
    compute_end_soc,
    compute_planned_energy,
    compute_range,
    compute_temperature_weights,
    fill_from_history,
    lower_charge,
    schedule_plan,
)
from socast.core.forecast.planned_legs import PLAN_PROGRESS, compute_planned_legs
from socast.core.forecast.soc_filter import CONSUMPTION_WANDER, ENERGY_SD
from socast.core.wire.messages import Leg, Plan
from tests.support.fleet_days import DAY, DAYS, LEG, LEGS, RESERVE, SHIFT, START, speeds, trained_pipeline

BEGIN = START + DAY * DAYS
PLAN = Plan("c", BEGIN, BEGIN + SHIFT, RESERVE, [Leg(0.6 * v, 600.0) for v in speeds("c", DAYS).tolist()])
CELSIUS = 8.0


@cache
def statistics():
    """Return what a fleet has learned in some days."""
    return trained_pipeline().engine.statistics


@cache
def planned():
    """Return the planned legs of the car."""
    return compute_planned_legs(PLAN, statistics().get_tables(2))


def usual(n=1, celsius=CELSIUS, awake_s=np.inf):
    """Return the usual consumption, without uncertainty and as if all went by plan."""
    weights = compute_temperature_weights(np.full(n, celsius + ZERO_CELSIUS))
    learned = statistics().compute_usual(np.ones(n, np.int64), weights, np.full(n, awake_s))
    nothing = np.zeros_like(learned.covariance)
    as_planned, certain = np.tile([1.0, 1.0, 0.0], (n, 1)), np.zeros((n, 3, 3))
    return learned._replace(
        covariance=nothing, plan_factor=as_planned, plan_covariance=certain, plan_spread=np.zeros(n)
    )


def begin_with(energy):
    """Return the tables, where the beginning of a ride takes an energy. [kWh]"""
    tables = statistics().get_tables(2)
    rates = tables.rates.copy()
    rates[:, STARTS] = energy
    return tables._replace(rates=rates)


def certain(energy):
    """Return energies without a standard deviation."""
    return MeanAndSd(np.array([energy]), np.zeros(1))


def planned_energy(progress, time, ride_km=0.0, riding=False):
    """Return the energy ahead of one car by the progress of its plan."""
    progress, time, riding = progress.reshape(1), np.array([time]), np.array([riding])
    times = schedule_plan(progress, time, np.array([ride_km]), riding, np.array([np.nan]))
    return compute_planned_energy(progress, times, time, riding, usual())


def ahead(done=0, time=BEGIN, ride_km=0.0, driven_km=0.0, riding=False):
    """Return the energy ahead of one car by plan."""
    return planned_energy(planned().drop_done(done, 0).compute_progress(driven_km), time, ride_km, riding)


def remaining(done, driven):
    """Return the legs that are left, the first shortened by a distance [km]; None where it has not begun."""
    left = planned().drop_done(done, 0)
    return left if driven is None else left.shorten(driven)


def known(soc=0.6, variance=1e-5, log_factor=0.1, log_factor_variance=0.01, covariance=-1e-5, usual=0.0, curve=0.0):
    values = (soc, variance, log_factor, log_factor_variance, covariance, usual, 0.01, curve, 24.0)
    return CarEstimate(*np.broadcast_arrays(*(np.atleast_1d(np.asarray(value, float)) for value in values)))


def test_energy_of_a_plan_is_that_of_its_legs_and_waits():
    whole = ahead()
    legs = float((planned().energy @ usual().weights[0]).sum())
    rest = SHIFT / 3600.0 - LEGS * 600.0 / 3600.0
    waiting = rest * usual().standing_power[0] + LEGS * usual().approach_energy[0]
    assert whole.energy[0] == pytest.approx(legs + waiting)
    assert whole.km[0] == pytest.approx(sum(leg.distance_km for leg in PLAN.legs))
    assert (whole.hours[0], whole.end[0], whole.reserve[0]) == (SHIFT / 3600.0, BEGIN + SHIFT, RESERVE / 100.0)
    assert whole.basis[0] == 0


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.0, 24.0), st.floats(0.1, 24.0))
def test_consumption_factor_decays_towards_the_usual(scale, norm, hours, more):
    soon, late = (
        known(log_factor=scale, usual=norm).compute_mean_log_factor(np.array([h]))[0] for h in (hours, hours + more)
    )
    assert min(scale, norm) - 1e-9 <= late <= max(scale, norm) + 1e-9
    assert abs(late - norm) <= abs(soon - norm) + 1e-12
    mean = scipy.integrate.quad(lambda t: norm + (scale - norm) * np.exp(-t / FACTOR_DECAY_TIME), 0.0, hours + more)[0]
    assert late == pytest.approx(mean / (hours + more), abs=1e-9)
    assert known(log_factor=scale, usual=norm).compute_mean_log_factor(np.zeros(1))[0] == pytest.approx(scale, abs=1e-6)


@given(st.integers(0, LEGS - 1), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_energy_ahead_falls_during_a_ride(done, one, other):
    length = PLAN.legs[done].distance_km
    shares = sorted((one, other))
    time = BEGIN + LEG * done
    first, later = (ahead(done, time + 600.0 * share, length * share, riding=True) for share in shares)
    assert later.energy[0] <= first.energy[0] + 1e-12
    assert later.km[0] == pytest.approx(first.km[0] - (shares[1] - shares[0]) * length, abs=1e-9)
    assert later.energy[0] > 0.0


@given(st.integers(0, LEGS - 1), st.floats(0.0, 5.0), st.floats(0.0, 30.0))
def test_leg_progress_counts_from_the_arrival_of_the_plan(done, before, since):
    result = ahead(done, ride_km=before + since, driven_km=before, riding=True)
    same = ahead(done, ride_km=since, riding=True)
    assert result.km[0] == pytest.approx(same.km[0])
    assert result.energy[0] == pytest.approx(same.energy[0])


@given(st.integers(0, LEGS - 1), st.floats(0.0, 5.0), st.floats(0.0, 12.0), st.booleans())
def test_remaining_legs_as_a_plan_have_the_same_energy_ahead(done, before, since, riding):
    """Shortened legs, used as a plan, give the energy ahead of the original plan."""
    driven = since if riding else None
    rest = planned_energy(remaining(done, driven).compute_progress(0.0), BEGIN + LEG * done, 0.0, riding)
    ride_km, driven_km = (before + since, before) if riding else (0.0, 0.0)
    whole = ahead(done, BEGIN + LEG * done, ride_km, driven_km, riding)
    for name, value, other in zip(whole._fields, rest, whole, strict=True):
        assert value == pytest.approx(other), name


@given(st.lists(st.booleans(), max_size=12), st.integers(0, 6), st.integers(0, 3))
def test_progress_sums_up_the_stretches_of_the_legs_that_are_left(are_charges, rides, charges):
    legs = [
        Leg(duration_s=600.0 + i, charge_to_soc_pct=50.0 + i) if is_charge else Leg(2.0 + i, 900.0 + i)
        for i, is_charge in enumerate(are_charges)
    ]
    known = compute_planned_legs(Plan("c", BEGIN, BEGIN + SHIFT, RESERVE, legs), statistics().get_tables(2))
    left, progress = known.drop_done(rides, charges), known.compute_progress(1.5, rides, charges)
    places = np.flatnonzero(np.isfinite(left.charge_to))
    first, after = (int(places[0]), int(places[-1]) + 1) if len(places) else (len(left.km), len(left.km))
    assert (progress["legs"], progress["charges"]) == (first, len(places))
    assert progress["between_legs"] == after - first - len(places)
    assert progress["after_legs"] == len(left.km) - after
    assert progress["leg_kwh"] == pytest.approx(left.energy[:first][:1].sum(axis=0))
    assert progress["later_kwh"] == pytest.approx(left.energy[1:first].sum(axis=0))
    assert progress["after_kwh"] == pytest.approx(left.energy[after:].sum(axis=0))
    seconds = progress["leg_s"] + progress["later_s"], progress["charge_s"] + progress["between_s"], progress["after_s"]
    parts = left.seconds[:first], left.seconds[first:after], left.seconds[after:]
    assert seconds == pytest.approx([part.sum() for part in parts])
    assert progress["leg_km"] + progress["later_km"] + progress["after_km"] == pytest.approx(left.km.sum())


@given(st.floats(0.01, 1.0), st.floats(0.1, 20.0), st.floats(1.0, 20.0), st.floats(0.0, 400.0), st.floats(0.0, 400.0))
def test_share_of_a_begun_leg_takes_that_share_of_its_energy(share, km, pace, gained, lost):
    parts = np.array([[1.0], [share]]) * np.array([km, 60.0 * pace * km, gained, lost])
    whole, some = (begin_with(0.3).compute_leg_energy(*part.reshape(4, 1))[1] for part in parts)
    assert some == pytest.approx(share * whole)


def test_begun_ride_has_no_start_energy():
    energy, begun_energy = begin_with(0.3).compute_leg_energy(*np.array([[6.0], [600.0], [np.nan], [np.nan]]))
    assert energy - begun_energy == pytest.approx(0.3)


@given(st.floats(0.0, 20.0), st.floats(1.0, 20.0), st.floats(0.0, 2000.0), st.floats(0.0, 2000.0))
def test_leg_returns_no_more_than_its_descent(km, pace, gained, lost):
    tables = statistics().get_tables(2)
    taken, _ = tables.compute_leg_energy(*np.array([[km], [60.0 * pace * km], [gained], [lost]]))
    assert (tables.rates[:, LOST] < 0.0).all()
    assert (taken >= tables.rates[:, LOST] * min(lost, STEEPEST_DESCENT * km) - 1e-12).all()


def test_part_of_the_surplus_of_a_descent_returns():
    tables, lost = statistics().get_tables(2), np.array([600.0, 700.0])
    (one, more), _ = tables.compute_leg_energy(np.full(2, 6.0), np.full(2, 600.0), np.zeros(2), lost)
    assert (one < 0.0).all()
    assert more - one == pytest.approx(RECOVERED_SHARE * 100.0 * tables.rates[:, LOST])


@given(st.integers(0, LEGS), st.floats(0.0, SHIFT + OVERTIME), st.floats(0.0, 10.0), st.booleans())
def test_end_is_never_before_now_nor_before_the_rides_that_are_in_time(done, passed, driven, riding):
    now = BEGIN + passed
    result = ahead(done, now, driven if riding else 0.0, riding=riding)
    rest = remaining(done, driven if riding else None)
    begun = rest.seconds[:1].sum() if riding else 0.0
    assert result.end[0] >= max(now, BEGIN + SHIFT)
    assert result.end[0] >= min(now + rest.seconds.sum(), BEGIN + SHIFT + GRACE) - 1e-6
    assert result.hours[0] == pytest.approx((result.end[0] - now) / 3600.0)
    assert result.end[0] <= max(BEGIN + SHIFT + GRACE, now + begun + 1e-6)


def test_rides_for_which_no_time_is_left_do_not_come():
    late = ahead(LEGS - 2, BEGIN + SHIFT + GRACE - 300.0)
    assert late.km[0] == pytest.approx(0.25 * sum(leg.distance_km for leg in PLAN.legs[-2:]))
    over = ahead(LEGS - 2, BEGIN + SHIFT + GRACE)
    assert (over.km[0], over.energy[0]) == (0.0, pytest.approx(0.0))


def test_warm_up_is_ahead_as_the_car_wakes():
    cold, warm = usual(celsius=-10.0, awake_s=0.0), usual(celsius=-10.0, awake_s=7200.0)
    assert cold.warm_up_energy[0] > 1000.0 * warm.warm_up_energy[0] > 0.0


@given(st.floats(0.2, 1.0), st.floats(0.0, 0.2), st.floats(-0.3, 0.3))
def test_charge_of_a_display_with_a_curve_falls_by_the_energy(soc, energy, curve):
    after = lower_charge(np.array([soc]), np.array([energy]), np.array([curve]))[0]
    assert compute_charge_between(soc, after, curve) == pytest.approx(energy, abs=1e-9)


def test_plan_that_is_often_left_out_takes_less_energy():
    parts = np.array([[4.0, 1.0, 0.8]])
    seldom = usual()._replace(plan_factor=np.array([[0.75, 1.2, 0.5]]), plan_spread=np.array([0.04]))
    expected = seldom.expect_plan(parts)
    assert (expected.mean[0], expected.sd[0]) == (pytest.approx(4.6), pytest.approx(np.sqrt(0.04 * 4.6)))


def test_after_all_legs_the_rest_is_waiting():
    result = ahead(LEGS, BEGIN + SHIFT - 1800.0)
    assert result.km[0] == 0.0
    assert result.energy[0] == pytest.approx(0.5 * usual().standing_power[0], rel=1e-6)
    assert ahead(LEGS + 3, BEGIN + SHIFT - 1800.0).energy == pytest.approx(result.energy)


@pytest.mark.parametrize(
    ("passed", "applies"),
    [
        (-PLAN_LEAD - 1.0, False),
        (-PLAN_LEAD, True),
        (0.0, True),
        (SHIFT, True),
        (SHIFT + OVERTIME, True),
        (SHIFT + OVERTIME + 1.0, False),
    ],
)
def test_plan_applies_from_its_lead_to_its_overtime(passed, applies):
    result = ahead(time=BEGIN + passed)
    assert np.isfinite(result.energy[0]) == np.isfinite(result.end[0]) == np.isfinite(result.hours[0]) == applies
    assert not result.hours[0] < 0.0


def test_without_plan_the_energy_ahead_is_nan():
    none = planned_energy(np.zeros(1, PLAN_PROGRESS), BEGIN)
    assert np.isnan(none.energy).all()
    assert np.isnan(none.reserve).all()


def test_history_fills_in_only_without_plan_and_until_the_end_of_the_longest_known_shift():
    n = 4
    unknown = np.array([np.nan, np.nan, np.nan, 3.0])
    parts = np.column_stack([unknown, np.zeros(n)])
    reserve = np.array([np.nan, np.nan, np.nan, 0.3])
    plain = EnergyAhead(unknown, unknown, parts, unknown, unknown, unknown, reserve, np.zeros(n, np.int64))
    elapsed, now = np.array([3600.0, 3600.0 * 7.0, 3600.0, 3600.0]), np.full(n, BEGIN)
    patterns = np.full((n, 2, 20), np.nan)
    patterns[[0, 1, 3], :, :4] = np.array([6.0, 1.2])[:, np.newaxis]
    patterns = patterns.reshape(n, -1).view(SHIFT_PATTERNS)[:, 0]
    result = fill_from_history(plain, usual(n), elapsed, now, patterns)
    assert result.energy[0] == pytest.approx(1.2 * 5.0 * usual().mean_power[0])
    assert result.sd[0] > SHIFT_SPREAD / 2.0 * result.energy[0]
    assert result.end[0] == BEGIN + 5.0 * 3600.0
    assert np.isnan(result.energy[1:3]).all()
    assert result.energy[3] == 3.0
    assert result.basis.tolist() == [1, 0, 0, 0]
    assert result.reserve.tolist() == [DEFAULT_RESERVE] * 3 + [0.3]


@given(st.floats(0.0, 15.0), st.floats(0.01, 5.0), st.floats(0.0, 8.0))
def test_more_energy_ahead_lowers_mean_and_raises_sd(energy, more, hours):
    first, second = (compute_end_soc(known(), certain(e), np.array([hours])) for e in (energy, energy + more))
    assert second.mean[0] < first.mean[0]
    assert second.sd[0] > first.sd[0]
    assert first.mean[0] == pytest.approx(
        0.6 - np.exp(known().compute_mean_log_factor(np.array([hours]))[0]) * energy / 24.0
    )


def test_sd_agrees_with_simulation():
    rng, n = np.random.default_rng(1), 200_000
    spread = np.array([[2e-5, -1e-4], [-1e-4, 0.004]])
    soc, scale = rng.multivariate_normal([0.6, 0.0], spread, n).T
    scale += CONSUMPTION_WANDER * np.sqrt(3.0 / 30.0) * rng.normal(size=(30, n)).cumsum(axis=0).mean(axis=0)
    energy = 8.0 * np.exp(scale) + ENERGY_SD * np.sqrt(8.0) * rng.normal(size=n)
    ends = soc - energy / 24.0 + rng.uniform(-0.005, 0.005, n)
    estimate = known(variance=2e-5, log_factor=0.0, log_factor_variance=0.004, covariance=-1e-4)
    result = compute_end_soc(estimate, certain(8.0), np.array([3.0]))
    assert result.sd[0] == pytest.approx(ends.std(), rel=0.02)
    assert result.mean[0] == pytest.approx(ends.mean(), abs=0.005)


def test_sd_is_never_below_that_of_the_quantum():
    result = compute_end_soc(known(variance=0.0, log_factor_variance=0.0, covariance=0.0), certain(0.0), np.zeros(1))
    assert result.sd[0] == pytest.approx(0.01 / np.sqrt(12.0))


@given(st.floats(0.0, 1.0), st.floats(0.0, 0.5), st.floats(0.0, 1.0))
def test_range_grows_with_charge_and_is_zero_below_the_reserve(soc, more, reserve):
    reach = [compute_range(known(s), np.array([reserve]), usual()).km for s in (soc, min(soc + more, 1.0))]
    assert 0.0 <= reach[0].mean[0] <= reach[1].mean[0]
    assert all(each.sd[0] >= 0.0 and np.isfinite(each.sd[0]) for each in reach)
    assert (reach[0].mean[0] == 0.0) == (soc <= reserve)


@given(st.floats(0.3, 1.0), st.floats(-0.3, 0.3))
def test_ride_of_the_length_of_the_range_ends_at_the_reserve(soc, scale):
    estimate = known(soc, log_factor=scale)
    km = compute_range(estimate, np.array([0.1]), usual()).km.mean
    hours = km * usual().ride_pace / 60.0
    end = compute_end_soc(estimate, certain(float((km * usual().driving_energy_per_km)[0])), hours)
    assert end.mean[0] == pytest.approx(0.1, abs=2e-3)


def test_unknown_climb_is_the_usual_and_climbing_takes_more():
    legs = [Leg(6.0, 600.0), Leg(6.0, 600.0, 100.0, 0.0), Leg(6.0, 600.0, None, 100.0), Leg(6.0, 600.0, 0.0, 0.0)]
    plain, up, down, level = (
        compute_planned_legs(Plan("c", 0.0, 0.0, 0.0, legs), statistics().get_tables(2)).energy @ usual().weights[0]
    )
    assert up > plain > down
    assert plain == pytest.approx(level)  # the training rides were level


def test_unknown_temperature_counts_as_mild():
    weights = compute_temperature_weights(np.array([np.nan, 15.0 + ZERO_CELSIUS]))
    assert weights[0].tolist() == weights[1].tolist()
    assert weights.shape == (2, len(TEMPERATURES))
