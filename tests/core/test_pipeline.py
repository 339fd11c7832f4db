"""Test the pipeline: counters, status, tables and snapshots."""

import msgspec
import numpy as np
import pytest

from socast.core.cleaning.quality import CAUSES
from socast.core.errors import SettingsError, SocastError
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.snapshot import seal_snapshot
from tests.support.telemetry import START, drive, leaf, make_message, observed, ran, telemetry

NAMES = 400
"""Number of ride names that a pipeline remembers in the test of this limit."""


def full(n=200, seed=4):
    current = 30.0 + np.cos(np.pi * np.arange(n))  # one that never changes in town is frozen
    columns = drive(n, seed=seed, battery_voltage_v=360.0, battery_current_a=current)
    return columns | {"soc_pct": np.round(80 - 0.01 * np.arange(n), 1)}


def test_counters_equal_the_numbers_of_sent_messages():
    messages = [
        leaf(),
        observed(),
        make_message("plan", shift_end_s=START + 7200.0, reserve_soc_pct=10.0, legs=[]),
        *telemetry(full()),
    ]
    messages.append(messages[-1]._replace(payload=b"{"))
    pipeline, out = ran(messages)
    quality = pipeline.quality()
    assert quality["received"] == {"telemetry": 200, "vehicle": 1, "weather": 1, "plan": 1}
    assert quality["undecodable"] == {"not_json": 1}
    assert set(quality["samples"]) == set(CAUSES)
    assert quality["vehicles"] == 1
    assert quality["rides"] == 1
    assert len(out) > 10


def test_status_holds_the_newest_values_of_every_vehicle_with_samples():
    messages = [leaf("a"), leaf("b"), *telemetry(full(), "a"), make_message("ride", "c", ride_id="x", event="start")]
    pipeline = Pipeline()
    pipeline.push(messages)
    (status,) = pipeline.status()
    forecast = status.forecast
    assert (forecast.vehicle_id, status.vehicle_model, forecast.ride_id) == ("a", "nissan-leaf-2013", "r1")
    assert status.soc_pct == pytest.approx(78.0)
    assert forecast.ride_distance_km == pytest.approx(full()["metres"][-1] / 1000)
    assert forecast.ride_energy_measured_kwh == pytest.approx(10.8 * 199 * 3 / 3600)
    assert forecast.soc_pct == pytest.approx(78.0, abs=1.0)


def test_status_keeps_the_newest_values_after_the_end_of_the_stream():
    pipeline = Pipeline()
    pipeline.push([leaf("a"), *telemetry(full(), "a")])
    (before,) = pipeline.status()
    pipeline.finish()
    (after,) = pipeline.status()
    assert (after.forecast.time_s, after.soc_pct) == (before.forecast.time_s, before.soc_pct)
    assert (after.forecast.ride_id, after.forecast.ride_distance_km) == (None, 0.0)
    assert not any(msgspec.structs.astuple(after.forecast.quality))


def test_state_of_a_model_with_other_effects_keeps_what_holds_and_says_what_differs():
    messages = [leaf("a"), *telemetry(full(), "a")]
    before, whole = Pipeline(BASIC_PHYSICAL), Pipeline(BASIC_PHYSICAL, also=["headwind"])
    before.push(messages[:100])
    whole.push(messages)
    richer = Pipeline(BASIC_PHYSICAL, also=["headwind"])
    richer.restore(before.snapshot())
    assert richer.model_change == "effects that are new: headwind"
    again = Pipeline(BASIC_PHYSICAL)
    again.restore(richer.snapshot())
    assert again.model_change == "effects that are not used any more: headwind"
    assert repr(again.status()) == repr(before.status())
    for pipeline in (richer, again):
        pipeline.push(messages[100:])
        assert repr(pipeline.status()) == repr(whole.status())
        pipeline.finish()
    whole.finish()
    ride, expected = richer.take_rides().iloc[0], whole.take_rides().iloc[0]
    assert np.isnan(ride["effect_headwind"])
    assert ride.drop("effect_headwind").equals(expected.drop("effect_headwind"))


def test_ride_in_progress_has_no_prediction_where_its_model_has_a_new_effect():
    messages = [leaf("a"), *telemetry(full(), "a")]
    first, second = Pipeline(BASIC_PHYSICAL), Pipeline(EXTENDED_PHYSICAL)
    first.push(messages[:100])
    second.restore(first.snapshot())
    second.push(messages[100:])
    (status,) = second.status()
    assert status.forecast.ride_energy_predicted_kwh is None
    assert status.forecast.ride_energy_measured_kwh > 0
    assert second.model_change.startswith("it was made with model basic_physical/1, now extended_physical/1; effects")
    second.restore(second.snapshot())
    assert second.model_change == ""


