"""Compute the surroundings of a car along its way: road, air and light at each step, as the physics needs them."""

from typing import NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.tools.simulator.settings import STEP
from socast.tools.simulator.shift import NO_RIDE, Shift, Timeline
from socast.tools.simulator.weather import Sky, compute_sun_height
from socast.tools.simulator.world import TURN, compute_elevation, is_in_tunnel, to_plane

REFERENCE_DENSITY = 1.2
"""Density of air if it does not vary. [kg/m^3]"""


class Trace(NamedTuple):
    """Hold the surroundings of a car, step by step.

    Parameters
    ----------
    time : (n,) float
        Unix time at the end of the step. [s]
    x, y, elevation : (n,) float
        Position at the end of the step, east and north of the centre, and elevation. [m]
    speed, acceleration : (n,) float
        Means over the step. [m/s], [m/s^2]
    grade : (n,) float
        Sine of the angle of the road. [1]
    turn_rate : (n,) float
        Rate of turn. [rad/s]
    headwind, crosswind : (n,) float
        Wind against and across the direction of travel. [m/s]
    density : (n,) float
        Density of the air. [kg/m^3]
    ambient : (n,) float
        Temperature of the outside air. [°C]
    precipitation : (n,) float
        Precipitation. [mm/h]
    wetness, snow : (n,) float
        Water and snow on the road, 0 to 1. [1]
    humidity : (n,) float
        Relative humidity. [1]
    solar : (n,) float
        Irradiance. [W/m^2]
    dark : (n,) float
        1 at night and in tunnels, else 0. [1]
    on, door, plugged, occupants : (n,) float
        As in `shift.Timeline`.
    elapsed : (n,) float
        Time since the ride began, 0 between rides. [s]
    parked : (n,) float
        Time for which the car stood before it last drove. [s]
    tunnel : (n,) float
        1 inside a tunnel, else 0. [1]
    """

    time: Floats
    x: Floats
    y: Floats
    elevation: Floats
    speed: Floats
    acceleration: Floats
    grade: Floats
    turn_rate: Floats
    headwind: Floats
    crosswind: Floats
    density: Floats
    ambient: Floats
    precipitation: Floats
    wetness: Floats
    snow: Floats
    humidity: Floats
    solar: Floats
    dark: Floats
    on: Floats
    door: Floats
    plugged: Floats
    occupants: Floats
    elapsed: Floats
    parked: Floats
    tunnel: Floats


def make_trace(shift: Shift, sky: Sky, *, hills: bool = True) -> Trace:
    """Return the surroundings of a shift."""
    timeline = shift.timeline
    n = len(timeline.u)
    time: Floats = shift.time + STEP * np.arange(1, n + 1, dtype=float)
    x, y = to_plane(timeline.u, timeline.v)
    elevation = compute_elevation(x, y, hills=hills)
    air = sky.at(time)
    ambient = air.temperature - 0.0065 * (elevation - 30.0)
    inside = is_in_tunnel(timeline.u, timeline.v, timeline.heading)
    sheltered = np.where(inside, 0.0, 1.0)
    direction = timeline.heading + TURN
    towards = air.wind_east * np.cos(direction) + air.wind_north * np.sin(direction)
    across = air.wind_east * np.sin(direction) - air.wind_north * np.cos(direction)
    moved = np.maximum(timeline.moved, 1e-9)
    climbed = np.diff(elevation, prepend=elevation[0])
    return Trace(
        time=time,
        x=x,
        y=y,
        elevation=elevation,
        speed=0.5 * (timeline.before + timeline.after),
        acceleration=(timeline.after - timeline.before) / STEP,
        grade=np.where(timeline.moved > 0.05, climbed / np.hypot(moved, climbed), 0.0),
        turn_rate=timeline.turn_rate,
        headwind=-towards * sheltered,
        crosswind=-across * sheltered,
        density=compute_air_density(air.pressure, ambient, air.humidity, elevation),
        ambient=ambient,
        precipitation=air.precipitation * sheltered,
        wetness=air.wetness,
        snow=air.snow * sheltered,
        humidity=air.humidity,
        solar=air.solar * sheltered,
        dark=np.where((compute_sun_height(time) < 0.05) | inside, 1.0, 0.0),
        on=timeline.on,
        door=timeline.door,
        plugged=timeline.plugged,
        occupants=timeline.occupants,
        elapsed=_elapsed(timeline),
        parked=_parked(timeline),
        tunnel=np.where(inside, 1.0, 0.0),
    )


def compute_air_density(pressure: Floats, ambient: Floats, humidity: Floats, elevation: Floats) -> Floats:
    """Return the density of moist air. [kg/m^3]

    Units: pressure [Pa], ambient [°C], elevation [m].

    References
    ----------
    Alduchov and Eskridge (1996), J. Appl. Meteorol. 35:601, eq. 21, for the saturation pressure.
    """
    kelvin = ambient + ZERO_CELSIUS
    local = pressure * np.exp(-elevation / (29.27 * kelvin))
    vapour = humidity * 610.94 * np.exp(17.625 * ambient / (243.04 + ambient))
    return np.asarray((local - 0.378 * vapour) / (287.05 * kelvin))


def _elapsed(timeline: Timeline) -> Floats:
    """Return the time since the ride began, 0 between rides. [s]"""
    steps = np.arange(len(timeline.ride))
    begins = np.flatnonzero(np.diff(timeline.ride, prepend=NO_RIDE - 1))
    since = steps - np.repeat(begins, np.diff(np.append(begins, len(steps))))
    return np.where(timeline.ride != NO_RIDE, STEP * since, 0.0)


def _parked(timeline: Timeline) -> Floats:
    """Return how long the car stood before it last began to drive; 8 h before the first drive. [s]"""
    standing = timeline.after + timeline.before == 0
    ends = np.flatnonzero(np.diff(standing.astype(int), prepend=0, append=0))
    begins, ends = ends[0::2], ends[1::2]
    lengths = STEP * (ends - begins)
    long = lengths > 40.0
    parked = np.full(len(standing), 8 * 3600.0)
    for end, length in zip(ends[long][1:], lengths[long][1:], strict=True):
        parked[end:] = length
    return parked
