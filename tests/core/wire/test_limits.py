"""Test the limits of what is taken in: what exceeds them is counted, and nothing else changes."""

import json

import numpy as np
import pytest

from socast.core.batch import Lanes
from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire import rate_limit
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.core.wire.rate_limit import RateLimit
from tests.support.telemetry import drive, leaf, make_message, observed, ran, telemetry

SECOND = 10**9


def sample(vehicle="a", key=None, **fields):
    payload = json.dumps({"vehicle_id": vehicle, "time_s": 1.7e9} | fields).encode()
    return Message(key or f"fleet/{vehicle}/telemetry", payload, 0)


def count(limits, *messages):
    """Return the counters of a decoder with limits."""
    decoder = Decoder(Lanes(), limits)
    batch, _ = decoder.decode(messages)
    return batch.size, dict(decoder.rejected)


def test_larger_payload_is_refused_whether_the_car_is_known_or_not():
    large = sample(note="x" * 2000, seq=1)
    assert count(Limits(payload_bytes=1000), large, sample(), large) == (1, {"too_large": 2})
    assert count(Limits(payload_bytes=3000), large, sample(), large) == (3, {})


def test_list_of_too_many_samples_is_refused_as_a_whole():
    of_three = Message("fleet/a/telemetry", b"[" + b",".join([sample().payload] * 3) + b"]", 0)
    assert count(Limits(list_samples=2), of_three) == (0, {"too_many_samples": 3})
    assert count(Limits(list_samples=3), of_three) == (3, {})


def test_new_vehicles_beyond_the_limit_are_ignored_and_known_ones_go_on():
    decoder = Decoder(Lanes(), Limits(vehicles=2))
    messages = [sample(name) for name in "abcacb"] + [make_message("ride", "d", ride_id="r", event="start")]
    batch, events = decoder.decode(messages)
    assert batch.lane.tolist() == [0, 1, 0, 1]
    assert not events
    assert decoder.rejected == {"too_many_vehicles": 3}
    assert decoder.received == {"telemetry": 4}
    assert decoder.lanes.names == ["a", "b"]


def test_new_stations_beyond_the_limit_are_ignored_and_known_ones_go_on():
    pipeline = Pipeline(limits=Limits(stations=2))
    pipeline.push([observed(name, 1.7e9 + i, temperature_c=1.0) for i, name in enumerate("abcabcd")])
    quality = pipeline.quality()
    assert quality["received"]["weather"] == 4
    assert quality["undecodable"] == {"too_many_stations": 3}
    restored = Pipeline(limits=Limits(stations=1))
    restored.restore(pipeline.snapshot())
    assert len(restored.totals.stations) == 2


def test_new_vehicle_models_beyond_the_limits_do_not_change_their_cars():
    pipeline = Pipeline(limits=Limits(vehicle_models=1, vehicles=2))
    pipeline.push(
        [leaf(), make_message("vehicle", model="horse"), leaf(mass_kg=1600.0), leaf(mass_kg=1700.0), leaf(time=2.0)]
    )
    assert pipeline.quality()["unpredictable"] == {"too_many_models": 2}
    assert [message and message.mass_kg for message in pipeline.cars.messages] == [None, None, 1600.0]
    assert pipeline.cars.of_lane[0] == 1
    restored = Pipeline(limits=Limits(vehicle_models=1, vehicles=1))
    restored.restore(pipeline.snapshot())
    assert len(restored.cars.models) == 3
    restored.push([leaf(mass_kg=1800.0)])
    assert restored.quality()["unpredictable"] == {"too_many_models": 3}


@pytest.mark.parametrize(
    "message",
    [
        sample(ride_id="é" * 257),
        make_message("ride", ride_id="r" * 257, event="end"),
        make_message("ride", ride_id="r", event="start", driver_id="d" * 257),
        make_message("vehicle", model="m" * 257),
        sample(key="x" * 512 + "/fleet/a/telemetry"),
    ],
    ids=["ride_id", "ride", "driver", "model", "key"],
)
def test_text_that_is_too_long_is_refused(message):
    assert count(Limits(), message, sample(ride_id="é" * 256)) == (1, {"too_long": 1})


@pytest.mark.parametrize(("name", "value"), [("vehicles", 0), ("key_rate", -1.0), ("payload_bytes", 1e12)])
def test_impossible_limit_is_an_error(name, value):
    with pytest.raises(SettingsError, match=f"{name} is .*, but must be from"):
        Pipeline(limits=Limits(**{name: value}))


def received(times, key="k"):
    return [Message(key, b"{}", int(time * SECOND)) for time in times]


def test_rate_is_held_after_a_burst_and_other_keys_are_not_affected():
    limit = RateLimit(rate=10.0, burst=20.0)
    flood = received(np.arange(0.0, 10.0, 0.01))
    calm = received(np.arange(0.0, 10.0, 0.5), "other")
    kept = limit.select(sorted([*flood, *calm], key=lambda message: message.receipt_ns))
    assert len([message for message in kept if message.key == "k"]) == pytest.approx(20 + 10 * 10, abs=2)
    assert [message for message in kept if message.key == "other"] == calm


def test_rate_limit_decides_the_same_for_any_division():
    messages = received(np.arange(500) * 0.04 + np.random.default_rng(0).normal(0.0, 0.1, 500) + 1.0)  # in disorder
    whole = list(RateLimit(5.0, 3.0).select(messages))
    limit = RateLimit(5.0, 3.0)
    assert [message for start in range(0, 500, 7) for message in limit.select(messages[start : start + 7])] == whole
    assert 50 < len(whole) < 200


def test_full_buckets_of_many_made_up_keys_are_forgotten(monkeypatch):
    monkeypatch.setattr(rate_limit, "MOST_KEYS", 100)
    limit = RateLimit(1.0, 5.0)
    assert len(limit.select(received([0.0] * 9, "flood"))) == 5
    for number in range(1000):
        limit.select(received([0.001 * number], f"k{number}"))
        assert len(limit._place) <= 1000 * 5
    assert len(limit.select(received([1.0] * 9, "flood"))) == 1


def test_refused_messages_are_counted_and_the_rest_gives_the_forecasts_of_a_calm_car():
    fine = telemetry(drive(100, speed=10.0))
    flood = [Message("fleet/b/telemetry", b'{"vehicle_id": "b", "time_s": %d}' % i, i) for i in range(1000)]
    limits = Limits(key_rate=50.0, key_burst=100)
    pipeline, out = ran([leaf(), *fine[:50], *flood, *fine[50:]], limits=limits)
    _, expected = ran([leaf(), *fine], limits=limits)
    assert [message for message in out if "/a/" in message.key] == expected
    assert pipeline.quality()["undecodable"] == {"rate_limited": 900}
    assert pipeline.quality()["received"]["telemetry"] == 200
