"""Test the effects of the cabin against manual calculations."""

import numpy as np
import pytest

from tests.support.one_row import power


def test_open_doors_lose_the_heat_of_one_change_of_air():
    """At -9 °C, 3 m^3 of 1.2 kJ/(m^3 K) against 30 K are 108 kJ, over some minutes; a stop that counts adds as much."""
    seconds = np.arange(0.0, 3600.0, 1.0) + 0.5
    made_up = 3600 * sum(power("door_heat_loss", elapsed=t, stop_rate=0, ambient=264.15) for t in seconds)
    assert made_up == pytest.approx(108e3, rel=1e-3)
    stop = 3600 * power("door_heat_loss@share=1", elapsed=1e6, stop_rate=1 / 3, ambient=264.15) * 3
    assert stop == pytest.approx(108e3)
    assert power("door_heat_loss", elapsed=1e6, stop_rate=1 / 3, ambient=264.15) == pytest.approx(0, abs=1e-9)
    assert power("door_heat_loss", elapsed=0, stop_rate=1, ambient=300) == 0


def test_cabin_heating_takes_2_4_kw_at_minus_5_degrees():
    """A coefficient of 120 W/K below 15 °C, measured on a Nissan Leaf, gives 2.4 kW at -5 °C."""
    assert 120 * power("cabin_heating", ambient=268.15) == pytest.approx(2400)
    assert power("cabin_heating", ambient=288.15) == 0
    assert power("cabin_heating", ambient=310) == 0
    assert power("cabin_heating@balance=278.15", ambient=268.15) == pytest.approx(10)


def test_cabin_cooling_takes_a_kilowatt_at_32_degrees():
    assert 100 * power("cabin_cooling", ambient=305.15) == pytest.approx(1000)
    assert power("cabin_cooling", ambient=295.15) == 0
    assert power("cabin_cooling", ambient=250) == 0
    assert power("cabin_cooling@balance=289.15", ambient=305.15) == pytest.approx(16)


def test_heating_and_cooling_are_never_on_together():
    for ambient in np.arange(240.0, 320.0):
        assert 0 in {power("cabin_heating", ambient=ambient), power("cabin_cooling", ambient=ambient)}


@pytest.mark.parametrize("name", ["cabin_warmup", "cabin_warmup@decay=300", "cabin_warmup@decay=1200"])
def test_warm_up_takes_the_stored_heat_at_any_time_constant(name):
    """The integral over a long ride is C (T_in - T): 80 kJ/K times 41 K, 3.3 MJ, 0.9 kWh."""
    elapsed = np.arange(5.0, 20_000.0, 10.0)
    total = sum(power(name, ambient=253.15, parked=1e6, elapsed=t) for t in elapsed) * 10
    assert 80e3 * total == pytest.approx(80e3 * 41, rel=0.01)


def test_warm_up_grows_with_the_parked_time_and_decays_during_the_ride():
    start = power("cabin_warmup", ambient=273.15, parked=1e6, elapsed=0)
    assert start == pytest.approx(21 / 600)
    assert power("cabin_warmup", ambient=273.15, parked=3600, elapsed=0) == pytest.approx(start * (1 - 1 / np.e))
    assert power("cabin_warmup", ambient=273.15, parked=1e6, elapsed=600) == pytest.approx(start / np.e)
    assert power("cabin_warmup", ambient=273.15, parked=0, elapsed=0) == 0
    assert power("cabin_warmup", ambient=300, parked=1e6, elapsed=0) == 0


def test_solar_load_is_full_in_the_heat_and_zero_in_the_cold():
    assert power("solar_load", solar=1000, ambient=308.15) == pytest.approx(1000)
    assert power("solar_load", solar=1000, ambient=295.65) == pytest.approx(500)  # half way up the ramp of 5 K
    assert power("solar_load", solar=1000, ambient=293.15) == 0
    assert power("solar_load", solar=0, ambient=308.15) == 0
    assert power("solar_load@cooling_on=298.15", solar=1000, ambient=298.15) == 0


def test_humidity_takes_the_latent_heat_of_condensation():
    """Drying 0.03 kg/s at 30 °C, 70 % (2970 Pa) to 1200 Pa: 0.622/101325 * 0.03 * 2.45e6 = 0.45 W/Pa, 0.8 kW."""
    latent = 0.622 / 101_325 * 0.03 * 2.45e6
    assert latent * power("humidity", vapour_pressure=2970, ambient=303.15) == pytest.approx(799, abs=1)
    assert power("humidity", vapour_pressure=1200, ambient=303.15) == 0
    assert power("humidity", vapour_pressure=2970, ambient=290) == 0


def test_demisting_follows_the_relative_humidity_above_its_threshold():
    """Air at 20 °C saturates at 2339 Pa (WMO-No. 8); 80 % relative humidity is 0.2 above the threshold of 0.6."""
    assert power("demisting", vapour_pressure=0.8 * 2339, ambient=293.15) == pytest.approx(0.2, abs=0.003)
    assert power("demisting", vapour_pressure=0.5 * 2339, ambient=293.15) == 0
    assert power("demisting@damp=0.4", vapour_pressure=0.5 * 2339, ambient=293.15) == pytest.approx(0.1, abs=0.002)
