"""The reader of samples gives the same columns whatever the form of the messages."""

from collections import Counter

import msgspec
import numpy as np

from socast.core.wire.messages import Message
from socast.core.wire.sample_reader import read_samples
from tests.support.batched_recordings import make_batch

SAMPLES = [
    {"vehicle_id": "a", "time_s": 1.7e9, "latitude_deg": 45.5, "longitude_deg": -73.6, "elevation_m": 31.5},
    {"vehicle_id": "a", "time_s": 1.7e9 + 3.0, "speed_kmh": 50.0, "soc_pct": 80.5, "charging": True},
]
KEY = "north/fleet/a/telemetry"


def read(*messages):
    """Return vehicles, numbers of messages and columns of the samples of messages, and what was counted."""
    found = list(read_samples(messages, counts := Counter()))
    vehicle_ids = [each for samples in found for each in samples.vehicle_ids]
    numbers = [each for samples in found for each in samples.numbers]
    return vehicle_ids, numbers, np.concatenate([samples.columns for samples in found], axis=1), counts


def test_single_samples_lists_and_batches_give_the_same_columns():
    encoded = [Message(KEY, msgspec.json.encode(sample), 0) for sample in SAMPLES]
    single = read(*encoded)
    several = read(Message(KEY, msgspec.json.encode(SAMPLES), 0))
    own, gateway = read(make_batch(SAMPLES, KEY)), read(make_batch(SAMPLES))
    for other in (several, own, gateway):
        assert other[0] == single[0] == ["a", "a"]
        np.testing.assert_array_equal(other[2], single[2])
    assert [each[1] for each in (single, several, own, gateway)] == [[0, 1], [0, 0], [0, 0], [0, 0]]
    assert [dict(each[3]) for each in (single, gateway)] == [{"telemetry": 2}, {"batch": 1}]


def test_each_sample_has_the_number_of_its_message():
    one = Message(KEY, msgspec.json.encode(SAMPLES[0]), 0)
    plan, broken = Message("fleet/a/plan", b"{}", 0), Message(KEY, b"{", 0)
    _, numbers, _, counts = read(plan, one, make_batch(SAMPLES), broken, one, one)
    assert numbers == [1, 2, 2, 4, 5]
    assert counts == {"telemetry": 3, "batch": 1, "undecodable": 1}
