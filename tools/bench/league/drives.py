"""Make true drives: the speed, place, elevation and power of a car, in steps of half a second.

The car, its road load, its losses and its charging are written out here, and nothing is taken from the product. A
track is what a car truly did in a day; `socast.tools.bench.league.loggers` samples it.
"""

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats

STEP: Final = 0.5
"""Time between two points of a drive. [s]"""
JOULES: Final = 3.6e6
"""Energy of a kilowatt-hour. [J]"""
RESERVE: Final = 0.12
"""State of charge below which no drive of the league falls. [1]"""


class Kind(NamedTuple):
    """Describe a car: key of the catalogue, mass [kg], drag area [m^2], rolling resistance [1], usable energy [kWh]."""

    name: str
    mass: float
    drag_area: float
    rolling: float
    usable_kwh: float
    volts: float


KINDS: Final = (
    Kind("nissan-leaf-2013", 1650.0, 0.72, 0.0085, 20.5, 360.0),
    Kind("kia-soul-ev-2015", 1640.0, 0.82, 0.0085, 25.5, 365.0),
    Kind("bmw-i3-2014", 1390.0, 0.70, 0.0080, 19.5, 355.0),
    Kind("tesla-model-s", 2230.0, 0.58, 0.0095, 74.0, 370.0),
)


class Style(NamedTuple):
    """Describe a kind of road: speed [km/h], length of a leg [m], and the share of legs that end at a stop."""

    speed: tuple[float, float]
    length: tuple[float, float]
    stops: float


STYLES: Final = (
    Style((28.0, 50.0), (150.0, 700.0), 0.65),
    Style((45.0, 80.0), (500.0, 2500.0), 0.4),
    Style((88.0, 122.0), (3000.0, 15000.0), 0.1),
)


@dataclass
class Track:
    """Hold what a car truly did: its points in time, its drives, and its stays between them.

    Parameters
    ----------
    time, speed, distance, north, east, elevation : (n,) float
        Unix time [s], speed [m/s], distance since the first point, place on a plane, elevation. [m]
    power, energy : (n,) float
        Power at the battery's terminals [W], and its integral since the first point. [J]
    soc : (n,) float
        True state of charge. [1]
    charging : (n,) float
        1 while the car charges.
    drives : list of (float, float)
        Times at which each drive begins and ends: the first and the last motion. [s]
    stays : list of str
        How the car stays after each drive: `asleep`, `awake`, `charging`.
    on : list of (float, float)
        Times between which the car is switched on or charges, so that its logger samples. [s]
    """

    kind: Kind
    usable: float
    time: Floats = field(default_factory=lambda: np.empty(0))
    speed: Floats = field(default_factory=lambda: np.empty(0))
    distance: Floats = field(default_factory=lambda: np.empty(0))
    north: Floats = field(default_factory=lambda: np.empty(0))
    east: Floats = field(default_factory=lambda: np.empty(0))
    elevation: Floats = field(default_factory=lambda: np.empty(0))
    power: Floats = field(default_factory=lambda: np.empty(0))
    energy: Floats = field(default_factory=lambda: np.empty(0))
    soc: Floats = field(default_factory=lambda: np.empty(0))
    charging: Floats = field(default_factory=lambda: np.empty(0))
    drives: list[tuple[float, float]] = field(default_factory=list)
    stays: list[str] = field(default_factory=list)
    on: list[tuple[float, float]] = field(default_factory=list)

    def at(self, name: str, time: Floats | float) -> Floats:
        """Return a column at some times, interpolated."""
        return np.asarray(np.interp(time, self.time, getattr(self, name)))


def make_speeds(rng: np.random.Generator, minutes: float) -> tuple[Floats, Floats]:
    """Return the speed of a drive, which begins and ends at standstill [m/s], and the distances of its turns [m]."""
    parts, now, before, driven, turns = [np.zeros(1)], STEP, 0.0, 0.0, list[float]()
    style, hard = STYLES[rng.choice(3, p=(0.5, 0.35, 0.15))], rng.uniform(0.9, 1.9)
    while now < 60.0 * minutes:
        if rng.random() < 0.12:
            style = STYLES[rng.choice(3, p=(0.4, 0.35, 0.25))]
        top = rng.uniform(*style.speed) / 3.6
        stops = rng.random() < style.stops
        after = 0.0 if stops else rng.uniform(4.0, 9.0) if style is STYLES[0] else top * rng.uniform(0.6, 0.95)
        rest = 60.0 * minutes - now
        cruise = min(rng.uniform(*style.length) / top, max(20.0, rest))
        leg = [_ramp(before, top, hard), _cruise(rng, top, cruise), _ramp(top, after, hard * rng.uniform(0.8, 1.4))]
        if stops:
            leg.append(np.zeros(int(rng.uniform(10.0, 90.0) / STEP)))
        joined = np.concatenate(leg)
        driven += float(joined.sum()) * STEP
        turns.append(driven)
        parts.append(joined)
        now, before = now + STEP * len(joined), after
    parts.append(_ramp(before, 0.0, hard) if before > 0.0 else np.zeros(1))
    speed = np.concatenate([*parts, np.zeros(1)])
    last = int(np.flatnonzero(speed)[-1]) + 2  # no light at the end
    return speed[:last], np.array(turns)


