"""Noise and spikes of a reported speed: how strong they are, and the moving average that they ask for.

*Noise.* White noise of the speed doubles or triples the energy of speeding up and braking. An average over a fixed
number of samples hides much of that energy where the speed is clean. So the noise of each car is estimated, and the
average is as long as the noise asks, at each sample.

The estimate uses the second differences of the speed while the car drives: the changes of its acceleration. Those of
white noise with the standard deviation s have 6^(1/2) s, and the mean r of their normalised products at lag 1,
2 x y / (x^2 + y^2), is -0.38. Three real cars have at least r0 = -0.06 - 0.18 lg(dt) at steps dt of 1 to 10 s, each
over all of its drives; a single drive may have less. The share of noise is (r0 - r) / (r0 + 0.38), as far as chance
does not explain it.
A driver who changes the pedal often alternates too, with products at lag 2 of -0.05 to -0.1, where white noise has
0.08. The difference of both means must therefore be that of noise as well: 0.46 for white noise, and less than
0.08 + 0.1 lg(dt) for the drives of these cars. The lesser share counts.
The noise is this share of the deviation of calm driving, which is a low quantile of the absolute second differences.
At long steps real driving alternates like noise, and noise adds little to its energy: none is sought.

*Average.* Means over the last 1, 2, 3 ... samples are compared. The longest one is taken whose interval, of a half
width of `WIDTH` standard deviations, has a value in common with the intervals of all shorter ones (Goldenshluger and
Nemirovski). On a level stretch that is the whole memory, and beside a true change it is the sample itself.

*Spikes.* A speed that leaps further than drivers change it, there and back, is held back until the next sample. The
row takes the last speed, and the lesser of both distances. If the speed returns, it was a spike and remains unused.
Otherwise the leap is confirmed. Distance that the held row missed is then made good, and the row has the acceleration
of both steps, with their difference as its spread. A leap that continues the change before it is not held back, nor is
a rise for which the battery delivers the power.

References
----------
Goldenshluger, Nemirovski: On spatially adaptive estimation of nonparametric regression. Mathematical Methods of
Statistics 6 (1997) 135. Katkovnik: A new method for varying adaptive bandwidth selection. IEEE Transactions on Signal
Processing 47 (1999) 2567, DOI 10.1109/78.782208: the intersection of confidence intervals.
"""

from math import isnan, log10, nan, sqrt
from typing import Any, Final

from socast.core.cleaning.quality import Quality
from socast.core.columns import KMH
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "leap",  # last speed that is held back, NaN without one [m/s]
    "noise",  # deviation of calm driving that the reported speed owes to noise, 0 where none is shown [m/s]
    "noise_steps",  # number of steps that the estimate has seen, up to its memory
    "noise_dt",  # time of the last step [s]
    "change",  # change of the reported speed in it, NaN where unknown [m/s]
    "curve",  # change of that change, NaN where unknown [m/s]
    "last_curve",  # the one before, NaN where unknown [m/s]
    "alternation",  # running mean of the normalised products of two successive ones [1]
    "second_product",  # the same of each one and the one after the next [1]
    "calm_curve",  # running quantile of their absolute values [m/s]
    "repeats",  # running share of steps without a change of speed [1]
    "leap_limit",  # change of speed beyond which it was held back [m/s]
    "leap_time",  # time of the held rows [s]
    "leap_distance",  # distance that they have more if the leap is confirmed, negative for a fall [m]
    "leap_bend",  # difference of the accelerations before and after a leap confirmed with this row [m/s^2]
    "leap_after",  # acceleration after it, NaN unless one was [m/s^2]
)
UNKNOWN_AT_FIRST: Final = ("change", "curve", "last_curve", "leap", "leap_after")
"""Fields of a new lane that are NaN."""

SPEED_SPIKE: Final = int(Quality.SPEED_SPIKE)
SPEED_NOISY: Final = int(Quality.SPEED_NOISY)

