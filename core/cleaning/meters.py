"""What a car's own meters report: energy by voltage times current, and the state of charge, with their faults.

A meter is faulty where it contradicts the motion of the car or the other meter. A faulty sample receives a quality bit
and is counted. Energy of a frozen current is not metered. A state of charge that froze or jumped measures no energy,
see `socast.core.totals.measured_energy`.

Voltage times current is frozen where the current stays the same to the last digit while the speed of the car varies, or
exactly zero while the car drives. The state of charge is frozen where it stays the same while the car uses several
quanta by V·I. It jumps where it changes by more than the car can have used, or by much more than V·I measured.
"""

from math import exp, isnan, log, nan, tanh
from typing import Any, Final

from socast.core.cleaning.power_sign import observe_charge
from socast.core.cleaning.quality import Quality
from socast.core.columns import KMH, POWER_SPANS
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "power",  # [W]
    "has_power",
    "unmetered",  # time for which the power has been unknown [s]
    "current",  # last reported [A]
    "current_step",  # smallest change of it so far: the quantum [A], NaN if unknown
    "current_age",  # time since it last changed [s]
    "current_runs",  # number of samples with this value while the car drove
    "current_repeats",  # running share of samples that repeat the current while the car drives [1]
    "speed_varied",  # sum of the changes of speed since then [m/s]
    "zero_distance",  # distance since then, of a current of zero [m]
    "soc",  # last reported [1]
    "has_soc",
    "soc_age",  # time since it was last reported [s]
    "soc_step",  # smallest change seen: the quantum [1]
    "still_time",  # time since it last changed [s]
    "still_distance",  # distance since then [m]
    "still_energy",  # energy by voltage times current since then [J]
    "still_unmetered",  # time since then for which that energy is unknown [s]
    "still_known",  # 1 if these four count from a change, 0 if from the beginning of the ride or of charging
    "plugged",  # number of successive samples in which the standing car took power
    "slept",  # 1 at a pause, falling to 0 over `AWAKE` of driving, or at a stale change of the state of charge
)
UNKNOWN_AT_FIRST: Final = ("power", "current", "current_step", "soc", "soc_step", "raw_power")
"""Fields of a new lane that are NaN."""

SOC_MISSING: Final = int(Quality.SOC_MISSING)
SOC_JUMP: Final = int(Quality.SOC_JUMP)
SOC_FROZEN: Final = int(Quality.SOC_FROZEN)
SOC_STALE: Final = int(Quality.SOC_STALE)
CHARGING_INFERRED: Final = int(Quality.CHARGING_INFERRED)
POWER_MISSING: Final = int(Quality.POWER_MISSING)
POWER_FROZEN: Final = int(Quality.POWER_FROZEN)
CURRENT_INVERTED: Final = int(Quality.CURRENT_INVERTED)
LONGEST_TRAPEZOID: Final = 10.5
"""Longest step over which power is interpolated, unless that of a slow logger is longer. [periods]"""
CORRELATION_TIME: Final = 3.3118
"""Time in which the power of a driving car forgets what it was. [s]

Chosen so that the variance of the energy of steps of 3 s is what it was on simulated rides: (dP dt)^2 / 8."""

POWER_SPREAD: Final = 14e3
"""Standard deviation of the power of a car while it drives. [W]

Median of 31 drives of a BMW i3; they have 6 to 28 kW (DOI 10.21227/6jr9-5235)."""
UNSEEN_TIME: Final = 8.0
"""Time in which the power forgets what it was, where it is unknown for a minute or more. [s]

From the spread of the mean power of 1 to 4 min of the same drives: 6.8, 5.3 and 3.7 kW for 60, 120 and 240 s."""

LATEST_CHANGE: Final = 6.0
"""Time before a sample of a logger without a period in which its power may have changed. [s]

Chosen so that the errors of simulated rides are within their standard uncertainties."""

