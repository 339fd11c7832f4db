"""Test that pooled recipes recover planted values, learn new vehicle models from few rides, and read no answer."""

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ModelError
from socast.core.fit.pooled import EFFICIENCY, LEAST_POOLED_RIDES, POOLED_RECIPES, SHARED_TERMS, TREE_FEATURES, adapt
from socast.core.fit.recipes import RECIPES
from socast.core.models import ANY, BASIC_PHYSICAL, decode_model, encode_model
from socast.core.models.features import ANSWERS, Columns, list_raw_columns
from tests.support.planted_rides import MODELS
from tests.support.pooled_rides import PHYSICS, differing, fleet, measured, planted

pytestmark = pytest.mark.long
POOLED, BOOSTED = POOLED_RECIPES
FEW = 600
"""Number of rides of a fit whose accuracy does not matter."""


def mae(model, table: pd.DataFrame) -> float:
    return float(np.abs(model.predict_energy(table) - table["energy_kwh"]).mean())


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """Return rides with differing vehicle models and cars, and with a residual that no term explains."""
    rides = fleet(6000, 1, cars=6)
    energy = planted(rides, differing(MODELS))
    car = pd.factorize(rides["vehicle_id"])[0]
    factor = np.random.default_rng(4).normal(1.0, 0.06, car.max() + 1)[car]
    odd = 0.15 * (rides["average_speed_kmh"] < 22.0) * (rides["soc_start_pct"] < 60.0)
    return measured(rides, energy * factor + odd * Columns(rides)["size_kwh"], noise=0.004)


@pytest.fixture(scope="module")
def halves(table) -> tuple[pd.DataFrame, pd.DataFrame]:
    random = np.random.default_rng(0).random(len(table)) < 0.5
    return table[random], table[~random]


@pytest.fixture(scope="module")
def models(halves) -> dict:
    names = ("fitted_physical", "hybrid_interactions", "pooled_hybrid", "boosted_hybrid")
    return {name: RECIPES[name].fit(halves[0]) for name in names}


@pytest.fixture(scope="module")
def boosted(table):
    """Return the boosted model of few rides."""
    return BOOSTED.fit(table.iloc[:FEW])


def test_each_recipe_beyond_the_paper_is_better_than_the_one_before(models, halves):
    errors = [mae(models[name], halves[1]) for name in ("hybrid_interactions", "pooled_hybrid", "boosted_hybrid")]
    assert errors[1] < errors[0]
    assert errors[2] < 0.9 * errors[1]


def test_planted_factors_of_cars_are_recovered(models, table):
    truth = np.random.default_rng(4).normal(1.0, 0.06, table["vehicle_id"].nunique())
    factors = [models["boosted_hybrid"].cars[name] for name in pd.factorize(table["vehicle_id"])[1]]
    assert np.corrcoef(truth, factors)[0, 1] > 0.8
    assert not models["pooled_hybrid"].cars


def test_intervals_cover_new_rides(models, halves):
    energy = halves[1]["energy_kwh"].to_numpy()
    for name, model in models.items():
        lower, upper = model.predict_interval(halves[1], 0.9)
        covered = (lower <= energy) & (energy <= upper)
        assert covered.mean() == pytest.approx(0.9, abs=0.025), name
        assert covered[halves[1]["winter"] == 1].mean() > 0.85
        assert covered[halves[1]["distance_km"] > 10.0].mean() > 0.85


def test_model_file_is_an_exact_round_trip(models, halves):
    for model in models.values():
        again = decode_model(encode_model(model))
        assert again == model
        assert again.predict_energy(halves[1]).tobytes() == model.predict_energy(halves[1]).tobytes()
    assert len(encode_model(models["boosted_hybrid"])) < 400_000


def test_fitting_again_gives_the_same_model(table, boosted):
    assert BOOSTED.fit(table.iloc[:FEW]) == boosted


def test_prediction_of_a_row_does_not_depend_on_other_rows(models, halves):
    some = halves[1].iloc[:40]
    model = models["boosted_hybrid"]
    alone = np.concatenate([model.predict_energy(some.iloc[i : i + 1]) for i in range(40)])
    assert alone.tobytes() == model.predict_energy(some).tobytes()


def test_no_feature_holds_the_answer():
    read = {
        raw
        for column in (*TREE_FEATURES, *(c for term in SHARED_TERMS for c in term.columns))
        for raw in list_raw_columns(column)
    }
    assert not [column for column in read if column.startswith(ANSWERS)]


