"""Rides of a car strung into shifts, so that public drives can test forecasts of a shift's end.

Nothing in a ride changes but its time and its state of charge: rides follow each other after short pauses, and each
goes on where the one before it ended, by its own fall. The plan of a shift is made up as the simulator makes it:
distance and time of each ride as they were, with the errors of somebody who plans.
"""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np

from core.batch import Floats
from core.wire.messages import Leg, Message, Plan
from tools.importers.drive import Drive, message, moved
from tools.importers.resample import LONGEST_HOLD

PAUSE: Final = 300.0
"""Time between two rides of a shift. [s]"""
NIGHT: Final = 8 * 3600.0
"""Time between two shifts, at least. [s]"""
SEASON: Final = 30 * 86_400.0
"""Rides farther apart were not driven in the same weather, and are in no shift together. [s]"""
FULL: Final = 95.0
"""State of charge with which a shift begins. [%]"""
LEAST: Final = 5.0
"""A ride that would end below it is the first of the next shift. [%]"""
RESERVE: Final = 10.0
"""State of charge that the plan keeps, as the simulator's does. [%]"""
DISTANCE_ERROR: Final = 0.04
"""Standard deviation of a planned distance, over the distance, as in the simulator. [1]"""
DURATION_ERROR: Final = 0.12
"""The same of the logarithm of a planned time. [1]"""
HILL: Final = 10.0
"""Undulations of this height are the sensor's. [m]"""


class Strung(NamedTuple):
    """Rides of one car in a shift, in order: moved, and their state of charge continued."""

    drives: tuple[Drive, ...]

    @property
    def end(self) -> float:
        """Unix time at which the shift ends [s]."""
        return self.drives[-1].end


def strung(drives: Iterable[Drive], hours: float) -> list[Strung]:
    """Put the rides of each car, in their order, into shifts.

    A shift is over with the ride by which it has lasted so long, before a ride for which the battery would not do, and
    before one that was driven in another season.

    Parameters
    ----------
    drives : iterable of Drive
        In order.
    hours : float
        Length of a shift. [h]

    Returns
    -------
    list of Strung
        By car and time. The first of a car begins when its first ride did, each other one when its own did or
        `NIGHT` after the one before it.
    """
    shifts: list[Strung] = []
    by_car = sorted(drives, key=lambda drive: (drive.vehicle_id, drive.start))
    for _, own in groupby(by_car, key=lambda drive: drive.vehicle_id):
        free_from = -np.inf
        for rides in _grouped(list(own), hours * 3600.0):
            shifts.append(_placed(rides, max(rides[0].start, free_from)))
            free_from = shifts[-1].end + NIGHT
    return shifts


def plans(shift: Strung) -> list[Message]:
    """Return the plans of a shift: as its first ride begins of them all, and as each ends of those still ahead.

    Parameters
    ----------
    shift : Strung

    Returns
    -------
    list of Message
        By time.
    """
    legs = [leg(drive) for drive in shift.drives]
    times = [shift.drives[0].start, *(drive.end for drive in shift.drives)]
    vehicle = shift.drives[0].vehicle_id
    return [
        message(f"fleet/{vehicle}/plan", Plan(vehicle, round(when, 3), round(shift.end, 3), RESERVE, legs[done:]))
        for done, when in enumerate(times)
    ]


def leg(drive: Drive) -> Leg:
    """Return a ride as it would have been planned; the same ride always gives the same leg."""
    rng = np.random.default_rng(crc32(f"{drive.vehicle_id}/{drive.ride_id}".encode()))
    heights = drive.rows.get("elevation_m")
    gained, lost = (None, None) if heights is None or np.isnan(heights).all() else climbed(heights)
    return Leg(
        distance_km=round(max(0.0, distance_km(drive) * float(rng.normal(1.0, DISTANCE_ERROR))), 2),
        duration_s=round(float(drive.elapsed[-1]) * float(rng.lognormal(0.0, DURATION_ERROR))),
        gained_m=gained,
        lost_m=lost,
    )


def distance_km(drive: Drive) -> float:
    """Return how far a drive went by its speed, gaps left out. [km]"""
    step = np.diff(drive.elapsed)
    speed = np.nan_to_num(drive.rows["speed_kmh"][:-1])
    return float(speed @ np.where(step <= LONGEST_HOLD, step, 0.0)) / 3600.0


def climbed(heights: Floats) -> tuple[float, float]:
    """Return how much was gained and lost, undulations left out. [m]

    Parameters
    ----------
    heights : (n,) float64. Elevations, NaN where unknown. [m]

    Notes
    -----
    A level follows the heights with the play of `HILL`: it stays while they are within half of it, either way.

    Examples
    --------
    >>> climbed(np.array([0.0, 3.0, 1.0, 30.0, 28.0, 32.0, 12.0]))
    (27.0, 10.0)
    """
    known = heights[np.isfinite(heights)]
    level = [float(known[0])]
    for height in known.tolist():
        level.append(min(max(level[-1], height - HILL / 2.0), height + HILL / 2.0))
    change = np.diff(level)
    return round(float(np.maximum(change, 0.0).sum()), 1), round(float(np.maximum(-change, 0.0).sum()), 1)


def _grouped(drives: Sequence[Drive], length: float) -> list[list[Drive]]:
    """Return the rides of each shift of a car; `length` is that of a shift [s]."""
    shifts: list[list[Drive]] = []
    lasted, charge = np.inf, FULL
    for drive in drives:
        first, last, least = _charge(drive)
        empty = charge - (first - least) < LEAST
        if lasted >= length or empty or drive.start - shifts[-1][0].start > SEASON:
            shifts.append([])
            lasted, charge = -PAUSE, FULL
        shifts[-1].append(drive)
        lasted += PAUSE + float(drive.elapsed[-1])
        charge -= first - last
    return shifts


def _placed(drives: Sequence[Drive], start: float) -> Strung:
    """Return rides one after the other from a time on, [s], the state of charge going on."""
    placed: list[Drive] = []
    charge = FULL
    for drive in drives:
        first, last, _ = _charge(drive)
        soc = np.clip(charge + drive.rows["soc_pct"] - first, 0.0, 100.0)
        continued = drive._replace(rows={**drive.rows, "soc_pct": soc})
        placed.append(moved(continued, start - drive.start))
        start = placed[-1].end + PAUSE
        charge -= first - last
    return Strung(tuple(placed))


def _charge(drive: Drive) -> tuple[float, float, float]:
    """Return the state of charge with which a ride begins and ends, and the least on the way; 0 where unknown. [%]"""
    known = drive.rows["soc_pct"][np.isfinite(drive.rows["soc_pct"])]
    return (float(known[0]), float(known[-1]), float(known.min())) if len(known) else (0.0, 0.0, 0.0)
