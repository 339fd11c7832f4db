"""Test the consumption that is assumed of a vehicle model before its first rides."""

from dataclasses import replace

import numpy as np
import pytest

from socast.core.forecast.learning.first_tables import make_first_tables
from socast.core.forecast.learning.leg_energy import TEMPERATURES
from socast.core.vehicles import load_catalogue


def leg(tables, km=10.0, seconds=1800.0, gained=np.nan, lost=np.nan):
    return tables.compute_leg_energy(*(np.array([value]) for value in (km, seconds, gained, lost)))[0][0]


@pytest.mark.parametrize("model", sorted(load_catalogue()))
def test_energy_is_near_the_rating_when_mild_and_rises_with_cold_and_heat(model):
    known = load_catalogue()[model]
    tables = make_first_tables(known, 1.0)
    assert tables.is_plausible()
    by_temperature = dict(zip(TEMPERATURES.tolist(), leg(tables).tolist(), strict=True))
    assert 0.7 * 10.0 * known.rated_kwh_per_km < by_temperature[14.0] < 10.0 * known.rated_kwh_per_km + 0.2
    assert by_temperature[-25.0] > by_temperature[0.0] > by_temperature[14.0] < by_temperature[35.0]


def test_car_without_a_rating_is_estimated_by_its_mass():
    known = load_catalogue()["nissan-leaf-2013"]
    unrated = make_first_tables(replace(known, rated_kwh_per_km=None), 1.0)
    assert leg(unrated) == pytest.approx(leg(make_first_tables(known, 1.0)), rel=0.2)


def test_climbing_takes_more_and_slow_legs_wait():
    tables = make_first_tables(load_catalogue()["nissan-leaf-2013"], 1.0)
    assert (leg(tables, gained=100.0, lost=0.0) > leg(tables)).all()
    assert (leg(tables, gained=0.0, lost=100.0) < leg(tables)).all()
    assert leg(tables, seconds=3600.0) - leg(tables) == pytest.approx(0.5 * tables.standing_power)
