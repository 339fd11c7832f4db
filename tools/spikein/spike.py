"""Compute the current that a known effect adds to each sample of real cars."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import JOULES_PER_KWH
from socast.core.errors import SettingsError
from socast.core.vehicles import load_catalogue
from socast.tools.simulator.cars import Car, make_car
from socast.tools.simulator.hidden import PowerFunction
from socast.tools.simulator.hidden_shapes import get_power
from socast.tools.simulator.settings import STEP
from socast.tools.spikein.car_readings import CarReadings, FleetReadings
from socast.tools.spikein.records import SpikedDrive
from socast.tools.spikein.surroundings import Drive, find_drives

CURRENT, CHARGE = "battery_current_a", "soc_pct"
ROOF_AREA: Final = 0.12
"""Drag area of the load on the roof that `roof_load` stands for; the size of the effect scales it. [m^2]"""
LEAST_SHARE: Final = 1e-5
"""Smallest share of the energy that an effect of natural size must take to be scaled. [1]"""
RECHARGED_PCT: Final = 2.0
"""Rise of the state of charge between two samples after which a battery counts as charged anew. [%]"""


@dataclass(frozen=True)
class Spike:
    """Declare an effect that is put into a recording.

    Parameters
    ----------
    effect : str
        Name of an effect of `socast simulate --hidden`, with `~other` for its other form.
    size : float
        Energy of the effect, as the sum of absolute values, over the measured energy of the cars and times that it
        affects. [1]
    vehicles : tuple of str
        Cars that have it; empty for all.
    since_s : float, optional
        Time from which they have it; None for always. [Unix s]
    seed : int
        Seed of what the cars do not tell: their tyre pressure, rubbing brakes and wear.
    """

    effect: str
    size: float
    vehicles: tuple[str, ...] = ()
    since_s: float | None = None
    seed: int = 0


class CarSpike(NamedTuple):
    """Hold what a spike adds to the samples of a car.

    Parameters
    ----------
    field : str
        Field that is changed: `CURRENT`, or `CHARGE` of a car that sends no current.
    added : (n,) float
        Number that is added to it in each sample; 0 where nothing is. [A] or [%]
    drives : list of SpikedDrive
        Drives that have the effect.
    """

    readings: CarReadings
    field: str
    added: Floats
    drives: list[SpikedDrive]


@dataclass
class _Prepared:
    """Hold a car whose effect has its natural size."""

    readings: CarReadings
    drives: list[Drive]
    powers: list[Floats] = field(default_factory=list)
    measured: float = 0.0
    absolute: float = 0.0


def make_spikes(fleet: FleetReadings, spike: Spike) -> tuple[list[CarSpike], float]:
    """Return what a spike adds to each car, and the factor of its natural size.

    Raises
    ------
    SettingsError
        Where no car or no time is affected, or the effect hardly acts in this recording.
    """
    power = get_power(spike.effect)
    known = {each.vehicle_id for each in fleet.cars}
    if strangers := sorted(set(spike.vehicles) - known):
        raise SettingsError(f"no car {strangers[0]} is in the recording; choose from {', '.join(sorted(known))}")
    rng = np.random.default_rng(spike.seed)
    cars = [(each, _make_car(each.model, rng)) for each in fleet.cars]
    affected = [
        _prepare(readings, find_drives(readings, fleet.weather, car), power, spike.since_s or -np.inf)
        for readings, car in cars
        if not spike.vehicles or readings.vehicle_id in spike.vehicles
    ]
    measured, absolute = (sum(getattr(each, name) for each in affected) for name in ("measured", "absolute"))
    if measured <= 0.0:
        raise SettingsError("no energy is measured in the chosen cars and times; choose others")
    if absolute < LEAST_SHARE * measured:
        raise SettingsError(
            f"{spike.effect} takes {absolute / measured:.1e} of the energy of these drives at its natural size, too "
            f"little to make it {spike.size:.1%}; choose another effect, or other cars or dates"
        )
    factor = spike.size * measured / absolute
    return [_finish(each, factor) for each in affected], factor


def _make_car(model: str, rng: np.random.Generator) -> Car:
    """Return true parameters of a car of a model, with a load on its roof; those of another where it is unknown."""
    known = load_catalogue()
    return make_car(model if model in known else next(iter(known)), rng)._replace(roof_drag_area=ROOF_AREA)


def _prepare(readings: CarReadings, drives: Sequence[Drive], power: PowerFunction, since_s: float) -> _Prepared:
    """Compute the power of an effect at natural size, and the energies of the affected drives."""
    out = _Prepared(readings, [])
    values = readings.values
    measured_w = values["battery_voltage_v"] * values[CURRENT]
    for drive in drives:
        time = values["time_s"][drive.first : drive.last]
        if time[0] < since_s:
            continue
        at = np.asarray(power(drive.inputs), float)
        watts = measured_w[drive.first : drive.last]
        is_known = np.isfinite(watts)
        if is_known.sum() > 1:
            energy = float(np.trapezoid(watts[is_known], time[is_known]))
        else:
            energy = _energy_by_charge(readings, drive)
        out.drives.append(drive)
        out.powers.append(at)
        out.measured += abs(energy)
        out.absolute += float(np.abs(at).sum() * STEP)
    return out


def _energy_by_charge(readings: CarReadings, drive: Drive) -> float:
    """Return the energy of a drive by its state of charge. [J]"""
    soc = readings.values[CHARGE][drive.first : drive.last]
    known = soc[np.isfinite(soc)]
    if len(known) < 2:
        return 0.0
    return float(max(known[0] - known[-1], 0.0)) / 100.0 * drive.inputs.car.capacity


def _finish(car: _Prepared, factor: float) -> CarSpike:
    """Return what an effect of a size adds to each sample of a car."""
    readings = car.readings
    time, voltage = readings.values["time_s"], readings.values["battery_voltage_v"]
    has_current = np.isfinite(readings.values[CURRENT]).any() and np.isfinite(voltage).any()
    added, energies = np.zeros(len(time)), np.zeros(len(time))
    drives = []
    for drive, power in zip(car.drives, car.powers, strict=True):
        rows = slice(drive.first, drive.last)
        watts = factor * power
        spent = np.concatenate([[0.0], np.cumsum(watts) * STEP])
        grid = drive.inputs.trace.time[0] + STEP * np.arange(len(spent))
        half = 0.5 * float(np.median(np.diff(time[rows])))
        low, high = np.maximum(time[rows] - half, grid[0]), np.minimum(time[rows] + half, grid[-1])
        mean = (np.interp(high, grid, spent) - np.interp(low, grid, spent)) / np.maximum(high - low, STEP)
        is_known = np.isfinite(voltage[rows]) & (voltage[rows] > 0.0)
        if has_current and is_known.any():
            added[rows] = mean / np.interp(time[rows], time[rows][is_known], voltage[rows][is_known])
        energies[rows] = np.diff(np.interp(time[rows], grid, spent), prepend=0.0)
        drives.append(
            SpikedDrive(
                vehicle_id=readings.vehicle_id,
                begin_s=float(time[rows][0]),
                end_s=float(time[rows][-1]),
                energy_kwh=float(spent[-1] / JOULES_PER_KWH),
            )
        )
    name = CURRENT if has_current else CHARGE
    if not has_current and car.drives:
        added = _charge_used(readings, energies) / car.drives[0].inputs.car.capacity * -100.0
    return CarSpike(readings, name, np.where(np.isfinite(readings.values[name]), added, 0.0), drives)


def _charge_used(readings: CarReadings, energies: Floats) -> Floats:
    """Return the energy that an effect has taken since the car last charged. [J]"""
    soc = readings.values[CHARGE]
    held = np.maximum.accumulate(np.where(np.isfinite(soc), np.arange(len(soc)), 0))
    rises = np.diff(soc[held], prepend=soc[held[0]]) > RECHARGED_PCT
    charged = rises | (readings.values["charging"] > 0.5)
    total = np.cumsum(energies)
    last = np.maximum.accumulate(np.where(charged, np.arange(len(soc)), -1))
    return total - np.where(last < 0, 0.0, total[np.maximum(last, 0)])
