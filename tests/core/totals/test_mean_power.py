"""Test that samples with mean powers measure the whole energy, and that their noise floor says so."""

import numpy as np
import pytest

from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from tests.support.telemetry import PERIOD, drive, leaf, ran, telemetry

N, FINE = 400, 30
SPANS = {"moment": 0, "before": -FINE, "around": -FINE // 2, "after": 0}


def sample(span, seed):
    """Return a drive with a power that changes within a second, sampled every 3 s, and the true energy. [kWh]"""
    rng = np.random.default_rng(seed)
    steps = np.arange(N * FINE) * PERIOD / FINE
    power = 8e3 + 12e3 * np.sin(steps / 1.7) + 6e3 * np.sin(steps / 0.9 + rng.uniform(0, 6))
    power[: 2 * FINE] = power[-2 * FINE :] = 600.0
    starts = FINE * np.arange(N) + SPANS[span]
    length = 1 if span == "moment" else FINE
    sums = np.append(0.0, np.cumsum(power))
    edges = [np.clip(starts + each, 0, N * FINE) for each in (0, length)]
    means = np.diff(sums[np.array(edges)], axis=0)[0] / np.maximum(edges[1] - edges[0], 1)
    means[edges[1] == edges[0]] = 600.0
    columns = drive(N, seed=seed, battery_voltage_v=360.0, battery_current_a=means / 360.0)
    whole = (N - 1) * FINE
    return columns, power[:whole].sum() * PERIOD / FINE / 3.6e6


def measure(span, announced, seed=1):
    """Return the ride of a logger that announces what its power covers, and the true energy. [kWh]"""
    columns, truth = sample(span, seed)
    about = leaf(power_covers=announced) if announced else leaf()
    pipeline, _ = ran([about, *telemetry(columns)], keep_forecasts=False)
    return pipeline.take_rides(), truth


@pytest.mark.parametrize("span", ["before", "around", "after"])
def test_mean_power_that_is_announced_gives_the_energy_and_a_tenth_of_the_noise(span):
    told, truth = measure(span, span)
    untold, _ = measure(span, None)
    assert told["energy_vi_kwh"][0] == pytest.approx(truth, rel=2e-3)
    floors = [compute_noise_floor(compute_noise_variance(each)) for each in (told, untold)]
    assert floors[0] == pytest.approx(0.1 * floors[1], rel=0.05)


def test_moment_is_what_nothing_announced_means():
    announced, _ = measure("moment", "moment")
    silent, _ = measure("moment", None)
    names = ["energy_vi_kwh", "energy_vi_sd_kwh"]
    assert announced[names].equals(silent[names])


def test_lost_samples_of_mean_power_keep_the_noise_of_what_they_did_not_see():
    columns, _ = sample("before", 2)
    kept = np.ones(N, bool)
    kept[50:350:3] = False
    lost = {name: values[kept] for name, values in columns.items()}
    rides = [
        ran([leaf(power_covers="before"), *telemetry(each)], keep_forecasts=False)[0].take_rides()
        for each in (columns, lost)
    ]
    whole, holed = (float(compute_noise_variance(each)[0]) for each in rides)
    assert holed > 10.0 * whole
