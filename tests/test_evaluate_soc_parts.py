"""What a person would expect at a shift's end, and what alarms are worth: against sums done by hand."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soc_frames import CAPACITY, told

from core.evaluate.soc_baselines import SETTLED, baselines, mean_consumption
from core.evaluate.soc_judged import judged
from core.evaluate.soc_reserve import alarms, reserve, risk_below
from core.vehicles import catalogue

PERCENT = st.floats(0.0, 100.0)


def based(frames):
    """Return the cases of frames and what each baseline expects."""
    cases = judged(*frames).cases
    return cases, baselines(cases, *frames)


def test_the_pace_so_far_is_exact_where_it_never_changes():
    frames = told(cars=2, days=3, warm_up=0)
    passed = (frames.outlooks["time_s"] - frames.outlooks["shift_begin_s"]) / (7.0 * 3600.0)
    end = frames.outlooks.merge(frames.shifts[["vehicle_id", "shift", "soc_end_pct"]])["soc_end_pct"].to_numpy()
    even = frames.outlooks.assign(soc_pct=90.0 - passed * (90.0 - end))
    cases, found = based(frames._replace(outlooks=even))
    assert found["linear"].to_numpy() == pytest.approx(cases["soc_end_pct"].to_numpy())


def test_after_a_charge_the_pace_begins_anew():
    frames = told(cars=1, days=1, warm_up=0)
    begin = frames.shifts["begin_s"].iloc[0]
    since = (frames.outlooks["time_s"] - begin) / 3600.0
    soc = np.where(since < 2.9, 90.0 - 20.0 * since, 80.0 - 5.0 * (since - 2.9))
    shifts = frames.shifts.assign(charged_s=begin + 2.9 * 3600.0, soc_end_pct=59.5)
    cases, found = based(frames._replace(outlooks=frames.outlooks.assign(soc_pct=soc), shifts=shifts))
    assert cases["hours"].tolist() == [0, 1, 2, 4]
    assert found["linear"].to_numpy()[:3] == pytest.approx(59.5)
    assert np.isnan(found["linear"].iloc[3])  # just charged: nobody has seen a pace


def test_a_pace_is_not_carried_on_before_it_was_seen():
    frames = told(cars=1, days=1, hours=2.0 + SETTLED / 3600.0 / 2.0, warm_up=0)
    cases, found = based(frames)
    assert dict(zip(cases["hours"], np.isfinite(found["linear"]), strict=True)) == {0: True, 1: True, 2: False}


def test_the_rating_times_the_planned_kilometres():
    frames = told(cars=2, days=2, warm_up=0)
    cases, found = based(frames)
    for row, case in enumerate(cases.to_dict("records")):
        used = catalogue()[case["vehicle_model"]].rated_kwh_per_km * case["ahead_km"] / CAPACITY
        assert found["rating"].iloc[row] == pytest.approx(max(0.0, case["soc_pct"] - 100.0 * used))
    horse = frames._replace(shifts=frames.shifts.assign(vehicle_model="horse"))
    assert based(horse)[1]["rating"].isna().all()


def test_baselines_stay_within_what_a_battery_can_have():
    frames = told(cars=2, days=5, warm_up=0)
    outlooks = frames.outlooks.assign(ahead_km=1000.0, soc_begin_pct=10.0)
    _, found = based(frames._replace(outlooks=outlooks))
    known = found.to_numpy()[np.isfinite(found.to_numpy())]
    assert known.min() == 0.0
    assert known.max() == 100.0


@given(seed=st.integers(0, 10_000), unknown=st.floats(0.0, 0.5))
@settings(max_examples=25, deadline=None)
def test_mean_consumption_is_that_of_shifts_that_had_ended(seed, unknown):
    frames = told(cars=3, days=5, warm_up=0, seed=seed)
    rng = np.random.default_rng(seed)
    lost = rng.random(len(frames.shifts)) < unknown
    shifts = frames.shifts.assign(charged_s=np.where(lost, frames.shifts["begin_s"], np.nan))
    shifts["ride_km"] = np.where(rng.random(len(shifts)) < unknown, 0.0, shifts["ride_km"])
    cases = judged(frames.outlooks, shifts).cases
    found = mean_consumption(cases, shifts)
    for case, rate in zip(cases.to_dict("records"), found, strict=True):
        known = shifts[
            (shifts["end_s"] <= case["begin_s"])
            & (shifts["vehicle_model"] == case["vehicle_model"])
            & shifts["charged_s"].isna()
            & (shifts["ride_km"] > 0.0)
        ]
        energy = (known["soc_begin_pct"] - known["soc_end_pct"]).sum() / 100.0 * CAPACITY
        expected = energy / known["ride_km"].sum() if len(known) else np.nan
        assert rate == pytest.approx(expected, nan_ok=True)


def interval(mean, below, above):
    return pd.DataFrame({"soc_mean_pct": [mean], "soc_p05_pct": [mean - below], "soc_p95_pct": [mean + above]})


@given(mean=PERCENT, below=st.floats(0.01, 30.0), above=st.floats(0.01, 30.0), levels=st.tuples(PERCENT, PERCENT))
def test_the_risk_follows_from_the_interval(mean, below, above, levels):
    cases = interval(mean, below, above)
    ends = [float(risk_below(cases, level)[0]) for level in (mean - below, mean, mean + above)]
    assert ends == pytest.approx([0.05, 0.5, 0.95], abs=1e-6)
    low, high = (float(risk_below(cases, level)[0]) for level in sorted(levels))
    assert 0.0 <= low <= high <= 1.0


def test_without_a_width_there_is_no_doubt():
    assert [float(risk_below(interval(30.0, 0.0, 0.0), level)[0]) for level in (29.0, 31.0)] == [0.0, 1.0]


def test_alarms_counted_by_hand():
    cases = pd.DataFrame(
        {
            "soc_pct": [50.0, 50.0, 50.0, 50.0, 19.0, 50.0],
            "soc_end_pct": [15.0, 15.0, 30.0, 30.0, 10.0, 15.0],
            "soc_lowest_pct": [15.0, 15.0, 30.0, 30.0, 10.0, 15.0],
            "charged_s": np.nan,
        }
    )
    risk = np.array([0.9, 0.04, 0.05, 0.0, 1.0, np.nan])
    found = alarms(cases, np.full(6, 20.0), risk)
    assert {name: found[name] for name in ("shifts", "fell", "caught", "false_alarms")} == {
        "shifts": 4, "fell": 2, "caught": 1, "false_alarms": 1,
    }  # fmt: skip
    assert found["brier"] == pytest.approx((0.1**2 + 0.96**2 + 0.05**2 + 0.0) / 4)
    assert found["brier_base"] == 0.25


def test_a_dip_counts_unless_it_may_have_been_before_a_charge():
    cases = pd.DataFrame({"soc_pct": [50.0], "soc_end_pct": [30.0], "soc_lowest_pct": [15.0], "charged_s": [np.nan]})
    level, risk = np.array([20.0]), np.array([0.5])
    assert alarms(cases, level, risk)["fell"] == 1
    assert alarms(cases.assign(charged_s=1.0), level, risk)["fell"] == 0


def test_sure_forecasts_catch_all_and_raise_no_false_alarm():
    found = reserve(judged(*told(cars=8, days=20, sd_an_hour=1e-6)).cases)
    assert set(found) == {"plan", "20", "30", "40"}
    for of in found.values():
        for own in of.values():
            assert own["caught"] == own["fell"]
            assert own["false_alarms"] == 0
            assert own["brier"] == pytest.approx(0.0, abs=1e-9)
    assert found["30"]["4"]["fell"] > 20


def test_the_risk_of_a_calibrated_forecast_scores_better_than_the_share():
    found = reserve(judged(*told(cars=12, days=40)).cases)
    for level in ("20", "30"):
        for hours in ("1", "2", "4"):
            assert found[level][hours]["brier"] < 0.6 * found[level][hours]["brier_base"]
