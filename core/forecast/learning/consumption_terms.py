"""Describe stretches of driving and waiting by the amounts that their energy depends on, and what physics expects.

A stretch is a ride, an idle period or a leg of a plan. Its energy at an outside temperature is linear in its amounts:
kilometres, those with stops, those times the square of the speed, hours of driving and of waiting, metres climbed and
descended, the beginning of a ride, and the share of the warm-up after the car woke that falls into it. How much each
amount takes depends on the temperature through few coefficients: air and tyres in the cold, heating, and air
conditioning. The energy is linear in these coefficients, too, so that a regression of measured energies finds them
(`socast.core.forecast.learning.energy_regression`).

Before any data, the official consumption of the vehicle model without charging losses is split into air drag, which
follows from its drag area, stops, which follow from its mass, and the rest. Heating and air conditioning are those of
the reference car.
"""

from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, replace_nan
from socast.core.columns import GRAVITY, JOULES_PER_KWH, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.compiled_cache import njit
from socast.core.vehicles import ACCESSORIES, VehicleModel

FASTEST: Final = 0.4
"""Least pace of driving; a smaller one counts as this. [min/km]"""
SLOWEST: Final = 15.0
"""Largest pace of driving; time beyond it is waiting. [min/km]"""
FLOWING_SPEED: Final = 100.0
"""Mean speed from which on there are no stops; below, their number per kilometre grows by the difference. [km/h]"""
TEMPERATURES: Final = np.array([-25.0, -15.0, -7.0, 0.0, 7.0, 14.0, 21.0, 28.0, 35.0])
"""Knots of the outside temperature. [°C]"""
CITY_PACE: Final = 2.4
"""Time per kilometre that is assumed of the kilometres of idle periods, of which only the sum is known. [min/km]"""
REFERENCE_SPEED: Final = 50.0
"""Mean speed at which the term of the squared speed counts once. [km/h]"""
UNEVEN_SPEED: Final = 0.25
"""Variance of the speed over the square of its mean, on rides; faster ones vary as those at `REFERENCE_SPEED`. [1]"""
WARM_UP_DECAY: Final = 900.0
"""Time constant of the warm-up of cabin and battery after a car woke. [s]"""
LEAST_KM: Final = 1e-9
"""A shorter distance is none; the time per kilometre would overflow. [km]"""

KM, STOPS, FAST, DRIVING, WAITING, GAINED, LOST, START, WARM_UP = range(9)
"""Places of the amounts of a stretch: kilometres; those times the share of stops that their speed lets expect; those
times the mean square of the speed over that at `REFERENCE_SPEED` [km]; hours of driving and of waiting [h]; metres
climbed and descended [m]; beginnings of rides [1]; share of the warm-up of the shift [1]."""
STRETCH_AMOUNTS: Final = 9
"""Number of amounts of a stretch."""

DRIVING_SHARE: Final = 0.75
"""Share of the official consumption that driving takes: less charging losses and the accessories of the cycle. [1]

Estimated, as the other figures of this module: the standard deviations below cover what they miss."""
CONSUMPTION_PER_MASS: Final = 1.2e-4
"""Official consumption over kerb mass of the cars in the catalogue, for cars without a rating. [kWh/(km kg)]"""
LEAST_LEVEL: Final = 0.3
"""Least share of the official driving consumption that is neither air drag nor stops. [1]"""
EFFICIENCY: Final = 0.85
"""Efficiency from the battery to the wheels. [1]"""
STOP_ENERGY: Final = 4.2e-5
"""Energy of a kilometre with the most stops over the mass, with what braking returns. [kWh/(km kg)]"""
RECOVERED_CLIMB: Final = 0.6
"""Share of the energy of a climb that returns on the way down. [1]"""
COLD_BELOW: Final = 20.0
"""Temperature below which air is denser and tyres are stiffer. [°C]"""
COLD_PER_KELVIN: Final = 0.006
"""Growth of the energy per kilometre for each kelvin below that. [1/K]"""


