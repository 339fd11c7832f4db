"""Test laws of every recipe on small random fleets: no absurd prediction, and no gain from a hill up and down."""

import numpy as np
import pandas as pd
import pytest

from socast.core.fit.pooled import PooledRecipe
from socast.core.fit.recipes import RECIPES, LinearRecipe, make_product
from socast.core.models import ANY, LinearModel, make_physical_term
from tests.support import pooled_rides
from tests.support.planted_rides import MODELS, noisy, physical_energy

pytestmark = pytest.mark.long

SEEDS = range(4)
MOST = 10.0
"""Largest prediction over the largest measured energy. [1]"""
UNFITTED = {"basic_physical", "extended_physical"}
FITTED = [name for name in RECIPES if name not in UNFITTED]


def fleet(n: int, seed: int, models=MODELS, moving: float = 0.01) -> pd.DataFrame:
    """Return measured rides, most of which begin and end at rest, so that their kinetic energy is rounding."""
    rng = np.random.default_rng(seed)
    table = pooled_rides.fleet(n, seed, models=models)
    inertia = np.where(rng.random(n) < moving, rng.normal(0.0, 0.02, n), rng.normal(0.0, 1e-17, n))
    braked = 0.3 * table["effect_inertia_positive"] - 0.3 * table["effect_climbing_down"]
    table = table.assign(effect_inertia=inertia, effect_braking=braked, unresolved_braking_kwh=0.0)
    cold = table["effect_rolling"] * np.maximum(20.0 - table["ambient_c"], 0.0)
    force = rng.uniform(200.0, 900.0, n)  # at the wheels, root of the mean square [N]
    table = table.assign(effect_cold_rolling=cold, effect_drivetrain_loss_torque=force**2 * table["duration_s"] / 3.6e6)
    table["ride_key"] = [f"{seed}#{i}" for i in range(n)]
    energy = physical_energy(table, {"rolling": 1.3}) + 0.3 * table["effect_climbing_up"].to_numpy()
    table = noisy(table, energy, seed)
    return table.assign(
        energy_vi_kwh=table["energy_kwh"], energy_vi_sd_kwh=table["energy_sd_kwh"], energy_soc_sd_kwh=np.nan
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", RECIPES)
def test_no_prediction_is_beyond_ten_times_the_largest_measured_energy(name, seed):
    rng = np.random.default_rng(1000 + seed)
    models = MODELS[: rng.integers(1, 4)]
    known = fleet(int(rng.integers(130, 400)), seed, models)
    fresh = fleet(300, seed + 50, MODELS, moving=0.2)
    predicted = RECIPES[name].fit(known, covariance=False).predict_energy(fresh)
    assert np.abs(predicted).max() <= MOST * fresh["energy_kwh"].max()


def test_an_interaction_whose_main_term_is_large_in_one_ride_only_stays_bounded_by_its_factors():
    """One ride of the summer alone does not end at rest, and rides of the winter leave rounding."""
    table = fleet(800, 3, MODELS[:1], moving=0.0)
    table.loc[table.index[table["winter"] == 0][0], "effect_inertia"] = 0.02
    fit = RECIPES["hybrid_interactions"].fit(table).fits[ANY]
    found = dict(zip([term.name for term in RECIPES["hybrid_interactions"].terms], fit.coefficients, strict=True))
    assert set(fit.dropped) >= {"winter * inertia", "nominal_capacity_kwh"}
    assert found["winter * inertia"] == 0.0
    assert abs(found["summer * inertia"]) < 2.0
    assert abs(found["odometer_km * inertia"]) * table["odometer_km"].max() < 4.0


def test_an_interaction_of_rounding_is_dropped_where_its_main_term_is_well_determined():
    table = fleet(800, 4, MODELS[:1], moving=0.0)
    rng = np.random.default_rng(4)
    table["effect_inertia"] = np.where(table["winter"] == 0, rng.normal(0.0, 0.3, 800), rng.normal(0.0, 1e-17, 800))
    table = noisy(table, physical_energy(table))
    main = make_physical_term("inertia", ("effect_inertia",))
    rolling = make_physical_term("rolling", ("effect_rolling", "rolling_resistance"))
    fit = LinearRecipe("two", "two", (rolling, main, make_product("winter", main))).fit(table).fits[ANY]
    assert fit.dropped == ("winter * inertia",)
    assert fit.coefficients[1] == pytest.approx(1.0, abs=0.1)
    assert fit.coefficients[2] == 0.0


def test_predictions_that_stop_at_the_limit_are_counted_and_equal_it():
    model = RECIPES["fitted_physical"].fit(fleet(300, 5))
    rides = fleet(50, 6)
    assert model.count_limited(rides, model.predict_energy(rides)) == 0
    absurd = rides.assign(effect_climbing=np.where(np.arange(50) < 20, 1e6, rides["effect_climbing"]))
    predicted = model.predict_energy(absurd)
    assert model.count_limited(absurd, predicted) == 20
    np.testing.assert_array_equal(predicted[:20], model.compute_limits(absurd)[:20])
    np.testing.assert_array_equal(predicted[20:], model.predict_energy(rides)[20:])


def hill(level: pd.DataFrame, slope: float) -> pd.DataFrame:
    """Return rides between the same places of a map, up and down a slope in place of the level road."""
    longer = np.sqrt(1.0 + slope * slope)
    by_road = ["distance_km", "duration_s", *(f"effect_{name}" for name in ("aero_drag", "aero_drag_wind"))]
    by_road += ["effect_accessories", "effect_auxiliary", *(name for name in level if name.startswith("speed_"))]
    climbed = level["effect_rolling"] * slope / 2.0
    metres = 1000.0 * level["distance_km"] * slope / 2.0
    return level.assign(
        **{name: level[name] * longer for name in by_road},
        gained_m=metres,
        lost_m=metres,
        effect_climbing_up=climbed,
        effect_climbing_down=-climbed,
        effect_braking=level["effect_braking"] + 0.3 * climbed,
    )


def mean_level_rides(table: pd.DataFrame) -> pd.DataFrame:
    """Return a ride of each vehicle model with the means of its rides, on a level road."""
    means = table.groupby("vehicle_model").mean(numeric_only=True).reset_index()
    level = dict.fromkeys(("gained_m", "lost_m", "effect_climbing", "effect_climbing_up", "effect_climbing_down"), 0.0)
    return means.assign(vehicle_id="car", date="2018-06-01", **level)


@pytest.mark.parametrize("losing", [False, True])
@pytest.mark.parametrize("name", FITTED)
def test_a_round_trip_over_a_hill_never_costs_less_than_the_level_road(name, losing):
    """Where `losing`, the measured energies regain more downhill than they take uphill.

    Pooled recipes are not constrained: their priors have the losses, and enough rides may contradict these.
    """
    if losing and isinstance(RECIPES[name], PooledRecipe):
        pytest.skip("follows its rides")
    table = fleet(330, 21, MODELS[:2])
    if losing:
        table["energy_kwh"] -= 0.0015 * (table["gained_m"] + table["lost_m"])
    model: LinearModel = RECIPES[name].fit(table, covariance=False)
    level = mean_level_rides(table)
    flat = model.predict_energy(level)
    for slope in (0.02, 0.06, 0.12):
        assert (model.predict_energy(hill(level, slope)) >= flat - 1e-9).all()
