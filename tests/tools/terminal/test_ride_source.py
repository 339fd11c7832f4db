"""Test the source of rides: one recording gives the same rides in every command, with the same options."""

import json
from pathlib import Path

import pandas as pd
import pytest

from socast.core.errors import SettingsError
from socast.tools.terminal.cleaning_options import make_settings
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.loop.command_lines import compare_command, diagnose_command, list_fit_commands
from socast.tools.workbench.workspace import Given, Workspace
from tests.support.commands import called
from tests.support.paths import RECORDINGS

pytestmark = pytest.mark.long

SHIFT = RECORDINGS / "shift.mcap"
CLEANING = ("--speed-limit-kmh", "80", "--least-distance-km", "1.5")
COMMANDS = frozenset({"command", "commands"})


@pytest.fixture(scope="module")
def elevation(tmp_path_factory) -> Path:
    """Return a map of the elevation of the streets of the shift."""
    file = tmp_path_factory.mktemp("map") / "city.parquet"
    assert called("elevation", "learn", SHIFT, "-o", file)[2] == 0
    return file


@pytest.fixture(scope="module")
def tables(tmp_path_factory, elevation) -> Path:
    """Return the folder of tables of the shift, made with the map and settings."""
    folder = tmp_path_factory.mktemp("tables") / "shift"
    assert called("tables", SHIFT, "--out", folder, "--elevation", elevation, *CLEANING)[2] == 0
    return folder


def without_commands(value):
    """Return a report without the commands that it shows, which name what was given."""
    if isinstance(value, dict):
        return {name: without_commands(each) for name, each in value.items() if name not in COMMANDS}
    if isinstance(value, list):
        return [without_commands(each) for each in value if not str(each).startswith("socast ")]
    return value


def test_rides_of_a_recording_are_those_of_tables_made_with_the_same_options(elevation, tables):
    settings = make_settings(speed_limit_kmh=80.0, least_distance_km=1.5)
    made, read = RideSource([SHIFT], settings, [elevation]).read(), RideSource([tables]).read()
    plain = RideSource([SHIFT]).read()
    for one, other in zip(made, read, strict=True):
        shared = [name for name in other if name in one]
        pd.testing.assert_frame_equal(one[shared], other[shared], check_dtype=False)
    assert not made[0]["gained_m"].equals(plain[0]["gained_m"])


@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_report_on_a_recording_is_that_on_its_tables(tmp_path, elevation, tables, command):
    reports = []
    for number, data in enumerate(([SHIFT, "--elevation", elevation, *CLEANING], [tables])):
        file = tmp_path / f"{number}.json"
        _, error, code = called(command, *data, "--model", "extended_physical", "--json", file)
        assert code == 0, error
        reports.append(without_commands(json.loads(file.read_text())))
    assert reports[0] == reports[1]


def test_model_fitted_to_a_recording_is_that_fitted_to_its_tables(tmp_path, elevation, tables):
    files = [tmp_path / "one.json", tmp_path / "other.json"]
    data = [SHIFT, "--elevation", elevation, *CLEANING], [tables]
    for file, given in zip(files, data, strict=True):
        assert called("fit", *given, "--recipe", "road_load", "-o", file)[2] == 0
    one, other = (json.loads(file.read_text()) for file in files)
    assert one["fits"] == other["fits"]


def test_options_that_clean_are_refused_beside_tables(tables, elevation):
    for command in ("compare", "diagnose", "evaluate"):
        model = () if command == "evaluate" else ("--model", "extended_physical")
        _, error, code = called(command, tables, *model, "--elevation", elevation)
        assert (code, "--elevation cleans recordings" in error) == (2, True)


def test_pages_show_commands_that_read_the_rides_as_the_workbench_does(elevation):
    settings = make_settings(speed_limit_kmh=80.0)
    workspace = Workspace(Given(RideSource([SHIFT], settings, [elevation])))
    workspace.open()
    node, options = workspace.models.first, f"--elevation {elevation} --speed-limit-kmh 80"
    assert options in compare_command(workspace, [node])
    assert options in diagnose_command(workspace, node)
    assert options in list_fit_commands(workspace, node)[0]
    expected = RideSource([SHIFT], settings, [elevation]).read()[0]
    assert workspace.tables.rides["gained_m"].equals(expected["gained_m"])
    workspace.close()


def test_recordings_and_tables_are_not_mixed(tables):
    with pytest.raises(SettingsError, match="give recordings or tables, not both"):
        RideSource([SHIFT, tables]).check()


def test_words_name_every_option():
    source = RideSource(
        [Path("a b.mcap")], make_settings(smoothing=3), [Path("m.tif")], [Path("e.py")], [Path("v.toml")]
    )
    assert source.list_words() == [
        *("a b.mcap", "--effects", "e.py", "--vehicles", "v.toml", "--elevation", "m.tif", "--smoothing", "3"),
    ]
