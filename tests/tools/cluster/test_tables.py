"""Tables by stages equal those of a serial run to the bit, however messages and cars are divided."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from socast.core.errors import RecordingError
from socast.core.wire import duplicate_filter
from socast.core.wire.messages import Message
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.decoding import plan_spans
from socast.tools.cluster.ordering import Ordering
from socast.tools.cluster.runner import InProcessRunner
from socast.tools.cluster.tables import make_tables
from tests.support.cluster_tables import assert_same, make_job, make_parts, make_whole, receive, record
from tests.support.faulty_shifts import car, mixed
from tests.support.telemetry import PERIOD, START, drive, leaf, make_message, observed, telemetry

pytestmark = pytest.mark.long
RECORDINGS = Path(__file__).parents[3] / "recordings"
PHASES = [phase for phase in Phase if phase is not Phase.shrink]


def second_day(name, seed):
    """Return the drive of a car whose days are apart, with what its battery gave."""
    columns = drive(150, seed=seed, elevation_m=50.0, battery_voltage_v=350.0, ride_id=f"{name}{seed}")
    columns["battery_current_a"] = 4 + columns["speed_kmh"]
    columns["soc_pct"] = np.round(80 - 0.05 * np.arange(150), 1)
    columns["time_s"] = columns["time_s"] + 86_400.0 * (seed % 2)
    return telemetry(columns, name)


def make_fleet(rng, cars):
    """Return the messages of a fleet in one order: faults, silences, lists, repetitions, dispatch and weather."""
    streams = [car(f"car{i}", int(rng.integers(1000)), 60) for i in range(cars)]
    streams += [[leaf(f"b{i}"), *second_day(f"b{i}", 2 * i), *second_day(f"b{i}", 2 * i + 1)] for i in range(2)]
    streams[0] = streams[0][: len(streams[0]) // 2]  # silent, while the others go on
    weather = [observed(time=START + 90.0 * i, temperature_c=float(i)) for i in range(6)]
    ends = [leaf("car0", period_s=10.0), leaf("b0", period_s=0.0), leaf("b0", mass_kg=1700.0)]
    ends += [make_message("ride", "car0", START + 200.0, ride_id="A", event="end", driver_id="late")]
    messages = mixed([*streams, weather, ends], int(rng.integers(1000)))
    late = telemetry(drive(260, seed=4, speed=9.0), "runner")
    late[60:90] = [join(late[60:90])]
    messages += [*late, join(late[40:100:7])]
    for at in rng.integers(0, len(messages), 30):
        messages.insert(int(rng.integers(0, len(messages))), messages[at])
    return receive(messages)


def join(messages):
    """Return one message with the samples of several, of which one cannot be decoded."""
    samples = [json.loads(m.payload) for m in messages if m.payload.startswith(b"{")]
    return Message(messages[0].key, json.dumps([*samples, {"vehicle_id": 5}]).encode(), 0)


@settings(max_examples=6, phases=PHASES)
@given(seed=st.integers(0, 10_000), cars=st.integers(1, 4), parts=st.integers(1, 5), span_bytes=st.integers(1, 40_000))
def test_any_division_gives_the_serial_tables(seed, cars, parts, span_bytes):
    rng = np.random.default_rng(seed)
    messages = make_fleet(rng, cars)
    owner = rng.integers(0, 1 + seed % 3, len(messages))
    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patched:
        patched.setattr(duplicate_filter, "LEAST", 50)  # the halves turn over
        patched.setattr(duplicate_filter, "PER_VEHICLE", 20)
        folder = Path(name)
        several = [[m for m, own in zip(messages, owner, strict=True) if own == i] for i in range(1 + seed % 3)]
        paths = record(folder, *(each for each in several if each))
        whole = make_whole(paths)
        assert len(whole[0]) > 5
        assert whole[2]["duplicates"] > 5
        assert_same(whole, make_parts(paths, folder / "parts", parts, span_bytes))


def test_recordings_of_several_days_give_the_serial_tables(tmp_path):
    paths = [RECORDINGS / "autumn.mcap", RECORDINGS / "shift.mcap"]
    whole = make_whole(paths)
    assert whole[0]["driver_id"].notna().any()
    assert_same(whole, make_parts(paths, tmp_path / "parts", 3, 300_000))


def test_silent_car_ends_its_ride_although_no_other_car_is_in_its_part(tmp_path):
    silent = telemetry(drive(100, seed=2, speed=10.0), "silent")
    others = telemetry(drive(500, seed=3, speed=10.0), "other")
    later = telemetry({**drive(50, seed=2, speed=10.0), "time_s": START + 1800.0 + PERIOD * np.arange(50)}, "silent")
    messages = [leaf("silent"), leaf("other"), *mixed([silent, others[:100]], 1), *others[100:], *later]
    paths = record(tmp_path, receive(messages))
    whole = make_whole(paths)
    assert whole[0].iloc[0]["vehicle_id"] == "silent"  # before the end of the recording
    for parts in (1, 2, 7):
        assert_same(whole, make_parts(paths, tmp_path / f"parts{parts}", parts, 10_000))


def test_damaged_recording_has_the_serial_losses(tmp_path):
    (path,) = record(tmp_path, receive(make_fleet(np.random.default_rng(5), 2)))
    content = bytearray(path.read_bytes())
    first, _, _ = McapSource(path).block_spans[1]
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content[:-40]))
    whole = make_whole([path])
    assert whole[3][0]
    assert_same(whole, make_parts([path], tmp_path / "parts", 2, 5_000))
    assert first > 0


def test_spans_hold_every_message_once(tmp_path):
    messages = receive(make_fleet(np.random.default_rng(1), 2))
    paths = record(tmp_path, messages[::2], messages[1::2])
    sources = [McapSource(path) for path in paths]
    spans = plan_spans(sources, 2000)
    assert len(spans) > 3
    assert spans[0][0] == -np.inf
    assert spans[-1][1] == np.inf
    for source in sources:
        read = [message for span in spans for message in source.read_span(*span)]
        assert read == [message for part in source for message in part]


def test_more_vehicles_than_the_limit_are_refused_in_one_line(tmp_path):
    paths = record(tmp_path, receive([leaf("a"), leaf("b"), *telemetry(drive(30), "a")]))
    job = make_job(paths, tmp_path / "parts", 1)
    ordering = Ordering(job)
    ordering._limits = ordering._limits._replace(vehicles=1)
    ordering.lanes.load(["a", "b"])
    with pytest.raises(RecordingError, match="hold 2 vehicles, and the limit is 1; read them without --cluster"):
        ordering.finish()


def test_recording_in_which_nothing_can_be_read_gives_empty_tables(tmp_path):
    paths = record(tmp_path, receive([leaf("a"), *telemetry(drive(30), "a")]))
    runner = InProcessRunner()
    make_tables(make_job(paths, tmp_path / "parts", 2), [McapSource(p) for p in paths], tmp_path / "parts", runner)
    assert {record.stage for record in runner.records} == {"decode", "clean", "write"}
    assert all(record.peak_bytes > 0 for record in runner.records)
