"""Test adding effects: planted effects are accepted with their coefficient, others are refused with a reason."""

import json

import numpy as np
import pandas as pd
import pytest

from socast.core import models
from socast.core.diagnose.add.add import AdditionTrial, add_effect, force_addition, log_attempt
from socast.core.diagnose.add.holdout import (
    compare_errors,
    drop_dates,
    group_rows_by_ride,
    select_final_days,
    split_into_day_folds,
    split_into_vehicle_folds,
)
from socast.core.diagnose.add.terms import build_term_columns, is_additive
from socast.core.errors import EffectError, ModelError
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.recipes import RECIPES, make_term
from socast.core.models import ANY, BASIC_PHYSICAL, LinearModel, Term, decode_model, encode_model
from socast.core.pipeline import Pipeline
from tests.support.planted_windows import AUXILIARY, BASE, KINDS, START, base_model, planted
from tests.support.telemetry import drive, leaf, telemetry

pytestmark = pytest.mark.long

COLD = 1e-4
"""Planted coefficient: 1 % of 0.010 per kelvin. [1/K]"""
Tables = tuple[pd.DataFrame, pd.DataFrame]


@pytest.fixture(scope="module")
def cold() -> Tables:
    return planted({"effect_cold_rolling": COLD})


@pytest.fixture(scope="module")
def model(cold) -> LinearModel:
    return base_model(cold[0])


def tried(tables: Tables, model: LinearModel, effect: str, *scopes: str, **options: object) -> AdditionTrial:
    rides, windows = tables
    return add_effect(
        model, effect, build_term_columns(effect, scopes), join_tables(rides, windows), rides=rides, **options
    )


@pytest.fixture(scope="module")
def added(cold, model) -> AdditionTrial:
    return tried(cold, model, "cold_rolling")


def test_planted_effect_and_other_coefficients_are_recovered(added):
    trial = added.trial
    assert trial.accepted
    low, high = trial.coefficient.ci95
    assert low < COLD < high
    assert high - low < 0.6 * COLD
    assert trial.coefficient.plausible
    assert trial.coefficient.unit == "1/K"
    assert not trial.warnings
    assert "for each degree below 20 °C" in trial.words
    for fit in added.model.fits.values():
        for value, truth in zip(fit.coefficients, [*BASE.values(), AUXILIARY, COLD], strict=True):
            assert value == pytest.approx(truth, rel=0.12)


def test_error_falls_on_held_out_days_vehicles_and_final_days(added):
    trial = added.trial
    for part in ("of_effect", "on_days", "on_vehicles", "final"):
        one = getattr(trial, part)
        assert one.mae_after_kwh < 0.5 * one.mae_before_kwh, part
        assert one.change_kwh.value + one.change_kwh.ci95 < 0.0, part
    assert trial.of_effect.rides + trial.final.rides == trial.rides == 160
    assert trial.mae_after_kwh < 1.3 * trial.noise_floor_kwh
    cold = trial.conditions["outside temperature"][0]
    assert cold.where == "below -10 °C"
    assert cold.mae_after_kwh < cold.mae_before_kwh
    assert {one.where for one in trial.conditions["vehicle"]} == {f"taxi-{i}" for i in range(4)}


def test_decision_does_not_depend_on_final_hold_out(cold, model, added):
    rides, windows = cold
    apart = added.trial.final.dates
    assert len(apart) == 4
    last = windows["ride_key"].isin(rides.loc[rides["date"].isin(apart), "ride_key"])
    spoilt = windows.assign(**{name: windows[name] + 0.1 * last for name in ("energy_kwh", "energy_vi_kwh")})
    trial = add_effect(
        model, "cold_rolling", build_term_columns("cold_rolling"), join_tables(rides, spoilt), rides=rides
    ).trial
    assert trial.final.mae_after_kwh > 0.5
    for key in ("gain", "p", "of_effect", "on_days", "on_vehicles", "accepted"):
        assert getattr(trial, key) == getattr(added.trial, key), key


def test_history_is_plain_json_and_survives_model_file(model, added, tmp_path):
    path = tmp_path / "model.json"
    models.save(added.model, path)
    again = models.load(path)
    assert again == added.model
    assert again.history[:-1] == model.history
    entry = again.history[-1]
    assert json.loads(json.dumps(entry)) == entry
    assert (entry["action"], entry["effect"], entry["scope"]) == ("add", "cold_rolling", [])
    assert entry["from_version"] == model.version
    assert entry["last_date"] == "2019-04-21"
    assert again.version not in {model.version, ""}
    assert again.training.rides == 160
    assert again.name == model.name