DRIVING: Final = 2.0
"""Speed above which a step counts for the estimate. [m/s]"""
MEMORY: Final = 500.0
"""Memory of the estimate. [steps]"""
WHITE: Final = -0.38
"""Mean normalised product of successive second differences of white noise. [1]"""
WHITE_CONTRAST: Final = 0.46
"""Mean of these products at lag 2 less that at lag 1, of white noise. [1]"""
LEAST_CONTRAST: Final = 0.08
"""The same of clean speeds at most, on average, for steps of 1 s. [1]"""
CONTRAST_DOUBT: Final = 1.4
"""`DOUBT` for the difference of two means. [1]"""
DOUBT: Final = 1.0
"""One and a half standard deviations of the mean of normalised products, times the root of their number. [1]"""
RAMP: Final = 0.02
"""Range of the same mean over which the noise comes into effect. [1]"""
QUANTILE: Final = 0.25
"""Share of the second differences that are calm."""
CALM_PER_NOISE: Final = 0.3186 * 6.0**0.5
"""That quantile of the absolute second differences of white noise, over its standard deviation. [1]"""
QUANTILE_GAIN: Final = 0.026
"""Least relative step of the running quantile, for a standard deviation of 10 %. [1]"""
LONGEST_STEP: Final = 7.5
"""Longest step of which noise can be told from driving, and matters. [s]"""
MOST_REPEATS: Final = 0.4
"""Share of steps without a change from which a speed is refreshed too seldom to show its noise. [1]"""
LEAST_NOISE: Final = 0.2 * KMH
"""Noise below which no average is applied. [m/s]"""
WIDTH: Final = 1.4
"""Half width of the interval of a mean. [standard deviations]

Chosen so that the noise that remains adds as much energy of speeding up as the average hides, on the drives named at
`LEAP_RATE` with white noise of 0.5 to 3 km/h added. It is a compromise: too wide for one car, and too narrow for very
smooth drives.
"""
WIDER: Final = 0.35
"""How much wider it is where all is noise, and an average hides little. [1]"""
STILL_MEAN: Final = 0.9
STILL_SAMPLE: Final = 3.0
"""Mean of the last speeds, and largest one, that noise alone makes of a standing car. [standard deviations]

Noise that is cut at zero has a mean of 0.4 standard deviations."""
STILL_COUNT: Final = 4
"""Number of samples in that mean."""
LEAP: Final = 10.0 * KMH
LEAP_RATE: Final = 5.5 * KMH
"""Change of speed, at any time and per second, that drivers do not undo in the next step. [m/s], [m/s^2]

Chosen above the largest changes that 229 real drives and 46 test cycles undo in the next step: 8, 17, 26, 33 and
56 km/h for samples every 1, 2, 3, 5 and 10 s. In the step after it they undo up to 12, 22, 26, 37 and 63 km/h.
Steinstraeter et al., DOI 10.21227/6jr9-5235; Oh et al., arXiv:1905.02081; Yuan et al., DOI
10.1016/j.patter.2024.100950."""
LARGEST_LEAP: Final = 57.0 * KMH
"""The same at most. [m/s]"""
LONG_RISE: Final = 1.25
LONG_FALL: Final = 2.0
"""Rise and fall that are held back for two samples; a fall may be a stop, which must not come late. [leaps]"""
LIGHT: Final = 750.0
"""Mass of a light car, whose gain of kinetic energy the battery must at least deliver. [kg]"""
STANDING: Final = 0.5
"""Speed below which a car stands. [m/s]"""


@njit(cache=False)
def observe_noise(state: Any, speed: float, dt: float, restart: bool) -> None:
    """Update the noise of a car by an accepted speed; `state.speed` is the one before it."""
    steady = not restart and dt > 0.0 and abs(dt - state.noise_dt) <= 0.25 * dt
    steady = steady and speed > DRIVING and state.speed > DRIVING
    state.noise_dt = dt
    change = speed - state.speed if steady else nan
    curve = change - state.change
    last, before_last = state.curve, state.last_curve
    state.change, state.curve, state.last_curve = change, curve, last
    if isnan(curve):
        return
    state.noise_steps = min(2.0 * MEMORY, state.noise_steps + 1.0)
    n = min(MEMORY, state.noise_steps)
    size = abs(curve)
    if n == 1.0:
        state.calm_curve = size
    recent = 1.0 / n
    gain = max(QUANTILE_GAIN, 4.0 / (n + 4.0))
    state.calm_curve *= 1.0 + gain * (QUANTILE if size > state.calm_curve else QUANTILE - 1.0)
    state.calm_curve = max(1e-3, state.calm_curve)
    state.repeats += ((1.0 if change == 0.0 else 0.0) - state.repeats) * recent
    both = curve * curve + last * last
    if both > 0.0:  # false for NaN too
        state.alternation += (2.0 * curve * last / both - state.alternation) * recent
    both = curve * curve + before_last * before_last
    if both > 0.0:
        state.second_product += (2.0 * curve * before_last / both - state.second_product) * recent
    if int(state.place) % 8 == 0:
        state.noise = estimate_speed_noise(state, dt)


