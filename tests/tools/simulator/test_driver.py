"""Test that simulated drivers vary their speed as smoothly as the driver of a real car."""

from functools import cache
from typing import Final

import numpy as np
import pytest

from socast.core.columns import KMH
from socast.tools.commands.import_drives import collect_drives
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.simulator.driver import drive_route, make_style
from socast.tools.simulator.settings import PERIOD, STEP
from socast.tools.simulator.world import draw_destination, find_crossing, make_route
from tests.support.paths import REAL_DRIVES

SHARE_OF_REAL_DRIVES: Final = 0.906
"""Share of the kinetic energy gained that samples of the BMW i3 every 3 s show. [1]"""


@cache
def simulate_speeds() -> list[np.ndarray]:
    """Return the speed in steps of 0.5 s on rides of 2 to 12 km. [m/s]"""
    speeds = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        start = find_crossing(float(rng.uniform(-9000, 9000)), float(rng.uniform(-6000, 6000)))
        goal = draw_destination(*start, float(rng.uniform(2000, 12000)), rng)
        motion = drive_route(make_route(start, goal, rng), make_style(rng), 0.3, rng)
        speeds.append(np.append(motion.before[0], motion.after))
    return speeds


@cache
def read_real_speeds() -> list[np.ndarray]:
    """Return the speed of the BMW i3 in steps of 0.5 s. [m/s]"""
    drives = collect_drives([REAL_DRIVES / "bmw_i3"], DATA_SETS["bmw-i3"])
    times = (np.arange(0.0, drive.elapsed[-1], STEP) for drive in drives)
    return [
        np.interp(time, drive.elapsed, drive.rows["speed_kmh"] * KMH) for time, drive in zip(times, drives, strict=True)
    ]


def sum_gains(speed: np.ndarray) -> float:
    """Return the sum of the increases of the squared speed. [m^2/s^2]"""
    return float(np.maximum(np.diff(speed**2), 0.0).sum())


def compute_share_seen(speeds: list[np.ndarray], period: float) -> float:
    """Return the share of the kinetic energy gained that samples show, on average over their phases. [1]"""
    every = round(period / STEP)
    seen = sum(np.mean([sum_gains(speed[phase::every]) for phase in range(every)]) for speed in speeds)
    return float(seen / sum(sum_gains(speed) for speed in speeds))


def test_samples_show_as_much_kinetic_energy_as_in_real_drives():
    assert compute_share_seen(simulate_speeds(), PERIOD) == pytest.approx(SHARE_OF_REAL_DRIVES, abs=0.03)


@pytest.mark.skipif(not REAL_DRIVES.is_dir(), reason=f"the public data sets are not at {REAL_DRIVES}")
def test_real_drives_have_the_share_that_simulated_drives_are_compared_with():
    assert compute_share_seen(read_real_speeds(), PERIOD) == pytest.approx(SHARE_OF_REAL_DRIVES, abs=0.002)
