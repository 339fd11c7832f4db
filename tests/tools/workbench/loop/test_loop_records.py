"""The records of the loop: rides, residuals, causes and models of a recording with a hidden effect."""

import shlex

import numpy as np
import pytest

from socast.core import models
from socast.core.errors import SettingsError
from socast.core.models import EXTENDED_PHYSICAL
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.loop import causes, condition, residuals, rides
from socast.tools.workbench.loop import models as model_records
from socast.tools.workbench.workspace import Given, Workspace
from tests.support.paths import ROOT

pytestmark = pytest.mark.long
AUTUMN = ROOT / "recordings/autumn.mcap"


@pytest.fixture(scope="module")
def workspace():
    opened = Workspace(Given(RideSource((AUTUMN,))))
    opened.open()
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def base(workspace):
    return workspace.get_node()


@pytest.fixture(scope="module")
def quick(workspace):
    """A second model, which has no priors and is quickly refitted."""
    return workspace.models.insert("extended_physical", EXTENDED_PHYSICAL)


@pytest.fixture(scope="module")
def step(workspace, quick):
    """The step that adds the hidden effect."""
    told = []
    record = causes.add_to_model(
        workspace, quick.name, "headwind", report=lambda share, words: told.append((share, words))
    )
    return record | {"told": told}


def test_first_model_is_fitted_and_said_so(workspace, base):
    assert base.name == base.model.recipe == "road_load"
    assert "No model was given" in workspace.notes[0]
    assert base.file.parent == workspace.models.folder


def test_rides_have_every_column_with_its_unit(workspace, base):
    record = rides.describe_compared_rides(workspace, base)
    units = {column["key"]: column["unit"] for column in record["columns"]}
    assert units["ambient_c"] == "°C"
    assert units["vehicle_id"] == ""
    assert {len(values) for values in record["values"].values()} == {len(record["keys"])} == {537}


def test_selection_measures_only_the_filtered_rides(workspace, base):
    every = rides.measure_selection(workspace, base, "")
    cold = rides.measure_selection(workspace, base, "ambient_c:..0;vehicle_id:taxi-001|taxi-002")
    none = rides.measure_selection(workspace, base, "distance_km:500..")
    assert every["errors"]["rides"] == 537
    assert 0 < cold["errors"]["rides"] == len(cold["kept"]) < 537
    assert none["errors"] is None


@pytest.mark.parametrize("text", ["colour:1..2", "ambient_c:cold", "where:on the moon"])
def test_filter_that_is_not_understood_is_refused(workspace, base, text):
    with pytest.raises(SettingsError, match="filter"):
        rides.measure_selection(workspace, base, text)


def test_condition_of_a_slice_filters_rides(workspace, base):
    kept = rides.measure_selection(workspace, base, "where:colder%20than%200%20%C2%B0C")["kept"]
    ambient = np.array(rides.describe_compared_rides(workspace, base)["values"]["ambient_c"])
    assert set(np.flatnonzero(ambient < 0.0)) == set(kept)


def test_trace_follows_a_ride(workspace, base):
    key = rides.describe_compared_rides(workspace, base)["keys"][3]
    trace = rides.trace_one_ride(workspace, [base], key)
    of_model = trace["models"][base.name]
    assert sum(map(sum, of_model["terms"].values())) == pytest.approx(of_model["predicted_kwh"])
    assert shlex.split(trace["command"])[-2:] == ["--ride", key]


def test_residual_falls_along_the_hidden_cause(workspace, base):
    record = residuals.explore_residuals(workspace, base, x="headwind_kmh")
    bins = record["facets"][0]["bins"]
    assert record["unit"] == "W"
    assert bins["mean"][0] > 0.0 > bins["mean"][-1]
    assert sum(bins["rows"]) <= record["rows"]


def test_facets_divide_the_windows(workspace, base):
    record = residuals.explore_residuals(workspace, base, x="ambient_c", colour="vehicle_id", facet="vehicle_id")
    assert [facet["title"] for facet in record["facets"]] == [f"taxi-00{i}" for i in range(1, 6)]
    assert sum(len(facet["points"]["x"]) for facet in record["facets"]) == record["rows"]


def test_category_has_a_mean_for_each_name(workspace, base):
    bins = residuals.explore_residuals(workspace, base, x="vehicle_id", level="rides")["facets"][0]["bins"]
    assert bins["x"] == [f"taxi-00{i}" for i in range(1, 6)]
    assert sum(bins["rows"]) == 537


def test_survey_shows_every_column(workspace, base):
    charts = residuals.survey_residuals(workspace, base, "windows")["charts"]
    assert {"headwind_kmh", "ambient_c", "vehicle_id"} <= {chart["column"]["key"] for chart in charts}


def test_unknown_column_is_refused_with_the_known_ones(workspace, base):
    with pytest.raises(SettingsError, match="choose from"):
        residuals.explore_residuals(workspace, base, x="colour")


