"""The state of charge of each car, and what it uses today over what the model says: a Kalman filter a car.

The state is (s, a, c): the state of charge s [1]; the logarithm a of the energy that this car, with this driver, takes
today over the predicted; and the logarithm c of its usable capacity over the nominal one. Over a stretch of driving or
standing with the predicted energy E the charge falls by exp(a - c) E / C, or, where voltage and current are measured,
by that energy over exp(c) C, and the two energies together tell a.

A meter has a gain, which is the same for good. It shifts a and c alike, so that neither what the charge falls by nor
the two energies tell of it: a and c are as this car's meter has them; how unsure the gain is counts where a capacity is
told in kWh, no less however long is measured.

How unsure the state is follows the slopes of these equations at the point where the shift began, not at what has been
found since. So it does not depend on what is reported, only on when something is learned of it: where less was learned,
nothing is ever surer.

A reported state of charge is an interval, not a value with noise. It says most when it ticks: then the charge has just
crossed the boundary between two reported values, and only then is it a measurement. Between ticks it says that the
boundary has not been crossed: that moves what is published, and makes nothing surer.

What is reported may lie. A value that jumps is not believed until it has stayed for a while, and then moves the charge
and makes it less sure; one that does not tick though it must have is not believed until it ticks, which then makes
nothing surer before the next; where none comes, or none is believed, the prediction goes on alone and grows unsure.
After charging and after silence the filter begins at what is reported.

References
----------
Kalman, Journal of Basic Engineering 82 (1960) 35, DOI 10.1115/1.3662552; extended, but for its covariance, as in
Jazwinski, Stochastic Processes and Filtering Theory, Academic Press 1970, section 8.3. On quantised measurements as
intervals: Curry, Estimation and Control with Quantized Measurements, MIT Press 1970. The moments of a truncated normal:
Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions 1, Wiley 1994, section 13.10.1.
"""

from math import erfc, exp, isnan, nan, pi, sqrt
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.forecast.kalman_update import correct, drive, nudge

FIELDS: Final = (
    "heard",  # 1 once the car has sent anything
    "time",  # of the newest event [s]
    "s",  # state of charge [1]
    "a",  # log of the energy used over the predicted
    "c",  # log of the usable capacity over the nominal
    *("ss", "sa", "sc", "aa", "ac", "cc"),  # their covariance
    "fell",  # charge that was used since one was reported [1]
    "quantum",  # of what is reported [1]
    "reported",  # state of charge, as last believed or to be compared with [1]
    "frozen",  # 1 while that does not tick though it must have
    "suspect",  # a reported value that jumped, NaN for none [1]
    "suspect_time",  # since when [s]
    "charging",  # 1 while it is plugged in
    "plugged",  # since when [s]
    *("seen_predicted", "seen_metered", "seen_meter_time", "seen_time"),  # of the ride or rest in progress
    *("seen_ambient", "seen_distance"),
    "ambient",  # newest [K]
    "shift",  # ordinal
    "begin",  # of the shift [s]
    "begin_soc",  # [1]
    "last_soc",  # as reported last in the shift [1]
    "lowest_soc",  # [1]
    "distance",  # driven in the shift [m]
    "ride_distance",  # of it on rides [m]
    "hours",  # awake in the shift [h]
    "predicted",  # in the shift [kWh]
    "warmth",  # integral of the ambient temperature over that [K h]
    "charged",  # time of the last charging within the shift, NaN for none [s]
    *("size", "usual", "usual_variance"),  # as the shift began: `c`, and mean and variance of `a` less `c`
    *("driver", "driver_mean", "driver_variance"),  # who drives, -1 while it is not known; of that, their part
    "drivers",  # how many have driven in the shift
    *("next", "next_mean", "next_variance"),  # the same of who was named since, -1 for none
    *("ticks", "jumps", "freezes", "anchors"),
)
STATE: Final = np.dtype([(name, "f8") for name in FIELDS])
"""What is remembered of a car."""
_UNKNOWN: Final = ("s", "reported", "suspect", "charged", "ambient", "begin_soc", "last_soc", "lowest_soc", "ss")

