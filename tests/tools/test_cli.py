"""The command line answers quickly, reports every error in one line, and ends cleanly on a signal."""

import json
import logging
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import msgspec
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from socast.core.errors import SettingsError
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Forecast
from socast.stream.checkpoints import Checkpoints
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.recorder import list_recordings
from socast.stream.recording_metadata import find_version
from socast.stream.state_file import StateFile
from socast.stream.zenoh_session import find_free_port
from socast.tools.cli import COMMANDS, COMPLETION, application, main
from tests.support.commands import SOCAST, called, refused
from tests.support.live_consumers import consumers, logged
from tests.support.recorded_shift import shift
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "shift.mcap"
    with McapSink(path, 20_000) as sink:
        sink.put(shift())
    return path


HEAVY = {"filterpy", "joblib", "mcap", "numba", "pandas", "pint", "plotly", "scipy", "sklearn", "zenoh"}


@pytest.mark.parametrize(
    ("calls", "not_imported"),
    [
        (["--help", "--version"], {*HEAVY, "numpy", "rich"}),
        (["effects list"], HEAVY),
        (["live --help", "tables --help", "fit --help"], {"filterpy", "joblib", "plotly", "scipy.stats", "sklearn"}),
    ],
)
def test_commands_import_no_package_that_they_do_not_need(calls, not_imported):
    code = (
        "import sys; from socast.tools.cli import main\n"
        f"for call in {[call.split() for call in calls]}:\n"
        "    try: main(call)\n"
        "    except SystemExit as ended: assert ended.code == 0\n"
        f"    print('imported', call, sorted({not_imported} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    imported = [line for line in ended.stdout.splitlines() if line.startswith("imported")]
    assert imported == [f"imported {call.split()} []" for call in calls]


def test_process_ends_without_a_search_for_cycles():
    code = (
        "import atexit, gc; from socast.tools.cli import main\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 0))\n"
        "main(['--version'])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert ended.stdout.splitlines()[-1] == "True"


@pytest.mark.parametrize("width", [80, 120])
def test_help_lists_every_command_with_complete_summary(width):
    shown = CliRunner().invoke(application(), ["--help"], env={"COLUMNS": str(width)}).output
    for name, command in COMMANDS.items():
        assert f"  {name} " in shown
        assert command.summary in shown


@pytest.mark.parametrize(
    ("words", "offered", "not_offered"),
    [
        ("socast ", set(COMMANDS), set()),
        ("socast eval", {"evaluate", "evaluate-soc"}, {"live"}),
        ("socast effects ", {"list", "show", "check", "new"}, {"live"}),
        ("socast live --rec", {"--record", "--record-mb", "--recovery"}, {"--state"}),
        ("socast effects show --", {"--json", "--effects"}, {"--html"}),
    ],
)
def test_shell_completes_commands_subcommands_and_options(words, offered, not_offered, monkeypatch):
    before, _, _ = words.rpartition(" ")
    for name, value in {"WORDS": words, "CWORD": str(len(before.split()))}.items():
        monkeypatch.setenv(f"COMP_{name}", value)
    monkeypatch.setenv(COMPLETION, "complete_bash")
    out, _, _ = called()
    completions = set(out.split())
    assert offered <= completions
    assert not not_offered & completions


def test_completion_is_installed_for_current_shell(tmp_path):
    script = tmp_path / "bash"
    script.write_text(f"#!/bin/bash\n{shlex.join(SOCAST)} --install-completion\n")
    subprocess.run(
        ["bash", script], env=os.environ | {"HOME": str(tmp_path)}, capture_output=True, timeout=60, check=True
    )
    assert COMPLETION in (tmp_path / ".bash_completions" / "socast.sh").read_text()
    assert ".bash_completions/socast.sh" in (tmp_path / ".bashrc").read_text()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_option_is_documented(name):
    group = typer.main.get_command(application(name))
    commands = [group.commands[name]]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        assert command.help, command.name
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"{name}: {parameter.name}"
    loaded = getattr(import_module(COMMANDS[name].module), COMMANDS[name].name)
    assert loaded is not None
    assert COMMANDS[name].summary.endswith(".")


@pytest.mark.parametrize(
    ("call", "usage"),
    [
        ("info", "socast info [OPTIONS] REC..."),
        ("diagnose", "socast diagnose [OPTIONS] TABLES|REC..."),
        ("demo", "socast demo [OPTIONS] [REC]"),
        ("effects check", "socast effects check [OPTIONS] FILE.py"),
        ("live", "socast live [OPTIONS]"),
    ],
)
def test_help_names_arguments_without_braces_and_types(call, usage):
    chosen, *inner = call.split()
    out = CliRunner().invoke(application(chosen), [chosen, *inner, "--help"]).output
    assert out.splitlines()[0] == f"Usage: {usage}"
    assert "list[" not in out
    assert "Path" not in out


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_one_long_name(name):
    commands = [typer.main.get_command(application(name)).commands[name]]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        for parameter in command.params:
            assert sum(option.startswith("--") for option in parameter.opts) <= 1, parameter.name


def help_of(call):
    chosen, *inner = call.split()
    return CliRunner().invoke(application(chosen), [chosen, *inner, "--help"]).output


@pytest.mark.parametrize(
    ("call", "titles"),
    [
        (
            "live",
            "Options, Connection, Models and forecasts, Cleaning, Limits, Recording, Monitoring, Several consumers",
        ),
        ("serve", "Arguments, Options, Models and forecasts, Cleaning, Live service, Web server"),
        ("replay", "Arguments, Options, Models and forecasts, Cleaning"),
        ("diagnose", "Arguments, Options, Cleaning, Cluster"),
        ("simulate", "Options, Fleet, Physics and faults, Cluster"),
        ("bridge ovms", "Options, Rows and their router"),
        ("tables", "Arguments, Options"),
    ],
)
def test_help_divides_many_options_under_titles(call, titles):
    found = re.findall(r"^(\w[\w ]*):$", help_of(call), re.MULTILINE)
    assert ", ".join(found) == titles


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_in_help_fit_80_columns_and_are_whole(name):
    commands = [typer.main.get_command(application(name)).commands[name]]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        examples = command.help.partition("Examples:")[2].splitlines()
        assert [line for line in examples if len(line) > 80] == []
        joined = "\n".join(examples).replace(" \\\n      ", " ")
        assert all(line.startswith("  socast ") or not line for line in joined.splitlines()), joined


def test_version_option_prints_version():
    result = CliRunner().invoke(application(), ["--version"])
    assert re.fullmatch(r"socast \d+\.\d+\.\d+\n", result.output)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("lunch", "no such command 'lunch'; `socast --help`"),
        ("lnfo", "did you mean 'info'? `socast --help`"),
        ("--lunch", "no such option: --lunch; `socast --help`"),
        ("info", "missing argument 'REC...'; `socast info --help`"),
        ("effects show", "missing argument 'E'; `socast effects show --help`"),
        ("simulate", "missing option '--out' / '-o'; `socast simulate --help`"),
        ("replay --speed", "option '--speed' requires an argument; `socast replay --help`"),
        ("ask taxi-7 --distance-km abc", "--distance-km is 'abc', must be a valid number; `socast ask --help`"),
        ("evaluate . --seed 1.5", "--seed is '1.5', must be a valid integer; `socast evaluate --help`"),
        ("live --smoothing -1", "--smoothing is '-1', must be greater than or equal to 0; `socast live --help`"),
        ("live --period nan", "--period is 'nan', must be"),
    ],
)
def test_invalid_call_gives_one_line_with_mistake_and_pointer_to_help(call, message, capsys):
    assert message.lower() in refused(capsys, *call.split()).lower()


