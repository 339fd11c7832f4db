"""Test percentage errors by ride, car and date, and reductions below the baselines, against values computed by hand."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from socast.core.evaluate.paper.breakdown import compute_percentage_errors, compute_reductions_by_baseline
from socast.core.evaluate.paper.results import HeldOutPredictions
from socast.core.evaluate.ride_filter import EvaluatedRides

ENERGY = np.array([1.0, 2.0, 4.0, 0.05])
SD = np.array([0.1, 0.1, 0.3, 0.1])


@pytest.fixture
def evaluated():
    rides = pd.DataFrame(
        {
            "energy_kwh": ENERGY,
            "energy_vi_kwh": ENERGY,
            "energy_vi_sd_kwh": np.hypot(SD, 0.01 * ENERGY),
            "vehicle_id": ["a", "a", "b", "b"],
            "date": ["d1", "d2", "d2", "d3"],
        }
    )
    codes = np.zeros(4, dtype=np.int64)
    return EvaluatedRides(rides, 4, {}, ("leaf",), codes, codes, ENERGY)


def hold(rows, energy, overlap=0.25):
    """Return predictions of one recipe in repeats."""
    return HeldOutPredictions(
        ("toy",),
        tuple(np.array(at) for at in rows),
        {"toy": tuple(np.array(e) for e in energy)},
        {},
        overlap,
        (),
    )


def test_errors_by_ride_are_means_over_repeats(evaluated):
    held = hold([[0, 1], [2, 3]], [[1.5, 2.0], [3.0, 0.05]])
    errors = compute_percentage_errors({"ride": held}, evaluated).ride
    toy = errors.recipes["toy"]
    assert toy.mae_kwh.value == pytest.approx((0.25 + 0.5) / 2)
    assert toy.wmape.value == pytest.approx((0.5 / 3.0 + 1.0 / 4.05) / 2)
    assert toy.mape.value == pytest.approx((0.25 + 0.25) / 2)
    # two repeats with errors of 0.25 and 0.5: variance (1 / 2 + overlap) times 0.03125, t with one degree of freedom
    assert toy.mae_kwh.ci95 == pytest.approx(12.706 * np.sqrt(0.75 * 0.03125), rel=1e-3)
    assert (errors.rides, errors.energy_kwh, errors.below_least) == (4, pytest.approx(7.05 / 4), 0.25)


def test_noise_floor_is_that_of_held_out_rides(evaluated):
    errors = compute_percentage_errors({"date": hold([[0, 2]], [[1.0, 4.4]])}, evaluated).date
    floor = np.sqrt(2.0 / np.pi) * 0.2
    assert errors.noise_floor_kwh == pytest.approx(floor)
    assert errors.recipes["toy"].over_floor == pytest.approx(0.2 / floor)


def test_intervals_by_car_are_clustered_by_car(evaluated):
    held = hold([[0, 1, 2]], [[1.2, 2.2, 4.6]])
    by_car = compute_percentage_errors({"vehicle": held}, evaluated).vehicle.recipes["toy"].mae_kwh
    by_date = compute_percentage_errors({"date": held}, evaluated).date.recipes["toy"].mae_kwh
    assert by_car.value == pytest.approx(by_date.value) == pytest.approx(1.0 / 3.0)
    assert by_car.ci95 != pytest.approx(by_date.ci95)


def test_splits_without_predictions_are_left_out(evaluated):
    assert compute_percentage_errors({"vehicle": hold([], [])}, evaluated).to_json() == {"least_energy_kwh": 0.1}


def test_table_without_uncertainties_has_unknown_floor(evaluated):
    plain = replace(evaluated, rides=evaluated.rides.drop(columns=["energy_vi_kwh", "energy_vi_sd_kwh"]))
    errors = compute_percentage_errors({"date": hold([[0]], [[1.5]])}, plain).date
    assert errors.noise_floor_kwh is None
    assert errors.recipes["toy"].over_floor is None
    assert errors.recipes["toy"].wmape.value == pytest.approx(0.5)


def test_reductions_refer_to_each_baseline():
    errors = {"basic_physical": [1.0, 2.0], "basic_rescaled": [0.5, 1.0], "hybrid": [0.25, 0.25]}
    shares = compute_reductions_by_baseline(errors, ["leaf", "soul"])
    assert list(shares) == ["basic_physical", "basic_rescaled"]
    assert shares["basic_physical"]["hybrid"] == pytest.approx({"leaf": 0.75, "soul": 0.875, "average": 0.8125})
    assert shares["basic_rescaled"]["hybrid"] == pytest.approx({"leaf": 0.5, "soul": 0.75, "average": 0.625})
    assert shares["basic_rescaled"]["basic_physical"]["average"] == pytest.approx(-1.0)
