"""Simulate a city like Montreal: a grid of streets, three expressways with tunnels, and a hill in the centre.

The axes `u`, `v` [m] of the city run along the streets, turned by 30 degrees from east `x` and north `y` [m].
"""

from itertools import pairwise
from math import ceil, cos, floor, pi, sin
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import EARTH_RADIUS, KMH

ORIGIN: Final = (45.505, -73.595)
"""Latitude and longitude of the centre. [deg]"""
TURN: Final = pi / 6
LOWLAND: Final = 32.0
"""Elevation of the plain. [m]"""
BLOCK: Final = (140.0, 220.0)
"""Distance between streets along u and along v. [m]"""
EXTENT: Final = (11_000.0, 7_000.0)
"""Half the size of the city along u and along v. [m]"""
RESIDENTIAL, BOULEVARD, EXPRESSWAY = 0, 1, 2


class Line(NamedTuple):
    """Describe an expressway.

    Parameters
    ----------
    axis : int
        Axis along which it runs: 0 for u, 1 for v.
    at : float
        Its position on the other axis. [m]
    limit : float
        Speed limit. [m/s]
    tunnels : tuple of (float, float)
        Begin and end of each tunnel. [m]
    """

    axis: int
    at: float
    limit: float
    tunnels: tuple[tuple[float, float], ...]


EXPRESSWAYS: Final = (
    Line(0, -9 * BLOCK[1], 90 * KMH, ((-700.0, 600.0), (3000.0, 3900.0))),
    Line(1, 20 * BLOCK[0], 100 * KMH, ((-850.0, 600.0),)),
    Line(0, 16 * BLOCK[1], 80 * KMH, ((-2500.0, -1400.0),)),
)
"""Tunnels are 0.9 to 1.45 km long, so that a position that jumps this far in 3 s gives 1,000 to 2,000 km/h."""


class Route(NamedTuple):
    """Hold a route through the city: its nodes, and the conditions at the end of each segment.

    Parameters
    ----------
    u, v : (k + 1,) float
        Nodes. [m]
    along : (k + 1,) float
        Distance driven at each node. [m]
    limit : (k,) float
        Speed limit of each segment. [m/s]
    street : (k,) int
        RESIDENTIAL, BOULEVARD or EXPRESSWAY.
    turn : (k,) bool
        True if the route turns at the end of the segment.
    """

    u: Floats
    v: Floats
    along: Floats
    limit: Floats
    street: np.ndarray
    turn: np.ndarray

    @property
    def length(self) -> float:
        """Length of the route. [m]"""
        return float(self.along[-1])


def compute_elevation(x: Floats, y: Floats, *, hills: bool = True) -> Floats:
    """Return the elevation of the ground. [m]

    Units: y [m].
    """
    if not hills:
        return np.full(np.shape(x), LOWLAND)
    hill = 165.0 * np.exp(-(x * x + 1.3 * y * y) / (2 * 1300.0**2))
    rolling = 9.0 * np.sin(x / 1100.0 + 0.4) * np.cos(y / 1500.0) + 3.0 * np.sin(x / 420.0) * np.cos(y / 380.0 + 1.0)
    return LOWLAND + hill + rolling - 0.0012 * y


