"""Test the laws of derived columns, and that unknown inputs give unknown values."""

import numpy as np
import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.models import BASIC_PHYSICAL, features
from socast.core.models.features import DERIVED_COLUMNS, Columns, get_unit, list_raw_columns
from tests.support.pooled_rides import fleet

TABLE = fleet(200, 1)
NUMBERS = st.floats(-60.0, 60.0)


@pytest.mark.parametrize("name", DERIVED_COLUMNS)
def test_derived_column_is_computed_row_by_row_from_its_inputs_only(name):
    filled = TABLE.fillna({"battery_temperature_c": 3.0})
    inputs = {column: filled[column] for column in list_raw_columns(name)}
    whole = Columns(inputs)[name]
    rows = np.array([5, 3, 120])
    assert Columns(inputs, rows=rows)[name].tobytes() == whole[rows].tobytes()
    assert np.isfinite(whole[np.isfinite(np.column_stack(list(inputs.values()))).all(axis=1)]).all()


@pytest.mark.parametrize("name", DERIVED_COLUMNS)
def test_unknown_input_makes_derived_column_unknown(name):
    for column in list_raw_columns(name):
        blind = TABLE.assign(**{column: np.nan})
        assert np.isnan(Columns(blind)[name]).all()


@pytest.mark.parametrize("name", DERIVED_COLUMNS)
def test_units_are_known_to_pint(name):
    assert pint.UnitRegistry().Unit(get_unit(name).replace("percent", "1")) is not None


@given(temperature=NUMBERS)
def test_cabin_is_never_heated_and_cooled_at_once(temperature):
    outside = np.array([temperature])
    heating, cooling = (
        DERIVED_COLUMNS["heating_need_k"].make(outside)[0],
        DERIVED_COLUMNS["cooling_need_k"].make(outside)[0],
    )
    assert heating >= 0.0
    assert cooling >= 0.0
    assert heating * cooling == 0.0
    assert DERIVED_COLUMNS["deep_cold_k"].make(outside)[0] <= heating


@given(time=st.floats(0.0, 1e7), more=st.floats(0.0, 1e6))
def test_warm_up_and_soak_shares_rise_from_zero_to_one(time, more):
    for made in (DERIVED_COLUMNS["warmed"].make, DERIVED_COLUMNS["soaked"].make):
        early, late = made(np.array([time, time + more]))
        assert 0.0 <= early <= late <= 1.0
    assert DERIVED_COLUMNS["warmed"].make(np.array([features.CABIN_WARM_UP]))[0] == pytest.approx(1.0 - np.exp(-1.0))


def test_sun_stands_at_its_known_height_over_montreal():
    noon, midnight = 1529596800.0, 1529640000.0  # 21 June 2018, 16:00 UTC, and twelve hours on
    heights = features.compute_sun_sine(np.array([noon, midnight]), np.full(2, 45.5), np.full(2, -73.6))
    assert np.degrees(np.arcsin(heights[0])) == pytest.approx(67.0, abs=4.0)
    assert heights[1] == 0.0
    december = features.compute_sun_sine(
        np.array([1545411600.0]), np.array([45.5]), np.array([-73.6])
    )  # 21 December 2018, 17:00 UTC
    assert np.degrees(np.arcsin(december[0])) == pytest.approx(21.0, abs=4.0)


def test_basic_energy_equals_the_basic_physical_model():
    np.testing.assert_allclose(Columns(TABLE)["basic_kwh"], BASIC_PHYSICAL.predict_energy(TABLE), rtol=1e-12)


def test_ride_without_motion_has_the_smallest_size():
    still = TABLE.assign(effect_rolling=0.0, effect_accessories=0.0, distance_km=0.0)
    assert (Columns(still)["size_kwh"] == features.SMALLEST_RIDE).all()
    assert (Columns(TABLE)["size_kwh"] > features.SMALLEST_RIDE).all()
    assert np.isnan(Columns(still)["stops_per_km"]).all()


def test_battery_fullness_and_frost_start_at_their_thresholds():
    assert DERIVED_COLUMNS["battery_fullness_pct"].make(np.array([50.0, 88.0, 98.0])).tolist() == [0.0, 0.0, 10.0]
    assert DERIVED_COLUMNS["battery_frost_k"].make(np.array([25.0, 5.0, -5.0])).tolist() == [0.0, 0.0, 10.0]
