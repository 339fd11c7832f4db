"""Test the expected variance of measured rows, and that of residuals: planted variances are recovered."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.fit.row_noise import (
    LEAST_SHARE,
    build_variance_parts,
    compute_robust_weights,
    estimate_variance,
    expect_label_variance,
)
from tests.support.synthetic_windows import METER_SD, gather_with_model, make_tables, make_windows

N = 400


def make_rows(**changes):
    """Return metered windows whose stated variance is that of their time and motion times a random factor."""
    rng = np.random.default_rng(2)
    time, kinetic = rng.uniform(50.0, 70.0, N), rng.uniform(0.0, 0.05, N)
    energy, stated = rng.normal(0.2, 0.05, N), (1e-6 * time + 2e-3 * kinetic) * rng.gamma(4.0, 0.25, N)
    columns = {
        "duration_s": time,
        "effect_inertia_positive": kinetic,
        "energy_kwh": energy,
        "energy_vi_kwh": energy,
        "energy_vi_sd_kwh": np.sqrt(stated + (0.01 * energy) ** 2),
        "energy_soc_noise_kwh": np.full(N, 0.1),
    }
    return pd.DataFrame(columns | changes)


def test_expected_variance_follows_from_time_and_motion():
    rows = make_rows()
    usual = 1e-6 * rows["duration_s"] + 2e-3 * rows["effect_inertia_positive"]
    ratio = expect_label_variance(rows) / usual.to_numpy()
    assert ratio == pytest.approx(np.full(N, ratio.mean()), rel=0.15)
    assert 0.85 < ratio.mean() < 1.1


def test_energy_of_a_row_does_not_change_its_expected_variance():
    """Two rows with the same time and motion count alike, although one has sampled peaks and so more energy."""
    rows = make_rows()
    rows.loc[1, ["duration_s", "effect_inertia_positive"]] = rows.loc[0, ["duration_s", "effect_inertia_positive"]]
    rows.loc[1, "energy_vi_sd_kwh"] = 5.0 * rows.loc[0, "energy_vi_sd_kwh"]
    found = expect_label_variance(rows)
    assert found[0] == pytest.approx(found[1])


def test_rows_of_unknown_variance_do_not_change_that_of_others():
    rows = make_rows()
    full = expect_label_variance(rows)
    rows.loc[::4, "energy_vi_sd_kwh"] = np.nan
    assert expect_label_variance(rows) == pytest.approx(full, rel=0.05)
    rows.loc[3, "effect_inertia_positive"] = np.nan
    assert np.isfinite(expect_label_variance(rows)).all()


def test_rows_by_the_state_of_charge_keep_their_stated_variance():
    rows = make_rows()
    rows.loc[:9, "energy_vi_kwh"] = np.nan
    found = expect_label_variance(rows)
    assert found[:10] == pytest.approx(0.01)
    assert (found[10:] < 0.001).all()
    rows["energy_vi_kwh"] = np.nan
    assert expect_label_variance(rows) == pytest.approx(0.01)


@pytest.fixture(scope="module")
def windows():
    return gather_with_model(make_tables(make_windows()))[0]


def with_columns(windows, **columns):
    return replace(windows, table=windows.table.assign(**columns))


def estimate(windows, residual):
    return estimate_variance(build_variance_parts(windows.table), residual)


def parts(windows):
    """Return the sizes with which the error of a window may grow. [kWh]"""
    table = windows.table
    rolling = (table["effect_rolling"] * table["rolling_resistance"]).to_numpy()
    return rolling, table["effect_inertia_positive"].to_numpy(), table["duration_s"].to_numpy() / 3.6e6


@pytest.mark.parametrize("share", [(1.0, 0.0, 0.0), (0.0, 0.1, 0.0), (2.0, 0.0, 0.2), (1.0, 0.08, 0.1)])
def test_planted_variance_is_recovered(windows, share):
    rolling, inertia, _ = parts(windows)
    planted = share[0] * METER_SD**2 + (share[1] * rolling) ** 2 + (share[2] * inertia) ** 2
    rng = np.random.default_rng(6)
    result = np.mean(
        [estimate(windows, rng.normal(0.0, 1.0, len(planted)) * np.sqrt(planted)) for _ in range(40)],
        axis=0,
    )
    plain = planted > 2.0 * LEAST_SHARE * np.median(planted)
    ratio = result[plain] / planted[plain]
    assert 0.7 < np.quantile(ratio, 0.05) <= np.quantile(ratio, 0.95) < 1.45
    assert np.median(ratio) == pytest.approx(1.0, abs=0.12)


def test_no_window_outweighs_all_others(windows):
    rolling, _, _ = parts(windows)
    residual = np.random.default_rng(7).normal(0.0, 1.0, len(rolling)) * rolling
    result = estimate(with_columns(windows, energy_vi_sd_kwh=0.0), residual)
    assert result.min() > 0.5 * LEAST_SHARE * np.median(result)


def test_doubled_residuals_have_fourfold_variance(windows):
    residual = np.random.default_rng(8).normal(0.0, 0.004, len(windows.measured))
    np.testing.assert_allclose(estimate(windows, 2.0 * residual), 4.0 * estimate(windows, residual))


def test_outliers_do_not_change_usual_variance(windows):
    residual = np.random.default_rng(9).normal(0.0, 0.004, len(windows.measured))
    spoilt = residual.copy()
    spoilt[::400] = 50.0
    ratio = estimate(windows, spoilt) / estimate(windows, residual)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)


def test_variance_is_positive_for_zero_residual(windows):
    result = estimate(windows, np.zeros(len(windows.measured)))
    assert (result > 0.0).all()
    assert np.isfinite(result).all()


@given(st.integers(0, 2**32), st.floats(1e-6, 1e6))
def test_robust_weights_are_scale_free_and_decrease_with_residual(seed, scale):
    left = np.random.default_rng(seed).standard_t(2.0, 300)
    result = compute_robust_weights(left)
    np.testing.assert_allclose(compute_robust_weights(scale * left), result, rtol=1e-9)
    np.testing.assert_array_equal(compute_robust_weights(-left), result)
    assert ((result > 0.0) & (result <= 1.0)).all()
    order = np.argsort(np.abs(left))
    assert (np.diff(result[order]) <= 0.0).all()
    far = result < 1.0
    np.testing.assert_allclose(np.ptp((result * np.abs(left))[far]) if far.any() else 0.0, 0.0, atol=1e-9)


def test_robust_weights_of_gaussian_errors_are_mostly_one():
    result = compute_robust_weights(np.random.default_rng(10).normal(size=20_000))
    assert 0.999 < np.mean(result == 1.0) <= 1.0
    assert compute_robust_weights(np.r_[np.random.default_rng(11).normal(size=500), 300.0])[-1] < 0.02
    assert (compute_robust_weights(np.zeros(5)) == 1.0).all()
