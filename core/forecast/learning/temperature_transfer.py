"""Transfer what was learned at some outside temperatures to others, by physics.

A forecast on the first cold day needs the consumption at a temperature that the fleet has not met. Two things are known
of it. The model of consumption states how its effects depend on the temperature, so sums over rides can be moved to
another one (`shift_amounts`). What the model leaves unexplained is a factor and a power. The power depends on the
temperature as heating and air conditioning do, and few data determine how strongly (`fit_corrections`). The result at
each knot of temperature has a variance, which grows with the distance from the temperatures that were met.
"""

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

import socast.core.effects
from socast.core.batch import Floats
from socast.core.columns import GRAVITY, SIGNALS, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.effects import Effect
from socast.core.forecast.learning.leg_energy import TEMPERATURES
from socast.core.totals.accumulator import AMOUNTS
from socast.core.totals.context import RunContext
from socast.core.vehicles import ACCESSORIES
from socast.core.vehicles.fleet import CarParameters

FACTOR_SD: Final = 0.3
"""Standard deviation of the factor of the model's energy, before any data. [1]"""
POWER_SD: Final = 0.3
"""Standard deviation of the constant power that the model lacks. [kW]"""
CLIMATE_SD: Final = 0.5
"""Standard deviation of heating, and of cooling, over that of the reference car. [1]"""
LOCAL_FACTOR_SD: Final = 0.05
"""Standard deviation of the factor at a temperature about that at all temperatures. [1]"""
LOCAL_POWER_SD: Final = 0.15
"""Standard deviation of the power at a temperature about the curve. [kW]"""
POWER_SD_PER_KELVIN: Final = 0.025
"""Further standard deviation of the power for each kelvin from the nearest temperature that was met. [kW/K]"""
MET_HOURS: Final = 2.0
"""Time at a knot from which its temperature counts as met. [h]"""
REFERENCE_AIR_TEMPERATURE: Final = ZERO_CELSIUS + 15.0
"""Temperature of the standard air density. [K]"""
LEAST_SHARE: Final = 0.1
"""An effect whose power is less than this share of that at the other temperature is moved by the difference. [1]"""
_DURATION: Final = AMOUNTS.index("duration")
_DISTANCE: Final = AMOUNTS.index("distance")
_AMBIENT: Final = AMOUNTS.index("ambient")
_OF_AMBIENT: Final = frozenset({"ambient", "air_density", "pack_temperature"})
"""Signals that depend on the outside temperature alone."""


class Corrections(NamedTuple):
    """Hold what corrects the model's energy at each knot of temperature, with its uncertainty.

    Parameters
    ----------
    factor : (temperatures,) float
        Factor of the predicted energy. [1]
    power : (temperatures,) float
        Power to be added. [kW]
    covariance : (temperatures, 2, 2) float
        Covariance of factor and power at each knot.
    """

    factor: Floats
    power: Floats
    covariance: Floats

    def compute_energy(self, predicted: Floats, hours: Floats) -> Floats:
        """Return the corrected energy at each knot. [kWh]

        Units: predicted [h], hours [h].
        """
        return np.asarray(self.factor * predicted + self.power * hours)

    def compute_relative_sd(self, predicted: Floats, hours: Floats) -> Floats:
        """Return the standard deviation of the corrected energy over that energy, at each knot. [1]"""
        terms = np.column_stack([predicted, hours])
        variance = np.einsum("ki,kij,kj->k", terms, self.covariance, terms)
        energy = np.maximum(self.compute_energy(predicted, hours), 1e-9)
        return np.asarray(np.minimum(np.sqrt(np.maximum(variance, 0.0)) / energy, 1.0))


