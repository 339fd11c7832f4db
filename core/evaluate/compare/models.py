"""Compare models with measured energies: their errors, overall, by condition, and the rides of largest error.

Nothing is fitted here. All models are evaluated on the same rides, those that each of them predicts, so that models are
compared ride by ride. Rides of one vehicle on one day are correlated; the intervals allow for that
(`core.stats.clustered`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.errors import ModelError
from core.evaluate.binning import bin_rides
from core.evaluate.relative_errors import compute_relative_figures, compute_share_below_least
from core.evaluate.ride_filter import find_exclusion_reasons, name_rides
from core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from core.models import ANY, LinearModel
from core.stats import multiple_testing, scores
from core.stats.clustered import assign_vehicle_days, compute_clustered_mean, compute_clustered_ratio
from core.stats.scores import Codes, Estimate

MOST_WORST_RIDES: Final = 10
"""Number of rides of largest error that are listed."""
MOST_RELATIVE_SD: Final = 0.2
"""Largest ratio of standard uncertainty to energy at which the relative error of a ride is listed."""
RIDE_PROPERTIES: Final = ("vehicle_id", "vehicle_model", "date", "distance_km", "ambient_c", "average_speed_kmh")
"""Columns that describe a ride in reports."""


@dataclass(frozen=True)
class ComparedRides:
    """Hold rides with measured and predicted energies.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        Rides that are fit for training and that every model predicts.
    measured : (n,) float
        Measured energy. [kWh]
    predicted : dict of str to (n,) float
        Predicted energy, by model. [kWh]
    clusters : (n,) int64
        Vehicle-day of each ride.
    read : int
        Number of rides read.
    left_out : dict of str to int
        Number of excluded rides, by reason in words.
    notes : tuple of str
        Notes for the reader.
    """

    rides: pd.DataFrame
    measured: Floats
    predicted: dict[str, Floats]
    clusters: Codes
    read: int
    left_out: dict[str, int]
    notes: tuple[str, ...] = ()

    @property
    def noise_floor(self) -> float:
        """Error that measurement noise alone causes, NaN where it is unknown. [kWh]"""
        return compute_noise_floor(compute_noise_variance(self.rides))

    @property
    def keys(self) -> list[str]:
        """Name of each ride."""
        return name_rides(self.rides)


def select_rides(rides: pd.DataFrame, models: Mapping[str, LinearModel]) -> ComparedRides:
    """Return the rides that can be compared, with the energies that models predict for them.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table, as `core.totals.tables.ride_table` makes it.
    models : mapping of str to LinearModel
        Models by label.

    Returns
    -------
    ComparedRides

    Raises
    ------
    ModelError
        Where a column is missing, a model has no fit for any of the vehicle models, or no ride is left.
    """
    if rides.empty:
        raise ModelError("there are no rides: give tables or recordings that hold some")
    reason = find_exclusion_reasons(rides)
    left_out = {str(why).replace("_", " "): int(n) for why, n in reason.value_counts().sort_index().items()}
    kept = rides[reason.isna()].reset_index(drop=True)
    if kept.empty:
        raise ModelError(
            f"none of {len(rides):,} rides can be compared ({format_exclusions(left_out)}): give rides that are fit "
            "for training and have a measured energy"
        )
    found = {label: _predict(label, model, kept) for label, model in models.items()}
    known = np.ones(len(kept), np.bool_)
    for label, energy in found.items():
        own = ~np.isfinite(energy) & known
        if own.any():
            left_out[f"not predicted by {label}"] = int(own.sum())
        known &= ~own
    if not known.any():
        raise ModelError(
            f"there is no ride that every model predicts ({format_exclusions(left_out)}): compare fewer at a time"
        )
    kept = kept[known].reset_index(drop=True)
    return ComparedRides(
        rides=kept,
        measured=kept["energy_kwh"].to_numpy(np.float64),
        predicted={label: energy[known] for label, energy in found.items()},
        clusters=assign_vehicle_days(kept),
        read=len(rides),
        left_out=left_out,
        notes=_notes(kept, models),
    )


def format_exclusions(left_out: Mapping[str, int]) -> str:
    """Return the numbers of excluded rides, by reason, in words."""
    return ", ".join(f"{n:,} {why}" for why, n in left_out.items()) or "none left out"


def _predict(label: str, model: LinearModel, rides: pd.DataFrame) -> Floats:
    """Return the predictions of a model; refuse a model that predicts none of the rides."""
    cars = sorted(rides["vehicle_model"].unique())
    if ANY not in model.fits and not any(car in model.fits for car in cars):
        raise ModelError(
            f"model {label} is fitted to {', '.join(model.fits)}, and the rides are of {', '.join(cars)}: give rides "
            "of its vehicle models, or a model with a fit for these or for any other (*)"
        )
    energy = model.predict(rides)
    if not np.isfinite(energy).any():
        unknown = [name for name in model.needs if name in rides and rides[name].isna().all()]
        told = f": column {unknown[0]!r} is unknown in all of them" if unknown else ""
        raise ModelError(
            f"model {label} predicts none of {len(rides):,} rides{told}: give a model that does not read it"
        )
    return energy


def _notes(rides: pd.DataFrame, models: Mapping[str, LinearModel]) -> tuple[str, ...]:
    """Return notes on what the models were fitted to and what the rides lack."""
    notes = []
    for label, model in models.items():
        trained = model.training
        if trained is not None:
            inside = rides["date"].between(trained.first_date, trained.last_date)
            inside &= rides["vehicle_model"].isin(list(trained.vehicle_models))
            if n := int((~rides["vehicle_model"].isin(list(trained.vehicle_models))).sum()):
                told = ", ".join(trained.vehicle_models)
                notes.append(f"{label} was fitted to {told}; {n:,} of {len(rides):,} rides are of other vehicle models")
            if n := int(inside.sum()):
                notes.append(
                    f"{label} was fitted to rides from {trained.first_date} to {trained.last_date}; {n:,} of these "
                    "may be among them, and its error on other rides is larger: `socast evaluate` measures it"
                )
    days = len(np.unique(assign_vehicle_days(rides)))
    if days == 1:
        notes.append(f"{len(rides):,} rides of one car on one day: too few for intervals")
    if "driver_id" not in rides or rides["driver_id"].isna().all():
        notes.append("drivers are unknown: errors are shown by vehicle, not by driver")
    return tuple(notes)


def compare_predictions(found: ComparedRides) -> dict[str, Any]:
    """Return how predictions compare with measured energies.

    Parameters
    ----------
    found : ComparedRides
        Rides with measured and predicted energies.

    Returns
    -------
    dict
        `about`: the rides. `models`: for each model its errors (`compute_errors`), errors `by` condition and `worst`
        rides. `pairs`: differences between models. `rides`: energies of each ride. `notes`.
    """
    return {
        "about": describe_rides(found),
        "models": {
            label: compute_errors(found, energy)
            | {"by": compute_errors_by_condition(found, energy), "worst": find_worst_rides(found, energy)}
            for label, energy in found.predicted.items()
        },
        "pairs": compare_pairs(found),
        "rides": {
            "key": found.keys,
            "vehicle_model": found.rides["vehicle_model"].tolist(),
            "measured_kwh": found.measured,
            "predicted_kwh": found.predicted,
        },
        "notes": list(found.notes),
    }


def describe_rides(found: ComparedRides) -> dict[str, Any]:
    """Return which rides were compared: counts, dates, instruments, noise floor and mean consumption."""
    rides = found.rides
    distance = rides["distance_km"].to_numpy(np.float64)
    measured = {
        name: float((rides["energy_kwh"] == rides[f"energy_{name}_kwh"]).mean())
        for name in ("vi", "soc")
        if f"energy_{name}_kwh" in rides
    }
    return {
        "read": found.read,
        "rides": len(rides),
        "left_out": found.left_out,
        "vehicles": int(rides["vehicle_id"].nunique()),
        "vehicle_days": len(np.unique(found.clusters)),
        "vehicle_models": sorted(rides["vehicle_model"].unique()),
        "first_date": str(rides["date"].min()),
        "last_date": str(rides["date"].max()),
        "measured": measured,
        "noise_floor_kwh": found.noise_floor,
        "below_least": compute_share_below_least(found.measured),
        "consumption_kwh": compute_clustered_mean(found.measured, found.clusters).figures(),
        "per_100km_kwh": compute_clustered_ratio(100.0 * found.measured, distance, found.clusters).figures(),
    }


def compute_errors(found: ComparedRides, predicted: Floats) -> dict[str, Any]:
    """Return the errors of predictions.

    Parameters
    ----------
    found : ComparedRides
    predicted : (n,) float
        Predicted energy. [kWh]

    Returns
    -------
    dict
        `mae_kwh` and `bias_kwh` with intervals, `rmse_kwh`, `relative` and `relative_bias` as shares of mean
        consumption, the share of rides `within` each band of relative error, and the figures of
        `compute_relative_figures`: `wmape`, which is `relative` with its interval, `mape`, and `over_floor`.
    """
    error = predicted - found.measured
    used = float(np.mean(found.measured))
    off = compute_clustered_mean(error, found.clusters)
    figures = compute_relative_figures(found.measured, predicted, found.clusters, found.noise_floor)
    return {
        "rides": len(error),
        "bias_kwh": off.figures(),
        "rmse_kwh": scores.compute_rmse(found.measured, predicted),
        **figures,
        "relative": figures["wmape"]["value"],
        "relative_bias": off.value / used if used > 0.0 else np.nan,
        "within": scores.compute_band_shares(found.measured, predicted),
    }


def compute_errors_by_condition(found: ComparedRides, predicted: Floats) -> dict[str, list[dict[str, Any]]]:
    """Return the errors in each bin of each condition.

    Parameters
    ----------
    found : ComparedRides
    predicted : (n,) float
        Predicted energy. [kWh]

    Returns
    -------
    dict of str to list of dict
        `bin`, `n`, `vehicle_days`, `bias_kwh` with its interval, `mae_kwh`, and `relative` and `relative_bias` as
        shares of consumption. `q` is the false-discovery rate if all bins at least as significantly biased were
        reported (Benjamini and Hochberg, over the bins of all conditions).
    """
    error = predicted - found.measured
    made: dict[str, list[dict[str, Any]]] = {}
    p: list[float] = []
    for name, (codes, labels) in bin_rides(found.rides).items():
        entries = made.setdefault(name, [])
        for code in np.unique(codes[codes >= 0]).tolist():
            rows = np.flatnonzero(codes == code)
            off = compute_clustered_mean(error[rows], found.clusters[rows])
            entries.append({"bin": labels[code], **_bin(error[rows], found.measured[rows], found.clusters[rows], off)})
            p.append(off.p)
    q = iter(multiple_testing.adjust_false_discovery(np.array(p)).tolist())
    for entry in (entry for entries in made.values() for entry in entries):
        entry["q"] = next(q)
    return made


def _bin(error: Floats, measured: Floats, clusters: Codes, off: Estimate) -> dict[str, Any]:
    """Return the errors of the rides of a bin."""
    used = float(np.mean(measured))
    size = float(np.mean(np.abs(error)))
    return {
        "n": len(error),
        "vehicle_days": len(np.unique(clusters)),
        "bias_kwh": off.figures(),
        "mae_kwh": size,
        "relative": size / used if used > 0.0 else np.nan,
        "relative_bias": off.value / used if used > 0.0 else np.nan,
    }


def compare_pairs(found: ComparedRides) -> list[dict[str, Any]]:
    """Return the difference of mean absolute error of each pair of models, on the same rides.

    Returns
    -------
    list of dict
        Models `a` and `b`; `difference_kwh`, the error of a less the error of b, with its interval; `p`; and `p_holm`,
        adjusted for all pairs.
    """
    error = {label: np.abs(energy - found.measured) for label, energy in found.predicted.items()}
    apart = {
        (a, b): compute_clustered_mean(error[a] - error[b], found.clusters)
        for a, b in multiple_testing.list_pairs(list(error))
    }
    adjusted = multiple_testing.adjust_differences(apart)
    return [
        {"a": a, "b": b, "difference_kwh": off.figures(), "p": off.p, "p_holm": adjusted[a, b]}
        for (a, b), off in apart.items()
    ]


def find_worst_rides(found: ComparedRides, predicted: Floats) -> dict[str, list[dict[str, Any]]]:
    """Return the rides of largest `absolute` error and of largest `relative` error.

    Parameters
    ----------
    found : ComparedRides
    predicted : (n,) float
        Predicted energy. [kWh]

    Returns
    -------
    dict of str to list of dict
        At most `MOST_WORST_RIDES` rides each, largest error first.

    Notes
    -----
    The relative list holds only rides whose energy is known to within `MOST_RELATIVE_SD`, because a ride downhill may
    use almost no energy.
    """
    error = predicted - found.measured
    size = np.abs(found.measured)
    spread = (
        found.rides["energy_sd_kwh"].to_numpy(np.float64) if "energy_sd_kwh" in found.rides else np.zeros(len(error))
    )
    relative = np.divide(error, size, out=np.full(len(error), np.nan), where=size > 0.0)
    keys = found.keys

    def told(row: int) -> dict[str, Any]:
        own = {name: found.rides[name].iloc[row] for name in RIDE_PROPERTIES if name in found.rides}
        return {
            "ride": keys[row],
            **own,
            "measured_kwh": found.measured[row],
            "predicted_kwh": predicted[row],
            "error_kwh": error[row],
            "relative": relative[row],
        }

    def first(values: Floats) -> list[dict[str, Any]]:
        order = np.argsort(-np.abs(values), kind="stable")  # NaN last
        return [told(row) for row in order[:MOST_WORST_RIDES].tolist() if not np.isnan(values[row])]

    known = np.nan_to_num(spread) <= MOST_RELATIVE_SD * size
    return {"absolute": first(error), "relative": first(np.where(known, relative, np.nan))}
