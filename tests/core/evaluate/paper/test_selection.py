"""Test which terms elimination removes: decoys are removed, planted terms stay, and other rides measure the loss."""

import numpy as np
import pytest

from socast.core.evaluate.paper.selection import VehicleModelRegression, find_removable_terms, plan_selection
from socast.core.evaluate.ride_filter import filter_rides
from socast.core.fit.recipes import FITTED_TERMS, LinearRecipe, make_term
from socast.core.models import make_physical_term
from tests.support import planted_rides

MODELS = ("kia-soul-ev-2015", "tesla-model-s")
PLANTED = ("distance_km", "gained_m", "duration_s")
DECOYS = ("odometer_km", "soc_start_pct", "wind_speed_kmh", "precipitation_mm_h")
RECIPE = LinearRecipe(
    "hybrid_full", "Hybrid", (*(make_term(c) for c in (*PLANTED, *DECOYS, "nominal_capacity_kwh")), make_term())
)


def fleet(n=2400, seed=1):
    table = planted_rides.rides(n, seed, MODELS)
    rng = np.random.default_rng(seed)
    scale = np.where(table["vehicle_model"] == MODELS[0], 1.0, 1.4)
    physical = 0.15 * table["distance_km"] + 0.002 * table["gained_m"] + 0.0002 * table["duration_s"]
    return table.assign(energy_kwh=scale * physical + rng.normal(0.0, 0.05, n), start_s=table["start_s"] + np.arange(n))


@pytest.fixture(scope="module")
def selection():
    return find_removable_terms(RECIPE, filter_rides(fleet()), seed=2)


def test_decoy_terms_are_removed_and_planted_terms_stay(selection):
    assert selection.constant == ["nominal_capacity_kwh"]
    assert set(selection.rfe.removed) == set(DECOYS)
    assert not set(selection.rfecv.removed) & set(PLANTED)
    assert len(selection.rfecv.removed) >= 2


def test_loss_of_removal_is_reported_for_each_step(selection):
    steps = selection.rfe.steps
    assert {step.term for step in steps[: len(DECOYS)]} == set(DECOYS)
    assert len(steps) == len(PLANTED) + len(DECOYS) - 1
    assert steps[len(DECOYS)].loss.value > 0.005
    assert steps[len(DECOYS)].loss.p < 1e-3
    assert selection.rfecv.loss.value < 0.001
    scores = {score.terms: score.mae for score in selection.rfecv.scores}
    assert min(scores) == 1
    assert scores[3] < scores[2] < scores[1]
    assert scores[3] == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.1)


def test_total_loss_equals_loss_of_last_removal(selection):
    assert selection.rfe.loss == selection.rfe.steps[len(DECOYS) - 1].loss
    assert set(selection.rfe.loss.to_json()) == {"value", "ci95", "p", "upper95"}


def test_elimination_with_a_margin_removes_decoys_and_states_what_it_allows(selection):
    margin = selection.margin
    assert set(margin.removed) == set(DECOYS)
    assert margin.largest == pytest.approx(0.01 * margin.error)
    assert margin.loss.upper95 <= margin.largest
    assert margin.steps[len(DECOYS)].loss.upper95 > margin.largest


def test_a_wider_margin_removes_more():
    removed = [
        len(find_removable_terms(RECIPE, filter_rides(fleet()), 2, share).margin.removed) for share in (0.0, 10.0)
    ]
    assert removed[0] <= len(DECOYS) < removed[1]


def test_on_few_rides_elimination_with_a_margin_removes_only_what_it_shows_to_cost_little():
    table = fleet(700)
    table["energy_kwh"] += np.random.default_rng(9).normal(0.0, 0.3, len(table))
    found = find_removable_terms(RECIPE, filter_rides(table), 2)
    assert set(found.rfe.removed) & set(PLANTED)
    assert len(found.margin.removed) < len(found.rfe.removed)
    shown = [step.loss.upper95 for step in found.margin.steps[: len(found.margin.removed)]]
    assert all(loss <= found.margin.largest for loss in shown)


