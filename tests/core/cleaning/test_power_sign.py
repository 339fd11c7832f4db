"""Test that a current of the wrong sign is recognised by accelerations or by the charge, and no other current is."""

import numpy as np
import pytest

from socast.core.cleaning.quality import Quality
from tests.support.telemetry import PERIOD, cleaned, count, drive, joined, leaf, picked, ran, telemetry, without

N = 400
CAPACITY = 24.0 * 3.6e6


def metered(n=N, seed=1, sign=1.0, lag=0, noise=300.0, climb=0.0, **columns):
    """Return a drive with the battery power of a small car, some samples late, and its state of charge."""
    made = drive(n, seed=seed, **columns)
    v = made["speed_kmh"] / 3.6
    power = 1500.0 * v * np.gradient(v, PERIOD) + 180.0 * v + 0.4 * v**3 + 900.0 + 1500.0 * 9.81 * climb * v
    power = np.roll(power, lag) + np.random.default_rng(seed).normal(0, noise, n)
    energy = np.cumsum(power) * PERIOD
    made |= {"battery_voltage_v": np.full(n, 360.0), "battery_current_a": sign * power / 360.0}
    return made | {"soc_pct": np.round(80.0 - 100.0 * energy / CAPACITY, 1)}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("charge", [True, False])
def test_inverted_current_is_recognised_within_one_ride(seed, charge):
    columns = metered(seed=seed, sign=-1.0)
    pipeline, _ = ran([leaf(), *telemetry(columns if charge else without(columns, "soc_pct"))])
    ride = pipeline.take_rides().iloc[0]
    assert ride["unfit_reason"] == "current_inverted"
    assert pipeline.quality()["logger_faults"]["current_inverted"] == {"a": 1}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lag", [0, 1])
@pytest.mark.parametrize("climb", [0.0, -0.06])
def test_right_current_is_never_inverted_downhill_or_late(seed, lag, climb):
    clean = cleaned(metered(seed=seed, lag=lag, climb=climb))
    assert count(clean, Quality.CURRENT_INVERTED) == 0


def test_inverted_current_of_a_slow_logger_is_recognised_by_its_charge():
    columns = picked(metered(4000, sign=-1.0), slice(None, None, 20))
    columns |= {"seq": np.arange(200)}
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    assert pipeline.take_rides()["unfit_reason"].tolist()[-1] in {"current_inverted", "too_long"}
    assert pipeline.quality()["samples"]["current_inverted"] > 100


def test_current_that_is_put_right_counts_again():
    wrong, right = metered(sign=-1.0), metered(800)
    columns = joined(wrong, right)
    columns["time_s"] = wrong["time_s"][0] + PERIOD * np.arange(1200)
    columns["seq"] = np.arange(1200)
    clean = cleaned(without(columns, "soc_pct", "latitude_deg", "longitude_deg"))
    inverted = (clean.quality & Quality.CURRENT_INVERTED) != 0
    assert inverted[200:400].all()
    assert not inverted[1000:].any()


def test_inverted_car_teaches_nothing_about_its_battery():
    pipeline, _ = ran([leaf(), *telemetry(metered(800, sign=-1.0))])
    pipeline.take_rides()
    later = metered(800, sign=-1.0)
    later["time_s"] = later["time_s"] + 86_400.0
    pipeline.push(telemetry(later | {"ride_id": np.full(800, "r2", dtype=object)}))
    pipeline.finish()
    assert 15.0 < pipeline.take_rides()["usable_capacity_kwh"].iloc[0] < 30.0
