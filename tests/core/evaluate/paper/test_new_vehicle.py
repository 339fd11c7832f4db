"""Test errors on vehicle models left out of training, and learning curves over a few of their rides."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.paper import new_vehicle
from socast.core.evaluate.paper.new_vehicle import (
    Learner,
    compute_learning_curve,
    compute_tables_12_and_13,
    draw_rides,
    list_learners,
    select_ride_counts,
    select_untrained,
    split_by_vehicle_model,
    tabulate_learning_curves,
)
from socast.core.evaluate.paper.results import select_comparable
from socast.core.evaluate.paper.runs import fit_and_predict
from socast.core.evaluate.ride_filter import CLUSTERS, LEAST_RIDES, filter_rides
from tests.support import planted_rides

MODELS = ("kia-soul-ev-2015", "nissan-leaf-2013", "tesla-model-s")
PER_KM = dict(zip(MODELS, (0.15, 0.18, 0.25), strict=True))


@dataclass
class PerKm:
    """Fit the consumption per kilometre; adapt it to a new car by a weighted mean with the previous value."""

    name: str = "per_km"
    title: str = "Per Kilometre"
    fitted: list = field(default_factory=list)

    def fit(self, rides):
        self.fitted.append(rides)
        return Rate(float(rides["energy_kwh"].sum() / rides["distance_km"].sum()))

    def adapt(self, model, rides):
        new_rate, weight = PerKm().fit(rides).rate, len(rides) / (len(rides) + 2.0)
        return Rate(weight * new_rate + (1.0 - weight) * model.rate)


@dataclass
class Rate:
    rate: float

    def predict_energy(self, rides):
        return self.rate * rides["distance_km"].to_numpy()


@dataclass
class Fixed:
    name: str
    rate: float
    title: str = "fixed"

    def fit(self, _rides):
        return Rate(self.rate)


@pytest.fixture(scope="module")
def table():
    rides = planted_rides.rides(1500, 4, MODELS)
    rng = np.random.default_rng(4)
    energy = rides["vehicle_model"].map(PER_KM) * rides["distance_km"] + rng.normal(0.0, 0.01, len(rides))
    return filter_rides(rides.assign(energy_kwh=energy, start_s=rides["start_s"] + np.arange(1500)))


def test_new_vehicle_model_is_tested_on_all_its_rides_and_never_trained_on(table):
    splits = split_by_vehicle_model(table)
    assert set(splits) == set(MODELS)
    for name, split in splits.items():
        models = table.rides["vehicle_model"].to_numpy()
        assert set(models[split.test]) == {name}
        assert name not in set(models[split.train])
        assert len(split.train) + len(split.test) == len(models)


def test_untrained_vehicle_model_is_tested_and_never_trained_on(table):
    leaf = select_untrained(["nissan-leaf"], table)
    assert leaf == ("nissan-leaf-2013",)
    assert select_untrained(["tesla-model-s", "nissan-leaf-2013"], table) == ("nissan-leaf-2013", "tesla-model-s")
    assert select_untrained([], table) == ()
    splits, plain = split_by_vehicle_model(table, leaf), split_by_vehicle_model(table)
    models = table.rides["vehicle_model"].to_numpy()
    assert set(splits) == set(MODELS)
    for name, split in splits.items():
        assert set(models[split.train]) == set(MODELS) - {name, *leaf}
        assert np.array_equal(split.test, plain[name].test)


def test_vehicle_model_without_others_to_train_on_is_not_tested(table):
    assert set(split_by_vehicle_model(table, MODELS[:2])) == set(MODELS[:2])
    assert split_by_vehicle_model(table, MODELS) == {}


def test_untrained_vehicle_model_without_rides_is_refused(table):
    with pytest.raises(SettingsError, match="'tesla-model-x', which is to be left out of training; name some of kia"):
        select_untrained(["tesla-model-x"], table)


def test_tables_12_and_13_average_over_clusters_relative_to_basic_model(table):
    recipes = {"basic_physical": Fixed("basic_physical", 0.1), "per_km": PerKm()}
    held = {
        name: select_comparable(
            {r: [fit_and_predict(recipe, table, split)] for r, recipe in recipes.items()}, len(table.rides)
        )
        for name, split in split_by_vehicle_model(table).items()
    }
    result = compute_tables_12_and_13(held, table)
    for name in MODELS:
        of_model = table.rides[table.rides["vehicle_model"] == name]
        cluster = pd.cut(of_model["distance_km"], [0, 5, 10, 15, 20, 25], right=False, labels=CLUSTERS[:5])
        means = (
            of_model["distance_km"]
            .groupby(cluster, observed=True)
            .mean()[of_model.groupby(cluster, observed=True).size() >= LEAST_RIDES]
        )
        basic, row = (PER_KM[name] - 0.1) * means.mean(), result["per_km"][name]
        others = table.rides[table.rides["vehicle_model"] != name]
        rate = others["energy_kwh"].sum() / others["distance_km"].sum()
        assert row.basic == pytest.approx(basic, rel=0.02)
        assert row.mae == pytest.approx(abs(rate - PER_KM[name]) * means.mean(), rel=0.05)
        assert row.relative == pytest.approx(abs(rate - PER_KM[name]) / PER_KM[name], rel=0.05)
        assert row.reduction == pytest.approx(1.0 - row.mae / row.basic)
    reductions = [result["per_km"][name].reduction for name in MODELS]
    assert result["per_km"]["average"].reduction == pytest.approx(np.mean(reductions))
    assert result["basic_physical"]["average"].reduction == 0.0


def test_learners_are_both_variants_of_fitted_physical_and_adaptable_recipes():
    recipes = {"fitted_physical": Fixed("fitted_physical", 0.2), "per_km": PerKm(), "other": Fixed("other", 0.1)}
    assert [(learner.name, learner.way) for learner in list_learners(recipes)] == [
        ("fitted_physical_others", "unchanged"),
        ("fitted_physical_refitted", "refitted"),
        ("per_km", "adapted"),
    ]


def test_drawn_orders_are_reproducible_permutations_and_ride_counts_fit_table():
    rides = np.arange(100, 700)
    for order in draw_rides(rides, "leaf", 3, number=4):
        assert np.array_equal(np.sort(order), rides)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(draw_rides(rides, "leaf", 3, 4), draw_rides(rides, "leaf", 3, 4), strict=True)
    )
    assert not np.array_equal(*draw_rides(rides, "leaf", 3, 2))
    assert select_ride_counts(300) == (0, 1, 3, 10, 30, 100)
    assert select_ride_counts(60) == (0, 1, 3, 10, 30)
    assert select_ride_counts(1) == (0,)


def test_learning_curve_tests_same_unseen_rides_at_every_point(table, monkeypatch):
    split = split_by_vehicle_model(table)[MODELS[0]]
    tested, shown = [], []
    monkeypatch.setattr(Rate, "predict_energy", lambda _, rides: tested.append(rides.index) or np.zeros(len(rides)))
    monkeypatch.setattr(PerKm, "adapt", lambda _, model, rides: shown.append(set(rides.index)) or model)
    compute_learning_curve(Learner("per_km", PerKm(), "adapted"), table, split, draw_rides(split.test, MODELS[0], 1, 2))
    for i in range(2):
        points, learned = tested[6 * i : 6 * i + 6], shown[5 * i : 5 * i + 5]
        assert all(points[0].equals(point) for point in points)
        assert [len(rides) for rides in learned] == [1, 3, 10, 30, 100]
        assert all(a < b for a, b in pairwise(learned))
        assert not learned[-1] & set(points[0])


def test_learning_curve_falls_towards_planted_consumption(table):
    split = split_by_vehicle_model(table)[MODELS[2]]
    orders = draw_rides(split.test, MODELS[2], 1, 5)
    recipe = PerKm()
    adapted = compute_learning_curve(Learner("adapted", recipe, "adapted"), table, split, orders)
    unchanged = compute_learning_curve(Learner("unchanged", PerKm(), "unchanged"), table, split, orders)
    refitted = compute_learning_curve(Learner("refitted", PerKm(), "refitted"), table, split, orders)
    assert adapted.shape == (5, 6)
    np.testing.assert_allclose(adapted[:, 0], unchanged[:, 0])
    np.testing.assert_allclose(unchanged, unchanged[:, :1] * np.ones(6))
    assert np.all(np.diff(adapted.mean(axis=0)) < 0)
    assert adapted[:, -1].mean() < 0.1 * unchanged.mean()
    assert unchanged.mean() > refitted[:, -1].mean() > adapted[:, -1].mean()
    assert len(recipe.fitted) == 1, "the others are learnt once, not at every point"


def test_learning_curves_have_intervals_over_draws_and_notes_on_failures(table):
    class Broken(PerKm):
        def adapt(self, _model, _rides):
            raise ModelError("too few rides: give more")

    split = split_by_vehicle_model(table)[MODELS[0]]
    orders = draw_rides(split.test, MODELS[0], 1, 4)
    result = {
        (MODELS[0], name): compute_learning_curve(Learner(name, recipe, "adapted"), table, split, orders)
        for name, recipe in (("good", PerKm()), ("broken", Broken()))
    }
    curves, notes = tabulate_learning_curves(result)
    assert list(curves[MODELS[0]]) == ["good"]
    points = curves[MODELS[0]]["good"]
    assert [point.rides for point in points] == list(new_vehicle.RIDE_COUNTS)
    assert points[0].ci95 < points[1].ci95, "without rides of its own only the test differs between draws"
    assert notes == ["broken on a few rides of kia-soul-ev-2015: too few rides: give more"]


def test_reference_curve_is_better_variant_at_each_point():
    others, refitted = np.full((3, 6), 0.2), np.tile([0.2, 0.3, 0.4, 0.3, 0.1, 0.05], (3, 1))
    curves, _ = tabulate_learning_curves(
        {("leaf", new_vehicle.BENCHMARK_UNCHANGED): others, ("leaf", new_vehicle.BENCHMARK_REFITTED): refitted}
    )
    assert [p.mae for p in curves["leaf"]["fitted_physical"]] == pytest.approx([0.2, 0.2, 0.2, 0.2, 0.1, 0.05])
    assert list(curves["leaf"]) == ["fitted_physical", "fitted_physical_others", "fitted_physical_refitted"]


def test_single_vehicle_model_has_no_new_vehicle_results():
    rides = planted_rides.rides(200, 4, MODELS[:1]).assign(energy_kwh=1.0)
    alone = filter_rides(rides.assign(start_s=np.arange(200.0)))
    assert split_by_vehicle_model(alone) == {}
    assert new_vehicle.plan_learning_curves(list_learners({"per_km": PerKm()}), alone, {}, seed=1) == {}
    assert compute_tables_12_and_13({}, alone) == {}
