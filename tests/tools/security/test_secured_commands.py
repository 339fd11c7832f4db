"""The commands run with the configurations of `socast secure`: the service, the replay of a car, and a question."""

import pytest

from socast.stream.mcap_writer import McapSink
from tests.support.commands import called, refused
from tests.support.live_consumers import consumers, logged
from tests.support.secure_fleets import make_fleet, open_router
from tests.support.telemetry import drive, leaf, telemetry
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


@pytest.mark.parametrize("embedded", [True, False], ids=["router of the consumer", "router of its own"])
def test_service_forecasts_a_car_and_answers_dispatch_alone(tmp_path, capsys, embedded):
    fleet = make_fleet(tmp_path / "keys", prefix="montreal")
    recording = tmp_path / "shift.mcap"
    cars = ("taxi-1", "taxi-7")
    with McapSink(recording) as sink:
        sink.put([message for car in cars for message in [leaf(car), *telemetry(drive(40), car)]])
    listen = ("--listen", f"tls/127.0.0.1:{fleet.port}")
    with consumers(tmp_path) as start:
        router = None if embedded else open_router(fleet)
        config = (
            ("--config", fleet.path / "router.json5", *listen)
            if embedded
            else ("--config", fleet.path / "consumer.json5")
        )
        _, log = start(*config, "--prefix", "montreal", "--report", "0.2")
        at = ("--prefix", "montreal", "--config")
        _, printed, code = called("replay", recording, *at, fleet.locate("taxi-1"), "--speed", "max")
        assert (code, "published 82 messages" in printed) == (0, True), printed
        assert eventually(lambda: any(line.get("messages", 0) >= 41 for line in logged(log)))
        out, _, code = called("ask", "taxi-1", *at, fleet.path / "dispatch.json5")
        assert (code, "taxi-1" in out) == (0, True)
        assert "taxi-7' has sent nothing" in refused(capsys, "ask", "taxi-7", *at, fleet.path / "dispatch.json5")
        assert "no consumer answers" in refused(capsys, "ask", "taxi-1", *at, fleet.locate("taxi-1"))
        if router is not None:
            router.close()
    assert max(line.get("messages", 0) for line in logged(log)) == 41
    assert "anybody who reaches" not in log.read_text()


def test_file_of_no_configuration_is_refused(tmp_path, capsys):
    recording = tmp_path / "shift.mcap"
    with McapSink(recording) as sink:
        sink.put(telemetry(drive(3)))
    for command in (("ask", "taxi-1"), ("replay", recording)):
        message = refused(capsys, *command, "--config", tmp_path / "missing.json5")
        assert "missing.json5 does not exist; `socast secure init` makes one" in message
    message = refused(capsys, "replay", recording, "--config", tmp_path / "missing.json5", "--in-process")
    assert "--config only publishes and makes no forecasts" in message
