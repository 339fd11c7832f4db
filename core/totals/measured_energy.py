"""The measured energy of rides and windows: by voltage and current where known, by the state of charge elsewhere.

The choice between the two never depends on their values. Voltage and current (V·I) measure wherever they are known and
healthy for at least half of the duration; a frozen current does not count as known, see `socast.core.cleaning.meters`.
The state of charge measures only where V·I does not, and only where it is healthy: it has neither jumped nor frozen.
Its energy is that of the display of this car, see `socast.core.totals.display_yield`.

A logger that samples V·I every 10 s or more misses most of what the power does between two samples. There the healthy
state of charge also measures where its quantum and noise are less than the error that V·I is expected to have by the
time between samples and the duration.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, replace_nan
from socast.core.cleaning.meters import COARSEST_SOC, CORRELATION_TIME, FROZEN_SOC, POWER_SPREAD
from socast.core.columns import GRAVITY, JOULES_PER_KWH
from socast.core.totals.accumulator import Totals
from socast.core.vehicles.catalogue import BOUNDS
from socast.core.vehicles.fleet import Cars

METER_GAIN: Final = 0.01
"""Relative standard uncertainty of the reported voltage times current. [1]

Estimated: each of the two sensors is of class 0.5 %.
"""
RIDE_SD: Final = 0.02
"""Standard deviation of the yield of single rides, by temperature and power, relative to their mean. [1]

Estimated: the public BMW i3, its curve taken off, has 0.02 (DOI 10.21227/6jr9-5235)."""
METERED_SHARE: Final = 0.5
"""Least share of the duration for which V·I must be known. [1]"""
TRAINING_SHARE: Final = 0.8
"""The same for a ride that is fit for training. [1]"""
MOST_FROZEN: Final = 0.002
"""Largest share of samples with a frozen current in a ride that is fit for training. [1]

A frozen current is seen after half a minute, which was metered wrong, so few such samples already matter: with five of
625, the energy of a simulated ride was 20 % too high."""
HEAVY: Final = 3500.0
"""Mass of a car whose own is unknown: the heaviest of its licence class in Europe. [kg]"""
FASTEST: Final = 10.0
"""Speed with which a ride may begin, as loggers cut the first seconds off. [m/s]"""
LEAST_CONSUMPTION: Final = 0.0017
"""Least energy that a car takes per distance on level road, over its capacity. [1/km]

Estimated: 0.04 kWh/km of 24 kWh, half of the rolling resistance and drag of a compact car at 40 km/h."""
BATTERIES: Final = 1.5
"""Largest energy of a ride without charging, in capacities: the capacity in the catalogue and the model may err. [1]"""
LARGEST_BATTERY: Final = BOUNDS["nominal_capacity_kwh"][1]
"""Capacity of a car whose own is unknown. [kWh]"""

SLOW: Final = 7.5
"""Mean time between two samples above which a logger is slow. [s]"""
EXPECTED_STEPS: Final = 4.0
"""Number of steps that the expected variance of the energy by V·I of a slow logger counts for. [1]"""

NO_SOURCE: Final = 0
BY_POWER: Final = 1
BY_SOC: Final = 2
SOURCES: Final = (None, "vi", "soc")
"""Name of each source of the measured energy, by its code."""


class MeasuredEnergy(NamedTuple):
    """Measured energy of rides or windows.

    Parameters
    ----------
    energy, sd : (n,) float
        Energy and its standard uncertainty, NaN where nothing measures it. [kWh]
    source : (n,) int
        `BY_POWER`, `BY_SOC` or `NO_SOURCE`.
    """

    energy: Floats
    sd: Floats
    source: Ints


def measure_by_power(totals: Totals, cars: Cars) -> tuple[Floats, Floats]:
    """Return the energy measured by voltage and current, and its standard uncertainty.

    Returns
    -------
    energy, uncertainty : (n,) float
        Energy and its standard uncertainty, NaN where less than half of the duration is measured. [kWh]

    Notes
    -----
    The mean power of the measured time fills the time without a measurement (gaps, missing values, a frozen current).
    Three terms add up in quadrature: the gain of the meter, the power between samples and where it is unknown, and ends
    lost in gaps. A slow logger has few steps, so its variance is averaged with the expected one, unless its samples
    hold mean powers.
    """
    energy = totals.amount("energy") / JOULES_PER_KWH
    share = totals.share("metered")
    whole = np.divide(energy, share, out=np.full(len(energy), np.nan), where=share >= METERED_SHARE)
    sampled = np.sqrt(_estimate_variance(totals, cars)) / JOULES_PER_KWH
    return whole, np.sqrt((METER_GAIN * whole) ** 2 + sampled**2 + _cut(totals, whole) ** 2)


def _expect_variance(totals: Totals, cars: Cars) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the variance that the energy by V·I is expected to have [J^2], and where the logger misses that much.

    A logger misses it that is slow and samples the powers of moments.

    The expected variance follows from the time between samples and the duration alone, see
    `socast.core.cleaning.meters.find_variance_factor`.
    """
    duration, samples = totals.amount("duration"), totals.amount("samples")
    step = np.maximum(duration / np.maximum(samples, 1.0), SLOW)
    a = step / CORRELATION_TIME
    per_time = POWER_SPREAD**2 * step * (1.0 / np.tanh(0.5 * a) - 2.0 / a)
    of_moments = cars.power_span[totals.kinds] == 0.0
    return per_time * duration, (samples > 0.0) & (step > SLOW) & of_moments


