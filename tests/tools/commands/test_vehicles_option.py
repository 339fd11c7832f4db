"""A car that sends only the name of its model is predicted where `--vehicles` gives its data sheet.

`live`, `serve`, `diagnose`, `fit` and the diagnosis of the night take the option; without it no energy is predicted.
"""

import json
from contextlib import ExitStack
from math import inf
from types import SimpleNamespace

import pandas as pd
import pytest

from socast.core.settings import Settings
from socast.core.vehicles import catalogue
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.stream.memory import MemorySink
from socast.tools.commands import live
from socast.tools.terminal import night_watch
from socast.tools.terminal.forecast_options import ForecastOptions
from socast.tools.terminal.live_service import LiveOptions, start_service
from socast.tools.terminal.night_watch import make_nightly_diagnosis, name_condition_files
from tests.support import own_tables
from tests.support.commands import called, done, refused
from tests.support.players import wait_until_there

pytestmark = pytest.mark.long
RIDES = 24


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Return a folder with a recording of a car that names its model only, and with the data sheet of that model."""
    folder = tmp_path_factory.mktemp("van")
    parts = []
    for ride in range(RIDES):
        file = own_tables.abrp(folder / "ride.csv", start=own_tables.START + (ride // 3) * 86400 + (ride % 3) * 7200)
        parts.append(pd.read_csv(file).iloc[100 + 20 * ride : 300 + 20 * ride])
    table = folder / "van.csv"
    pd.concat(parts).to_csv(table, index=False)
    (folder / "kept").mkdir()
    recording = folder / "kept" / "van.mcap"
    done("import", "csv", table, "--guess", "--vehicle-model", "my-van", "-o", recording)
    done("vehicles", "new", folder / "my-van.toml", "--mass-kg", 1600, "--capacity-kwh", 40)
    catalogue._OWN.clear()
    return SimpleNamespace(folder=folder, recording=recording, sheet=folder / "my-van.toml", kept=folder / "kept")


def test_fit_and_diagnosis_take_the_data_sheet(fleet, tmp_path):
    done("tables", fleet.recording, "--vehicles", fleet.sheet, "--out", tmp_path / "tables")
    catalogue._OWN.clear()
    done(
        "fit",
        tmp_path / "tables",
        "--recipe",
        "road_load_constant",
        "-o",
        tmp_path / "van.json",
        "--vehicles",
        fleet.sheet,
    )
    fit = json.loads((tmp_path / "van.json").read_text())["fits"]
    assert "my-van" in fit
    catalogue._OWN.clear()
    report = tmp_path / "found.json"
    words = ("diagnose", fleet.recording, "--model", tmp_path / "van.json", "--json", report)
    _, errors, code = called(*words, "--vehicles", fleet.sheet)
    assert code == 0, errors
    assert json.loads(report.read_text())["data"]["rides"] >= 20
    catalogue._OWN.clear()
    _, errors, code = called(*words)
    assert (code, errors.count("\n")) == (2, 1)


def test_fit_of_a_car_of_unknown_model_names_the_remedy(fleet, tmp_path, capsys):
    done("tables", fleet.recording, "--out", tmp_path / "tables")
    capsys.readouterr()
    for recipe in ("road_load_constant", "fitted_physical"):
        message = refused(capsys, "fit", tmp_path / "tables", "--recipe", recipe, "-o", tmp_path / "van.json")
        assert "some are of cars whose vehicle model is unknown; name it as you import (--vehicle-model" in message


def test_diagnosis_of_the_night_takes_the_data_sheet_and_the_events(fleet, tmp_path, monkeypatch):
    jobs = []
    monkeypatch.setattr(night_watch, "DiagnosisProcess", lambda arguments: jobs.append(arguments) or SimpleNamespace())
    options = ForecastOptions(["basic_physical"], (), (fleet.sheet,), Settings(), "", (), ())
    midnight = SimpleNamespace(day_rollover=SimpleNamespace(midnight=86_400.0))
    events = tmp_path / "workshop.csv"
    events.write_text("date,vehicle_id,what\n2017-01-01,nobody,new tyres\n")
    found = tmp_path / "findings.json"
    nightly = make_nightly_diagnosis(options, midnight, MemorySink(), fleet.kept, found, events)
    nightly(Tally())
    midnight.day_rollover.midnight *= 2.0
    nightly(Tally())
    (arguments,) = jobs
    _, errors, code = called("diagnose", *arguments)
    assert code == 0, errors
    assert json.loads(found.read_text())["findings"] is not None
    assert json.loads(name_condition_files(found)[0].read_text())["events_left_out"] == 1  # of an unknown car


def test_live_service_predicts_with_the_data_sheet(fleet, monkeypatch):
    forecasts = []

    def serve_here(options: LiveOptions) -> None:
        with ExitStack() as ending:
            service = start_service(options, ending)
            forecasts.extend(
                service.pipeline.push([message for block in McapSource(fleet.recording) for message in block])
            )

    monkeypatch.setattr(live, "serve", serve_here)
    done("live", "--listen", "tcp/127.0.0.1:0", "--vehicles", fleet.sheet)
    assert any(json.loads(message.payload)["ride_energy_predicted_kwh"] for message in forecasts)


def test_replay_without_the_data_sheet_names_the_unknown_model(fleet):
    printed, errors, code = called("replay", fleet.recording)
    assert code == 0, errors
    assert "the vehicle model 'my-van' of van is not in the catalogue: no energy of theirs is predicted" in " ".join(
        printed.split()
    )


def test_workbench_predicts_with_the_data_sheet(fleet, monkeypatch):
    class PlayingServer:
        """Play the recording to its end in place of serving it."""

        def __init__(self, workbench, *_):
            self.player = workbench.fleet

        def run(self):
            self.player.set_speed(inf)
            self.player.play()
            wait_until_there(self.player)
            shown.update(self.player.board.get_values("van"))

    shown = {}
    monkeypatch.setattr("socast.tools.workbench.server.WorkbenchServer", PlayingServer)
    done("serve", fleet.recording, "--no-browser", "--vehicles", fleet.sheet)
    assert shown["ride_energy_predicted_kwh"] > 0.0