BEFORE: Final = float(POWER_SPANS.index("before"))
AFTER: Final = float(POWER_SPANS.index("after"))
MEAN_NOISE: Final = 0.01
"""Variance of the energy of a step with mean power, over that with the powers of moments. [1]

Estimated: the means hold the whole energy, so that noise of the meter and of the stamps remains."""
AWAKE: Final = 2000.0
"""Distance after a pause from which the state of charge is no longer that from before it. [m]"""
FROZEN_TIME: Final = 30.0
"""Time for which an unchanged current is normal: loggers refresh it every second to every few seconds. [s]"""
REPEAT_MEMORY: Final = 100.0
"""Number of samples in the running share of those that repeat the current."""
LEAST_REPEATS: Final = 0.3
"""Share of repetitions of a current that is assumed of any car: a coarse meter at a steady speed. [1]"""
LEAST_SPEED_CHANGE: Final = 54.0 * KMH
"""Sum of changes of speed without which a current may stay the same for any time. [m/s]"""
LEAST_CHANCE: Final = -16.0
"""Logarithm of the chance of a run of repetitions below which the current is frozen: one in ten million."""
FROZEN_SPEED_CHANGE: Final = 108.0 * KMH
"""Sum of changes of speed during which the current of a car cannot stay the same to the last digit. [m/s]

Estimated: one and a half stops from town speed. Each change by 36 km/h takes or returns 60 kJ of a car of 1.2 t, which
is five quanta of a coarse meter (1 A at 400 V) over `FROZEN_TIME`. Half of it is enough where the meter is finer."""
LEAST_STEP: Final = 1e-3
"""Change of a current that is no rounding of its unit. [A]"""
COARSE_STEP: Final = 0.5
"""Quantum from which a meter is coarse. [A]"""
ZERO_DISTANCE: Final = 300.0
"""Distance over which a driving car cannot draw exactly nothing. [m]

Estimated: control units alone draw 200 W, and regeneration balances them only for moments."""

COARSEST_SOC: Final = 0.01
"""Quantum of a state of charge that has not changed yet: the coarsest that the wire contract allows. [1]"""
FINEST_SOC: Final = 0.002
"""Least quantum of a state of charge by which it may be stale. [1]

The display of the public BMW i3 has a noise of as much, and steps of 0.001 (DOI 10.21227/6jr9-5235)."""
FROZEN_SOC: Final = 4.0 * COARSEST_SOC
"""Share of the battery that a metered car uses before an unchanged state of charge counts as frozen. [1]

Four quanta of 1 %, which also exceed the largest step of the public Leaf's display, 3.3 % (VED, arXiv:1905.02081)."""
JUMP_MARGIN: Final = 0.02
"""Change beyond the metered energy and the coarsest quantum that is normal: displays lag and correct themselves. [1]"""
JUMP_SHARE: Final = 0.5
"""The same as a share of the metered energy, since usable and nominal capacity differ. [1]"""
STANDING_RATE: Final = 0.5 / 3600.0
"""Highest rate at which a standing car uses its battery: 12 kW of 24 kWh. [1/s]"""
DRIVING_RATE: Final = 0.1 / 1000.0
"""Highest rate at which a driving car uses its battery: 2.4 kWh/km of 24 kWh, twice that of full acceleration. [1/m]"""
LONGEST_STILLNESS: Final = 600.0
"""After a longer step nothing is known about the energy between two reports. [s]"""
USUAL_RATE: Final = 0.025 / 1000.0
"""Rate at which a driving car uses its battery at most, on average over some minutes. [1/m]

Estimated: 0.6 kWh/km of 24 kWh, four times the consumption of a Leaf, or twice that of a Twizy with 6 kWh in winter."""
SOC_HELD: Final = 60.0
"""Age beyond which a state of charge does not count for a ride that begins, nor while the car charges. [s]"""
STALE_QUANTA: Final = 1.5
"""Number of quanta by which a change soon after a pause may exceed what the car has used since. [1]"""
CHARGING_POWER: Final = 500.0
"""Least power into the battery of a standing car by which it charges. [W]

Estimated: the weakest chargers deliver 1.2 kW, and a current meter with an offset of 1 A at 400 V shows 0.4 kW."""
UNPROVEN: Final = 60.0
"""The same time for a car whose current may have the wrong sign, or that has no fix. [s]

Its stops, and a speed that is stuck at zero, are not taken for charging."""
METER_LAG: Final = 4.0
"""Time after which a stopped car recovers no more braking energy, with the lag of its meter. [s]"""


