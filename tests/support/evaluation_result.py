"""Make the result of an evaluation as `socast evaluate --json` writes it, with simulated figures."""

import math
from itertools import combinations, pairwise
from typing import Any

import msgspec
import numpy as np

from socast.core.evaluate.binning import SEASONS
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.records import to_json_values

RECIPES = {
    "basic_physical": "Basic Physical Model",
    "extended_physical": "Extended Physical Model",
    "fitted_physical": "Fitted Extended Physical Model (Linear Regression)",
    "empirical": "Learned Empirical Model (No Interaction Terms)",
    "empirical_interactions": "Learned Empirical Model (Interaction Terms)",
    "hybrid": "Hybrid Model (No Interaction Terms)",
    "hybrid_interactions": "Hybrid Model (Interaction Terms)",
    "segment_network": "Segment Model (Neural Network on 60 s)",
    "hybrid_ridge": "Regularised Hybrid Model",
    "hybrid_trees": "Hybrid Model with Boosted Trees",
    "basic_rescaled": "Basic Physical Model, Rescaled",
    "basic_rescaled_power": "Basic Physical Model, Rescaled, with a Constant Power",
    "telematics_regression": "Telematics Regression (Distance, Duration, Speed, Temperature)",
}
SKILL = dict(zip(RECIPES, (1.0, 0.91, 0.58, 0.54, 0.52, 0.51, 0.48, 0.55, 0.47, 0.41, 0.82, 0.68, 0.62), strict=True))
"""Ratio of the mean error of each model to that of the basic physical model."""
VEHICLES = {
    "kia-soul-ev-2015": (131866, 0.33),
    "nissan-leaf-2016": (26269, 0.59),
    "tesla-model-s": (22082, 0.51),
    "tesla-model-x": (13130, 0.55),
}
CLUSTERS = ("0-5", "5-10", "10-15", "15-20", "20-25")
ALL_CLUSTERS = (*CLUSTERS, "25-30", "30+")
TEMPERATURES = ("below -30", *(f"{low} to {high}" for low, high in pairwise(range(-30, 31, 10))), "from 30")
BASELINES = ("basic_physical", "basic_rescaled", "basic_rescaled_power", "telematics_regression")
BEYOND_PAPER = ("hybrid_ridge", "hybrid_trees")


def hold(values: dict[str, Any]) -> RecipeEvaluation:
    """Return the result of an evaluation from its JSON values, some of which may be missing."""
    return msgspec.convert(to_json_values(values), RecipeEvaluation)


def evaluation(seed: int = 1) -> dict[str, Any]:
    """Return a complete result of an evaluation."""
    rng = np.random.default_rng(seed)
    rides = {v: _rides(total) for v, (total, _) in VEHICLES.items()}
    mae = {recipe: _errors(recipe, rng) for recipe in RECIPES}
    average = {r: {v: mae[r][v]["average"]["value"] for v in VEHICLES} for r in RECIPES}
    return {
        "about": _about(rides),
        "rides": rides,
        "consumption": {v: _consumption(rides[v]) for v in VEHICLES},
        "test_consumption": _test_consumption(rng),
        "recipes": dict(RECIPES),
        "mae": mae,
        "reduction": {r: _reduction(average[r], average["basic_physical"]) for r in RECIPES},
        "reduction_by_baseline": {b: {r: _reduction(average[r], average[b]) for r in RECIPES} for b in BASELINES},
        "percentage": _percentage(),
        "relative": {
            r: {c: mae[r]["weighted"][c]["value"] / (0.6 + 1.1 * i) for i, c in enumerate(CLUSTERS)} for r in RECIPES
        },
        "difference": {v: _differences(average, v, rng) for v in (*VEHICLES, "all")},
        "dominates": {"all": ["hybrid_trees"]}
        | {v: ["hybrid_trees"] if i % 2 else ["hybrid_ridge", "hybrid_trees"] for i, v in enumerate(VEHICLES)},
        "dominates_average": {v: ["hybrid_trees"] for v in (*VEHICLES, "all")},
        "bias": {r: {v: float(rng.normal(0, 0.02)) for v in VEHICLES} for r in RECIPES},
        "rmse": {r: {v: 1.3 * average[r][v] for v in VEHICLES} for r in RECIPES},
        "bands": {r: {b: min(1.0, int(b) / 25 / SKILL[r] ** 0.5) for b in ("5", "10", "15")} for r in RECIPES},
        "by": _by(rng),
        "coverage": {r: _coverage(rng) for r in BEYOND_PAPER},
        "buffer_kwh": {r: {"95": 1.9 * SKILL[r], "99": 3.2 * SKILL[r]} for r in RECIPES},
        "buffer_by_cluster": {
            r: {c: {"95": (1.9 + i) * SKILL[r], "99": (3.2 + i) * SKILL[r]} for i, c in enumerate(CLUSTERS)}
            for r in RECIPES
        },
        "splits": _splits(average, rng),
        "new_vehicle": _new_vehicle(average, rng),
        "few_shot": {v: _few_shot(average, v) for v in VEHICLES},
        "selection": _selection(),
        "curve": {v: _curve(rng) for v in VEHICLES},
    }