def _estimate_variance(totals: Totals, cars: Cars) -> Floats:
    """Return the variance of the energy by V·I because the power between two samples is unknown. [J^2]"""
    observed = totals.amount("energy_variance")
    expected, slow = _expect_variance(totals, cars)
    steps = totals.amount("samples")
    mixed = (steps * observed + EXPECTED_STEPS * expected) / (steps + EXPECTED_STEPS)
    return np.where(slow, mixed, observed)


def find_lost_time(totals: Totals) -> Floats:
    """Return the time at the beginning and end of each ride that no sample covers, because it fell into a gap."""
    return totals.at_first("lost") + totals.at_last("lost")


def _cut(totals: Totals, energy: Floats) -> Floats:
    """Return the uncertainty due to ends lost in gaps, with a power there of anything up to the mean power. [kWh]"""
    duration = totals.amount("duration")
    share = np.divide(find_lost_time(totals), duration, out=np.zeros(len(energy)), where=duration > 0.0)
    return np.abs(energy) * share / np.sqrt(3.0)


def find_inverted(totals: Totals) -> NDArray[np.bool_]:
    """Return where the current had the wrong sign in at least one sample."""
    return np.asarray(totals.flagged("current_inverted") > 0.0)


def _is_impossible(totals: Totals, cars: Cars) -> NDArray[np.bool_]:
    """Return where more energy returned to the battery than the car can have had from its descent and its motion."""
    kinds = totals.kinds
    mass = replace_nan(cars.parameters_of(kinds).mass_kg, HEAVY)
    descent = np.maximum(totals.amount("lost") - totals.amount("gained"), 0.0)
    most = mass * (GRAVITY * descent + 0.5 * FASTEST**2) / JOULES_PER_KWH
    return np.asarray(totals.amount("energy") / JOULES_PER_KWH < -most)


def measure_by_soc(totals: Totals) -> tuple[Floats, Floats]:
    """Return the energy measured by the fall of the state of charge, and its standard uncertainty.

    Returns
    -------
    energy, uncertainty : (n,) float
        Energy and its standard uncertainty, NaN where the capacity or the state of charge is unknown. [kWh]

    Notes
    -----
    With the yield (k, b) of the display, see `socast.core.totals.display_yield`, the fall of the charge from s_1 to s_2
    is the energy E = (s_1 - s_2 + b D) / k. The true charge at each end is uniform within a quantum q, so the fall has
    a variance of q^2 / 6, and that of the learned noise of the display. The spread of the yields of single rides, the
    uncertainty of k and b, the gain of the meter from which they were learned, and ends lost in gaps add up in
    quadrature.
    """
    (energy, bend), display = _compute_soc_energy(totals), totals.display
    of_yield = energy**2 * display["inverse_variance"] - 2.0 * energy * bend * display["covariance"]
    of_yield += bend**2 * display["curve_variance"]
    shared = of_yield / display["inverse"] ** 2 + (METER_GAIN * energy) ** 2
    return energy, np.sqrt(compute_soc_energy_noise(totals) ** 2 + shared)


def _compute_soc_energy(totals: Totals) -> tuple[Floats, Floats]:
    """Return the energy by the state of charge [kWh], and the bend D of its fall [1]."""
    first, last = totals.at_first("soc"), totals.at_last("soc")
    bend = (first**2 - first) - (last**2 - last)
    return (first - last + totals.display["curve"] * bend) / totals.display["inverse"], bend


def compute_soc_energy_noise(totals: Totals) -> Floats:
    """Return the part of the uncertainty of the energy by SOC that is independent from ride to ride.

    Returns
    -------
    (n,) float
        Standard deviation by quantum, noise of the display, yield of the ride and lost ends, without the shared
        uncertainty of the car's yield. [kWh]
    """
    variance = find_quantum(totals) ** 2 / 6.0 + totals.display["reading_variance"]
    energy, _ = _compute_soc_energy(totals)
    spread = (RIDE_SD * energy) ** 2 + _cut(totals, energy) ** 2
    return np.asarray(np.sqrt(variance / totals.display["inverse"] ** 2 + spread))


def find_quantum(totals: Totals) -> Floats:
    """Return the quantum of the reported state of charge, (n,). [1]"""
    return replace_nan(totals.at_last("soc_step"), COARSEST_SOC)