def _ramp(begin: float, end: float, rate: float) -> Floats:
    """Return speeds from one speed to another, gently at both ends."""
    count = max(2, int(np.ceil(1.5 * abs(end - begin) / rate / STEP)))
    share = np.arange(1, count + 1) / count
    return begin + (end - begin) * share * share * (3.0 - 2.0 * share)


def _cruise(rng: np.random.Generator, top: float, duration: float) -> Floats:
    """Return speeds around one speed, which both ends have."""
    count = max(2, int(duration / STEP))
    share = np.arange(1, count + 1) / count
    waves = sum(
        rng.uniform(0.0, 0.04) * np.sin(2.0 * np.pi * (share * duration / rng.uniform(12.0, 60.0) + rng.random()))
        for _ in range(3)
    )
    return np.asarray(top * (1.0 + waves * np.minimum(1.0, 8.0 * np.minimum(share, 1.0 - share))))


class Drive(NamedTuple):
    """Hold the columns of one drive, each (n,) float: see `Track`."""

    speed: Floats
    distance: Floats
    north: Floats
    east: Floats
    elevation: Floats
    power: Floats


def make_drive(rng: np.random.Generator, kind: Kind, minutes: float, hills: float) -> Drive:
    """Return a drive of about some minutes on roads of the given hilliness, 0 to 1."""
    speed, turns = make_speeds(rng, minutes)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * STEP)])
    angles = np.cumsum(rng.choice([-1.0, 0.0, 1.0], len(turns)) * rng.uniform(0.2, 1.6, len(turns)))
    knots = np.repeat(turns, 2)
    knots[1::2] += 25.0
    before = np.concatenate([[0.0], angles[:-1]])
    heading = np.interp(distance, np.maximum.accumulate(knots), np.stack([before, angles], 1).ravel())
    heading += rng.uniform(0.0, 2.0 * np.pi) + 0.25 * np.sin(distance / rng.uniform(150.0, 600.0))
    step = np.diff(distance, prepend=0.0)
    lengths, slopes = rng.uniform(60.0, 900.0, 4), hills * rng.uniform(0.0, 0.025, 4)
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    waves = distance[:, None] / lengths + phases
    elevation = (slopes * lengths * (np.sin(waves) - np.sin(phases))).sum(1)
    slope = (slopes * np.cos(waves)).sum(1)
    power = _find_power(rng, kind, speed, slope)
    return Drive(
        speed, distance, np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), elevation, power
    )


def _find_power(rng: np.random.Generator, kind: Kind, speed: Floats, slope: Floats) -> Floats:
    """Return the power at the terminals: road load, losses of the drive, limited recuperation, accessories. [W]"""
    change = np.gradient(speed, STEP)
    force = kind.mass * 1.04 * change + kind.mass * 9.81 * (slope + kind.rolling * (speed > 0.0))
    force += 0.5 * rng.uniform(1.15, 1.3) * kind.drag_area * speed * speed
    wheels = force * speed
    regained = np.maximum(-35e3, np.where(speed > 2.0, 0.75 * wheels, 0.0))
    drive = np.where(wheels > 0.0, wheels / 0.87, regained)
    heating = rng.uniform(200.0, 2500.0) * (1.0 + 0.2 * np.sin(np.arange(len(speed)) * STEP / rng.uniform(30.0, 90.0)))
    return np.asarray(drive + heating)