def to_plane(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Return the position east and north of the centre from the axes of the city. [m]

    Units: u [m], v [m].
    """
    return u * cos(TURN) - v * sin(TURN), u * sin(TURN) + v * cos(TURN)


def to_wgs84(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return latitude and longitude. [deg]

    Units: y [m].
    """
    latitude = ORIGIN[0] + np.degrees(y / EARTH_RADIUS)
    return latitude, ORIGIN[1] + np.degrees(x / (EARTH_RADIUS * np.cos(np.radians(latitude))))


def is_in_tunnel(u: Floats, v: Floats, heading: Floats) -> np.ndarray:
    """Return a mask of the positions inside a tunnel, without those that cross above it. (n,) bool

    Units: u [m], v [m], heading [rad].
    """
    inside = np.zeros(len(u), bool)
    for line in EXPRESSWAYS:
        along, across, aligned = (u, v, np.cos(heading)) if line.axis == 0 else (v, u, np.sin(heading))
        for begin, end in line.tunnels:
            inside |= (np.abs(across - line.at) < 5) & (along > begin) & (along < end) & (np.abs(aligned) > 0.7)
    return inside


def draw_destination(u: float, v: float, distance: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return a crossing at about the given distance along streets, more likely towards the centre than out of town.

    Units: u [m], v [m], distance [m].
    """
    for _ in range(30):
        share = rng.uniform()
        sign_u = -1.0 if rng.uniform() < 0.5 + 0.4 * u / EXTENT[0] else 1.0
        sign_v = -1.0 if rng.uniform() < 0.5 + 0.4 * v / EXTENT[1] else 1.0
        goal = (u + sign_u * share * distance, v + sign_v * (1 - share) * distance)
        if abs(goal[0]) <= EXTENT[0] and abs(goal[1]) <= EXTENT[1]:
            break
    else:
        goal = (-u / 3, -v / 3)
    reached = find_crossing(*goal)
    return reached if reached != (u, v) else find_crossing(u + 2 * BLOCK[0], v)


def find_crossing(u: float, v: float) -> tuple[float, float]:
    """Return the crossing nearest to a position at which a car may stop; none lies on an expressway.

    Units: u [m], v [m].
    """
    place = [round(u / BLOCK[0]) * BLOCK[0], round(v / BLOCK[1]) * BLOCK[1]]
    for line in EXPRESSWAYS:
        across = 1 - line.axis
        if abs(place[across] - line.at) < 5:
            place[across] += BLOCK[across]
    return place[0], place[1]


def make_route(start: tuple[float, float], goal: tuple[float, float], rng: np.random.Generator) -> Route:
    """Return a route over streets; long routes take an expressway if one is near.

    Units: start [m], goal [m].
    """
    points = [start, *_corners(start, goal, rng), goal]
    nodes, limits, streets, turns = [start], list[float](), list[int](), list[bool]()
    for a, b in pairwise(points):
        length = abs(b[0] - a[0]) + abs(b[1] - a[1])
        if length < 1:
            continue
        if turns:
            turns[-1] = True
        street, limit = _street(a, b)
        count = max(1, round(length / (220.0, 330.0, 700.0)[street]))
        shares = [k / count for k in range(1, count + 1)]
        nodes += [(a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share) for share in shares]
        limits += [limit] * count
        streets += [street] * count
        turns += [False] * count
    u, v = np.array(nodes).T
    along = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(u)) + np.abs(np.diff(v)))])
    return Route(u, v, along, np.array(limits), np.array(streets), np.array(turns))


def _corners(
    start: tuple[float, float], goal: tuple[float, float], rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Return the crossings at which a route turns."""
    direct = abs(goal[0] - start[0]) + abs(goal[1] - start[1])
    best = min(EXPRESSWAYS, key=lambda line: abs(start[1 - line.axis] - line.at) + abs(goal[1 - line.axis] - line.at))
    detour = abs(start[1 - best.axis] - best.at) + abs(goal[1 - best.axis] - best.at)
    if direct > 3000 and detour < 0.8 * direct and rng.uniform() < 0.75:
        enter, leave = _ramp(best, start[best.axis]), _ramp(best, goal[best.axis])
        if best.axis == 0:
            return [(enter, start[1]), (enter, best.at), (leave, best.at), (leave, goal[1])]
        return [(start[0], enter), (best.at, enter), (best.at, leave), (goal[0], leave)]
    boulevard = 5 * BLOCK[0]
    middle, _ = find_crossing(
        round((start[0] + rng.uniform() * (goal[0] - start[0])) / boulevard) * boulevard, start[1]
    )
    return [(middle, start[1]), (middle, goal[1])]


def _ramp(line: Line, at: float) -> float:
    """Return the position at which to join or leave an expressway: `at`, or the nearer end of a tunnel there. [m]"""
    block = BLOCK[line.axis]
    for begin, end in line.tunnels:
        if begin - 5 < at < end + 5:
            return block * (floor(begin / block) if at < (begin + end) / 2 else ceil(end / block))
    return at


def _street(a: tuple[float, float], b: tuple[float, float]) -> tuple[int, float]:
    """Return the class of a straight section and its speed limit [m/s]."""
    axis = 0 if abs(b[0] - a[0]) > abs(b[1] - a[1]) else 1
    at = a[1 - axis]
    for line in EXPRESSWAYS:
        if line.axis == axis and abs(line.at - at) < 5:
            return EXPRESSWAY, line.limit
    if round(at / BLOCK[1 - axis]) % 5 == 0:
        return BOULEVARD, 50 * KMH
    return RESIDENTIAL, 40 * KMH
