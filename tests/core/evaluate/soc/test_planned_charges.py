"""Test which forecasts around planned charges are evaluated, and against what."""

import numpy as np
import pytest

from socast.core.evaluate.soc.cases import CHARGED, select_cases
from socast.core.evaluate.soc.planned_charges import (
    MOST_CHARGES,
    MOST_SHORT,
    find_wanted,
    select_charge_cases,
    split_at_charges,
)
from socast.core.evaluate.soc.report import evaluate_soc
from tests.support.soc_frames import ForecastFrames, make_frames

CHARGED_TO = 80.0


def make_charged_frames(late_s=0.0, arrives=(3.5,)):
    """Return shifts of 7 h with charges that begin at some hours, `late_s` after what forecasts tell."""
    tables = make_frames(cars=3, days=12, warm_up=0)
    outlooks, shifts = tables.outlooks.copy(), tables.shifts.copy()
    begin = outlooks["shift_begin_s"].to_numpy()
    time = outlooks["time_s"].to_numpy()
    hours = np.array([*arrives, np.inf])
    arrived = begin[:, np.newaxis] + 3600.0 * hours
    number = (time[:, np.newaxis] >= arrived).sum(axis=1)
    following = arrived[np.arange(len(time)), number]
    last = arrived[np.arange(len(time)), np.maximum(number - 1, 0)]
    ahead = np.isfinite(following)
    outlooks["charge_planned"] = ahead
    outlooks["charge_s"] = np.where(ahead, following - late_s, np.nan)
    outlooks["charge_to_pct"] = np.where(ahead, CHARGED_TO, np.nan)
    outlooks["charge_km"] = np.where(ahead, outlooks["ahead_km"] / 2.0, np.nan)
    for name, off in (("mean", 1.0), ("p05", -2.0), ("p95", 3.0)):
        outlooks[f"charge_soc_{name}_pct"] = np.where(ahead, 40.0 + off, np.nan)
    outlooks["charge_risk"] = np.where(ahead, 0.0, np.nan)
    outlooks["arrived_s"] = np.where(number > 0, last, np.nan)
    outlooks["arrival_soc_pct"] = np.where(number > 0, 40.0, np.nan)
    shifts["charged_s"] = shifts["begin_s"] + 3600.0 * arrives[-1] + 1800.0
    return ForecastFrames(outlooks, shifts)


def test_parts_of_shifts_end_at_their_charges():
    outlooks, parts = split_at_charges(*make_charged_frames(arrives=(2.5, 5.5)))
    assert len(parts) == 2 * 3 * 12
    assert parts["soc_end_pct"].eq(40.0).all()
    hours = (parts["end_s"] - parts["begin_s"]) / 3600.0
    assert sorted(set(hours.round(6))) == [2.5, 3.0]
    told = outlooks.merge(parts[["vehicle_id", "shift", "begin_s", "end_s"]], on=["vehicle_id", "shift"])
    assert told["time_s"].between(told["begin_s"], told["end_s"]).all()
    assert set(outlooks["shift"] % MOST_CHARGES) == {0, 1, 2}


@pytest.mark.parametrize("late_s", [0.0, 1500.0])
def test_forecast_is_selected_by_the_time_that_it_tells(late_s):
    outlooks, parts = split_at_charges(*make_charged_frames(late_s))
    cases = select_cases(outlooks, parts, find_wanted(outlooks)).cases
    ahead = (cases["shift_end_s"] - cases["time_s"]) / 3600.0
    assert set(cases["hours"]) == {1, 2}
    assert ((ahead <= cases["hours"]) & (ahead > cases["hours"] - MOST_SHORT)).all()
    assert (cases["end_s"] - cases["shift_end_s"]).to_numpy() == pytest.approx(np.full(len(cases), late_s))
    assert (cases["soc_mean_pct"] - cases["soc_end_pct"]).to_numpy() == pytest.approx(np.ones(len(cases)))


def test_forecasts_over_a_planned_charge_are_judged_apart_whether_or_not_the_car_charged():
    tables = make_charged_frames()
    for shifts in (tables.shifts, tables.shifts.assign(charged_s=np.nan)):
        over = select_charge_cases(tables.outlooks, shifts)["over the charge"]
        assert set(over["hours"]) == {4, 6}
        begin = over["begin_s"] + 3.5 * 3600.0
        assert (over["time_s"] < begin).all()
        plain = select_cases(tables.outlooks, shifts)
        assert not set(plain.cases["hours"]) & {4, 6}
        assert plain.left_out[CHARGED] >= len(over)


def test_person_expects_the_planned_charge_less_the_rides_after_it():
    tables = make_charged_frames()
    over = select_charge_cases(tables.outlooks, tables.shifts.assign(charged_s=np.nan))["over the charge"]
    fall = (CHARGED_TO - over["rating"]) / 100.0 * over["capacity_kwh"]
    rate = fall / (over["ahead_km"] / 2.0)
    assert rate.groupby(over["vehicle_model"]).std().max() == pytest.approx(0.0, abs=1e-9)
    assert over["regression"].isna().all()
    assert over["linear"].isna().all()


def test_report_has_figures_around_charges_only_where_charges_are_planned():
    figures = evaluate_soc(*make_charged_frames()).charges
    assert list(figures) == ["to the charge", "over the charge"]
    assert [each.bin for each in figures["to the charge"]] == ["1 h", "2 h", "all"]
    assert figures["to the charge"][-1].coverage.value == 1.0
    assert figures["to the charge"][-1].bias_pct.value == pytest.approx(1.0)
    assert evaluate_soc(*make_frames()).charges == {}
