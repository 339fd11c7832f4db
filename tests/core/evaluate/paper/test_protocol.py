"""Test the whole evaluation: predictions are blind, planted errors are recovered, and results are reproducible."""

import json
from dataclasses import dataclass, field
from math import pi, sqrt

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.binning import SEASONS
from socast.core.evaluate.paper.breakdown import compute_figure_1
from socast.core.evaluate.paper.protocol import evaluate, select_recipes
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.evaluate.paper.results import select_comparable, word_limited
from socast.core.evaluate.paper.runs import Prediction
from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.ride_filter import CLUSTERS, LEAST_RIDES, filter_rides
from socast.core.models import HILLS_OF_BUILT_IN
from socast.core.stats.splits import Split
from socast.core.vehicles import AccessoryCurve
from tests.support import planted_rides

pytestmark = pytest.mark.long

SD = 0.1
MODELS = ("kia-soul-ev-2015", "tesla-model-s")


@dataclass
class Model:
    """Predict with any function of the rides, and with an interval where a half width is given."""

    of: object
    interval: float | None = None

    def predict_energy(self, rides):
        return np.asarray(self.of(rides), dtype=float)

    def predict_interval(self, rides, level):
        assert level == 0.9
        return self.predict_energy(rides) - self.interval, self.predict_energy(rides) + self.interval


@dataclass
class Toy:
    """A recipe that fits nothing."""

    name: str
    of: object
    interval: float | None = None
    title: str = "toy"
    seen: list = field(default_factory=list)

    def fit(self, rides):
        self.seen.append(rides)
        return Model(self.of, self.interval)


def per_km(factor=1.0, off=0.0):
    return lambda rides: 0.2 * factor * rides["distance_km"].to_numpy() + off


def fleet(n=1600, seed=3, models=MODELS):
    """Return rides with 0.2 kWh/km and normal noise, and with names of drivers."""
    table = planted_rides.rides(n, seed, models)
    rng = np.random.default_rng(seed)
    table["start_s"] += rng.permutation(n) * 10.0
    table["driver_id"] = rng.choice(["ana", "bo"], n)
    return table.assign(energy_kwh=0.2 * table["distance_km"] + rng.normal(0.0, SD, n))


def recipes(*toys):
    return {toy.name: toy for toy in toys}


TRUE = Toy("true", per_km(), interval=1.6449 * SD)
HIGH = Toy("basic_physical", per_km(1.0, 0.3))
CLOSE = Toy("close", per_km(1.02))


@pytest.fixture(scope="module")
def rides():
    return fleet()


@pytest.fixture(scope="module")
def result(rides):
    reported = []
    evaluation = evaluate(
        rides, recipes(HIGH, CLOSE, TRUE), seed=5, progress=lambda done, of: reported.append((done, of))
    )
    assert reported[0][0] == 0
    assert reported[-1][0] == reported[-1][1] == len(reported) - 1
    return evaluation


def test_result_becomes_json_with_every_part_and_back(result):
    values = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert msgspec.convert(values, RecipeEvaluation) == result
    assert set(values) == set(RecipeEvaluation.__struct_fields__)
    assert result.recipes == dict.fromkeys(("basic_physical", "close", "true"), "toy")
    assert result.about.vehicle_models == sorted(MODELS)
    assert result.about.clusters == list(CLUSTERS[:5])


def test_ride_counts_and_consumption_match_ride_table(result, rides):
    for model in MODELS:
        of_model = rides[rides["vehicle_model"] == model]
        assert result.rides[model]["total"] == len(of_model)
        assert result.rides[model]["5-10"] == of_model["distance_km"].between(5, 10, inclusive="left").sum()
        for cluster in ("0-5", "10-15"):
            low, high = (float(end) for end in cluster.split("-"))
            at = of_model["distance_km"].between(low, high, inclusive="left")
            assert result.consumption[model][cluster] == pytest.approx(of_model["energy_kwh"][at].mean())


def test_planted_error_lies_within_its_interval(result):
    truth = SD * sqrt(2 / pi)
    for model in MODELS:
        error = result.mae["true"][model]["average"]
        assert abs(error.value - truth) < 1.5 * error.ci95
        assert error.ci95 < 0.3 * truth
        assert result.rmse["true"][model] == pytest.approx(SD, rel=0.1)
        assert result.bias["basic_physical"][model] == pytest.approx(0.3, abs=0.01)


