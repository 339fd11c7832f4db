"""`socast replay` compares the forecasts of each shift with its outcome."""

import io
import json
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from socast.tools.terminal import shift_outcomes
from socast.tools.terminal.shift_outcomes import AHEAD, NO_INTERVALS, ShiftOutcomes, show_outcomes, summary
from tests.support.commands import done
from tests.support.fleet_days import CARS, DAYS, SHIFT, recorded, shift, trained_pipeline
from tests.support.soc_frames import make_frames


class Recited:
    """Gives forecasts and shifts in parts, as a pipeline does."""

    def __init__(self, outlooks, shifts, cuts):
        edges = [-np.inf, *sorted(cuts), np.inf]
        ended = shifts["end_s"] + 7200.0
        self._parts = [
            (outlooks[(outlooks["time_s"] > a) & (outlooks["time_s"] <= b)], shifts[(ended > a) & (ended <= b)])
            for a, b in pairwise(edges)
        ]
        self._at = -1

    def take_outlooks(self):
        self._at += 1
        return self._parts[self._at][0] if self._at < len(self._parts) else self._parts[0][0][:0]

    def take_shifts(self):
        return self._parts[self._at][1] if self._at < len(self._parts) else self._parts[0][1][:0]

    def __len__(self):
        return len(self._parts)


def records(outlooks, shifts, cuts=()):
    recited = Recited(outlooks.sort_values("time_s", kind="stable"), shifts, cuts)
    outcomes = ShiftOutcomes(recited)
    for _ in range(len(recited) - 1):
        outcomes()
    return outcomes.records()


def printed(shifts, width=140):
    console = Console(file=io.StringIO(), width=width)
    show_outcomes(console, shifts)
    return console.file.getvalue()


def test_record_of_each_shift_holds_forecasts_by_time_made():
    made, ended = make_frames(cars=2, days=3, hours=7.0, warm_up=1)
    collected = records(made, ended)
    assert [(s["vehicle_id"], s["begin_s"]) for s in collected] == sorted(
        zip(ended["vehicle_id"], ended["begin_s"], strict=True), key=lambda each: each[1]
    )
    for shift_ in collected:
        of_shift = made[(made["vehicle_id"] == shift_["vehicle_id"]) & (made["shift_begin_s"] == shift_["begin_s"])]
        if np.isnan(of_shift["soc_mean_pct"].iloc[0]):
            assert set(shift_["forecasts"].values()) == {None}
            continue
        wanted = {"begin": shift_["begin_s"]} | {name: shift_["end_s"] - ahead for name, ahead in AHEAD.items()}
        for name, time in wanted.items():
            row = of_shift[of_shift["time_s"] <= time].iloc[-1]
            forecast = shift_["forecasts"][name]
            assert (forecast["time_s"], forecast["mean"]) == (row["time_s"], row["soc_mean_pct"])
            assert forecast["held"] == (row["soc_p05_pct"] <= shift_["soc_end_pct"] <= row["soc_p95_pct"])
    assert json.loads(json.dumps(collected)) == collected


@given(cuts=st.lists(st.floats(1_514_764_800.0, 1_514_764_800.0 + 4 * 86_400.0), max_size=8), rows=st.integers(0, 3000))
def test_order_of_delivery_and_deleted_forecasts_never_change_records(cuts, rows):
    made, ended = make_frames(cars=3, days=3, warm_up=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shift_outcomes, "MOST_ROWS", rows)
        assert records(made, ended, cuts) == records(made, ended)