def test_physical_coefficients_equal_the_extended_physical_model_with_losses():
    rides = fleet(50, 3)
    level = dict.fromkeys([name for name in rides if name.startswith(("effect_climbing", "effect_inertia"))], 0.0)
    rides = rides.assign(**level, effect_aero_drag_wind=rides["effect_aero_drag"])
    expected = EFFICIENCY * BASIC_PHYSICAL.predict_energy(rides) + rides["effect_accessories"]
    np.testing.assert_allclose(planted(rides, dict.fromkeys(MODELS, PHYSICS)), expected)


@pytest.mark.parametrize("left_out", MODELS)
def test_unseen_vehicle_models_are_predicted_better_than_by_fitted_physics(table, left_out):
    new = table["vehicle_model"] == left_out
    pooled = POOLED.fit(table[~new], covariance=False)
    fitted = RECIPES["fitted_physical"].fit(table[~new], covariance=False)
    assert left_out not in pooled.fits
    assert mae(pooled, table[new]) < mae(fitted, table[new])
    assert mae(pooled, table[new]) < 0.6 * mae(BASIC_PHYSICAL, table[new])


def test_adapting_to_rides_of_a_new_vehicle_model_improves_its_prediction(table):
    new = table["vehicle_model"] == MODELS[0]
    start = POOLED.fit(table[~new])
    others = table[~new].iloc[:300]
    draws = [table[new].sample(frac=1.0, random_state=seed) for seed in range(5)]
    errors = np.array(
        [[mae(adapt(start, shuffled[:n]), shuffled[300:]) for n in (0, 3, 30, 300)] for shuffled in draws]
    )
    assert errors[0, 0] == mae(start, draws[0][300:])
    mean = errors.mean(axis=0)
    assert mean[1] < 1.1 * mean[0]
    assert mean[2] < mean[0]
    assert mean[3] < 1.25 * mae(POOLED.fit(table), table[new])
    rides = draws[0]
    adapted = adapt(start, rides.iloc[:30])
    assert adapted.predict_energy(others).tobytes() == start.predict_energy(others).tobytes()
    assert (adapted.fits[MODELS[0]].rides, adapted.version != start.version) == (30, True)
    assert adapted.history[-1] == {"action": "adapt", "rides": {MODELS[0]: 30}}
    assert decode_model(encode_model(adapted)) == adapted


def test_variance_of_a_new_vehicle_model_shrinks_with_each_ride(table):
    new = table["vehicle_model"] == MODELS[1]
    start = POOLED.fit(table[~new])
    covariances = [adapt(start, table[new].iloc[:count]).fits[MODELS[1]].covariance for count in (1, 10, 100)]
    variances = [np.array(start.fits[ANY].covariance).diagonal(), *(np.array(c).diagonal() for c in covariances)]
    for more, fewer in zip(variances[1:], variances, strict=False):
        assert (more <= fewer * (1.0 + 1e-9)).all()


def test_adapting_to_a_known_vehicle_model_changes_only_its_fit(models, halves):
    model = models["boosted_hybrid"]
    adapted = adapt(model, halves[1][halves[1]["vehicle_model"] == MODELS[0]])
    assert [key for key in model.fits if adapted.fits[key] != model.fits[key]] == [MODELS[0]]
    assert (adapted.cars, adapted.correction) == (model.cars, model.correction)


def test_unfit_rides_do_not_influence_the_fit(table):
    some = table.iloc[:600]
    odd = some.copy()
    odd.loc[odd.index[:50], "energy_kwh"] = 1e3
    odd.loc[odd.index[:50], "fit_for_training"] = False
    odd.loc[odd.index[50:60], "energy_kwh"] = np.nan
    fitted, clean = POOLED.fit(odd), POOLED.fit(some.iloc[60:])
    assert fitted.fits == clean.fits
    assert fitted.training.left_out == {"unfit": 50, "no_measured_energy": 10}
    assert adapt(clean, odd.iloc[:60]) is clean


def test_columns_without_measurements_do_not_prevent_a_fit(table):
    unknown = ("parked_s", "battery_temperature_c", "occupants", "time_since_charge_s", "precipitation_mm_h")
    blind = table.assign(**dict.fromkeys(unknown, np.nan))
    model = BOOSTED.fit(blind.iloc[:1000])
    assert np.isfinite(model.predict_energy(blind)).all()
    assert np.isfinite(model.predict_energy(table)).all()


