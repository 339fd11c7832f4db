"""Test the messages of a drive."""

from zoneinfo import ZoneInfo

import msgspec
import numpy as np
import pytest

from socast.core.wire.messages import Ride, Telemetry, Vehicle, Weather, address
from socast.tools.importers import ved
from socast.tools.importers.drive import ReadOptions, make_messages
from tests.support.published_files import ved_file

UTC_ZONE = ReadOptions(ZoneInfo("UTC"))


def decode(messages):
    """Return the values of messages."""
    kinds = {"telemetry": Telemetry, "vehicle": Vehicle, "ride": Ride, "weather": Weather}
    return [msgspec.json.decode(m.payload, type=kinds[address(m.key).kind]) for m in messages]


def test_drive_gives_vehicle_start_samples_and_end(tmp_path):
    (drive,) = ved.read_drives(ved_file(tmp_path / "week.csv"), UTC_ZONE)
    out = decode(make_messages([drive], 3.0))
    vehicle, start, *sent, end = out
    assert vehicle == Vehicle("ved-455", start.time_s, "nissan-leaf-2013", power_covers="around")
    assert (start.ride_id, start.event) == ("ved-455-1", "start")
    assert end == Ride("ved-455", sent[-1].time_s, "ved-455-1", "end")
    assert [s.seq for s in sent] == list(range(21))
    assert np.diff([s.time_s for s in sent]) == pytest.approx(3.0, abs=2e-3)
    assert sent[3] == Telemetry(
        "ved-455",
        sent[3].time_s,
        ride_id="ved-455-1",
        seq=3,
        latitude_deg=42.24,
        longitude_deg=-83.74,
        speed_kmh=36.0,
        soc_pct=80.1,
        battery_voltage_v=360.0,
        battery_current_a=20.0,
        ambient_c=11.5,
        hvac_w=1000.0,
    )
