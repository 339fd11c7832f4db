"""A snapshot of the service holds what the pipeline, the recorder and the loop count."""

from types import SimpleNamespace

import numpy as np

from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream.loop import Tally, run
from socast.stream.memory import MemorySink, MemorySource
from socast.stream.nightly_diagnosis import CarLevel, NightlyCondition
from socast.stream.recorder import Recorder
from socast.stream.service_snapshot import LAG_BUCKETS, OF_SOURCE, LagMeter, SnapshotTaker
from socast.stream.service_status import ServiceStatus, ServiceWatch
from tests.support.recorded_shift import BEGIN, shift
from tests.support.telemetry import drive, telemetry


def test_counts_of_a_shift_are_those_of_the_pipeline(tmp_path):
    pipeline = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    recorder, source, status = Recorder(tmp_path), MemorySource(shift(), 50), ServiceStatus()
    take = SnapshotTaker(pipeline, source, recorder, per_vehicle=True, now=lambda: BEGIN + 1300.0)
    watch = ServiceWatch(status, take)
    tally = run(source, pipeline, [MemorySink()], recorder=recorder, watch=watch, keep_open=True)
    snapshot = take(tally, LagMeter())
    quality = pipeline.quality()
    assert snapshot.messages == tally.received == len(shift())
    assert snapshot.received == quality["received"]
    assert snapshot.rejected == {"not_json": 1}
    assert snapshot.duplicates == quality["duplicates"] > 0
    assert (snapshot.recorded, snapshot.unrecorded) == (recorder.recorded, 0)
    assert snapshot.rides == quality["rides"] > 0
    assert snapshot.model_rides[("extended_physical/1", "predicted")] > 0
    assert set(snapshot.model_mae_kwh) == {"extended_physical/1", "basic_physical/1"}
    assert snapshot.of_vehicles.names == ("car-0", "car-1", "car-2")
    assert 0.0 <= snapshot.newest_sample_s - BEGIN <= 1300.0
    assert (snapshot.vehicles, snapshot.active_vehicles) == (3, 3)
    assert sum(status.snapshot.lag.counts) > 0


def test_levels_of_the_nightly_assessment_are_those_of_their_cars():
    pipeline, source = Pipeline(EXTENDED_PHYSICAL), MemorySource(shift(), 50)
    tally = run(source, pipeline, keep_open=True)
    known = [None]
    take = SnapshotTaker(pipeline, source, per_vehicle=True, get_condition=lambda: known[0])
    before = take(tally, LagMeter())
    assert (before.assessed_s, before.of_vehicles.consumption_ratio) == (None, None)
    known[0] = NightlyCondition(90.0, {"car-1": CarLevel(1.05, 26.5), "of yesterday": CarLevel(1.0, None)})
    after = take(tally, LagMeter())
    assert after.assessed_s == 90.0
    assert after.of_vehicles.consumption_ratio == (None, 1.05, None)
    assert after.of_vehicles.usable_kwh == (None, 26.5, None)


def test_a_consumer_of_several_tells_whether_it_publishes():
    pipeline, source = Pipeline(), MemorySource([])
    for role in (True, False):
        take = SnapshotTaker(pipeline, source, candidate=SimpleNamespace(is_active=role, failure=""))
        assert take(Tally(), LagMeter()).publishes is role
    assert SnapshotTaker(pipeline, source)(Tally(), LagMeter()).publishes is None


def test_a_snapshot_names_the_consumers_that_overlap():
    watch = SimpleNamespace(found=("shard 3/3",))
    snapshot = SnapshotTaker(Pipeline(), MemorySource([]), overlap=watch)(Tally(), LagMeter())
    assert snapshot.overlapping == ("shard 3/3",)


def test_sample_far_ahead_of_the_clock_is_not_the_newest():
    pipeline = Pipeline()
    source = MemorySource(shift())
    run(source, pipeline, keep_open=True)
    moment = BEGIN + 600.0
    for _ in range(2):
        snapshot = SnapshotTaker(pipeline, source, now=lambda: moment)(Tally(), LagMeter())
        assert snapshot.newest_sample_s is None
        assert snapshot.active_vehicles == 0


def test_lag_counts_single_samples_only():
    meter = LagMeter()
    for key, payload in (
        ("fleet/a/telemetry", b'{"vehicle_id": "a", "time_s": 97.0}'),
        ("fleet/a/telemetry", b'{"time_s": 1000.0}'),
        ("fleet/a/telemetry", b'[{"time_s": 97.0}]'),
        ("fleet/a/telemetry", b'{"time_s": "x"}'),
        ("fleet/a/telemetry", b"\xff"),
        ("weather/a", b'{"time_s": 97.0}'),
    ):
        meter.observe(Message(key, payload, 100 * 10**9))
    counted = meter.count()
    assert counted.counts[LAG_BUCKETS.index(5.0)] == 1
    assert counted.counts[0] == 1
    assert (sum(counted.counts), counted.total) == (2, 3.0)


def test_counts_of_the_source_are_taken_over_as_far_as_it_has_them():
    pipeline, source = Pipeline(), MemorySource([])
    assert SnapshotTaker(pipeline, source)(Tally(), LagMeter()).missed is None
    given = {"missed": 1, "dropped": {"bytes": 4}, "queue_messages": 5, "queue_bytes": 6, "is_catching_up": True}
    for name, value in given.items():
        setattr(source, name, value)
    snapshot = SnapshotTaker(pipeline, source)(Tally(), LagMeter())
    assert {name: getattr(snapshot, name) for name in OF_SOURCE} == given


def test_lost_and_recovered_samples_are_taken_over():
    pipeline = Pipeline()
    pipeline.take(telemetry(drive(50, speed=10.0) | {"seq": np.arange(50)})[::2])
    snapshot = SnapshotTaker(pipeline, MemorySource([]), per_vehicle=True)(Tally(recovered=4), LagMeter())
    assert (snapshot.lost, snapshot.recovered) == (24, 4)
    assert snapshot.of_vehicles.lost == (24,)
