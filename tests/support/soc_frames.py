"""Random shifts and forecasts in the tables of a pipeline, for tests of their evaluation."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtr

DAY_ONE = 1_514_764_800.0
"""1 January 2018, midnight UTC."""
CAPACITY = 30.0
RESERVE = 10.0
MODELS = ("kia-soul-ev-2015", "nissan-leaf-2016")
RATES = {"kia-soul-ev-2015": 0.20, "nissan-leaf-2016": 0.25}
"""Mean consumption of rides. [kWh/km]"""
SPREAD = 1.6448536269514722


class ForecastFrames(NamedTuple):
    """Tables of forecasts and shifts."""

    outlooks: pd.DataFrame
    shifts: pd.DataFrame


def make_frames(
    cars: int = 6,
    days: int = 20,
    hours: float = 7.0,
    sd_an_hour: float = 1.0,
    narrow: float = 1.0,
    bias: float = 0.0,
    warm_up: int = 2,
    seed: int = 1,
) -> ForecastFrames:
    """Return shifts whose forecasts have normal errors, with `sd_an_hour` per hour left, and at least half an hour's.

    Each shift and hour has one error; the interval is `narrow` times as wide as the 90 % interval of the error. In the
    first `warm_up` days there are no forecasts of the end. Each shift has its own consumption about the mean of its
    model, and drives more in some hours than in others.
    """
    rng = np.random.default_rng(seed)
    made, ended = [], []
    for car in range(cars):
        model = MODELS[car % len(MODELS)]
        for day in range(days):
            begin = DAY_ONE + 86_400.0 * day + 3600.0 * rng.uniform(6.0, 12.0)
            name = {"vehicle_id": f"taxi-{car}", "vehicle_model": model, "shift": day}
            km = 12.0 * hours
            fall = 100.0 * RATES[model] * rng.normal(1.0, 0.1) * km / CAPACITY
            ambient = float(rng.uniform(-25.0, 25.0))
            shift = name | {
                "begin_s": begin, "end_s": begin + 3600.0 * hours,
                "soc_begin_pct": 90.0, "soc_end_pct": 90.0 - fall, "soc_lowest_pct": 90.0 - fall,
                "distance_km": 1.2 * km, "ride_km": km, "charged_s": np.nan, "ambient_c": ambient,
                "capacity_kwh": CAPACITY,
            }  # fmt: skip
            ended.append(shift)
            made.append(_outlooks(shift, hours, sd_an_hour, narrow, bias, day < warm_up, rng) | name)
    return ForecastFrames(_join(made), pd.DataFrame(ended))


def _join(made: list[dict]) -> pd.DataFrame:
    """Return one table of parts that are columns of arrays, or of one value for all rows of the part."""
    lengths = [len(part["time_s"]) for part in made]
    columns = {}
    for name, first in made[0].items():
        if isinstance(first, np.ndarray):
            columns[name] = np.concatenate([part[name] for part in made])
        else:
            kind = object if isinstance(first, str) else None
            columns[name] = np.repeat(np.array([part[name] for part in made], kind), lengths)
    return pd.DataFrame(columns)


def _outlooks(shift, hours, sd_an_hour, narrow, bias, unlearned, rng) -> dict:
    """Return one forecast per minute: columns of arrays, or of one value for all."""
    passed = np.linspace(0.0, 1.0, int(60 * hours) + 1)
    left = hours * (1.0 - passed)
    driven = np.cumsum(rng.uniform(0.2, 1.8, int(hours) + 1)[np.floor(hours * passed[:-1]).astype(int)])
    share = np.concatenate([[0.0], driven / driven[-1]])
    sd = sd_an_hour * np.maximum(left, 0.5)
    error = rng.normal(0.0, 1.0, int(hours) + 2)[np.round(left).astype(int)] * sd + bias
    mean = shift["soc_end_pct"] + error
    half = SPREAD * narrow * sd
    soc = 90.0 - share * (90.0 - shift["soc_end_pct"])
    known = np.nan if unlearned else 1.0
    return {
        "time_s": shift["begin_s"] + 3600.0 * hours * passed,
        "shift_begin_s": shift["begin_s"], "shift_end_s": shift["end_s"], "planned": True,
        "soc_pct": soc, "soc_mean_pct": known * mean, "soc_p05_pct": known * (mean - half),
        "soc_p95_pct": known * (mean + half), "reserve_soc_pct": RESERVE,
        "reserve_risk": known * ndtr((RESERVE - mean) / (narrow * sd)),
        "ahead_km": shift["ride_km"] * (1.0 - share), "ambient_c": shift["ambient_c"],
        "soc_begin_pct": 90.0, "shift_km": shift["distance_km"] * share,
        "charge_planned": False, "charge_to_pct": np.nan, "arrived_s": np.nan, "arrival_soc_pct": np.nan,
        "charge_s": np.nan, "charge_soc_mean_pct": np.nan, "charge_soc_p05_pct": np.nan,
        "charge_soc_p95_pct": np.nan, "charge_risk": np.nan, "charge_km": np.nan,
    }  # fmt: skip
