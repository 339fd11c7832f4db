"""Test the SOC filter against planted truths, and with a faulty reported charge."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from socast.core.forecast import filter_state, outlook, soc_filter, soc_reading
from socast.tools.verify.soc_witness import get_covariance
from tests.support.soc_shifts import (
    BEGIN,
    CAPACITY,
    NIGHT,
    PRIOR,
    STEP,
    compute_coverage,
    count_faults,
    run_filter,
    shift,
)

pytestmark = pytest.mark.long

QUANTA = (0.001, 0.005, 0.01)
CARS = 200


@pytest.mark.parametrize("quantum", QUANTA)
@pytest.mark.parametrize("metered", [False, True])
def test_consumption_of_a_fifth_more_is_learned(quantum, metered):
    events, truth = shift(CARS, 4.0, quantum, np.log(1.2), metered=metered, seed=5, step=5.0)
    result = run_filter(events)
    scale, spread = (result.at(name, CARS)[:, -1] for name in ("log_factor", "log_factor_variance"))
    assert 0.8 <= compute_coverage(scale, spread, truth.a[:, -1]) <= 0.97
    assert np.exp(scale - truth.a[:, -1]).mean() == pytest.approx(1.0, abs=0.02)
    assert np.sqrt(spread).max() < 0.7 * np.sqrt(PRIOR)
    assert count_faults(events).freezes.mean() < 0.05


@pytest.mark.parametrize("quantum", QUANTA)
@pytest.mark.parametrize("metered", [False, True])
def test_intervals_cover_unknown_consumption_and_charge(quantum, metered):
    rng = np.random.default_rng(3)
    c = rng.normal(0.0, filter_state.CAPACITY_SD, CARS)
    events, truth = shift(
        CARS, 4.0, quantum, c + rng.normal(0.0, np.sqrt(PRIOR), CARS), c, metered=metered, seed=6, step=5.0
    )
    result = run_filter(events)
    for at in (700, 1400, -1):
        scale, spread = (result.at(name, CARS)[:, at] for name in ("log_factor", "log_factor_variance"))
        assert 0.8 <= compute_coverage(scale, spread, truth.a[:, at] - truth.c) <= 0.97
    off, spread = result.at("soc", CARS) - truth.soc, result.at("variance", CARS)
    assert 0.8 <= compute_coverage(off[:, 700:], spread[:, 700:], 0.0) <= 0.97


@pytest.mark.parametrize("quantum", QUANTA)
def test_capacity_is_learned_over_days_from_voltage_and_current(quantum):
    smaller, state, spread = np.log(0.85), None, [np.full(60, filter_state.CAPACITY_SD)]
    for day in range(5):
        events, _ = shift(60, 4.0, quantum, 0.0, smaller, metered=True, seed=day, begin=BEGIN + NIGHT * day)
        state = run_filter(events, state).state
        spread.append(np.sqrt(state["p_cc"]))
    assert np.exp(state["log_capacity"]).mean() == pytest.approx(0.85, abs=0.01)
    assert all(after.mean() < before.mean() for before, after in pairwise(spread[:3]))
    assert spread[-1].max() < 0.2 * filter_state.CAPACITY_SD


@pytest.mark.parametrize("quantum", QUANTA)
def test_capacity_interval_covers_truth_however_long_it_is_measured(quantum):
    """The gain error of the meter stays in the interval, and the filter follows the ageing of the capacity."""
    rng = np.random.default_rng(21)
    c, state, inside = rng.normal(0.0, filter_state.CAPACITY_SD, CARS), None, []
    for day in range(12):
        c += soc_filter.CAPACITY_AGEING * rng.normal(size=CARS)
        events, _ = shift(CARS, 3.0, quantum, 0.0, c, metered=True, seed=day, begin=BEGIN + NIGHT * day, step=30.0)
        state = run_filter(events, state).state
        sd = np.hypot(np.sqrt(state["p_cc"]), soc_filter.METER_GAIN_SD)
        inside.append(np.abs(state["log_capacity"] - c) < 1.96 * sd)
    assert 0.9 <= np.mean(inside[:3]) <= 0.98
    assert 0.9 <= np.mean(inside[-3:]) <= 0.98
    assert np.sqrt(state["p_cc"]).max() < soc_filter.METER_GAIN_SD


def test_capacity_is_not_identifiable_without_a_meter():
    events, _ = shift(60, 4.0, 0.01, np.log(1.1), 0.0, seed=2)
    result = run_filter(events).state
    assert np.sqrt(result["p_cc"]).min() > 0.5 * filter_state.CAPACITY_SD


@pytest.mark.parametrize("quantum", QUANTA)
def test_quantum_is_assumed_coarse_until_the_first_step(quantum):
    events, truth = shift(50, 1.0, quantum, seed=3, exact=True)
    stepped = (np.diff(events["soc"], axis=1, prepend=events["soc"][:, :1]) != 0.0).cumsum(axis=1) > 0
    events["quantum"] = np.where(stepped, quantum, np.nan)
    result = run_filter(events)
    assert result.at("variance", 50)[:, 0] == pytest.approx(
        np.full(50, filter_state.DEFAULT_QUANTUM**2 / 12.0 + soc_reading.READING_SD**2)
    )
    first = np.argmax(stepped, axis=1)
    off = (result.at("soc", 50) - truth.soc)[np.arange(50), first]
    assert np.abs(off).mean() < 0.2 * soc_reading.READING_SD + 0.1 * quantum
    assert (result.at("quantum", 50)[np.arange(50), first] == quantum).all()


# faulty reported charge


def widths(result, events):
    """Return the standard deviations of the charge at the shift's end and of that of now, (cars, n) each."""
    cars, n = events.shape
    left = events["predicted"][:, -1:] - events["predicted"]
    hours = np.broadcast_to(STEP / 3600.0 * (n - 1 - np.arange(n)), left.shape)
    known = outlook.CarEstimate.from_filter(result.estimates, np.full(left.size, CAPACITY))
    end = outlook.compute_end_soc(known, outlook.MeanAndSd(left.ravel(), np.zeros(left.size)), hours.ravel())
    return end.sd.reshape(cars, n), np.sqrt(result.at("variance", cars))


