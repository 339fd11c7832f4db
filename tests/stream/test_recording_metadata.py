"""A recording says what wrote it: the command, the version, and the settings that differ from the defaults."""

import struct
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
from mcap.reader import make_reader

from socast.core.settings import Settings
from socast.stream.mcap_format import MAGIC, RECORD, decode_metadata
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.recorder import Recorder
from socast.stream.recording_metadata import list_changed_settings, make_metadata
from socast.tools.simulator.settings import Faults, Simulation
from tests.support.mcap_recordings import make_telemetry, read_recording, write_recording
from tests.support.paths import ROOT

METADATA = make_metadata(
    "live", prefix="montreal/", models=["a/1", "b/2"], settings=list_changed_settings(Settings(window=5), Settings())
)


def test_metadata_hold_command_prefix_models_and_changed_settings():
    assert METADATA == {
        "command": "live",
        "prefix": "montreal",
        "model": "a/1",
        "shadows": "b/2",
        "settings": '{"window":5}',
    }
    assert make_metadata("replay") == {"command": "replay"}


def test_only_changes_of_nested_settings_are_listed():
    assert list_changed_settings(Simulation(), Simulation()) == {}
    changed = replace(Simulation(), seed=7, faults=replace(Faults(), late=0.5))
    assert list_changed_settings(changed, Simulation()) == {"seed": 7, "faults": {"late": 0.5}}


def test_metadata_survive_round_trip_and_mcap_package_finds_them(tmp_path: Path):
    path = tmp_path / "r.mcap"
    with McapSink(path, metadata=METADATA) as sink:
        sink.put(make_telemetry(5))
    expected = {"version": version("socast")} | METADATA
    assert McapSource(path).metadata == expected
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [(each.name, each.metadata) for each in reader.iter_metadata()] == [("socast", expected)]
        assert reader.get_summary().statistics.metadata_count == 1


def test_metadata_of_unfinished_recording_are_read(tmp_path: Path):
    sink = McapSink(tmp_path / "r.mcap", metadata=METADATA)
    sink.put(make_telemetry(5))
    sink.flush()
    source = McapSource(tmp_path / "r.mcap")
    sink.close()
    assert source.losses.unfinished
    assert source.metadata["command"] == "live"


def test_every_file_of_a_recorder_carries_the_metadata(tmp_path: Path):
    with Recorder(tmp_path, file_s=60.0, metadata=METADATA) as recorder:
        for at in range(0, 200, 10):
            recorder.put(make_telemetry(200)[at : at + 10])
    assert len(recorder.files) > 2
    assert {McapSource(path).metadata["settings"] for path in recorder.files} == {'{"window":5}'}


def test_shipped_recording_without_a_command_is_read():
    source = McapSource(ROOT / "recordings" / "evening.mcap")
    assert "command" not in source.metadata
    assert len(next(iter(source))) > 1000
    assert not source.viewer_messages


def test_simulated_recording_names_its_seed_and_not_what_it_hides():
    metadata = McapSource(ROOT / "recordings" / "autumn.mcap").metadata
    assert metadata["command"] == "simulate"
    assert '"seed":31' in metadata["settings"]
    assert "headwind" not in metadata["settings"].replace('"headwind":false', "")


@pytest.mark.parametrize(
    "forged",
    [
        lambda about: about[:4] + b"\xff" * 4 + about[8:],
        lambda about: struct.pack("<I", 1 << 31) + about[4:],
        lambda about: about[:10] + struct.pack("<I", 1 << 31) + about[14:],
        lambda about: about[:18] + b"\xff\xfe" + about[20:],
        lambda _: b"",
    ],
)
def test_forged_metadata_are_left_out_and_messages_are_read(tmp_path: Path, forged):
    data = write_recording(tmp_path / "r.mcap", make_telemetry(5)).read_bytes()
    begin = len(MAGIC) + RECORD.size + RECORD.unpack_from(data, len(MAGIC))[1]
    opcode, length = RECORD.unpack_from(data, begin)
    body = data[begin + RECORD.size : begin + RECORD.size + length]
    assert decode_metadata(body) == ("socast", {"version": version("socast")})
    bad = forged(body)
    path = tmp_path / "forged.mcap"
    path.write_bytes(data[:begin] + RECORD.pack(opcode, len(bad)) + bad + data[begin + RECORD.size + length :])
    assert McapSource(path).metadata == {}
    assert read_recording(path) == make_telemetry(5)
