"""Test that no leap of a logger's clock and counter silences a car, and that late samples count as late."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.settings import Settings
from tests.core.cleaning.test_clock import WITH_SEQ, cruise, jittered, truth
from tests.support.telemetry import PERIOD, START, cleaned, count, decoded, joined, picked, telemetry, without

N = 300
YEARS = 10 * 365.25 * 86_400.0
A_MINUTE = 20
"""Number of samples after which a stream from the past is believed."""
offsets = st.one_of(st.floats(-4e8, -30.0), st.floats(30.0, 1e9))  # not before 2010, where GPS weeks have rolled over


def moved(columns, rows, seconds):
    """Return columns in which the time and the counter of some rows are later, as if both were right."""
    time, seq = columns["time_s"].copy(), columns["seq"].copy()
    time[rows] += seconds
    seq[rows] = np.maximum(0, seq[rows] + round(seconds / PERIOD))
    return columns | {"time_s": time, "seq": seq}


@given(
    seed=st.integers(0, 2**32 - 1),
    sd=st.sampled_from([0.0, 0.3]),
    at=st.integers(1, 110),
    seconds=st.floats(700.0, 2e9),
    counter=st.sampled_from(["leaps", "continues", "restarts", "backward", "absent"]),
)
def test_single_leaping_sample_costs_at_most_five_samples(seed, sd, at, seconds, counter):
    columns = jittered(sd, seed, n=120)
    wild = moved(columns, at, seconds)
    if counter != "leaps":
        wild["seq"][at] = {"continues": at, "restarts": 0, "backward": max(0, at - 50), "absent": 0}[counter]
    if counter == "absent":
        columns, wild = without(columns, "seq"), without(wild, "seq")
    clean, plain = cleaned(wild), cleaned(columns)
    assert np.all(clean.dt[at + 5 :] > 0)
    assert clean.time[at + 5 :] == pytest.approx(plain.time[at + 5 :], abs=max(3 * sd, 1e-5))
    assert count(clean, Quality.LATE) <= 1


def test_sample_whose_time_and_counter_leap_ten_years_costs_itself_only():
    columns = cruise(N)
    clean, plain = cleaned(moved(columns, 100, YEARS)), cleaned(columns)
    others = np.arange(N) != 100
    assert clean.time[others] == pytest.approx(plain.time[others], abs=1e-6)
    assert clean.quality[100] & Quality.REPAIRED_TIME
    assert clean.dt[100] == 0
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1))


@given(
    seed=st.integers(0, 2**32 - 1),
    sd=st.sampled_from([0.0, 0.3, 0.5]),
    at=st.integers(20, 200),
    seconds=offsets,
    seq=st.booleans(),
)
def test_stream_with_constant_offset_is_believed_after_a_minute(seed, sd, at, seconds, seq):
    columns = moved(jittered(sd, seed, n=N) | {"seq": np.arange(N) + 10**9}, slice(at, None), seconds)
    clean = cleaned(columns if seq else without(columns, "seq"))
    later = slice(at + A_MINUTE + (5 if seq else 15), None)  # jitter may bring samples out of order
    assert np.abs(clean.time[later] - columns["time_s"][later]).max() <= PERIOD + 4 * sd
    assert not (clean.quality[later] & Quality.LATE).any()


@pytest.mark.parametrize("back", [90.0, 3600.0, YEARS])
def test_time_and_counter_set_back_are_believed_after_twenty_samples_and_keep_the_duration(back):
    columns = moved(jittered(0.2, 2, n=N) | {"seq": np.arange(N) + 10**9}, slice(150, None), -back)
    clean = cleaned(columns)
    late = np.flatnonzero(clean.quality & Quality.LATE)
    assert late.tolist() == list(range(150, 150 + A_MINUTE - 1))
    assert count(clean, Quality.CLOCK_STEP) == 1
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.5)


def test_logger_that_restarts_with_the_time_of_its_last_start_is_believed_after_twenty_samples():
    first, second = jittered(0.2, 2, n=N), jittered(0.2, 3, n=N)
    clean = cleaned(joined(first, second))
    assert count(clean, Quality.LATE) == A_MINUTE - 1
    assert np.abs(clean.time[N + A_MINUTE + 1 :] - truth(N)[A_MINUTE + 1 :]).max() < 1.0


def test_first_samples_ten_years_ahead_cost_a_minute():
    clean = cleaned(moved(cruise(N), [0], YEARS))
    assert count(clean, Quality.LATE) == A_MINUTE - 1
    assert clean.time[A_MINUTE:] == pytest.approx(truth(N)[A_MINUTE:], abs=1e-6)
    two = cleaned(moved(cruise(N), [100, 101], YEARS))  # the second sample confirms the first
    assert count(two, Quality.LATE) == A_MINUTE - 1
    assert two.time[102 + A_MINUTE :] == pytest.approx(truth(N)[102 + A_MINUTE :], abs=1e-6)


def test_silenced_car_recovers_from_its_saved_state():
    columns = moved(cruise(N), [100, 101], YEARS)
    batch = decoded(telemetry(columns))
    before, after = Cleaner(Settings()), Cleaner(Settings())
    before.clean(batch.rows(0, 110), 1)
    after.load(before.dump())
    clean = after.clean(batch.rows(110, N), 1)
    assert clean.time[A_MINUTE:] == pytest.approx(truth(N)[110 + A_MINUTE :], abs=1e-6)


@pytest.mark.parametrize("missing", [19, 60, 300, 1200])
@pytest.mark.parametrize("newer", [1, 40])
@pytest.mark.parametrize("sd", [0.0, 0.3])
def test_samples_of_an_outage_that_come_after_newer_ones_stay_late_however_many(missing, newer, sd):
    n = 200 + missing + newer + 100
    resumed = 200 + missing + 1  # a leap of more than 200 samples costs the first sample after it
    order = np.concatenate([np.arange(200), np.arange(resumed - 1, resumed + newer), np.arange(200, resumed - 1)])
    order = np.concatenate([order, np.arange(resumed + newer, n)])
    columns = jittered(sd, 4, n=n)
    clean = cleaned(picked(columns, order), Settings(gap_time=86_400.0))
    assert count(clean, Quality.LATE) == missing
    assert count(clean, Quality.CLOCK_STEP) == 0
    assert clean.dt.sum() == pytest.approx(PERIOD * (n - 1), abs=1.5)


def test_clock_set_back_into_an_outage_is_believed_once_it_leaves_the_outage():
    keep = np.r_[0:100, 160:N]
    columns = picked(jittered(0.2, 4, n=N) | {"seq": np.arange(N) + 1000}, keep)
    columns = moved(columns, slice(150, None), -PERIOD * 90)  # from sample 210 to 120
    clean = cleaned(columns)
    assert count(clean, Quality.LATE) == 160 - 120 + A_MINUTE - 1
    assert np.abs(clean.time[215:] - columns["time_s"][215:]).max() < 1.0


@pytest.mark.parametrize("pause", [900.0, 43_200.0, 86_400.0 * 20])
@WITH_SEQ
def test_power_cycle_after_a_long_pause_costs_no_sample_with_a_counter(pause, seq):
    first, second = cruise(100), cruise(100)
    second["time_s"] = second["time_s"] + 100 * PERIOD + pause
    columns = joined(first, second)
    clean = cleaned(columns if seq else without(columns, "seq"), Settings(gap_time=86_400.0))
    lost = (clean.quality & Quality.REPAIRED_TIME) != 0
    assert np.flatnonzero(lost).tolist() == ([] if seq else [100])
    assert clean.time[-1] == START + 199 * PERIOD + pause
