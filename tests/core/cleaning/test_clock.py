"""Test the repair of time against the accuracy that the docstring of `socast.core.cleaning.clock` states."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.quality import Quality
from socast.core.settings import Settings
from tests.support.telemetry import PERIOD, START, cleaned, count, drive, joined, picked, without

N = 800
SETTLED = 100
ONE_RIDE = Settings(gap_time=86_400.0)
"""With which no silence within a test ends the ride, whose first step counts no time."""
WITH_SEQ = pytest.mark.parametrize("seq", [True, False], ids=["seq", "stamps"])


def cruise(n=N, **columns):
    """Return a drive at constant speed without positions, because these tests use only time."""
    return without(drive(n, speed=10.0, **columns), "latitude_deg", "longitude_deg", "metres")


def jittered(sd, seed, n=N, seq=True):
    columns = cruise(n, soc_pct=90 - 0.01 * np.arange(n))
    columns["time_s"] += np.random.default_rng(seed).normal(0, sd, n)
    return columns if seq else without(columns, "seq")


def truth(n=N, period=PERIOD):
    return START + period * np.arange(n)


@pytest.mark.parametrize("sd", [0.1, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_counter_reduces_jitter_to_a_fifth(sd, seed):
    clean = cleaned(jittered(sd, seed))
    error = (clean.time - truth())[SETTLED:]
    assert np.sqrt(np.mean(error**2)) < 0.23 * sd
    assert np.abs(error).max() < max(0.9 * sd, 0.1)
    assert clean.dt[SETTLED + 1 :].sum() == pytest.approx(PERIOD * (N - SETTLED - 1), abs=0.6 * sd + 0.02)
    assert count(clean, Quality.GAP | Quality.LATE | Quality.CLOCK_STEP | Quality.SEQUENCE) == 0
    raw = cleaned(jittered(sd, seed)).time  # far better than the stamps
    assert np.array_equal(raw, clean.time)
    assert error.std() < 0.3 * (jittered(sd, seed)["time_s"] - truth())[SETTLED:].std()


@pytest.mark.parametrize("sd", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_jitter_up_to_half_a_second_is_repaired_without_counter(sd, seed):
    clean = cleaned(jittered(sd, seed, seq=False))
    error = (clean.time - truth())[SETTLED:]
    assert np.sqrt(np.mean(error**2)) < 0.3 * sd
    assert clean.dt[SETTLED + 1 :].sum() == pytest.approx(PERIOD * (N - SETTLED - 1), abs=0.8 * sd)
    assert count(clean, Quality.GAP) <= 3


def test_error_for_a_second_of_jitter_without_counter_stays_within_documented_limits():
    drives = [cleaned(jittered(1.0, seed, seq=False)) for seed in range(8)]
    errors = np.array([(clean.time - truth())[SETTLED:] for clean in drives])
    assert np.sqrt(np.mean(errors**2)) < 0.65
    assert np.mean(np.abs(errors) > PERIOD / 2) < 0.04
    for clean in drives:
        assert clean.dt[SETTLED + 1 :].sum() == pytest.approx(PERIOD * (N - SETTLED - 1), abs=3.0)


@WITH_SEQ
@pytest.mark.parametrize("sd", [0.0, 0.3])
def test_gap_lasts_a_whole_number_of_periods(seq, sd):
    columns = jittered(sd, 3, seq=seq)
    keep = np.ones(N, bool)
    for at, missing in ((200, 1), (300, 2), (400, 7), (600, 90)):
        keep[at : at + missing] = False
    clean = cleaned(picked(columns, keep))
    gaps = (clean.quality & Quality.GAP) != 0
    assert np.round(clean.dt[gaps] / PERIOD).tolist() == [2, 3, 8, 91]
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.0)
    assert np.abs((clean.time - truth()[keep])[SETTLED:]).max() < max(2 * sd, 1e-6)


@pytest.mark.parametrize("sd", [0.0, 0.3, 1.0])
def test_loss_of_a_tenth_of_the_samples_keeps_the_duration_with_a_counter(sd):
    rng = np.random.default_rng(5)
    keep = rng.random(N) > 0.1
    keep[[0, -1]] = True
    clean = cleaned(picked(jittered(sd, 5), keep))
    error = (clean.time - truth()[keep])[SETTLED:]
    assert np.sqrt(np.mean(error**2)) <= 0.25 * sd + 1e-6
    missing = np.diff(np.flatnonzero(keep)) > 1
    assert np.array_equal((clean.quality[1:] & Quality.GAP) != 0, missing)


@WITH_SEQ
def test_repeated_stamps_are_ignored(seq):
    columns = cruise(soc_pct=90 - 0.01 * np.arange(N))  # the content changes, so these are no duplicates
    repeated = np.arange(7, N - 1, 20)
    columns["time_s"][repeated] = columns["time_s"][repeated - 1]
    clean = cleaned(columns if seq else without(columns, "seq"))
    assert np.abs(clean.time - truth()).max() < 0.05
    assert np.all(clean.quality[repeated] & Quality.REPAIRED_TIME)
    assert count(clean, Quality.DUPLICATE | Quality.LATE | Quality.GAP) == 0


@WITH_SEQ
def test_time_advances_by_the_period_over_missing_and_huge_stamps(seq):
    columns = jittered(0.3, 1, seq=seq)
    columns["time_s"][10::25] = np.tile([1e300, -5.0, 9e9, 1e11], N)[: len(columns["time_s"][10::25])]
    clean = cleaned(columns)
    assert count(clean, Quality.OUT_OF_RANGE) == len(columns["time_s"][10::25])
    assert np.abs((clean.time - truth())[SETTLED:]).max() < 0.4
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.0)


@pytest.mark.parametrize("step", [4.0, 20.0, 500.0, -4.0, -20.0, -500.0, -3e7])
@pytest.mark.parametrize("sd", [0.0, 0.3])
def test_clock_that_is_set_while_the_counter_runs_keeps_the_duration(step, sd):
    columns = jittered(sd, 2)
    columns["time_s"][400:] += step
    clean = cleaned(columns)
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.5)
    assert count(clean, Quality.CLOCK_STEP) == 1
    assert np.all(clean.dt[1:] > 0)
    after = clean.time[403:] - truth()[403:] - step
    assert np.abs(after).max() < max(3 * sd, 1e-6)


def test_clock_set_back_without_counter_is_accepted_after_ten_samples_and_keeps_the_duration():
    columns = jittered(0.2, 2, seq=False)
    columns["time_s"][400:] -= 500.0
    clean = cleaned(columns)
    assert count(clean, Quality.LATE) == 9
    assert count(clean, Quality.CLOCK_STEP) == 1
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(PERIOD * (N - 1), abs=1.5)


def test_clock_set_forward_without_counter_counts_as_a_gap():
    columns = jittered(0.2, 2, seq=False)
    columns["time_s"][400:] += 600.0
    clean = cleaned(columns, ONE_RIDE)
    assert count(clean, Quality.GAP) == 1
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1) + 600.0, abs=1.5)


@WITH_SEQ
def test_time_that_runs_backwards_for_a_minute_keeps_the_duration(seq):
    columns = jittered(0.0, 2, seq=seq)
    columns["time_s"][400:420] = columns["time_s"][399] - PERIOD * np.arange(1, 21)
    clean = cleaned(columns)
    used = clean.dt > 0
    assert clean.dt[used].sum() == pytest.approx(PERIOD * (N - 1))
    assert np.abs(clean.time[425:] - truth()[425:]).max() < 1e-6
    assert count(clean, Quality.LATE) == (0 if seq else 20)
    assert np.diff(clean.time).min() >= 0


@pytest.mark.parametrize("period", [0.5, 1.0, 2.0, 4.0, 5.0, 10.0, 30.0])
@WITH_SEQ
def test_period_other_than_nominal_is_estimated(period, seq):
    columns = cruise(300, soc_pct=90 - 0.01 * np.arange(300))
    columns["time_s"] = truth(300, period) + np.random.default_rng(4).normal(0, 0.03 * period, 300)
    clean = cleaned(columns if seq else without(columns, "seq"))
    error = (clean.time - truth(300, period))[SETTLED:]
    assert np.abs(error).max() < 0.25 * period
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(period * 299, abs=0.3 * period)
    assert count(clean, Quality.CLOCK_STEP) == 0
    assert np.mean((clean.quality[SETTLED:] & Quality.GAP) != 0) == 0


@pytest.mark.parametrize("ppm", [100, -100, 1000])
@pytest.mark.parametrize("sd", [0.0, 0.5, 1.0])
def test_drifting_clock_is_followed(ppm, sd):
    columns = jittered(sd, 6)
    columns["time_s"] += ppm * 1e-6 * (truth() - START)
    clean = cleaned(columns)
    error = clean.time - truth() - ppm * 1e-6 * (truth() - START)
    assert np.abs(error[SETTLED:].mean()) < 0.1 * sd + 0.02
    assert error[SETTLED:].std() < 0.25 * sd + 0.01


@WITH_SEQ
def test_swapped_neighbours_keep_the_duration(seq):
    order = np.arange(N)
    for at in range(20, N - 2, 30):
        order[[at, at + 1]] = order[[at + 1, at]]
    clean = cleaned(picked(jittered(0.1, 1, seq=seq), order))
    late = (clean.quality & Quality.LATE) != 0
    assert late.sum() == len(range(20, N - 2, 30))
    assert np.all(clean.dt[late] <= 0)
    assert np.all(clean.distance[late] == 0)
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(PERIOD * (N - 1), abs=0.5)


@pytest.mark.parametrize(("length", "seq"), [(3, True), (60, True), (9, False)])
def test_backlog_counts_as_late_and_changes_nothing_else(length, seq):
    order = np.concatenate(
        [np.arange(300), np.arange(300 + length, 420), np.arange(300, 300 + length), np.arange(420, N)]
    )
    clean = cleaned(picked(jittered(0.1, 1, seq=seq), order))
    assert count(clean, Quality.LATE) == length
    assert count(clean, Quality.CLOCK_STEP) == 0
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(PERIOD * (N - 1), abs=0.5)


def test_restart_of_the_counter_after_a_power_cycle_keeps_the_duration():
    columns = jittered(0.3, 2)
    columns["seq"][400:] -= 400
    columns["time_s"][400:] += 60.0
    clean = cleaned(columns)
    assert count(clean, Quality.SEQUENCE) == 1
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1) + 60.0, abs=1.0)
    early = jittered(0.3, 2)
    early["seq"][20:] -= 20  # a restart that could be a late sample by the counter alone
    clean = cleaned(early)
    assert count(clean, Quality.SEQUENCE) == 1
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.0)


@pytest.mark.parametrize("counter", ["constant", "tens", "byte", "random"])
def test_broken_counter_is_ignored(counter):
    columns = jittered(0.3, 2)
    broken = {
        "constant": np.zeros(N, int),
        "tens": 10 * np.arange(N),
        "byte": np.arange(N) % 256,
        "random": np.random.default_rng(0).integers(0, 10**6, N),
    }
    columns["seq"] = broken[counter]
    clean = cleaned(columns)
    assert count(clean, Quality.SEQUENCE) >= (3 if counter == "byte" else N - 10)
    assert count(clean, Quality.DUPLICATE | Quality.LATE) == 0
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(PERIOD * (N - 1), abs=1.0)


def test_stationary_car_with_constant_counter_has_no_duplicates():
    columns = without(drive(200, speed=0.0), "metres") | {"seq": np.full(200, 7)}
    clean = cleaned(columns)
    assert count(clean, Quality.DUPLICATE) == 0
    assert clean.dt.sum() == pytest.approx(PERIOD * 199)


def test_jump_of_the_counter_without_elapsed_time_is_rejected():
    columns = jittered(0.1, 2)
    columns["seq"][400] = 10**9
    clean = cleaned(columns)
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=0.5)
    assert count(clean, Quality.SEQUENCE) == 2


def test_two_cars_with_one_identity_are_flagged_and_add_no_time():
    first, second = cruise(200), cruise(200)
    second["seq"] = second["seq"] + 5000
    second["time_s"] = second["time_s"] + 1.2
    order = np.argsort(np.concatenate([np.arange(200), np.arange(200) + 0.5]))
    clean = cleaned(picked(joined(first, second), order))
    assert count(clean, Quality.SEQUENCE) >= 395
    assert clean.dt[clean.dt > 0].sum() == pytest.approx(PERIOD * 199, abs=4.0)


def test_first_sample_without_stamp_waits_for_a_stamp():
    columns = cruise(10)
    columns["time_s"][0] = 1e300
    clean = cleaned(columns)
    assert clean.dt[0] <= 0
    assert clean.time[1] == START + PERIOD
    assert clean.dt.sum() == pytest.approx(8 * PERIOD, abs=1.0 + PERIOD)


@given(
    seed=st.integers(0, 2**32 - 1),
    sd=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    seq=st.booleans(),
    lost=st.floats(0, 0.3),
    twice=st.floats(0, 0.3),
    moved=st.floats(0, 0.1),
)
def test_time_never_decreases_and_no_step_is_negative(seed, sd, seq, lost, twice, moved):
    rng = np.random.default_rng(seed)
    columns = jittered(sd, seed, n=120, seq=seq)
    place = np.arange(120) + np.where(rng.random(120) < moved, rng.normal(0, 4, 120), 0.0)
    order = np.argsort(place, kind="stable")
    order = np.repeat(order, np.where(rng.random(120) < twice, 2, 1))
    order = order[rng.random(len(order)) >= lost]
    clean = cleaned(picked(columns, order))
    assert np.all(clean.dt >= 0)
    assert np.all(np.isfinite(clean.time))
    ticked = np.diff(clean.time, prepend=clean.time[:1])
    steps = (clean.quality & Quality.CLOCK_STEP) != 0
    assert ticked[~steps] == pytest.approx(clean.dt[~steps], abs=1e-5)  # a clock that is set changes its time at once
    assert seq is False or lost > 0.2 or not steps.any()  # see the next test


@pytest.mark.xfail(reason="a clock of 1 s jitter that loses a quarter of its samples seems to be set", strict=True)
def test_jitter_with_many_lost_samples_is_no_clock_step():
    rng = np.random.default_rng(3628)
    columns = jittered(1.0, 3628, n=120, seq=True)
    rng.random(120), rng.normal(0, 4, 120), rng.random(120)
    clean = cleaned(picked(columns, np.arange(120)[rng.random(120) >= 0.25]))
    assert not ((clean.quality & Quality.CLOCK_STEP) != 0).any()


def test_nominal_period_follows_the_settings():
    columns = cruise(60)
    columns["time_s"] = truth(60, 10.0)
    clean = cleaned(columns, Settings(period=10.0))
    assert clean.dt[1:].tolist() == [10.0] * 59
    assert count(clean, Quality.GAP) == 0


@pytest.mark.parametrize("ahead", [3600.0, 86_400.0, 2.3e9])
def test_single_wrong_stamp_is_rejected_without_counter(ahead):
    columns = without(drive(300), "seq")
    columns["time_s"][100] += ahead
    clean = cleaned(columns)
    assert clean.dt.sum() == pytest.approx(PERIOD * 299, abs=0.1)
    assert clean.time[-1] == pytest.approx(START + PERIOD * 299, abs=0.1)
    assert count(clean, Quality.LATE | Quality.CLOCK_STEP) == 0
    assert clean.quality[100] & Quality.REPAIRED_TIME
    assert np.flatnonzero(clean.quality & Quality.GAP).tolist() == [101]


@given(
    seed=st.integers(0, 2**32 - 1),
    sd=st.sampled_from([0.0, 0.3, 1.0]),
    at=st.integers(1, 118),
    ahead=st.floats(1000.0, 1e9),
    stuck=st.booleans(),
)
def test_single_wrong_stamp_loses_only_its_sample(seed, sd, at, ahead, stuck):
    columns = jittered(sd, seed, n=120, seq=False)
    if stuck:
        columns["seq"] = np.full(120, 7)
    others = np.arange(120) != at
    plain = cleaned(picked(columns, others))
    columns["time_s"][at] += ahead
    wild = cleaned(columns)
    for name, one, other in zip(Clean._fields, wild, plain, strict=True):
        assert np.array_equal(one[others], other, equal_nan=True), name
    assert wild.dt[at] == 0
    assert wild.time[at] == wild.time[at - 1]
    assert wild.quality[at] & Quality.REPAIRED_TIME


def test_long_silence_without_counter_is_a_gap_once_a_second_stamp_confirms_it():
    columns = without(drive(300), "seq")
    columns["time_s"][150:] += 7200.0
    clean = cleaned(columns, ONE_RIDE)
    assert clean.dt.sum() == pytest.approx(PERIOD * 299 + 7200, abs=0.1)
    assert np.flatnonzero(clean.quality & Quality.GAP).tolist() == [151]
    assert np.flatnonzero(clean.quality & Quality.REPAIRED_TIME).tolist() == [150]
    others = np.arange(300) != 150
    assert clean.time[others] == pytest.approx(columns["time_s"][others], abs=0.1)


@pytest.mark.parametrize("silence", [300.0, 28_801.3])
@pytest.mark.parametrize("sd", [0.1, 0.3, 0.5])
def test_silence_with_jitter_and_without_counter_keeps_the_duration(silence, sd):
    for seed in range(25):
        columns = jittered(sd, seed, n=300, seq=False)
        columns["time_s"][150:] += silence
        clean = cleaned(columns, ONE_RIDE)
        assert clean.dt.sum() == pytest.approx(PERIOD * 299 + silence, abs=2.5 * sd)
        assert np.sqrt(np.mean((clean.time - truth(300) - silence)[151:] ** 2)) < sd
        assert count(clean, Quality.LATE | Quality.CLOCK_STEP) == 0


def test_third_stamp_decides_when_the_second_is_before_the_first():
    columns = without(drive(300), "seq")
    columns["time_s"][150:] += 7200.0
    columns["time_s"][150] += 4.0
    clean = cleaned(columns, ONE_RIDE)
    assert np.flatnonzero(clean.quality & Quality.GAP).tolist() == [152]
    assert np.flatnonzero(clean.quality & Quality.REPAIRED_TIME).tolist() == [150, 151]
    assert clean.dt.sum() == pytest.approx(PERIOD * 299 + 7200, abs=0.1)


def test_samples_too_rare_to_confirm_each_other_are_not_used():
    columns = without(drive(100), "seq")
    columns["time_s"][90:] += 3600.0 * np.arange(1, 11)
    clean = cleaned(columns)
    assert np.flatnonzero(clean.quality & Quality.REPAIRED_TIME).tolist() == list(range(90, 100))
    assert clean.dt.sum() == pytest.approx(PERIOD * 89, abs=0.1)


@pytest.mark.parametrize("period", [30.0, 60.0])
def test_clock_of_a_slow_logger_set_back_without_counter_is_accepted_after_five_samples(period):
    columns = cruise(100)
    columns["time_s"] = START + period * np.arange(100)
    columns["time_s"][50:] -= 5000.0
    clean = cleaned(without(columns, "seq"), ONE_RIDE, period=period)
    assert count(clean, Quality.LATE) == 4
    assert clean.dt[clean.dt > 0.0].sum() == pytest.approx(period * 99, abs=1.5)


@pytest.mark.parametrize("at", [4, 7, 40])
def test_clock_set_back_soon_after_the_start_does_not_change_the_period(at):
    columns = cruise(100)
    columns["time_s"] = START + 60.0 * np.arange(100)
    columns["time_s"][at:] -= 700.0
    clean = cleaned(columns, ONE_RIDE, period=60.0)
    assert clean.dt[1:] == pytest.approx(60.0, abs=1.0)


@pytest.mark.parametrize("seed", range(4))
def test_whole_seconds_do_not_make_a_logger_one_without_a_period(seed):
    n = 1500
    columns = cruise(n, soc_pct=90 - 0.01 * np.arange(n))
    error = np.random.default_rng(seed).normal(0.0, 0.05, n)
    columns["time_s"] = np.floor(START + np.arange(n) + error)
    clean = cleaned(columns, ONE_RIDE)
    assert clean.dt[50:] == pytest.approx(1.0, abs=0.6)
    assert clean.dt.sum() == pytest.approx(n - 1, rel=0.02)


@pytest.mark.parametrize("period", [8.0, 10.0, 20.0, 30.0, 60.0])
def test_period_that_nothing_announces_costs_no_time_without_a_counter(period):
    columns = cruise(100)
    columns["time_s"] = START + period * np.arange(100)
    clean = cleaned(without(columns, "seq"), ONE_RIDE)
    assert clean.dt[1:] == pytest.approx(period, abs=0.05 * period)