def add_fault(events, fault, begin, end, by=-0.07):
    """Return events with a faulty charge from one row up to another, and the faulty rows, (n,) bool."""
    rows = np.arange(events.shape[1])
    on = (rows >= begin) & (rows < end)
    bad = events.copy()
    if fault == "frozen":
        bad["soc"][:, on] = events["soc"][:, begin - 1, None]
    elif fault == "absent":
        bad["soc"][:, on] = np.nan
    elif fault == "spike":
        on = rows == begin
        bad["soc"][:, on] += by
    elif fault == "jump":  # the fault is over once the reading has stayed long enough to be accepted
        bad["soc"][:, begin:] += by
        on = (rows >= begin) & (rows < begin + soc_reading.JUMP_CONFIRMATION / STEP)
    return bad, on


FAULTS = ("frozen", "absent", "spike", "jump")
LEAST = 1.0 - 1e-9
"""Smallest ratio of a standard deviation to that without the fault."""


@pytest.mark.parametrize("metered", [False, True])
@pytest.mark.parametrize("fault", FAULTS)
@given(
    seed=st.integers(0, 10_000),
    quantum=st.sampled_from(QUANTA),
    begin=st.integers(2, 478),
    lasting=st.integers(1, 478),
    by=st.floats(0.03, 0.1),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_faulty_soc_never_reduces_any_variance(fault, metered, seed, quantum, begin, lasting, by, sign):
    """This holds during the fault, and after a jump or spike; later the first step after a fault may be more recent.

    Drives with a rejected reading even without the fault are excluded.
    """
    rng = np.random.default_rng(seed)
    c = rng.normal(0.0, filter_state.CAPACITY_SD, 10)
    events, _ = shift(
        10, 2.0, quantum, c + rng.normal(0.0, np.sqrt(PRIOR), 10), c, metered=metered, seed=seed, full=0.8
    )
    bad, on = add_fault(events, fault, begin, begin + lasting, sign * by)
    good = run_filter(events)
    faults = count_faults(events)
    sound = (faults.jumps == 0) & (faults.freezes == 0)
    assume(sound.any())
    (good_end, good_now), (bad_end, bad_now) = widths(good, events), widths(run_filter(bad), events)
    rows = np.arange(len(on)) >= begin if fault in ("spike", "jump") else on
    assert rows.any()
    for result, without in ((bad_end, good_end), (bad_now, good_now)):
        assert (result >= LEAST * without)[np.ix_(sound, rows)].all()
    assert bad_end[sound, begin:].mean() >= 0.999 * good_end[sound, begin:].mean()


@pytest.mark.parametrize("quantum", QUANTA)
def test_long_frozen_soc_is_detected_and_variance_grows(quantum):
    events, truth = shift(50, 4.0, quantum, 0.1, seed=9)
    bad, on = add_fault(events, "frozen", 300, 800)
    result = run_filter(bad)
    assert (count_faults(bad).freezes >= 1).all()
    sd = np.sqrt(result.at("variance", 50)[:, on])
    assert (np.diff(sd, axis=1) > 0.0).all()
    error = np.abs(result.at("soc", 50) - truth.soc)
    assert np.mean(error[:, 799] < 3.0 * sd[:, -1]) > 0.95
    assert (error[:, 799] < np.abs(bad["soc"] - truth.soc)[:, 799]).all()


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("quantum", QUANTA)
def test_filter_recovers_after_a_fault(fault, quantum):
    events, truth = shift(50, 4.0, quantum, 0.1, seed=10)
    bad, on = add_fault(events, fault, 300, 500)
    off = -0.07 if fault == "jump" else 0.0
    result, good = run_filter(bad), run_filter(events)
    later = np.flatnonzero(on)[-1] + 200
    error = result.at("soc", 50)[:, later:] - truth.soc[:, later:] - off
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.sqrt(np.mean((good.at("soc", 50) - truth.soc)[:, later:] ** 2))
    sd = np.median(np.sqrt(result.at("variance", 50) / good.at("variance", 50))[:, later:])
    assert sd > 1.25 if fault == "jump" else 0.8 < sd < 1.25  # which of the two values is right remains unknown


def test_jump_is_accepted_only_after_it_has_stayed():
    events, truth = shift(50, 2.0, 0.01, seed=11)
    bad, on = add_fault(events, "jump", 200, 0)
    result = run_filter(bad)
    soc = result.at("soc", 50)
    assert (np.abs(soc - truth.soc)[:, on] < 0.03).all()
    after = np.flatnonzero(on)[-1] + 1
    assert (np.abs(soc[:, after] - bad["soc"][:, after]) < 0.01).all()
    assert (np.sqrt(result.at("variance", 50)[:, after]) >= 0.5 * soc_reading.JUMP_SD * 0.07).all()
    assert (count_faults(bad).jumps == 1).all()


@pytest.mark.parametrize("quantum", QUANTA)
def test_charge_returns_at_once_when_the_reading_jumps_back(quantum):
    events, truth = shift(50, 4.0, quantum, seed=11)
    bad, on = add_fault(events, "jump", 200, 0)
    back = np.flatnonzero(on)[-1] + 50
    bad["soc"][:, back:] = events["soc"][:, back:]
    result = run_filter(bad)
    assert (np.abs(result.at("soc", 50) - bad["soc"])[:, back - 2] < quantum + 0.01).all()
    after = slice(back + 2, None)
    assert np.mean(np.abs(result.at("soc", 50) - truth.soc)[:, after] < quantum + 0.01) > 0.95
    assert np.median(np.sqrt(result.at("variance", 50)[:, -1])) < 0.01


@pytest.mark.parametrize("quantum", QUANTA)
def test_absent_reading_does_not_hold_the_charge(quantum):
    events, truth = shift(50, 4.0, quantum, metered=True, seed=13)
    bad, on = add_fault(events, "absent", 100, 960)
    soc = run_filter(bad).at("soc", 50)
    assert (truth.soc[:, 100] - truth.soc[:, 900] > 0.1).all()
    assert (np.abs(soc - truth.soc)[:, on] < 0.08).all()


def test_spike_leaves_no_trace():
    events, _ = shift(50, 2.0, 0.01, seed=12)
    bad, _ = add_fault(events, "spike", 200, 0)
    result, good = run_filter(bad), run_filter(events)
    steady = (events["soc"][:, 200:202] == events["soc"][:, 199, None]).all(axis=1)
    assert steady.any()
    assert np.array_equal(result.at("soc", 50)[steady, 201:], good.at("soc", 50)[steady, 201:])
    assert np.array_equal(result.at("variance", 50)[steady, 201:], good.at("variance", 50)[steady, 201:])


def test_soc_is_unknown_when_never_reported():
    events, _ = shift(3, 1.0, seed=1)
    events["soc"] = np.nan
    result = run_filter(events)
    assert np.isnan(result.at("soc")).all()
    for name in ("soc", "reported", "suspect"):
        assert np.isnan(result.state[name]).all()


samples = st.tuples(
    st.sampled_from([15.0, 60.0, 601.0, 7300.0]),
    st.none() | st.floats(0.0, 1.0),
    st.none() | st.floats(-0.5, 5.0),
    st.none() | st.floats(-0.5, 5.0),
    st.booleans(),
    st.booleans(),
)


@given(st.lists(samples, max_size=60), st.sampled_from(QUANTA))
def test_covariance_stays_positive_and_soc_finite_for_any_events(drawn, quantum):
    events = np.zeros(len(drawn), filter_state.FILTER_EVENT)
    time, totals = BEGIN, np.zeros(4)
    for event, (wait, reported, predicted, metered, charging, ends) in zip(events, drawn, strict=True):
        time, size = time + wait, min(wait, 60.0)
        known = metered is not None
        totals += predicted or 0.0, metered or 0.0, size * known, size
        event["kind"], event["time"] = filter_state.CLOSED if ends else filter_state.RUNNING, time
        event["predicted"], event["metered"], event["meter_time"], event["duration"] = totals
        event["predicted"] = np.nan if predicted is None else totals[0]
        event["ambient"], event["quantum"], event["capacity"] = 280.0 * totals[3], quantum, CAPACITY
        event["soc"] = np.nan if reported is None else round(reported / quantum) * quantum
        event["since_charge"] = 0.0 if charging else np.nan
        totals *= not ends
    result = run_filter(events) if len(events) else None
    if result is None:
        return
    known = np.isfinite(result.at("soc")[0])
    assert np.isfinite(result.at("variance")[0][known]).all()
    assert np.isfinite(result.at("log_factor")).all()
    spread = get_covariance(result.state[0])
    if known[-1]:
        assert np.linalg.eigvalsh(spread / np.abs(spread).max()).min() > -1e-9
    prior = filter_state.CAPACITY_SD**2 + filter_state.SHIFT_CAPACITY_SD**2
    assert spread[2, 2] <= prior * (1.0 + 1e-12)


# between rides and shifts


def test_any_cut_of_the_events_gives_the_same_bits():
    parts = [shift(3, 1.0, 0.005, seed=day, begin=BEGIN + NIGHT * day)[0].ravel() for day in range(2)]
    events = np.concatenate(parts)
    events = events[np.argsort(events["time"], kind="stable")]
    whole, state, parts = run_filter(events), None, []
    for cut in np.array_split(events, 37):
        result = run_filter(cut, filter_state.create_filter_state(3) if state is None else state)
        state, parts = result.state, [*parts, result.estimates]
    assert np.concatenate(parts).tobytes() == whole.estimates.tobytes()
    assert state.tobytes() == whole.state.tobytes()


@pytest.mark.parametrize("quantum", QUANTA)
@pytest.mark.parametrize("after", ["night", "charge"])
def test_filter_restarts_at_reported_soc_after_night_and_charging(quantum, after):
    first, _ = shift(20, 2.0, quantum, 0.1, seed=1, exact=True)
    wait = NIGHT if after == "night" else STEP * (first.shape[1] + 40)
    second, _ = shift(20, 2.0, quantum, 0.1, seed=2, begin=BEGIN + wait, full=0.6, exact=True)
    first["kind"][:, -1] = filter_state.CLOSED
    if after == "charge":
        plugged = np.repeat(first[:, -1:], 40, axis=1)
        plugged["kind"], plugged["predicted"], plugged["since_charge"], plugged["soc"] = (
            filter_state.RUNNING,
            0.0,
            0.0,
            0.6,
        )
        plugged["duration"] = STEP * np.arange(1.0, 41.0)
        plugged["time"] = first["time"][:, -1:] + plugged["duration"]
        plugged["distance"] = plugged["ambient"] = 0.0
        plugged["kind"][:, -1] = filter_state.CLOSED
        first = np.concatenate([first, plugged], axis=1)
    events = np.concatenate([first, second], axis=1)
    at = first.shape[1] - (after == "charge")
    result = run_filter(events)
    assert result.at("soc", 20)[:, at] == pytest.approx(events["soc"][:, at], abs=1e-12)
    assert np.sqrt(result.at("variance", 20)[:, at]) == pytest.approx(
        np.hypot(quantum / np.sqrt(12.0), soc_reading.READING_SD)
    )
    assert not count_faults(events).jumps.any()
    assert len(result.shifts) == (20 if after == "night" else 0)
    assert np.isfinite(result.state["charged"]).all() == (after == "charge")


def test_new_shift_begins_with_the_prior_and_keeps_the_share_of_the_car_in_the_capacity():
    first, _ = shift(5, 3.0, 0.001, 0.2, np.log(0.9), metered=True, seed=4)
    second, _ = shift(5, 0.01, 0.001, metered=True, seed=5, begin=BEGIN + NIGHT)
    before = run_filter(first).state
    after = run_filter(second[:, :1], before, prior=(0.15, 0.004)).state
    assert after["log_consumption"] - after["log_capacity"] == pytest.approx(np.full(5, 0.15))
    assert after["p_aa"] + after["p_cc"] - 2.0 * after["p_ac"] == pytest.approx(np.full(5, 0.004))
    of_car, of_shift = before["car_capacity_variance"], filter_state.SHIFT_CAPACITY_SD**2
    share = of_car / (of_car + of_shift)
    revealed = of_car + of_shift - before["p_cc"]
    assert after["log_capacity"] == pytest.approx(share * before["log_capacity"])
    assert after["p_cc"] == pytest.approx(of_car - share**2 * revealed + soc_filter.CAPACITY_AGEING**2 + of_shift)
    assert (after["shift"] == 1.0).all()


def test_closed_shift_agrees_with_its_events():
    first, _ = shift(1, 2.0, 0.01, seed=7, exact=True)
    second, _ = shift(1, 0.1, 0.01, seed=8, begin=BEGIN + NIGHT)
    (row,) = run_filter(np.concatenate([first, second], axis=1)).shifts
    assert (row["shift"], row["begin"], row["end"]) == (0.0, first["time"][0, 0], first["time"][0, -1])
    assert (row["last_soc"], row["lowest_soc"]) == (first["soc"][0, -1], first["soc"].min())
    assert row["begin_soc"] == pytest.approx(0.95)
    assert row["distance"] == pytest.approx(first["distance"][0, -1])
    assert row["hours"] == pytest.approx(2.0, abs=0.02)
    assert row["predicted"] == pytest.approx(first["predicted"][0, -1], rel=0.02)
    assert row["warmth"] / row["hours"] == pytest.approx(283.15)
    assert np.isnan(row["charged"])


@pytest.mark.parametrize("metered", [True, False])
def test_closed_shift_tells_what_it_used_by_its_meter_alone(metered):
    events, _ = shift(5, 3.0, 0.001, np.log(1.2), 0.0, metered=metered, seed=6)
    events["soc"][:, events.shape[1] // 4 :] = np.nan
    result = run_filter(np.column_stack([events, shift(5, 0.01, 0.001, seed=7, begin=BEGIN + NIGHT)[0]]))
    used = result.shifts["metered_used"] / result.shifts["predicted"]
    assert used == pytest.approx(1.2, rel=0.1) if metered else np.isnan(used).all()


def test_car_of_unknown_model_or_capacity_follows_its_reported_soc():
    events, _ = shift(3, 2.0, 0.01, seed=14)
    events["predicted"] = np.nan
    blind = run_filter(events)
    assert (np.abs(blind.at("soc", 3) - events["soc"]) < 0.03).all()
    events["capacity"] = np.nan
    assert np.isfinite(run_filter(events).at("soc", 3)).all()


def show(correction, begin=200, end=240):
    """Return the last estimate of a shift whose display is off for some events, and its state."""
    events, _ = shift(quantum=0.001, exact=True)
    events["soc"][0, begin:end] += correction
    result = run_filter(events)
    return result.estimates[-1], result.state[0]


def test_display_that_corrects_itself_is_not_faulty():
    estimate, state = show(0.02)
    assert np.isnan(estimate["faulty"])
    assert np.isnan(state["faulty"])


def test_fault_does_not_last_once_the_display_has_recovered():
    estimate, state = show(-0.2)
    assert np.isfinite(state["faulty"])
    assert np.isnan(estimate["faulty"])
    late, _ = show(-0.2, begin=-40, end=None)
    assert np.isfinite(late["faulty"])


def test_energy_of_a_shift_with_a_gap_is_unknown():
    events, _ = shift()
    assert np.isfinite(run_filter(events).state["awake_predicted"][0])
    events["time"][0, 300:] += soc_filter.UNSEEN_TIME + 30.0
    assert np.isnan(run_filter(events).state["awake_predicted"][0])


@pytest.mark.parametrize(("kind", "follows"), [(0.0, True), (7.0, False)])
def test_level_is_followed_within_a_vehicle_model(kind, follows):
    events, _ = shift()
    plain = run_filter(events).state["log_consumption"][0]
    events["level"][0, -1], events["car_kind"][0, -1] = 0.2, kind
    changed = run_filter(events).state["log_consumption"][0]
    assert changed == pytest.approx(plain - 0.2 * follows, abs=0.02)
