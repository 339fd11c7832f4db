"""Test that recipes equal those of the paper, recover planted coefficients, and refuse unusable rides."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ModelError
from socast.core.fit.recipes import (
    BASELINES,
    BASIC_PART,
    FITTED_TERMS,
    HISTOGRAM_COLUMNS,
    RECIPES,
    LinearRecipe,
    get_recipe,
)
from socast.core.models import ANY, BASIC_PHYSICAL, decode_model, encode_model
from socast.core.models.features import ANSWERS
from tests.support.planted_rides import MODELS, noisy, physical_energy, rides

pytestmark = pytest.mark.long
PAPER = {
    "basic_physical": ("Basic Physical Model", 4),
    "extended_physical": ("Extended Physical Model", 5),
    "fitted_physical": ("Fitted Extended Physical Model (Linear Regression)", 5),
    "empirical": ("Learned Empirical Model (No Interaction Terms)", 38),
    "empirical_interactions": ("Learned Empirical Model (Interaction Terms)", 38 + 35 + 5),
    "hybrid": ("Hybrid Model (No Interaction Terms)", 40),
    "hybrid_interactions": ("Hybrid Model (Interaction Terms)", 40 + 5 + 4 + 10),
}
FITTED = [name for name in PAPER if name not in {"basic_physical", "extended_physical"}]


@pytest.fixture(scope="module")
def fleet() -> pd.DataFrame:
    """Return 2,000 rides of four vehicle models, with losses in the drivetrain."""
    table = rides(2000, seed=8)
    return noisy(table, physical_energy(table, {"rolling": 1.4, "climbing": 0.9}))


@pytest.fixture(scope="module")
def models(fleet):
    return {name: RECIPES[name].fit(fleet) for name in PAPER}


def names(recipe) -> set[str]:
    return {term.name for term in recipe.terms}


def test_recipes_are_named_and_ordered_as_in_the_paper():
    assert list(RECIPES)[: len(PAPER)] == list(PAPER)
    for name, (title, terms) in PAPER.items():
        assert (RECIPES[name].name, RECIPES[name].title, len(RECIPES[name].terms)) == (name, title, terms)


FOUR_RIDES = {
    "effect_rolling": [80.0, 160.0, 80.0, 160.0],
    "rolling_resistance": 0.01,
    "effect_aero_drag": [0.4, 0.8, 0.4, 0.8],
    "drag_area_m2": 0.5,
    "effect_climbing": 0.0,
    "effect_inertia": 0.0,
}
"""Rides of basic energies 1, 2, 1 and 2 kWh: rolling of 0.8 kWh and drag of 0.2 kWh on the shorter ones."""


class TestBaselines:
    """The coefficients of least squares are computed by hand."""

    def fit(self, name, energy, **columns):
        few = rides(4, seed=1, models=MODELS[:1]).assign(energy_kwh=energy, **columns)
        fitted = RECIPES[name].fit(few, covariance=False)
        return dict(zip((term.name for term in RECIPES[name].terms), fitted.fits[ANY].coefficients, strict=True))

    def test_rescaled_basic_has_the_factor_of_least_squares(self):
        # minimum of 2 (2 - k)^2 + 2 (3 - 2 k)^2 at k = (2 + 6) / (1 + 4)
        assert self.fit("basic_rescaled", [2.0, 3.0, 2.0, 3.0], **FOUR_RIDES) == pytest.approx({"basic": 1.6})

    def test_rescaled_basic_with_power_solves_two_kinds_of_ride_exactly(self):
        # k + 1800 s p = 2 kWh and 2 k + 1800 s p = 3 kWh: k = 1, and 1 kWh in half an hour is 2 kW
        fitted = self.fit("basic_rescaled_power", [2.0, 3.0, 2.0, 3.0], duration_s=1800.0, **FOUR_RIDES)
        assert fitted == pytest.approx({"basic": 1.0, "duration_s": 2.0 / 3600.0})

    def test_telematics_regression_recovers_planted_coefficients(self):
        table = rides(400, seed=4, models=MODELS[:1])
        gap = (table["ambient_c"] - 20.0).abs()
        energy = 0.1 * table["distance_km"] + 2e-5 * table["distance_km"] * table["average_speed_kmh"] ** 2
        energy += 3e-4 * table["duration_s"] + 1e-5 * table["duration_s"] * gap
        fitted = RECIPES["telematics_regression"].fit(table.assign(energy_kwh=energy), covariance=False)
        assert fitted.fits[ANY].coefficients == pytest.approx((0.1, 2e-5, 3e-4, 1e-5), rel=1e-6)

    def test_baselines_have_none_to_four_fitted_numbers(self):
        counted = [len(RECIPES[name].terms) if RECIPES[name].free else 0 for name in BASELINES]
        assert counted == [0, 1, 2, 4]


def test_terms_equal_those_of_the_paper():
    squares = {f"{name} * {name}" for name in ("distance_km", "ambient_c", "speed_0_5_km", "soc_start_pct")}
    speeds = {f"average_speed_kmh * {other}" for other in ("lost_m", "odometer_km", "distance_km", "winter", "summer")}
    assert squares | speeds <= names(RECIPES["empirical_interactions"])
    physical = [term.name for term in FITTED_TERMS]
    assert physical == ["rolling", "aero_drag_wind", "inertia", "climbing", "accessories"]
    hybrid = names(RECIPES["hybrid"])
    removed = {"time_since_charge_s", "precipitation_mm_h", "gained_m"}
    assert names(RECIPES["hybrid_full"]) == names(RECIPES["empirical"]) | set(physical)
    assert hybrid == names(RECIPES["hybrid_full"]) - removed
    assert removed <= names(RECIPES["hybrid_full"])
    added = {f"{by} * {name}" for by in ("odometer_km", "winter", "summer") for name in physical}
    added |= {f"lost_m * {term.name}" for term in BASIC_PART}
    assert names(RECIPES["hybrid_interactions"]) == hybrid | added
    assert len(HISTOGRAM_COLUMNS) == 21
    assert all("constant" not in names(RECIPES[name]) for name in ("basic_physical", "fitted_physical"))


def test_no_recipe_reads_the_answer():
    for recipe in RECIPES.values():
        for term in getattr(recipe, "terms", ()):
            assert not any(column.startswith(ANSWERS) for column in term.columns)


def test_basic_physical_recipe_equals_the_built_in_model(fleet, models):
    assert models["basic_physical"].predict_energy(fleet).tobytes() == BASIC_PHYSICAL.predict_energy(fleet).tobytes()


def test_each_vehicle_model_has_a_fit_and_all_others_share_one(fleet, models):
    for name in PAPER:
        assert set(models[name].fits) == {*MODELS, ANY}
        assert {key: fit.rides for key, fit in models[name].fits.items()} == {
            **fleet["vehicle_model"].value_counts().to_dict(),
            ANY: 2000,
        }
    alone = RECIPES["hybrid"].fit(fleet[fleet["vehicle_model"] == MODELS[0]])
    np.testing.assert_allclose(alone.fits[ANY].coefficients, models["hybrid"].fits[MODELS[0]].coefficients, rtol=1e-6)
    stranger = fleet.assign(vehicle_model="a-new-one")
    assert np.isfinite(models["hybrid"].predict_energy(stranger)).all()


def test_model_with_more_terms_is_never_worse_in_sample(fleet, models):
    left = {name: np.sqrt(np.mean((models[name].predict_energy(fleet) - fleet["energy_kwh"]) ** 2)) for name in PAPER}
    assert left["basic_physical"] > left["extended_physical"] > left["fitted_physical"] > left["hybrid"]
    assert left["hybrid"] > left["hybrid_interactions"]
    assert left["empirical"] > left["empirical_interactions"] > left["hybrid"]


@pytest.mark.parametrize("name", PAPER)
def test_fitted_model_survives_its_file_exactly(name, fleet, models):
    read = decode_model(encode_model(models[name]))
    assert read == models[name]
    assert read.predict_energy(fleet).tobytes() == models[name].predict_energy(fleet).tobytes()


@pytest.mark.parametrize("name", FITTED)
def test_collinear_columns_keep_coefficients_bounded(name, fleet, models):
    """Check that no column moves the energy by more than three times the standard deviation of energies."""
    model = models[name]
    for key, fit in model.fits.items():
        of_model = fleet if key == ANY else fleet[fleet["vehicle_model"] == key]
        spread = of_model["energy_kwh"].std()
        columns = {name: of_model[name].to_numpy(float) for name in model.needs if name != "vehicle_model"}
        for term, coefficient in zip(model.terms, fit.coefficients, strict=True):
            if all(column in columns for column in term.columns) and term.columns:
                values = np.prod([np.nan_to_num(columns[column]) for column in term.columns], axis=0)
                assert abs(coefficient) * values.std() < 3.0 * spread, (key, term.name)
    shaken = fleet.assign(winter=1 - fleet["winter"], summer=1 - fleet["summer"])
    assert np.abs(model.predict_energy(shaken) - model.predict_energy(fleet)).max() < 2.0


def test_hybrid_without_redundant_terms_predicts_the_same(fleet, models):
    """Check that summer and one bin of the histogram add nothing to the other terms."""
    full = RECIPES["hybrid"]
    kept = tuple(term for term in full.terms if term.name not in {"summer", "speed_100_105_km", "nominal_capacity_kwh"})
    least = LinearRecipe("least", "least", kept).fit(fleet)
    fresh = rides(200, seed=99)
    for key in MODELS:
        of_model = fresh.assign(vehicle_model=key, nominal_capacity_kwh=27.0)
        np.testing.assert_allclose(models["hybrid"].predict_energy(of_model), least.predict_energy(of_model), atol=1e-6)


def test_rolling_resistance_nearly_proportional_to_distance_stays_bounded():
    """Plant rides of a car of unknown load: only the cosine of the grade distinguishes the two columns."""
    table = rides(1500, seed=5, models=MODELS[:1])
    table["effect_rolling"] = table["distance_km"] * 4.0 * (1.0 + 3e-4 * np.random.default_rng(1).standard_normal(1500))
    fit = RECIPES["hybrid"].fit(noisy(table, physical_energy(table))).fits[ANY]
    assert abs(fit.coefficients[0]) < 2.0
    assert np.sqrt(fit.covariance[0][0]) < 1.0


def test_interval_covers_planted_coefficients_at_the_nominal_level():
    planted = {"rolling": 1.4, "aero_drag_wind": 1.1, "climbing": 0.85}
    table = rides(3000, seed=21, models=MODELS[:1], cars=20)
    energy = physical_energy(table, planted)
    held = []
    for seed in range(30):
        fit = RECIPES["fitted_physical"].fit(noisy(table, energy, seed=seed, of_day=0.004)).fits[ANY]
        assert fit.clusters is not None
        for term, value, variance in zip(FITTED_TERMS, fit.coefficients, np.diag(fit.covariance), strict=True):
            if term.name in planted:
                held.append(abs(value - planted[term.name]) < 1.96 * np.sqrt(variance))
    assert 0.90 <= np.mean(held) <= 0.98


def test_inertia_is_held_near_physics_where_rides_do_not_determine_it(fleet, models):
    for key, fit in models["fitted_physical"].fits.items():
        assert fit.held == ("inertia",), key
        assert abs(fit.coefficients[2] - 1.0) < 1.0
    interactions = models["hybrid_interactions"].fits[ANY].held
    assert set(interactions) == {
        "inertia",
        *(f"{by} * inertia" for by in ("odometer_km", "lost_m", "winter", "summer")),
    }
    moving = fleet.assign(effect_inertia=np.random.default_rng(1).normal(0.0, 0.3, len(fleet)))
    measured = noisy(moving, physical_energy(moving, {"inertia": 1.3}))
    fit = RECIPES["fitted_physical"].fit(measured).fits[ANY]
    assert fit.held == ()
    assert fit.coefficients[2] == pytest.approx(1.3, abs=0.03)


def test_unknown_values_are_filled_with_the_mean_of_known_ones(fleet):
    since = fleet["time_since_charge_s"]
    full = RECIPES["hybrid_full"].fit(fleet)
    assert full.fits[ANY].fills["time_since_charge_s"] == pytest.approx(since.mean())
    assert full.training.filled["time_since_charge_s"] == since.isna().sum()
    predicted = full.predict_energy(fleet.assign(time_since_charge_s=np.nan, wind_from_deg=np.nan))
    assert np.isfinite(predicted).all()
    unknown = fleet.assign(mass_kg=np.nan, drag_area_m2=np.nan)
    assert np.isnan(full.predict_energy(unknown)).all()


def test_rides_unfit_unmeasured_or_of_unknown_cars_are_left_out_and_counted(fleet):
    odd = fleet.copy()
    odd.loc[:9, "fit_for_training"] = False
    odd.loc[:9, "unfit_reason"] = "too_long"
    odd.loc[:9, "energy_kwh"] = 1e6
    odd.loc[20:24, "energy_kwh"] = np.nan
    odd.loc[30:32, ["effect_rolling", "drag_area_m2"]] = np.nan
    fitted = RECIPES["hybrid"].fit(odd)
    clean = RECIPES["hybrid"].fit(fleet.drop(index=[*range(10), *range(20, 25), *range(30, 33)]))
    assert fitted.fits == clean.fits
    assert fitted.training.fingerprint == clean.training.fingerprint
    assert fitted.training.left_out == {"too_long": 10, "no_measured_energy": 5, "unknown_vehicle_or_effect": 3}


def test_answer_columns_do_not_influence_the_fit(fleet, models):
    other = fleet.assign(soc_end_pct=1.0, hvac_kwh=2.0, energy_vi_kwh=3.0, energy_soc_kwh=4.0)
    assert RECIPES["hybrid"].fit(other) == models["hybrid"]


def test_equal_rides_give_equal_models_and_other_rides_another_version(fleet, models):
    assert RECIPES["hybrid_interactions"].fit(fleet) == models["hybrid_interactions"]
    assert RECIPES["hybrid"].fit(fleet.iloc[:-1]).version != models["hybrid"].version


def test_fit_does_not_depend_on_the_order_of_rides(fleet, models):
    shuffled = RECIPES["hybrid_interactions"].fit(fleet.sample(frac=1.0, random_state=3))
    np.testing.assert_allclose(
        shuffled.predict_energy(fleet), models["hybrid_interactions"].predict_energy(fleet), atol=1e-6
    )


def test_fit_without_covariance_has_the_same_coefficients(fleet, models):
    for name in ("extended_physical", "hybrid"):
        quick = RECIPES[name].fit(fleet, covariance=False)
        for key, fit in quick.fits.items():
            np.testing.assert_allclose(fit.coefficients, models[name].fits[key].coefficients, rtol=1e-6, atol=1e-12)
            assert fit.covariance is None


@pytest.mark.parametrize("name", ["fitted_physical", "hybrid_interactions"])
@pytest.mark.parametrize("groups", [37, 700])
def test_fit_to_parquet_files_equals_fit_to_the_table(name, groups, fleet, models, tmp_path):
    half = len(fleet) // 2
    fleet.iloc[:half].to_parquet(tmp_path / "a.parquet", row_group_size=groups)
    fleet.iloc[half:].to_parquet(tmp_path / "b.parquet", row_group_size=groups)
    fitted = RECIPES[name].fit_parquet(tmp_path / "a.parquet", tmp_path / "b.parquet")
    assert fitted.training == models[name].training
    for key, fit in fitted.fits.items():
        expected = models[name].fits[key]
        np.testing.assert_allclose(fitted.predict_energy(fleet), models[name].predict_energy(fleet), atol=1e-7)
        np.testing.assert_allclose(np.diag(fit.covariance), np.diag(expected.covariance), rtol=1e-3)


def test_vehicle_model_with_too_few_rides_uses_the_fit_over_all(fleet):
    rare = fleet["vehicle_model"] == MODELS[0]
    few = pd.concat([fleet[~rare], fleet[rare].iloc[:40]])
    fitted = RECIPES["hybrid"].fit(few)
    assert set(fitted.fits) == {*MODELS[1:], ANY}
    assert fitted.training.vehicle_models[MODELS[0]] == 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="lost_m"), "column 'lost_m' is missing: make the tables again"),
        (lambda t: t.drop(columns="energy_kwh"), "column 'energy_kwh' is missing"),
        (lambda t: t.iloc[:0], "0 rides to fit to, and it needs 80"),
        (lambda t: t.iloc[:1], "1 ride to fit to, and it needs 80"),
        (lambda t: t.assign(energy_kwh=np.nan), "2,000 rides, all unfit (2,000 no measured energy)"),
        (lambda t: t.assign(fit_for_training=False), "2,000 rides, all unfit (2,000 unfit)"),
        (lambda t: pd.concat([t.iloc[5:6]] * 200), "all 200 rides are alike: nothing can be learned"),
        (lambda t: t.assign(energy_kwh=1.5), "energy_kwh is 1.5 in all 2,000 rides: nothing can be learned"),
        (lambda t: t.assign(lost_m="steep"), "column 'lost_m' of the ride table is no number"),
    ],
)
def test_rides_that_cannot_be_fitted_are_refused_in_one_line(change, message, fleet):
    with pytest.raises(ModelError) as caught:
        RECIPES["hybrid"].fit(change(fleet))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_recipe_is_refused_with_the_known_names():
    with pytest.raises(ModelError, match="recipe 'hybird' is unknown: known are basic_physical, extended_physical"):
        get_recipe("hybird")
