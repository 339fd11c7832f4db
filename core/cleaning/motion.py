"""Speed, distance, elevation and heading from what the sensors say, causally, tunnels and holes included.

Distance is the integral of the believed speed. Two witnesses check it: the odometer, and the chord between two fixes,
which no path can be shorter than. Where the speed had a hole (a tunnel, a gap, a rejected value) and a witness has seen
more distance than the speed has shown since the witness last spoke, the shortfall is made good, once. A fix that is
farther away than the car can have driven since the last one is held back until the next fix confirms it; a single
spike is therefore never driven, while the far end of a tunnel is. Where the speed is missing it is held, for 20 periods
at most, and for 3.5 where a witness will tell. A car that never sends a speed is measured by its fixes, from one to the
next that is 20 m away, else by its odometer.

Work is done over distance / speed, not over the step, where a distance was bridged or held. The acceleration is that
which accounts for the kinetic energy of the smoothed speed, so that over a ride inertia adds up to the difference of
its ends; on an ordinary row it is the smoothed speed's change over the step.

Elevation is smoothed over distance, so that a standing car climbs nothing, and then passes a backlash (a play
operator, Brokate and Sprekels, Hysteresis and Phase Transitions, Springer 1996, DOI 10.1007/978-1-4612-4048-8), so
that metre-sized noise makes no hills. What it costs: hills of wavelength l keep 1 / sqrt(1 + (2 pi L / l)^2) of their
height, L being the smoothing length (all but 1 % for 3.6 km, 89 % for 1 km), and each turn of the slope loses at most
twice the slack; the climb still to come when a ride ends is not in it.
"""

from math import atan2, cos, isnan, nan, pi, sqrt
from typing import Any, Final

from numba import njit

from core.cleaning.quality import Quality
from core.columns import EARTH_RADIUS, KMH

FIELDS: Final = (
    "latitude",  # last believed fix [rad]
    "longitude",
    "fix_age",  # time since that fix [s]
    "fix_distance",  # distance counted since [m]
    "fix_hole",  # 1 if the speed had a hole since
    "fix_still",  # time since for which the speed read nothing [s]
    "fix_live",  # 1 if the fix had moved before it was believed, 0 for the first one after silence
    "pending_latitude",  # a fix that waits to be confirmed [rad]
    "pending_longitude",
    "pending_age",  # time since it came [s]
    "heading",  # [rad]
    "heading_latitude",  # fix from which the next heading is taken
    "heading_longitude",
    "heading_age",  # time since the last heading [s]
    "odometer",  # last believed [m]
    "odometer_distance",  # distance counted since it last changed [m]
    "odometer_age",  # time since then [s]
    "odometer_hole",
    "odometer_ticks",
    "speed",  # last believed speed as reported, NaN in a hole [m/s]
    "speed_age",  # time since a speed was last believed [s]
    "smooth",  # last smoothed speed [m/s]
    "place",  # next place in the ring below
    ("ring", 8),  # believed speeds of the last samples, NaN where there was none [m/s]
    "has_speed",
    "has_fix",
    "elevation",  # smoothed [m]
    "level",  # after the backlash [m]
    "standing",
)

SPEED_REJECTED: Final = int(Quality.SPEED_REJECTED)
SPEED_MISSING: Final = int(Quality.SPEED_MISSING)
POSITION_MISSING: Final = int(Quality.POSITION_MISSING)
POSITION_JUMP: Final = int(Quality.POSITION_JUMP)
POSITION_FROZEN: Final = int(Quality.POSITION_FROZEN)
BRIDGED: Final = int(Quality.BRIDGED)

NEAR: Final = 5.0  # fixes nearer than this are the same place [m]
WANDER: Final = 20.0  # the same where the fixes alone must tell whether the car moves [m]
SLACK: Final = 50.0  # what two fixes may be wrong by [m]
TURN: Final = 15.0  # a heading needs this much of a base [m]
BLIND: Final = 200.0  # fixes lag behind the wheels by less than this [m]
NULL_ISLAND: Final = 1e-4  # half-width of the square round 0/0 that is no fix [rad]
LONGEST_HOLD: Final = 20.0  # a speed is held, or interpolated, over so much at most [periods]
HOLE: Final = 3.5  # steps of more periods than this are holes [periods]
CRAWL: Final = 0.5  # below this the car stands [m/s]
MOVING: Final = 1.5  # above this it moves [m/s]
BRIDGING: Final = 20 * KMH  # least speed at which an unseen distance is taken to have been driven [m/s]


@njit(cache=False)
def turned(angle: float) -> float:
    """Return a difference of two angles as the shorter way round. [rad]"""
    return angle - 2.0 * pi if angle > pi else angle + 2.0 * pi if angle < -pi else angle