def test_car_of_unknown_model_is_measured_and_its_missing_prediction_counted():
    pipeline, _ = ran([make_message("vehicle", model="horse"), *telemetry(full())])
    ride = pipeline.take_rides().iloc[0]
    assert ride["vehicle_model"] == "horse"
    assert ride["energy_kwh"] > 0
    assert np.isnan(ride["mass_kg"])
    assert pipeline.quality()["unpredictable"] == {"unknown_vehicle_model": 1}
    assert len(pipeline.quality()["unknown_models"]) == 1


def test_setting_outside_its_limits_is_named():
    with pytest.raises(SettingsError, match=r"window is 99, but must be from 0 to 8"):
        Pipeline(settings=Settings(window=99))


def test_invalid_snapshot_is_refused_in_one_line():
    pipeline = Pipeline()
    for bad in (
        b"",
        b"\xff" * 40,
        msgspec.msgpack.encode([1]),
        msgspec.msgpack.encode({"version": 1}),
        seal_snapshot({"effects": [1], "model": "a/1"}),
    ):
        with pytest.raises(SocastError) as error:
            pipeline.restore(bad)
        assert "\n" not in str(error.value)


def test_snapshot_made_with_other_settings_continues_with_the_new_settings():
    pipeline = Pipeline()
    pipeline.push([leaf(), *telemetry(full())])
    other = Pipeline(settings=Settings(forecast_time=60.0))
    other.restore(pipeline.snapshot())
    assert other.settings.forecast_time == 60.0
    assert len(other.status()) == 1


def test_model_predicts_plausible_consumption_from_the_ride_table():
    pipeline, _ = ran([leaf(), *telemetry(full())])
    rides = pipeline.take_rides()
    predicted = pipeline.model.predict_energy(rides)
    assert 0.05 < predicted[0] / rides["distance_km"][0] < 0.35


def test_additional_effects_are_summed_and_change_no_forecast():
    messages = [leaf(), *telemetry(full())]
    plain, out = ran(messages)
    more, same = ran(messages, also=["climbing_up", "rolling"])
    assert same == out
    rides = more.take_rides()
    assert "effect_climbing_up" in rides
    assert rides.columns.is_unique
    shared = list(plain.take_rides())
    assert set(shared) <= set(rides)


def test_pipeline_without_tables_keeps_no_rides_or_windows():
    columns = full(400)
    columns["ride_id"] = np.repeat(np.array([f"r{i}" for i in range(20)], dtype=object), 20)
    pipeline, _ = ran([leaf(), *telemetry(columns)], keep_tables=False)
    assert pipeline.take_rides().empty
    assert pipeline.take_windows().empty
    assert pipeline.quality()["rides"] == 20


def test_number_of_kept_ride_names_is_limited(monkeypatch):
    monkeypatch.setattr("socast.core.wire.rides.NAMES", NAMES)
    pipeline = Pipeline(keep_tables=False)
    columns, half = drive(3 * NAMES, speed=10.0), 3 * NAMES // 2
    columns["ride_id"] = np.array([f"r{i // 2}" for i in range(3 * NAMES)], dtype=object)
    columns["ride_id"][:half] = np.array([f"x{i}" for i in range(half)], dtype=object)
    messages = telemetry(columns)
    messages += [
        m._replace(payload=m.payload.replace(b'": "r', b'": "y').replace(b'": "x', b'": "z')) for m in messages
    ]
    out, kept, step = [], [], 3 * NAMES // 4 + 1  # odd, so that lists end within rides of two samples
    for start in range(0, len(messages), step):
        out += pipeline.push(messages[start : start + step])
        kept.append(len(pipeline.decoder.rides))
    assert max(kept) < 2 * NAMES
    assert min(kept[-4:]) < NAMES
    names = {msgspec.json.decode(message.payload)["ride_id"] for message in out}
    assert None not in names
    assert pipeline.quality()["rides"] == len(names) - 1  # the last ride is open, and none was cut by forgetting it


def test_damaged_snapshot_is_refused():
    kept = Pipeline()
    kept.push([leaf(), *telemetry(drive(30))])
    content = kept.snapshot()
    for at in (0, 40, len(content) // 2, len(content) - 1):
        damaged = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
        with pytest.raises(SocastError, match="damaged"):
            Pipeline().restore(damaged)
    with pytest.raises(SocastError, match="damaged"):
        Pipeline().restore(content[:-10])


def test_pipeline_without_forecasts_makes_the_same_tables():
    sent = [leaf(), *telemetry(drive(300))]
    whole, tables = Pipeline(), Pipeline(keep_forecasts=False)
    whole.push(sent)
    tables.take(sent)
    assert tables.forecasts() == []
    for pipeline in (whole, tables):
        pipeline.finish()
    assert whole.take_rides().equals(tables.take_rides())