@njit(cache=False)
def estimate_speed_noise(state: Any, dt: float) -> float:
    """Return the noise that the second differences of the speed show. [m/s]"""
    clean = min(0.0, -0.06 - 0.18 * log10(dt))
    excess = clean - state.alternation
    sure = (excess - DOUBT / sqrt(state.noise_steps)) / RAMP
    least = LEAST_CONTRAST + 0.1 * log10(dt)
    contrast = state.second_product - state.alternation - least
    sure = min(sure, (contrast - CONTRAST_DOUBT / sqrt(state.noise_steps)) / RAMP)
    if sure <= 0.0 or state.repeats > MOST_REPEATS or dt > LONGEST_STEP:
        return 0.0
    share = min(1.0, sure) * min(1.0, excess / max(0.2, clean - WHITE), contrast / (WHITE_CONTRAST - least))
    noise = share * (1.0 + WIDER * share**6) * state.calm_curve / CALM_PER_NOISE
    return noise if noise >= LEAST_NOISE else 0.0


@njit(cache=False)
def is_still(state: Any, speed: float) -> bool:
    """Return whether noise alone explains a speed and the last ones, so that the car stands."""
    noise = sqrt(state.noise * state.calm_curve / CALM_PER_NOISE)
    if not speed < STILL_SAMPLE * noise:
        return False
    ring, place, total = state.ring, int(state.place), speed
    for i in range(1, STILL_COUNT):
        total += ring[(place - i) % ring.shape[0]]
    return bool(total < STILL_COUNT * STILL_MEAN * noise)


@njit(cache=False)
def average_adaptively(ring: Any, place: int, longest: int, noise: float) -> tuple[float, int]:
    """Return the mean of the last samples of a ring that agree within their noise, and their number. [m/s], [1]"""
    size = ring.shape[0]
    mean = total = ring[place % size]
    count = 1
    low, high = mean - WIDTH * noise, mean + WIDTH * noise
    for i in range(1, longest):
        before = ring[(place - i) % size]
        if isnan(before):
            break
        total += before
        wider = total / (i + 1)
        half = WIDTH * noise / sqrt(i + 1.0)
        low, high = max(low, wider - half), min(high, wider + half)
        if low > high:
            break
        mean, count = wider, i + 1
    return mean, count


@njit(cache=False)
def find_leap_limit(dt: float) -> float:
    """Return the change of speed in a step that drivers do not undo in the next one. [m/s]"""
    return min(LARGEST_LEAP, LEAP + LEAP_RATE * dt)


@njit(cache=False)
def is_powered(state: Any, row: Any, speed: float, dt: float) -> bool:
    """Return whether the battery delivers what a light car takes to reach a speed, at both ends of the step."""
    needed = 0.5 * LIGHT * (speed * speed - state.speed * state.speed)
    power = min(state.power, row.raw_voltage * row.raw_current)
    return bool(state.sign >= 0.0 and power * dt > needed)


@njit(cache=False)
def hold_leap(state: Any, speed: float, dt: float, limit: float, longest: float) -> tuple[float, float, int]:
    """Hold a leap of the speed back until the next samples show whether it returns."""
    before, leap = state.speed, state.leap
    change = speed - before
    state.leap_after = nan
    if isnan(leap) and not abs(change) > limit:  # nearly always
        return speed, 0.0, 0
    state.leap = nan
    waited, missed = state.leap_time, state.leap_distance
    if isnan(change) or dt > longest:
        stopped = isnan(speed) and leap < STANDING  # the car has stopped and fallen silent
        return (leap if stopped else speed), 0.0, 0
    if isnan(leap):
        if abs(change - state.acceleration * dt) < 1.5 * abs(state.acceleration) * dt:  # it continues
            return speed, 0.0, 0
        state.leap_limit, leap, missed, waited = limit, before, 0.0, 0.0
    else:
        limit = state.leap_limit
        if (speed - leap) * (leap - before) < 0.0 and abs(speed - leap) > limit:
            return speed, max(0.0, -missed), SPEED_SPIKE
        long = (LONG_RISE if leap > before else LONG_FALL) * limit
        if waited > 1.5 * dt or abs(leap - before) <= long or abs(change) <= limit:
            if dt > 0.0 and waited > 0.0:
                state.leap_after = (speed - leap) / dt
                state.leap_bend = abs((leap - before) / waited - state.leap_after)
            return speed, max(0.0, missed) + 0.5 * (leap - before) * dt, 0
    more = (0.5 * (leap + speed) - before) * dt
    state.leap, state.leap_time, state.leap_distance = speed, waited + dt, missed + more
    return before, min(0.0, more), 0
