"""Concatenate the rides of a car into synthetic shifts, so that public drives can test forecasts of a shift's end.

A ride keeps everything but its time and its state of charge. Rides follow each other after short pauses, and each one
continues the state of charge at which the previous one ended, by its own decrease. The plan of a shift is synthetic
too, as in the simulator: the distance and time of each ride, with random errors of planning.
"""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.wire.messages import Leg, Message, Plan
from socast.tools.importers.drive import LONGEST_HOLD, Drive, make_message, move_drive

PAUSE: Final = 300.0
"""Time between two rides of a shift. [s]"""
SHIFT_BREAK: Final = 8 * 3600.0
"""Shortest time between two shifts. [s]"""
LONGEST_SPAN: Final = 30 * SECONDS_PER_DAY
"""Rides recorded farther apart are of different seasons, so no shift holds both. [s]"""
LARGEST_TEMPERATURE_CHANGE: Final = 5.0
"""No shift holds rides whose outside temperature differs by more from that of its first ride. [K]"""
START_SOC: Final = 95.0
"""State of charge with which a shift begins. [%]"""
LOWEST_SOC: Final = 5.0
"""A ride that would end below this state of charge is the first of the next shift. [%]"""
RESERVE: Final = 10.0
"""State of charge that the plan keeps, as in the simulator. [%]"""
DISTANCE_ERROR: Final = 0.04
"""Standard deviation of a planned distance, relative to the distance, as in the simulator. [1]"""
DURATION_ERROR: Final = 0.12
"""Standard deviation of the logarithm of a planned time, as in the simulator. [1]"""
ELEVATION_PLAY: Final = 10.0
"""Undulations up to this height are errors of the sensor. [m]"""


class SyntheticShift(NamedTuple):
    """Hold the rides of one car in a shift, in order, with their new times and states of charge."""

    drives: tuple[Drive, ...]

    @property
    def end(self) -> float:
        """Unix time at which the shift ends. [s]"""
        return self.drives[-1].end


def concatenate_drives(drives: Iterable[Drive], hours: float) -> list[SyntheticShift]:
    """Concatenate the rides of each car into synthetic shifts of one weather, in their order within each shift.

    Units: hours [h].

    Returns
    -------
    list of SyntheticShift
        By car and time. The first shift of a car begins when its first ride began. Each other one begins when its own
        first ride began, or `SHIFT_BREAK` after the previous shift if that is later.

    Notes
    -----
    A shift begins with the first ride that no shift holds yet. Rides in other weather, see
    `LARGEST_TEMPERATURE_CHANGE`, wait for another shift. A shift ends with the ride by which it reaches its length. It
    also ends before a ride for which the battery would not suffice, and before a ride recorded more than `LONGEST_SPAN`
    after its first.
    """
    shifts: list[SyntheticShift] = []
    by_car = sorted(drives, key=lambda drive: (drive.vehicle_id, drive.start))
    for _, drives_of_car in groupby(by_car, key=lambda drive: drive.vehicle_id):
        free_from = -np.inf
        for rides in _group_by_shift(list(drives_of_car), hours * 3600.0):
            shifts.append(_place(rides, max(rides[0].start, free_from)))
            free_from = shifts[-1].end + SHIFT_BREAK
    return shifts


def make_plans(shift: SyntheticShift) -> list[Message]:
    """Return the plans of a shift: one for all rides at its start, and one for the rest as each ride ends."""
    legs = [plan_leg(drive) for drive in shift.drives]
    times = [shift.drives[0].start, *(drive.end for drive in shift.drives)]
    vehicle = shift.drives[0].vehicle_id
    return [
        make_message(f"fleet/{vehicle}/plan", Plan(vehicle, round(when, 3), round(shift.end, 3), RESERVE, legs[done:]))
        for done, when in enumerate(times)
    ]