RUNNING: Final = 0
"""Event: totals of the ride or rest in progress."""
CLOSED: Final = 1
"""Event: totals of a ride or rest that has ended."""
NAMED: Final = 2
"""Event: who drives from the next running totals on, by the code in `duration`; `predicted` and `metered` are mean and
variance of their part in `a`."""

EVENT: Final = np.dtype(
    [
        ("kind", "i8"),
        ("lane", "i8"),
        ("time", "f8"),  # [s]
        ("predicted", "f8"),  # of the ride or rest so far [kWh]
        ("factor", "f8"),  # by which that is to be multiplied now [1]
        ("power", "f8"),  # and what is to be added [kW]
        ("metered", "f8"),  # by voltage and current, so far [kWh]
        ("meter_time", "f8"),  # for which that is known [s]
        ("duration", "f8"),  # so far [s]
        ("distance", "f8"),  # so far [m]
        ("riding", "f8"),  # 1 for a ride
        ("ambient", "f8"),  # integral over time so far [K s]
        ("soc", "f8"),  # as reported, NaN for none [1]
        ("step", "f8"),  # its quantum, NaN for unknown [1]
        ("since_charge", "f8"),  # NaN for never [s]
        ("capacity", "f8"),  # nominal usable [kWh]
    ]
)
"""What the filter hears of a car."""

SILENCE: Final = 600.0
"""After longer silence the filter begins at what is reported. [s]"""
BETWEEN_SHIFTS: Final = 7200.0
"""Longer silence ends a shift. [s]"""
UNPLUGGED: Final = 60.0
"""A charge that was shorter is none. [s]"""
SETTING_OUT: Final = 300.0
"""Until a car has driven so far, its shift has not begun to cost anything. [m]"""
COARSEST: Final = 0.01
"""Quantum of a state of charge that has not been seen to tick. [1]"""
FLOOR: Final = 0.001
"""Standard deviation of a car's own estimate of its charge, where it ticks. [1]"""
NOISE: Final = 0.15
"""Standard deviation of the energy of a stretch that takes 1 kWh, over the predicted; it grows with the root. [1]"""
WARMING: Final = 1200.0
"""Time after waking or charging in which a car warms up, and what it takes tells less of how it is. [s]"""
UNSURE: Final = 4.0
"""By how much the variance of the energy is larger then. [1]"""
METER: Final = 0.015
"""Standard deviation of the gain of a car's meter, the same for good: of voltage and of current 1 % each. [1]"""
SAMPLED: Final = 0.05
"""Standard deviation of what a meter that samples every few seconds makes of 1 kWh; it grows with the root. [1]"""
DRIVER: Final = 0.06
"""Standard deviation of what drivers take, about what they take on average. [1]"""
WANDER: Final = 0.05
"""Standard deviation of the change of `a` in an hour awake. [1]"""
BLIND_POWER: Final = 5.0
"""Standard deviation of the power where no model tells. [kW]"""
CLEARLY: Final = 4.0
"""Standard deviations beyond which a reported value is not believed."""
MARGIN: Final = 0.01
"""Share of the charge by which it must be off besides. [1]"""
STAYS: Final = 180.0
"""Time for which a value that jumped must stay. [s]"""
JUMPED: Final = 0.01
"""Standard deviation that is added where a jump is believed. [1]"""
CAPACITY: Final = 0.1
"""Standard deviation of `c` before anything is learned: age, temperature, what a car calls full."""
AGEING: Final = 0.005
"""Standard deviation of the change of `c` from shift to shift: by age, and more by how cold the battery is."""

TOLD: Final = (
    "soc",  # published [1]
    "variance",
    "scale",  # `a` less `c`
    "scale_variance",
    "covariance",  # of both
    "ambient",  # [K]
    "shift",
    "quantum",  # [1]
    "charged",  # [s]
    "reported",  # [1]
    "begin",  # of the shift [s]
    "begin_soc",  # [1]
    "distance",  # in the shift [m]
    "usual",  # `scale` as it was expected to be, before anything was found today
)
"""What is told after each event."""

CLOSED_SHIFT: Final = np.dtype(
    [
        *((name, "f8") for name in ("event", "lane", "shift", "begin", "end", "begin_soc", "last_soc", "lowest_soc")),
        *((name, "f8") for name in ("distance", "ride_distance", "hours", "predicted", "warmth", "charged", "driver")),
    ]
)
"""A shift that has ended; `event` is the number of the event that told so."""