def test_averages_are_plain_means_and_bottom_row_is_weighted_by_all_rides(result):
    mae, count = result.mae["close"], result.rides
    for model in MODELS:
        known = [mae[model][c].value for c in CLUSTERS[:5] if mae[model][c].value is not None]
        assert mae[model]["average"].value == pytest.approx(np.mean(known))
    for cluster in ("0-5", "5-10"):
        weights = [count[m]["total"] for m in MODELS]
        values = [mae[m][cluster].value for m in MODELS]
        assert mae["weighted"][cluster].value == pytest.approx(np.average(values, weights=weights))


def test_reductions_are_relative_to_basic_physical_model(result):
    average = {r: {m: rows[m]["average"].value for m in MODELS} for r, rows in result.mae.items()}
    for recipe, shares in result.reduction.items():
        expected = [1 - average[recipe][m] / average["basic_physical"][m] for m in MODELS]
        assert [shares[m] for m in MODELS] == pytest.approx(expected)
        assert shares["average"] == pytest.approx(np.mean(expected))
    relative = result.relative["true"]["5-10"]
    mean = result.test_consumption["weighted"]["5-10"].value
    assert relative == pytest.approx(result.mae["true"]["weighted"]["5-10"].value / mean)


def test_frames_have_a_row_for_each_recipe_and_vehicle_model_or_kind_of_split(result):
    errors = result.errors.set_index(["recipe", "vehicle_model"])
    assert len(errors) == 3 * len(MODELS)
    for model in MODELS:
        cell = result.mae["true"][model]["average"]
        assert tuple(errors.loc["true", model][["mae", "mae_ci95"]]) == (cell.value, cell.ci95)
        assert errors.loc["close", model]["mae_by_date"] == result.splits["date"]["close"][model]
    percentages = result.percentages.set_index(["held_out", "recipe"])
    assert percentages.loc[("date", "true"), "wmape"] == result.percentage.date.recipes["true"].wmape.value
    assert len(percentages) == 3 * 3


def test_planted_best_model_dominates_and_equal_model_codominates(rides, result):
    assert set(result.dominates["all"]) == {"true"}
    assert result.difference["all"]["basic_physical|true"].p < 1e-6
    assert result.difference["all"]["basic_physical|true"].value > 0.0
    rng = np.random.default_rng(1)
    shaken = rng.normal(0.0, 0.001, len(rides))
    twin = Toy("twin", lambda predicted: per_km()(predicted) + shaken[predicted.index])
    evaluation = evaluate(rides, recipes(HIGH, TRUE, twin), seed=5)
    assert set(evaluation.dominates["all"]) == {"true", "twin"}


def test_cluster_with_few_rides_has_no_figure(result):
    few = [(m, c) for m in MODELS for c in CLUSTERS[:5] if 0 < result.rides[m][c] < LEAST_RIDES]
    many = [(m, c) for m in MODELS for c in CLUSTERS[:5] if result.rides[m][c] >= LEAST_RIDES]
    assert few
    assert many
    for model, cluster in few:
        assert result.mae["true"][model][cluster] == EstimatedValue()
    for model, cluster in many:
        assert result.mae["true"][model][cluster].ci95 > 0.0


def test_intervals_cover_planted_errors_and_buffers_are_quantiles(result):
    covered = result.coverage["true"]
    assert set(result.coverage) == {"true"}
    assert covered.overall == pytest.approx(0.9, abs=0.03)
    assert covered.width_kwh == pytest.approx(2 * 1.6449 * SD)
    for shares in (covered.cluster, covered.season, covered.vehicle_model):
        assert shares
        assert all(0.7 <= share <= 1.0 for share in shares.values())
    assert None not in (covered.by_vehicle, covered.by_date, covered.new_vehicle)
    assert result.buffer_kwh["true"]["95"] == pytest.approx(1.645 * SD, rel=0.15)
    assert result.buffer_kwh["basic_physical"]["95"] == pytest.approx(1.645 * SD - 0.3, abs=0.03)


def test_errors_are_reported_by_distance_temperature_season_and_driver(result):
    assert set(result.by) == {"distance", "temperature", "season", "driver"}
    assert [b.bin for b in result.by["season"]["true"]] == list(SEASONS)
    assert [b.bin for b in result.by["driver"]["true"]] == ["ana", "bo"]
    total = sum(b.n for b in result.by["driver"]["true"])
    assert total == sum(b.n for b in result.by["season"]["true"])
    assert "0 to 5" in {b.bin for b in result.by["temperature"]["true"]}


def test_predicted_rides_have_no_energy_columns_and_are_not_trained_on(rides):
    seen = []

    def spy(predicted):
        assert not [n for n in predicted if n.startswith(("energy", "soc_end", "hvac"))]
        seen.append(set(predicted["ride_id"]))
        return per_km()(predicted)

    toy = Toy("spy", spy)
    evaluate(rides.assign(soc_end_pct=1.0, hvac_kwh=1.0, energy_vi_kwh=1.0), recipes(toy), seed=1)
    assert len(seen) == len(toy.seen)
    for predicted, trained in zip(seen, toy.seen, strict=True):
        assert not predicted & set(trained["ride_id"])


