"""Test errors relative to the energy and to the noise floor against values computed by hand."""

import numpy as np
import pytest

from socast.core.evaluate.relative_errors import (
    LEAST_ENERGY,
    compute_relative_figures,
    compute_share_below_least,
    divide_by_floor,
)

MEASURED = np.array([1.0, 2.0, 0.05, -0.2])
PREDICTED = np.array([1.2, 1.5, 0.15, 0.0])


def test_figures_match_hand_computed_values():
    figures = compute_relative_figures(MEASURED, PREDICTED, np.arange(4), floor=0.05)
    assert figures.mae_kwh.value == pytest.approx((0.2 + 0.5 + 0.1 + 0.2) / 4)
    assert figures.wmape.value == pytest.approx(1.0 / 2.85)
    assert figures.mape.value == pytest.approx((0.2 + 0.25) / 2)
    assert figures.over_floor == pytest.approx(5.0)


def test_rides_of_almost_no_energy_are_left_out_of_mape_and_counted():
    assert compute_share_below_least(MEASURED) == 0.5
    assert compute_share_below_least(np.array([LEAST_ENERGY])) == 0.0
    figures = compute_relative_figures(MEASURED[2:], PREDICTED[2:], np.arange(2), floor=0.05)
    assert figures.mape.value is None


def test_interval_is_wider_where_clusters_are_alike():
    measured = np.ones(40)
    predicted = measured + np.repeat([0.1, 0.4, 0.1, 0.4], 10)
    apart = compute_relative_figures(measured, predicted, np.arange(40), floor=0.1)
    alike = compute_relative_figures(measured, predicted, np.repeat(np.arange(4), 10), floor=0.1)
    for measure in ("mae_kwh", "wmape", "mape"):
        assert getattr(alike, measure).value == pytest.approx(getattr(apart, measure).value)
        assert getattr(alike, measure).ci95 > 3.0 * getattr(apart, measure).ci95


@pytest.mark.parametrize("floor", [0.0, np.nan])
def test_unknown_floor_gives_unknown_ratio(floor):
    assert np.isnan(divide_by_floor(0.1, floor))