def new_state(lanes: int) -> NDArray[np.void]:
    """Return the state of cars never heard of, (lanes,) of `STATE`."""
    state = np.zeros(lanes, STATE)
    for name in _UNKNOWN:
        state[name] = nan
    state["shift"] = state["driver"] = state["next"] = -1.0
    state["cc"] = CAPACITY**2
    state["quantum"] = COARSEST
    return state


@njit(cache=True)
def follow(events: Any, state: Any, prior: Any, out: Any, shifts: Any) -> int:
    """Take events in order.

    Parameters
    ----------
    events : (n,) EVENT
    state : (lanes,) STATE
        Changed in place.
    prior : (lanes, 2) float
        Mean and variance of `a` less `c` when a shift begins.
    out : (n, len(TOLD)) float
        `TOLD` after each event.
    shifts : (n,) CLOSED_SHIFT
        Those that ended.

    Returns
    -------
    int
        How many shifts ended.
    """
    closed = 0
    for i in range(events.shape[0]):
        e = events[i]
        s = state[e.lane]
        if e.kind == NAMED:
            s.next, s.next_mean, s.next_variance = e.duration, e.predicted, e.metered
        else:
            if s.heard == 0.0 or e.time - s.time > BETWEEN_SHIFTS:
                if s.shift >= 0.0:
                    close_shift(s, i, e.lane, shifts[closed])
                    closed += 1
                open_shift(s, e, prior[e.lane])
            if e.kind == RUNNING:  # a ride or rest that has ended may be of the shift before
                drive(s, WANDER**2 * max(s.time - s.begin, 0.0) / 3600.0)
            step = COARSEST if isnan(e.step) else e.step
            s.quantum = min(s.quantum, step)
            hear(s, e)
            s.quantum = step
        tell(s, out[i])
    return closed


@njit(cache=True)
def open_shift(s: Any, e: Any, prior: Any) -> None:
    """Begin a shift: the driver and the day are new."""
    s.shift += 1.0
    s.begin = e.time
    s.distance = s.ride_distance = s.hours = s.predicted = s.warmth = 0.0
    s.begin_soc = s.last_soc = s.lowest_soc = s.charged = nan
    s.driver, s.driver_mean, s.driver_variance, s.drivers = -1.0, 0.0, DRIVER**2, 0.0
    s.cc = min(s.cc + AGEING**2, CAPACITY**2)
    s.size, s.usual, s.usual_variance = s.c, prior[0], prior[1]  # shifts tell of `a` less `c`
    s.a, s.aa = s.c + prior[0], s.cc + prior[1]
    s.sa, s.ac = s.sc, s.cc


@njit(cache=True)
def close_shift(s: Any, event: int, lane: int, row: Any) -> None:
    """Write down a shift that has ended."""
    row.event, row.lane, row.shift, row.begin, row.end = event, lane, s.shift, s.begin, s.time
    row.begin_soc, row.last_soc, row.lowest_soc = s.begin_soc, s.last_soc, s.lowest_soc
    row.ride_distance, row.distance, row.hours, row.predicted, row.warmth = (
        s.ride_distance,
        s.distance,
        s.hours,
        s.predicted,
        s.warmth,
    )
    row.charged = s.charged
    row.driver = s.driver if s.drivers == 1.0 else -1.0  # what two have taken tells of neither