class CoefficientPrior(NamedTuple):
    """Hold mean and standard deviation of each coefficient before any data, (terms,) float each."""

    mean: Floats
    sd: Floats


_COLD: Final = np.maximum(COLD_BELOW - TEMPERATURES, 0.0)
_CLIMATE: Final = (ACCESSORIES.power(TEMPERATURES + ZERO_CELSIUS) - ACCESSORIES.standby) / 1000.0  # [kW]
_HEATS: Final = ACCESSORIES.cooling_on > TEMPERATURES + ZERO_CELSIUS
_HEATING, _COOLING = np.where(_HEATS, _CLIMATE, 0.0), np.where(_HEATS, 0.0, _CLIMATE)
_CONTRIBUTIONS: Final[dict[str, tuple[list[int], Floats | float]]] = {
    "level": ([KM], 1.0),
    "stops": ([STOPS], 1.0),
    "cold": ([KM], _COLD),
    "fast": ([FAST], 1.0),
    "driving": ([DRIVING], 1.0),
    "waiting": ([WAITING], 1.0),
    "heating": ([DRIVING, WAITING], _HEATING),
    "cooling": ([DRIVING, WAITING], _COOLING),
    "heating_waiting": ([WAITING], _HEATING),
    "cooling_waiting": ([WAITING], _COOLING),
    "gained": ([GAINED], 1.0),
    "lost": ([LOST], 1.0),
    "start": ([START], 1.0),
    "start_heating": ([START], _HEATING),
    "warm_up": ([WARM_UP], 1.0),
    "warm_up_heating": ([WARM_UP], _HEATING),
}
"""Name of each term -> the amounts that contribute to it, and how much at each knot of temperature."""
TERMS: Final = tuple(_CONTRIBUTIONS)
"""Names of the terms."""
EXPANSION: Final = np.zeros((len(TEMPERATURES), STRETCH_AMOUNTS, len(TERMS)))
"""What an amount of a stretch contributes to each term, (temperatures, amounts, terms) float."""
for _term, (_places, _by_temperature) in enumerate(_CONTRIBUTIONS.values()):
    EXPANSION[:, _places, _term] = np.broadcast_to(_by_temperature, len(TEMPERATURES))[:, np.newaxis]


def compute_warm_up_left(awake_s: Floats) -> Floats:
    """Return the share of the warm-up that is left some time after a car woke; none where that is unknown. [1]"""
    return replace_nan(np.exp(-np.maximum(awake_s, 0.0) / WARM_UP_DECAY), 0.0)


def make_prior(model: VehicleModel, accessory_scale: float) -> CoefficientPrior:
    """Return what physics expects of the coefficients of a vehicle model."""
    rated = CONSUMPTION_PER_MASS * model.mass_kg if model.rated_kwh_per_km is None else model.rated_kwh_per_km
    pressure = 0.5 * STANDARD_AIR_DENSITY * (REFERENCE_SPEED / 3.6) ** 2
    drag = (1.0 + UNEVEN_SPEED) * pressure * model.drag_area_m2 / EFFICIENCY * 1000.0 / JOULES_PER_KWH
    stops = STOP_ENERGY * model.mass_kg
    of_cycle = (1.0 - REFERENCE_SPEED / FLOWING_SPEED) * stops
    level = max(DRIVING_SHARE * rated - drag - of_cycle, LEAST_LEVEL * DRIVING_SHARE * rated)
    climb = model.mass_kg * GRAVITY / EFFICIENCY / JOULES_PER_KWH
    standby, whole = accessory_scale * ACCESSORIES.standby / 1000.0, DRIVING_SHARE * rated
    values = {
        "level": (level, 0.25 * whole),
        "stops": (stops, 0.5 * stops),
        "cold": (COLD_PER_KELVIN * whole, 0.8 * COLD_PER_KELVIN * whole),
        "fast": (drag, 0.4 * drag),
        "driving": (standby, 0.4),
        "waiting": (standby, 0.2),
        "heating": (accessory_scale, 0.4 * accessory_scale),
        "cooling": (accessory_scale, 0.5 * accessory_scale),
        "heating_waiting": (0.0, 0.25 * accessory_scale),
        "cooling_waiting": (0.0, 0.5 * accessory_scale),
        "gained": (climb, 0.3 * climb),
        "lost": (-RECOVERED_CLIMB * climb, 0.3 * climb),
        "start": (0.0, 0.05),
        "start_heating": (0.0, 0.1 * accessory_scale),
        "warm_up": (0.0, 0.15),
        "warm_up_heating": (0.2 * accessory_scale, 0.3 * accessory_scale),
    }
    mean, sd = np.array([values[name] for name in TERMS]).T
    return CoefficientPrior(mean, sd)


