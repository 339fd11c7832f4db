"""The public interface is exactly what `__all__` lists, and importing it costs only what is used."""

import inspect
import subprocess
import sys
from datetime import date
from importlib.metadata import version

import pandas as pd
import pytest

import socast
from tests.support.html_pages import assert_axes_are_titled
from tests.support.paths import SHIFT

pytestmark = pytest.mark.long

EXPORTS = [
    "AdditionTrial",
    "AskError",
    "CatalogueError",
    "Comparison",
    "Diagnosis",
    "Effect",
    "EffectError",
    "ImportFileError",
    "LinearModel",
    "Message",
    "ModelError",
    "Parameter",
    "Pipeline",
    "RecipeEvaluation",
    "RecipeRegressor",
    "RecordingError",
    "Settings",
    "SettingsError",
    "SocEvaluation",
    "SocastError",
    "Tables",
    "add_effect",
    "assess_condition",
    "check_effect",
    "compare_before_after",
    "compare_datasets",
    "compare_models",
    "diagnose",
    "effect",
    "evaluate_recipes",
    "evaluate_soc_forecasts",
    "fit_model",
    "get_effect",
    "list_effects",
    "list_recipes",
    "load_effects",
    "load_model",
    "make_tables",
    "read_forecasts",
    "read_messages",
    "read_samples",
    "read_tables",
    "save_model",
    "simulate_fleet",
    "split_energy",
    "stamp_model",
    "trace_ride",
]
HEAVY = {"numba", "pandas", "plotly", "scipy", "sklearn", "typer", "zenoh"}


@pytest.fixture(scope="module")
def tables():
    return socast.make_tables(SHIFT)


def test_exports_are_fixed():
    assert sorted(socast.__all__) == EXPORTS
    assert set(EXPORTS) <= set(dir(socast))


@pytest.mark.parametrize("name", EXPORTS)
def test_every_export_is_documented(name):
    doc = inspect.getdoc(getattr(socast, name))
    assert doc
    assert doc.splitlines()[0].endswith(".")


@pytest.mark.parametrize("name", EXPORTS)
def test_every_parameter_of_a_function_is_documented(name):
    exported = getattr(socast, name)
    if inspect.isfunction(exported) and exported.__module__.startswith("socast"):
        parameters = set(inspect.signature(exported).parameters)
        assert all(parameter in exported.__doc__ for parameter in parameters)


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="horse"):
        socast.horse  # noqa: B018


def test_importing_effect_loads_no_heavy_library():
    code = "import sys; from socast import effect; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stdout.split())


def test_tables_equal_those_of_the_command(tables, shift_tables):
    written = socast.read_tables(shift_tables)
    pd.testing.assert_frame_equal(tables.rides, written.rides, check_dtype=False)
    pd.testing.assert_frame_equal(tables.windows, written.windows, check_dtype=False)


def test_samples_are_as_sent(tables):
    samples = socast.read_samples(SHIFT)
    assert len(samples) == tables.quality["received"]["telemetry"] + tables.quality["duplicates"]
    assert samples["speed"].max() > 900.0 / 3.6
    assert samples["vehicle_id"].nunique() == 7


def test_pipeline_gives_forecasts_as_table():
    pipeline = socast.Pipeline(socast.load_model("extended_physical"))
    forecasts = socast.read_forecasts(pipeline.push(list(socast.read_messages(SHIFT))))
    assert {"vehicle_id", "soc_pct", "ride_energy_predicted_kwh"} <= set(forecasts)
    assert len(forecasts) > 100


def test_prediction_has_the_index_of_the_rides(tables):
    rides = tables.rides.iloc[::-1]
    energy = socast.load_model("extended_physical").predict(rides)
    assert list(energy.index) == list(rides.index)
    assert energy.corr(rides["energy_kwh"]) > 0.9


def test_version_is_that_of_the_distribution():
    assert socast.__version__ == version("socast")


def test_model_round_trip(tables, tmp_path):
    model = socast.fit_model(tables.rides, "basic_physical")
    socast.save_model(model, tmp_path / "model.json")
    assert socast.load_model(tmp_path / "model.json") == model


def test_loop_of_diagnosis_lowers_the_error(autumn_tables):
    rides, windows, _ = socast.read_tables(autumn_tables)
    base = socast.fit_model(rides, "road_load", windows)
    diagnosis = socast.diagnose(rides, windows, base)
    assert diagnosis.missing[0].effect == "headwind"
    assert diagnosis.data.held_out.rides == len(rides) - diagnosis.data.rides > 0
    quick = socast.load_model("extended_physical")  # without priors it is refitted in no time
    added = socast.add_effect(quick, "headwind", rides, windows)
    assert added.accepted
    assert added.errors["mae_after_kwh"].iloc[0] < added.errors["mae_before_kwh"].iloc[0]
    refused = socast.add_effect(added.model, "demisting", rides, windows)
    assert not refused.accepted
    assert refused.model is added.model
    compared = socast.compare_models(rides, {"before": quick, "with": added.model})
    for result in (diagnosis, added, refused, compared):
        assert "<table>" in result._repr_html_()
        assert_axes_are_titled(result.plot())
    assert diagnosis.headline
    assert diagnosis.next_step[0] == "Add headwind in all cars."
    before, after = compared.errors["mae_kwh"]
    assert after < before
    assert compared.worst_rides["model"].tolist() == ["before"] * 10 + ["with"] * 10
    assert "base" in socast.trace_ride(rides, windows, rides["ride_key"].iloc[0], {"base": base}).models
    assert socast.compare_datasets(rides, rides, {"base": base}).shared == len(rides)


def test_evaluations_have_dataframes_figures_and_tables(tables):
    of_recipes = socast.evaluate_recipes(tables.rides, ["basic_physical"], repeats=2)
    of_charge = socast.evaluate_soc_forecasts(SHIFT)
    for result in (of_recipes, of_charge):
        assert len(result.errors) > 0
        assert "<table>" in result._repr_html_()
        assert "[" in result.plot().layout.xaxis.title.text
        assert result.to_json()


def test_simulated_fleet_is_a_recording_with_its_truth(tmp_path):
    summary = socast.simulate_fleet(tmp_path / "fleet.mcap", vehicles=1, shift_hours=0.5, seed=3)
    assert summary["messages"] == sum(1 for _ in socast.read_messages(tmp_path / "fleet.mcap"))
    assert (tmp_path / "fleet.truth.json").exists()


def test_change_after_a_date_needs_days_on_both_sides(tables):
    model = socast.load_model("extended_physical")
    with pytest.raises(socast.ModelError, match="1 date, and a condition takes 6: give more days"):
        socast.compare_before_after(tables.rides, model, ["taxi-001"], date(2018, 1, 17))
