"""Make plain shapes of an unknown cause: an amount of driving multiplied by a function of the conditions."""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.ride_blocks import get_numbers
from socast.core.models.derived_features import compute_sun_sine

ABOUT: Final = (
    "ambient_c",
    "precipitation_mm_h",
    "wind_speed_kmh",
    "soc_start_pct",
    "battery_temperature_c",
    "occupants",
    "odometer_km",
)
"""Features on which an unknown cause may depend. Motion is not among them: it is measured too coarsely."""
CARRIERS: Final = (
    "duration_s",
    "effect_rolling",
    "effect_aero_drag",
    "effect_inertia_positive",
    "effect_braking",
    "effect_climbing_up",
    "stops",
)
"""Carriers with which an unknown cause may grow: time, distance, speed, acceleration, braking, hills and stops."""

PRODUCT_CARRIERS: Final = ("duration_s", "effect_rolling")
"""Carriers that are multiplied by two conditions: time and distance."""
ALSO_LOW: Final = ("ambient_c", "soc_start_pct")
"""Conditions whose low values may also cause consumption."""
ONLY_HIGH: Final = ("precipitation_mm_h", "wind_speed_kmh", "occupants", "parked_s")
"""Conditions whose high values may cause consumption."""
EARLY: Final = 600.0
"""Time constant with which the start of a ride ends. [s]"""


class PlainShapeColumns(NamedTuple):
    """Hold the plain shapes that can be identified beside a model.

    Parameters
    ----------
    columns : (n, shapes) float
        Weighted and projected off the terms of the model. [1]
    energy : (shapes,) float
        Absolute amount of each over all windows. [unit of the shape]
    """

    names: list[str]
    columns: Floats
    energy: Floats


def build_plain_shapes(base: BaseProjection, *, products: bool = False) -> PlainShapeColumns:
    """Return the plain shapes, off the terms of a model.

    Parameters
    ----------
    products : bool
        Whether to include time and distance in two conditions at once, such as rain in the cold.
    """
    names, columns = _shapes(base.windows)
    if products:
        more, products_of_two = _products(base.windows)
        names, columns = [*names, *more], np.column_stack([columns, products_of_two])
    projected = base.project_out(columns)
    kept = (projected**2).sum(axis=0) > LEAST_LEFT * (base.apply_weights(columns) ** 2).sum(axis=0)
    return PlainShapeColumns(
        [name for name, keep in zip(names, kept, strict=True) if keep],
        projected[:, kept],
        np.abs(columns).sum(axis=0)[kept],
    )


def _shapes(windows: Windows) -> tuple[list[str], Floats]:
    """Return the name and the energy of each carrier times each function of a feature, (n, shapes)."""
    functions = dict(_functions(windows))
    names, columns = [], []
    for carrier in CARRIERS:
        amount = np.nan_to_num(get_numbers(windows.table, carrier), nan=0.0)
        for name, values in functions.items():
            names.append(f"{carrier.removeprefix('effect_')} * {name}")
            columns.append(amount * values)
    return names, np.column_stack(columns)


def _products(windows: Windows) -> tuple[list[str], Floats]:
    """Return the name and the energy of time and distance in each condition and in each two conditions, (n, shapes)."""
    conditions = _conditions(windows)
    pairs = [
        (one, other) for i, one in enumerate(conditions) for other in list(conditions)[i:] if not _exclude(one, other)
    ]
    names, columns = [], []
    for carrier in PRODUCT_CARRIERS:
        amount = np.nan_to_num(get_numbers(windows.table, carrier), nan=0.0)
        for one, other in pairs:
            names.append(" * ".join([carrier.removeprefix("effect_"), *dict.fromkeys((one, other))]))
            columns.append(amount * (conditions[one] if one == other else conditions[one] * conditions[other]))
    return names, np.column_stack(columns) if columns else np.empty((len(windows.measured), 0))


def _exclude(one: str, other: str) -> bool:
    """Return whether two different conditions are opposites of each other."""
    same = one.rsplit(maxsplit=1)[-1] == other.rsplit(maxsplit=1)[-1]
    return one != other and (same or {one, other} == {"dark", "sun"})


def _conditions(windows: Windows) -> dict[str, Floats]:
    """Return conditions from 0, absent, to 1, fully present, by name."""
    table = windows.table
    light = compute_window_sun_sine(windows)
    out = {
        "early elapsed_s": np.exp(-np.nan_to_num(get_numbers(table, "elapsed_s")) / EARLY),
        "dark": (light <= 0.0).astype(np.float64),
        "sun": np.maximum(light, 0.0),
    }
    for name in (*ALSO_LOW, *ONLY_HIGH):
        values = get_numbers(table, name)
        if not np.isfinite(values).any():
            continue
        values = np.where(np.isfinite(values), values, np.nanmedian(values))
        low, high = np.quantile(values, [0.05, 0.98])
        if not high > low:
            continue
        out[f"high {name}"] = np.clip((values - low) / (high - low), 0.0, 1.0)
        if name in ALSO_LOW:
            out[f"low {name}"] = 1.0 - out[f"high {name}"]
    return out


def _functions(windows: Windows) -> list[tuple[str, Floats]]:
    """Return functions of the features, with unknown values replaced by the median."""
    table = windows.table
    functions: list[tuple[str, Floats]] = []
    for name in ABOUT:
        values = get_numbers(table, name)
        if not np.isfinite(values).any():
            continue
        values = np.where(np.isfinite(values), values, np.nanmedian(values))
        low, middle, high = np.quantile(values, [0.2, 0.5, 0.8])
        spread = max(float(np.std(values)), 1e-9)
        if spread < 1e-6 * max(abs(middle), 1.0):
            continue
        functions.append((name, (values - middle) / spread))
        functions.append((f"low {name}", np.maximum(low - values, 0.0) / spread))
        functions.append((f"high {name}", np.maximum(values - high, 0.0) / spread))
    light = compute_window_sun_sine(windows)
    return [*functions, ("sun", light), ("dark", (light <= 0.0).astype(np.float64))]


def compute_window_sun_sine(windows: Windows) -> Floats:
    """Return the sine of the solar elevation at each window, 0 at night and where the position is unknown, (n,)."""
    table = windows.table
    place = get_numbers(table, "latitude_start_deg"), get_numbers(table, "longitude_start_deg")
    return np.nan_to_num(compute_sun_sine(get_numbers(table, "start_s"), *place), nan=0.0)
