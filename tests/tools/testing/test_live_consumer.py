"""Test the live consumer for tests: real Zenoh sessions on loopback."""

import threading
from itertools import chain, islice

import pandas as pd
import pytest

from socast.core.errors import AskError, SettingsError
from socast.core.wire.messages import Message
from socast.stream.mcap_reader import McapSource
from socast.tools.testing.live_consumer import LiveConsumer
from socast.tools.testing.made_recording import gather_messages, make_car, write_recording
from socast.tools.testing.replayed import make_options, replay_recordings
from tests.support.paths import RECORDINGS

MODEL = RECORDINGS / "fitted.json"
KEY = ["vehicle_id", "time_s"]


@pytest.fixture
def live(tmp_path):
    """Return a live consumer."""
    with LiveConsumer(MODEL, tmp_path / "live.mcap") as consumer:
        yield consumer


def test_results_are_bit_identical_with_those_of_a_replay(live, tmp_path):
    messages = list(islice(chain.from_iterable(McapSource(RECORDINGS / "shift.mcap")), 8000))
    recording = write_recording(messages, tmp_path / "recorded.mcap")
    live.publish(recording)
    published, replayed = live.finish(), replay_recordings([recording], make_options(MODEL), tmp_path / "replayed.mcap")
    assert len(published.forecasts) > 500
    one, other = (each.forecasts.sort_values(KEY, ignore_index=True) for each in (published, replayed))
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    pd.testing.assert_frame_equal(published.rides, replayed.rides, check_exact=True)
    pd.testing.assert_frame_equal(published.quality.sort_index(), replayed.quality.sort_index())


def test_results_grow_with_what_is_published_and_rides_close_at_the_end(live):
    car = make_car(speed_kmh=[(0, 0), (60, 50), (600, 50)], soc_pct=[(0, 80), (600, 77)])
    live.publish(car[:100])
    first = live.results()
    live.publish(car[100:])
    second = live.results()
    assert 0 < len(first.forecasts) < len(second.forecasts)
    assert (len(first.rides), len(second.rides)) == (0, 0)
    last = live.finish()
    assert last.rides["distance_km"].sum() == pytest.approx(7.875, abs=0.05)
    assert last.quality.loc["received.telemetry", "count"] == len(car) - 1
    assert last.file.stat().st_size > 0


def test_consumer_answers_questions(live):
    live.publish(make_car("taxi-1"))
    assert live.ask("taxi-1", distance_km=10, duration_s=900)["asked"]["distance_km"] == 10.0
    with pytest.raises(AskError):
        live.ask("taxi-9")


def test_consumer_listens_on_loopback_only(live):
    assert live.endpoint.startswith("tcp/127.0.0.1:")
    assert not live.endpoint.endswith(":0")


def test_two_consumers_do_not_hear_each_other(live, tmp_path):
    with LiveConsumer("extended_physical", tmp_path / "other.mcap") as other:
        assert other.endpoint != live.endpoint
        other.publish(make_car())
        assert live.results().forecasts.empty
        assert other.results().forecasts["model"].str.startswith("extended_physical").all()


def test_close_ends_thread_and_sessions_and_may_be_called_twice(tmp_path):
    consumer = LiveConsumer(MODEL, tmp_path / "live.mcap")
    consumer.close()
    consumer.close()
    assert not any(thread.name == "socast-live" for thread in threading.enumerate())
    with pytest.raises(SettingsError, match="the consumer has ended"):
        consumer.publish(make_car())


def test_failure_of_the_consumer_is_raised_in_the_test(live, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("of the model")

    monkeypatch.setattr(live._pipeline, "take", fail)
    with pytest.raises(ZeroDivisionError, match="of the model"):
        live.publish(make_car())


def test_recorded_forecasts_are_no_input_and_keys_with_a_prefix_are_refused(live, tmp_path):
    car = make_car()
    forecast = Message("fleet/taxi-1/forecast", b"{}", car[0].receipt_ns)
    live.publish(write_recording(gather_messages(car, [forecast]), tmp_path / "made.mcap"))
    assert "received.forecast" not in live.results().quality.index
    with pytest.raises(SettingsError, match="key 'montreal/fleet/a/telemetry' has a prefix"):
        live.publish([Message("montreal/fleet/a/telemetry", b"{}", 0)])
