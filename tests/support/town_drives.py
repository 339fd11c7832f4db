"""Drives through a town in two dimensions, with corners and stops, and receivers with white and correlated errors."""

from typing import Any

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import EARTH_RADIUS
from tests.support.telemetry import PLACE, START, Columns

STEP = 0.1
"""Step of the simulation. [s]"""
RADIUS = 8.0
"""Radius of a corner. [m]"""


def town_drive(seed: int, period: float = 3.0, duration: float = 900.0, park: float = 0.0) -> Columns:
    """Return a drive from rest to rest as wire columns without a speed, and its true `metres` and speed `v`.

    Legs of 100 to 600 m end in a stop of 10 to 40 s, in a corner, or go on. `park` is the time at rest at the end. [s]
    """
    rng = np.random.default_rng(seed)
    speeds, turns = [np.zeros(150)], [np.zeros(150)]
    while STEP * sum(map(len, speeds)) < duration:
        cruise, length, end = rng.uniform(8.0, 15.0), rng.uniform(100.0, 600.0), rng.integers(3)
        goal = (0.0, 4.0, cruise)[end]
        v, at, leg = float(speeds[-1][-1]), 0.0, []
        while at < length:
            slows = length - at <= max(0.0, v * v - goal * goal) / 3.0
            v = max(goal, 0.3, v - 1.5 * STEP) if slows else min(cruise, v + 1.2 * STEP)
            at += v * STEP
            leg.append(v)
        speeds.append(np.array(leg))
        turns.append(np.zeros(len(leg)))
        if end == 0:
            rest = int(rng.uniform(10.0, 40.0) / STEP)
            speeds.append(np.zeros(rest))
            turns.append(np.zeros(rest))
        if end == 1:
            corner = int(0.5 * np.pi * RADIUS / v / STEP)
            speeds.append(np.full(corner, v))
            turns.append(np.full(corner, rng.choice([-0.5, 0.5]) * np.pi / corner))
    rest = int((30.0 + park) / STEP)
    v, turn = np.concatenate([*speeds, np.zeros(rest)]), np.concatenate([*turns, np.zeros(rest)])
    course = rng.uniform(0.0, 6.28) + np.cumsum(turn)
    every = slice(None, None, round(period / STEP))
    metres, north, east = (np.cumsum(v * STEP * f)[every] for f in (1.0, np.cos(course), np.sin(course)))
    n = len(metres)
    return {
        "time_s": START + period * np.arange(n),
        "seq": np.arange(n),
        "metres": metres,
        "v": v[every],
        **locate(north, east),
    }


def locate(north: Floats, east: Floats) -> Columns:
    """Return the coordinates of places in metres north and east of `PLACE`."""
    return {
        "latitude_deg": PLACE[0] + np.degrees(north / EARTH_RADIUS),
        "longitude_deg": PLACE[1] + np.degrees(east / EARTH_RADIUS / np.cos(np.radians(PLACE[0]))),
    }


def with_noise(columns: Columns, sd: float, time: float = 0.0, seed: int = 0, rows: Any = slice(None)) -> Columns:
    """Return columns whose fixes have an error of that deviation [m] and correlation time [s] on each axis."""
    rng, out = np.random.default_rng(seed), dict(columns)
    stamps = columns["time_s"][rows]
    keep = np.exp(-np.diff(stamps, prepend=stamps[0] - 1e9) / time) if time > 0.0 else np.zeros(len(stamps))
    for name, scale in (("latitude_deg", 1.0), ("longitude_deg", np.cos(np.radians(PLACE[0])))):
        error, noise = np.zeros(len(stamps)), rng.normal(0.0, sd, len(stamps))
        for i in range(len(stamps)):
            error[i] = keep[i] * error[i - 1] + np.sqrt(1.0 - keep[i] ** 2) * noise[i]
        out[name] = columns[name].copy()
        out[name][rows] += np.degrees(error / EARTH_RADIUS / scale)
    return out