def plan_leg(drive: Drive) -> Leg:
    """Return a ride with the errors of a plan; the same ride always gives the same leg."""
    rng = np.random.default_rng(crc32(f"{drive.vehicle_id}/{drive.ride_id}".encode()))
    heights = drive.rows.get("elevation_m")
    gained, lost = (None, None) if heights is None or np.isnan(heights).all() else compute_climb(heights)
    return Leg(
        distance_km=round(max(0.0, integrate_distance(drive) * float(rng.normal(1.0, DISTANCE_ERROR))), 2),
        duration_s=round(float(drive.elapsed[-1]) * float(rng.lognormal(0.0, DURATION_ERROR))),
        gained_m=gained,
        lost_m=lost,
    )


def integrate_distance(drive: Drive) -> float:
    """Return the distance of a drive, integrated over its speed without gaps. [km]"""
    step = np.diff(drive.elapsed)
    speed = np.nan_to_num(drive.rows["speed_kmh"][:-1])
    return float(speed @ np.where(step <= LONGEST_HOLD, step, 0.0)) / 3600.0


def compute_climb(heights: Floats) -> tuple[float, float]:
    """Return the elevation gained and lost, without undulations of the sensor. [m]

    Units: heights [m].

    Returns
    -------
    gained, lost : float
        Sums of climbs and of descents, both positive. [m]

    Notes
    -----
    A level follows the elevation with the play of `ELEVATION_PLAY`: it stays while the elevation is within half of the
    play above or below.

    Examples
    --------
    >>> compute_climb(np.array([0.0, 3.0, 1.0, 30.0, 28.0, 32.0, 12.0]))
    (27.0, 10.0)
    """
    known = heights[np.isfinite(heights)]
    level = [float(known[0])]
    for height in known.tolist():
        level.append(min(max(level[-1], height - ELEVATION_PLAY / 2.0), height + ELEVATION_PLAY / 2.0))
    change = np.diff(level)
    return round(float(np.maximum(change, 0.0).sum()), 1), round(float(np.maximum(-change, 0.0).sum()), 1)


def _group_by_shift(drives: Sequence[Drive], length: float) -> list[list[Drive]]:
    """Return the rides of each shift of a car; `length` is the length of a shift. [s]"""
    shifts: list[list[Drive]] = []
    left = list(drives)
    while left:
        taken = set(_choose_rides(left, length))
        shifts.append([drive for place, drive in enumerate(left) if place in taken])
        left = [drive for place, drive in enumerate(left) if place not in taken]
    return shifts


def _choose_rides(drives: Sequence[Drive], length: float) -> list[int]:
    """Return the places of the rides of a shift that begins with the first of some rides."""
    taken: list[int] = []
    lasted, charge, temperature = -PAUSE, START_SOC, _find_temperature(drives[0])
    for place, drive in enumerate(drives):
        if taken and (lasted >= length or drive.start - drives[0].start > LONGEST_SPAN):
            break
        if abs(_find_temperature(drive) - temperature) > LARGEST_TEMPERATURE_CHANGE:
            continue
        first, last, least = _charge_range(drive)
        if taken and charge - (first - least) < LOWEST_SOC:
            break
        taken.append(place)
        lasted += PAUSE + float(drive.elapsed[-1])
        charge -= first - last
    return taken


def _find_temperature(drive: Drive) -> float:
    """Return the mean outside temperature of a ride, NaN where unknown. [°C]"""
    known = drive.rows.get("ambient_c", np.empty(0))
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else float("nan")


def _place(drives: Sequence[Drive], start: float) -> SyntheticShift:
    """Return rides one after the other from `start` [s] on, with a continuous state of charge."""
    placed: list[Drive] = []
    charge = START_SOC
    for drive in drives:
        first, last, _ = _charge_range(drive)
        soc = np.clip(charge + drive.rows["soc_pct"] - first, 0.0, 100.0)
        continued = drive._replace(rows={**drive.rows, "soc_pct": soc})
        placed.append(move_drive(continued, start - drive.start))
        start = placed[-1].end + PAUSE
        charge -= first - last
    return SyntheticShift(tuple(placed))


def _charge_range(drive: Drive) -> tuple[float, float, float]:
    """Return the state of charge at the start and end of a ride, and its lowest value; 0 if unknown. [%]"""
    known = drive.rows["soc_pct"][np.isfinite(drive.rows["soc_pct"])]
    return (float(known[0]), float(known[-1]), float(known.min())) if len(known) else (0.0, 0.0, 0.0)
