"""Compare models with measured energies: their errors, overall, by condition, and the rides of largest error.

Nothing is fitted here. All models are evaluated on the same rides, those that each of them predicts, so that models are
compared ride by ride. Rides of one vehicle on one day are correlated; the intervals allow for that
(`socast.core.stats.clustered`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.evaluate.binning import list_bins
from socast.core.evaluate.compare.records import (
    ComparedModel,
    Comparison,
    ConditionBin,
    PairDifference,
    PredictionErrors,
    RideEnergies,
    RideSample,
    WorstRide,
    WorstRides,
)
from socast.core.evaluate.paper.results import word_limited
from socast.core.evaluate.records import hold_estimate
from socast.core.evaluate.relative_errors import compute_relative_figures, compute_share_below_least
from socast.core.evaluate.ride_filter import compute_instrument_shares, find_exclusion_reasons, name_rides
from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance
from socast.core.fit.ride_blocks import assign_vehicle_days, get_numbers_if_present
from socast.core.formatting import format_count
from socast.core.models import ANY, LinearModel
from socast.core.models.plausibility import describe_implausible, describe_limited
from socast.core.stats import multiple_testing, scores
from socast.core.stats.clustered import compute_clustered_mean, compute_clustered_ratio
from socast.core.stats.scores import Codes

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
    left_out : dict of str to int
        Number of excluded rides, by reason in words.
    models : mapping of str to LinearModel
        The models.
    """

    rides: pd.DataFrame
    measured: Floats
    predicted: dict[str, Floats]
    clusters: Codes
    read: int
    left_out: dict[str, int]
    models: Mapping[str, LinearModel] = field(default_factory=dict)

    @property
    def noise_floor(self) -> float:
        """Error that measurement noise alone causes, NaN where it is unknown. [kWh]"""
        return compute_noise_floor(compute_noise_variance(self.rides))

    @property
    def keys(self) -> list[str]:
        """Name of each ride."""
        return name_rides(self.rides)


