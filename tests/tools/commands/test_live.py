"""`socast live --watch` diagnoses what it recorded after midnight, and publishes what it is sure of."""

import json
import shutil

import pytest

from core.errors import SettingsError
from stream.mcap_writer import McapSink
from stream.zenoh_session import Connection, Node, find_free_port
from tests.support.commands import called, refused
from tests.support.live_consumers import consumers, logged
from tests.support.paths import ROOT
from tests.support.recorded_shift import make_two_days
from tests.support.zenoh_sessions import eventually
from tools.commands.fit import inputs

pytestmark = pytest.mark.long


def test_watch_without_record_is_refused(tmp_path, capsys):
    message = refused(capsys, "live", "--watch", tmp_path / "findings.json")
    assert "give --record DIR too" in message


def test_file_that_holds_no_findings_is_refused(tmp_path, capsys):
    (tmp_path / "findings.json").write_text("{}")
    watch = ("--record", tmp_path / "kept", "--watch", tmp_path / "findings.json")
    message = refused(capsys, "live", "--listen", "tcp/127.0.0.1:0", *watch)
    assert "is no file of findings" in message


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
    assert inputs([tmp_path]) == [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(SettingsError, match="holds no rides"):
        inputs([tmp_path / "empty"])
