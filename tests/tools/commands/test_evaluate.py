"""`socast evaluate` prints and writes its tables, and refuses invalid input in one line."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from socast.core.fit import segment_network
from socast.tools.cli import main
from socast.tools.commands.evaluate import window_columns
from socast.tools.terminal.output import check_outputs
from socast.tools.terminal.table_files import read
from tests.support import planted_rides
from tests.support.segment_windows import segment_windows

pytestmark = pytest.mark.long
QUICK = ("--recipes", "basic_physical,empirical", "--repeats", "2", "--jobs", "1")


def fleet(n=240, models=planted_rides.MODELS[:2]):
    table = planted_rides.rides(n, 2, models)
    table = table.assign(start_s=table["start_s"] + np.arange(n), ride_key=[f"car#{i}" for i in range(n)])
    return planted_rides.noisy(table, planted_rides.physical_energy(table))


@pytest.fixture
def folder(tmp_path):
    fleet().to_parquet(tmp_path / "rides.parquet")
    return tmp_path


def ran(capsys, *arguments):
    """Return what a command prints."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in ("evaluate", *arguments)])
    printed = capsys.readouterr()
    assert not ended.value.code, printed.err
    return printed.out


def refused(capsys, *arguments):
    """Return the one line of a command that is refused."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in ("evaluate", *arguments)])
    message = capsys.readouterr().err
    assert ended.value.code == 2
    assert re.fullmatch(r"socast: [^\n]+\n", message), message
    return message


def test_evaluation_is_printed_and_written(folder, capsys):
    out = ran(capsys, folder, *QUICK, "--json", folder / "e.json", "--html", folder / "e.html", "--seed", "3")
    assert "Learned Empirical Model" in out
    result = json.loads((folder / "e.json").read_text())
    assert result["about"]["seed"] == 3
    assert result["about"]["repeats"] == 2
    assert result["about"]["seconds"] > 0
    assert set(result["mae"]) == {"basic_physical", "empirical"}
    assert result["reduction"]["empirical"]["average"] > 0.3
    for part in ("new_vehicle", "dominates", "coverage", "buffer_kwh"):
        assert part in result
    page = (folder / "e.html").read_text()
    assert "Learned Empirical Model" in page


def test_vehicle_model_left_out_of_training_is_recorded(folder, capsys):
    fleet(models=planted_rides.MODELS).to_parquet(folder / "rides.parquet")
    out = ran(capsys, folder, *QUICK, "--leave-out-of-training", "nissan-leaf", "--json", folder / "e.json")
    assert json.loads((folder / "e.json").read_text())["about"]["left_out_of_training"] == ["nissan-leaf-2013"]
    assert "Never trained on: Nissan LEAF 2013 SV." in " ".join(out.split())


def test_files_are_accepted_and_several_form_one_table(folder, capsys):
    table = fleet()
    for name, part in (("a", table.iloc[:120]), ("b", table.iloc[120:])):
        (folder / name).mkdir()
        part.to_parquet(folder / name / "rides.parquet")
    ran(capsys, folder / "rides.parquet", *QUICK, "--json", folder / "one.json")
    ran(capsys, folder / "b", folder / "a", *QUICK, "--json", folder / "two.json")
    one, two = (json.loads((folder / name).read_text()) for name in ("one.json", "two.json"))
    one["about"].pop("seconds")
    two["about"].pop("seconds")
    assert one == two


def test_ride_keys_of_several_recordings_are_distinguished(folder):
    files = [folder / "rides.parquet", folder / "rides.parquet"]
    assert read(files)["ride_key"].nunique() == 2 * len(fleet())
    assert read(files[:1])["ride_key"].tolist() == fleet()["ride_key"].tolist()


def test_segment_model_is_evaluated_only_with_windows(folder, capsys):
    frame, rides, _ = segment_windows(240)
    frame.to_parquet(folder / "windows.parquet")
    table = fleet().drop(columns="energy_kwh").merge(rides[["ride_key", "energy_kwh"]], on="ride_key")
    table.to_parquet(folder / "rides.parquet")
    ran(capsys, folder, "--recipes", "basic_physical,segment_network", *QUICK[2:], "--json", folder / "e.json")
    mae = json.loads((folder / "e.json").read_text())["mae"]
    assert set(mae) == {"basic_physical", "segment_network"}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.drop(columns="effect_climbing"), "'effect_climbing' is missing"),
        (lambda t: t.drop(columns="vehicle_id"), "'vehicle_id' is missing"),
        (lambda t: t.head(1), "1 of 1 ride can be evaluated"),
        (lambda t: t.assign(energy_kwh=np.nan), "0 of 240 rides can be evaluated"),
        (lambda t: t.assign(energy_kwh=None), "0 of 240 rides can be evaluated"),
        (lambda t: t.assign(ambient_c="cold"), "holds no numbers"),
    ],
)
def test_table_that_cannot_be_evaluated_is_refused(folder, capsys, spoil, message):
    spoil(fleet()).to_parquet(folder / "rides.parquet")
    assert message in refused(capsys, folder, *QUICK)


def test_one_car_one_day_or_identical_rides_are_evaluated_as_far_as_possible(folder, capsys):
    table = fleet(models=planted_rides.MODELS[:1])
    for alike in (
        {"vehicle_id": "one"},
        {"date": "2018-01-15"},
        {"vehicle_id": "one", "date": "2018-01-15", "ambient_c": 5.0, "duration_s": 600.0, "winter": 1, "summer": 0},
        {name: table[name].iloc[0] for name in table if name.startswith(("effect", "speed", "distance", "duration"))},
    ):
        table.assign(**alike).to_parquet(folder / "rides.parquet")
        ran(capsys, folder, *QUICK, "--json", folder / "e.json")
        assert json.loads((folder / "e.json").read_text())["about"]["notes"]


def test_identical_rides_are_refused_with_reason(folder, capsys):
    table = fleet(models=planted_rides.MODELS[:1])
    first = table.iloc[[0]].drop(columns=["start_s", "ride_id", "ride_key"])
    alike = table[["start_s", "ride_id", "ride_key"]].merge(first, how="cross")
    alike.to_parquet(folder / "rides.parquet")
    message = refused(capsys, folder, "--recipes", "fitted_physical", *QUICK[2:])
    assert "all" in message
    assert "alike" in message


def test_file_that_is_no_table_is_refused(folder, capsys):
    (folder / "x.parquet").write_bytes(b"PAR1 nothing")
    assert "x.parquet: no Parquet table" in refused(capsys, folder / "x.parquet", *QUICK)
    assert "does not exist" in refused(capsys, folder / "y.parquet", *QUICK)
    (folder / "empty").mkdir()
    assert "holds no rides.parquet" in refused(capsys, folder / "empty", *QUICK)
    pd.DataFrame({"ride_key": ["a"]}).to_parquet(folder / "windows.parquet")
    assert "windows.parquet: column 'window' is missing" in refused(capsys, folder, *QUICK)


def test_invalid_options_are_refused(folder, capsys):
    assert "recipe 'horse' is unknown; known are basic_physical" in refused(capsys, folder, "--recipes", "horse")
    assert "needs windows.parquet" in refused(capsys, folder, "--recipes", "segment_network")
    assert "--repeats is 1; give 2 or more" in refused(capsys, folder, "--repeats", "1")
    assert "--jobs is 0; give 1 or more" in refused(capsys, folder, "--jobs", "0")
    assert "--seed is -1; give 0 or more" in refused(capsys, folder, "--seed", "-1")
    message = refused(capsys, folder, *QUICK, "--leave-out-of-training", "horse")
    assert "no ride is of vehicle model 'horse', which is to be left out of training; name some of" in message
    assert "overwritten" in refused(capsys, folder, "--json", folder / "rides.parquet")
    assert "cannot be written" in refused(capsys, folder, "--html", folder / "no" / "e.html")
    assert "/proc/e.html cannot be written" in refused(capsys, folder, "--html", "/proc/e.html")
    assert "/proc/version cannot be written" in refused(capsys, folder, "--json", "/proc/version")


def test_check_of_outputs_changes_no_file(tmp_path):
    kept, new = tmp_path / "kept.json", tmp_path / "new.json"
    kept.write_text("[]")
    check_outputs([], kept, new)
    assert kept.read_text() == "[]"
    assert not new.exists()


def test_only_feature_columns_of_windows_are_read(folder):
    names = {name for product in segment_network.SEGMENT_FEATURES for name in product} | {"ride_key", "window"}
    frame, _, _ = segment_windows(20)
    frame.assign(energy_vi_kwh=1.0).to_parquet(folder / "windows.parquet")
    assert set(read([folder / "windows.parquet"], window_columns())) == names