def _rides(total: int) -> dict[str, int]:
    shares = (0.8, 0.14, 0.045, 0.01, 0.002, 0.0004, 0.0002)
    counts = {c: round(total * s) for c, s in zip(ALL_CLUSTERS, shares, strict=True)}
    return counts | {"total": sum(counts.values())}


def _about(rides: dict[str, dict[str, int]]) -> dict[str, Any]:
    fit = sum(r["total"] for r in rides.values())
    return {
        "rides": fit + 14079,
        "fit": fit,
        "unfit": {"too_long": 11021, "too_short": 2950, "energy_unknown": 108},
        "seed": 1,
        "repeats": 10,
        "test_share": 0.2,
        "vehicle_models": list(VEHICLES),
        "clusters": list(CLUSTERS),
        "vehicles": 170,
        "notes": ["segment_network: no prediction for 0.10% of the rides; no recipe is evaluated by these"],
        "first_date": "2018-01-15",
        "last_date": "2018-12-20",
        "energy_source": {"vi": 0.62, "soc": 0.38},
        "seconds": 143.2,
    }


def _consumption(rides: dict[str, int]) -> dict[str, float | None]:
    per_cluster = {c: 0.6 + 1.0 * i if rides[c] else None for i, c in enumerate(ALL_CLUSTERS)}
    known = [value for value in per_cluster.values() if value is not None]
    return per_cluster | {"average": sum(known) / len(known)}


def _estimate(value: float, ci95: float) -> dict[str, float]:
    return {"value": float(value), "ci95": float(ci95)}


def _test_consumption(rng: np.random.Generator) -> dict[str, Any]:
    rows = {
        v: {c: _estimate(0.6 + i + 0.1 * rng.random(), 0.01 * 3**i) for i, c in enumerate(CLUSTERS)}
        for v in (*VEHICLES, "weighted")
    }
    for v in VEHICLES:
        rows[v]["average"] = _estimate(2.6, 0.06)
    return rows


def _errors(recipe: str, rng: np.random.Generator) -> dict[str, Any]:
    rows: dict[str, Any] = {}
    for v, (total, base) in VEHICLES.items():
        values = base * SKILL[recipe] * (1 + 0.5 * np.arange(5)) * rng.normal(1, 0.01, 5)
        rows[v] = {
            c: _estimate(value, 3 * 3**i / math.sqrt(total))
            for i, (c, value) in enumerate(zip(CLUSTERS, values, strict=True))
        }
        if v == "nissan-leaf-2016":
            rows[v]["20-25"] = {"value": None, "ci95": None}
        known = [cell["value"] for cell in rows[v].values() if cell["value"] is not None]
        rows[v]["average"] = _estimate(np.mean(known), 0.03)
    rows["weighted"] = {
        c: _estimate(np.mean([rows[v][c]["value"] for v in VEHICLES if rows[v][c]["value"] is not None]), 0.1)
        for c in CLUSTERS
    }
    return rows


def _reduction(error: dict[str, float], basic: dict[str, float]) -> dict[str, float]:
    shares = {v: 1 - error[v] / basic[v] for v in error}
    return shares | {"average": float(np.mean(list(shares.values())))}


def _differences(average: dict[str, dict[str, float]], v: str, rng: np.random.Generator) -> dict[str, Any]:
    made = {}
    for a, b in combinations(RECIPES, 2):
        value = float(np.mean([average[a][v] - average[b][v] for v in (VEHICLES if v == "all" else [v])]))
        made[f"{a}|{b}"] = _estimate(value, 0.02 + 0.01 * rng.random()) | {"p": 0.001 if abs(value) > 0.03 else 0.4}
    return made


def _by(rng: np.random.Generator) -> dict[str, Any]:
    bins = {
        "distance": ALL_CLUSTERS,
        "temperature": TEMPERATURES,
        "season": SEASONS,
        "driver": tuple(f"driver-{i:03d}" for i in range(60)),
    }
    return {
        axis: {
            r: [
                {
                    "bin": b,
                    "n": int(200 / (i + 1)) + 5,
                    "bias": float(rng.normal(0, 0.03)),
                    "mae": float(SKILL[r] * (0.4 + 0.02 * i)),
                    "relative": float(SKILL[r] * 0.4),
                }
                for i, b in enumerate(names)
            ]
            for r in RECIPES
        }
        for axis, names in bins.items()
    }


