"""`socast fit` makes a model file that forecasts, and refuses unusable input in one line."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from socast.core import models
from socast.core.fit.recipes import RECIPES
from socast.core.models import ANY, LinearModel
from socast.core.pipeline import Pipeline
from socast.stream.loop import run
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.memory import MemorySink, MemorySource
from socast.tools.terminal.ride_source import list_ride_files
from tests.support.commands import done, refused
from tests.support.planted_rides import MODELS, noisy, physical_energy, rides
from tests.support.pooled_rides import differing, fleet, measured, planted
from tests.support.recorded_shift import shift
from tests.support.synthetic_windows import make_tables, make_windows

pytestmark = pytest.mark.long
PAPER = list(RECIPES)[:7]


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    fleet_rides = rides(900, seed=31)
    made = noisy(fleet_rides, physical_energy(fleet_rides, {"rolling": 1.4}))
    made.loc[:4, "fit_for_training"] = False
    made.loc[:4, "unfit_reason"] = "too_long"
    return made


@pytest.fixture(scope="module")
def folder(table, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("tables")
    table.to_parquet(path / "rides.parquet", row_group_size=200)
    return path


def fitted(folder: Path, recipe: str, out: Path, *more: object) -> LinearModel:
    done("fit", folder, "--recipe", recipe, "-o", out, *more)
    return models.load(out)


@pytest.mark.parametrize("name", PAPER)
def test_every_recipe_of_paper_is_fitted_and_predicts(name, folder, table, tmp_path, capsys):
    model = fitted(folder, name, tmp_path / "model.json")
    printed = capsys.readouterr().out
    assert RECIPES[name].title in printed
    assert "895 rides from 2018-01-02 to 2018-12-31" in printed
    assert "left out: 5 too long" in printed
    assert "MAE in sample" in printed
    assert model == RECIPES[name].fit_parquet(folder / "rides.parquet")
    assert np.isfinite(model.predict_energy(table)).all()
    for key in model.fits:
        assert key in printed or key == ANY


def test_fit_to_windows_says_which_numbers_the_rides_determine(tmp_path, capsys):
    rides, windows = make_tables(make_windows(1, 4, 3, 6), noise=0.02)
    rides.to_parquet(tmp_path / "rides.parquet")
    windows.to_parquet(tmp_path / "windows.parquet")
    fitted(tmp_path, "road_load", tmp_path / "model.json", "--json", tmp_path / "report.json")
    printed = " ".join(capsys.readouterr().out.split())
    told = json.loads((tmp_path / "report.json").read_text())["fits"]["kia-soul-ev-2015"]["determined"]
    rest = [each for each in told if not each["determined"]]
    counted = f"{len(told) - len(rest)} of {len(told)} numbers, 6 coefficients and 3 powers of accessories"
    assert f"kia-soul-ev-2015: the rides determine {counted}" in printed
    assert "any other (*): the rides determine" not in printed
    for each in rest:
        assert f"{each['name']} ({100 * each['sd_over_prior']:.0f} % left)" in printed
        assert each["drives"] is None or f"of 30 min {each['drive']}" in printed


def test_fit_takes_a_recording_and_cleans_it_as_tables_does(tmp_path):
    recording, cleaning = tmp_path / "shift.mcap", ("--least-distance-km", 0.1)
    with McapSink(recording) as sink:
        sink.put(shift())
    done("tables", recording, "--out", tmp_path / "tables", *cleaning)
    by_tables = fitted(tmp_path / "tables", "basic_rescaled", tmp_path / "by_tables.json")
    assert fitted(recording, "basic_rescaled", tmp_path / "by_recording.json", *cleaning) == by_tables


def test_cleaning_of_tables_is_refused_by_fit(folder, tmp_path, capsys):
    message = refused(capsys, "fit", folder, "--recipe", "road_load", "-o", tmp_path / "m.json", "--period", 1)
    assert "--period 1 cleans recordings" in message


def test_fitted_coefficients_are_shown_with_units_and_intervals(folder, tmp_path, capsys):
    model = fitted(folder, "fitted_physical", tmp_path / "model.json", "--json", tmp_path / "result.json")
    printed = capsys.readouterr().out
    assert "heating full" in printed
    assert "±" in printed
    assert "(held)" in printed
    written = json.loads((tmp_path / "result.json").read_text())
    assert written["recipe"] == "fitted_physical"
    assert written["training"]["rides"] == 895
    assert written["training"]["left_out"] == {"too_long": 5}
    assert set(written["fits"]) == {*MODELS, ANY}
    every = written["fits"][ANY]
    rolling = every["coefficients"][0]
    assert rolling["term"] == "rolling"
    assert rolling["unit"] == "1"
    assert abs(rolling["value"] - 1.4) < 2.0 * rolling["ci95"]
    assert every["mae_in_sample_kwh"] < 0.2
    assert abs(every["curve"]["heating_off_c"] - 10.0) < 4.0
    assert model.history[0]["mae_in_sample_kwh"][ANY] == every["mae_in_sample_kwh"]


def test_coefficient_at_its_limit_is_marked_and_its_interval_ends_there(tmp_path, capsys):
    rides, windows = make_tables(make_windows(2, 6, 3, 6), noise=0.002)
    for table in (rides, windows):
        for name in ("energy_kwh", "energy_vi_kwh"):
            table[name] = table[name] + 1.8 * table["effect_inertia_negative"]
    rides.to_parquet(tmp_path / "rides.parquet")
    windows.to_parquet(tmp_path / "windows.parquet")
    result = tmp_path / "result.json"
    fitted(tmp_path, "road_load", tmp_path / "model.json", "--json", result)
    printed = " ".join(capsys.readouterr().out.split())
    coefficients = json.loads(result.read_text())["fits"][ANY]["coefficients"]
    found = {one["term"]: one for one in coefficients}
    slowing = found["inertia_negative"]
    assert slowing["at_limit"]
    assert slowing["ci95"] is None
    assert slowing["low"] < slowing["high"] == slowing["range"][1] == pytest.approx(slowing["value"])
    assert f"1.8, {slowing['low']:.3g} to 1.8 (at its limit)" in printed
    assert "the data alone would put it beyond its plausible range" in printed
    assert not found["climbing"]["at_limit"]
    assert found["climbing"]["high"] - found["climbing"]["value"] == pytest.approx(found["climbing"]["ci95"])
    for one in coefficients:
        assert one["range"][0] <= one["low"] <= one["value"] <= one["high"] <= one["range"][1]


def test_several_tables_are_fitted_together(folder, table, tmp_path):
    half = tmp_path / "half.parquet"
    table.iloc[:450].to_parquet(half)
    table.iloc[450:].to_parquet(tmp_path / "rides.parquet")
    done("fit", half, tmp_path, "--recipe", "hybrid", "-o", tmp_path / "model.json")
    assert list_ride_files([half, tmp_path]) == [half, tmp_path / "rides.parquet"]
    together, whole = models.load(tmp_path / "model.json"), fitted(folder, "hybrid", tmp_path / "whole.json")
    assert together.training == whole.training
    np.testing.assert_allclose(together.predict_energy(table), whole.predict_energy(table), rtol=1e-6)


def written(table: pd.DataFrame, path: Path) -> Path:
    table.to_parquet(path)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="odometer_km"), "column 'odometer_km' is missing: make the tables again"),
        (lambda t: t.iloc[5:6], "1 ride to fit to, and it needs 80: give more rides"),
        (
            lambda t: t.assign(energy_kwh=np.nan),
            "900 rides, all unfit (895 no measured energy, 5 too long)",
        ),
        (lambda t: pd.concat([t.iloc[5:6]] * 100), "all 100 rides are alike: nothing can be learned"),
        (lambda t: t.assign(energy_kwh=1.0), "energy_kwh is 1 in all 895 rides"),
        (lambda t: t.assign(lost_m="x"), "column 'lost_m' of the ride table is no number"),
    ],
)
def test_unusable_table_is_refused_in_one_line(change, message, table, tmp_path, capsys):
    bad = written(change(table), tmp_path / "bad.parquet")
    assert message in refused(capsys, "fit", bad, "--recipe", "hybrid", "-o", tmp_path / "model.json")
    assert not (tmp_path / "model.json").exists()


def test_rides_of_one_vehicle_suffice_for_fit(table, tmp_path, capsys):
    one = table["vehicle_model"] == MODELS[0]
    car = written(table[one].assign(vehicle_id="a"), tmp_path / "one.parquet")
    model = fitted(car, "hybrid", tmp_path / "model.json")
    assert set(model.fits) == {MODELS[0], ANY}
    assert MODELS[0] in capsys.readouterr().out


def test_missing_table_or_unknown_recipe_is_refused_in_one_line(folder, table, tmp_path, capsys):
    out = tmp_path / "model.json"
    message = refused(capsys, "fit", folder, "--recipe", "hybird", "-o", out)
    assert "recipe 'hybird' is unknown: did you mean hybrid" in message
    assert "does not exist; name a folder" in refused(capsys, "fit", tmp_path / "no", "--recipe", "hybrid", "-o", out)
    assert "holds no rides.parquet" in refused(capsys, "fit", tmp_path, "--recipe", "hybrid", "-o", out)
    other = tmp_path / "shift.truth.json"
    other.write_text("{}", encoding="utf-8")
    assert "neither a recording (*.mcap) nor" in refused(capsys, "fit", other, "--recipe", "hybrid", "-o", out)
    (tmp_path / "text.parquet").write_text("distance_km\n")
    message = refused(capsys, "fit", tmp_path / "text.parquet", "--recipe", "hybrid", "-o", out)
    assert "text.parquet: no Parquet table" in message
    lacking = written(table.drop(columns=["winter", "summer"]), tmp_path / "lacking.parquet")
    assert "column 'winter' is missing" in refused(capsys, "fit", lacking, "--recipe", "hybrid", "-o", out)
    message = refused(capsys, "fit", folder, "--recipe", "hybrid", "-o", folder / "rides.parquet")
    assert "is read and would be overwritten" in message
    assert "cannot be written" in refused(capsys, "fit", folder, "--recipe", "hybrid", "-o", tmp_path / "a" / "b.json")


def test_unusable_model_file_is_refused_in_one_line(tmp_path, capsys):
    path, recording = tmp_path / "model.json", tmp_path / "shift.mcap"
    with McapSink(recording) as sink:
        sink.put(shift(20))
    content = json.loads(models.encode_model(models.BASIC_PHYSICAL))
    for change, message in (
        ({"format": 1}, "model file of format 1, and this version reads format 2: fit the model again"),
        ({"terms": [{"name": "x", "columns": ["distanse_km"], "unit": "1"}]}, "column 'distanse_km' is not one that"),
        ({"terms": [{"name": "x", "columns": ["effect_roling"]}]}, "damaged: Object missing required field `unit`"),
    ):
        path.write_text(json.dumps({**content, **change}))
        assert message in refused(capsys, "replay", recording, "--model", path)


# ---- a fitted model in service


@pytest.fixture(scope="module", params=["hybrid_interactions", "empirical", "extended_physical"])
def in_service(request, table) -> LinearModel:
    return RECIPES[request.param].fit(table, covariance=False)


def through(source, model) -> tuple[list, pd.DataFrame]:
    pipeline, sink = Pipeline(model), MemorySink()
    run(source, pipeline, [sink])
    return sink.messages, pipeline.take_rides()


def test_live_equals_replay_exactly_with_fitted_model(in_service, tmp_path):
    messages = shift(samples=230, cars=2)  # one whole ride of each car, and a half of another
    forecasts, table = through(MemorySource(messages), in_service)
    predicted = [json.loads(m.payload)["ride_energy_predicted_kwh"] for m in forecasts]
    known = [energy for energy in predicted if energy is not None]
    assert len(known) > 50
    assert len(set(known)) > 40
    assert json.loads(forecasts[0].payload)["model"] == f"{in_service.name}/{in_service.version}"
    for chunk in (1, 7):
        again, other = through(MemorySource(messages, chunk), in_service)
        assert again == forecasts
        assert other.to_json() == table.to_json()
    with McapSink(tmp_path / "shift.mcap", 10_000) as sink:
        sink.put(messages)
    models.save(in_service, tmp_path / "model.json")
    assert through(McapSource(tmp_path / "shift.mcap"), models.load(tmp_path / "model.json"))[0] == forecasts


def test_pipeline_restored_during_ride_makes_same_forecasts(in_service):
    messages = shift()
    whole = Pipeline(in_service)
    whole.push(messages[:700])
    expected = whole.push(messages[700:])
    first = Pipeline(in_service)
    first.push(messages[:700])
    second = Pipeline(in_service)
    second.restore(first.snapshot())
    assert second.push(messages[700:]) == expected
    assert second.status() == whole.status()


def test_last_forecast_of_ride_equals_prediction_from_its_table_row(in_service):
    pipeline = Pipeline(in_service)
    pipeline.push(shift())
    forecasts = [status.forecast for status in pipeline.status()]
    running = {each.vehicle_id: each.ride_energy_predicted_kwh for each in forecasts}
    pipeline.finish()
    table = pipeline.take_rides()
    last = table.groupby("vehicle_id").tail(1)
    assert len(last) == len(running)
    for vehicle, energy in zip(last["vehicle_id"], in_service.predict_energy(last), strict=True):
        assert energy == running[vehicle]


def test_replay_and_tables_accept_model_file(folder, tmp_path, capsys):
    fitted(folder, "hybrid", tmp_path / "model.json")
    with McapSink(tmp_path / "shift.mcap") as sink:
        sink.put(shift())
    done("replay", tmp_path / "shift.mcap", "--model", tmp_path / "model.json", "--json", tmp_path / "rides.json")
    rows = json.loads((tmp_path / "rides.json").read_text())["rides"]
    assert any(row["predicted_kwh"] is not None for row in rows)
    assert "predicted" in capsys.readouterr().out
    done("tables", tmp_path / "shift.mcap", "--model", tmp_path / "model.json", "--out", tmp_path / "made")
    made = pd.read_parquet(tmp_path / "made" / "rides.parquet")
    assert np.isfinite(models.load(tmp_path / "model.json").predict_energy(made)).any()


@pytest.fixture(scope="module")
def whole() -> pd.DataFrame:
    """A table with all that the recipes beyond the paper read."""
    made = fleet(700, 1)
    return measured(made, planted(made, differing(MODELS)))


def test_pooled_model_adapts_to_new_car(whole, tmp_path):
    table = whole
    new = table["vehicle_model"] == MODELS[0]
    base = fitted(written(table[~new], tmp_path / "others.parquet"), "pooled_hybrid", tmp_path / "base.json")
    adapted = written(table[new].iloc[:40], tmp_path / "new.parquet")
    done("fit", adapted, "--adapt", tmp_path / "base.json", "-o", tmp_path / "result.json")
    model = models.load(tmp_path / "result.json")
    rest = table[new].iloc[40:]
    error = [np.abs(each.predict_energy(rest) - rest["energy_kwh"]).mean() for each in (base, model)]
    assert error[1] < error[0]
    assert model.version != base.version
    assert model.history[-1]["action"] == "adapt"


def test_recipe_and_adapt_exclude_each_other(folder, tmp_path, capsys):
    assert "--recipe NAME to fit" in refused(capsys, "fit", folder, "-o", tmp_path / "m.json")
    both = ("fit", folder, "--recipe", "hybrid", "--adapt", tmp_path / "m.json", "-o", tmp_path / "m.json")
    assert "--recipe NAME to fit" in refused(capsys, *both)


@pytest.mark.parametrize("recipe", ["fitted_physical", "hybrid", "boosted_hybrid"])
def test_unknown_values_in_single_rows_never_prevent_fit(recipe, whole, tmp_path):
    spoilt = whole.copy()
    spoilt.loc[20, "duration_s"] = np.nan
    spoilt.loc[21, "effect_rolling"] = np.nan
    model = fitted(written(spoilt, tmp_path / "rides.parquet"), recipe, tmp_path / "m.json")
    assert model.interval is not None
    assert np.isfinite(model.predict_energy(whole)).all()


@pytest.mark.parametrize("recipe", ["fitted_physical", "boosted_hybrid"])
def test_empty_table_is_refused_in_one_line(recipe, whole, tmp_path, capsys):
    file = written(whole.iloc[:0], tmp_path / "rides.parquet")
    assert "0 rides" in refused(capsys, "fit", file, "--recipe", recipe, "-o", tmp_path / "m.json")


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "--recipe", "fitted_physical", "-o", "model.json"),
        ("evaluate",),
        ("compare", "--model", "basic_physical"),
        ("diagnose", "--model", "basic_physical"),
    ],
)
def test_window_table_is_not_taken_for_rides(command, table, tmp_path, capsys):
    windows = written(table.assign(window=0), tmp_path / "windows.parquet")
    message = refused(capsys, command[0], windows, *command[1:])
    assert f"{windows} is a window table; give the folder, or rides.parquet" in message


def test_table_given_twice_is_refused(folder, tmp_path, capsys):
    assert "given twice" in refused(capsys, "fit", folder, folder, "--recipe", "hybrid", "-o", tmp_path / "m.json")
