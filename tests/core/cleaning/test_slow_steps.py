"""Test what becomes of fixes that jump between two samples of a slow logger."""

import numpy as np
import pytest

from socast.core.columns import EARTH_RADIUS
from tests.support.telemetry import PLACE, START, drive, leaf, ran, telemetry

STEP = 60.0
"""Time between two samples. [s]"""


def make_slow_drive(jumps, seed):
    """Return a drive of 50 minutes to the north, of which a share of fixes is 300 m to 2 km away."""
    random = np.random.default_rng(seed)
    rows = 50
    speed = 10.0 + 2.0 * np.sin(np.arange(rows * 60) / 95.0) + 1.0 * np.sin(np.arange(rows * 60) / 11.0)
    metres = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])[::60]
    columns = drive(rows, speed=speed[::60], battery_voltage_v=360.0, battery_current_a=30.0 + np.arange(rows) % 3)
    off = np.where(random.random(rows) < jumps, random.uniform(300.0, 2000.0, rows), 0.0)
    angle = random.uniform(0.0, 2.0 * np.pi, rows)
    columns["time_s"] = START + STEP * np.arange(rows)
    columns["odometer_km"] = np.full(rows, np.nan)
    columns["latitude_deg"] = PLACE[0] + np.degrees((metres + off * np.cos(angle)) / EARTH_RADIUS)
    east = off * np.sin(angle) / EARTH_RADIUS / np.cos(np.radians(PLACE[0]))
    columns["longitude_deg"] = PLACE[1] + np.degrees(east)
    return columns, metres[-1]


def judge(jumps, seed):
    """Return how far the distance of a drive is off, and why it is unfit, None where it is fit."""
    columns, driven = make_slow_drive(jumps, seed)
    pipeline, _ = ran([leaf(period_s=STEP), *telemetry(columns)], keep_forecasts=False)
    ride = pipeline.take_rides().iloc[0]
    why = ride["unfit_reason"] if isinstance(ride["unfit_reason"], str) else None
    return abs(ride["distance_km"] * 1000.0 / driven - 1.0), why


def test_drive_without_jumps_is_fit():
    off, why = judge(0.0, 0)
    assert (off < 0.02, why) == (True, None)


@pytest.mark.parametrize(("jumps", "most"), [(0.1, 1), (0.3, 0), (0.6, 0)])
def test_drives_whose_fixes_jump_are_unfit_where_their_distance_is_wrong(jumps, most):
    judged = [judge(jumps, seed) for seed in range(6)]
    assert sum(off > 0.04 and why is None for off, why in judged) <= most
    assert {why for _, why in judged} <= {None, "speed_contradicted"}
