"""Test that forecasts which no car can have are withheld, and that faulty telemetry no longer leads to them."""

import json
from collections import Counter

import msgspec
import numpy as np
import pytest

from socast.core.forecast.plausibility import withhold_implausible
from socast.core.forecast.soc_filter import BEYOND_MARGIN
from socast.core.wire.messages import Interval, LegOutlook, Outlook
from tests.support.fleet_days import CARS, DAY, DAYS, columns, days, forecasts, leaf, shift, trained_pipeline
from tests.support.telemetry import drive, ran, telemetry

FAIR = Interval(50.0, 40.0, 60.0)
OUTLOOK = Outlook(
    vehicle_id="a",
    time_s=1.7e9,
    model="m/1",
    soc_pct=80.0,
    soc_sd_pct=1.0,
    usable_capacity_kwh=20.0,
    usable_capacity_sd_kwh=1.0,
    consumption_scale=1.0,
    asked=LegOutlook(10.0, 1000.0, Interval(2.0, 1.0, 3.0), FAIR),
    legs=[LegOutlook(5.0, 500.0, Interval(1.0, 0.5, 1.5), FAIR)],
    shift_end_s=1.7e9,
    soc_end_of_shift_pct=FAIR,
    reserve_soc_pct=20.0,
    reserve_risk=0.1,
    why_not=None,
)


def test_plausible_forecasts_of_ordinary_days_are_all_published():
    pipeline = trained_pipeline()
    assert len(pipeline.push(days((DAYS,)))) > 500
    assert pipeline.quality()["implausible_forecasts"] == {}


def test_energy_beyond_the_battery_is_withheld_and_counted():
    sent = drive(1500, speed=10.0, battery_voltage_v=1500.0, battery_current_a=1990.0 + np.arange(1500) % 2)
    pipeline, out = ran([leaf(), *telemetry(sent)])
    published = [json.loads(message.payload)["ride_energy_measured_kwh"] for message in out]
    assert max(each for each in published if each is not None) <= 36.0
    assert pipeline.quality()["implausible_forecasts"]["ride_energy"] > 200


def test_charge_that_is_reported_no_more_never_leads_below_empty():
    sent = columns("c", DAYS, hours=24.0)
    sent["soc_pct"][100:] = sent["soc_pct"][100]  # the display is frozen
    sent["speed_kmh"][100:] = 100.0
    pipeline = trained_pipeline()
    out = pipeline.push([message for _, message in shift("c", DAYS, sent)])
    charges = [each.soc_pct for each in forecasts(out, "c").values() if each.soc_pct is not None]
    assert min(charges) == 0.0
    assert pipeline.engine.state["soc"][CARS.index("c")] >= -BEYOND_MARGIN


def test_odometer_bridges_no_more_than_a_day():
    sent = drive(400, speed=10.0, odometer_km=1000.0 + np.arange(400) * 0.03)
    for each in ("latitude_deg", "longitude_deg", "speed_kmh"):
        del sent[each]
    sent["time_s"][200:] += 100 * DAY
    sent["odometer_km"][200:] += 200_000.0
    pipeline, _ = ran([leaf(), *telemetry(sent)])
    assert pipeline.take_rides()["distance_km"].max() < 100.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_absurd_meter_of_some_cars_does_not_disorder_the_ranges_of_others(sign):
    pipeline = trained_pipeline()
    for day in range(DAYS, DAYS + 3):
        messages = []
        for car in "ab":
            sent = columns(car, day)
            sent["battery_current_a"] = sign * (1990.0 + np.arange(len(sent["time_s"])) % 2)
            sent["battery_voltage_v"][:] = 1500.0
            messages += shift(car, day, sent)
        honest = [each for car in "cdef" for each in shift(car, day)]
        out = pipeline.push([m for _, m in sorted([*messages, *honest], key=lambda each: each[0])])
    ranges = [each.range_km for each in forecasts(out, "c").values() if each.range_km]
    assert len(ranges) > 50
    assert all(0.0 <= each.p05 <= each.mean <= each.p95 < 1000.0 for each in ranges)


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"soc_end_of_shift_pct": Interval(50.0, 60.0, 70.0)}, "interval_order"),
        ({"soc_end_of_shift_pct": Interval(150.0, 60.0, 170.0)}, "end_of_shift"),
        ({"reserve_risk": 1.1}, "reserve_risk"),
        ({"legs": [LegOutlook(5.0, 500.0, Interval(95_188.0, 1.0, 2e5), FAIR)]}, "leg_energy"),
        ({"asked": LegOutlook(5.0, 500.0, Interval(np.inf, 1.0, 2.0), FAIR)}, "leg_energy"),
    ],
)
def test_answer_that_is_not_plausible_is_null_and_says_why(changed, cause):
    counted = Counter()
    answer = withhold_implausible(msgspec.structs.replace(OUTLOOK, **changed), counted)
    assert counted == {cause: 1}
    assert cause in answer.why_not
    assert answer.soc_end_of_shift_pct is answer.reserve_risk is answer.asked.energy_kwh is answer.asked.soc_pct is None
    assert answer.legs[0].energy_kwh is None


def test_plausible_answer_is_unchanged():
    counted = Counter()
    assert withhold_implausible(OUTLOOK, counted) is OUTLOOK
    assert not counted
