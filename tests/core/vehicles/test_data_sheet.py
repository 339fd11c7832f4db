"""Test that data sheets become vehicle models, with priors for what is not known."""

import pytest

from socast.core.errors import CatalogueError
from socast.core.vehicles import add_vehicles, list_assumed, load_catalogue, read_data_sheets
from socast.core.vehicles.catalogue import vehicle_model
from socast.core.wire.messages import Vehicle

SHEET = "[my-car]\nmass_kg = 1800\nnominal_capacity_kwh = 60\n"


def test_unknown_figures_are_those_usual_in_the_catalogue():
    car = read_data_sheets(SHEET, "cars.toml")["my-car"]
    assert (car.mass_kg, car.nominal_capacity_kwh, car.name) == (1800.0, 60.0, "my-car")
    assert car.rolling_resistance == 0.008
    assert list_assumed(car) == ["drag_coefficient", "frontal_area_m2", "rolling_resistance", "accessory_scale"]


def test_drag_area_stands_in_place_of_coefficient_and_area():
    car = read_data_sheets(SHEET + "drag_area_m2 = 0.9", "cars.toml")["my-car"]
    assert car.drag_area_m2 == pytest.approx(0.9)
    assert "drag_coefficient" not in list_assumed(car)


def test_added_vehicle_is_served_like_one_of_the_catalogue():
    assert vehicle_model(Vehicle("taxi-7", 0.0, "my-car")) == "unknown_vehicle_model"
    add_vehicles(read_data_sheets(SHEET, "cars.toml"))
    assert vehicle_model(Vehicle("taxi-7", 0.0, "my-car", mass_kg=1900.0)).mass_kg == 1900.0
    assert load_catalogue()["nissan-leaf-2013"].mass_kg == 1515.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[my-car", "is not TOML"),
        ("", "holds no vehicle"),
        ("[my-car]\nmass_kg = 1800", "nominal_capacity_kwh is missing: give one from 1 to 400"),
        (SHEET.replace("1800", "18"), "mass_kg 18 is outside 200 to 7500"),
        (SHEET + "drag_area = 1", "'drag_area' is no figure of a vehicle; did you mean drag_area_m2"),
        (SHEET + "legs = 4", "'legs' is no figure of a vehicle; known are accessory_scale, drag_area_m2,"),
        (SHEET + "drag_area_m2 = 9", "drag_area_m2 is 9; give one from 0.1 to 5"),
        (SHEET + "drag_area_m2 = 1\ndrag_coefficient = 0.3", "leave one of them out"),
        (SHEET.replace("my-car", "tesla-model-s"), "is in the catalogue already"),
    ],
)
def test_mistake_is_one_line_with_file_value_and_remedy(text, words):
    with pytest.raises(CatalogueError) as refused:
        read_data_sheets(text, "cars.toml")
    assert str(refused.value).startswith("cars.toml")
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