def test_deleted_forecasts_bound_memory(monkeypatch):
    monkeypatch.setattr(shift_outcomes, "MOST_ROWS", 500)
    made, ended = make_frames(cars=1, days=10, warm_up=0)
    outcomes = ShiftOutcomes(Recited(made, ended, made["time_s"].to_numpy()[::100]))
    for _ in range(len(made) // 100):
        outcomes()
        assert sum(map(len, outcomes._forecasts)) < 800


def test_forecast_before_charge_or_of_unfinished_shift_is_not_evaluated():
    made, ended = make_frames(cars=1, days=1, warm_up=0)
    at = ended["end_s"].iloc[0] - 5400.0
    (shift_,) = records(made, ended.assign(charged_s=at))
    assert [f["held"] is None for f in shift_["forecasts"].values()] == [True, True, False]
    assert f"charged {pd.Timestamp(at, unit='s'):%H:%M}" in printed([shift_])
    (shift_,) = records(made.assign(shift_end_s=made["shift_end_s"] + 3600.0), ended)
    assert shift_["cut"]
    assert all(f["held"] is None for f in shift_["forecasts"].values())
    assert "in progress" in printed([shift_])
    (shift_,) = records(made, ended.assign(soc_end_pct=np.nan))
    assert all(f["held"] is None for f in shift_["forecasts"].values())


def test_outdated_forecast_is_none():
    made, ended = make_frames(cars=1, days=1, warm_up=0)
    end = ended["end_s"].iloc[0]
    (shift_,) = records(made[~made["time_s"].between(end - 3600.0 - 700.0, end - 3600.0)], ended)
    assert shift_["forecasts"]["1h"] is None
    assert shift_["forecasts"]["2h"] is not None
    assert "–" in printed([shift_])


def test_missing_intervals_are_reported_with_remedy():
    made, ended = make_frames(cars=1, days=2, warm_up=2)
    assert printed(records(made, ended), 400).strip() == NO_INTERVALS
    assert "--warm-up" in NO_INTERVALS
    assert printed([]) == ""


def test_summary_gives_share_of_outcomes_within_interval():
    made, ended = make_frames(cars=5, days=20, warm_up=0)
    collected = records(made, ended)
    held = [s["forecasts"]["2h"]["held"] for s in collected]
    assert f"{sum(held)} of {len(held)}" in summary(collected)[1]
    assert 0.8 < np.mean(held) < 0.98
    assert f"the last 60 of {len(collected)} shifts" in printed(collected)


def test_outcomes_of_pipeline_are_collected():
    pipeline = trained_pipeline(keep_outlooks=True)
    pipeline.take_shifts()
    outcomes = ShiftOutcomes(pipeline)
    for _, message in shift("c", DAYS):
        pipeline.push([message])
        outcomes()
    pipeline.finish()
    shift_ = [s for s in outcomes.records() if s["vehicle_id"] == "c"][-1]
    assert shift_["end_s"] - shift_["begin_s"] == pytest.approx(SHIFT)
    assert shift_["forecasts"]["1h"]["p05"] < shift_["soc_end_pct"] < shift_["forecasts"]["1h"]["p95"]
    assert shift_["forecasts"]["1h"]["held"]
    assert not shift_["cut"]


def test_replay_after_warm_up_reports_shifts_with_intervals(tmp_path, capsys):
    """The rides are the same; only their energy by charge rests on the capacities that the warm-up has learned."""
    recorded(tmp_path / "before.mcap", range(DAYS))
    recorded(tmp_path / "now.mcap", [DAYS])
    replay = ("replay", tmp_path / "now.mcap", "--period", 15, "--json", tmp_path / "now.json")
    done(*replay)
    alone = json.loads((tmp_path / "now.json").read_text())
    capsys.readouterr()
    done(*replay, "--warm-up", tmp_path / "before.mcap")
    assert "forecast against outcome" in capsys.readouterr().out
    both = json.loads((tmp_path / "now.json").read_text())
    by_charge = {"energy_kwh", "energy_sd_kwh", "error_pct"}
    for ride, alone_ride in zip(both["rides"], alone["rides"], strict=True):
        assert {k: v for k, v in ride.items() if k not in by_charge} == {
            k: v for k, v in alone_ride.items() if k not in by_charge
        }
    assert [s["vehicle_id"] for s in both["shifts"]] == list(CARS)
    widths = [
        [s["forecasts"]["1h"]["p95"] - s["forecasts"]["1h"]["p05"] for s in each["shifts"]] for each in (both, alone)
    ]
    assert sum(widths[0]) < sum(widths[1])
