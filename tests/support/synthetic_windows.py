"""Make synthetic drives with every effect of the library from a seed, for tests of the diagnosis.

A window consists of six stretches of ten seconds, each with separate signals, so that physics determines the energies
of the effects.
"""

from collections.abc import Mapping
from functools import cache

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.columns import GRAVITY, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.recipes import fit_to_windows
from socast.core.models import LinearModel
from socast.core.models.features import Columns
from socast.core.vehicles import VehicleModel, load_catalogue

START = 1_514_764_800.0
"""1 January 2018, midnight UTC."""
DAY_STEP = 17
"""Number of days from one day of driving to the next."""
STRETCHES = 6
STRETCH_S = 10.0
METER_SD = 0.002
"""Standard deviation of the metered energy of a window, without the error of the gain. [kWh]"""
BASE = {
    "rolling": 1.05,
    "climbing": 1.1,
    "aero_drag": 1.1,
    "inertia_positive": 1.15,
    "inertia_negative": 0.85,
    "braking": 0.2,
    "accessories": 0.9,
}
"""True coefficients of the road load."""
CARS_PARAMETERS = ("mass_kg", "rolling_resistance", "drag_area_m2", "nominal_capacity_kwh", "accessory_scale")


@cache
def make_windows(
    cars: int = 4, days: int = 20, rides: int = 3, windows: int = 8, seed: int = 1, kind: str = "kia-soul-ev-2015"
) -> pd.DataFrame:
    """Return windows of rides over a year, without energies. The result is cached and must not be changed."""
    n = cars * days * rides * windows
    at = np.arange(n)
    ride, car = at // windows, at // (windows * rides * days)
    day, hour = (ride // rides) % days, 8.0 + 3.0 * (ride % rides)
    start = START + 86_400.0 * DAY_STEP * day + 3600.0 * hour + 60.0 * (at % windows)
    vehicle = load_catalogue()[kind]
    signals = _signals(start, day, ride, car, vehicle, seed)
    speed, dt = signals["speed"], signals["dt"]
    energies = {
        f"effect_{name}": _summed(effects.get(name).power(signals) * dt) / 3.6e6 for name in effects.list_tabulated()
    }
    mean = {name: _summed(values) / STRETCHES for name, values in signals.items()}
    return pd.DataFrame(
        {
            "ride_key": [f"taxi-{c}#{r}" for c, r in zip(car, ride % (days * rides), strict=True)],
            "window": at % windows,
            "vehicle_id": [f"taxi-{c}" for c in car],
            "vehicle_model": kind,
            "date": pd.to_datetime(start, unit="s").strftime("%Y-%m-%d").to_numpy(dtype=object),
            "start_s": start,
            "duration_s": STRETCHES * STRETCH_S,
            "distance_km": _summed(speed * dt) * 1e-3,
            "average_speed_kmh": mean["speed"] * 3.6,
            "ambient_c": mean["ambient"] - ZERO_CELSIUS,
            "battery_temperature_c": mean["pack_temperature"] - ZERO_CELSIUS,
            "wind_speed_kmh": np.hypot(mean["headwind"], mean["crosswind"]) * 3.6,
            "precipitation_mm_h": mean["water"] * 1e4,
            "soc_start_pct": mean["charge"] * 100.0,
            "elapsed_s": mean["elapsed"],
            "parked_s": mean["parked"],
            "odometer_km": mean["odometer"] / 1000.0,
            "occupants": mean["occupants"],
            "stops": _summed(signals["stop_rate"] * dt),
            "unresolved_braking_kwh": 0.0,
            "latitude_start_deg": 45.5,
            "longitude_start_deg": -73.6,
            "drag_area_m2": vehicle.drag_area_m2,
            **{name: getattr(vehicle, name) for name in CARS_PARAMETERS if name != "drag_area_m2"},
            **energies,
        }
    )


def _summed(values: np.ndarray) -> np.ndarray:
    return values.reshape(-1, STRETCHES).sum(axis=1)


def _signals(start, day, ride, car, vehicle: VehicleModel, seed: int) -> dict[str, np.ndarray]:
    """Return the signals that effects read for each stretch; all cars share the weather of a day."""
    rng = np.random.default_rng(seed)
    days, n, m = int(day.max()) + 1, len(start), len(start) * STRETCHES

    def stretched(values):
        return np.repeat(values, STRETCHES)

    def of_days(values):
        return stretched(values[day])

    ambient = ZERO_CELSIUS + 5.0 - 17.0 * np.cos(2.0 * np.pi * DAY_STEP * np.arange(days) / 365.0)
    ambient = of_days(ambient + rng.normal(0.0, 3.0, days)) + stretched(rng.normal(0.0, 0.5, n))
    fallen = of_days((rng.random(days) < 0.4) * rng.exponential(3e-4, days))
    wind, towards = of_days(rng.gamma(2.0, 2.0, days)), stretched(rng.uniform(0.0, 2.0 * np.pi, n))
    occupants = stretched(rng.integers(1, 5, ride[-1] + 1).astype(float)[ride])
    speed = np.clip(stretched(rng.gamma(4.0, 3.0, n)) + rng.normal(0.0, 2.0, m), 1.0, 35.0)
    height = np.sin(np.pi * (stretched(start % 86_400.0 / 3600.0) - 6.0) / 13.0)
    mass, grade, acceleration = vehicle.mass_kg + 75.0 * occupants, rng.normal(0.0, 0.02, m), rng.normal(0.0, 0.35, m)
    load = mass * GRAVITY * np.sqrt(1.0 - grade**2)
    force = mass * (acceleration + GRAVITY * grade) + vehicle.rolling_resistance * load
    force += 0.5 * STANDARD_AIR_DENSITY * vehicle.drag_area_m2 * speed**2
    return {
        "dt": np.full(m, STRETCH_S),
        "speed": speed,
        "acceleration": acceleration,
        "grade": grade,
        "mass": mass,
        "tyre_load": load,
        "traction": force,
        "wheel_power": force * speed,
        "braking_force": np.maximum(-force, 0.0),
        "turn_rate": rng.normal(0.0, 0.03, m),
        "headwind": wind * np.cos(towards),
        "crosswind": wind * np.sin(towards),
        "ambient": ambient,
        "pack_temperature": ambient + 6.0,
        "air_density": 353.0 / ambient,
        "vapour_pressure": of_days(rng.uniform(0.4, 0.95, days)) * 611.2 * np.exp(0.065 * (ambient - ZERO_CELSIUS)),
        "water": np.where(ambient > ZERO_CELSIUS, fallen, 0.0),
        "snow": np.where(ambient > ZERO_CELSIUS, 0.0, 8.0 * fallen),
        "solar": of_days(rng.uniform(0.2, 1.0, days)) * 700.0 * np.maximum(height, 0.0),
        "sun_sine": 0.4 - 0.8 * stretched(rng.random(n) < 0.3).astype(float),
        "elapsed": stretched((start - start[np.searchsorted(ride, ride)]) + 30.0),
        "parked": stretched(rng.exponential(5000.0, ride[-1] + 1)[ride]),
        "stop_rate": (rng.random(m) < 0.1) / STRETCH_S,
        "charge": stretched(rng.uniform(0.3, 1.0, ride[-1] + 1)[ride]),
        "occupants": occupants,
        "odometer": stretched(3e7 + 1e7 * car + 1e5 * day),
        "rolling_resistance": np.full(m, vehicle.rolling_resistance),
        "accessory_scale": np.full(m, vehicle.accessory_scale),
    }


def compute_road_load_energy(table: pd.DataFrame) -> np.ndarray:
    """Return the energy of the road load with the coefficients `BASE`. [kWh]"""
    coefficients = {"rolling": table["rolling_resistance"], "aero_drag": table["drag_area_m2"]}
    parts = [value * table[f"effect_{name}"] * coefficients.get(name, 1.0) for name, value in BASE.items()]
    return np.sum(parts, axis=0)


def compute_coefficients(table: pd.DataFrame, shares: Mapping[str, float]) -> dict[str, float]:
    """Return the coefficients that give planted effects these shares of the energy within their scopes.

    Names of effects are those of terms without `effect_`, followed by scopes: `"brake_drag vehicle=taxi-1"`.
    """
    energy = compute_road_load_energy(table)
    return {
        name: share * float(energy[_indicator(table, name)].sum()) / float(_column(table, name).sum())
        for name, share in shares.items()
    }


def _indicator(table: pd.DataFrame, name: str) -> np.ndarray:
    scopes = [Columns(table)[scope] for scope in name.split()[1:]]
    return np.prod([np.ones(len(table)), *scopes], axis=0) > 0.0


def _column(table: pd.DataFrame, name: str) -> np.ndarray:
    return np.asarray(table[f"effect_{name.split(maxsplit=1)[0]}"] * _indicator(table, name))


def make_tables(
    table: pd.DataFrame,
    shares: Mapping[str, float] | None = None,
    *,
    unknown: np.ndarray | float = 0.0,
    seed: int = 1,
    noise: float = 0.004,
    of_ride: float = 0.0,
    of_day: float = 0.0,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return ride and window tables with energies: the road load, planted effects, and errors.

    `shares` are the shares of the energy of planted effects. `unknown` is energy of a cause outside the library [kWh].
    `noise` and `of_ride` are standard deviations of the errors of each window and of all windows of a ride [kWh].
    `of_day` is the standard deviation of the rolling resistance of a vehicle-day, as a share.
    """
    rng = np.random.default_rng(seed)
    ride, day = pd.factorize(table["ride_key"])[0], pd.factorize(table["vehicle_id"] + " " + table["date"])[0]
    energy = compute_road_load_energy(table) + unknown
    for name, coefficient in compute_coefficients(table, shares or {}).items():
        energy = energy + coefficient * _column(table, name)
    rolling = table["effect_rolling"] * table["rolling_resistance"]
    energy = energy + rng.normal(0.0, 1.0, day.max() + 1)[day] * of_day * rolling.to_numpy()
    energy = energy + rng.normal(0.0, noise, len(table)) + rng.normal(0.0, 1.0, ride.max() + 1)[ride] * of_ride
    return build_tables(table, energy)


def make_unknown(form: str, table: pd.DataFrame | None = None) -> np.ndarray:
    """Return the energy of a cause outside the library, 6 % of the total. [kWh]"""
    table = make_windows() if table is None else table
    rolling = (table["effect_rolling"] * table["rolling_resistance"]).to_numpy()
    hours = table["duration_s"].to_numpy() / 3600.0
    forms = {
        "crowded": rolling * (table["occupants"].to_numpy() > 3.0),
        "low battery": hours * np.maximum(60.0 - table["soc_start_pct"].to_numpy(), 0.0),
        "gusty": table["effect_braking"].to_numpy() * table["wind_speed_kmh"].to_numpy(),
    }
    return 0.06 * compute_road_load_energy(table).sum() / forms[form].sum() * forms[form]


def build_tables(table: pd.DataFrame, energy: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return ride and window tables with the given energy, measured by voltage and current. [kWh]"""
    gain = 0.01 * np.abs(energy)
    windows = table.drop(columns="date").assign(
        energy_kwh=energy, energy_vi_kwh=energy, energy_soc_kwh=energy + 0.01,
        energy_sd_kwh=np.hypot(METER_SD, gain), energy_vi_sd_kwh=np.hypot(METER_SD, gain), energy_soc_sd_kwh=0.1,
        energy_soc_noise_kwh=0.1,
    )  # fmt: skip
    return _rides(windows, table["date"]), windows


AMOUNTS = {"duration_s", "distance_km", "stops", "unresolved_braking_kwh"}
"""Columns of which a ride has the sum over its windows, besides energies."""


def _rides(windows: pd.DataFrame, date: pd.Series) -> pd.DataFrame:
    """Return the ride table: sums of amounts, first values of initial states, and means of the weather."""
    sums = [name for name in windows if name.startswith("effect_") or name in AMOUNTS]
    sums += [name for name in windows if name.startswith("energy_") and "_sd_" not in name]
    means = ["ambient_c", "battery_temperature_c", "wind_speed_kmh", "precipitation_mm_h"]
    spread = [name for name in windows if "_sd_" in name]
    firsts = [name for name in windows if name not in {*sums, *means, *spread, "window", "ride_key"}]
    groups = windows.assign(date=date).groupby("ride_key", sort=False)
    root = windows[spread].pow(2).groupby(windows["ride_key"], sort=False).sum().pow(0.5)
    made = pd.concat([groups[[*firsts, "date"]].first(), groups[means].mean(), groups[sums].sum(), root], axis=1)
    made = made.reset_index()
    return made.assign(
        ride_id=made["ride_key"], winter=(made["ambient_c"] < 0.0).astype(int),
        summer=(made["ambient_c"] >= 0.0).astype(int), fit_for_training=True, unfit_reason=None,
        average_speed_kmh=made["distance_km"] / made["duration_s"] * 3600.0,
    )  # fmt: skip


def gather_with_model(
    tables: tuple[pd.DataFrame, pd.DataFrame], recipe: str = "road_load"
) -> tuple[Windows, LinearModel]:
    """Return the windows to diagnose, and the diagnosed model: a recipe fitted to the same windows."""
    model = fit_to_windows(recipe, *tables, covariance=False)
    return gather_windows(*tables, model), model


def project_base(tables: tuple[pd.DataFrame, pd.DataFrame], recipe: str = "road_load") -> BaseProjection:
    """Return the projection for a recipe fitted to the same windows."""
    return BaseProjection(*gather_with_model(tables, recipe))