def test_splits_by_vehicle_and_by_date_hold_out_cars_and_days(rides):
    class Memory(Toy):
        def fit(self, rides):
            cars, dates = set(rides["vehicle_id"]), set(rides["date"])
            known = lambda predicted: predicted["vehicle_id"].isin(cars) & predicted["date"].isin(dates)  # noqa: E731 - short
            return Model(lambda predicted: np.where(known(predicted), per_km()(predicted), per_km(1.0, 5.0)(predicted)))

    evaluation = evaluate(rides, recipes(TRUE, Memory("memory", None)), seed=1)
    for model in MODELS:
        assert evaluation.splits["ride"]["memory"][model] < 2.5
        assert evaluation.splits["vehicle"]["memory"][model] == pytest.approx(5.0, abs=0.05)
        assert evaluation.splits["date"]["memory"][model] == pytest.approx(5.0, abs=0.05)
        assert evaluation.splits["vehicle"]["true"][model] < 0.12


def test_result_depends_on_seed_but_not_on_processes_or_ride_order():
    table, wanted = fleet(400, models=MODELS[:1]), select_recipes("basic_physical,empirical", None)
    one = evaluate(table, wanted, seed=7, repeats=2)
    assert evaluate(table.sample(frac=1.0, random_state=1), wanted, seed=7, repeats=2, jobs=2) == one
    assert evaluate(table, wanted, seed=8, repeats=2).mae != one.mae


def test_vehicle_model_left_out_of_training_changes_new_vehicle_errors_only(rides, result):
    class Trained(Toy):
        def fit(self, rides):
            rate = rides["energy_kwh"].sum() / rides["distance_km"].sum()
            return Model(lambda predicted: rate * predicted["distance_km"].to_numpy())

    table = fleet(models=(*MODELS, "nissan-leaf-2013"))
    table.loc[table["vehicle_model"] == "nissan-leaf-2013", "energy_kwh"] *= 3.0
    plain, without = (
        evaluate(table, recipes(HIGH, Trained("rate", None)), seed=1, repeats=2, left_out_of_training=left_out)
        for left_out in ((), ("nissan-leaf",))
    )
    assert plain.about.left_out_of_training == []
    assert without.about.left_out_of_training == ["nissan-leaf-2013"]
    assert without.mae == plain.mae
    errors = {name: without.new_vehicle["rate"][name].mae for name in (*MODELS, "nissan-leaf-2013")}
    assert errors.pop("nissan-leaf-2013") == plain.new_vehicle["rate"]["nissan-leaf-2013"].mae
    for name, error in errors.items():
        assert error < 0.2 * plain.new_vehicle["rate"][name].mae
    two = evaluate(rides, recipes(HIGH, TRUE), seed=1, repeats=2, left_out_of_training=MODELS[:1])
    assert list(two.new_vehicle["true"]) == [MODELS[0], "average"]
    assert two.about.notes == [
        "intervals by ride are 11.3 times as wide over 2 repeats as over many: give --repeats 8 or more",
        f"{MODELS[1]}: not tested as a new vehicle model, for want of rides to test or of others to train on",
        f"basic_physical: {HILLS_OF_BUILT_IN}",
    ]
    assert result.about.notes == [f"basic_physical: {HILLS_OF_BUILT_IN}"]


def test_failing_recipe_is_left_out_with_note(rides):
    def refuse(_rides):
        raise ModelError("column 'x' is missing: add it")

    evaluation = evaluate(rides, recipes(TRUE, Toy("broken", refuse)), seed=1)
    assert list(evaluation.mae) == ["true"]
    assert evaluation.about.notes == ["broken: column 'x' is missing: add it"]
    with pytest.raises(ModelError, match="no recipe can be evaluated: broken: column 'x'"):
        evaluate(rides, recipes(Toy("broken", refuse)), seed=1)


def test_recipes_are_evaluated_on_rides_that_all_of_them_predict():
    split = Split(np.arange(100, 200), np.arange(100))
    whole = Prediction(split.test, np.ones(100))
    holes = np.ones(100)
    holes[[3, 7]] = np.nan
    evaluation = select_comparable({"a": [whole], "b": [Prediction(split.test, holes)]}, 200)
    assert evaluation.recipes == ("a", "b")
    assert set(range(100)) - set(evaluation.rows[0].tolist()) == {3, 7}
    assert len(evaluation.energy["a"][0]) == len(evaluation.energy["b"][0]) == 98
    assert evaluation.notes == ("b: no prediction for 2.00% of the rides; no recipe is evaluated by these",)
    holes[:20] = np.nan
    evaluation = select_comparable({"a": [whole], "b": [Prediction(split.test, holes)]}, 200)
    assert evaluation.recipes == ("a",)
    assert len(evaluation.rows[0]) == 100


