"""Test that the physical models equal the equations of the paper, and that prediction works row by row."""

from itertools import pairwise

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import GRAVITY, JOULES_PER_KWH, ZERO_CELSIUS
from socast.core.effects.road_load import STANDARD_AIR_DENSITY
from socast.core.errors import ModelError
from socast.core.fit.recipes import FITTED_TERMS, get_recipe
from socast.core.models import ANY, BASIC_PHYSICAL, CORRECTION, EXTENDED_PHYSICAL, Fit, Term
from socast.core.vehicles import ACCESSORIES
from tests.support.linear_models import CURVE, FLEET, LEAF, STUMP, fleet, make_model, model_of, ride_columns, steps
from tests.support.planted_rides import planted


def equation_1(signals) -> np.ndarray:
    """Return equation (1) as the paper prints it, with v in km/h, d in km and E in kWh. [kWh]"""
    m, a = signals["mass"], signals["acceleration"]
    theta = np.arcsin(signals["grade"])
    f, rho, cx, area, g = (
        LEAF.rolling_resistance,
        STANDARD_AIR_DENSITY,
        LEAF.drag_coefficient,
        LEAF.frontal_area_m2,
        GRAVITY,
    )
    v = signals["speed"] * 3.6
    d = signals["speed"] * signals["dt"] / 1000
    return (
        (1 / 3600)
        * (m * g * (f * np.cos(theta) + np.sin(theta)) + 0.5 * (rho * cx * area * (v / 3.6) ** 2) + m * a)
        * d
    )


@given(st.integers(0, 2**32))
def test_basic_physical_model_equals_equation_1(seed):
    signals = steps(seed, 50)
    predicted = BASIC_PHYSICAL.predict_energy(ride_columns(BASIC_PHYSICAL, signals))
    np.testing.assert_allclose(predicted, equation_1(signals), rtol=1e-11, atol=1e-15)


@given(st.integers(0, 2**32))
def test_extended_physical_model_adds_the_accessories(seed):
    signals = steps(seed, 50)
    predicted = EXTENDED_PHYSICAL.predict_energy(ride_columns(EXTENDED_PHYSICAL, signals))
    accessories = ACCESSORIES.power(signals["ambient"]) * 3.0 / JOULES_PER_KWH
    np.testing.assert_allclose(predicted, equation_1(signals) + accessories, rtol=1e-11, atol=1e-15)


def test_kilometre_at_50_kmh_in_a_leaf_matches_manual_calculation():
    speed = 50 / 3.6
    signals = {
        "dt": np.array([1000 / speed]),
        "speed": np.array([speed]),
        "acceleration": np.zeros(1),
        "grade": np.zeros(1),
        "ambient": np.array([ZERO_CELSIUS + 15]),
        "mass": np.array([1600.0]),
        "accessory_scale": np.ones(1),
    }
    columns = ride_columns(EXTENDED_PHYSICAL, signals)
    # 1600 kg * 9.80665 * 0.008 = 125.5 N; 0.5 * 1.225 * 0.72 * 13.89^2 = 85.1 N; 210.6 N km / 3600 = 0.0585 kWh
    assert BASIC_PHYSICAL.predict_energy(columns)[0] == pytest.approx(0.0585, abs=5e-5)
    # and 300 W for 72 s = 0.006 kWh
    assert EXTENDED_PHYSICAL.predict_energy(columns)[0] == pytest.approx(0.0645, abs=5e-5)


def test_physical_models_list_their_needs_and_effects():
    assert BASIC_PHYSICAL.effects == ("rolling", "climbing", "aero_drag", "inertia")
    assert EXTENDED_PHYSICAL.effects == (*BASIC_PHYSICAL.effects, "accessories")
    assert set(BASIC_PHYSICAL.needs) == {f"effect_{e}" for e in BASIC_PHYSICAL.effects} | {
        "rolling_resistance",
        "drag_area_m2",
    }