@njit(cache=True)
def hear(s: Any, e: Any) -> None:
    """Take the totals of a ride or rest."""
    passed = e.time - s.time if s.heard == 1.0 else 0.0
    meter_time, duration = e.meter_time - s.seen_meter_time, e.duration - s.seen_time
    predicted = e.factor * (e.predicted - s.seen_predicted) + e.power * duration / 3600.0
    metered = e.metered - s.seen_metered
    warmth, distance = e.ambient - s.seen_ambient, e.distance - s.seen_distance
    if e.kind == CLOSED:
        s.seen_predicted = s.seen_metered = s.seen_meter_time = 0.0
        s.seen_time = s.seen_ambient = s.seen_distance = 0.0
    else:
        s.seen_predicted = 0.0 if isnan(e.predicted) else e.predicted
        s.seen_metered, s.seen_meter_time = e.metered, e.meter_time
        s.seen_time, s.seen_ambient, s.seen_distance = e.duration, e.ambient, e.distance
    if duration > 0.0:
        s.ambient = warmth / duration
        if s.distance > SETTING_OUT:
            s.hours += duration / 3600.0
            s.warmth += warmth / 3600.0
            s.predicted += 0.0 if isnan(predicted) else predicted
        s.distance += distance
        s.ride_distance += e.riding * distance
    silent = passed - max(duration, 0.0) > SILENCE
    charging = e.since_charge < passed or (e.since_charge == 0.0 and passed == 0.0 and s.charging == 1.0)
    s.heard, s.time = 1.0, e.time
    if charging and s.charging == 0.0:
        s.plugged = e.time
    s.charging = 1.0 if charging else 0.0
    if charging and s.distance > SETTING_OUT and e.time - s.plugged >= UNPLUGGED:
        s.charged = e.time
    if silent or charging:
        restart(s)
    elif not isnan(s.s):
        used = metered * duration / meter_time if meter_time > 0.5 * duration else nan
        warming = e.time - s.begin < WARMING or e.since_charge < WARMING
        move(s, predicted, used, duration, e.capacity, NOISE**2 * (UNSURE if warming else 1.0))
    observe(s, e)
    if s.charging == 0.0 and isnan(s.suspect) and not isnan(s.reported):
        log_charge(s)


@njit(cache=True)
def move(s: Any, predicted: float, used: float, duration: float, capacity: float, spread: float) -> None:
    """Let the charge fall by what is used, measured by a meter [kWh] or predicted.

    The energy of a stretch has the variance `spread` times 1 kWh times itself, as if made of independent parts.
    """
    if isnan(capacity) or duration <= 0.0:
        return
    s.aa += WANDER**2 * duration / 3600.0
    if isnan(predicted) and isnan(used):
        by_c = BLIND_POWER * duration / 3600.0 / capacity
        s.fell += by_c
        s.ss += by_c**2
        return
    if isnan(used):
        s.s -= exp(s.a - s.c) * predicted / capacity
        by_c = exp(s.usual) * predicted / capacity
        by_a, noise = -by_c, spread * abs(predicted) / capacity**2
    else:
        if not isnan(predicted) and predicted > 0.0:
            learn(s, predicted, used, (spread + SAMPLED**2) * predicted)
        s.s -= used / (capacity * exp(s.c))
        by_c = used / (capacity * exp(s.size))
        by_a, noise = 0.0, SAMPLED**2 * abs(used) / capacity**2
    s.fell += by_c
    s.ss += by_a**2 * s.aa + by_c**2 * s.cc + 2.0 * (by_a * s.sa + by_c * s.sc + by_a * by_c * s.ac) + noise
    s.sa += by_a * s.aa + by_c * s.ac
    s.sc += by_a * s.ac + by_c * s.cc


@njit(cache=True)
def learn(s: Any, predicted: float, used: float, variance: float) -> None:
    """Learn `a` from the energy that a meter measured of a stretch, and the variance of that about what is expected."""
    slope = exp(s.size + s.usual) * predicted
    total = slope**2 * s.aa + variance
    correct(s, used - exp(s.a) * predicted, slope * s.sa, slope * s.aa, slope * s.ac, total)


@njit(cache=True)
def restart(s: Any) -> None:
    """Forget the charge; what is reported next is where it begins."""
    s.s = s.reported = s.suspect = nan
    s.frozen = 0.0


@njit(cache=True)
def anchor(s: Any, reported: float, q: float) -> None:
    """Begin at a reported charge."""
    s.s = s.reported = reported
    s.ss = q * q / 12.0 + FLOOR**2
    s.sa = s.sc = s.fell = 0.0
    s.anchors += 1.0


@njit(cache=True)
def observe(s: Any, e: Any) -> None:
    """Take the charge that is reported."""
    if isnan(e.soc):
        return
    q = s.quantum
    if isnan(s.s):
        anchor(s, e.soc, q)
        return
    spread = sqrt(s.ss + q * q / 12.0)
    limit = max(CLEARLY * spread, q + MARGIN)
    if e.soc == s.reported:
        s.suspect = nan
        s.fell = 0.0
        if s.frozen == 0.0 and abs(s.s - e.soc) > limit:
            s.frozen = 1.0
            s.freezes += 1.0
        return
    if abs(e.soc - s.s) > limit:
        doubt(s, e, limit, q)
        return
    tick(s, e.soc, q)