def test_terms_of_physics_are_the_last_that_elimination_with_a_margin_takes():
    terms = (*FITTED_TERMS, *(make_term(c) for c in (*PLANTED, *DECOYS)), make_term())
    recipe = LinearRecipe("hybrid_full", "Hybrid", terms)
    found = find_removable_terms(recipe, filter_rides(fleet()), 2)
    names, physics = [step.term for step in found.margin.steps], {term.name for term in FITTED_TERMS}
    first = min(names.index(name) for name in physics & set(names))
    assert set(names[first:]) <= physics
    assert len(names) == len(found.rfe.steps)


def test_a_column_of_rounding_is_constant_for_elimination():
    terms = (make_physical_term("inertia", ("effect_inertia",)), *(make_term(c) for c in PLANTED), make_term())
    table = fleet()
    table["effect_inertia"] = np.random.default_rng(4).normal(0.0, 1e-17, len(table))
    table.loc[table.index[::400], "effect_inertia"] = 0.02
    of_rounding = table.assign(effect_inertia=np.where(table["effect_inertia"] < 0.01, table["effect_inertia"], 0.0))
    constant = [
        find_removable_terms(LinearRecipe("hybrid_full", "Hybrid", terms), filter_rides(rides), 2).constant
        for rides in (table, of_rounding)
    ]
    assert constant == [[], ["inertia"]]


def test_no_loss_where_no_term_is_removable():
    recipe = LinearRecipe("hybrid_full", "Hybrid", (*(make_term(c) for c in PLANTED), make_term()))
    rfe = find_removable_terms(recipe, filter_rides(fleet()), seed=2).rfe
    assert rfe.removed == []
    assert rfe.loss is None


def test_one_of_two_collinear_terms_is_removed_without_loss():
    recipe = LinearRecipe(
        "hybrid_full", "Hybrid", (*(make_term(c) for c in (*PLANTED, "winter", "summer")), make_term())
    )
    table = fleet()
    table["energy_kwh"] += 0.5 * table["winter"]
    steps = {step.term: step.loss for step in find_removable_terms(recipe, filter_rides(table), seed=2).rfe.steps}
    first, second = (name for name in steps if name in {"winter", "summer"})
    before = list(steps)[list(steps).index(first) - 1]
    assert steps[first].value == pytest.approx(steps[before].value, abs=1e-9)
    assert steps[second].value > steps[first].value + 0.1


def test_each_vehicle_model_has_separate_coefficients():
    rng = np.random.default_rng(3)
    model, x = rng.integers(0, 2, 200).astype(float), rng.normal(size=(200, 2))
    y = np.where(model == 0, 1.0 + 2.0 * x[:, 0], -1.0 + 5.0 * x[:, 0])
    fitted = VehicleModelRegression().fit(np.column_stack([model, x]), y)
    np.testing.assert_allclose(fitted.predict(np.column_stack([model, x])), y, atol=1e-9)
    assert np.isnan(fitted.predict(np.array([[7.0, 0.0, 0.0]])))
    first, one, other = fitted.importance_
    assert first > one > 2.0
    assert other < 1e-9


def test_selection_is_empty_with_few_rides_or_without_full_hybrid_recipe():
    assert find_removable_terms(RECIPE, filter_rides(fleet(200)), seed=2).to_json() == {}
    assert plan_selection(filter_rides(fleet(200)), {"basic_physical": RECIPE}, seed=2) == {}
    assert plan_selection(filter_rides(fleet(200)), {"hybrid": RECIPE}, seed=2) == {}
    assert list(plan_selection(filter_rides(fleet(200)), {"hybrid_full": RECIPE}, seed=2)) == ["hybrid_full"]


def test_selection_is_reproducible(selection):
    assert find_removable_terms(RECIPE, filter_rides(fleet()), seed=2) == selection
