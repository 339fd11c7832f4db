"""Several models are loaded once each, and their errors appear in text, tables, JSON and Zenoh messages."""

import io
import json
import logging
from pathlib import Path
from shutil import copyfile

import msgspec
import pandas as pd
import pytest
from rich.console import Console

from socast.core import models
from socast.core.errors import ModelError
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL, Training
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Gain, ModelErrors, RideErrors
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.tools.terminal.live_service import RideLog
from socast.tools.terminal.live_table import LiveTable, make_fleet_table
from socast.tools.terminal.model_comparison import (
    advise_fit,
    describe_gain,
    find_models,
    load_models,
    make_log_fields,
    make_models_table,
    warn_of_training_days,
)
from tests.support.commands import called, refused
from tests.support.live_consumers import consumers, logged
from tests.support.paths import RECORDINGS
from tests.support.recorded_shift import shift
from tests.support.zenoh_sessions import eventually

BOTH = ("--model", "extended_physical", "--model", "basic_physical")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("standings") / "shift.mcap"
    with McapSink(path, 20_000) as sink:
        sink.put(shift())
    return path


@pytest.fixture
def consumer(tmp_path):
    with consumers(tmp_path) as start:
        yield start


def gain(lower, upper, verdict, mean=0.0524):
    return Gain(rides=1214, vehicle_days=31, mean_kwh=mean, lower_kwh=lower, upper_kwh=upper, verdict=verdict)


def make_errors(gain_of_model, **fields):
    rides = RideErrors(
        vehicle_model=None,
        rides=1300,
        unpredicted_rides=2,
        mae_kwh=0.25,
        mae_pct=12.5,
        bias_kwh=-0.1,
        gain=gain_of_model,
    )
    rides = msgspec.structs.replace(rides, **fields)
    part = msgspec.structs.replace(rides, vehicle_model="nissan-leaf-2013", rides=7)
    return ModelErrors(model="cold/2", first="warm/1", time_s=0.0, overall=rides, by_vehicle_model=[part])


@pytest.mark.parametrize(
    ("difference", "words"),
    [
        (gain(None, None, "undecided", None), "undecided:"),
        (gain(None, None, "undecided"), "undecided:"),
        (gain(-0.01, 0.0724, "undecided"), "undecided:"),
        (gain(0.0312, 0.0731, "better"), "better than the first by 0.052 kWh per ride (0.031 to 0.073), over"),
        (
            gain(-0.0731, -0.0312, "worse", -0.0524),
            "worse than the first by 0.052 kWh per ride (0.031 to 0.073), over",
        ),
    ],
)
def test_gain_is_described_in_words(difference, words):
    assert describe_gain(difference) == f"{words} 1,214 rides of 31 vehicle-days"


def printed(what, width=120) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(what)
    return console.file.getvalue()


def test_table_has_row_per_model_and_optional_rows_per_vehicle_model():
    errors = [make_errors(None), make_errors(gain(0.0312, 0.0731, "better"))]
    short = printed(make_models_table(errors, wide=False), 80)
    long = printed(make_models_table(errors, wide=True, by_vehicle_model=True), 112)
    assert "nissan-leaf-2013" not in short
    assert long.count("nissan-leaf-2013") == 2
    for figure in ("cold/2", "1,300", "0.250", "0.052 (0.031 to 0.073)", "better"):
        assert figure in short
        assert figure in long
    assert {"12.5", "−0.100", "31"} <= set(long.split())
    assert "–" in printed(make_models_table([make_errors(None, mae_kwh=None)], wide=False)).split()


def test_log_line_has_figures_with_units_and_no_unknown_values():
    fields = make_log_fields(make_errors(gain(None, None, "undecided", None)))
    assert fields["model"] == "cold/2"
    assert (fields["mae_kwh"], fields["gain_vehicle_days"], fields["gain_verdict"]) == (0.25, 31, "undecided")
    assert None not in fields.values()
    assert "gain" not in make_log_fields(make_errors(None))


def test_warning_names_rides_of_training_days():
    training = Training(rides=9, first_date="2018-01-02", last_date="2018-01-03", vehicle_models={}, fingerprint="")
    fitted = msgspec.structs.replace(EXTENDED_PHYSICAL, name="fitted", training=training)
    rides = pd.DataFrame({"date": ["2018-01-01", "2018-01-02", "2018-01-03", "2018-01-04"]})
    (warning,) = warn_of_training_days([BASIC_PHYSICAL, fitted], rides)
    assert warning.startswith("fitted/1 was fitted to rides from 2018-01-02 to 2018-01-03; 2 of these 4 rides")
    assert warn_of_training_days([fitted], rides[3:]) == []


def test_models_are_loaded_by_name_and_default_without_name():
    assert load_models(None) == load_models([]) == [EXTENDED_PHYSICAL]
    assert load_models(["basic_physical", "extended_physical"]) == [BASIC_PHYSICAL, EXTENDED_PHYSICAL]
    with pytest.raises(ModelError, match="oracle"):
        load_models(["basic_physical", "oracle"])


@pytest.mark.parametrize("command", [["replay", "{rec}"], ["live", "--listen", "tcp/127.0.0.1:0"]])
def test_same_model_twice_is_refused_in_one_line(command, recording, tmp_path, capsys):
    for name in ("one.json", "copy.json"):
        models.save(BASIC_PHYSICAL, tmp_path / name)
    arguments = [argument.format(rec=recording) for argument in command]
    message = refused(capsys, *arguments, "--model", tmp_path / "one.json", "--model", tmp_path / "copy.json")
    assert f"basic_physical/{models.stamp(BASIC_PHYSICAL).version} is given twice" in message