def test_decoy_is_refused_and_attempt_is_logged(cold, added):
    result = tried(cold, added.model, "headwind")
    assert not result.trial.accepted
    assert "not worth a term" in result.trial.reason
    kept = log_attempt(added.model, result.trial)
    assert kept.history[-1]["action"] == result.trial.outcome != "add"
    assert kept.terms == added.model.terms
    assert kept.version == added.model.version
    assert decode_model(encode_model(kept)) == kept
    taken = force_addition(result).model
    assert taken.history[-1]["action"] == "add"
    assert taken.history[-1]["forced"]
    assert taken.terms[-1].name == "headwind"


def test_second_effect_does_not_change_first(cold, added):
    result = tried(cold, added.model, "headwind").trial
    assert result.mae_before_kwh == pytest.approx(added.trial.mae_after_kwh, rel=0.05)
    assert result.final.dates == added.trial.final.dates


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_added_where_nothing_is_missing(seed):
    tables = planted(seed=10 + seed, rides=2, windows=5)
    assert not tried(tables, base_model(tables[0]), "wet_road").trial.accepted


@pytest.mark.parametrize("scope", ["vehicle=taxi-2", "since=2018-06-01"])
def test_effect_of_one_vehicle_or_since_a_date_is_recovered_within_its_scope(scope):
    tables = planted({("effect_cold_rolling", scope): 2e-4}, rides=3)
    result = tried(tables, base_model(tables[0]), "cold_rolling", scope)
    assert result.trial.accepted
    assert result.trial.scope == [scope]
    low, high = result.trial.coefficient.ci95
    assert low < 2e-4 < high
    term = result.model.terms[-1]
    assert term == Term(name=f"cold_rolling, {scope}", columns=("effect_cold_rolling", scope), unit="1/K")
    assert decode_model(encode_model(result.model)) == result.model
    assert (result.trial.on_vehicles is None) == scope.startswith("vehicle")
    rides = tables[0].assign(vehicle_id="another", start_s=START)
    without = result.model.predict_energy(rides.assign(effect_cold_rolling=0.0))
    assert result.model.predict_energy(rides).tolist() == without.tolist()


def test_no_final_hold_out_if_effect_acts_only_on_its_days():
    tables = planted(rides=4)
    apart = select_final_days((), list(tables[0]["date"]))
    rides, windows = (
        table.assign(effect_wet_road=table["effect_rolling"] * dates.isin(apart))
        for table, dates in zip(tables, (tables[0]["date"], join_tables(*tables)["date"]), strict=True)
    )
    result = tried((rides, windows), base_model(rides), "wet_road").trial
    assert result.final is None
    assert result.of_effect.rides == result.rides


def test_differing_vehicle_models_get_separate_coefficients():
    ids = {("effect_cold_rolling", f"vehicle=taxi-{i}"): (0.5e-4 if i % 2 else 2.5e-4) for i in range(4)}
    tables = planted(ids)
    result = tried(tables, base_model(tables[0]), "cold_rolling")
    by_kind = {key: one.value for key, one in result.trial.by_vehicle_model.items()}
    assert by_kind[KINDS[0]] == pytest.approx(2.5e-4, rel=0.15)
    assert by_kind[KINDS[1]] == pytest.approx(0.5e-4, rel=0.4)
    for key, value in by_kind.items():
        assert result.model.fits[key].coefficients[-1] == value
    assert by_kind[KINDS[1]] < result.model.fits[ANY].coefficients[-1] < by_kind[KINDS[0]]


def test_implausible_coefficient_gives_warning():
    tables = planted({"effect_cold_rolling": 8e-4})
    result = tried(tables, base_model(tables[0]), "cold_rolling")
    assert result.trial.accepted
    assert not result.trial.coefficient.plausible
    assert "outside its plausible range, 2.5e-05 to 0.000375 1/K: it is too large" in result.trial.warnings[0]


def test_effect_of_wrong_sign_is_refused_with_warning():
    tables = planted({"effect_cold_rolling": -2e-4})
    result = tried(tables, base_model(tables[0]), "cold_rolling")
    assert not result.trial.accepted
    assert "which physics forbids" in result.trial.warnings[0]


