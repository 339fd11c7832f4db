"""Random features of rides and a target that depends on them, for tests of boosted trees."""

import numpy as np

NAMES = ("ambient_c", "duration_s", "stops", "occupants")


def features(rows: int, seed: int, unknown: float = 0.1) -> np.ndarray:
    """Return features of very different size, some of them unknown, (rows, 4)."""
    random = np.random.default_rng(seed)
    table = random.normal(size=(rows, len(NAMES))) * [10.0, 1e6, 1e-6, 1.0]
    table[:, 3] = np.round(table[:, 3])
    table[random.random(table.shape) < unknown] = np.nan
    return table


def answers(table: np.ndarray, seed: int) -> np.ndarray:
    """Return a step in the first feature times the fourth, whether the second is unknown, and noise, (rows,)."""
    random = np.random.default_rng(seed + 1)
    known = np.nan_to_num(table)
    step = np.where(known[:, 0] > 3.0, 2.0, 0.0)
    return step * known[:, 3] + np.isnan(table[:, 1]) + random.normal(0.0, 0.3, len(table))
