"""The regression finds planted coefficients, uses only earlier days, and its interval holds what it says."""

import numpy as np
import pandas as pd
import pytest

from socast.core.columns import SECONDS_PER_DAY
from socast.core.evaluate.soc.baselines import compute_baselines
from socast.core.evaluate.soc.cases import select_cases
from socast.core.evaluate.soc.regression import (
    COLD_BELOW,
    FEWEST_ERRORS,
    FEWEST_SHIFTS,
    compute_regression,
    fit_ridge,
    make_terms,
    predict_by_day,
)
from tests.support.soc_frames import CAPACITY, DAY_ONE, make_frames


def make_points(cars=4, days=40, noise=0.0, spread=0.0, seed=1):
    """Return points of shifts that use 0.15 kWh/km, 0.5 kW of waiting and 1 kW of driving in the cold, and some noise.

    Each shift has three points, of which the last is a case. `spread` is the standard deviation of the factor of a car.
    """
    rng = np.random.default_rng(seed)
    factors = np.exp(rng.normal(0.0, spread, cars)) if spread else np.ones(cars)
    rows = []
    for day in range(days):
        for car in range(cars):
            begin = DAY_ONE + SECONDS_PER_DAY * day + 3600.0 * rng.uniform(6.0, 10.0)
            ambient, hours = float(rng.uniform(-15.0, 25.0)), float(rng.uniform(4.0, 6.0))
            error = noise * float(rng.normal())
            for place, left in enumerate((1.0, 0.6, 0.3)):
                km, drive, wait = 90.0 * left, 4.0 * left, (hours - 4.0) * left
                cold = max(COLD_BELOW - ambient, 0.0) / 10.0
                used = factors[car] * (0.15 * km + 0.5 * wait + 1.0 * drive * cold) + error * left
                rows.append(
                    {
                        "case": day * cars + car if place == 2 else -1, "vehicle_id": f"taxi-{car}", "shift": day,
                        "day": np.floor(begin / SECONDS_PER_DAY), "begin_s": begin, "end_s": begin + 3600.0 * hours,
                        "time_s": begin + 3600.0 * hours * (1.0 - left), "charged_s": np.nan, "share": 1.0,
                        "km": km, "drive_h": drive, "wait_h": wait, "ambient_c": ambient, "used_kwh": used,
                        "soc_pct": 90.0 - 100.0 * (1.0 - left) * used / left / CAPACITY, "capacity_kwh": CAPACITY,
                    }
                )  # fmt: skip
    return pd.DataFrame(rows)


def find_errors(points):
    """Return by how much the regression is off. [%]"""
    return predict_by_day(points)["regression"] - (
        points["soc_pct"] - 100.0 * points["used_kwh"] / points["capacity_kwh"]
    )


def test_ridge_recovers_planted_coefficients():
    terms = make_terms(make_points())
    used = terms @ np.arange(1.0, 10.0)
    found = fit_ridge(terms, used, np.ones(len(terms)))
    assert found @ terms.mean(axis=0) == pytest.approx(used.mean(), rel=0.02)


def test_regression_learns_cold_and_waiting():
    errors = find_errors(make_points(days=60)).to_numpy()[-200:]
    assert np.abs(errors).mean() < 0.4


def test_regression_learns_thirsty_cars():
    points = make_points(cars=6, days=60, spread=0.2)
    assert find_errors(points).abs()[points["day"] > points["day"].max() - 10].mean() < 1.2


def test_regression_uses_only_earlier_days():
    points = make_points(noise=2.0)
    whole, cut = predict_by_day(points), points["day"] <= points["day"].min() + 25
    pd.testing.assert_frame_equal(predict_by_day(points[cut].reset_index(drop=True)), whole[cut].reset_index(drop=True))
    later = points.assign(used_kwh=np.where(cut, points["used_kwh"], 1.0))
    pd.testing.assert_frame_equal(predict_by_day(later)[cut], whole[cut])


def test_first_shifts_have_no_expectation_and_later_no_interval():
    points = make_points(cars=2, days=30)
    result, day = predict_by_day(points), (points["day"] - points["day"].min()).to_numpy()
    assert result["regression"].isna().to_numpy()[day < FEWEST_SHIFTS / 2].all()
    assert result["regression"].notna().to_numpy()[day > FEWEST_SHIFTS / 2].all()
    assert result["regression_p05"].isna().to_numpy()[day < (FEWEST_SHIFTS + FEWEST_ERRORS) / 2].all()
    assert result["regression_p05"].notna().to_numpy()[day > (FEWEST_SHIFTS + FEWEST_ERRORS) / 2].all()


def test_interval_holds_what_it_says():
    points = make_points(cars=10, days=60, noise=1.0)
    result = predict_by_day(points)
    became = points["soc_pct"] - 100.0 * points["used_kwh"] / points["capacity_kwh"]
    known = result["regression_p05"].notna()
    inside = (result["regression_p05"] <= became) & (became <= result["regression_p95"])
    assert inside[known].mean() == pytest.approx(0.9, abs=0.04)


def test_every_case_gets_its_own_expectation():
    frames = make_frames(cars=6, days=20, warm_up=0)
    cases = select_cases(*frames).cases
    result = compute_regression(cases, *frames)
    assert len(result) == len(cases)
    pd.testing.assert_frame_equal(result, compute_baselines(cases, *frames)[result.columns])
    at = (cases["hours"] == 2) & (cases["shift"] > 8)
    error, plain = (
        (result["regression"] - cases["soc_end_pct"])[at].abs(),
        (cases["soc_pct"] - cases["soc_end_pct"])[at],
    )
    assert result["regression"][at].notna().all()
    assert error.mean() < 0.5 * plain.mean()


def test_leg_takes_its_share_of_what_is_ahead():
    frames = make_frames(cars=6, days=20, warm_up=0)
    cases = select_cases(*frames).cases
    whole = compute_regression(cases, *frames)
    half = compute_regression(cases.assign(leg=0, ahead_km=cases["ahead_km"] / 2.0), *frames)
    far = whole["regression"].notna() & (whole["regression"] > 0.0) & (cases["hours"] >= 2)
    fall, of_half = cases["soc_pct"] - whole["regression"], cases["soc_pct"] - half["regression"]
    np.testing.assert_allclose(of_half[far], fall[far] / 2.0)


def test_without_plan_habits_tell_what_is_ahead():
    frames = make_frames(cars=6, days=30, warm_up=0)
    outlooks = frames.outlooks.assign(planned=False, ahead_km=np.nan, shift_end_s=np.nan)
    cases = select_cases(outlooks, frames.shifts).cases
    result = compute_regression(cases, outlooks, frames.shifts)
    at = (cases["hours"] == 4) & (cases["shift"] > 8)
    error = (result["regression"] - cases["soc_end_pct"])[at].abs()
    assert error.mean() < 0.5 * (cases["soc_pct"] - cases["soc_end_pct"])[at].mean()