def test_unseen_vehicles_and_vehicle_models_are_predicted(models, halves):
    strange = halves[1].iloc[:20].assign(vehicle_id="taxi-new", vehicle_model="horse")
    for model in models.values():
        assert np.isfinite(model.predict_energy(strange)).all()


def test_single_vehicle_model_can_be_fitted(table):
    alone = table[table["vehicle_model"] == MODELS[0]]
    model = BOOSTED.fit(alone)
    assert set(model.fits) == {MODELS[0], ANY}
    assert mae(model, alone) < mae(RECIPES["fitted_physical"].fit(alone), alone)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="parked_s"), "column 'parked_s' is missing in the rides: make the tables again"),
        (lambda t: t.drop(columns="energy_kwh"), "column 'energy_kwh' is missing"),
        (lambda t: t.iloc[:0], "0 rides to fit to"),
        (
            lambda t: t.iloc[: LEAST_POOLED_RIDES - 1],
            f"{LEAST_POOLED_RIDES - 1} rides to fit to, and it needs {LEAST_POOLED_RIDES}",
        ),
        (lambda t: t.assign(energy_kwh=np.nan), "200 rides, all unfit .200 no measured energy"),
        (lambda t: t.assign(energy_kwh=1.5), "energy_kwh is 1.5 in all 200 rides: nothing can be learned"),
    ],
)
def test_rides_that_cannot_be_fitted_are_refused(table, change, message):
    for recipe in POOLED_RECIPES:
        with pytest.raises(ModelError, match=message):
            recipe.fit(change(table.iloc[:200]))


def test_model_that_does_not_pool_cannot_be_adapted(models, table):
    with pytest.raises(ModelError, match="does not tell how vehicle models differ: fit one of a recipe that pools"):
        adapt(models["fitted_physical"], table.iloc[:10])
    with pytest.raises(ModelError, match="column 'stops' is missing"):
        adapt(models["pooled_hybrid"], table.iloc[:10].drop(columns="stops"))


def test_boosted_model_without_trees_and_cars_equals_the_pooled_model(models, halves):
    whole = models["boosted_hybrid"]
    bare = msgspec.structs.replace(whole, cars={}, correction=None)
    np.testing.assert_allclose(
        bare.predict_energy(halves[1]), models["pooled_hybrid"].predict_energy(halves[1]), rtol=1e-12
    )


def test_vehicle_model_with_one_ride_is_pooled(table):
    rare = table.iloc[:400].assign(vehicle_model=MODELS[0])
    rare.loc[rare.index[0], "vehicle_model"] = MODELS[1]
    model = BOOSTED.fit(rare)
    assert model.fits[MODELS[1]].rides == 1
    assert np.isfinite(model.predict_energy(rare)).all()


def test_adapting_to_predicted_energies_changes_no_prediction(models, halves):
    model = models["boosted_hybrid"]
    one = halves[0][halves[0]["vehicle_model"] == MODELS[0]]
    predicted = one.assign(energy_kwh=model.predict_energy(one))
    again = adapt(model, predicted)
    rest = halves[1][halves[1]["vehicle_model"] == MODELS[0]]
    assert again.predict_energy(rest) == pytest.approx(model.predict_energy(rest), rel=1e-6, abs=1e-6)
    assert again.version != model.version


def test_term_that_is_zero_in_all_rides_is_held_at_physics(table):
    mild = table.assign(ambient_c=table["ambient_c"].clip(lower=8.0))
    model = POOLED.fit(mild[mild["vehicle_model"] != MODELS[0]])
    new = table[table["vehicle_model"] == MODELS[0]].iloc[:30].copy()
    new["ambient_c"] = np.where(np.arange(30) == 0, -15.0, 15.0)
    adapted = adapt(model, new)
    place = [term.name for term in model.terms].index("heating in deep cold")
    assert adapted.fits[MODELS[0]].coefficients[place] == pytest.approx(SHARED_TERMS[place].physics, abs=1e-6)


def test_version_depends_on_the_cars_of_the_rides(table, boosted):
    some = table.iloc[:FEW]
    swapped = some.assign(vehicle_id=some["vehicle_id"].iloc[::-1].to_numpy())
    assert BOOSTED.fit(swapped).version != boosted.version
