"""Generate ride tables for pooled recipes: vehicle models differ by planted factors, and errors grow with size."""

import numpy as np
import pandas as pd

from socast.core.fit.block_sums import build_design
from socast.core.fit.pooled import SHARED_TERMS, PooledRecipe
from socast.core.models.features import Columns
from tests.support.planted_rides import rides

TERMS = PooledRecipe("planted", "Planted").terms
CLIMATE = np.array([term.climate for term in SHARED_TERMS])
PHYSICS = np.array([term.physics for term in SHARED_TERMS])


def fleet(n: int, seed: int = 1, cars: int = 8, **kwargs) -> pd.DataFrame:
    """Return a ride table with every column that pooled recipes read, without energies."""
    table = rides(n, seed, cars=cars, **kwargs)
    rng = np.random.default_rng(seed + 1000)
    mass = table["mass_kg"].to_numpy()
    moved = mass * table["distance_km"].to_numpy() * rng.uniform(2e-5, 6e-5, n)
    up = np.maximum(table["effect_climbing"], 0.0) + moved
    return table.assign(
        stops=rng.poisson(1.0 + table["distance_km"]).astype(float),
        parked_s=np.where(rng.random(n) < 0.01, np.nan, rng.exponential(3000.0, n)),
        battery_temperature_c=np.nan,
        latitude_start_deg=45.5,
        longitude_start_deg=-73.6,
        effect_climbing_up=up,
        effect_climbing_down=table["effect_climbing"] - up,
        effect_inertia_positive=2.0 * moved,
        effect_inertia_negative=-2.0 * moved + table["effect_inertia"],
        effect_auxiliary=table["duration_s"] / 3.6e6,
    )


def planted(table: pd.DataFrame, coefficients: dict[str, np.ndarray]) -> np.ndarray:
    """Return the energy by the shared terms, with coefficients for each vehicle model. [kWh]"""
    columns = Columns(table, {"soaked": 0.3, "battery_frost_k": 0.0})
    made = build_design(TERMS, columns, len(table))
    return np.einsum("ij,ij->i", made, np.array([coefficients[kind] for kind in table["vehicle_model"]]))


def differing(models, seed: int = 3, drive: float = 0.1, climate: float = 0.2) -> dict[str, np.ndarray]:
    """Return coefficients of vehicle models that differ by one factor on the drive and one on the climate."""
    rng = np.random.default_rng(seed)
    common = PHYSICS + np.where([term.name == "constant power" for term in SHARED_TERMS], 300.0, 0.0)
    return {
        model: common * np.where(CLIMATE, 1.0 + rng.normal(0.0, climate), 1.0 + rng.normal(0.0, drive))
        for model in models
    }


def measured(table: pd.DataFrame, energy: np.ndarray, seed: int = 2, noise: float = 0.01) -> pd.DataFrame:
    """Return the table with measured energies, whose errors have a variance of `noise` times the size."""
    size = Columns(table)["size_kwh"]
    return table.assign(energy_kwh=energy + np.random.default_rng(seed).normal(0.0, np.sqrt(noise * size)))
