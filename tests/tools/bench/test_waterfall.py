"""The true energies of terms add up to the energy at the battery, at what driving costs there."""

from datetime import UTC, datetime

import pytest

from socast.tools.bench.waterfall import TermEnergy, TermTruth, list_rows, sum_terms
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Simulation


def test_true_energies_of_terms_add_up_to_the_energy_of_the_rides():
    truth = TermTruth()
    start = datetime(2018, 1, 15, tzinfo=UTC)
    for _ in simulate(Simulation(vehicles=2, days=1, shift_hours=0.5, start=start, seed=3), truth):
        pass
    chosen = {(ride["vehicle_id"], ride["ride_id"]) for ride in truth.rides}
    terms = sum_terms(truth, chosen)
    assert sum(terms.values()) == pytest.approx(sum(ride["energy_kwh"] for ride in truth.rides), abs=1e-3)
    assert terms["inertia_positive"] == pytest.approx(-terms["inertia_negative"], rel=1e-2)


def test_wheel_energy_counts_at_what_driving_costs_and_braking_has_the_rest():
    truth = TermTruth()
    truth.cars["a"] = {}
    powers = {"rolling": 2.0, "accessories": 1.0, "waiting": 0.5, "driven": 4.0, "driving_losses": 1.0}
    energies = powers | {"braked": 2.0, "braking_losses": 0.5}
    truth.rides = [{"vehicle_id": "a", "ride_id": name, "terms_kwh": energies} for name in ("1", "2")]
    assert sum_terms(truth, {("a", "1")}) == {
        "accessories": 1.0,
        "waiting": 0.5,
        "rolling": 2.5,
        "braking": 1.0,
    }


def test_rows_tell_bias_and_how_often_the_truth_is_held():
    right, near, off = (
        TermEnergy(seed, "plain", "rolling", 10.0, value, 0.5, 4.0) for seed, value in enumerate((10.2, 10.8, 12.0))
    )
    ((term, per, bias, half, held, within),) = list_rows([right, near, off])
    assert (term, per, bias, half) == ("rolling", "4.00", "10.0 %", "5.0 %")
    assert held.startswith("33.3 %")
    assert within.startswith("66.7 %")