@njit(cache=False)
def chord(latitude: float, longitude: float, other_latitude: float, other_longitude: float) -> float:
    """Return the distance of two fixes on a sphere, for distances of some kilometres. [m]"""
    north = other_latitude - latitude
    east = turned(other_longitude - longitude)
    east *= cos(0.5 * (latitude + other_latitude))
    return EARTH_RADIUS * sqrt(north * north + east * east)


@njit(cache=False)
def steer(s: Any, latitude: float, longitude: float, dt: float) -> float:
    """Update the heading from a believed fix; return the rate of turn. [rad/s]"""
    s.heading_age += dt
    if isnan(s.heading_latitude):
        s.heading_latitude, s.heading_longitude = latitude, longitude
        return 0.0
    if chord(s.heading_latitude, s.heading_longitude, latitude, longitude) < TURN:
        return 0.0
    east = turned(longitude - s.heading_longitude) * cos(latitude)
    heading = atan2(east, latitude - s.heading_latitude)
    turn = turned(heading - s.heading)
    rate = turn / s.heading_age if s.heading_age > 0.0 else 0.0
    s.heading = heading
    s.heading_latitude, s.heading_longitude = latitude, longitude
    s.heading_age = 0.0
    return 0.0 if isnan(rate) else rate


@njit(cache=False)
def believe(s: Any, latitude: float, longitude: float, distance: float, limit: float) -> tuple[float, float]:
    """Take a fix as true; return the distance that the speed has missed and a speed derived from the fixes."""
    shortfall = distance - s.fix_distance
    blind = s.fix_live == 1.0 and shortfall > BLIND and s.fix_still > 0.5 * s.fix_age  # a GPS speed in a tunnel
    if s.fix_hole == 0.0 and not blind:
        shortfall = 0.0
    derived = distance / s.fix_age if s.fix_age > 0.0 else nan
    s.latitude, s.longitude = latitude, longitude
    s.fix_age = s.fix_distance = s.fix_hole = s.fix_still = 0.0
    s.fix_live = 1.0
    s.pending_latitude = nan
    return (max(0.0, shortfall) if distance <= limit else 0.0), derived


@njit(cache=False)
def confirmed(s: Any, latitude: float, longitude: float, dt: float, step: float, x: Any) -> bool:
    """Say whether a far fix agrees with the one before it, which was as far; else hold it back until the next."""
    s.pending_age += dt
    if not isnan(s.pending_latitude):
        apart = chord(s.pending_latitude, s.pending_longitude, latitude, longitude)
        if apart <= x.speed_limit * max(s.pending_age, step) + SLACK:
            return True
    s.pending_latitude, s.pending_longitude, s.pending_age = latitude, longitude, 0.0
    return False


@njit(cache=False)
def locate(s: Any, r: Any, dt: float, x: Any) -> tuple[float, float]:
    """Judge a fix, noting what is wrong with it.

    Returns
    -------
    shortfall : float
        Distance that the fix proves and the speed has not shown. [m]
    derived : float
        Speed from the fixes, NaN where they do not tell. [m/s]
    """
    latitude, longitude = r.raw_latitude, r.raw_longitude
    if isnan(latitude) or isnan(longitude) or (abs(latitude) < NULL_ISLAND and abs(longitude) < NULL_ISLAND):
        r.quality += POSITION_MISSING if s.has_fix == 1.0 or not isnan(latitude) else 0
        return 0.0, nan
    s.has_fix = 1.0
    if isnan(s.latitude):
        s.latitude, s.longitude = latitude, longitude
        s.fix_age = s.fix_distance = s.fix_hole = s.fix_still = 0.0
        return 0.0, nan
    step = max(dt, x.period)
    distance = chord(s.latitude, s.longitude, latitude, longitude)
    if distance < (NEAR if s.has_speed == 1.0 else WANDER):
        s.pending_latitude = nan
        frozen = latitude == s.latitude and longitude == s.longitude and s.smooth > MOVING
        r.quality += POSITION_FROZEN if frozen else 0
        return 0.0, (0.0 if s.fix_age > 2.0 * x.period else nan)
    r.quality += POSITION_JUMP if distance > x.speed_limit * step + SLACK else 0
    if distance > x.speed_limit * max(s.fix_age, step) + SLACK and not confirmed(s, latitude, longitude, dt, step, x):
        return 0.0, nan
    return believe(s, latitude, longitude, distance, x.tunnel_limit)


@njit(cache=False)
def odometer_shortfall(s: Any, odometer: float, most: float) -> float:
    """Return the distance that the odometer proves and the speed has not shown. [m]"""
    if isnan(odometer) or odometer == s.odometer:
        return 0.0
    driven = odometer - s.odometer
    told = s.odometer_hole == 1.0 and s.odometer_ticks >= 1.0 and 0.0 < driven <= most
    shortfall = driven - s.odometer_distance if told else 0.0
    s.odometer = odometer
    s.odometer_ticks += 1.0
    s.odometer_distance = s.odometer_hole = s.odometer_age = 0.0
    return max(0.0, shortfall) if shortfall > SLACK else 0.0


