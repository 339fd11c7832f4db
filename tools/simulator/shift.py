"""Simulate a shift of one taxi: rides, drives to the next passenger, pauses, and charging at a low state of charge."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.wire.messages import Leg
from socast.tools.simulator.cars import Car
from socast.tools.simulator.driver import DrivingStyle, compute_congestion, drive_route, make_style
from socast.tools.simulator.settings import STEP, UTC_OFFSET, Faults
from socast.tools.simulator.world import Route, compute_elevation, draw_destination, find_crossing, make_route, to_plane

CHARGER: Final = 44e3
"""Power of a fast charger. [W]"""
UNPLUGGING: Final = 30.0
"""Time for which a car that stands ready before its first ride still reports that it charges. [s]"""
NO_RIDE: Final = -1
"""Index of the ride between rides."""
WAIT: Final = (600.0, 3000.0)
"""Shortest and longest wait of `Orders.waits`. [s]"""
WAY_HOME: Final = (1000.0, 9000.0)
"""Shortest and longest distance of a way home. [m]"""
CANDIDATES: Final = 30
"""Number of destinations tried for a ride of a given length."""
CLOSE_ENOUGH: Final = 0.02, 60.0
"""Error of the length with which the search ends: relative [1], or absolute if that is larger [m]."""


class Orders(NamedTuple):
    """Hold the orders of dispatch for a shift.

    Parameters
    ----------
    length : float
        Time until which rides begin, if `distances` does not give their number. [s]
    distances : (n,) float, optional
        Distance of each ride; None draws them for the car. [m]
    charge : (float, float)
        Lowest and highest state of charge at the beginning. [1]
    charge_below : float
        Estimated state of charge below which dispatch sends the car to charge. [1]
    prepared : float
        Time for which the car stands switched on, just unplugged, before the first ride; 0 omits it. [s]
    boarding, alighting : (float, float)
        Shortest and longest waiting time of a ride before and after its drive. [s]
    idle : float
        Mean time between a ride and the drive to the next, in addition to the shortest time of 45 s. [s]
    estimate_factor : float
        Consumption that dispatch estimates, divided by its estimate for a plain car. [1]
    """

    driver_id: str
    style: DrivingStyle
    length: float = 0.0
    distances: Floats | None = None
    charge: tuple[float, float] = (0.82, 1.0)
    charge_below: float = 0.15
    prepared: float = 0.0
    boarding: tuple[float, float] = (20.0, 90.0)
    alighting: tuple[float, float] = (25.0, 90.0)
    idle: float = 330.0
    estimate_factor: float = 1.0
    waits: float = 0.0
    no_shows: float = 0.0
    plan_spread: float = 0.0
    way_home: float = 0.0
    hills: bool = True


class Trip(NamedTuple):
    """Hold a ride.

    Parameters
    ----------
    ride_id, driver_id : str
        Identifiers of the ride and of its driver.
    begin, end : int
        First step, and the step after the last one.
    planned : Leg or None
        The ride as planned, None if it was begun by mistake.
    """

    ride_id: str
    driver_id: str
    begin: int
    end: int
    planned: Leg | None


class Interlude(NamedTuple):
    """Hold what dispatch plans between rides: a charge, or a ride whose passenger does not come.

    Parameters
    ----------
    end : int
        Step at which it is over, and dispatch knows.
    duration_s : float
        Planned duration. [s]
    distance_km : float or None
        Planned distance of the ride; None for a charge. [km]
    charge_to_pct : float or None
        Planned state of charge; None for a ride. [%]
    """

    before: int
    end: int
    duration_s: float
    distance_km: float | None = None
    charge_to_pct: float | None = None


class Timeline(NamedTuple):
    """Hold the position of the car and the events in it, step by step.

    Parameters
    ----------
    u, v : (n,) float
        Position at the end of the step, along the streets. [m]
    moved : (n,) float
        Distance driven in the step. [m]
    before, after : (n,) float
        Speed at the beginning and at the end of the step. [m/s]
    heading : (n,) float
        Direction from the u axis, counter-clockwise, unwrapped within a drive. [rad]
    turn_rate : (n,) float
        Rate of turn. [rad/s]
    on, door, plugged : (n,) float
        1 if the car is ready to drive, has an open door, or charges; else 0.
    occupants : (n,) float
        Number of people in the car. [1]
    ride : (n,) int
        Index of the trip, `NO_RIDE` between rides.
    """

    u: Floats
    v: Floats
    moved: Floats
    before: Floats
    after: Floats
    heading: Floats
    turn_rate: Floats
    on: Floats
    door: Floats
    plugged: Floats
    occupants: Floats
    ride: Ints


class Shift(NamedTuple):
    """Hold a shift.

    Parameters
    ----------
    time : float
        Unix time at which it begins. [s]
    soc : float
        State of charge at the beginning. [1]
    length : float
        Planned length. [s]
    """

    time: float
    soc: float
    timeline: Timeline
    trips: list[Trip]
    length: float
    unstarted_legs: tuple[Leg, ...] = ()
    interludes: tuple[Interlude, ...] = ()


class _TimelineBuilder:
    """Build a timeline piece by piece."""

    def __init__(self, place: tuple[float, float]) -> None:
        self.pieces: list[Timeline] = []
        self.steps = 0
        self.place = place
        self.heading = 0.0

    def stand(self, seconds: float, ride: int, occupants: int, door: float = 0.0, **flags: float) -> None:
        """Stand for a while, with a door open for `door` seconds in the middle."""
        n = max(1, int(seconds / STEP))
        column = np.zeros(n)
        first = max(0, int((n - door / STEP) / 2))
        opened = column.copy()
        opened[first : first + int(door / STEP)] = 1.0
        self._add(
            Timeline(
                u=column + self.place[0],
                v=column + self.place[1],
                moved=column,
                before=column,
                after=column,
                heading=column + self.heading,
                turn_rate=column,
                on=column + flags.get("on", 1.0),
                door=opened,
                plugged=column + flags.get("plugged", 0.0),
                occupants=column + occupants,
                ride=np.full(n, ride),
            )
        )

    def move(
        self,
        way: Route,
        ride: int,
        occupants: int,
        style: DrivingStyle,
        traffic: float,
        rng: np.random.Generator,
    ) -> None:
        """Drive a route from the current position."""
        motion = drive_route(way, style, traffic, rng)
        n = len(motion.along)
        directions = np.unwrap(np.arctan2(np.diff(way.v), np.diff(way.u)))
        segment = np.clip(np.searchsorted(way.along, motion.along - 1e-6) - 1, 0, len(directions) - 1)
        heading = _smooth(directions[segment], 9)
        turning = np.diff(heading, prepend=heading[0]) / STEP
        zero = np.zeros(n)
        self._add(
            Timeline(
                u=np.interp(motion.along, way.along, way.u),
                v=np.interp(motion.along, way.along, way.v),
                moved=np.diff(motion.along, prepend=0.0),
                before=motion.before,
                after=motion.after,
                heading=heading,
                turn_rate=np.where(motion.after > 0.5, turning, 0.0),
                on=zero + 1.0,
                door=zero,
                plugged=zero,
                occupants=zero + occupants,
                ride=np.full(n, ride),
            )
        )
        self.place, self.heading = (float(way.u[-1]), float(way.v[-1])), float(heading[-1])

    def timeline(self) -> Timeline:
        """Return the whole timeline."""
        return Timeline(*(np.concatenate(columns) for columns in zip(*self.pieces, strict=True)))

    def _add(self, piece: Timeline) -> None:
        """Append a piece."""
        self.pieces.append(piece)
        self.steps += len(piece.u)


def draw_orders(hours: float | None, rng: np.random.Generator) -> Orders:
    """Draw the orders of dispatch for a shift.

    Parameters
    ----------
    hours : float or None
        Length of the shift; None draws 7 to 10 h. [h]
    """
    length = 3600 * (float(rng.uniform(7.0, 10.0)) if hours is None else hours)
    style = make_style(rng)
    return Orders(f"driver-{int(rng.integers(1, 400)):03d}", style, length)


def make_shift(
    name: str, begin: float, orders: Orders, car: Car, ambient: float, faults: Faults, rng: np.random.Generator
) -> Shift:
    """Drive a shift.

    Units: begin [s], ambient [°C].
    """
    style, driver = orders.style, orders.driver_id
    builder = _TimelineBuilder(find_crossing(float(rng.normal(0, 1700)), float(rng.normal(0, 1500))))
    soc = estimate = float(rng.uniform(*orders.charge))
    cold = max(0.0, 20.0 - ambient)
    per_metre = orders.estimate_factor * 3600 * (0.12 + 0.05 * car.mass / 1600 + 0.002 * cold)
    per_second = orders.estimate_factor * (600 + min(car.heater_power, car.cabin_loss * cold))
    trips: list[Trip] = []
    interludes: list[Interlude] = []
    common = 0.5 * float(rng.normal()) if orders.plan_spread > 0.0 else 0.0
    if orders.prepared > 0:
        builder.stand(UNPLUGGING, NO_RIDE, 0, on=0.0, plugged=1.0)
        builder.stand(orders.prepared, NO_RIDE, 1, door=6.0)
    builder.stand(float(rng.uniform(60, 240)), NO_RIDE, 1, door=6.0)
    for wanted in _wanted(orders, builder):
        traffic = compute_congestion((begin + UTC_OFFSET + builder.steps * STEP) / 3600 % 24)
        since, driven = builder.steps, 0.0
        if orders.no_shows > 0.0 and rng.uniform() < orders.no_shows:
            interludes.append(_wait_in_vain(builder, len(trips), car, orders, traffic, rng))
        if rng.uniform() < 0.4:
            driven += _drive_to(builder, float(rng.lognormal(np.log(900.0), 0.5)), NO_RIDE, 1, style, traffic, rng)
        if rng.uniform() < faults.false_start:
            first = builder.steps
            builder.stand(float(rng.uniform(3, 14)), len(trips), 2)
            trips.append(Trip(f"{name}-{len(trips):02d}", driver, first, builder.steps, None))
            builder.stand(float(rng.uniform(10, 40)), NO_RIDE, 1)
        first, place = builder.steps, builder.place
        metres = _carry(builder, len(trips), car, orders, wanted, traffic, rng)
        if rng.uniform() < faults.errand:
            builder.stand(float(rng.uniform(3300, 5400)), len(trips), 1)
        planned = _plan(builder, first, place, metres, orders.hills, rng)
        if orders.plan_spread > 0.0:
            planned = _misjudge(planned, orders.plan_spread, common, rng)
        trips.append(Trip(f"{name}-{len(trips):02d}", driver, first, builder.steps, planned))
        builder.stand(45 + float(rng.exponential(orders.idle)), NO_RIDE, 1, door=float(rng.uniform(0, 8)))
        if orders.waits > 0.0 and rng.uniform() < orders.waits:
            builder.stand(float(rng.uniform(*WAIT)), NO_RIDE, 1)
        estimate -= ((driven + metres) * per_metre + (builder.steps - since) * STEP * per_second) / car.capacity
        if estimate < orders.charge_below:
            plugged = builder.steps
            estimate = _charge(builder, estimate, car, ambient, style, rng)
            spent = round((builder.steps - plugged) * STEP)
            interludes.append(Interlude(len(trips), builder.steps, spent, charge_to_pct=round(100 * estimate)))
    _end_at_home(builder, orders, rng)
    timeline, length = builder.timeline(), builder.steps * STEP
    return Shift(begin, soc, timeline, trips, length, interludes=tuple(interludes))


def stop_shift(shift: Shift, steps: int) -> Shift:
    """Return a shift that ends after a number of steps; the rest of its plan stays planned."""
    begun = [trip._replace(end=min(trip.end, steps)) for trip in shift.trips if trip.begin < steps]
    unstarted_legs = tuple(trip.planned for trip in shift.trips[len(begun) :] if trip.planned)
    return shift._replace(
        timeline=Timeline._make(column[:steps] for column in shift.timeline),
        trips=begun,
        unstarted_legs=unstarted_legs,
        interludes=tuple(each for each in shift.interludes if each.end <= steps),
    )


def _wanted(orders: Orders, builder: _TimelineBuilder) -> Iterator[float | None]:
    """Yield the distance of each ride [m], None if it is drawn for the car."""
    if orders.distances is not None:
        yield from orders.distances.tolist()
        return
    while builder.steps * STEP < orders.length:
        yield None


def _carry(
    builder: _TimelineBuilder,
    ride: int,
    car: Car,
    orders: Orders,
    wanted: float | None,
    traffic: float,
    rng: np.random.Generator,
) -> float:
    """Take passengers over the distance `wanted`, or over a drawn one; return the distance driven [m]."""
    metres = wanted or float(np.clip(rng.lognormal(np.log(car.ride_median), car.ride_spread), 350, 34e3))
    people = 2 + min(3, int(rng.geometric(0.65)) - 1)
    builder.stand(float(rng.uniform(*orders.boarding)), ride, people, door=float(rng.uniform(4, 14)))
    candidates = CANDIDATES if wanted else 1
    driven = _drive_to(builder, metres, ride, people, orders.style, traffic, rng, candidates)
    builder.stand(float(rng.uniform(*orders.alighting)), ride, people, door=float(rng.uniform(4, 14)))
    return driven


def _drive_to(
    builder: _TimelineBuilder,
    metres: float,
    ride: int,
    people: int,
    style: DrivingStyle,
    traffic: float,
    rng: np.random.Generator,
    candidates: int = 1,
) -> float:
    """Drive about the given distance to the best of some destinations; return the distance driven [m]."""
    ways = (make_route(builder.place, draw_destination(*builder.place, metres, rng), rng) for _ in range(candidates))
    best = next(ways)
    for way in ways:
        if abs(best.length - metres) < max(CLOSE_ENOUGH[0] * metres, CLOSE_ENOUGH[1]):
            break
        best = min(best, way, key=lambda known: abs(known.length - metres))
    pieces = len(builder.pieces)
    builder.move(best, ride, people, style, traffic, rng)
    return float(builder.pieces[pieces].moved.sum())


def _charge(
    builder: _TimelineBuilder, soc: float, car: Car, ambient: float, style: DrivingStyle, rng: np.random.Generator
) -> float:
    """Drive to a charger near by and plug in; return the state of charge that dispatch estimates afterwards. [1]"""
    _drive_to(builder, 600.0, NO_RIDE, 1, style, 0.2, rng)
    power = 0.75 * CHARGER * min(1.0, max(0.25, (ambient + 15) / 30))
    seconds = float(np.clip((rng.uniform(0.6, 0.85) - soc) * car.capacity / power, 1200, 7200))
    builder.stand(60.0, NO_RIDE, 1, door=6.0)
    builder.stand(seconds, NO_RIDE, 0, on=0.0, plugged=1.0)
    builder.stand(90.0, NO_RIDE, 1, door=6.0)
    return min(0.85, soc + power * seconds / car.capacity)


def _plan(
    builder: _TimelineBuilder,
    first: int,
    place: tuple[float, float],
    driven: float,
    hills: bool,
    rng: np.random.Generator,
) -> Leg:
    """Return the plan of dispatch for the ride that was just driven."""
    ends = [to_plane(np.array([u]), np.array([v])) for u, v in (place, builder.place)]
    heights = [float(compute_elevation(x, y, hills=hills)[0]) for x, y in ends]
    rise, undulation = heights[1] - heights[0], 0.004 * driven * hills
    return Leg(
        distance_km=round(driven / 1000 * float(rng.normal(1.0, 0.04)), 2),
        duration_s=round((builder.steps - first) * STEP * float(rng.lognormal(0.0, 0.12))),
        gained_m=round(max(rise, 0.0) + undulation, 0),
        lost_m=round(max(-rise, 0.0) + undulation, 0),
    )


def _misjudge(planned: Leg, spread: float, common: float, rng: np.random.Generator) -> Leg:
    """Return a plan that is wrong by a factor of mean 1, whose logarithm has a part common to the shift."""
    sd = float(np.sqrt(np.log1p(spread**2)))
    factor = float(np.exp(sd * (common + np.sqrt(0.75) * rng.normal()) - 0.5 * sd**2))
    return Leg(
        distance_km=round((planned.distance_km or 0.0) * factor, 2),
        duration_s=round(planned.duration_s * factor),
        gained_m=planned.gained_m,
        lost_m=planned.lost_m,
    )


def _wait_in_vain(
    builder: _TimelineBuilder, ride: int, car: Car, orders: Orders, traffic: float, rng: np.random.Generator
) -> Interlude:
    """Drive to a passenger who does not come, and return the ride as it was planned."""
    _drive_to(builder, float(rng.lognormal(np.log(900.0), 0.5)), NO_RIDE, 1, orders.style, traffic, rng)
    builder.stand(float(rng.uniform(180, 420)), NO_RIDE, 1)
    km = float(np.clip(rng.lognormal(np.log(car.ride_median), car.ride_spread), 350, 34e3)) / 1000.0
    return Interlude(ride, builder.steps, round(120.0 + 155.0 * km * float(rng.lognormal(0.0, 0.2))), round(km, 2))


def _end_at_home(builder: _TimelineBuilder, orders: Orders, rng: np.random.Generator) -> None:
    """Drive home, if the shift ends there."""
    if orders.way_home > 0.0 and rng.uniform() < orders.way_home:
        _drive_to(builder, float(rng.uniform(*WAY_HOME)), NO_RIDE, 1, orders.style, 0.5, rng)


def _smooth(values: Floats, width: int) -> Floats:
    """Return the centred moving average; the values at the ends are repeated."""
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1 / width), mode="valid")