def _coverage(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "overall": 0.902,
        "cluster": {c: float(np.clip(rng.normal(0.9, 0.03), 0, 1)) for c in CLUSTERS},
        "season": dict(zip(SEASONS, (0.871, 0.913), strict=True)),
        "vehicle_model": dict.fromkeys(VEHICLES, 0.9),
        "width_kwh": 0.92,
        "by_vehicle": 0.89,
        "by_date": 0.84,
        "new_vehicle": 0.71,
    }


def _splits(average: dict[str, dict[str, float]], rng: np.random.Generator) -> dict[str, Any]:
    factor = {"ride": 0.0, "vehicle": 0.05, "date": 0.12}
    return {
        split: {r: {v: m * (1 + more * rng.random()) for v, m in average[r].items()} for r in RECIPES}
        for split, more in factor.items()
    }


def _percentage() -> dict[str, Any]:
    factor = {"ride": 1.0, "vehicle": 1.1, "date": 1.2}
    return {"least_energy_kwh": 0.1} | {
        kind: {
            "rides": 1234,
            "energy_kwh": 1.9,
            "below_least": 0.013,
            "noise_floor_kwh": 0.05,
            "recipes": {
                r: {
                    "mae_kwh": _estimate(0.6 * SKILL[r] * more, 0.02),
                    "wmape": _estimate(0.3 * SKILL[r] * more, 0.01),
                    "mape": _estimate(0.4 * SKILL[r] * more, 0.015),
                    "over_floor": 12.0 * SKILL[r] * more,
                }
                for r in RECIPES
            },
        }
        for kind, more in factor.items()
    }


def _new_vehicle(average: dict[str, dict[str, float]], rng: np.random.Generator) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for r in RECIPES:
        made[r] = {}
        for v in VEHICLES:
            basic = average["basic_physical"][v]
            error = basic if r == "basic_physical" else average[r][v] * rng.uniform(1.0, 2.4)
            made[r][v] = {"mae": error, "relative": error / 2.5, "basic": basic, "reduction": 1 - error / basic}
        made[r]["average"] = {key: float(np.mean([row[key] for row in made[r].values()])) for key in made[r][v]}
    return made


def _few_shot(average: dict[str, dict[str, float]], v: str) -> dict[str, Any]:
    def curve(end: float, start: float) -> list[dict[str, float]]:
        return [
            {"rides": n, "mae": end + (start - end) / (1 + 0.3 * n), "ci95": 0.05 / (1 + n) ** 0.5}
            for n in (0, 1, 3, 10, 30, 100)
        ]

    basic = average["basic_physical"][v]
    ways = {
        "fitted_physical_others": curve(0.7 * basic, 0.7 * basic),
        "fitted_physical_refitted": curve(average["fitted_physical"][v], 0.65 * basic),
    }
    return ways | {r: curve(average[r][v], 0.65 * basic) for r in ("fitted_physical", "hybrid_ridge", "hybrid_trees")}


def _selection() -> dict[str, Any]:
    return {
        "constant": ["nominal_capacity_kwh"],
        "rfecv": {
            "removed": ["time_since_charge_s"],
            "scores": [{"terms": n, "mae": 0.3 + 0.4 / n} for n in range(1, 34)],
            "loss": _estimate(0.0001, 0.0004) | {"p": 0.7},
        },
        "rfe": {
            "removed": ["precipitation_mm_h", "gained_m"],
            "loss": _estimate(0.0006, 0.0005) | {"p": 0.125},
            "steps": [
                {"term": term, "loss": _estimate(0.0002 * 3**i, 0.0005) | {"p": 0.5 / 4**i}}
                for i, term in enumerate(("precipitation_mm_h", "gained_m", "lost_m", "odometer_km", "distance_km"))
            ],
        },
    }


def _curve(rng: np.random.Generator) -> dict[str, Any]:
    at = np.arange(-30.0, 36.0, 2.0)
    power = 300 + 3700 * np.clip((12 - at) / 32, 0, 1) + 1200 * np.clip((at - 21) / 14, 0, 1)
    return {
        "points": [
            {"ambient_c": float(t), "power_w": float(p), "rides": int(rng.integers(5, 400))}
            for t, p in zip(at, power * rng.normal(1, 0.05, len(at)), strict=True)
        ],
        "curve": {
            "heating_full": 253.15,
            "heating_off": 285.15,
            "cooling_on": 294.15,
            "cooling_full": 308.15,
            "heating": 4000.0,
            "standby": 300.0,
            "cooling": 1500.0,
        },
    }
