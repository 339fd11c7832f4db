"""Test the effects of the battery against manual calculations."""

import numpy as np
import pytest

from tests.support.one_row import power


def test_tenth_of_an_ohm_loses_a_kilowatt_at_36_kw():
    """A current of 100 A at 360 V and 25 °C loses 100^2 * 0.1 W = 1 kW."""
    assert 0.1 * power("battery_resistance", wheel_power=36_000, pack_temperature=298.15) == pytest.approx(1000)
    assert power("battery_resistance", wheel_power=-36_000, pack_temperature=298.15) == pytest.approx(10_000)


@pytest.mark.parametrize(("activation", "growth"), [(1000, 1.815), (2500, 4.435), (4000, 10.84)])
def test_resistance_grows_in_the_cold_by_arrhenius(activation, growth):
    """The growth is exp(E (1/253.15 K - 1/298.15 K)) = exp(E * 5.962e-4 / K)."""
    name = "battery_resistance" if activation == 2500 else f"battery_resistance@activation={activation}"
    cold, warm = (power(name, wheel_power=10_000, pack_temperature=t) for t in (253.15, 298.15))
    assert cold / warm == pytest.approx(growth, rel=2e-3)
    assert growth == pytest.approx(np.exp(activation * 5.962e-4), rel=2e-3)


def test_battery_at_minus_15_degrees_is_heated_with_1_5_kw():
    assert 100 * power("cold_battery_heating", pack_temperature=258.15) == pytest.approx(1500)
    assert power("cold_battery_heating", pack_temperature=273.15) == 0
    assert power("cold_battery_heating", pack_temperature=310) == 0
    assert power("cold_battery_heating@threshold=263.15", pack_temperature=258.15) == pytest.approx(5)


def test_cold_battery_limits_regeneration_in_proportion_to_its_temperature():
    """At 0 °C, 10 K below the threshold, half of the range of 20 K is reached: half of 20 kW, times the share."""
    braking = {"braking_force": 2000, "speed": 10}
    assert power("cold_regen_limit", pack_temperature=273.15, **braking) == pytest.approx(10_000)
    assert power("cold_regen_limit", pack_temperature=243.15, **braking) == pytest.approx(20_000)
    assert power("cold_regen_limit", pack_temperature=283.15, **braking) == 0
    assert power("cold_regen_limit", braking_force=0, speed=10, pack_temperature=243.15) == 0


def test_full_battery_limits_regeneration_in_proportion_to_its_charge():
    braking = {"braking_force": 2000, "speed": 10}
    assert power("regen_full_battery", charge=0.95, **braking) == pytest.approx(10_000)
    assert power("regen_full_battery", charge=1.0, **braking) == pytest.approx(20_000)
    assert power("regen_full_battery", charge=0.9, **braking) == 0
    assert power("regen_full_battery@threshold=0.8", charge=0.9, **braking) == pytest.approx(10_000)
    assert power("regen_full_battery", charge=1.0, braking_force=0, speed=10) == 0