@pytest.mark.parametrize("call", [[], ["effects"]])
def test_call_without_command_prints_help_without_error(call, capsys):
    with pytest.raises(SystemExit) as ended:
        main(call)
    assert ended.value.code == 2
    streams = capsys.readouterr()
    assert "Usage: socast" in streams.out + streams.err
    assert "socast: " not in streams.out + streams.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "nowhere.mcap"], "nowhere.mcap"),
        (["info", "/"], "no *.mcap in this folder"),
        (["replay", "{rec}", "--speed", "fast"], "fast"),
        (["replay", "{rec}", "--speed", "0"], "'0'"),
        (["replay", "{rec}", "--longest-gap", "-1"], "gap"),
        (["replay", "{rec}", "--model", "oracle"], "oracle"),
        (["replay", "{rec}", "--connect", "tcp/127.0.0.1:1"], "127.0.0.1:1"),
        (["replay", "{rec}", "--connect", "tcp/127.0.0.1:1", "--out", "x.mcap"], "--connect"),
        (["replay", "{rec}", "--out", "/nowhere/x.mcap"], "/nowhere/x.mcap"),
        (["simulate", "-o", "/nowhere/x.mcap"], "/nowhere/x.mcap"),
        (["replay", "{rec}", "--json", "/nowhere/x.json"], "/nowhere/x.json"),
        (["replay", "{rec}", "--out", "{rec}"], "overwritten"),
        (["replay", "{rec}", "--json", "{rec}"], "overwritten"),
        (["info", "{rec}", "--json", "/nowhere/x.json"], "/nowhere/x.json"),
        (["tables", "{rec}", "--out", "{tmp}", "--json", "/nowhere/x.json"], "/nowhere/x.json"),
        (["tables", "{rec}", "--out", "{rec}"], "--out"),
        (["tables", "{rec}", "--out", "{tmp}/taken"], "rides.parquet"),
        (["effects", "list", "--json", "/nowhere/x.json"], "/nowhere/x.json"),
        (["live", "--listen", "tcp/127.0.0.1:0", "--state", "/nowhere/state"], "/nowhere/state"),
        (["live", "--mode", "queen"], "queen"),
        (["live", "--connect", "tcp/127.0.0.1:1"], "127.0.0.1:1"),
        (["live", "--config", "nowhere.json5"], "nowhere.json5"),
        (["live", "--prefix", "a/**"], "'a/**'"),
        (["live", "--prefix", "a b?"], "'a b?'"),
        (["replay", "{rec}", "--prefix", "a/**"], "'a/**'"),
        (["replay", "{rec}", "--prefix", "a//b", "--connect", "tcp/127.0.0.1:1"], "'a//b'"),
        (["replay", "{rec}", "--connect", "tcp/127.0.0.1:1", "--smoothing", "3"], "--connect"),
        (["live", "--record", "/proc/nowhere"], "/proc/nowhere"),
        (["demo", "nowhere.mcap"], "nowhere.mcap"),
    ],
)
def test_impossible_request_is_refused_in_one_line(arguments, message, recording, tmp_path, capsys):
    (tmp_path / "taken" / "rides.parquet").mkdir(parents=True)
    kept = recording.read_bytes()
    assert message in refused(capsys, *(argument.format(rec=recording, tmp=tmp_path) for argument in arguments))
    assert recording.read_bytes() == kept


