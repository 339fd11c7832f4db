"""Generate ride and window tables from a seed, with effects planted in the energy of windows."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from socast.core.columns import GRAVITY
from socast.core.effects import ROAD_LOAD
from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import LinearRecipe, make_term
from socast.core.fit.ride_blocks import RideFrame
from socast.core.models import LinearModel, make_physical_term
from socast.core.models.features import FEATURES, Columns
from socast.core.totals.measured_energy import METER_GAIN

KINDS = ("kia-soul-ev-2015", "nissan-leaf-2016")
BASE = {"rolling": 1.1, "climbing": 0.95, "aero_drag": 1.05, "inertia_positive": 1.1, "inertia_negative": 0.8}
AUXILIARY = 600.0
"""Constant power of every car. [W]"""
TERMS = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("climbing", ("effect_climbing",)),
    make_physical_term("aero_drag", ("effect_aero_drag", "drag_area_m2")),
    make_physical_term("inertia_positive", ("effect_inertia_positive",)),
    make_physical_term("inertia_negative", ("effect_inertia_negative",)),
    make_term("effect_auxiliary"),
)
START = 1_514_764_800.0
"""1 January 2018, midnight UTC."""
SD = 0.003
"""Standard deviation of the measured energy of a window. [kWh]"""


def planted(
    effects: Mapping[str | tuple[str, ...], float] | None = None,
    *,
    vehicles: int = 4,
    days: int = 20,
    rides: int = 2,
    windows: int = 8,
    seed: int = 1,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rides and windows with the energy of the base terms and of given effects, columns to coefficient."""
    rng = np.random.default_rng(seed)
    n = vehicles * days * rides * windows
    at = np.arange(n)
    ride = at // windows
    day = (ride // rides) % days
    vehicle = ride // (rides * days)
    ambient = -15.0 + 40.0 * ((day * 7) % days) / max(days - 1, 1)
    wet = (np.random.default_rng(seed + 1).random(days) < 0.4)[day]
    speed = np.clip(rng.normal(11.0, 4.0, n), 2.0, 30.0)
    metres = 60.0 * speed
    mass = np.where(vehicle % 2, 1700.0, 1500.0)
    load = mass * GRAVITY * metres / 3.6e6
    dates = (np.datetime64("2018-01-01") + 25 * day).astype(str)
    table = pd.DataFrame(
        {
            "ride_key": [f"taxi-{v}#{r}" for v, r in zip(vehicle, ride, strict=True)],
            "window": at % windows,
            "vehicle_id": [f"taxi-{v}" for v in vehicle],
            "vehicle_model": [KINDS[v % 2] for v in vehicle],
            "start_s": START + 25 * 86_400.0 * day + 36_000.0 + 60.0 * (at % (windows * rides)),
            "duration_s": 60.0,
            "distance_km": metres * 1e-3,
            "average_speed_kmh": speed * 3.6,
            "ambient_c": ambient,
            "occupants": 1.0,
            "stops": 0.0,
            "effect_rolling": load,
            "rolling_resistance": 0.01,
            "effect_climbing": mass * GRAVITY * rng.normal(0.0, 4.0, n) / 3.6e6,
            "effect_aero_drag": 0.5 * 1.225 * speed**2 * metres / 3.6e6,
            "drag_area_m2": 0.7,
            "effect_inertia_positive": mass * rng.gamma(2.0, 100.0, n) / 3.6e6,
            "effect_inertia_negative": -mass * rng.gamma(2.0, 100.0, n) / 3.6e6,
            "effect_auxiliary": 60.0 / 3.6e6,
            "effect_cold_rolling": load * np.maximum(20.0 - ambient, 0.0),
            "effect_cold_rolling@reference=283.15": load * np.maximum(10.0 - ambient, 0.0),
            "effect_wet_road": load * wet,
            "effect_brake_drag": metres / 3.6e6,
            "effect_headwind": rng.normal(0.0, 0.02, n),
            "effect_snow": 0.0,
            "accessory_scale": 1.0,
        }
    )
    energy = sum(_base(table).values()) + sum(
        (value * _product(table, columns) for columns, value in (effects or {}).items()), np.zeros(n)
    )
    energy = energy + rng.normal(0.0, SD, n)
    table = table.assign(**{name: 0.0 for name in FEATURES if name not in {*table, "winter", "summer"}}, samples=20.0)
    table = table.assign(**{each.energy_name: 0.0 for each in ROAD_LOAD if each.energy_name not in table})
    table = table.assign(mass_kg=mass, wind_from_deg=np.nan, soc_start_pct=80.0, soc_end_pct=79.0)
    table = table.assign(unresolved_braking_kwh=0.0)
    measured = {"energy_kwh": energy, "energy_vi_kwh": energy, "energy_soc_kwh": energy}
    sd = np.hypot(SD, METER_GAIN * energy)
    table = table.assign(
        **measured, energy_sd_kwh=sd, energy_vi_sd_kwh=sd, energy_soc_sd_kwh=1.0, energy_soc_noise_kwh=1.0
    )
    return _rides(table, dates), table


def _base(table: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the energy of each base term. [kWh]"""
    energies = {t.name: BASE[t.name] * _product(table, t.columns) for t in TERMS[:-1]}
    return energies | {"auxiliary": AUXILIARY * table["effect_auxiliary"].to_numpy()}


def _product(table: pd.DataFrame, columns: str | Sequence[str]) -> np.ndarray:
    names = (columns,) if isinstance(columns, str) else tuple(columns)
    return np.prod([Columns(table)[name] for name in names], axis=0)


def _rides(table: pd.DataFrame, dates: np.ndarray) -> pd.DataFrame:
    """Return the ride table of the windows."""
    amounts = {"duration_s", "distance_km", "stops", "gained_m", "lost_m", "unresolved_braking_kwh"}
    sums = [name for name in table if name.startswith(("effect_", "speed_")) or name in amounts]
    sums += ["energy_kwh", "energy_vi_kwh", "energy_soc_kwh"]
    firsts = [name for name in table if name not in {*sums, "ride_key", "window"}]
    groups = table.assign(date=dates).groupby("ride_key", sort=False)
    ride_table = pd.concat([groups[[*firsts, "date"]].first(), groups[sums].sum()], axis=1).reset_index()
    count = groups.size().to_numpy()
    whole = np.hypot(SD * np.sqrt(count), METER_GAIN * ride_table["energy_kwh"])
    sd = dict.fromkeys(("energy_sd_kwh", "energy_vi_sd_kwh"), whole)
    speed = ride_table["distance_km"] / ride_table["duration_s"] * 3600.0
    return ride_table.assign(
        ride_id=ride_table["ride_key"], winter=0, summer=1, fit_for_training=True, unfit_reason=None,
        average_speed_kmh=speed, **sd,
    )  # fmt: skip


def base_model(rides: pd.DataFrame) -> LinearModel:
    """Return the base terms, fitted to whole rides."""
    return fit_terms(LinearRecipe("base", "", TERMS), RideFrame(rides))