@given(st.integers(0, 2**32), st.lists(st.integers(0, 40), max_size=6))
def test_physical_prediction_of_a_row_does_not_depend_on_other_rows(seed, cuts):
    columns = ride_columns(EXTENDED_PHYSICAL, steps(seed, 40))
    whole = EXTENDED_PHYSICAL.predict_energy(columns)
    edges = [0, *sorted(cuts), 40]
    parts = [EXTENDED_PHYSICAL.predict_energy({n: c[a:b] for n, c in columns.items()}) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def test_prediction_changes_neither_model_nor_columns():
    columns = ride_columns(EXTENDED_PHYSICAL, steps(1, 10))
    before = {name: column.copy() for name, column in columns.items()}
    for column in columns.values():
        column.flags.writeable = False
    first, again = EXTENDED_PHYSICAL.predict_energy(columns), EXTENDED_PHYSICAL.predict_energy(columns)
    assert first.tobytes() == again.tobytes()
    assert all(columns[name].tobytes() == before[name].tobytes() for name in columns)


@pytest.mark.parametrize("name", EXTENDED_PHYSICAL.needs)
def test_prediction_is_nan_only_where_a_needed_column_is_nan(name):
    columns = ride_columns(EXTENDED_PHYSICAL, steps(2, 5))
    columns[name][3] = np.nan
    assert np.isnan(EXTENDED_PHYSICAL.predict_energy(columns)).tolist() == [False, False, False, True, False]


def test_prediction_accepts_a_table_and_ignores_other_columns():
    columns = ride_columns(BASIC_PHYSICAL, steps(3, 5))
    table = pd.DataFrame({**columns, "driver_id": "d"})
    assert BASIC_PHYSICAL.predict_energy(table).tobytes() == BASIC_PHYSICAL.predict_energy(columns).tobytes()


def test_missing_column_is_refused_by_name():
    with pytest.raises(ModelError, match=r"basic_physical: column 'effect_inertia' is missing"):
        BASIC_PHYSICAL.predict_energy({n: np.ones(1) for n in BASIC_PHYSICAL.needs if n != "effect_inertia"})


def test_prediction_handles_no_rows_and_constant_terms():
    assert BASIC_PHYSICAL.predict_energy({n: np.empty(0) for n in BASIC_PHYSICAL.needs}).shape == (0,)
    constant = model_of(Term(name="one", columns=(), unit="kWh"), fits={ANY: Fit(coefficients=(0.25,))})
    assert constant.predict_energy({"distance_km": np.zeros(3)}).tolist() == [0.25, 0.25, 0.25]
    assert constant.effects == ()


def by_hand(ride) -> float:
    """Return the prediction of FLEET for a ride, written out term by term. [kWh]"""
    fit = FLEET.fits.get(ride.vehicle_model, FLEET.fits[ANY])
    distance = fit.fills.get("distance_km", np.nan) if np.isnan(ride.distance_km) else ride.distance_km
    east = np.sin(np.radians(ride.wind_from_deg))
    east = fit.fills.get("wind_from_east", np.nan) if np.isnan(east) else east
    power = CURVE.power(np.array([ride.ambient_c + ZERO_CELSIUS]))[0]
    columns = (distance, east * ride.wind_speed_kmh, ride.duration_s * power * ride.accessory_scale / 3.6e6, 1.0)
    total = sum(c * x for c, x in zip(fit.coefficients, columns, strict=True))
    if ride.vehicle_model == "leaf":
        total += 0.5 + (-1.0 if ride.occupants <= 2 else 1.0)
    return total * (1.125 if ride.vehicle_id == "b" else 1.0)


def test_prediction_uses_fit_of_vehicle_model_and_factor_of_car():
    rides = fleet()
    expected = [by_hand(ride) for ride in rides.itertuples()]
    np.testing.assert_allclose(FLEET.predict_energy(rides), expected, rtol=1e-12)
    known = ~np.isnan(expected)
    assert 10 < known.sum() < len(rides)


def test_needs_include_columns_behind_derived_columns_and_fits():
    assert FLEET.needs == (
        "distance_km",
        "wind_from_deg",
        "wind_speed_kmh",
        "duration_s",
        "ambient_c",
        "accessory_scale",
        "occupants",
        "vehicle_model",
        "vehicle_id",
    )
    alone = msgspec.structs.replace(FLEET, fits={ANY: FLEET.fits[ANY]}, cars={}, correction=None)
    assert "vehicle_model" not in alone.needs
    assert "vehicle_id" not in alone.needs


@given(st.integers(0, 2**32), st.lists(st.integers(0, 60), max_size=6))
def test_prediction_of_a_row_does_not_depend_on_other_rows(seed, cuts):
    rides = fleet(60, seed)
    whole = FLEET.predict_energy(rides)
    edges = [0, *sorted(cuts), 60]
    parts = [FLEET.predict_energy(rides.iloc[a:b]) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    order = np.random.default_rng(seed).permutation(60)
    assert FLEET.predict_energy(rides.iloc[order]).tobytes() == whole[order].tobytes()


def test_prediction_does_not_change_the_table():
    rides = fleet()
    before = rides.copy(deep=True)
    FLEET.predict_energy(rides)
    pd.testing.assert_frame_equal(rides, before)


def test_prediction_is_unknown_for_vehicle_models_without_a_fit():
    lone = msgspec.structs.replace(FLEET, fits={"leaf": FLEET.fits["leaf"]}, correction=None)
    rides = fleet()
    known = ~np.isnan(lone.predict_energy(rides))
    assert set(rides["vehicle_model"][known]) == {"leaf"}


def test_interval_of_a_model_without_calibration_is_refused():
    with pytest.raises(ModelError, match="has no prediction interval"):
        FLEET.predict_interval(fleet())


@pytest.mark.parametrize("correction", [None, {ANY: STUMP}, {"tesla-model-s": STUMP}])
@pytest.mark.parametrize("cars", [{}, {"tesla-model-s-1": 1.2, "nissan-leaf-2013-3": 0.9}])
def test_parts_add_up_to_prediction(correction, cars):
    rides = planted(240)
    fitted = get_recipe("fitted_physical").fit(rides, covariance=False)
    model = msgspec.structs.replace(fitted, correction=correction, cars=cars)
    result = model.predict_parts(rides)
    assert list(result) == [term.name for term in FITTED_TERMS] + [CORRECTION] * (correction is not None)
    np.testing.assert_allclose(sum(result.values()), model.predict_energy(rides), rtol=1e-9)


def test_vehicle_model_without_fit_has_no_parts():
    rides = planted(40)
    one = make_model("one", FITTED_TERMS[:-1], [1.0] * 4, key="tesla-model-s")
    result = one.predict_parts(rides)["rolling"]
    np.testing.assert_array_equal(np.isnan(result), rides["vehicle_model"] != "tesla-model-s")
