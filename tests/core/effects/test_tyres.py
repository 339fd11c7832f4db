"""Test the effects of tyres and road against manual calculations."""

import numpy as np
import pytest

from tests.support.one_row import power

WEIGHT = 1500 * 9.80665


def test_cold_tyres_add_a_quarter_of_rolling_resistance_at_minus_10_degrees():
    """Regulation 117 has 0.8 % per kelvin: 30 K of c = 0.010 add 0.0024, which is 706 W at 72 km/h and 1500 kg."""
    cold = 0.008 * 0.010 * power("cold_rolling", tyre_load=WEIGHT, speed=20, ambient=263.15)
    assert cold == pytest.approx(706, abs=0.5)
    rolling = 0.010 * power("rolling", mass=1500, grade=0, speed=20)
    assert cold / rolling == pytest.approx(0.24)


def test_cold_tyres_add_nothing_at_and_above_the_reference():
    assert power("cold_rolling", tyre_load=WEIGHT, speed=20, ambient=293.15) == 0
    assert power("cold_rolling", tyre_load=WEIGHT, speed=20, ambient=313.15) == 0
    assert power("cold_rolling@reference=283.15", tyre_load=WEIGHT, speed=20, ambient=284.15) == 0
    assert power("cold_rolling@reference=283.15", tyre_load=1000, speed=1, ambient=282.15) == pytest.approx(1000)


@pytest.mark.parametrize("name", ["wet_road", "snow"])
def test_layer_of_the_parameters_depth_gives_all_but_1_over_e(name):
    column, depth = {"wet_road": ("water", 0.0003), "snow": ("snow", 0.002)}[name]
    full = WEIGHT * 15

    def at(layer):
        return power(name, tyre_load=WEIGHT, speed=15, **{column: layer})

    assert at(0.0) == 0
    assert at(depth) == pytest.approx(full * (1 - 1 / np.e))
    assert at(100 * depth) == pytest.approx(full)
    assert at(depth / 100) == pytest.approx(full / 100, rel=0.01)  # thin layers count by their depth


def test_wet_road_takes_200_w_at_50_km_h():
    """Deep water that raises c by 0.001 takes 0.001 * 14710 N * 13.9 m/s for 1500 kg at 50 km/h."""
    assert 0.001 * power("wet_road", tyre_load=WEIGHT, speed=50 / 3.6, water=0.01) == pytest.approx(204.3, abs=0.1)


def test_tyre_pressure_has_the_form_of_rolling_resistance():
    soft = power("tyre_pressure", tyre_load=WEIGHT * np.cos(0.1), speed=12)
    assert soft == pytest.approx(power("rolling", mass=1500, grade=np.sin(0.1), speed=12))


def test_cornering_power_matches_manual_calculation():
    """A roundabout of 20 m radius at 10 m/s and 1500 kg: 7500 N, 120 kN/rad, slip 0.0625 rad, 469 N, 4.7 kW."""
    assert power("cornering", mass=1500, speed=10, turn_rate=10 / 20) / 120e3 == pytest.approx(7500 * 7500 / 120e3 * 10)
    assert power("cornering", mass=1500, speed=10, turn_rate=-0.5) == power(
        "cornering", mass=1500, speed=10, turn_rate=0.5
    )
    assert power("cornering", mass=1500, speed=30, turn_rate=0) == 0


def test_side_acceleration_is_limited_to_the_grip_of_tyres():
    assert power("cornering", mass=1000, speed=20, turn_rate=3) == pytest.approx((1000 * 6) ** 2 * 20)
