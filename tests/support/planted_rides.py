"""Generate ride tables with planted energies from a seed, for tests of fits."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from socast.core.columns import GRAVITY, KMH, ZERO_CELSIUS
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import FITTED_TERMS, HISTOGRAM_COLUMNS
from socast.core.models.features import Columns
from socast.core.vehicles import AccessoryCurve, load_catalogue

PLANTED = AccessoryCurve(
    heating_full=ZERO_CELSIUS - 15.0,
    heating_off=ZERO_CELSIUS + 10.0,
    cooling_on=ZERO_CELSIUS + 18.0,
    cooling_full=ZERO_CELSIUS + 26.0,
    heating=3500.0,
    standby=400.0,
    cooling=1500.0,
)
MODELS = ("kia-soul-ev-2015", "nissan-leaf-2013", "tesla-model-s", "tesla-model-x")


def rides(n: int, seed: int = 1, models: Sequence[str] = MODELS, cars: int = 8) -> pd.DataFrame:
    """Return a ride table without energies: a year of taxi rides from -28 to 29 °C.

    The kinetic energy of nearly all rides is zero, as for rides that begin and end at rest.
    """
    rng = np.random.default_rng(seed)
    day = np.sort(rng.integers(0, 365, n))
    distance = np.clip(rng.lognormal(1.3, 0.7, n), 0.5, 28.0)
    speed = np.clip(rng.normal(22.0 + distance, 5.0), 8.0, 80.0)
    gained, lost = rng.gamma(2.0, 5.0 * distance), rng.gamma(2.0, 5.0 * distance)
    kind = rng.choice(models, n)
    car = rng.integers(0, cars, n)
    parameters = pd.DataFrame(
        [vars(load_catalogue()[name]) | {"drag_area_m2": load_catalogue()[name].drag_area_m2} for name in kind]
    )
    mass = parameters["mass_kg"] + 75.0 * rng.integers(1, 4, n)
    wind, towards = rng.gamma(2.0, 7.0, n), rng.uniform(0.0, 360.0, n)
    headwind = wind * np.cos(np.radians(towards - rng.uniform(0.0, 360.0, n)))
    metres, v = 1000.0 * distance, speed * 1.3 * KMH
    shares = rng.dirichlet(np.ones(len(HISTOGRAM_COLUMNS)) * 0.3, n)
    shares = shares / shares.sum(axis=1, keepdims=True)
    winter = ((day < 74) | (day > 348)).astype(np.int64)
    dates = (np.datetime64("2018-01-01") + day).astype(str)
    table = {
        "ride_id": [f"r{i}" for i in range(n)],
        "vehicle_id": [f"{name}-{i}" for name, i in zip(kind, car, strict=True)],
        "vehicle_model": kind,
        "date": dates,
        "winter": winter,
        "summer": 1 - winter,
        "fit_for_training": np.ones(n, np.bool_),
        "unfit_reason": np.full(n, None, dtype=object),
        "start_s": 1_514_764_800.0 + 86_400.0 * day,
        "duration_s": 3.6 * metres / speed,
        "distance_km": distance,
        "average_speed_kmh": speed,
        "gained_m": gained,
        "lost_m": lost,
        "ambient_c": 1.0 - 25.0 * np.cos(2 * np.pi * day / 365) + rng.normal(0.0, 3.0, n).clip(-4.0, 3.0),
        "wind_speed_kmh": wind,
        "wind_from_deg": np.where(wind < 2.0, np.nan, towards),
        "precipitation_mm_h": rng.exponential(0.2, n) * (rng.random(n) < 0.2),
        "soc_start_pct": rng.uniform(20.0, 100.0, n),
        "time_since_charge_s": np.where(rng.random(n) < 0.05, np.nan, rng.exponential(20_000.0, n)),
        "odometer_km": 20_000.0 * (1 + car) + 50.0 * day,
        "occupants": rng.integers(1, 4, n).astype(float),
        **dict(zip(HISTOGRAM_COLUMNS, (shares * distance[:, np.newaxis]).T, strict=True)),
        "effect_rolling": mass * GRAVITY * metres / 3.6e6,
        "effect_climbing": mass * GRAVITY * (gained - lost) / 3.6e6,
        "effect_aero_drag": 0.5 * 1.225 * v**2 * metres / 3.6e6,
        "effect_aero_drag_wind": 0.5 * 1.3 * (v + headwind * KMH) ** 2 * metres / 3.6e6,
        "effect_inertia": np.where(rng.random(n) < 0.02, rng.normal(0.0, 0.002, n), rng.normal(0.0, 1e-17, n)),
        **{name: parameters[name] for name in ("rolling_resistance", "drag_area_m2", "nominal_capacity_kwh")},
        "accessory_scale": parameters["accessory_scale"],
        "mass_kg": parameters["mass_kg"],
    }
    made = pd.DataFrame(table)
    time = made["duration_s"] * made["accessory_scale"] / 3.6e6
    return made.assign(effect_accessories=time * PLANTED.power(made["ambient_c"].to_numpy() + ZERO_CELSIUS))


def physical_energy(
    table: pd.DataFrame, coefficients: Mapping[str, float] | None = None, curve: AccessoryCurve = PLANTED
) -> np.ndarray:
    """Return the energy by equation (2), with coefficients of 1 except for the given ones. [kWh]"""
    given = {term.name: 1.0 for term in FITTED_TERMS} | dict(coefficients or {})
    made = build_design(FITTED_TERMS, Columns(table, {}, curve), len(table))
    return made @ [given[term.name] for term in FITTED_TERMS]


def noisy(table: pd.DataFrame, energy: np.ndarray, seed: int = 2, of_day: float = 0.01) -> pd.DataFrame:
    """Return the table with measured energies: with noise of each ride, and noise that a car shares within a day."""
    rng = np.random.default_rng(seed)
    days = pd.factorize(table["vehicle_id"] + table["date"])[0]
    shared = rng.normal(0.0, of_day, days.max() + 1)[days]
    distance = table["distance_km"].to_numpy()
    sd = 0.02 + 0.02 * np.sqrt(distance)
    return table.assign(energy_kwh=energy + rng.normal(0.0, sd) + shared * distance, energy_sd_kwh=sd)


def planted(n: int = 400, seed: int = 3, of_day: float = 0.01, **coefficients: float) -> pd.DataFrame:
    """Return rides with the energy of extended physics, planted coefficients, and noise of the ride and of its day."""
    table = rides(n, seed)
    table = table.assign(start_s=table["start_s"] + np.arange(n), ride_key=[f"car#{i}" for i in range(n)])
    still = table.assign(effect_aero_drag_wind=table["effect_aero_drag"])  # extended physics knows no wind
    energy = physical_energy(still, coefficients)
    return noisy(table, energy, seed, of_day)
