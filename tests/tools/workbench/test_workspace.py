"""What the command line gave: tables or recordings, models in a folder, and files of effects that change."""

import shutil

import pytest

from socast.core import effects, models
from socast.core.errors import ModelError, SettingsError
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.loop import causes
from socast.tools.workbench.loop import models as model_records
from socast.tools.workbench.workspace import Given, Workspace
from tests.support.paths import ROOT
from tests.support.planted_windows import base_model, planted

pytestmark = pytest.mark.usefixtures("_checks_here")
OWN = '''"""An effect of one's own."""

from socast import effect


@effect(coefficient="force", unit="N", low=0, high=1000, source="nobody")
def {name}(speed):
    """Something that drags: P = F v."""
    return speed
'''


@pytest.fixture
def tables(tmp_path):
    """A folder of tables in which cold tyres are planted, with a base model beside it."""
    rides, windows = planted({"effect_cold_rolling": 1e-4})
    folder = tmp_path / "tables"
    folder.mkdir()
    rides.to_parquet(folder / "rides.parquet")
    windows.to_parquet(folder / "windows.parquet")
    models.save(base_model(rides), tmp_path / "base.json")
    return folder


@pytest.fixture
def own(tmp_path):
    """A file with an effect, which the test forgets at its end."""
    file = tmp_path / "mine.py"
    file.write_text(OWN.format(name="my_drag"), encoding="utf-8")
    effects.load_file(file)
    yield file
    if file.exists():  # the library is shared by all tests
        file.write_text(OWN.format(name="my_drag"), encoding="utf-8")
    for registered in [name for name, path in effects.registry._brought_by.items() if path == file]:
        del effects.registry._library[registered], effects.registry._brought_by[registered]


def test_models_of_a_folder_form_the_same_tree_again(tables, tmp_path):
    given = Given(RideSource((tables,)), models=(str(tmp_path / "base.json"),), folder=tmp_path / "kept")
    first = Workspace(given)
    first.open()
    added = causes.add_to_model(first, "base", "cold_rolling")
    assert added["added"]
    first.close()
    again = Workspace(given)
    again.open()
    assert [(node.name, node.parent) for node in again.models.list_nodes()] == [
        ("base", ""),
        ("base-cold_rolling", "base"),
    ]
    assert again.get_node().path == str(tmp_path / "base.json")
    assert not again.is_temporary


def test_temporary_models_are_removed_at_the_end(tables, tmp_path):
    workspace = Workspace(Given(RideSource((tables,)), models=(str(tmp_path / "base.json"),)))
    workspace.open()
    assert workspace.models.folder.is_dir()
    workspace.close()
    assert not workspace.models.folder.exists()


def test_shadow_of_tables_is_refused(tables, tmp_path):
    workspace = Workspace(Given(RideSource((tables,)), models=(str(tmp_path / "base.json"),)))
    workspace.open()
    node = workspace.get_node()
    with pytest.raises(SettingsError, match="tables were given"):
        model_records.run_shadows(workspace, node, node)
    workspace.close()


def test_too_few_rides_for_a_fit_take_a_built_in_model():
    workspace = Workspace(Given(RideSource((ROOT / "recordings/shift.mcap",))))
    workspace.open()
    assert workspace.is_ready
    assert "built-in model" in workspace.notes[0] or workspace.get_node().origin == "fitted"
    workspace.close()


def test_workspace_without_rides_says_how_to_give_some():
    workspace = Workspace(Given())
    workspace.open()
    assert not workspace.is_ready
    with pytest.raises(SettingsError, match="socast serve RECORDING"):
        _ = workspace.tables
    workspace.close()


def test_unreadable_model_is_kept_as_the_problem(tables, tmp_path):
    workspace = Workspace(Given(RideSource((tables,)), models=(str(tmp_path / "none.json"),)))
    with pytest.raises(ModelError):
        workspace.open()
    assert "none.json" in workspace.describe()["problem"]
    workspace.close()


def test_changed_file_of_effects_gives_new_tables(own, tmp_path):
    recording = tmp_path / "shift.mcap"
    shutil.copy(ROOT / "recordings/shift.mcap", recording)
    workspace = Workspace(Given(RideSource((recording,), effect_files=(own,))))
    workspace.open()
    assert "effect_my_drag" in workspace.tables.windows
    assert not workspace.effects.has_changed
    own.write_text(OWN.format(name="my_other_drag"), encoding="utf-8")
    assert workspace.effects.has_changed
    assert workspace.read_effects_again() == {"effects": ["my_other_drag"], "made": True}
    assert "effect_my_other_drag" in workspace.tables.windows
    assert workspace.tables.version == 2
    workspace.close()


def test_error_of_a_changed_file_is_shown_at_its_line(own, tables, tmp_path):
    workspace = Workspace(Given(RideSource((tables,), effect_files=(own,)), models=(str(tmp_path / "base.json"),)))
    workspace.open()
    own.write_text("from socast import effect\n\nthis is not Python\n", encoding="utf-8")
    workspace.read_effects_again()
    record = workspace.effects.list_records()[0]
    assert record["error"]["line"] == 3
    assert record["error"]["lines"][2] == "this is not Python"
    assert [effect["name"] for effect in record["effects"]] == ["my_drag"]
    workspace.close()


def test_tables_that_lack_an_effect_name_it(own, tables, tmp_path):
    workspace = Workspace(Given(RideSource((tables,), effect_files=(own,)), models=(str(tmp_path / "base.json"),)))
    workspace.open()
    assert workspace.describe()["lacking"] == ["my_drag"]
    assert workspace.read_effects_again() == {"effects": [], "made": False}
    workspace.close()
