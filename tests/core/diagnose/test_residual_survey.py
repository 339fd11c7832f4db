"""ColumnResiduals are averaged along every column, and a column is named only beyond chance."""

import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.residual_survey import SIGNIFICANCE, ColumnResiduals, survey_columns
from socast.core.diagnose.shown_columns import list_columns

WINDOWS, DAYS = 3000, 60


def make_residuals(seed, slope=0.0):
    """Return residuals of windows with noise that the windows of a day share, and a slope along the headwind."""
    rng = np.random.default_rng(seed)
    day = np.sort(rng.integers(0, DAYS, WINDOWS))
    table = pd.DataFrame(
        {
            "ambient_c": rng.normal(5.0, 8.0, DAYS)[day],
            "average_speed_kmh": rng.normal(30.0, 10.0, WINDOWS),
            "headwind_kmh": rng.normal(0.0, 10.0, WINDOWS),
            "vehicle_id": np.array(["a", "b", "c"])[day % 3],
        }
    )
    power = 200.0 * rng.normal(size=DAYS)[day] + 500.0 * rng.normal(size=WINDOWS) + slope * table["headwind_kmh"]
    keys = [str(each) for each in day]
    return ColumnResiduals(power.to_numpy(), np.full(WINDOWS, 30.0), day, keys, list_columns(table), "W")


def test_column_of_a_planted_slope_comes_first_with_signed_means():
    first, *others = survey_columns(make_residuals(1, slope=-40.0))
    assert first["column"]["key"] == "headwind_kmh"
    assert first["q"] < 0.005
    assert first["bins"]["mean"][0] > 200.0 > -200.0 > first["bins"]["mean"][-1]
    assert first["outside"] > 6
    assert [chart["spread"] for chart in others] == sorted((chart["spread"] for chart in others), reverse=True)


def test_columns_without_an_effect_are_seldom_named():
    named = [min(chart["q"] for chart in survey_columns(make_residuals(seed))) < SIGNIFICANCE for seed in range(100)]
    assert np.mean(named) <= 0.1  # 5 % are expected


def test_bins_without_an_effect_are_seldom_marked():
    marked = [any(chart["outside"] for chart in survey_columns(make_residuals(seed))) for seed in range(100)]
    assert np.mean(marked) <= 0.1  # 5 % are expected


def test_bias_that_is_the_same_everywhere_belongs_to_no_column():
    seen = make_residuals(5)
    charts = survey_columns(seen._replace(value=seen.value + 1000.0))
    assert all(chart["q"] > SIGNIFICANCE for chart in charts)
    assert all(chart["outside"] == chart["of"] for chart in charts)


def test_days_that_share_a_residual_do_not_pass_for_many_windows():
    seen = make_residuals(3)
    alone = seen._replace(day=np.arange(WINDOWS))
    widths = [survey_columns(each)[0]["bins"]["ci95"][0] for each in (seen, alone)]
    assert widths[0] != pytest.approx(widths[1], rel=0.05)


def test_amounts_of_windows_are_labelled_as_such():
    table = pd.DataFrame({"distance_km": [0.5, 1.0], "average_speed_kmh": [30.0, 60.0]})
    assert [column.label for column, _ in list_columns(table)] == ["Distance", "Average speed"]
    of_windows = [column.label for column, _ in list_columns(table.assign(window=[0, 1]))]
    assert of_windows == ["Distance in the window", "Average speed"]