def fit_corrections(sums: NDArray[np.void], model_power: Floats, scale: float) -> Corrections:
    """Return the corrections of a model at each knot of temperature.

    Units: model_power [kW].

    Notes
    -----
    Over all temperatures, the measured energy is regressed on the predicted energy, the time, and the time multiplied
    by the reference car's power of heating and of cooling. The prior of the latter two is what the model lacks of that
    power. At each knot, factor and power then are regressed anew with that result as prior. The variance of the prior
    is that of the result, and that of a deviation which is larger the farther away the next data are.
    """
    heating, cooling = (scale * power for power in _split_climate_power(TEMPERATURES))
    terms = np.stack([np.ones(len(TEMPERATURES)), heating, cooling], axis=1)  # of the power at each knot
    mean = np.array([1.0, 0.0, _find_missing_share(model_power, heating), _find_missing_share(model_power, cooling)])
    precision = np.diag(np.array([FACTOR_SD, POWER_SD, CLIMATE_SD, CLIMATE_SD]) ** -2.0)
    matrix, right = precision.copy(), precision @ mean
    for row, term in zip(sums, terms, strict=True):
        matrix[0, 0] += row["pp"]
        matrix[0, 1:] += row["ph"] * term
        matrix[1:, 0] += row["ph"] * term
        matrix[1:, 1:] += row["hh"] * np.outer(term, term)
        right[0] += row["pm"]
        right[1:] += row["hm"] * term
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    estimate = covariance @ right
    away = _find_distance(sums["hours"])
    fitted = [
        _fit_knot(row, _project(term), estimate, covariance, float(kelvin))
        for row, term, kelvin in zip(sums, terms, away, strict=True)
    ]
    values = np.array([each[0] for each in fitted])
    return Corrections(values[:, 0], values[:, 1], np.array([each[1] for each in fitted]))


def _project(term: Floats) -> Floats:
    """Return the matrix that makes factor and power at a knot of the estimate over all temperatures, (2, 4)."""
    out = np.zeros((2, 4))
    out[0, 0], out[1, 1:] = 1.0, term
    return out


def _fit_knot(
    row: np.void, projection: Floats, estimate: Floats, covariance: Floats, kelvin: float
) -> tuple[Floats, Floats]:
    """Return factor and power at a knot, (2,), and their covariance, (2, 2)."""
    local = np.diag([LOCAL_FACTOR_SD**2, LOCAL_POWER_SD**2 + (POWER_SD_PER_KELVIN * kelvin) ** 2])
    precision = np.linalg.inv(projection @ covariance @ projection.T + local)
    matrix = np.array([[row["pp"], row["ph"]], [row["ph"], row["hh"]]]) + precision
    right = np.array([row["pm"], row["hm"]]) + precision @ projection @ estimate
    return np.linalg.solve(matrix, right), np.linalg.inv(matrix)


def _split_climate_power(celsius: Floats) -> tuple[Floats, Floats]:
    """Return the power of heating and of cooling of the reference car. [kW]"""
    power = (ACCESSORIES.power(celsius + ZERO_CELSIUS) - ACCESSORIES.standby) / 1000.0
    cold = celsius + ZERO_CELSIUS < ACCESSORIES.cooling_on
    return np.where(cold, power, 0.0), np.where(cold, 0.0, power)


def _find_missing_share(model_power: Floats, climate: Floats) -> float:
    """Return the share of a climate power that the model lacks, from 0 to 1."""
    most, least = int(np.argmax(climate)), int(np.argmin(np.abs(TEMPERATURES - 15.0)))
    if not climate[most] > 0.0:
        return 0.0
    return float(np.clip(1.0 - (model_power[most] - model_power[least]) / climate[most], 0.0, 1.0))


def _find_distance(hours: Floats) -> Floats:
    """Return the distance of each knot from the nearest temperature that was met, (temperatures,). [K]"""
    met = TEMPERATURES[hours >= MET_HOURS]
    if not len(met):
        return np.zeros(len(TEMPERATURES))
    return np.asarray(np.abs(TEMPERATURES[:, np.newaxis] - met).min(axis=1))


