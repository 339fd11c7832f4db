"""Provide signals of a drive, a small linear model with every optional part, and rides for it."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.columns import JOULES_PER_KWH
from socast.core.models import ANY, Fit, LinearModel, Term
from socast.core.models.trees import Trees
from socast.core.vehicles import AccessoryCurve, load_catalogue

LEAF = load_catalogue()["nissan-leaf-2013"]


def steps(seed: int, rows: int) -> dict[str, np.ndarray]:
    """Return random signals of a drive, in SI units, one value per step of 3 s."""
    random = np.random.default_rng(seed)
    return {
        "dt": np.full(rows, 3.0),
        "speed": random.uniform(0.0, 36.0, rows),
        "acceleration": random.uniform(-2.0, 2.0, rows),
        "grade": random.uniform(-0.1, 0.1, rows),
        "ambient": random.uniform(245.0, 310.0, rows),
        "mass": np.full(rows, LEAF.mass_kg + 75.0),
        "accessory_scale": np.full(rows, 1.0),
    }


def ride_columns(model, signals) -> dict[str, np.ndarray]:
    """Return the columns that a model needs, with one row per step."""
    columns = {
        "rolling_resistance": np.full(len(signals["dt"]), LEAF.rolling_resistance),
        "drag_area_m2": np.full(len(signals["dt"]), LEAF.drag_area_m2),
    }
    for name in model.effects:
        effect = effects.get(name)
        columns[effect.energy_name] = effect.power(signals) * signals["dt"] / JOULES_PER_KWH
    return columns


def model_of(*terms, **fields) -> LinearModel:
    return LinearModel(name="m", version="1", recipe="r", terms=terms, **fields)


CURVE = AccessoryCurve(
    heating_full=255.0,
    heating_off=285.0,
    cooling_on=294.0,
    cooling_full=305.0,
    heating=4000.0,
    standby=250.5,
    cooling=1500.0,
)
LINEAR = (
    Term(name="distance", columns=("distance_km",), unit="kWh/km"),
    Term(name="wind", columns=("wind_from_east", "wind_speed_kmh"), unit="kWh/(km/h)"),
    Term(name="accessories", columns=("accessories_kwh",), unit="1"),
    Term(name="constant", columns=(), unit="kWh"),
)
STUMP = Trees(
    features=("occupants", "wind_from_north"),
    baseline=0.5,
    roots=(0,),
    feature=(0, -1, -1),
    threshold=(2.0, 0.0, 0.0),
    left=(1, 0, 0),
    right=(2, 0, 0),
    value=(0.0, -1.0, 1.0),
    missing_left=(1, 0, 0),
)


def fleet(rows: int = 60, seed: int = 1) -> pd.DataFrame:
    """Return rides of three vehicle models, one of them without a fit, and of cars of unknown vehicle model."""
    random = np.random.default_rng(seed)
    table = pd.DataFrame(
        {
            "distance_km": random.uniform(1.0, 20.0, rows),
            "wind_speed_kmh": random.uniform(0.0, 40.0, rows),
            "wind_from_deg": random.uniform(0.0, 360.0, rows),
            "duration_s": random.uniform(60.0, 3000.0, rows),
            "ambient_c": random.uniform(-30.0, 30.0, rows),
            "accessory_scale": random.choice([0.9, 1.3], rows),
            "occupants": random.integers(1, 5, rows).astype(float),
            "vehicle_model": random.choice(["leaf", "soul", "new", None], rows),
            "vehicle_id": random.choice(["a", "b", "c"], rows),
        }
    )
    table.loc[::7, "wind_from_deg"] = np.nan
    table.loc[::11, "distance_km"] = np.nan
    return table


FLEET = model_of(
    *LINEAR,
    fits={
        "leaf": Fit(coefficients=(0.2, 0.001, 1.0, 0.05), fills={"wind_from_east": 0.3}, curve=CURVE),
        "soul": Fit(coefficients=(0.1, 0.002, 0.9, -0.05), fills={"distance_km": 4.0}, curve=CURVE),
        ANY: Fit(coefficients=(0.15, 0.0, 1.1, 0.0), curve=CURVE),
    },
    cars={"b": 1.125},
    correction={"leaf": STUMP},
)


def make_model(name: str, terms: Sequence[Term], coefficients: Sequence[float], key: str = ANY) -> LinearModel:
    """Return a model with one fit and no other parts."""
    return LinearModel(
        name=name, version="1", recipe=name, terms=tuple(terms), fits={key: Fit(coefficients=tuple(coefficients))}
    )
