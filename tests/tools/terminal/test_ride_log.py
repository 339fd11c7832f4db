"""Test the log lines of rides that have ended."""

import logging

from socast.core.pipeline import Pipeline
from socast.tools.terminal.live_service import RideLog
from tests.support.telemetry import drive, leaf, telemetry


def test_start_of_a_logged_ride_is_an_iso_time_in_utc(monkeypatch, caplog):
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    pipeline = Pipeline()
    log = RideLog(pipeline)
    pipeline.push([leaf(), *telemetry(drive(200))])
    pipeline.finish()
    with caplog.at_level(logging.INFO, "socast"):
        log.end()
    (ride,) = [record.fields for record in caplog.records if record.message == "ride"]
    assert ride["start"] == "2024-01-15T08:00:00Z"
    assert "start_s" not in ride
