"""Test the noise of the measured energy: shared gains are excluded, and the floor is the error of a perfect model."""

import numpy as np
import pandas as pd
import pytest

from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance, is_metered

METERED = pd.DataFrame(
    {
        "energy_kwh": [2.0, -1.0],
        "energy_vi_kwh": [2.0, -1.0],
        "energy_vi_sd_kwh": np.hypot([0.03, 0.04], [0.02, 0.01]),
        "energy_soc_kwh": [2.1, -0.9],
        "energy_soc_sd_kwh": [9.0, 9.0],
    }
)
"""Two rides measured by voltage and current: noise of 0.03 and 0.04 kWh, and a meter gain of 1 %."""


def test_meter_gain_is_excluded():
    np.testing.assert_allclose(compute_noise_variance(METERED), [0.03**2, 0.04**2])


def test_noise_of_soc_is_its_resolution_without_capacity_error():
    by_soc = METERED.assign(energy_vi_kwh=np.nan, energy_soc_noise_kwh=0.05)
    assert not is_metered(by_soc).any()
    np.testing.assert_allclose(compute_noise_variance(by_soc), 0.05**2)
    np.testing.assert_allclose(
        compute_noise_variance(by_soc.drop(columns=["energy_vi_kwh", "energy_vi_sd_kwh"])), 0.05**2
    )


def test_variance_is_never_negative():
    assert (compute_noise_variance(METERED.assign(energy_vi_sd_kwh=0.0)) == 0.0).all()


def test_unknown_uncertainty_gives_unknown_variance():
    assert np.isnan(compute_noise_variance(METERED[["energy_kwh"]])).all()


def test_noise_floor_equals_mean_absolute_error_of_perfect_model():
    rng = np.random.default_rng(5)
    sd = rng.uniform(0.01, 0.1, 20_000)
    assert compute_noise_floor(sd**2) == pytest.approx(np.abs(rng.normal(0.0, sd)).mean(), rel=0.02)
    assert compute_noise_floor(np.array([0.04, np.nan])) == pytest.approx(0.2 * np.sqrt(2.0 / np.pi))
    assert np.isnan(compute_noise_floor(np.array([np.nan])))
