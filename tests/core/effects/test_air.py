"""Test the effects of air (wind, yaw, density, roof load) against manual calculations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.one_row import power


def test_headwind_power_matches_manual_calculation():
    assert power("headwind", speed=20, headwind=5, air_density=1.2) == pytest.approx(0.6 * (25**2 - 20**2) * 20)  # 2700
    assert power("headwind", speed=20, headwind=-30, air_density=1.2) == pytest.approx(0.6 * (-(10**2) - 20**2) * 20)
    assert power("headwind", speed=20, headwind=0, air_density=1.3) == 0
    assert power("headwind", speed=0, headwind=15, air_density=1.2) == 0


def test_headwind_costs_more_than_equal_tailwind_saves():
    against, behind = (power("headwind", speed=20, headwind=w, air_density=1.2) for w in (6, -6))
    assert against > -behind > 0
    assert against + behind == pytest.approx(1.2 * 6**2 * 20)  # 1/2 rho v (2 w^2)


def test_power_of_air_density_follows_the_density_difference():
    """The ideal gas at -20 °C is 14 % denser: 101325 Pa / (287.05 J/(kg K) 253.15 K) = 1.394 kg/m^3."""
    density = 101_325 / (287.05 * 253.15)
    assert power("air_density", speed=25, air_density=density) == pytest.approx(
        0.5 * (1.3943 - 1.225) * 25**3, rel=1e-3
    )
    assert power("air_density", speed=25, air_density=1.225) == 0
    assert power("air_density", speed=25, air_density=1.1) < 0


@given(st.floats(0, 36), st.floats(-20, 20), st.floats(0.9, 1.5))
def test_base_drag_wind_and_density_add_up_to_drag_in_actual_air(speed, headwind, density):
    parts = power("aero_drag", speed=speed)
    parts += power("headwind", speed=speed, headwind=headwind, air_density=density)
    parts += power("air_density", speed=speed, air_density=density)
    whole = power("aero_drag_wind", speed=speed, headwind=headwind, air_density=density)
    assert parts == pytest.approx(whole, abs=1e-6)


def test_crosswind_power_follows_its_formula_up_to_the_yaw_limit():
    side = {"speed": 20, "headwind": 0, "air_density": 1.2}
    assert power("crosswind_yaw", crosswind=6, **side) == pytest.approx(0.6 * 6**2 * 20)  # sine of yaw 0.29, below 0.5
    assert power("crosswind_yaw", crosswind=-6, **side) == power("crosswind_yaw", crosswind=6, **side)
    slow = {"speed": 5, "headwind": 0, "air_density": 1.2, "crosswind": 10}
    assert power("crosswind_yaw", **slow) == pytest.approx(0.6 * 0.5**2 * (5**2 + 10**2) * 5)
    assert power("crosswind_yaw@yaw_limit=0.7", **slow) == pytest.approx(0.6 * 0.49 * 125 * 5)
    assert power("crosswind_yaw", crosswind=0, **side) == 0


@given(st.floats(1, 36), st.floats(-10, 10), st.floats(-10, 10), st.floats(0, 8))
def test_crosswind_power_equals_growth_of_drag_coefficient_with_yaw(v, w, u, k):
    """Compare with C_d (1 + k sin^2 b) times the relative wind squared, minus C_d times its axial part squared."""
    along, felt = (v + w) ** 2, (v + w) ** 2 + u * u
    if felt == 0 or u * u > 0.25 * felt:
        return
    added = 0.5 * 1.2 * ((1 + k * u * u / felt) * felt - along) * v
    assert (1 + k) * power("crosswind_yaw", speed=v, headwind=w, crosswind=u, air_density=1.2) == pytest.approx(
        added, abs=1e-6
    )


def test_roof_rack_of_0_2_square_metres_takes_2_kw_at_90_km_h():
    assert 0.2 * power("roof_load", speed=25, air_density=1.2) == pytest.approx(1875)
    assert np.isclose(power("roof_load", speed=50, air_density=1.2) / power("roof_load", speed=25, air_density=1.2), 8)
