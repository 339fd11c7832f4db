"""Healthy displays replace outcomes, and impossible bounds are counted unless a charge is planned."""

import numpy as np
import pandas as pd
import pytest

from socast.core.evaluate.soc.cases import count_impossible_bounds, replace_outcomes, select_cases
from socast.core.evaluate.soc.recorders import PLAN_COLUMNS, PlanRecorder
from socast.core.evaluate.soc.records import ImpossibleBounds
from socast.core.evaluate.soc.report import compute_interval_score, evaluate_soc
from socast.core.wire.messages import Message
from tests.support.soc_frames import make_frames


def make_displays(shifts, fault=None):
    """Return displays that fall evenly from 90 to 20 %, minute by minute, and begin a little before the shift."""
    return pd.DataFrame(
        {
            "vehicle_id": shift["vehicle_id"],
            "begin_s": shift["begin_s"] - 2.0,
            "step_s": 60.0,
            "fault": fault,
            "soc_pct": [],
            "shown_pct": np.linspace(90.0, 20.0, int((shift["end_s"] - shift["begin_s"]) / 60.0)).tolist(),
        }
        for shift in shifts.to_dict("records")
    )


def test_outcome_is_what_a_healthy_display_shows():
    shifts = make_frames(cars=2, days=3).shifts.assign(soc_end_pct=np.nan, soc_lowest_pct=np.nan)
    known = shifts[shifts["vehicle_id"] == "taxi-1"]
    result = replace_outcomes(shifts, make_displays(known, "absent"))
    mine = (result["vehicle_id"] == "taxi-1").to_numpy()
    assert result["soc_end_pct"][mine].tolist() == pytest.approx([20.0] * 3, abs=0.2)
    assert result["fault"][mine].tolist() == ["absent"] * 3
    assert result["soc_end_pct"][~mine].isna().all()
    assert (result["fault"][~mine] == "").all()


def test_figures_by_fault_and_by_new_weather_are_told_apart():
    frames = make_frames(cars=4, days=12)
    displays = make_displays(frames.shifts)
    displays["fault"] = np.where(displays["vehicle_id"] == "taxi-0", "frozen", None)
    result = evaluate_soc(*frames, displays=displays)
    assert {part.bin: part.pooled.shifts for part in result.by["display"]} == {"frozen": 10, "healthy": 30}
    assert sum(part.pooled.n for part in result.by["new weather"]) == result.about.forecasts
    assert sum(part.pooled.n for part in result.by["shifts seen"]) == result.about.forecasts


def test_novelty_is_the_distance_from_what_was_met_on_earlier_days():
    frames = make_frames(cars=3, days=6, warm_up=0)
    cold = frames.shifts["shift"] == 5
    outlooks = frames.outlooks.assign(ambient_c=np.where(frames.outlooks["shift"] == 5, -18.0, 5.0))
    cases = select_cases(outlooks, frames.shifts).cases
    first, last = cases["shift"] == 0, cases["shift"] == 5
    assert cold.any()
    assert cases["novelty_k"][first].isna().all()
    assert (cases["novelty_k"][last] == 23.0).all()
    assert (cases["novelty_k"][~first & ~last] == 0.0).all()


def test_bounds_above_the_present_charge_count_without_a_charge_ahead():
    outlooks = pd.DataFrame(
        {"vehicle_id": "a", "shift": 0, "time_s": [1.0, 2.0, 3.0], "soc_pct": 50.0, "soc_p95_pct": [49.0, 51.5, 60.0]}
    )
    assert count_impossible_bounds(outlooks) == ImpossibleBounds(n=3, above=2, largest=10.0)
    plans = pd.DataFrame([("a", 2.5, 1.0, 60.0, True, 80.0)], columns=list(PLAN_COLUMNS))
    assert count_impossible_bounds(outlooks, plans) == ImpossibleBounds(n=2, above=1, largest=1.5)


def test_impossible_bounds_are_remarked():
    frames = make_frames(cars=2, days=6)
    assert any("above the present charge" in note for note in evaluate_soc(*frames).notes)
    within = frames.outlooks.assign(soc_p95_pct=frames.outlooks[["soc_p95_pct", "soc_pct"]].min(axis=1, skipna=False))
    assert evaluate_soc(within, frames.shifts).bounds.above == 0
    assert not any("above the present charge" in note for note in evaluate_soc(within, frames.shifts).notes)


def test_plans_that_cannot_be_read_are_left_out():
    recorder = PlanRecorder()
    for key, payload in (("fleet/a/plan", b"{"), ("fleet/a/plan", b'{"time_s": 1}'), ("fleet/a/ride", b"{}")):
        recorder.record(Message(key, payload, 0))
    assert list(recorder.table().columns) == list(PLAN_COLUMNS)
    assert len(recorder.table()) == 0


def test_interval_score_grows_by_twenty_times_the_miss():
    low, high = np.full(3, 10.0), np.full(3, 20.0)
    assert compute_interval_score(low, high, np.array([10.0, 8.0, 21.5])) == pytest.approx([10.0, 50.0, 40.0])