def find_usable_capacity(totals: Totals) -> tuple[Floats, Floats]:
    """Return the energy for which 100 % of each car's display stands, and its standard uncertainty.

    Returns
    -------
    capacity, uncertainty : (n,) float
        Capacity as learned before each row, NaN where the vehicle model is unknown. [kWh]
    """
    inverse = totals.display["inverse"]
    return 1.0 / inverse, np.hypot(np.sqrt(totals.display["inverse_variance"]) / inverse, METER_GAIN) / inverse


def find_soc_faults(totals: Totals, cars: Cars) -> NDArray[np.bool_]:
    """Return where the state of charge is faulty: it jumped or froze, by V·I or by the distance driven.

    Returns
    -------
    (n,) bool
        True where the state of charge must not measure the energy.

    Notes
    -----
    Without V·I, an unchanged charge is frozen where the car must have used `FROZEN_SOC` of its battery: the least
    consumption over the distance, less the energy of its net descent.
    """
    return (totals.amount("soc_faults") > 0.0) | _unmoved(totals, cars)


def is_only_stale(totals: Totals) -> NDArray[np.bool_]:
    """Return where a stale state of charge, and no other fault of it, was reported, (n,)."""
    return (totals.flagged("soc_stale") > 0.0) & (totals.flagged("soc_jump") + totals.flagged("soc_frozen") == 0.0)


def _unmoved(totals: Totals, cars: Cars) -> NDArray[np.bool_]:
    """Return where the charge is the same at both ends of a distance that takes several quanta."""
    kinds = totals.kinds
    descent = np.maximum(totals.amount("lost") - totals.amount("gained"), 0.0)
    fallen = cars.parameters_of(kinds).mass_kg * GRAVITY * descent / JOULES_PER_KWH / cars.capacity[kinds]
    used = LEAST_CONSUMPTION * totals.amount("distance") * 1e-3 - replace_nan(fallen)
    return (totals.at_first("soc") == totals.at_last("soc")) & (used > FROZEN_SOC)


def measure_energy(totals: Totals, cars: Cars) -> MeasuredEnergy:
    """Return the measured energy, its standard uncertainty and its source.

    Returns
    -------
    MeasuredEnergy
        By V·I wherever it is known, except where a healthy state of charge is expected to measure a slow logger's
        energy better; else by a healthy state of charge.
    """
    power, power_sd = measure_by_power(totals, cars)
    soc, soc_sd = measure_by_soc(totals)
    is_healthy = ~np.isnan(soc) & ~find_soc_faults(totals, cars)
    by_soc = is_healthy & (np.isnan(power) | _is_finer(totals, cars))
    source = np.where(by_soc, BY_SOC, np.where(np.isnan(power), NO_SOURCE, BY_POWER))
    return MeasuredEnergy(np.where(by_soc, soc, power), np.where(by_soc, soc_sd, power_sd), source)


def _is_finer(totals: Totals, cars: Cars) -> NDArray[np.bool_]:
    """Return where the logger is slow, and its state of charge is expected to measure better than V·I."""
    expected, slow = _expect_variance(totals, cars)
    display = totals.display
    of_soc = (find_quantum(totals) ** 2 / 6.0 + display["reading_variance"]) / display["inverse"] ** 2
    has_period = cars.period[totals.kinds] != 0.0
    return slow & has_period & (of_soc < expected / JOULES_PER_KWH**2)


def compute_largest_energy(totals: Totals, cars: Cars) -> Floats:
    """Return the energy that rides cannot exceed, taken from the battery or returned to it.

    Returns
    -------
    (n,) float
        `BATTERIES` capacities, and as many again in each hour of a ride with charging. [kWh]
    """
    capacity = replace_nan(cars.capacity[totals.kinds], LARGEST_BATTERY)
    duration = totals.amount("duration")
    charged = totals.at_last("since_charge") < duration
    return BATTERIES * capacity * np.where(charged, 1.0 + duration / 3600.0, 1.0)


def list_energy_faults(totals: Totals, cars: Cars) -> tuple[tuple[str, NDArray[np.bool_]], ...]:
    """Return why the measured energy of rides makes them unfit for training; a later reason outranks earlier ones."""
    source = measure_energy(totals, cars).source
    unmeasured, by_power = source == NO_SOURCE, source == BY_POWER
    reported = unmeasured & ~np.isnan(totals.at_last("soc"))
    frozen = (totals.flagged("soc_frozen") > 0.0) | _unmoved(totals, cars)
    return (
        ("contradictory_energy", totals.display["contradicted"] > 0.0),
        ("power_missing", by_power & (totals.share("metered") < TRAINING_SHARE)),
        ("power_frozen", by_power & (totals.flagged("power_frozen") > MOST_FROZEN * totals.amount("samples"))),
        ("no_measured_energy", unmeasured),
        ("soc_jump", reported & (totals.flagged("soc_jump") > 0.0)),
        ("soc_frozen", reported & frozen),
        ("soc_stale", reported & (totals.flagged("soc_stale") > 0.0)),
        ("unknown_capacity", reported & np.isnan(cars.capacity[totals.kinds])),
        ("impossible_energy", by_power & _is_impossible(totals, cars)),
        ("current_inverted", find_inverted(totals)),
    )
