"""`socast vehicles` describes cars that the catalogue lacks, and other commands take them."""

import json

from socast.core.vehicles import catalogue
from socast.tools.terminal.live_table import describe_unknown_models
from tests.support.commands import called, done, refused
from tests.support.own_tables import abrp


def make_recording(folder, *options):
    """Import a table of a car of the model `my-van` and return the recording and the output."""
    map_file = folder / "map.toml"
    file = abrp(folder / "car.csv")
    done("import", "csv", file, "--guess", "--map", map_file)
    printed, errors, code = called(
        "import", "csv", file, "--map", map_file, "--vehicle-model", "my-van", "-o", folder / "a.mcap", *options
    )
    assert code == 0, errors
    return folder / "a.mcap", printed


def test_new_data_sheet_passes_its_check_and_is_listed(tmp_path):
    file = tmp_path / "my-van.toml"
    done("vehicles", "new", file, "--mass-kg", 2100, "--capacity-kwh", 75, "--drag-area-m2", 1.1)
    printed, _, code = called("vehicles", "check", file)
    assert (code, "usual values of the catalogue: frontal_area_m2" in printed) == (0, True)
    printed, _, _ = called("vehicles", "list", "--vehicles", file, "--json", "-")
    vehicles = {each["key"]: each for each in json.loads(printed)["vehicles"]}
    assert vehicles["my-van"]["mass_kg"] == 2100
    assert "nissan-leaf-2013" in vehicles


def test_a_drag_area_that_was_given_has_no_tilde(tmp_path):
    figures = "--mass-kg", 2100, "--capacity-kwh", 75
    printed, _, _ = called("vehicles", "new", tmp_path / "van.toml", "--drag-area-m2", 0.71, *figures)
    assert " 0.71 " in printed
    printed, _, _ = called("vehicles", "new", tmp_path / "bus.toml", *figures)
    assert "~0." in printed.split("bus")[1].split()[2]


def test_recording_with_a_data_sheet_is_predicted_without_the_file(tmp_path):
    file = tmp_path / "my-van.toml"
    done("vehicles", "new", file, "--mass-kg", 1600, "--capacity-kwh", 40)
    recording, printed = make_recording(tmp_path, "--vehicles", file)
    assert "% of the nominal capacity" in printed
    catalogue._OWN.clear()
    printed, _, code = called("replay", recording)
    assert (code, "is not in the catalogue" in printed) == (0, False)


def test_unknown_model_is_named_with_the_remedy(tmp_path):
    _, printed = make_recording(tmp_path)
    assert "the vehicle model 'my-van' is not in the catalogue" in printed
    assert "`socast vehicles new`" in printed
    assert "`socast vehicles new` and give the file with --vehicles" in describe_unknown_models({"horse": ["a"]})[0]


def test_wrong_calls_are_refused_in_one_line(tmp_path, capsys):
    file = tmp_path / "van.toml"
    figures = ["--mass-kg", 2100, "--capacity-kwh", 75]
    assert "mass_kg 21 is outside" in refused(capsys, "vehicles", "new", file, "--mass-kg", 21, "--capacity-kwh", 75)
    assert not file.exists()
    assert "--key is 'a b'" in refused(capsys, "vehicles", "new", file, "--key", "a b", *figures)
    file.write_text("")
    assert "is there already" in refused(capsys, "vehicles", "new", file, *figures)
    assert "holds no vehicle" in refused(capsys, "vehicles", "check", file)
    assert "cannot be read" in refused(capsys, "vehicles", "list", "--vehicles", tmp_path / "none.toml")