@pytest.mark.parametrize(
    ("effect", "scopes", "error", "words"),
    [
        ("cold_roling", (), EffectError, "did you mean cold_rolling"),
        ("snow", (), ModelError, "snow is never active in these 160 rides; record"),
        ("payload", (), ModelError, "payload is not in the tables: make them again"),
        ("brake_drag", (), ModelError, "can reproduce all of brake_drag with its own terms"),
        ("rolling", (), ModelError, "is in model base already, as the term 'rolling'"),
        (
            "wet_road",
            ("vehicle=taxi-9",),
            ModelError,
            "within the scope vehicle=taxi-9: the rides are of taxi-0, taxi-1",
        ),
        ("wet_road", ("since=2020-01-01",), ModelError, "rides are of 2018-01-01 to 2019-04-21"),
        ("wet_road", ("since=2018-13-01",), ModelError, "is not a date"),
        ("wet_road", ("winter",), ModelError, "scope 'winter' is not valid: write vehicle=ID or since=YYYY-MM-DD"),
        ("wet_road", ("vehicle=a", "vehicle=b"), ModelError, "add the effect once for each"),
        ("cold_rolling@reference=283.150", (), EffectError, "is known as 'cold_rolling@reference=283.15'"),
    ],
)
def test_errors_of_add_effect_name_cause_and_remedy(effect, scopes, error, words, cold, model):
    with pytest.raises(error, match=words.replace("(", r"\(")):
        tried(cold, model, effect, *scopes)


def test_variant_is_another_column_of_same_effect(cold, model, added):
    result = tried(cold, model, "cold_rolling@reference=283.15")
    assert result.model.terms[-1].columns == ("effect_cold_rolling@reference=283.15",)
    assert "below 10 °C" in result.trial.words
    with pytest.raises(ModelError, match="in model base already, as the term 'cold_rolling'"):
        tried(cold, added.model, "cold_rolling@reference=283.15")


def test_model_with_more_than_terms_is_refused(cold, model):
    with pytest.raises(ModelError, match="factors of single cars"):
        tried(
            cold, LinearModel(**{f: getattr(model, f) for f in model.__struct_fields__} | {"cars": {"a": 1.1}}), "snow"
        )


def test_one_vehicle_on_one_day_is_refused():
    tables = planted({"effect_wet_road": 1e-3}, vehicles=1, days=1, rides=40)
    tables = tuple(t.assign(effect_wet_road=t["effect_rolling"] * (np.arange(len(t)) % 2)) for t in tables)
    with pytest.raises(ModelError, match="of one vehicle on one day"):
        tried(tables, base_model(tables[0]), "wet_road")


def test_model_with_constant_is_fitted_to_whole_rides(cold):
    rides, windows = cold
    assert is_additive(BASIC_PHYSICAL.terms)
    assert not is_additive((make_term("average_speed_kmh"),))
    assert not is_additive((make_term("distance_km", "distance_km"),))
    assert not is_additive(RECIPES["hybrid"].terms)
    with_constant = LinearModel(
        name="constant", version="1", recipe="x", terms=(*base_model(rides).terms, make_term()), fits={}, history=()
    )
    result = add_effect(
        with_constant, "cold_rolling", build_term_columns("cold_rolling"), join_tables(rides, windows), rides=rides
    )
    assert result.trial.windows == result.trial.rides
    assert result.trial.coefficient.ci95[0] < COLD < result.trial.coefficient.ci95[1]
    with pytest.raises(ModelError, match="hold for whole rides only"):
        add_effect(with_constant, "cold_rolling", build_term_columns("cold_rolling"), join_tables(rides, windows))


# ---- the parts of a trial


def test_folds_hold_out_each_ride_once_and_whole_days_if_there_are_many():
    for days, by_date in ((12, False), (24, True)):
        rides, windows = planted(days=days, rides=2, windows=2)
        result = group_rows_by_ride(join_tables(rides, windows), rides)
        folds = split_into_day_folds(result, 3)
        assert np.sum(folds, axis=0).tolist() == [1] * len(result.table)
        seen: dict[str, set[int]] = {}
        for i, fold in enumerate(folds):
            for date, vehicle in zip(result.table["date"][fold], result.table["vehicle_id"][fold], strict=True):
                seen.setdefault(date if by_date else f"{date} {vehicle}", set()).add(i)
        assert all(len(places) == 1 for places in seen.values())
    by_vehicle = split_into_vehicle_folds(result, 3)
    assert sum(fold.sum() for fold in by_vehicle) == len(result.table)
    for fold in by_vehicle:
        out = set(result.table["vehicle_id"][fold])
        assert not out & set(result.table["vehicle_id"][~fold])


