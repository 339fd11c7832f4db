"""Test which forecasts are evaluated, and that the others are counted by reason."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.evaluate.soc.cases import CHARGED, CUT_SHORT, HOURS_AHEAD, SILENT, UNREPORTED, select_cases
from tests.support.soc_frames import make_frames


def changed(tables, **columns):
    """Return tables with some columns of the shifts replaced."""
    return tables._replace(shifts=tables.shifts.assign(**columns))


@given(seconds=st.floats(0.0, 590.0), hours=st.sampled_from([2.5, 4.5, 8.0]))
@settings(max_examples=20, deadline=None)
def test_newest_forecast_before_each_time_ahead_is_evaluated(seconds, hours):
    tables = make_frames(cars=2, days=3, hours=hours, warm_up=0)
    outlooks = tables.outlooks.assign(time_s=tables.outlooks["time_s"] - seconds)
    cases = select_cases(outlooks, tables.shifts).cases
    age = cases["end_s"] - 3600.0 * cases["hours"] - cases["time_s"]
    assert set(cases["hours"]) == {h for h in HOURS_AHEAD if h < hours}
    assert (age >= 0.0).all()
    assert (age[cases["hours"] > 0] <= 60.0 + 1e-6).all()
    assert age[cases["hours"] == 0].to_numpy() == pytest.approx(seconds, abs=1e-6)


def test_forecast_before_charge_is_not_evaluated():
    tables = make_frames(cars=1, days=1, warm_up=0)
    begin = tables.shifts["begin_s"].iloc[0]
    cases = select_cases(*changed(tables, charged_s=begin + 3.5 * 3600.0))
    assert cases.cases["hours"].tolist() == [0, 1, 2]
    assert cases.left_out == {CHARGED: 2}
    at_the_end = changed(tables, charged_s=tables.shifts["end_s"])
    assert select_cases(*at_the_end).left_out == {CHARGED: len(HOURS_AHEAD)}


def test_silent_car_is_counted():
    tables = make_frames(cars=1, days=1, warm_up=0)
    ahead = tables.shifts["end_s"].iloc[0] - tables.outlooks["time_s"]
    cases = select_cases(tables.outlooks[~ahead.between(3599.0, 3600.0 + 1200.0)], tables.shifts)
    assert cases.cases["hours"].tolist() == [0, 2, 4, 6]
    assert cases.left_out == {SILENT: 1}


def test_shift_without_final_soc_is_counted():
    tables = changed(make_frames(cars=1, days=2, warm_up=0), soc_end_pct=[np.nan, 40.0])
    cases = select_cases(*tables)
    assert cases.left_out == {UNREPORTED: len(HOURS_AHEAD)}
    assert cases.warm_up == 0


def test_shift_cut_by_recording_is_counted_and_early_end_is_evaluated():
    tables = make_frames(cars=1, days=2, warm_up=0)
    cases = select_cases(tables.outlooks.assign(shift_end_s=tables.outlooks["shift_end_s"] + 3600.0), tables.shifts)
    assert cases.left_out == {CUT_SHORT: len(HOURS_AHEAD)}
    assert set(cases.cases["shift"]) == {0}
