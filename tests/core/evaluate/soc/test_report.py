"""Test the evaluation of forecasts of a shift's end: planted errors are recovered, and unusable cases are left out."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from socast.core.errors import ModelError
from socast.core.evaluate.soc.baselines import PERSONS
from socast.core.evaluate.soc.cases import HOURS_AHEAD, WARM_UP
from socast.core.evaluate.soc.report import evaluate_soc
from tests.support.soc_frames import CAPACITY, DAY_ONE, MODELS, SPREAD, make_frames

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def frames():
    return make_frames(cars=12, days=40)


@pytest.fixture(scope="module")
def result(frames):
    return evaluate_soc(*frames)


def changed(tables, **columns):
    """Return tables with some columns of the shifts replaced."""
    return tables._replace(shifts=tables.shifts.assign(**columns))


def overall(frames):
    return evaluate_soc(*frames).overall.pooled


def test_each_shift_has_one_forecast_at_each_time_ahead(result):
    shifts = 12 * 38
    assert {hours: figures.n for hours, figures in result.overall.hours.items()} == {
        str(h): shifts for h in HOURS_AHEAD
    }
    assert result.overall.pooled.n == shifts * len(HOURS_AHEAD)
    assert result.about.to_json() | {"left_out": None} == {
        "shifts": 480, "judged_shifts": shifts, "warm_up_shifts": 24, "forecasts": shifts * 5, "left_out": None,
        "vehicles": 12, "vehicle_days": shifts, "vehicle_models": sorted(MODELS), "first_date": "2018-01-03",
        "last_date": "2018-02-09",
    }  # fmt: skip
    assert result.about.left_out == {WARM_UP: 24 * len(HOURS_AHEAD)}


def test_calibrated_interval_has_nominal_coverage(result):
    for figures in (result.overall.pooled, *result.overall.hours.values()):
        assert figures.coverage.low < 0.9 < figures.coverage.high
    pooled = result.overall.pooled.coverage
    assert pooled.high - pooled.low < 0.04


def test_interval_of_half_width_has_low_coverage():
    figures = overall(make_frames(cars=12, days=40, narrow=0.5))
    assert figures.coverage.high < 0.7
    assert figures.coverage.low < 2.0 * stats.norm.cdf(SPREAD / 2.0) - 1.0 < figures.coverage.high
    assert figures.below + figures.above == pytest.approx(1.0 - figures.coverage.value)


def test_error_bias_and_width_match_planted_values(result):
    for hours, figures in result.overall.hours.items():
        sd = max(float(hours), 0.5)
        assert figures.width_pct.value == pytest.approx(2.0 * SPREAD * sd)
        assert figures.mae_pct.value == pytest.approx(sd * np.sqrt(2.0 / np.pi), abs=1.5 * figures.mae_pct.ci95)
        assert abs(figures.bias_pct.value) < 1.5 * figures.bias_pct.ci95
    off = overall(make_frames(cars=12, days=40, bias=3.0)).bias_pct
    assert off.value == pytest.approx(3.0, abs=1.5 * off.ci95)


def test_better_forecasts_have_lower_error_than_every_baseline():
    figures = evaluate_soc(*make_frames(cars=6, days=20, sd_an_hour=0.2)).overall.hours["2"]
    best = figures.best
    errors = {name: of.mae_pct.value for name, of in figures.baselines.items() if name in PERSONS}
    assert best.name == min(errors, key=errors.__getitem__)
    assert best.share_less == pytest.approx(1.0 - figures.mae_pct.value / errors[best.name])
    assert best.share_less > 0.4
    for of in figures.baselines.values():
        assert of.less_pct.value - of.less_pct.ci95 > 0.0
        assert of.less_pct.value == pytest.approx(of.mae_pct.value - of.forecast_mae_pct.value)


def test_conditions_contain_every_case_once(result):
    for bins in result.by.values():
        assert sum(figures.pooled.n for figures in bins) == result.overall.pooled.n
    assert [figures.bin for figures in result.by["temperature"]] == [
        "below -20", "-20 to -10", "-10 to 0", "0 to 10", "10 to 20", "20 to 30",
    ]  # fmt: skip
    assert [figures.bin for figures in result.by["vehicle model"]] == sorted(MODELS)


def test_result_does_not_depend_on_row_order(frames, result):
    mixed = [table.sample(frac=1.0, random_state=3).reset_index(drop=True) for table in frames]
    assert evaluate_soc(*mixed) == result


def test_result_is_json_without_nan(result):
    assert msgspec.json.decode(msgspec.json.encode(result.to_json())) == result.to_json()
    assert b"NaN" not in msgspec.json.encode(result.to_json())
    assert msgspec.convert(result.to_json(), type(result)) == result


def test_frames_have_a_row_for_each_time_ahead_and_for_each_forecast(result):
    errors = result.errors.set_index("hours")
    assert errors["mae_pct"].to_dict() == {int(h): each.mae_pct.value for h, each in result.overall.hours.items()}
    assert errors["mae_pct_ci95"][2] == result.overall.hours["2"].mae_pct.ci95
    assert errors["rating"][2] == result.overall.hours["2"].baselines["rating"].mae_pct.value
    assert len(result.forecasts) == result.overall.pooled.n
    assert set(result.forecasts["hours"]) == set(HOURS_AHEAD)


def test_shifts_of_one_car_on_one_day_are_one_cluster():
    frames = make_frames(cars=2, days=4, hours=2.0, warm_up=0)
    late = frames.shifts.assign(shift=frames.shifts["shift"] + 100)
    both = pd.concat([frames.shifts, late], ignore_index=True)
    outlooks = pd.concat([frames.outlooks, frames.outlooks.assign(shift=frames.outlooks["shift"] + 100)])
    figures = evaluate_soc(outlooks, both).overall.hours["1"]
    assert (figures.n, figures.shifts, figures.vehicle_days) == (16, 16, 8)
    alone = evaluate_soc(*frames).overall.hours["1"]
    assert figures.mae_pct.to_json() == pytest.approx(alone.mae_pct.to_json())
    assert figures.coverage.value == alone.coverage.value
    assert figures.coverage.low < alone.coverage.low
    assert figures.coverage.low < stats.binomtest(14, 16).proportion_ci(method="wilson").low - 0.1


def test_without_plans_only_linear_baseline_applies_with_note():
    frames = make_frames(cars=2, days=4)
    outlooks = frames.outlooks.assign(planned=False, ahead_km=np.nan)
    result = evaluate_soc(outlooks, frames.shifts)
    figures = result.overall.hours["2"]
    assert {name: of.n for name, of in figures.baselines.items()} == {
        "linear": 4,
        "model_mean": 0,
        "rating": 0,
        "regression": 0,
    }
    assert figures.best is None
    assert any("no shift had a plan" in note for note in result.notes)
    assert [bins.bin for bins in result.by["plan"]] == ["by habit"]


@pytest.mark.parametrize("days", [0, 2])
def test_no_case_raises_error_of_one_line(days):
    frames = make_frames(cars=1, days=2)
    tables = [table[table["shift"] < days] for table in frames]
    with pytest.raises(
        ModelError, match=rf"{days} shifts ended and no forecast .*: give recordings of more days"
    ) as refusal:
        evaluate_soc(*tables)
    assert "\n" not in str(refusal.value)
    assert (WARM_UP in str(refusal.value)) == (days > 0)


def test_examples_include_extreme_shifts_in_time_order(frames, result):
    assert {why for figures in result.examples for why in figures.why.split(", ")} == {
        "coldest", "warmest", "middling", "worst",
    }  # fmt: skip
    for figures in result.examples:
        assert figures.hours_ahead == sorted(figures.hours_ahead, reverse=True)
        assert figures.hours_ahead[-1] == pytest.approx(0.0, abs=0.02)
        widths = np.array(figures.soc_p95_pct) - np.array(figures.soc_p05_pct)
        assert np.all(np.diff(widths) <= 1e-9)
    ambient = {figures.why: figures.ambient_c for figures in result.examples}
    evaluated = frames.shifts[frames.shifts["shift"] >= 2]
    assert min(ambient.values()) == evaluated["ambient_c"].min()


def test_synthetic_frames_have_declared_dates_and_capacity(frames):
    assert frames.shifts["begin_s"].min() >= DAY_ONE
    assert (frames.shifts["capacity_kwh"] == CAPACITY).all()