def test_predictions_beyond_what_a_ride_can_take_are_counted_by_recipe():
    counted = Prediction(np.arange(600), np.zeros(600), limited=3)
    held = select_comparable({"absurd": [counted, counted]}, 1200)
    assert held.notes == (f"absurd: {word_limited(6, 1200)}",)
    assert word_limited(6, 1200).startswith("6 of 1,200 predictions are more than a ride can take")


def test_one_car_on_one_day_is_evaluated_without_parts_that_need_more():
    table = fleet(200, models=MODELS[:1])
    table = table.assign(vehicle_id="one", date="2018-01-15").drop(columns="driver_id")
    evaluation = evaluate(table, recipes(HIGH, TRUE), seed=1)
    assert evaluation.dominates["all"] == ["true"]
    assert evaluation.new_vehicle == {}
    assert evaluation.few_shot == {}
    assert evaluation.by["driver"]["true"] == []
    assert "by_vehicle" not in evaluation.coverage["true"].to_json()
    assert evaluation.splits["vehicle"]["true"][MODELS[0]] is None
    assert evaluation.splits["date"]["true"][MODELS[0]] is None
    *notes, hills = evaluation.about.notes
    assert len(notes) == 3
    assert hills == f"basic_physical: {HILLS_OF_BUILT_IN}"


def test_excluded_rides_are_counted_by_reason(rides):
    table = rides.head(60).copy()
    table.loc[:4, ["fit_for_training", "unfit_reason"]] = [False, "too_short"]
    table.loc[5:6, "energy_kwh"] = np.nan
    table.loc[7, "vehicle_model"] = None
    evaluation = filter_rides(pd.concat([table, table.iloc[20:23]]))
    assert evaluation.unfit == {"no_measured_energy": 2, "no_vehicle_model": 1, "too_short": 5, "twice": 3}
    assert len(evaluation.rides) == 60 - 8
    assert evaluation.read == 63


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.drop(columns="distance_km"), "column 'distance_km' is missing"),
        (lambda t: t.head(1), "1 of 1 ride can be evaluated, at most 1 of a vehicle model in a cluster of 5 km"),
        (lambda t: t.assign(energy_kwh=np.nan), "0 of 1,600 rides can be evaluated.*1,600 no measured energy"),
        (lambda t: t.assign(fit_for_training=False, unfit_reason="too_long"), "left out: 1,600 too long"),
        (lambda t: t.assign(energy_kwh="much"), "'energy_kwh' of the ride table holds no numbers"),
        (lambda t: t.head(0), "0 of 0 rides can be evaluated"),
    ],
)
def test_unusable_ride_table_raises_error_with_reason(rides, spoil, message):
    with pytest.raises(ModelError, match=message):
        evaluate(spoil(rides), recipes(TRUE))


def test_recipes_are_selected_by_name_in_order_of_paper():
    assert list(select_recipes("hybrid, basic_physical", None)) == ["basic_physical", "hybrid"]
    for names, message in (
        ("horse", "'horse' is unknown; known are basic_physical"),
        (" ,", "no recipe is named"),
        ("segment_network", "needs windows.parquet"),
    ):
        with pytest.raises(SettingsError, match=message):
            select_recipes(names, None)


def test_figure_1_recovers_planted_curve_and_points_on_it():
    table = planted_rides.rides(3000, 5, MODELS[:1])
    table = table.assign(effect_aero_drag_wind=table["effect_aero_drag"], start_s=table["start_s"] + np.arange(3000))
    table = planted_rides.noisy(table, planted_rides.physical_energy(table), of_day=0.0)
    evaluation = compute_figure_1(filter_rides(table))[MODELS[0]]
    planted, fitted = planted_rides.PLANTED, AccessoryCurve(**evaluation.curve)
    assert sum(point.rides for point in evaluation.points) <= 3000
    assert len(evaluation.points) > 20
    for point in evaluation.points:
        at = np.array([point.ambient_c + ZERO_CELSIUS])
        assert point.power_w == pytest.approx(planted.power(at)[0], abs=4 * 600.0 / sqrt(point.rides) + 60.0)
        assert fitted.power(at)[0] == pytest.approx(planted.power(at)[0], abs=150.0)
