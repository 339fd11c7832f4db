"""Test the vehicle catalogue, its sources and plausibility, the overrides in messages, and the accessory curve."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import CatalogueError
from socast.core.vehicles.catalogue import (
    ACCESSORIES,
    BOUNDS,
    OUT_OF_RANGE,
    OVERRIDES,
    UNKNOWN_MODEL,
    AccessoryCurve,
    VehicleModel,
    load_catalogue,
    read_catalogue,
    vehicle_model,
)
from socast.core.wire.messages import Vehicle

KEYS = {
    "nissan-leaf-2013",
    "nissan-leaf-2016",
    "kia-soul-ev-2015",
    "tesla-model-s",
    "tesla-model-x",
    "bmw-i3-2014",
    "renault-twizy-2012",
}

ENTRY = """
[horse]
name = "Horse"
mass_kg = 500
drag_coefficient = 0.9
frontal_area_m2 = 1.0
rolling_resistance = 0.02
nominal_capacity_kwh = 5
accessory_scale = 0.0
[horse.sources]
mass_kg = "a"
drag_coefficient = "a"
frontal_area_m2 = "a"
rolling_resistance = "a"
nominal_capacity_kwh = "a"
accessory_scale = "a"
"""


def test_catalogue_has_the_keys_of_the_wire_contract():
    assert set(load_catalogue()) == KEYS
    assert all(key == model.key for key, model in load_catalogue().items())


@pytest.mark.parametrize("key", sorted(KEYS))
def test_every_figure_has_a_meaningful_source(key):
    model = load_catalogue()[key]
    for figure in BOUNDS:
        assert len(model.sources[figure]) > 15, figure
    assert set(model.sources) <= {f.name for f in fields(VehicleModel)}
    assert (model.usable_capacity_kwh is None) == ("usable_capacity_kwh" not in model.sources)
    assert (model.rated_kwh_per_km is None) == ("rated_kwh_per_km" not in model.sources)


@pytest.mark.parametrize("key", sorted(KEYS))
def test_road_load_at_90_kmh_is_that_of_a_small_electric_vehicle(key):
    model = load_catalogue()[key]
    rolling = model.mass_kg * 9.81 * model.rolling_resistance
    drag = 0.5 * 1.2 * model.drag_area_m2 * 25.0**2
    assert 0.05 < (rolling + drag) / 3600 < 0.16  # kWh/km at the wheels


@pytest.mark.parametrize("key", sorted(KEYS))
def test_official_consumption_is_one_to_four_times_the_road_load_in_town(key):
    model = load_catalogue()[key]
    load = model.mass_kg * 9.81 * model.rolling_resistance + 0.5 * 1.2 * model.drag_area_m2 * 16.0**2
    assert 1.0 < model.rated_kwh_per_km / (load / 3600) < 4.0


def test_equal_vehicle_models_have_equal_hashes():
    first = load_catalogue()["tesla-model-s"]
    assert first == replace(first)
    assert hash(first) == hash(replace(first))
    assert first.drag_area_m2 == first.drag_coefficient * first.frontal_area_m2


def test_catalogue_cannot_be_changed():
    with pytest.raises(TypeError):
        load_catalogue()["horse"] = None


def test_read_catalogue_reads_a_good_entry():
    assert read_catalogue(ENTRY)["horse"].mass_kg == 500.0


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[horse]", "[horse", "not TOML"),
        ("mass_kg = 500\n", "", "mass_kg is missing: give one from 200 to 7500"),
        ("mass_kg = 500\n", 'mass_kg = "heavy"\n', "mass_kg is 'heavy', no number"),
        ("mass_kg = 500\n", "mass_kg = true\n", "mass_kg is True, no number"),
        ("mass_kg = 500\n", "mass_kg = 50\n", "mass_kg 50 is outside 200 to 7500"),
        ("mass_kg = 500\n", "mass_kg = nan\n", "mass_kg nan is outside"),
        ("mass_kg = 500\n", "mass_kg = 500\nlegs = 4\n", "'legs' is no figure of a vehicle"),
        ('mass_kg = "a"\n', "", "mass_kg has no source"),
        ('mass_kg = "a"\n', 'mass_kg = " "\n', "mass_kg has no source"),
        ('name = "Horse"\n', "", "it has no name"),
        (
            "accessory_scale = 0.0\n",
            "accessory_scale = 0.0\nusable_capacity_kwh = 6\n",
            "usable_capacity_kwh 6 is outside 1 to 5",
        ),
        (
            "accessory_scale = 0.0\n",
            "accessory_scale = 0.0\nrated_kwh_per_km = 18\n",
            "rated_kwh_per_km 18 is outside 0.02 to 1",
        ),
        ("[horse.sources]", "[cart]\nname='x'\n[cart.sources]", "no sources"),
        ("[horse]", "x = 1\n[horse]", "'x' is no table"),
    ],
)
def test_invalid_catalogue_is_refused_with_figure_and_place_in_one_line(before, after, message):
    assert ENTRY.count(before) == 1
    with pytest.raises(CatalogueError) as caught:
        read_catalogue(ENTRY.replace(before, after))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_message_without_overrides_gives_the_catalogue_entry():
    assert vehicle_model(Vehicle("a", 0.0, "bmw-i3-2014")) is load_catalogue()["bmw-i3-2014"]


@given(
    st.sampled_from(sorted(KEYS)),
    st.dictionaries(st.sampled_from(OVERRIDES), st.floats(0.0, 1.0), max_size=len(OVERRIDES)),
)
def test_overrides_replace_their_figures_and_no_others(key, shares):
    overrides = {name: BOUNDS[name][0] + share * (BOUNDS[name][1] - BOUNDS[name][0]) for name, share in shares.items()}
    model = vehicle_model(Vehicle("a", 0.0, key, **overrides))
    for name in BOUNDS:
        assert getattr(model, name) == overrides.get(name, getattr(load_catalogue()[key], name))
    assert all(model.sources[name] == "the car's own vehicle message" for name in overrides)


def test_usable_capacity_scales_with_an_overridden_nominal_capacity():
    model = vehicle_model(Vehicle("a", 0.0, "tesla-model-s", nominal_capacity_kwh=68.0))
    assert model.usable_capacity_kwh == pytest.approx(77.5 * 68 / 85)


COMPLETE = {
    "nominal_capacity_kwh": 40.0,
    "mass_kg": 1600.0,
    "drag_coefficient": 0.28,
    "frontal_area_m2": 2.3,
    "rolling_resistance": 0.009,
}


def test_complete_overrides_replace_an_unknown_key():
    model = vehicle_model(Vehicle("a", 0.0, "new-car", **COMPLETE))
    assert (model.key, model.mass_kg, model.accessory_scale) == ("new-car", 1600.0, 1.0)
    assert set(BOUNDS) <= set(model.sources)


@pytest.mark.parametrize("missing", OVERRIDES)
def test_unknown_key_with_incomplete_overrides_gives_a_reason(missing):
    overrides = {name: value for name, value in COMPLETE.items() if name != missing}
    assert vehicle_model(Vehicle("a", 0.0, "new-car", **overrides)) == UNKNOWN_MODEL


@pytest.mark.parametrize("name", OVERRIDES)
@pytest.mark.parametrize("key", ["new-car", "kia-soul-ev-2015"])
@pytest.mark.parametrize("side", [0, 1])
def test_override_out_of_range_gives_a_reason(name, key, side):
    outside = BOUNDS[name][side] * (0.99, 1.01)[side]
    assert vehicle_model(Vehicle("a", 0.0, key, **{**COMPLETE, name: outside})) == OUT_OF_RANGE


def test_accessory_curve_has_five_segments():
    curve = ACCESSORIES
    celsius = np.arange(-60.0, 60.0, 0.01)
    power = curve.power(celsius + ZERO_CELSIUS)
    slope = np.diff(power) / 0.01
    signs = np.sign(np.where(np.abs(slope) < 1e-6, 0.0, slope))
    segments = signs[np.r_[True, np.diff(signs) != 0]]
    assert segments.tolist() == [0, -1, 0, 1, 0]
    assert power[0] == curve.heating
    assert power[-1] == curve.cooling
    assert power.min() == curve.standby
    assert curve.cooling < curve.heating  # the paper: cooling takes less than heating


@given(st.floats(200.0, 340.0), st.floats(1e-6, 1e-3))
def test_accessory_curve_is_continuous(ambient, step):
    curve = ACCESSORIES
    steepest = max(
        (curve.heating - curve.standby) / (curve.heating_off - curve.heating_full),
        (curve.cooling - curve.standby) / (curve.cooling_full - curve.cooling_on),
    )
    before, after = curve.power(np.array([ambient, ambient + step]))
    assert abs(after - before) <= steepest * step + 1e-8


def test_accessory_curve_is_linear_between_its_temperatures():
    curve = AccessoryCurve(260.0, 285.0, 295.0, 305.0, 5000.0, 400.0, 2000.0)
    knots = [260.0, 285.0, 295.0, 305.0]
    ambient = np.linspace(240.0, 320.0, 1001)
    expected = np.interp(ambient, knots, [5000.0, 400.0, 400.0, 2000.0])
    np.testing.assert_allclose(curve.power(ambient), expected, rtol=1e-12)
    assert np.isnan(curve.power(np.array([np.nan]))).all()