@njit(cache=False)
def fill_ride_amounts(out: Any, km: float, hours: float, gained: float, lost: float) -> None:
    """Write the amounts of a ride or leg; unknown climbs count as none."""
    driving = min(hours, SLOWEST / 60.0 * km) if km > LEAST_KM else 0.0
    pace = 60.0 * driving / km if km > LEAST_KM else SLOWEST
    speed = 60.0 / max(pace, FASTEST)
    square = speed**2 + UNEVEN_SPEED * min(speed, REFERENCE_SPEED) ** 2
    out[:] = 0.0
    out[KM] = km
    out[STOPS] = km * max(1.0 - speed / FLOWING_SPEED, 0.0)
    out[FAST] = km * square / ((1.0 + UNEVEN_SPEED) * REFERENCE_SPEED**2)
    out[DRIVING], out[WAITING] = driving, hours - driving
    out[GAINED] = 0.0 if isnan(gained) else gained
    out[LOST] = 0.0 if isnan(lost) else lost
    out[START] = 1.0


@njit(cache=False)
def fill_idle_amounts(out: Any, km: float, hours: float) -> None:
    """Write the amounts of an idle period, all of which counts as waiting."""
    fill_ride_amounts(out, km, CITY_PACE / 60.0 * km, 0.0, 0.0)
    out[DRIVING], out[WAITING], out[START] = 0.0, hours, 0.0


@njit(cache=True)
def compute_stretch_amounts(riding: Any, km: Any, hours: Any, gained: Any, lost: Any, out: Any) -> None:
    """Write the amounts of rides and of idle periods, (n, amounts)."""
    for i in range(len(km)):
        if riding[i]:
            fill_ride_amounts(out[i], km[i], hours[i], gained[i], lost[i])
        else:
            fill_idle_amounts(out[i], km[i], hours[i])


@njit(cache=True)
def predict_energy(amounts: Any, kinds: Any, weights: Any, rates: Any, out: Any) -> None:
    """Write the energy of stretches. [kWh]

    Units: rates [kWh per amount] by kind of car and temperature, weights [1] by temperature.
    """
    for i in range(len(kinds)):
        energy = 0.0
        for knot in range(weights.shape[1]):
            if weights[i, knot] != 0.0:
                of_knot = 0.0
                for j in range(amounts.shape[1]):
                    of_knot += amounts[i, j] * rates[kinds[i], knot, j]
                energy += weights[i, knot] * of_knot
        out[i] = energy


def compute_knot_weights(values: Floats, knots: Floats) -> Floats:
    """Return the weights of linear interpolation between knots, (n, knots); beyond the last knot, that has all of it.

    Examples
    --------
    >>> compute_knot_weights(np.array([15.0, 99.0]), np.array([10.0, 20.0, 40.0])).tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]
    """
    values = np.clip(values, knots[0], knots[-1])
    low = np.clip(np.searchsorted(knots, values, side="right") - 1, 0, len(knots) - 2)
    share = (values - knots[low]) / (knots[low + 1] - knots[low])
    out = np.zeros((len(values), len(knots)))
    rows = np.arange(len(values))
    out[rows, low], out[rows, low + 1] = 1.0 - share, share
    return out
