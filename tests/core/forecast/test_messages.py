"""Test the content of the published forecasts, and when they are published."""

import json

import numpy as np
import pytest

from socast.core.models import EXTENDED_PHYSICAL
from socast.core.settings import Settings
from socast.core.wire.messages import Forecast
from tests.support.fleet_days import DAYS, forecasts, shift, trained_pipeline
from tests.support.telemetry import PERIOD, START, drive, leaf, make_message, ran, telemetry, without


def forecasts_of(messages, **options):
    pipeline, out = ran(messages, **options)
    return pipeline, out, [json.loads(message.payload) for message in out]


def full(n=300):
    columns = drive(n, seed=4, battery_voltage_v=360.0, battery_current_a=30.0 + np.arange(n) % 2)
    return columns | {"soc_pct": np.round(80 - 0.01 * np.arange(n), 1)}


def test_forecast_describes_the_sample_behind_it():
    columns = full()
    pipeline, out, published = forecasts_of([leaf(), *telemetry(columns)], prefix="montreal/")
    assert {message.key for message in out} == {"montreal/fleet/a/forecast"}
    assert [message.receipt_ns for message in out] == [int(forecast["time_s"] * 1e9) for forecast in published]
    stamps = set((columns["time_s"]).tolist())
    assert all(forecast["time_s"] in stamps for forecast in published)
    assert all(set(forecast) == set(Forecast.__struct_fields__) - {"next_charge"} for forecast in published)
    row = np.searchsorted(columns["time_s"], [forecast["time_s"] for forecast in published])
    assert [f["ride_distance_km"] for f in published] == pytest.approx(columns["metres"][row] / 1000)
    assert [f["ride_duration_s"] for f in published] == pytest.approx(PERIOD * row)
    assert [f["soc_pct"] for f in published] == pytest.approx(columns["soc_pct"][row], abs=0.5)
    power = 0.36 * columns["battery_current_a"]
    energy = np.r_[0.0, np.cumsum(0.5 * (power[1:] + power[:-1]))] * PERIOD / 3600
    assert [f["ride_energy_measured_kwh"] or 0.0 for f in published[1:]] == pytest.approx(energy[row[1:]])
    predicted = [f["ride_energy_predicted_kwh"] for f in published]
    assert 0.05 < predicted[-1] / (columns["metres"][-1] / 1000) < 0.35
    assert {f["ride_id"] for f in published} == {"r1"}
    assert {f["model"] for f in published} == {f"{EXTENDED_PHYSICAL.name}/{EXTENDED_PHYSICAL.version}"}
    assert pipeline.model is EXTENDED_PHYSICAL


@pytest.mark.parametrize("wait", [6.0, 15.0, 60.0])
def test_forecasts_are_due_by_event_time(wait):
    columns = drive(300, speed=10.0)
    _, _, published = forecasts_of([leaf(), *telemetry(columns)], settings=Settings(forecast_time=wait))
    steps = np.diff([forecast["time_s"] for forecast in published])
    assert np.all(np.ceil(wait / PERIOD) * PERIOD == steps)
    assert published[0]["time_s"] == START


def test_material_change_is_published_at_once():
    columns = drive(100, speed=10.0, soc_pct=80.0)
    columns["soc_pct"][47:] = 78.5
    columns["ride_id"][71:] = "r2"
    _, _, published = forecasts_of([leaf(), *telemetry(columns)], settings=Settings(forecast_time=60.0))
    times = [round((forecast["time_s"] - START) / PERIOD) for forecast in published]
    assert {0, 47, 71} <= set(times)
    assert published[times.index(71)]["ride_id"] == "r2"
    assert published[times.index(71)]["ride_distance_km"] == 0.0


def test_parked_car_gets_fewer_forecasts():
    columns = drive(400, speed=0.0, soc_pct=70.0)
    columns["ride_id"][:] = None
    _, _, published = forecasts_of(telemetry(columns))
    assert 18 <= len(published) <= 22
    assert {forecast["ride_id"] for forecast in published} == {None}


def test_unknown_values_are_null():
    _, _, published = forecasts_of(telemetry(drive(60, speed=10.0)))
    for name in ("ride_energy_predicted_kwh", "ride_energy_measured_kwh", "soc_pct", "soc_sd_pct", "range_km"):
        assert {json.dumps(forecast[name]) for forecast in published} == {"null"}, name


def test_faults_are_counted_from_the_beginning_of_the_ride():
    columns = without(full(200), "latitude_deg", "longitude_deg")
    columns["speed_kmh"][[30, 31]] = 900.0
    columns["soc_pct"][40] = 300.0
    columns["time_s"][50] += 1.2
    messages = [leaf(), *telemetry(columns)]
    sent = messages[60]  # again with other bytes, so that they are not the same message
    messages[60:60] = [sent._replace(payload=sent.payload + b" " * spaces) for spaces in (1, 2, 3)]
    del messages[100:105]
    _, _, published = forecasts_of([*messages, make_message("ride", ride_id="r1", event="end")])
    assert published[-1]["quality"] == {
        "repaired_time": 1,
        "rejected_speed": 2,
        "duplicate": 3,
        "gap": 1,
        "out_of_range": 1,
    }
    assert published[0]["quality"] == dict.fromkeys(published[0]["quality"], 0)


def test_newest_only_returns_last_forecast_of_each_vehicle():
    messages = [leaf("a"), leaf("b"), *telemetry(full(), "a"), *telemetry(full(), "b")]
    whole, out = ran(messages)
    late = type(whole)()
    late.take(messages)
    newest = late.forecasts(newest_only=True)
    assert [message.key for message in newest] == ["fleet/a/forecast", "fleet/b/forecast"]
    assert newest[0] == [message for message in out if message.key == "fleet/a/forecast"][-1]
    assert newest[1] == out[-1]


def test_range_and_end_intervals_contain_their_mean():
    published = list(forecasts(trained_pipeline().push([m for _, m in shift("c", DAYS)]), "c").values())
    for forecast in published[2:]:
        for interval in (forecast.range_km, forecast.soc_end_of_shift_pct):
            assert interval.p05 <= interval.mean <= interval.p95
        assert forecast.soc_end_of_shift_pct.p05 >= 0.0
        assert forecast.soc_end_of_shift_pct.p95 <= 100.0
        assert 0.0 < forecast.soc_sd_pct < 2.0
        assert 0.0 <= forecast.reserve_risk <= 1.0
        assert (forecast.ride_id is None) == (forecast.ride_energy_predicted_kwh is None)


def test_pipeline_without_any_shift_publishes_a_wide_interval():
    _, _, published = forecasts_of(
        [leaf(), make_message("plan", shift_end_s=START + 7200.0, reserve_soc_pct=10.0, legs=[]), *telemetry(full())]
    )
    for forecast in published:
        assert forecast["soc_sd_pct"] > 0.0
        end, reach = forecast["soc_end_of_shift_pct"], forecast["range_km"]
        assert end["p95"] - end["p05"] > 2.0
        assert reach["p95"] - reach["p05"] > 0.5 * reach["mean"]
        assert 0.0 <= forecast["reserve_risk"] <= 1.0
