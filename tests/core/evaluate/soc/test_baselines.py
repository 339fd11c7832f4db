"""Test the baselines at the end of a shift and their empirical risk against sums computed by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.evaluate.soc.baselines import (
    LEAST_ERRORS,
    LEAST_PACE_TIME,
    compute_baselines,
    compute_empirical_risk,
    compute_mean_consumption,
)
from socast.core.evaluate.soc.cases import select_cases
from socast.core.vehicles import load_catalogue
from tests.support.soc_frames import CAPACITY, make_frames

PERCENT = st.floats(0.0, 100.0)


def select_with_baselines(frames):
    """Return the cases of frames, and the expectation of each baseline."""
    cases = select_cases(*frames).cases
    return cases, compute_baselines(cases, *frames)


def test_linear_baseline_is_exact_for_constant_pace():
    frames = make_frames(cars=2, days=3, warm_up=0)
    passed = (frames.outlooks["time_s"] - frames.outlooks["shift_begin_s"]) / (7.0 * 3600.0)
    end = frames.outlooks.merge(frames.shifts[["vehicle_id", "shift", "soc_end_pct"]])["soc_end_pct"].to_numpy()
    even = frames.outlooks.assign(soc_pct=90.0 - passed * (90.0 - end))
    cases, result = select_with_baselines(frames._replace(outlooks=even))
    assert result["linear"].to_numpy() == pytest.approx(cases["soc_end_pct"].to_numpy())


def test_linear_baseline_begins_when_the_car_wakes_up_and_not_at_its_departure():
    frames = make_frames(cars=1, days=1, warm_up=0)
    begin, hours = frames.shifts["begin_s"].iloc[0], 7.0
    soc = 90.0 - 40.0 * (frames.outlooks["time_s"] - begin) / (3600.0 * hours)
    departed = frames.outlooks.assign(soc_pct=soc, soc_begin_pct=82.0)  # heated for a while before
    shifts = frames.shifts.assign(soc_begin_pct=82.0, soc_end_pct=50.0)
    _, result = select_with_baselines(frames._replace(outlooks=departed, shifts=shifts))
    assert result["linear"].dropna().to_numpy() == pytest.approx(50.0)


def test_linear_baseline_restarts_after_charge():
    frames = make_frames(cars=1, days=1, warm_up=0)
    begin = frames.shifts["begin_s"].iloc[0]
    since = (frames.outlooks["time_s"] - begin) / 3600.0
    soc = np.where(since < 2.9, 90.0 - 20.0 * since, 80.0 - 5.0 * (since - 2.9))
    shifts = frames.shifts.assign(charged_s=begin + 2.9 * 3600.0, soc_end_pct=59.5)
    cases, result = select_with_baselines(frames._replace(outlooks=frames.outlooks.assign(soc_pct=soc), shifts=shifts))
    assert cases["hours"].tolist() == [0, 1, 2, 4]
    assert result["linear"].to_numpy()[:3] == pytest.approx(59.5)
    assert np.isnan(result["linear"].iloc[3])  # just charged: nobody has seen a pace


def test_linear_baseline_is_unknown_before_least_pace_time():
    frames = make_frames(cars=1, days=1, hours=2.0 + LEAST_PACE_TIME / 3600.0 / 2.0, warm_up=0)
    cases, result = select_with_baselines(frames)
    assert dict(zip(cases["hours"], np.isfinite(result["linear"]), strict=True)) == {0: True, 1: True, 2: False}


def test_rating_baseline_is_rating_times_planned_distance():
    frames = make_frames(cars=2, days=2, warm_up=0)
    cases, result = select_with_baselines(frames)
    for row, case in enumerate(cases.to_dict("records")):
        used = load_catalogue()[case["vehicle_model"]].rated_kwh_per_km * case["ahead_km"] / CAPACITY
        assert result["rating"].iloc[row] == pytest.approx(max(0.0, case["soc_pct"] - 100.0 * used))
    horse = frames._replace(shifts=frames.shifts.assign(vehicle_model="horse"))
    assert select_with_baselines(horse)[1]["rating"].isna().all()


def test_baselines_stay_between_0_and_100_percent():
    frames = make_frames(cars=2, days=5, warm_up=0)
    outlooks = frames.outlooks.assign(ahead_km=1000.0)
    woken = outlooks["time_s"] == outlooks["shift_begin_s"]
    outlooks["soc_pct"] = np.where(woken, 10.0, outlooks["soc_pct"])
    _, result = select_with_baselines(frames._replace(outlooks=outlooks))
    known = result.to_numpy()[np.isfinite(result.to_numpy())]
    assert known.min() == 0.0
    assert known.max() == 100.0


@given(seed=st.integers(0, 10_000), unknown=st.floats(0.0, 0.5))
@settings(max_examples=25, deadline=None)
def test_mean_consumption_uses_only_earlier_ended_shifts(seed, unknown):
    frames = make_frames(cars=3, days=5, warm_up=0, seed=seed)
    rng = np.random.default_rng(seed)
    lost = rng.random(len(frames.shifts)) < unknown
    shifts = frames.shifts.assign(charged_s=np.where(lost, frames.shifts["begin_s"], np.nan))
    shifts["ride_km"] = np.where(rng.random(len(shifts)) < unknown, 0.0, shifts["ride_km"])
    cases = select_cases(frames.outlooks, shifts).cases
    result = compute_mean_consumption(cases, shifts)
    whole = shifts[shifts["charged_s"].isna() & (shifts["ride_km"] > 0.0)].to_dict("records")
    for case, rate in zip(cases.to_dict("records"), result, strict=True):
        known = [
            shift
            for shift in whole
            if shift["end_s"] <= case["begin_s"] and shift["vehicle_model"] == case["vehicle_model"]
        ]
        energy = sum(shift["soc_begin_pct"] - shift["soc_end_pct"] for shift in known) / 100.0 * CAPACITY
        expected = energy / sum(shift["ride_km"] for shift in known) if known else np.nan
        assert rate == pytest.approx(expected, nan_ok=True)


@given(seed=st.integers(0, 10_000), lost=st.floats(0.0, 0.4))
@settings(max_examples=40, deadline=None)
def test_empirical_risk_uses_only_errors_known_at_forecast_time(seed, lost):
    rng = np.random.default_rng(seed)
    n = 60
    expected = np.where(rng.random(n) < lost, np.nan, rng.integers(20, 60, n))
    became, time = rng.integers(20, 60, n).astype(float), rng.uniform(0.0, 100.0, n)
    ended = time + rng.uniform(0.0, 20.0, n)
    levels = rng.uniform(10.0, 70.0, (n, 3))
    result = compute_empirical_risk(expected, became, time, ended, levels)
    for row in range(n):
        errors = (became - expected)[(ended <= time[row]) & np.isfinite(expected)]
        if np.isnan(expected[row]) or len(errors) < LEAST_ERRORS:
            assert np.isnan(result[row]).all()
        else:
            below = (expected[row] + errors[:, np.newaxis] < levels[row]).sum(axis=0)
            assert result[row] == pytest.approx((below + 0.5) / (len(errors) + 1.0))
