"""Test the expected variance of measured rows."""

import numpy as np
import pandas as pd
import pytest

from socast.core.fit.row_noise import expect_label_variance

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