def make_track(rng: np.random.Generator, drives: int, start: float, stays: tuple[str, ...] = ()) -> Track:
    """Return a day of some drives from a time on, with the named stays after the first drives.

    Units: start [s].
    """
    minutes, hills = rng.uniform(5.0, 40.0, drives), rng.uniform(0.0, 1.0)
    kind = KINDS[int(rng.integers(len(KINDS)))]
    made = [make_drive(rng, kind, each, hills) for each in minutes]
    usable = kind.usable_kwh * np.clip(rng.normal(1.0, 0.04), 0.88, 1.12)
    needed = [float(each.power.sum()) * STEP / JOULES / usable for each in made]
    soc = min(0.97, max(rng.uniform(0.55, 0.95), RESERVE + needed[0] + 0.05))
    builder = _Builder(Track(kind, usable), start, soc)
    builder.stay(rng.uniform(2.0, 60.0), 400.0, on=True)
    for number, drive in enumerate(made):
        builder.drive(drive)
        drawn = str(rng.choice(["asleep", "awake", "charging"], p=(0.5, 0.25, 0.25)))
        stay = stays[number] if number < len(stays) else drawn
        builder.track.stays.append(stay)
        after = needed[number + 1] if number + 1 < drives else 0.0
        target = max(RESERVE + after + 0.05, min(0.95, builder.soc + rng.uniform(0.1, 0.4)))
        must = builder.soc < RESERVE + after + 0.02
        builder.stay(rng.uniform(2.0, 90.0), 400.0, on=True)
        if stay == "asleep":
            builder.stay(rng.choice([1200.0, 3600.0, 8 * 3600.0, 14 * 3600.0]) * rng.uniform(0.8, 1.2), 8.0)
            if must:
                builder.charge(target, 3600.0, on=False)
        elif stay == "awake":
            builder.stay(rng.uniform(420.0, 1500.0), 350.0, on=True)
            if must:
                builder.stay(5.0, 8.0)
                builder.charge(target, 3600.0, on=False)
        else:
            builder.charge(target, rng.uniform(600.0, 2000.0), on=True)
        builder.stay(rng.uniform(2.0, 60.0), 400.0, on=True)
    return builder.close()


class _Builder:
    """Join drives and stays to a track."""

    def __init__(self, track: Track, start: float, soc: float) -> None:
        self.track, self.now, self.soc = track, start, soc
        self.place = np.zeros(4)  # distance, north, east, elevation
        self.parts: list[Floats] = []
        self.is_on = False

    def add(self, columns: Floats) -> None:
        """Add points: time, speed, distance, north, east, elevation, power, charging."""
        self.parts.append(columns)
        self.now = float(columns[0, -1])
        power, time = columns[6], columns[0]
        used = float((0.5 * (power[1:] + power[:-1]) * np.diff(time)).sum())
        self.soc -= used / JOULES / self.track.usable
        self.place = columns[2:6, -1]

    def stay(self, duration: float, watts: float, *, on: bool = False, charging: bool = False) -> None:
        """Let time pass at standstill."""
        self._switch(on)
        columns = np.empty((8, 2))
        columns[0] = self.now + 1e-3, self.now + duration
        columns[1], columns[2:6] = 0.0, self.place[:, None]
        columns[6], columns[7] = watts, float(charging)
        self.add(columns)

    def charge(self, target: float, duration: float, *, on: bool) -> None:
        """Charge up to a state of charge."""
        watts = -(target - self.soc) * self.track.usable * JOULES / duration
        self.stay(duration, min(watts, -1500.0), on=on, charging=True)

    def drive(self, drive: Drive) -> None:
        """Drive."""
        self._switch(True)
        count = len(drive.speed)
        columns = np.empty((8, count))
        columns[0] = self.now + STEP * np.arange(1, count + 1)
        columns[1] = drive.speed
        columns[2:6] = np.stack([drive.distance, drive.north, drive.east, drive.elevation]) + self.place[:, None]
        columns[6], columns[7] = drive.power, 0.0
        begin, end = np.flatnonzero(drive.speed)[[0, -1]]
        self.track.drives.append((float(columns[0, max(begin - 1, 0)]), float(columns[0, end + 1])))
        self.add(columns)

    def close(self) -> Track:
        """Return the track."""
        self._switch(False)
        columns, track = np.concatenate(self.parts, axis=1), self.track
        track.time, track.speed, track.distance, track.north, track.east = columns[:5]
        track.elevation, track.power, track.charging = columns[5:]
        steps = 0.5 * (track.power[1:] + track.power[:-1]) * np.diff(track.time)
        track.energy = np.concatenate([[0.0], np.cumsum(steps)])
        first = self.soc + track.energy[-1] / JOULES / track.usable
        track.soc = first - track.energy / JOULES / track.usable
        return track

    def _switch(self, on: bool) -> None:
        """Switch the car on or off."""
        on_since = self.track.on
        if on and not self.is_on:
            on_since.append((self.now, np.inf))
        elif not on and self.is_on:
            on_since[-1] = (on_since[-1][0], self.now)
        self.is_on = on
