"""Test the true coefficients of a simulated fleet, and the measure of the coverage of intervals."""

import json

import pytest

from socast.core.vehicles import load_catalogue
from socast.tools.bench import coefficients
from socast.tools.simulator.truth import Truth


def make_truth(**changes):
    entry = load_catalogue()["nissan-leaf-2016"]
    car = {
        "model": "nissan-leaf-2016",
        "mass": entry.mass_kg,
        "rolling_resistance": entry.rolling_resistance,
        "drag_area": entry.drag_coefficient * entry.frontal_area_m2,
        "efficiency": 0.8,
        "speedometer": 1.0,
    }
    truth = Truth()
    truth.cars["taxi-001"] = car | changes
    return truth


def test_true_coefficients_follow_from_the_parameters_of_the_cars():
    rides = coefficients.pd.DataFrame({"vehicle_id": ["taxi-001"] * 2, "distance_km": [3.0, 5.0]})
    plain = coefficients.find_truth(make_truth(), rides)
    assert plain["rolling"] == plain["climbing"] == pytest.approx(1.25)
    assert plain["inertia_positive"] == plain["inertia_negative"] == pytest.approx(1.04 * 1.25)
    assert plain["braking"] == pytest.approx(0.45)
    assert plain["aero_drag"] == pytest.approx(1.25 * 1.2 / 1.225)
    fast = coefficients.find_truth(make_truth(speedometer=1.1), rides)
    assert fast["rolling"] == pytest.approx(plain["rolling"] / 1.1)
    assert fast["aero_drag"] == pytest.approx(plain["aero_drag"] / 1.1**3)


@pytest.mark.long
def test_most_intervals_of_a_fleet_hold_the_true_coefficients(tmp_path, capsys):
    file = tmp_path / "coefficients.json"
    assert coefficients.main(["--seeds", "11", "--processes", "1", "--json", str(file)]) == 0
    estimates = json.loads(file.read_text())["estimates"]
    assert len(estimates) == 6
    assert sum(each["low"] <= each["truth"] <= each["high"] for each in estimates) >= 4
    assert "Intervals of 95 %" in capsys.readouterr().out


def test_wrong_seeds_are_refused_in_one_line(capsys):
    assert coefficients.main(["--seeds", "a-b"]) == 2
    assert capsys.readouterr().err.startswith("--seeds is 'a-b'; give numbers")