@njit(cache=False)
def smoothed(s: Any, speed: float, window: int, restart: bool) -> float:
    """Return the moving average of the last believed speeds. [m/s]"""
    ring = s.ring
    if restart:
        ring[:] = nan
    ring[int(s.place) % window] = speed
    s.place += 1.0
    total = 0.0
    count = 0
    for i in range(window):
        if not isnan(ring[i]):
            total += ring[i]
            count += 1
    return total / count


@njit(cache=False)
def climb(s: Any, elevation: float, distance: float, x: Any) -> float:
    """Return the climb of the step, after smoothing and backlash; downhill is negative. [m]"""
    if isnan(elevation):
        return 0.0
    if isnan(s.elevation):
        s.elevation = s.level = elevation
        return 0.0
    if distance > 0.0:
        s.elevation += distance / (x.elevation_length + distance) * (elevation - s.elevation)
    above = s.elevation - s.level
    risen = max(0.0, above - x.elevation_slack) + min(0.0, above + x.elevation_slack)
    s.level += risen
    return risen


@njit(cache=False)
def stride(s: Any, speed: float, dt: float, fixed: bool, witnessed: bool, period: float) -> float:
    """Return the distance of a step from the speed alone, and note a hole in it. [m]

    Where the speed is not known the last one is held, but not for long where a witness will tell.
    """
    s.speed_age += dt
    gap = dt > HOLE * period
    if isnan(speed) or gap:
        s.fix_hole = s.odometer_hole = 1.0
    if gap and witnessed:
        distance = 0.0
    elif isnan(speed):
        held = not fixed and s.speed_age <= (HOLE if witnessed else LONGEST_HOLD) * period
        distance = s.smooth * dt if held else 0.0
    else:
        distance = (speed if isnan(s.speed) else 0.5 * (s.speed + speed)) * min(dt, LONGEST_HOLD * period)
    s.fix_distance += distance
    s.odometer_distance += distance
    return distance


@njit(cache=False)
def believed_speed(s: Any, r: Any, x: Any) -> float:
    """Return the reported speed, NaN where it is rejected or missing. [m/s]"""
    reported = r.raw_speed
    if reported > x.speed_limit:
        r.quality += SPEED_REJECTED
        return nan
    if not isnan(reported):
        s.has_speed = 1.0
    elif s.has_speed == 1.0:
        r.quality += SPEED_MISSING
    return float(reported)


@njit(cache=False)
def move(s: Any, r: Any, dt: float, x: Any) -> None:
    """Move the car on by a sample: fill in distance, travel, speed, acceleration, turn rate and climb."""
    speed = believed_speed(s, r, x)
    s.fix_age += dt
    s.odometer_age += dt
    age = max(s.fix_age, dt)
    fixed = not (isnan(r.raw_latitude) or isnan(s.latitude))
    distance = stride(s, speed, dt, fixed, fixed or not isnan(s.odometer), x.period)
    shortfall, derived = locate(s, r, dt, x)
    if isnan(r.raw_speed) and derived <= x.speed_limit:
        speed = derived
    s.odometer_distance += shortfall
    since = s.odometer_age
    owed = odometer_shortfall(s, r.raw_odometer, x.speed_limit * since + x.tunnel_limit)
    if owed > 0.0:
        s.fix_distance += owed
        shortfall += owed
        age = since if isnan(s.latitude) else max(age, since)
    r.turn_rate = 0.0 if isnan(s.latitude) else steer(s, s.latitude, s.longitude, dt)
    before = s.smooth
    gap = dt > HOLE * x.period
    if not isnan(speed):
        s.smooth = smoothed(s, speed, int(x.window), gap or s.speed_age > HOLE * x.period)
        s.speed_age = 0.0
    s.speed = speed
    r.speed = 0.5 * (before + s.smooth)
    r.distance = distance + shortfall
    r.travel = dt
    if shortfall > 0.0 and (s.has_speed == 1.0 or gap or owed > 0.0 or shortfall > x.speed_limit * dt):
        r.quality += BRIDGED
        r.speed = min(x.speed_limit, max(BRIDGING, r.speed, r.distance / max(age, x.period)))
        r.travel = r.distance / r.speed
    elif isnan(speed):
        r.travel = r.distance / r.speed if r.speed > 0.0 else 0.0
    elif derived > 0.0 and s.has_speed == 0.0:
        r.travel = age if age <= HOLE * x.period else min(age, r.distance / r.speed)
    run = r.speed * r.travel
    r.acceleration = 0.5 * (s.smooth * s.smooth - before * before) / run if run > 0.0 else 0.0
    r.climb = climb(s, r.raw_elevation, r.distance, x)
