"""`socast info` shows what wrote a recording."""

import json
from datetime import datetime
from zoneinfo import ZoneInfo

from mcap.writer import Writer

from socast.stream.mcap_writer import McapSink
from socast.stream.recording_metadata import find_version, make_metadata
from tests.support.commands import called
from tests.support.mcap_recordings import make_telemetry


def write_with_metadata(path, metadata):
    """Write a recording of three samples and return its path."""
    with McapSink(path, metadata=metadata) as sink:
        sink.put(make_telemetry(3))
    return path


def test_info_shows_what_wrote_the_recording(tmp_path):
    metadata = make_metadata("simulate", prefix="montreal", settings={"seed": 7})
    out, _, code = called("info", write_with_metadata(tmp_path / "r.mcap", metadata), "--json", tmp_path / "info.json")
    assert code == 0
    assert f'written by socast {find_version()} simulate; prefix montreal; settings {{"seed":7}}' in out
    (about,) = json.loads((tmp_path / "info.json").read_text())["recordings"]
    assert about["metadata"] == {"version": find_version()} | metadata


def test_info_shows_times_in_the_chosen_zone_and_names_it(tmp_path):
    path = write_with_metadata(tmp_path / "r.mcap", {})
    begin = json.loads(called("info", path, "--json", "-")[0])["recordings"][0]["begin"]
    assert begin.endswith("+00:00")
    local = datetime.fromisoformat(begin).astimezone(ZoneInfo("Asia/Kolkata"))
    assert f"{local:%Y-%m-%d %H:%M:%S} to " in called("info", path, "--time-zone", "Asia/Kolkata")[0]
    assert " IST, " in called("info", path, "--time-zone", "Asia/Kolkata")[0]
    assert " UTC, " in called("info", path)[0]
    _, err, code = called("info", path, "--time-zone", "Moon")
    assert (code, "--time-zone is 'Moon', which is no time zone" in err) == (2, True)


def test_info_prints_no_control_characters_of_metadata(tmp_path):
    out, _, _ = called("info", write_with_metadata(tmp_path / "r.mcap", {"command": "live\x1b[2J\nlie"}))
    assert "live?[2J?lie" in out
    assert "\x1b" not in out


def test_info_says_nothing_where_the_recording_does_not(tmp_path):
    path = tmp_path / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Telemetry", "jsonschema", b"{}")
        channel = writer.register_channel("fleet/car-1/telemetry", "json", schema)
        writer.add_message(channel, 10**18, b"{}", 10**18)
        writer.finish()
    out, _, code = called("info", path, "--json", tmp_path / "info.json")
    assert code == 0
    assert "written by" not in out
    (about,) = json.loads((tmp_path / "info.json").read_text())["recordings"]
    assert about["metadata"] == {}
    assert about["viewer_topics"] == {}


def test_info_does_not_call_a_recording_broken_off_that_is_still_being_written(tmp_path):
    with McapSink(tmp_path / "r.mcap") as sink:
        sink.put(make_telemetry(3))
        sink.flush()
        out, _, code = called("info", tmp_path / "r.mcap")
    assert code == 0
    said = " ".join(out.split())
    assert "it has no end: it is still being written, or its writer was killed; 0 bytes after its last" in said
    assert "it has no end" not in called("info", tmp_path / "r.mcap")[0]