def select_rides(rides: pd.DataFrame, models: Mapping[str, LinearModel]) -> ComparedRides:
    """Return the rides that can be compared, with the energies that models predict for them."""
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
    predictions = {label: _predict(label, model, kept) for label, model in models.items()}
    known = np.ones(len(kept), np.bool_)
    for label, energy in predictions.items():
        unpredicted = ~np.isfinite(energy) & known
        if unpredicted.any():
            left_out[f"not predicted by {label}"] = int(unpredicted.sum())
        known &= ~unpredicted
    if not known.any():
        raise ModelError(
            f"there is no ride that every model predicts ({format_exclusions(left_out)}): compare fewer at a time"
        )
    kept = kept[known].reset_index(drop=True)
    return ComparedRides(
        rides=kept,
        measured=kept["energy_kwh"].to_numpy(np.float64),
        predicted={label: energy[known] for label, energy in predictions.items()},
        clusters=assign_vehicle_days(kept),
        read=len(rides),
        left_out=left_out,
        models=models,
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
    energy = model.predict_energy(rides)
    if not np.isfinite(energy).any():
        unknown = [name for name in model.needs if name in rides and rides[name].isna().all()]
        reason = f": column {unknown[0]!r} is unknown in all of them" if unknown else ""
        raise ModelError(
            f"model {label} predicts none of {len(rides):,} rides{reason}: give a model that does not read it"
        )
    return energy


def list_notes(compared: ComparedRides) -> list[str]:
    """Return notes on what the models were fitted to and what the rides lack, and on implausible coefficients."""
    rides, models = compared.rides, compared.models
    notes = [
        f"{label}: {line}"
        for label, model in models.items()
        for line in describe_implausible(model) + describe_limited(model)
    ]
    for label, model in models.items():
        if (trained := model.training) is not None:
            alike = rides["vehicle_model"].isin(list(trained.vehicle_models))
            inside = alike & rides["date"].between(trained.first_date, trained.last_date)
            if n := int((~alike).sum()):
                kinds = ", ".join(trained.vehicle_models)
                notes.append(
                    f"{label} was fitted to {kinds}; {n:,} of {len(rides):,} rides are of other vehicle models"
                )
            if n := int(inside.sum()):
                notes.append(
                    f"{label} was fitted to rides from {trained.first_date} to {trained.last_date}; {n:,} of these "
                    "may be among them, and its error on other rides is larger: `socast evaluate` measures it"
                )
    if compared.clusters.max() == 0:
        notes.append(f"{format_count(len(rides), 'ride')} of one car on one day: too few for intervals")
    if "driver_id" not in rides or rides["driver_id"].isna().all():
        notes.append("drivers are unknown: errors are shown by vehicle, not by driver")
    counts = {label: model.count_limited(rides, compared.predicted[label]) for label, model in models.items()}
    notes += [f"{label}: {word_limited(count, len(rides))}" for label, count in counts.items() if count]
    return notes


def compare_predictions(compared: ComparedRides, word_command: Callable[[str, str], str] = lambda *_: "") -> Comparison:
    """Return how predictions compare with measured energies.

    Parameters
    ----------
    word_command : callable
        Function of a model and a ride that returns the command that traces the ride.
    """
    return Comparison(
        about=describe_rides(compared),
        models={
            label: ComparedModel(
                **msgspec.structs.asdict(compute_errors(compared, energy)),
                by=compute_errors_by_condition(compared, energy),
                worst=find_worst_rides(compared, energy, partial(word_command, label)),
            )
            for label, energy in compared.predicted.items()
        },
        pairs=compare_pairs(compared),
        rides=RideEnergies(
            key=compared.keys,
            vehicle_model=compared.rides["vehicle_model"].tolist(),
            measured_kwh=compared.measured.tolist(),
            predicted_kwh={label: energy.tolist() for label, energy in compared.predicted.items()},
        ),
        notes=list_notes(compared),
    )


def describe_rides(compared: ComparedRides) -> RideSample:
    """Return which rides were compared."""
    rides = compared.rides
    distance = rides["distance_km"].to_numpy(np.float64)
    return RideSample(
        read=compared.read,
        rides=len(rides),
        left_out=compared.left_out,
        vehicles=int(rides["vehicle_id"].nunique()),
        vehicle_days=len(np.unique(compared.clusters)),
        vehicle_models=sorted(rides["vehicle_model"].unique()),
        first_date=str(rides["date"].min()),
        last_date=str(rides["date"].max()),
        measured=compute_instrument_shares(rides),
        noise_floor_kwh=compared.noise_floor,
        below_least=compute_share_below_least(compared.measured),
        consumption_kwh=hold_estimate(compute_clustered_mean(compared.measured, compared.clusters)),
        per_100km_kwh=hold_estimate(compute_clustered_ratio(100.0 * compared.measured, distance, compared.clusters)),
    )


def compute_errors(compared: ComparedRides, predicted: Floats) -> PredictionErrors:
    """Return the errors of predictions. [kWh]"""
    error = predicted - compared.measured
    off = compute_clustered_mean(error, compared.clusters)
    errors = compute_relative_figures(compared.measured, predicted, compared.clusters, compared.noise_floor)
    return PredictionErrors(
        rides=len(error),
        bias_kwh=hold_estimate(off),
        rmse_kwh=scores.compute_rmse(compared.measured, predicted),
        relative=errors.wmape.value,
        relative_bias=_divide_by_mean(off.value, compared.measured),
        within=scores.compute_band_shares(compared.measured, predicted),
        **msgspec.structs.asdict(errors),
    )


def _divide_by_mean(energy: float, measured: Floats) -> float | None:
    """Return an energy as a share of mean consumption, None where that is not positive."""
    used = float(np.mean(measured))
    return energy / used if used > 0.0 else None


def compute_errors_by_condition(compared: ComparedRides, predicted: Floats) -> dict[str, list[ConditionBin]]:
    """Return the errors in each bin of each condition, with false-discovery rates over all bins.

    Units: predicted [kWh].
    """
    error = predicted - compared.measured
    bins = list_bins(compared.rides)
    biases = [compute_clustered_mean(error[rows], compared.clusters[rows]) for *_, rows in bins]
    rates = multiple_testing.adjust_false_discovery(np.array([off.p for off in biases])).tolist()
    made: dict[str, list[ConditionBin]] = {}
    for (name, label, rows), off, q in zip(bins, biases, rates, strict=True):
        measured, clusters, size = compared.measured[rows], compared.clusters[rows], np.abs(error[rows])
        mae = float(np.mean(size))
        made.setdefault(name, []).append(
            ConditionBin(
                bin=label,
                n=len(rows),
                vehicle_days=len(np.unique(clusters)),
                bias_kwh=hold_estimate(off),
                mae_kwh=mae,
                mae_ci95_kwh=compute_clustered_mean(size, clusters).ci95,
                relative=_divide_by_mean(mae, measured),
                relative_bias=_divide_by_mean(off.value, measured),
                q=q,
            )
        )
    return made


def compare_pairs(compared: ComparedRides) -> list[PairDifference]:
    """Return the difference of mean absolute error of each pair of models, on the same rides."""
    error = {label: np.abs(energy - compared.measured) for label, energy in compared.predicted.items()}
    apart = {
        (a, b): compute_clustered_mean(error[a] - error[b], compared.clusters)
        for a, b in multiple_testing.list_pairs(list(error))
    }
    adjusted = multiple_testing.adjust_differences(apart)
    return [
        PairDifference(a=a, b=b, difference_kwh=hold_estimate(off), p=off.p, p_holm=adjusted[a, b])
        for (a, b), off in apart.items()
    ]


def find_worst_rides(
    compared: ComparedRides, predicted: Floats, word_command: Callable[[str], str] = lambda _: ""
) -> WorstRides:
    """Return the rides of largest absolute error and of largest relative error.

    Units: predicted [kWh].

    Notes
    -----
    A relative error is only given of rides whose energy is known to within `MOST_RELATIVE_SD`, because a ride downhill
    may use almost no energy. The relative list holds only these rides.
    """
    rides, error, size = compared.rides, predicted - compared.measured, np.abs(compared.measured)
    known = np.nan_to_num(get_numbers_if_present(rides, "energy_sd_kwh", 0.0)) <= MOST_RELATIVE_SD * size
    relative = np.divide(error, size, out=np.full(len(error), np.nan), where=known & (size > 0.0))
    keys = compared.keys

    def describe_row(row: int) -> WorstRide:
        properties: dict[str, Any] = {n: rides[n].iloc[row] if n in rides else None for n in RIDE_PROPERTIES}
        return WorstRide(
            ride=keys[row],
            **properties,
            measured_kwh=compared.measured[row],
            predicted_kwh=predicted[row],
            error_kwh=error[row],
            relative=relative[row],
            command=word_command(keys[row]),
        )

    def first(values: Floats) -> list[WorstRide]:
        order = np.argsort(-np.abs(values), kind="stable")  # NaN last
        return [describe_row(row) for row in order[:MOST_WORST_RIDES].tolist() if not np.isnan(values[row])]

    return WorstRides(absolute=first(error), relative=first(relative))
