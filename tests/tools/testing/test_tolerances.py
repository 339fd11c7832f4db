"""Test the tolerances of fields."""

import pytest

from socast.core.errors import SettingsError
from socast.tools.testing.tolerances import Tolerance, find_unit, parse_tolerances, resolve_tolerances

FIELDS = ("soc_pct", "soc_sd_pct", "range_km.mean", "range_km.p05", "ride_energy_predicted_kwh", "model")


def resolve(*words):
    return resolve_tolerances(parse_tolerances(words), FIELDS)


@pytest.mark.parametrize(
    ("word", "tolerance"),
    [
        ("range_km=2", Tolerance(2.0)),
        ("range_km=2km", Tolerance(2.0)),
        ("range_km=2 km", Tolerance(2.0)),
        ("range_km=2%", Tolerance(0.0, 0.02)),
        ("range=1e-3", Tolerance(0.001)),
    ],
)
def test_tolerance_holds_for_all_fields_that_begin_with_its_name(word, tolerance):
    assert resolve(word) == {"range_km.mean": tolerance, "range_km.p05": tolerance}


def test_percent_of_a_field_in_percent_is_its_unit():
    assert resolve("soc=0.1%") == {"soc_pct": Tolerance(0.1), "soc_sd_pct": Tolerance(0.1)}


def test_longest_name_wins():
    assert resolve("soc_sd=3", "soc=1")["soc_sd_pct"] == Tolerance(3.0)
    assert resolve("range_km.p05=3", "range=1")["range_km.p05"] == Tolerance(3.0)


def test_name_ends_at_a_word():
    with pytest.raises(SettingsError, match="there is no such field"):
        resolve("so=1")


@pytest.mark.parametrize(
    "word", ["soc_pct", "soc_pct=", "=1", "soc_pct=-1", "soc_pct=nan", "soc_pct=inf", "soc_pct=1=2", "soc_pct=1e999"]
)
def test_wrong_tolerance_is_refused(word):
    with pytest.raises(SettingsError, match="give FIELD=NUMBER"):
        resolve(word)


def test_number_of_python_is_checked_as_text_is():
    with pytest.raises(SettingsError, match="tolerance soc_pct=nan: give FIELD=NUMBER"):
        resolve_tolerances({"soc_pct": float("nan")}, FIELDS)


def test_unknown_field_names_the_known_ones():
    with pytest.raises(SettingsError, match="there is no such field; did you mean range_km"):
        resolve("rnage_km=1")
    with pytest.raises(
        SettingsError, match="known are soc_pct, soc_sd_pct, range_km, ride_energy_predicted_kwh, model"
    ):
        resolve("x=1")


def test_other_unit_than_that_of_the_field_is_refused():
    with pytest.raises(SettingsError, match=r"range_km\.mean is in km; give range_km=2km"):
        resolve("range_km=2kWh")
    with pytest.raises(SettingsError, match="model has no unit"):
        resolve("model=2km")


@pytest.mark.parametrize(
    ("field", "unit"), [("solar_w_m2", "W/m²"), ("precipitation_mm_h", "mm/h"), ("speed_0_5_km", "km"), ("stops", "")]
)
def test_unit_is_that_of_the_name(field, unit):
    assert find_unit(field) == unit
