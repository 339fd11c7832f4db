"""Provide windows whose energy is not linear in the features of the segment network."""

import numpy as np
import pandas as pd

from socast.core.fit.segment_network import SEGMENT_FEATURES


def segment_windows(rides=300, seed=1, models=("leaf", "soul")):
    """Return windows, rides, and the energy of each window, which is not linear in the features. [kWh]"""
    rng = np.random.default_rng(seed)
    count = rng.integers(2, 9, rides)
    ride = np.repeat(np.arange(rides), count)
    n = len(ride)
    names = dict.fromkeys(name for product in SEGMENT_FEATURES for name in product)
    table = pd.DataFrame({name: rng.gamma(2.0, 0.05, n) for name in names})
    table["duration_s"], table["ambient_c"] = rng.uniform(20.0, 60.0, n), rng.uniform(-25.0, 25.0, rides)[ride]
    table["ride_key"] = [f"car#{i}" for i in ride]
    table["window"] = np.concatenate([np.arange(c) for c in count])
    cold = np.maximum(5.0 - table["ambient_c"], 0.0) / 3000.0
    energy = 0.3 * table["effect_climbing_up"] + table["duration_s"] / 60.0 * (
        0.02 + cold * table["distance_km"] * 10.0
    )
    ride_table = pd.DataFrame(
        {"ride_key": [f"car#{i}" for i in range(rides)], "vehicle_model": rng.choice(models, rides)}
    )
    return table, ride_table.assign(energy_kwh=np.bincount(ride, weights=energy)), energy.to_numpy()