def test_replay_of_several_models_reports_errors_of_each(recording, tmp_path):
    out, err, code = called("replay", recording, *BOTH, "--out", tmp_path / "f.mcap", "--json", tmp_path / "both.json")
    assert (code, err) == (0, "")
    called("replay", recording, "--json", tmp_path / "one.json")
    both, one = (json.loads((tmp_path / name).read_text()) for name in ("both.json", "one.json"))
    shadows = [ride.pop("shadows_kwh") for ride in both["rides"]]
    assert (both["rides"], both["shifts"]) == (one["rides"], one["shifts"])
    assert all(list(shadow) == ["basic_physical/1"] for shadow in shadows)
    assert [of_model["model"] for of_model in both["models"]] == ["extended_physical/1", "basic_physical/1"]
    fit = [(ride, shadow) for ride, shadow in zip(both["rides"], shadows, strict=True) if ride["fit_for_training"]]
    off = [abs(shadow["basic_physical/1"] - ride["energy_kwh"]) for ride, shadow in fit]
    assert both["models"][1]["overall"]["mae_kwh"] == pytest.approx(sum(off) / len(off))
    assert both["models"][1]["overall"]["gain"]["vehicle_days"] == 3
    assert "basic_physical/1" in out
    assert "basic_physical/1: undecided: 9 rides of 3 vehicle-days" in out
    kept = [message for block in McapSource(tmp_path / "f.mcap") for message in block]
    assert json.loads(kept[-1].payload) == both["models"][1]
    out, _, code = called("info", tmp_path / "f.mcap", "--json", tmp_path / "info.json")
    assert code == 0
    (about,) = json.loads((tmp_path / "info.json").read_text())["recordings"]
    assert about["vehicles"] == ["car-0", "car-1", "car-2"]
    assert about["kinds"]["errors"] == 20
    out, _, code = called("replay", tmp_path / "f.mcap")
    assert code == 0
    assert "could not be decoded" not in out


def test_live_publishes_errors_of_each_model_and_continues_after_restart(consumer, recording, tmp_path):
    heard: list[tuple[str, bytes]] = []
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    process, log = consumer("--listen", endpoint, *BOTH, "--state", tmp_path / "state", "--report", "0.05")
    with Node(Connection(connect=(endpoint,))) as node:
        keep = lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes()))  # noqa: E731
        with node.session.declare_subscriber("models/**", keep):
            called("replay", recording, "--connect", endpoint, "--speed", "max")
            assert eventually(
                lambda: any(make_log_fields.get("messages") == len(shift()) for make_log_fields in logged(log))
            )
            assert eventually(lambda: len({key for key, _ in heard}) == 2)
            process.terminate()
            assert process.wait(20) == 0
    newest = {key: json.loads(payload) for key, payload in heard}
    assert set(newest) == {"models/extended_physical/1/errors", "models/basic_physical/1/errors"}
    assert newest["models/basic_physical/1/errors"]["overall"]["rides"] == 6
    lines = logged(log)
    assert [make_log_fields["model"] for make_log_fields in lines if make_log_fields["event"] == "model"] == [
        "extended_physical/1",
        "basic_physical/1",
    ]
    assert all(
        "shadows_kwh.basic_physical/1" in make_log_fields
        for make_log_fields in lines
        if make_log_fields["event"] == "ride"
    )
    again = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    again.restore((tmp_path / "state").read_bytes())
    assert again.shadows.errors()[1].overall.rides == 6


def test_change_of_verdict_is_logged_once(monkeypatch):
    logger, records = logging.getLogger("test_standings"), []
    logger.setLevel(logging.INFO)
    logger.addFilter(lambda record: records.append(record) or False)
    monkeypatch.setattr("socast.tools.terminal.live_service._log", logger)
    pipeline = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    now = [0.0]
    rides = RideLog(pipeline, lambda: now[0])
    for turn in range(4):
        for i in range(20):
            pipeline.shadows.monitors[1]._all.add_cluster(5, 1.0 + 0.1 * (i % 5))
        now[0] += 10.0
        rides(Tally())
        assert len(records) == 1, turn
    assert records[0].getMessage() == "verdict"
    assert records[0].fields["gain_verdict"] == "better"
    assert records[0].fields["gain_vehicle_days"] == 20


def test_live_table_has_column_per_shadow_and_models_below():
    pipeline = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    pipeline.push(shift())
    assert "by 2" in printed(make_fleet_table(pipeline.status(), "Live", "", 20, 1))
    assert "by 2" not in printed(make_fleet_table(pipeline.status(), "Live", "", 20))
    console = Console(file=io.StringIO(), width=120, height=40, force_terminal=True)
    for shows_models in (False, True):
        clock = iter(range(0, 100, 10)).__next__
        with LiveTable(pipeline, "Live", console=console, shows_models=shows_models, clock=clock) as screen:
            screen(Tally(received=1, seconds=1.0))
        shown = console.file.getvalue()
        assert ("basic_physical/1" in shown, "by 2" in shown) == (shows_models, shows_models)
        assert "car-2" in shown


def test_fitted_model_beside_the_recordings_is_used_unless_others_are_named(tmp_path):
    assert find_models(None, tmp_path) == []
    fitted = copyfile(RECORDINGS / "fitted.json", tmp_path / "fitted.json")
    assert find_models(None, tmp_path) == [str(fitted)]
    assert find_models(["basic_physical"], tmp_path) == ["basic_physical"]
    assert find_models(None, None) == []


def test_catalogue_model_says_what_fitting_would_bring():
    (fitted,), (catalogue,) = load_models([str(RECORDINGS / "fitted.json")]), load_models(None)
    assert advise_fit(fitted, "kept") is None
    assert advise_fit(catalogue, "kept", "kept/").endswith("socast fit kept --recipe road_load -o kept/fitted.json")
