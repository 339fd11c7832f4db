"""`socast live --watch` diagnoses what it recorded after midnight, and publishes what it is sure of."""

import json
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from socast.core import models
from socast.core.errors import SettingsError
from socast.core.settings import Settings
from socast.stream.loop import Tally
from socast.stream.mcap_writer import McapSink
from socast.stream.memory import MemorySink
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.tools.terminal import night_watch
from socast.tools.terminal.forecast_options import ForecastOptions
from socast.tools.terminal.night_watch import DiagnosisProcess, make_nightly_diagnosis
from socast.tools.terminal.ride_source import list_inputs
from tests.support.commands import called, refused
from tests.support.live_consumers import consumers, logged
from tests.support.paths import ROOT
from tests.support.recorded_shift import make_two_days
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


def test_watch_without_record_is_refused(tmp_path, capsys):
    message = refused(capsys, "live", "--watch", tmp_path / "findings.json")
    assert "give --record DIR too" in message


def test_file_that_holds_no_findings_is_refused(tmp_path, capsys):
    (tmp_path / "findings.json").write_text("{}")
    watch = ("--record", tmp_path / "kept", "--watch", tmp_path / "findings.json")
    message = refused(capsys, "live", "--listen", "tcp/127.0.0.1:0", *watch)
    assert "is no file of findings" in message


def test_unknown_model_and_folder_that_does_not_exist_are_refused_before_the_service_starts(tmp_path, capsys):
    listen = ("live", "--listen", "tcp/127.0.0.1:0", "--record", tmp_path / "kept", "--watch")
    assert "cannot be written" in refused(capsys, *listen, tmp_path / "nowhere" / "findings.json")
    message = refused(capsys, *listen, tmp_path / "findings.json", "--model", tmp_path / "none.json")
    assert "none.json: cannot read a model" in message


def test_events_need_a_nightly_diagnosis_and_a_readable_file(tmp_path, capsys):
    events = tmp_path / "workshop.csv"
    events.write_text("when,who\n")
    assert "give --watch FILE too" in refused(capsys, "live", "--events", events)
    watch = ("--record", tmp_path / "kept", "--watch", tmp_path / "findings.json")
    assert "workshop.csv" in refused(capsys, "live", *watch, "--events", events)


class DiagnosisHere:
    """Stand for a process that diagnoses: the same command, in this process."""

    def __init__(self, arguments: list[str]) -> None:
        _, self._error, self._code = called("diagnose", *arguments)

    def poll(self) -> int:
        return self._code

    def get_error(self) -> str:
        return self._error.splitlines()[-1]

    def end(self) -> None:
        """Hold nothing."""


def leave_all(folder: Path) -> None:
    """Leave three rides, which are too few."""


def remove_model(folder: Path) -> None:
    (folder / "base.json").unlink()


def replace_model(folder: Path) -> None:
    (folder / "base.json").write_text('{"format": 99, "terms": []}')


def remove_recordings(folder: Path) -> None:
    (folder / "kept" / "1.mcap").unlink()


def remove_folder_of_findings(folder: Path) -> None:
    (folder / "found").rmdir()


def spoil_findings(folder: Path) -> None:
    (folder / "found" / "findings.json").write_text("{}")


TOO_FEW = "rides with measured energy to diagnose, and it takes 20: give more rides"


@pytest.mark.parametrize(
    ("job", "spoil", "reason"),
    [
        (DiagnosisProcess, leave_all, TOO_FEW),
        (DiagnosisHere, leave_all, TOO_FEW),
        (DiagnosisHere, remove_model, "base.json: cannot read a model: No such file or directory"),
        (DiagnosisHere, replace_model, "base.json: model file of format 99, and this version reads format"),
        (
            DiagnosisHere,
            remove_recordings,
            "kept holds no rides.parquet and no recording (*.mcap); name a folder of recordings",
        ),
        (DiagnosisHere, remove_folder_of_findings, "findings.json cannot be written: No such file or directory"),
        (DiagnosisHere, spoil_findings, "findings.json is no file of findings"),
    ],
)
def test_night_that_fails_is_one_line_of_the_log_and_the_next_night_tries_again(
    tmp_path, caplog, monkeypatch, job, spoil, reason
):
    monkeypatch.setattr(night_watch, "DiagnosisProcess", job)
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    caplog.set_level(logging.INFO, "socast")
    (tmp_path / "kept").mkdir()
    (tmp_path / "found").mkdir()
    with McapSink(tmp_path / "kept" / "1.mcap") as sink:
        sink.put(make_two_days()[:60])
    models.save(models.load("extended_physical"), tmp_path / "base.json")
    options = ForecastOptions([str(tmp_path / "base.json")], (), (), Settings(), "", (), ())
    fleet = SimpleNamespace(day_rollover=SimpleNamespace(midnight=86_400.0))
    found = tmp_path / "found" / "findings.json"
    nightly = make_nightly_diagnosis(options, fleet, MemorySink(), tmp_path / "kept", found)
    spoil(tmp_path)

    def failures() -> list[str]:
        nightly(Tally())
        return [line.fields["reason"] for line in caplog.records if line.message == "diagnosis failed"]

    fleet.day_rollover.midnight *= 2.0
    assert eventually(failures)
    (only,) = failures()
    assert only.startswith("socast: ")
    assert reason in only
    assert "\n" not in only
    fleet.day_rollover.midnight *= 1.5
    nightly(Tally())
    nightly.end()
    assert [line.message for line in caplog.records].count("diagnosis begins") == 2


def test_missing_effect_is_published_after_midnight(tmp_path):
    kept, file, heard = tmp_path / "kept", tmp_path / "findings.json", []
    kept.mkdir()
    shutil.copy(ROOT / "recordings" / "autumn.mcap", kept)
    days = make_two_days()
    for name, part in (("1.mcap", days[: len(days) // 2]), ("2.mcap", days[len(days) // 2 :])):
        with McapSink(tmp_path / name) as sink:
            sink.put(part)
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with consumers(tmp_path) as start:
        process, log = start("--listen", endpoint, "--record", kept, "--watch", file)
        with Node(Connection(connect=(endpoint,))) as node:
            keep = lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes()))  # noqa: E731
            with node.session.declare_subscriber("findings/**", keep):
                called("replay", tmp_path / "1.mcap", "--connect", endpoint, "--speed", "max")
                assert eventually(lambda: any(line["event"] == "ride" for line in logged(log)))
                called("replay", tmp_path / "2.mcap", "--connect", endpoint, "--speed", "max")
                over = {"diagnosis ended", "diagnosis failed"}
                assert eventually(lambda: any(line["event"] in over for line in logged(log)), 180.0)
                assert eventually(lambda: heard)
                process.terminate()
                assert process.wait(20) == 0
    sure = [line for line in logged(log) if line["event"] == "finding"]
    assert "headwind" in {line["effect"] for line in sure}
    assert {key for key, _ in heard} == {f"findings/{line['who']}/{line['effect']}" for line in sure}
    assert {json.loads(payload)["status"] for _, payload in heard} == {"sure"}
    assert all(line["add"].startswith("socast add ") for line in sure if line["who"] == "all")
    assert json.loads(file.read_text())["findings"]


def test_folder_of_recordings_stands_for_its_recordings(tmp_path):
    for name in ("b.mcap", "a.mcap", "notes.txt"):
        (tmp_path / name).touch()
    assert list_inputs([tmp_path]) == [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(SettingsError, match="holds no rides"):
        list_inputs([tmp_path / "empty"])