@njit(cache=True)
def log_charge(s: Any) -> None:
    """Note what is reported, and believed, for the shift's log."""
    s.last_soc = s.reported
    if isnan(s.begin_soc) or s.distance <= SETTING_OUT:
        s.begin_soc = s.lowest_soc = s.reported
    s.lowest_soc = min(s.lowest_soc, s.reported)


@njit(cache=True)
def doubt(s: Any, e: Any, limit: float, q: float) -> None:
    """Wait whether a value that jumped stays; then the charge is there, and what is known of it less sure than before.

    Nothing else is learned, nor forgotten, of it.
    """
    if isnan(s.suspect) or abs(e.soc - s.suspect) > limit:
        s.suspect, s.suspect_time = e.soc, e.time
        s.jumps += 1.0
    elif e.time - s.suspect_time >= STAYS:
        s.s = e.soc
        s.ss += q * q / 12.0 + JUMPED**2
        believe(s, e.soc)
        s.anchors += 1.0


@njit(cache=True)
def tick(s: Any, reported: float, q: float) -> None:
    """Take a tick: since one was reported, the charge has crossed the boundary of the reported value's interval.

    By more than one quantum it may be anywhere in the interval; what is more than was used is not to be trusted. After
    a value that was frozen or doubted, and where it is far more, the charge moves and is no surer than before.
    """
    change = reported - s.reported
    jump = max(abs(change) - abs(s.fell) - q, 0.0) if s.frozen == 0.0 else 0.0
    at, variance = reported, q * q / 12.0 + jump * jump / 4.0 + FLOOR**2
    if abs(change) < 1.5 * q and s.frozen == 0.0:
        since = min(max(s.fell if change < 0.0 else -s.fell, 0.0), q)
        at = reported + (0.5 * (q - since) if change < 0.0 else 0.5 * (since - q))
        variance = (0.1 * q) ** 2 + since**2 / 12.0 + FLOOR**2
    off, variance = at - s.s, s.ss + variance
    if s.frozen == 0.0 and isnan(s.suspect) and jump <= abs(s.fell) + q:
        correct(s, off, s.ss, s.sa, s.sc, variance)
    else:
        nudge(s, off, s.ss, s.sa, s.sc, variance)
    believe(s, reported)
    s.ticks += 1.0


@njit(cache=True)
def believe(s: Any, reported: float) -> None:
    """Note a reported charge that is believed."""
    s.reported = reported
    s.suspect = nan
    s.frozen = s.fell = 0.0


@njit(cache=True)
def tell(s: Any, out: Any) -> None:
    """Write down what is known of a car, `TOLD`."""
    out[0], out[1] = published(s, s.quantum), s.ss
    out[2], out[3], out[4] = s.a - s.c, s.aa + s.cc - 2.0 * s.ac, s.sa - s.sc
    out[5], out[6], out[7], out[8], out[9] = s.ambient, s.shift, s.quantum, s.charged, s.last_soc
    out[10], out[11], out[12], out[13] = s.begin, s.begin_soc, s.distance, s.usual


@njit(cache=True)
def published(s: Any, q: float) -> float:
    """Return the mean of the charge, given that the car's own estimate of it is in the interval of what is reported."""
    if isnan(s.s) or s.frozen == 1.0 or not isnan(s.suspect) or isnan(s.reported) or s.ss <= 0.0:
        return s.s
    sd = sqrt(s.ss + FLOOR**2)
    gain = s.ss / sd**2
    low, high = (s.reported - 0.5 * q - s.s) / sd, (s.reported + 0.5 * q - s.s) / sd
    inside = 0.5 * (erfc(low / sqrt(2.0)) - erfc(high / sqrt(2.0)))
    if inside < 1e-6:
        return s.s + gain * sd * (high if high < 0.0 else low)
    density = (exp(-0.5 * low * low) - exp(-0.5 * high * high)) / sqrt(2.0 * pi)
    return s.s + gain * sd * density / inside
