"""Test that the tables of forecasts and shifts agree with the published forecasts and the samples."""

import numpy as np
import pandas as pd
import pytest

from socast.core.forecast.filter_state import CLOSED_SHIFT
from socast.core.forecast.tables import tabulate_outlooks, tabulate_shifts
from tests.support.fleet_days import DAYS, RESERVE, SHIFT, columns, days, forecasts, shift, trained_pipeline


def driven(cuts=1):
    pipeline = trained_pipeline(keep_outlooks=True)
    messages = days([DAYS], "abc")
    out, tables = [], []
    for part in np.array_split(np.arange(len(messages)), cuts):
        out += pipeline.push([messages[i] for i in part])
        tables.append(pipeline.take_outlooks())
    pipeline.finish()
    return pipeline, out, pd.concat(tables, ignore_index=True)


def test_each_row_equals_its_published_forecast():
    _, out, table = driven()
    for car in "abc":
        published = list(forecasts(out, car).values())
        mine = table[table["vehicle_id"] == car].reset_index(drop=True)
        assert mine["time_s"].tolist() == [each.time_s for each in published]
        for row, each in zip(mine.itertuples(), published, strict=True):
            assert row.soc_pct == pytest.approx(each.soc_pct)
            end = each.soc_end_of_shift_pct
            assert (
                np.isnan(row.soc_mean_pct)
                if end is None
                else (row.soc_mean_pct, row.soc_p05_pct, row.soc_p95_pct)
                == (pytest.approx((end.mean, end.p05, end.p95)))
            )
            assert np.isnan(row.reserve_risk) if each.reserve_risk is None else row.reserve_risk == each.reserve_risk
    planned = table[table["time_s"] > table["shift_begin_s"] + 60.0]
    assert planned["planned"].all()
    assert (planned["reserve_soc_pct"] == RESERVE).all()
    assert planned["ahead_km"].min() >= 0.0
    assert table["ambient_c"].between(5.9, 6.1).all() or table["ambient_c"].nunique() <= 2


def test_cuts_change_no_table_and_taken_rows_are_removed():
    pipeline, _, table = driven(7)
    _, _, whole = driven()
    pd.testing.assert_frame_equal(table, whole, check_exact=True)
    assert pipeline.take_outlooks().empty


@pytest.mark.parametrize("car", ["a", "c"])
def test_shift_row_agrees_with_its_samples(car):
    pipeline, _, _ = driven()
    shifts = pipeline.take_shifts()
    sent = columns(car, DAYS)
    row = shifts[(shifts["vehicle_id"] == car)].iloc[-1]
    assert (row["begin_s"], row["vehicle_model"], row["shift"]) == (sent["time_s"][0], "nissan-leaf-2013", DAYS)
    assert row["end_s"] == pytest.approx(sent["time_s"][-1], abs=240.0)
    assert row["soc_begin_pct"] == pytest.approx(95.0, abs=0.5)
    assert row["soc_end_pct"] == pytest.approx(sent["soc_pct"][-1], abs=0.5)
    assert row["soc_lowest_pct"] == row["soc_end_pct"]
    assert row["distance_km"] == pytest.approx(sent["metres"][-1] / 1000.0, abs=0.2)
    assert 0.95 * row["distance_km"] < row["ride_km"] <= row["distance_km"]
    assert np.isnan(row["charged_s"])
    assert row["ambient_c"] == pytest.approx(sent["ambient_c"][0])
    assert row["capacity_kwh"] == 24.0
    assert pipeline.take_shifts().empty


def test_shift_ends_when_the_next_begins():
    pipeline = trained_pipeline(keep_outlooks=True)
    pipeline.push([m for _, m in shift("c", DAYS)])
    pipeline.take_shifts()
    pipeline.push([m for _, m in shift("c", DAYS + 1)][:5])
    (ended,) = pipeline.take_shifts().itertuples()
    assert (ended.vehicle_id, ended.shift) == ("c", DAYS)
    assert ended.end_s - ended.begin_s == pytest.approx(SHIFT, abs=240.0)


def test_empty_tables_have_all_columns():
    pipeline = trained_pipeline()
    empty = tabulate_outlooks([], pipeline.context)
    _, _, table = driven()
    assert list(empty) == list(table)
    assert len(empty) == 0
    assert len(tabulate_shifts(np.zeros(0, CLOSED_SHIFT), pipeline.context)) == 0
    pipeline.push(days([DAYS], "a"))
    assert pipeline.take_outlooks().empty
    assert pipeline.take_shifts().empty