def test_interval_of_paired_difference_is_clustered_by_vehicle_day():
    rng = np.random.default_rng(4)
    held = []
    for _ in range(120):
        days = np.repeat(np.arange(30), 5)
        table = pd.DataFrame(
            {"vehicle_id": "a", "date": days.astype(str), "measured": rng.normal(3.0, 1.0, 150)}
        ).assign(noise=0.0)
        shared = rng.normal(0.0, 0.05, 30)[days]
        before = table["measured"] + 0.5
        after = table["measured"] + 0.4 + shared
        result = compare_errors(table, before.to_numpy(), after.to_numpy())
        held.append(abs(result.change_kwh.value + 0.1) < result.change_kwh.ci95)
        assert result.clusters == 30
    assert 0.90 < np.mean(held) < 0.99


def test_unpredicted_rides_are_left_out_of_comparison():
    table = pd.DataFrame({"vehicle_id": list("aab"), "date": "d", "measured": [1.0, 1.0, 1.0], "noise": 0.0})
    result = compare_errors(table, np.array([1.5, 1.5, np.nan]), np.array([1.25, 1.25, 1.0]))
    assert (result.rides, result.mae_before_kwh, result.mae_after_kwh) == (2, 0.5, 0.25)
    nothing = compare_errors(table, np.full(3, np.nan), np.full(3, np.nan))
    assert nothing.rides == 0
    assert nothing.change_kwh.value is None


def test_final_days_of_history_are_kept_and_chosen_again_for_new_dates():
    dates = [f"2018-01-{day:02d}" for day in range(1, 21)]
    assert select_final_days((), dates * 3) == ("2018-01-03", "2018-01-08", "2018-01-13", "2018-01-18")
    assert select_final_days((), dates[1:]) == ()
    history = ({"final": None}, {"action": "add", "final": {"dates": ["2018-01-05"]}}, {"action": "refused"})
    assert select_final_days(history, dates) == ("2018-01-05",)
    assert select_final_days(history, dates[:6]) == ("2018-01-05",)
    later = [date.replace("2018", "2019") for date in dates]
    assert select_final_days(history, later)[0] == "2019-01-03"


@pytest.mark.parametrize("scope", ["since=2018-13-01", "vehicle=", "since=now"])
def test_model_file_with_damaged_scope_is_refused_in_one_line(scope, added, tmp_path):
    content = json.loads(encode_model(added.model))
    content["terms"][-1]["columns"].append(scope)
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(ModelError) as raised:
        models.load(tmp_path / "bad.json")
    assert f"term 'cold_rolling': scope '{scope}'" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_live_forecast_with_scoped_effect_matches_ride_table(tmp_path):
    cold = (Term(name="cold", columns=("effect_cold_rolling", "vehicle=a", "since=2024-01-15"), unit="1/K"),)
    fit = models.Fit(coefficients=(2e-4,))
    scoped_model = LinearModel(name="s", version="1", recipe="x", terms=cold, fits={ANY: fit})
    models.save(scoped_model, tmp_path / "s.json")
    pipeline = Pipeline(models.load(tmp_path / "s.json"))
    drives = [leaf("a"), leaf("b"), *telemetry(drive(ambient_c=-10.0), "a"), *telemetry(drive(ambient_c=-10.0), "b")]
    pipeline.push(drives)
    forecasts = [status.forecast for status in pipeline.status()]
    running = {each.vehicle_id: each.ride_energy_predicted_kwh for each in forecasts}
    assert running["a"] > 0.0
    assert running["b"] == 0.0
    pipeline.finish()
    table = pipeline.take_rides()
    assert dict(zip(table["vehicle_id"], scoped_model.predict_energy(table), strict=True)) == running


def test_dates_are_dropped_from_both_tables():
    rides = pd.DataFrame({"ride_key": ["a", "b", "c"], "date": ["2018-01-01", "2018-01-02", "2018-01-01"]})
    windows = pd.DataFrame({"ride_key": ["a", "a", "b", "c"]})
    kept = drop_dates(rides, windows, ["2018-01-01"])
    assert [list(table["ride_key"]) for table in kept] == [["b"], ["b"]]
    assert drop_dates(rides, windows, ()) == (rides, windows)