CLEANING = ["--speed-limit-kmh", "--period", "--smoothing", "--least-distance-km", "--longest-ride-min"]


@pytest.mark.parametrize("option", CLEANING)
@pytest.mark.parametrize("command", [["tables", "{rec}", "--out", "{tmp}"], ["replay", "{rec}"], ["live"]])
def test_invalid_setting_of_cleaning_is_refused_in_unit_of_option(command, option, recording, tmp_path, capsys):
    given = [argument.format(rec=recording, tmp=tmp_path) for argument in command]
    assert f"{option} is '1000000', must be less than" in refused(capsys, *given, option, "1000000")


def test_replay_uses_settings_of_cleaning(recording):
    """With a limit below the cars' 36 km/h every speed is rejected; with one above, the tunnels' only."""
    rejected = []
    for limit in ("130", "30"):
        out, _, code = called("replay", recording, "--speed-limit-kmh", limit)
        assert code == 0
        rejected.append(int(re.search(r"rejected samples:.*speed rejected ([\d,]+)", out)[1].replace(",", "")))
    assert 0 < 10 * rejected[0] < rejected[1]


def test_info_shows_contents_of_recording(recording, tmp_path):
    out, _, code = called("info", recording, "--json", tmp_path / "info.json")
    assert code == 0
    (about,) = json.loads((tmp_path / "info.json").read_text())["recordings"]
    sent = shift()
    assert about["messages"] == len(sent)
    assert about["vehicles"] == ["car-0", "car-1", "car-2"]
    assert about["stations"] == ["yul"]
    assert about["topics"]["fleet/car-1/telemetry"]["schema"] == "Telemetry"
    assert sum(topic["messages"] for topic in about["topics"].values()) == len(sent)
    assert sum(about["kinds"].values()) == len(sent)
    assert about["duration_s"] == pytest.approx((sent[-1].receipt_ns - sent[0].receipt_ns) * 1e-9)
    assert about["losses"] == []
    assert f"{len(sent):,} messages" in out
    assert "2018-01-15 12:00:00" in out


def test_info_shows_losses_of_recording(recording, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-20_000])
    out, _, code = called("info", cut)
    assert code == 0
    assert "bytes after its last whole chunk are not read" in out