def test_diagnosis_names_the_hidden_effect_once_for_each_model(workspace, base):
    diagnosis = workspace.diagnose(base)
    record = causes.describe_causes_of(workspace, base, diagnosis)
    assert record["recommended"] == record["causes"][0]["name"] == "headwind"
    assert record["causes"][0]["credible"]
    assert record["title"] == "headwind is missing in all cars (100 %)"
    assert record["verdict_sentences"][0].strip().startswith("The wind meets")
    chances = [cause["probability"] for cause in record["causes"] if cause["probability"] is not None]
    assert chances == sorted(chances, reverse=True)
    assert record["missing"][0]["command"].startswith("socast add headwind")
    assert workspace.diagnose(base) is diagnosis
    assert residuals.describe_failures(workspace, base, diagnosis)["location"]["sentences"]


def test_condition_is_assessed_once_for_each_model_and_adds_up(workspace, base):
    assert workspace.find_condition(base) is None
    workspace.assess_condition(base)
    record = condition.describe_condition(workspace, base, workspace.find_condition(base))
    assert sorted(car["vehicle_id"] for car in record["cars"]) == [f"taxi-00{n}" for n in range(1, 6)]
    assert record["about"].startswith("537 rides")
    assert [row[0] for row in record["table"]["rows"]] == [car["vehicle_id"] for car in record["cars"]]
    assert record["frame"]["consumption"][0] < 0.0 < record["frame"]["consumption"][1]
    assert all(record["words"])
    parts = sum(share["energy_kwh"]["value"] for share in record["energy"]["shares"])
    assert parts == pytest.approx(record["energy"]["measured"]["energy_kwh"]["value"])
    assert [shlex.split(each)[1] for each in record["commands"]] == ["condition", "waterfall"]
    assert all(car["events"] == [] for car in record["cars"])


def test_known_events_are_in_the_record_of_their_car_and_in_the_commands(tmp_path, autumn_tables):
    file = tmp_path / "workshop.csv"
    file.write_text("date,vehicle_id,what\n2018-11-20,taxi-002,\n2018-11-01,,update\n")
    opened = Workspace(Given(RideSource((autumn_tables,)), ("extended_physical",), events=file))
    opened.open()
    node = opened.get_node()
    opened.assess_condition(node)
    record = condition.describe_condition(opened, node, opened.find_condition(node))
    events = {car["vehicle_id"]: [each["words"] for each in car["events"]] for car in record["cars"]}
    assert events["taxi-001"] == ["update on 1 November 2018 (all cars)"]
    assert events["taxi-002"] == ["update on 1 November 2018 (all cars)", "event on 20 November 2018"]
    assert f"--events {file}" in record["commands"][0]
    assert "--events" not in record["commands"][1]
    opened.close()


def test_any_candidate_shows_its_partial_residual(workspace, base):
    missing, other, unknown = (
        causes.describe_effect(workspace, base, name) for name in ("headwind", "payload", "humidity")
    )
    assert missing["partial_residual"]["slope"] == pytest.approx(1.15, abs=0.2)
    assert other["partial_residual"]["variant"].startswith("payload")
    assert unknown["partial_residual"] is None
    assert "zero in these drives" in unknown["undrawn"]


def test_added_effect_lowers_the_error(step):
    assert step["accepted"]
    assert step["added"]
    assert step["trial"]["mae_after_kwh"] < step["trial"]["mae_before_kwh"]
    assert [share for share, _ in step["told"]] == sorted(share for share, _ in step["told"])
    assert step["after"]["steps"][-1]["effect"] == "headwind"
    assert step["after"]["picture"].startswith("<svg")
    assert not step["before"]["picture"]
    assert {"headwind"} == {c["term"] for c in step["after"]["coefficients"]} - {
        c["term"] for c in step["before"]["coefficients"]
    }


def test_two_models_are_compared_on_the_same_rides(workspace, quick, step):
    record = model_records.compare_two(workspace, quick, workspace.get_node(step["model"]))
    assert record["difference"]["difference_kwh"]["value"] > 0.0
    assert record["command"].count("--model") == 2
    tree = model_records.list_models(workspace)["models"]
    assert [(each["name"], each["parent"]) for each in tree] == [
        ("road_load", ""),
        ("extended_physical", ""),
        ("extended_physical-headwind", "extended_physical"),
    ]


def test_shadow_is_followed_on_the_recording(workspace, quick, step):
    record = model_records.run_shadows(workspace, quick, workspace.get_node(step["model"]))
    first, shadow = (each["overall"]["mae_kwh"] for each in record["models"])
    assert shadow < first


def test_exported_file_is_the_model(workspace, step, tmp_path):
    exported = model_records.export_model(workspace.get_node(step["model"]))
    (tmp_path / exported["file"]).write_text(exported["text"], encoding="utf-8")
    assert models.load(tmp_path / exported["file"]).version == step["after"]["version"]
