"""`socast replay --foxglove` adds topics for viewers, and the readers of socast see the plain recording."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from socast.core.wire.messages import KINDS, Message
from socast.core.wire.schema import make_schema
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.foxglove.topics import MOST_CARS, SCHEMAS, make_layout
from tests.support.commands import called, refused
from tests.support.mcap_recordings import make_telemetry, read_recording, write_recording
from tests.support.recorded_shift import shift


class Replayed(NamedTuple):
    """Hold a recording, and what a replay for Foxglove wrote."""

    plain: Path
    viewed: Path
    layout: Path


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Replayed:
    folder = tmp_path_factory.mktemp("foxglove")
    plain = write_recording(folder / "shift.mcap", shift(), 20_000)
    viewed = folder / "viewed.mcap"
    layout = folder / "viewed.layout.json"
    out, err, code = called("replay", plain, "-o", viewed, "--foxglove")
    assert (err, code) == ("", 0)
    assert f"layout for Foxglove in {layout}" in out
    return Replayed(plain, viewed, layout)


def count_topics(path: Path) -> dict[str, set[str]]:
    """Return the schemas of each topic, as the mcap package reads them."""
    topics: dict[str, set[str]] = {}
    with path.open("rb") as file:
        for schema, channel, _ in make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, set()).add(schema.name)
    return topics


def test_recording_has_positions_warnings_and_forecasts_of_every_car(replayed):
    topics = count_topics(replayed.viewed)
    for car in ("car-0", "car-1", "car-2"):
        assert topics[f"fleet/{car}/telemetry"] == {"Telemetry"}
        assert topics[f"fleet/{car}/forecast"] == {"Forecast"}
        assert topics[f"fleet/{car}/location"] == {"foxglove.LocationFix"}
        assert topics[f"fleet/{car}/log"] == {"foxglove.Log"}
    with replayed.viewed.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    known = {schema["title"]: schema for schema in SCHEMAS.values()} | {
        struct.__name__: make_schema(kind) for kind, struct in KINDS.items()
    }
    assert all(json.loads(schema.data) == known[schema.name] for schema in schemas)
    assert {schema.encoding for schema in schemas} == {"jsonschema"}


def test_readers_see_exactly_the_messages_of_the_plain_recording(replayed):
    source = McapSource(replayed.viewed)
    assert [message for block in source for message in block] == read_recording(replayed.plain)
    assert not source.losses
    assert source.viewer_messages["fleet/car-1/location"] >= 400
    assert {topic.rpartition("/")[2] for topic in source.viewer_messages} == {"forecast", "location", "log"}


def test_replay_gives_exactly_the_forecasts_of_the_plain_recording(replayed, tmp_path):
    for name, recording in (("plain", replayed.plain), ("viewed", replayed.viewed)):
        _, err, code = called("replay", recording, "--out", tmp_path / name, "--json", tmp_path / f"{name}.json")
        assert (err, code) == ("", 0)
    assert len(read_recording(tmp_path / "plain")) > 100
    assert (tmp_path / "viewed").read_bytes() == (tmp_path / "plain").read_bytes()
    assert (tmp_path / "viewed.json").read_bytes() == (tmp_path / "plain.json").read_bytes()


def test_info_counts_what_is_for_viewers_apart(replayed):
    out, _, code = called("info", replayed.viewed)
    assert code == 0
    assert f"{len(shift()):,} messages" in out
    assert re.search(r"for viewers, .* 9 topics \(Forecast, foxglove.LocationFix, foxglove.Log\)", out)


def test_layout_shows_only_topics_and_fields_that_the_recording_has(replayed):
    layout = json.loads(replayed.layout.read_text())
    topics = count_topics(replayed.viewed)
    panels = layout["configById"]
    plotted = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    for value in plotted:
        topic, field, *inner = re.fullmatch(r'"(fleet/car-\d/\w+)"\.(\w+)(?:\.(\w+))?', value).groups()
        properties = make_schema(topic.rpartition("/")[2])["properties"]
        assert topic in topics
        assert field in properties
        assert inner == [None] or inner[0] in properties[field]["properties"]
    assert sum("car-2" in value for value in plotted) == 8
    logs = {panel["topicToRender"] for name, panel in panels.items() if name.startswith("RosOut!")}
    assert logs == {f"fleet/car-{number}/log" for number in range(3)}
    assert panels["map!fleet"]["followTopic"] in topics


def list_placed(node) -> list[str]:
    """Return the panels that a part of the window holds."""
    return [node] if isinstance(node, str) else [*list_placed(node["first"]), *list_placed(node["second"])]


@pytest.mark.parametrize("cars", [0, 1, MOST_CARS + 5])
def test_layout_places_every_panel_once(cars):
    layout = make_layout([f"fleet/car-{number}" for number in range(cars)])
    tabs = layout["configById"]["Tab!cars"]["tabs"]
    placed = list_placed(layout["layout"]) + [name for tab in tabs for name in list_placed(tab["layout"])]
    assert sorted(placed) == sorted(layout["configById"])
    assert len(tabs) == min(cars, MOST_CARS)


def test_messages_for_viewers_keep_their_channels_apart(tmp_path):
    sent = make_telemetry(20)
    with McapSink(tmp_path / "r.mcap", 500) as sink:
        for message in sent:
            sink.put([message])
            sink.put([Message(message.key, b'"for viewers"', message.receipt_ns)], for_viewers=True)
    source = McapSource(tmp_path / "r.mcap")
    assert [message for block in source for message in block] == sent
    assert source.viewer_messages.total() == 20
    assert not source.losses


def test_option_without_a_recording_to_write_is_refused(replayed, capsys, tmp_path):
    assert "--out" in refused(capsys, "replay", replayed.plain, "--foxglove")
    assert "--foxglove" in refused(
        capsys, "replay", replayed.plain, "--foxglove", "-o", tmp_path / "x", "--connect", "tcp/127.0.0.1:1"
    )