def test_replay_reports_forecasts_and_comparison(recording, tmp_path):
    out, err, code = called("replay", recording, "--out", tmp_path / "f.mcap", "--json", tmp_path / "rides.json")
    assert (code, err) == (0, "")
    written = json.loads((tmp_path / "rides.json").read_text())
    rides = written["rides"]
    assert len(rides) == 9
    assert [(shift["vehicle_id"], shift["soc_end_pct"]) for shift in written["shifts"]] == [
        (f"car-{i}", pytest.approx(81.0)) for i in range(3)
    ]
    assert "the charge at the shift's end has no forecast" in out
    assert all(ride["predicted_kwh"] > 0 and ride["energy_kwh"] > 0 for ride in rides)
    assert "9 rides of 3 cars" in out
    assert "messages that could not be decoded" in out
    source = McapSource(tmp_path / "f.mcap")
    assert {m.key for block in source for m in block} == {f"fleet/car-{i}/forecast" for i in range(3)}
    assert set(source.schemas.values()) == {Forecast.__name__}


def test_replay_writes_forecasts_under_prefix_as_live_does(recording, tmp_path):
    called("replay", recording, "--prefix", "/montreal/", "--out", tmp_path / "f.mcap")
    assert {m.key.partition("/")[0] for block in McapSource(tmp_path / "f.mcap") for m in block} == {"montreal"}


def test_paced_replay_gives_same_results(recording, tmp_path):
    called("replay", recording, "--json", tmp_path / "max.json")
    out, _, code = called("replay", recording, "--speed", "20", "--json", tmp_path / "paced.json")
    assert code == 0
    assert (tmp_path / "paced.json").read_bytes() == (tmp_path / "max.json").read_bytes()
    assert "SOC" in out


def test_tables_hold_same_rides_in_parquet_and_json_and_name_each_loss(recording, tmp_path):
    cuts = [tmp_path / name / "cut.mcap" for name in ("first", "second")]
    for at, cut in enumerate(cuts):
        cut.parent.mkdir()
        cut.write_bytes(recording.read_bytes()[: -20_000 * (at + 1)])
    out, err, code = called("tables", *cuts, "--out", tmp_path, "--json", tmp_path / "rides.json")
    assert code == 0
    rides = json.loads((tmp_path / "rides.json").read_text(), parse_constant=pytest.fail)["rides"]
    table = pd.read_parquet(tmp_path / "rides.parquet")
    assert [ride["ride_id"] for ride in rides] == table["ride_id"].tolist()
    assert [ride["distance_km"] for ride in rides] == table["distance_km"].tolist()
    assert f"{len(rides)} rides" in out
    lost = json.loads((tmp_path / "quality.json").read_text())["lost"]
    assert set(lost) == set(map(str, cuts))
    assert all(f"{cut}: it has no end" in err for cut in cuts)


def test_several_recordings_are_merged(tmp_path):
    sent = shift()
    for part in range(2):
        with McapSink(tmp_path / f"{part}.mcap") as sink:
            sink.put(sent[part::2])
    with McapSink(tmp_path / "whole.mcap") as sink:
        sink.put(sent)
    called("replay", tmp_path / "0.mcap", tmp_path / "1.mcap", "--json", tmp_path / "parts.json")
    called("replay", tmp_path / "whole.mcap", "--json", tmp_path / "whole.json")
    assert (tmp_path / "parts.json").read_bytes() == (tmp_path / "whole.json").read_bytes()


@pytest.fixture
def consumer(tmp_path: Path):
    with consumers(tmp_path) as start:
        yield start


