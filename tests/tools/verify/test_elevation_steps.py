"""Test that the compiled smoother equals filterpy's at gaps, maps, stands and wrong fixes, and that errors are seen."""

import numpy as np
import pytest

from socast.core.cleaning.elevation_filter import LENGTH, RideSteps
from socast.tools.verify import elevation_witness
from socast.tools.verify.elevation_steps import compare_ride
from socast.tools.verify.elevation_witness import discretise
from socast.tools.verify.records import GOAL

NOISE = 1e-5, 1.0, 5.0
N = 200


def make_ride(seed=1, **changed):
    """Return a ride over hills, with stands, short and long steps and missing fixes, without a map."""
    rng = np.random.default_rng(seed)
    distance = np.where(rng.random(N) < 0.2, 0.0, rng.gamma(0.5, 40.0, N))
    fix = 50.0 + 10.0 * np.sin(np.cumsum(distance) / 900.0) + rng.normal(0.0, 1.0, N)
    fix[rng.random(N) < 0.3] = np.nan
    columns = {"distance": distance, "time": np.full(N, 3.0), "fix": fix}
    return RideSteps(**(columns | {"ground": np.full(N, np.nan), "ground_variance": np.zeros(N)} | changed))


def begin_without_fixes(ride):
    ride.fix[:20] = np.nan


def jump_far(ride):
    ride.distance[100] = 30.0 * LENGTH


def report_wrong_heights(ride):
    ride.fix[[40, 80, 81]] = 400.0


def change_reference(ride):
    ride.fix[120:] += 300.0


def change_slope_where_the_car_stands(ride):
    ride.distance[90:110] = 0.0
    ride.fix[90:110] = ride.fix[89] = 50.0
    ride.distance[110:] = 5.0
    ride.fix[100:] = 62.0 + 0.3 * np.cumsum(ride.distance[100:])


def know_ground(ride):
    ride.ground[50:150] = 45.0 + np.random.default_rng(3).normal(0.0, 1.0, 100)
    ride.ground_variance[:] = 4.0


@pytest.mark.parametrize(
    "disturb",
    [
        begin_without_fixes,
        jump_far,
        report_wrong_heights,
        change_reference,
        change_slope_where_the_car_stands,
        know_ground,
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_smoother_equals_filterpy(disturb, seed):
    ride = make_ride(seed)
    disturb(ride)
    assert max(compare_ride(ride, NOISE)) < GOAL


@pytest.mark.parametrize("name", ["STEEP", "LENGTH"])
def test_filter_that_is_off_by_a_millionth_misses_the_goal(name, monkeypatch):
    monkeypatch.setattr(elevation_witness, name, (1.0 + 1e-6) * getattr(elevation_witness, name))
    discretise.cache_clear()
    assert max(compare_ride(make_ride(), NOISE)) > GOAL
    discretise.cache_clear()


def test_long_step_loses_the_memory_of_the_slope():
    transition, noise = discretise(100.0 * LENGTH, 1e-5)
    assert transition[1] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert noise[1, 1] == pytest.approx(0.5 * 1e-5 * LENGTH)