def shift_amounts(amounts: Floats, celsius: Floats, context: RunContext, car: CarParameters) -> Floats:
    """Return sums over rides as they would be at other outside temperatures.

    Notes
    -----
    The energy of an effect is multiplied by the ratio of its powers at both temperatures, for a car that drives at the
    mean speed. Where the power is small at the temperature of the sums, the difference of both is added instead.
    """
    duration = amounts[:, _DURATION]
    there = np.divide(amounts[:, _AMBIENT], duration, out=celsius + ZERO_CELSIUS, where=duration > 0.0)
    speed = np.divide(amounts[:, _DISTANCE], duration, out=np.zeros(len(duration)), where=duration > 0.0)
    out = amounts.copy()
    out[:, _AMBIENT] = (celsius + ZERO_CELSIUS) * duration
    for place, effect in _list_effects(context):
        if not _OF_AMBIENT.intersection(effect.arguments):
            continue
        with np.errstate(all="ignore"):
            before, after = (
                np.broadcast_to(effect.power(_SteadyDrive(kelvin, speed, car)), speed.shape)
                for kelvin in (there, celsius + ZERO_CELSIUS)
            )
        energy = amounts[:, place]
        is_ratio = np.abs(before) > LEAST_SHARE * np.abs(after)
        ratio = np.divide(after, before, out=np.ones(len(before)), where=is_ratio)
        moved = np.where(is_ratio, energy * ratio, energy + (after - before) * duration)
        out[:, place] = np.where(np.isfinite(moved), moved, energy)
    return out


def make_standing_amounts(width: int, celsius: Floats, context: RunContext, car: CarParameters) -> Floats:
    """Return the sums over an hour in which a car stands, at each of some outside temperatures."""
    out = np.zeros((len(celsius), width))
    out[:, _DURATION] = 3600.0
    out[:, _AMBIENT] = (celsius + ZERO_CELSIUS) * 3600.0
    drive = _SteadyDrive(celsius + ZERO_CELSIUS, np.zeros(len(celsius)), car)
    for place, effect in _list_effects(context):
        with np.errstate(all="ignore"):
            power = np.broadcast_to(effect.power(drive), celsius.shape)
        out[:, place] = 3600.0 * np.nan_to_num(power, nan=0.0, posinf=0.0, neginf=0.0)
    return out


def _list_effects(context: RunContext) -> list[tuple[int, Effect]]:
    """Return the effects that the model reads, each with its place among the sums; those of other models may fail."""
    read = set(context.model.effects)
    return [(len(AMOUNTS) + i, socast.core.effects.get(name)) for i, name in enumerate(context.effects) if name in read]


class _SteadyDrive(Mapping[str, Floats]):
    """Provide the signals of a car that drives at steady speeds, long after it started, in still air.

    Parameters
    ----------
    ambient, speed : (n,) float
        Outside temperature [K] and speed [m/s].
    """

    def __init__(self, ambient: Floats, speed: Floats, car: CarParameters) -> None:
        mass = float(car.mass_kg[0])
        ones = np.ones(len(speed))
        density = STANDARD_AIR_DENSITY * REFERENCE_AIR_TEMPERATURE / ambient
        rolling = float(car.rolling_resistance[0]) * mass * GRAVITY
        force = np.where(speed > 0.0, rolling + 0.5 * density * float(car.drag_area_m2[0]) * speed**2, 0.0)
        self._zero = np.zeros(len(speed))
        self._known = {
            "dt": ones,
            "speed": speed,
            "distance": speed,
            "ambient": ambient,
            "pack_temperature": ambient,
            "battery_temperature": ambient,
            "air_density": density,
            "elapsed": 900.0 * ones,
            "parked": 1800.0 * ones,
            "stopped": np.where(speed > 0.0, 0.0, 1.0),
            "charge": 0.5 * ones,
            "soc": 0.5 * ones,
            "occupants": ones,
            "mass": mass * ones,
            "accessory_scale": float(car.accessory_scale[0]) * ones,
            "rolling_resistance": float(car.rolling_resistance[0]) * ones,
            "drag_area": float(car.drag_area_m2[0]) * ones,
            "tyre_load": mass * GRAVITY * ones,
            "traction": force,
            "wheel_power": force * speed,
            "sun_sine": ones,
        }

    def __getitem__(self, name: str) -> Floats:
        return self._known.get(name, self._zero)

    def __iter__(self) -> Iterator[str]:
        return (column.name for column in SIGNALS)

    def __len__(self) -> int:
        return len(SIGNALS)