@njit(cache=False)
def integrate_power(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Integrate the measured power over the step, and estimate the variance of the integral.

    The energy is the trapezoid of voltage times current. Let the power change by dP between two samples. The integral
    has the variance (dP dt)^2 / 12 if the power wanders like a Brownian bridge, and (dP dt)^2 / 2 if it is noise; see
    `find_variance_factor` for what lies between. A logger without a period has sent nothing because the power stayed
    what it was, so its power is held. A mean power counts for its own period, so that its energy is known. Where the
    power is unknown, the mean of the ride fills it, with the variance of what cars usually do in that time.
    """
    power = row.raw_voltage * row.raw_current
    state.unmetered += dt
    if isnan(power):
        row.quality += POWER_MISSING if state.has_power == 1.0 else 0
    elif state.sign < 0.0:
        row.quality += CURRENT_INVERTED
        power = nan
    else:
        state.has_power = 1.0
        row.quality += CHARGING_INFERRED if charges_unsaid(state, row, power) else 0
        is_known = dt <= max(LONGEST_TRAPEZOID * settings.period, 1.5 * state.period)
        if is_power_frozen(state, row, dt, is_known):
            row.quality += POWER_FROZEN
            power = nan
        elif is_known:
            before = power if isnan(state.power) else state.power
            row.energy = (0.5 * (power + before) if state.has_period == 1.0 else before) * dt
            unknown = dt if state.has_period == 1.0 else min(dt, LATEST_CHANGE)
            row.energy_variance = find_variance_factor(unknown) * ((power - before) * unknown) ** 2
            if row.raw_power_span > 0.0 and dt <= 1.5 * state.period:
                take_mean_power(row, power, before, dt)
            row.metered = dt
    if row.metered == 0.0 and dt > 0.0:
        row.energy_variance = find_unseen_variance(state.unmetered) - find_unseen_variance(state.unmetered - dt)
    state.unmetered = state.unmetered if isnan(power) else 0.0
    state.power = power


@njit(cache=False)
def take_mean_power(row: Any, power: float, before: float, dt: float) -> None:
    """Set the energy of a step whose samples hold mean powers, and its variance."""
    of_span = before if row.raw_power_span == AFTER else 0.5 * (power + before)
    row.energy = (power if row.raw_power_span == BEFORE else of_span) * dt
    row.energy_variance *= MEAN_NOISE


@njit(cache=False)
def charges_unsaid(state: Any, row: Any, power: float) -> bool:
    """Return whether a standing car takes power without saying that it charges."""
    least = METER_LAG if state.sign > 0.0 and not isnan(row.raw_latitude) else UNPROVEN
    stands = state.standing == 1.0 and state.stood >= least
    state.plugged = state.plugged + 1.0 if stands and power < -CHARGING_POWER else 0.0
    return bool(state.plugged > 1.0 and row.raw_charging != 1.0)


@njit(cache=False)
def find_variance_factor(dt: float) -> float:
    """Return the variance of the energy of a step over the square of its change of power times its duration. [1]

    Let the power be an Ornstein-Uhlenbeck process with the correlation time T, and a = dt/T. The trapezoids over many
    steps then have the error variance s^2 dt^2 (coth(a/2) - 2/a) per step, with s^2 the variance of the power, and
    the mean square of dP is 2 s^2 (1 - exp(-a)). For steps below 3 s, the factor of 3 s covers the noise of meters.
    """
    if dt <= 3.0:
        return 0.125
    a = dt / CORRELATION_TIME
    return (1.0 / tanh(0.5 * a) - 2.0 / a) / (2.0 * (1.0 - exp(-a)))


@njit(cache=False)
def find_unseen_variance(time: float) -> float:
    """Return the variance of the energy of a time whose power is unknown, an Ornstein-Uhlenbeck process. [J^2]"""
    forgotten = UNSEEN_TIME * (1.0 - exp(-time / UNSEEN_TIME))
    return 2.0 * POWER_SPREAD * POWER_SPREAD * UNSEEN_TIME * (time - forgotten)


@njit(cache=False)
def is_power_frozen(state: Any, row: Any, dt: float, is_known: bool) -> bool:
    """Return whether the current has stayed the same although the speed varied, or zero although the car drove.

    Over a silence, where the current is not known, it may have changed and returned.
    """
    drives = row.distance > 0.0
    if row.raw_current != state.current:
        step = abs(row.raw_current - state.current)
        if step > LEAST_STEP and not step >= state.current_step:
            state.current_step = step
        state.current = row.raw_current
        state.current_age = state.speed_varied = state.zero_distance = state.current_runs = 0.0
        state.current_repeats -= state.current_repeats / REPEAT_MEMORY if drives else 0.0
        return False
    if not is_known:
        return False
    state.current_runs += 1.0 if drives else 0.0
    usual = LEAST_REPEATS + (1.0 - LEAST_REPEATS) * state.current_repeats
    if state.speed_varied > LEAST_SPEED_CHANGE and state.current_runs * log(usual) < LEAST_CHANCE:
        return True
    state.current_repeats += (1.0 - state.current_repeats) / REPEAT_MEMORY if drives else 0.0
    state.current_age += dt
    state.speed_varied += abs(row.acceleration) * dt
    state.zero_distance += row.distance if row.raw_current == 0.0 else 0.0
    is_coarse = not state.current_step < COARSE_STEP
    least = FROZEN_SPEED_CHANGE if is_coarse else 0.5 * FROZEN_SPEED_CHANGE
    varied = state.current_age > FROZEN_TIME and state.speed_varied > least
    return varied or state.zero_distance > ZERO_DISTANCE


@njit(cache=False)
def update_soc(state: Any, row: Any, dt: float) -> bool:
    """Update the lane by the reported state of charge; return whether it changed.

    `row.raw_capacity` is the capacity to which it refers, NaN where unknown. [J]
    """
    state.soc_age += dt
    state.still_time += dt
    state.still_distance += row.distance
    state.slept = max(0.0, state.slept - row.distance / AWAKE)
    state.still_energy += row.energy
    state.still_unmetered += dt - row.metered
    if row.raw_charging == 1.0 or dt > LONGEST_STILLNESS:
        begin_stillness(state, 0.0)
    if isnan(row.raw_soc):
        row.quality += SOC_MISSING if state.has_soc == 1.0 else 0
        if dt > LONGEST_STILLNESS or (row.raw_charging == 1.0 and state.soc_age > SOC_HELD):
            state.soc = nan  # the car may have charged since
        return False
    state.has_soc = 1.0
    if state.soc_age > LONGEST_STILLNESS:  # whatever changed meanwhile, the car was asleep
        state.slept = 1.0
        before, state.soc = state.soc, row.raw_soc
        state.soc_age = 0.0
        begin_stillness(state, 0.0)
        return bool(abs(state.soc - before) > 1e-6)
    state.soc_age = 0.0
    before, state.soc = state.soc, row.raw_soc
    change = row.raw_soc - before
    changed = abs(change) > 1e-6
    if abs(state.still_energy) > FROZEN_SOC * row.raw_capacity:
        row.quality += SOC_FROZEN
    if changed:
        stale = is_soc_stale(state, change)
        row.stale_fall = -change if stale else 0.0
        jumped = not stale and is_soc_jump(state, change, row.raw_capacity)
        row.quality += SOC_STALE if stale else SOC_JUMP if jumped else 0
        observe_charge(state, -change, row.raw_capacity, state.slept == 0.0)
        state.slept = 0.0 if stale else state.slept
        if not abs(change) >= state.soc_step:
            state.soc_step = abs(change)
    if changed or isnan(before):
        begin_stillness(state, 1.0 if changed else 0.0)
    return changed


@njit(cache=False)
def begin_stillness(state: Any, known: float) -> None:
    """Count time, distance and energy anew, from a change of the state of charge or, if not `known`, from elsewhere."""
    state.still_known = known
    state.still_time = state.still_distance = state.still_energy = state.still_unmetered = 0.0


@njit(cache=False)
def is_soc_stale(state: Any, change: float) -> bool:
    """Return whether a change soon after a pause is larger than what the car has used since the one before."""
    if state.slept == 0.0 or isnan(change):
        return False
    quantum = COARSEST_SOC if isnan(state.soc_step) else max(FINEST_SOC, min(state.soc_step, COARSEST_SOC))
    used = STANDING_RATE * min(state.still_time, LONGEST_STILLNESS) + USUAL_RATE * state.still_distance
    return bool(abs(change) > STALE_QUANTA * quantum + used)


@njit(cache=False)
def is_soc_jump(state: Any, change: float, capacity: float) -> bool:
    """Return whether the state of charge changed by more than the car can have used, or the meter contradicts it.

    The first change of a ride may include energy from before it, of less than a display that counts as frozen.
    """
    if state.still_time == 0.0:  # the car charged, or nothing is known of the time between
        return False
    used = state.still_energy / capacity
    normal = COARSEST_SOC if state.still_known == 1.0 else COARSEST_SOC + FROZEN_SOC
    possible = STANDING_RATE * state.still_time + DRIVING_RATE * state.still_distance
    contradicted = state.still_unmetered <= 0.1 * state.still_time
    contradicted &= abs(change + used) > normal + JUMP_MARGIN + JUMP_SHARE * abs(used)
    return contradicted or abs(change) > normal + possible