def test_live_ends_cleanly_on_sigterm_without_losing_messages(consumer, recording, tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    process, log = consumer("--listen", endpoint, "--record", tmp_path / "kept", "--report", "0.05")
    _, printed, code = called("replay", recording, "--connect", endpoint, "--speed", "max")
    assert code == 0
    assert f"published {len(shift()):,} messages" in printed
    assert eventually(lambda: any(line.get("messages") == len(shift()) for line in logged(log)))
    process.terminate()
    assert process.wait(20) == 0
    lines = logged(log)
    finished = next(line for line in lines if line["event"] == "finished")
    assert finished["messages"] == len(shift())
    assert finished["recorded"] == len(shift()) - finished["duplicates"]
    assert (finished["missed"], finished["unrecorded"]) == (0, 0)
    assert sum(line["event"] == "ride" for line in lines) == 9
    (kept,) = list_recordings(tmp_path / "kept")
    source = McapSource(kept)
    model = f"{EXTENDED_PHYSICAL.name}/{EXTENDED_PHYSICAL.version}"
    assert source.metadata == {"version": find_version(), "command": "live", "model": model}
    assert [m.payload for block in source for m in block] == list(dict.fromkeys(m.payload for m in shift()))
    assert not source.losses


def test_live_uses_settings_of_cleaning_and_ends_cleanly_on_sigint(consumer, recording):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    process, log = consumer("--listen", endpoint, "--report", "0.05", "--least-distance-km", "100")
    called("replay", recording, "--connect", endpoint, "--speed", "max")
    assert eventually(lambda: any(line.get("messages") == len(shift()) for line in logged(log)))
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0
    (finished,) = [line for line in logged(log) if line["event"] == "finished"]
    assert (finished["messages"], finished["missed"]) == (len(shift()), 0)
    rides = [line for line in logged(log) if line["event"] == "ride"]
    assert [ride["unfit_reason"] for ride in rides] == ["too_little_distance"] * 9


def test_recording_of_killed_consumer_is_read_up_to_last_flush(consumer, recording, tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    process, _ = consumer("--listen", endpoint, "--record", tmp_path / "kept", "--flush", "0.1")
    called("replay", recording, "--connect", endpoint, "--speed", "max")

    def kept() -> int:
        files = [path for path in list_recordings(tmp_path / "kept") if path.stat().st_size > 1000]  # with a header
        return sum(len(block) for path in files for block in McapSource(path))

    assert eventually(lambda: kept() == len({(m.key, m.payload) for m in shift()}))
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    out, _, code = called("replay", *list_recordings(tmp_path / "kept"))
    assert code == 0
    assert "9 rides of 3 cars" in out


def test_restarted_consumer_continues_from_its_state(consumer, tmp_path):
    """The state after a restart in the middle of a ride is, to the byte, that of a consumer that was not restarted."""
    sent = shift(samples=140, cars=1)
    parts = sent[: len(sent) // 2], sent[len(sent) // 2 :]
    for number, part in enumerate(parts):
        with McapSink(tmp_path / f"{number}.mcap") as sink:
            sink.put(part)
        endpoint = f"tcp/127.0.0.1:{find_free_port()}"
        process, log = consumer("--listen", endpoint, "--state", tmp_path / "state", "--report", "0.05")
        called("replay", tmp_path / f"{number}.mcap", "--connect", endpoint, "--speed", "max")
        assert eventually(lambda log=log, part=part: any(line.get("messages") == len(part) for line in logged(log)))
        process.terminate()
        assert process.wait(20) == 0
    assert "restored" in {line["event"] for line in logged(log)}
    assert "ride" not in {line["event"] for line in logged(log)}  # it is still under way
    uninterrupted = Pipeline(EXTENDED_PHYSICAL)
    uninterrupted.push(sent)
    saved = msgspec.msgpack.decode((tmp_path / "state").read_bytes()[32:])  # after the digest
    assert [key for key, *_ in saved["note"]["forecasts"]] == ["fleet/car-0/forecast"]
    assert msgspec.msgpack.encode(saved | {"note": None}) == uninterrupted.snapshot()[32:]


def test_failure_to_save_state_is_logged_and_forecasts_continue(tmp_path, caplog, monkeypatch):
    folder = tmp_path / "state"
    folder.mkdir()
    now = [0.0]
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    checkpoints = Checkpoints(Pipeline(EXTENDED_PHYSICAL), StateFile(folder / "cars"), clock=lambda: now[0])
    checkpoints.save()
    assert (folder / "cars").exists()
    shutil.rmtree(folder)
    now[0] = 1000.0
    checkpoints(Tally())
    assert "state not kept" in caplog.text
    with pytest.raises(SettingsError, match="cars"):
        checkpoints.save()


def test_demo_shows_cars_and_ends_with_a_verdict(recording, tmp_path):
    out, err, code = called("demo", recording, "--seconds", "1", "--json", tmp_path / "demo.json")
    assert (code, err) == (0, "")
    called("replay", recording, "--json", tmp_path / "replay.json")
    demo, replay = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("demo", "replay"))
    assert demo["rides"] == replay["rides"]
    assert "SOC" in out
    assert "The shift, car by car" in out
    assert "Energy: extended_physical is off by" in out
    assert "0 messages missed" in " ".join(out.split())
    assert demo["missed"] == 0
    assert {car["vehicle_id"] for car in demo["cars"]} == {ride["vehicle_id"] for ride in demo["rides"]}


def test_closed_pipe_gives_no_traceback(recording):
    command = f"{sys.executable} -m socast info {recording} | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60, check=False)
    assert "Traceback" not in done.stderr
    assert os.linesep in done.stdout
