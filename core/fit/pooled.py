"""Fit recipes beyond the paper: hybrids that are pooled across vehicle models and cars, with trees for the residual.

The terms are physical terms by sign, because regeneration downhill does not return the whole energy spent uphill. They
include phenomena that the models of the paper omit: a cabin that has cooled down while parked, the sun, doors, a full
or frozen battery. They also include the odometer.

The figures of the car from the catalogue scale the terms, so that their coefficients apply to an unseen vehicle model.
One of these figures, `accessory_scale`, is an estimate, for some cars from their own drives.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.errors import ModelError
from socast.core.fit.block_sums import build_design, limit_to_one_thread
from socast.core.fit.calibration import (
    HeldOutErrors,
    calibrate_interval,
    widen_for_unseen_cars,
)
from socast.core.fit.fitting import fit_terms
from socast.core.fit.partial_pooling import (
    NormalEquations,
    Prior,
    compute_common_mean,
    compute_early_posterior,
    compute_posterior,
    estimate_car_factors,
    estimate_noise,
    estimate_prior,
    sum_normal_equations,
)
from socast.core.fit.records import FitStep
from socast.core.fit.ride_blocks import ENERGY, RideFrame, get_names, get_numbers, group_by_name, select_trainable
from socast.core.fit.trees import fit_trees
from socast.core.models import ANY, VEHICLE, VEHICLE_MODEL, Fit, LinearModel, Term, stamp
from socast.core.models.features import Columns, derive_coefficient_unit, list_raw_columns
from socast.core.models.interval import PredictionInterval, compute_scale_terms
from socast.core.models.trees import Trees
from socast.core.stats.splits import deal_folds

SIZE_COLUMN: Final = "size_kwh"
EFFICIENCY: Final = 1.2
"""Energy out of the battery over energy at the wheels. Estimated: 83 % from battery to wheel."""
REGENERATION: Final = 0.7
"""Energy into the battery over energy returned at the wheels. Estimated: 83 % again, less some friction braking."""
LEAST_TREE_RIDES: Final = 400
"""Fewest rides of a vehicle model for its own trees."""
LEAST_POOLED_RIDES: Final = 10
"""Fewest rides for a fit; `adapt` applies fewer rides to an existing model."""
_FOLDS: Final = 3
"""Number of parts of the rides that the calibration of the interval holds out in turn."""


class SharedTerm(NamedTuple):
    """Describe a term whose coefficient is partially pooled across vehicle models.

    Parameters
    ----------
    physics : float
        Physical value of the coefficient, 0 where physics does not determine it.
    climate : bool
        Whether the coefficient shares the factor of the climate; otherwise it shares that of the drive.
    """

    name: str
    columns: tuple[str, ...]
    physics: float = 0.0
    climate: bool = False


_ROLLING: Final = ("effect_rolling", "rolling_resistance")
_COLD: Final = ("heating_need_k", "accessory_scale")

SHARED_TERMS: Final = (
    SharedTerm("rolling", _ROLLING, EFFICIENCY),
    SharedTerm("rolling, by temperature", (*_ROLLING, "ambient_c")),
    SharedTerm("rolling, by rain or snow", (*_ROLLING, "precipitation_mm_h")),
    SharedTerm("rolling, on winter tyres", (*_ROLLING, "winter")),
    SharedTerm("rolling, by speed squared", (*_ROLLING, "average_speed_kmh", "average_speed_kmh")),
    SharedTerm("climbing up", ("effect_climbing_up",), EFFICIENCY),
    SharedTerm("climbing down", ("effect_climbing_down",), REGENERATION),
    SharedTerm("climbing down, by cold", ("effect_climbing_down", "heating_need_k")),
    SharedTerm("climbing down, by battery's frost", ("effect_climbing_down", "battery_frost_k")),
    SharedTerm("speeding up", ("effect_inertia_positive",), EFFICIENCY),
    SharedTerm("slowing", ("effect_inertia_negative",), REGENERATION),
    SharedTerm("slowing, by cold", ("effect_inertia_negative", "heating_need_k")),
    SharedTerm("slowing, by battery's frost", ("effect_inertia_negative", "battery_frost_k")),
    SharedTerm("slowing, by battery's fullness", ("effect_inertia_negative", "battery_fullness_pct")),
    SharedTerm("drag", ("effect_aero_drag", "drag_area_m2"), EFFICIENCY / 2.0),
    SharedTerm("drag in the wind", ("effect_aero_drag_wind", "drag_area_m2"), EFFICIENCY / 2.0),
    SharedTerm("drive, by odometer", ("basic_kwh", "odometer_km")),
    SharedTerm("accessories", ("effect_accessories",), 1.0, climate=True),
    SharedTerm("constant power", ("effect_auxiliary",), climate=True),
    SharedTerm("heating", ("duration_s", *_COLD), climate=True),
    SharedTerm("heating in deep cold", ("duration_s", "deep_cold_k", "accessory_scale"), climate=True),
    SharedTerm("cooling", ("duration_s", "cooling_need_k", "accessory_scale"), climate=True),
    SharedTerm("warming up after parking", (*_COLD, "warmed", "soaked"), climate=True),
    SharedTerm("doors at stops", ("stops", *_COLD), climate=True),
    SharedTerm("sun", ("duration_s", "sun", "accessory_scale"), climate=True),
    SharedTerm("heating of the battery", ("duration_s", "battery_frost_k", "nominal_capacity_kwh"), climate=True),
    SharedTerm("constant power, by odometer", ("effect_auxiliary", "odometer_km"), climate=True),
    SharedTerm("heating, by odometer", ("duration_s", *_COLD, "odometer_km"), climate=True),
)
"""Terms of the pooled recipes.

Drag appears in still and in moving air, because the wind at a weather station differs from the wind in the street.
Temperatures and the odometer represent the yield of the battery, and the tyres.
"""

TREE_FEATURES: Final = (
    "ambient_c",
    "average_speed_kmh",
    "duration_s",
    "parked_s",
    "soc_start_pct",
    "time_since_charge_s",
    "odometer_km",
    "battery_temperature_c",
    "precipitation_mm_h",
    "wind_speed_kmh",
    "occupants",
    "winter",
    "sun",
    "stops_per_km",
    "uphill_per_km",
    "downhill_per_km",
    "speeding_up_per_km",
    "drag_per_km",
    "wind_drag_per_km",
)
"""Features of the trees: conditions of a ride, not its length, so that the trees also hold in the middle of a ride."""


class _RideGroup(NamedTuple):
    """Hold the rides of one vehicle model, as its fit uses them; all fields are (n, ...)."""

    design: Floats
    asked: Floats
    energy: Floats
    size: Floats
    vehicles: NDArray[np.object_]
    scale_terms: Floats
    distance: Floats

    def sums(self) -> NormalEquations:
        """Return the normal equations of the rides."""
        return sum_normal_equations(self.design, self.energy, self.size)

    def rows(self, which: NDArray[np.bool_]) -> "_RideGroup":
        """Return some of the rides."""
        columns: Any = (column[which] for column in self)
        return _RideGroup(*columns)

    def held(self, error: Floats) -> HeldOutErrors:
        """Return errors together with the columns on which their scale depends."""
        return HeldOutErrors(error, self.scale_terms, self.distance)


class _VehicleModelFit(NamedTuple):
    """Hold the fitted parts of one vehicle model."""

    prior: Prior
    coefficients: Floats
    covariance: Floats
    cars: dict[str, float]
    trees: Trees | None

    def predict(self, rides: _RideGroup) -> Floats:
        """Return the energy of rides. [kWh]"""
        total = rides.design @ self.coefficients
        if self.trees is not None:
            own = [TREE_FEATURES.index(name) for name in self.trees.features]
            total = total + self.trees.sum_leaves(rides.asked[:, own]) * rides.size
        return total * _factors(self.cars, rides.vehicles)


@dataclass(frozen=True)
class PooledRecipe:
    """Fit coefficients pooled across vehicle models, and adapt them to a new vehicle model from few rides.

    In its models the covariance of the fit `*` is the spread between vehicle models: that of a new one about the mean.

    Parameters
    ----------
    name, title : str
        Name in code and files, and title for people.
    cars : bool
        Whether each car has its own factor.
    free : bool
        False: `socast.core.fit.fitting` leaves the coefficients at 1, as this class fits them itself.
    """

    name: str
    title: str
    shared: tuple[SharedTerm, ...] = SHARED_TERMS
    cars: bool = False
    trees: bool = False
    note: str = ""
    free: bool = False

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return the terms of the model."""
        return tuple(Term(name=s.name, columns=s.columns, unit=derive_coefficient_unit(s.columns)) for s in self.shared)

    def fit(self, rides: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
        """Return a model with an interval, fitted to the rides of a table that are fit for training.

        Parameters
        ----------
        covariance : bool
            Whether to calibrate an interval; a fit without it is faster. The model has a covariance in any case.

        Returns
        -------
        LinearModel
            Model with a fit for each vehicle model, and the fit `*` for unseen ones.
        """
        _check(self.name, rides, _raw(self.terms, TREE_FEATURES))
        with limit_to_one_thread():
            start = fit_terms(self, RideFrame(rides), covariance=False)
            groups = _group_by_vehicle_model(start, rides)
            _check_varies(self.name, groups)
            sums = {key: group.sums() for key, group in groups.items()}
            prior = self._prior(sums)
            learned = {key: self._learn(prior, group) for key, group in groups.items()}
            interval = self._interval(groups, sums) if covariance else None
            fits, errors = {ANY: _fit(start.fits[ANY], prior, prior.mean, prior.covariance)}, {}
            for key, own in learned.items():
                left = groups[key].energy - own.predict(groups[key])
                errors[key] = float(np.abs(left).mean())
                if key != ANY:
                    fits[key] = _fit(
                        start.fits.get(key, start.fits[ANY]),
                        own.prior,
                        own.coefficients,
                        own.covariance,
                        rides=len(left),
                        residual_sd_kwh=float(np.sqrt(np.mean(left**2))),
                    )
        fitted = msgspec.structs.replace(
            start,
            fits=fits,
            history=(FitStep(action="fit", recipe=self.name, mae_in_sample_kwh=errors).to_json(),),
            cars={car: factor for own in learned.values() for car, factor in own.cars.items()},
            correction={key: own.trees for key, own in learned.items() if own.trees is not None} or None,
            interval=interval,
        )
        return stamp(fitted)

    def adapt(self, model: LinearModel, rides: pd.DataFrame) -> LinearModel:
        """Return a model adapted to some rides, see the function `adapt`."""
        return adapt(model, rides)

    def _prior(self, sums: dict[str, NormalEquations]) -> Prior:
        """Return the prior that the vehicle models have in common."""
        climate = np.array([s.climate for s in self.shared])
        sums = {key: own for key, own in sums.items() if own.rides}
        return estimate_prior(sums, np.array([s.physics for s in self.shared]), (~climate, climate))

    def _learn(self, prior: Prior, rides: _RideGroup) -> _VehicleModelFit:
        """Return the fit of one vehicle model, from its rides."""
        sums = rides.sums()
        if sums.rides >= 2 * len(prior.mean):  # enough to estimate the noise of its own rides
            scale = np.sqrt(np.maximum(np.diag(sums.gram) / sums.weight, 1e-12))
            prior = prior._replace(noise=estimate_noise(sums, prior.mean, scale))
        coefficients, covariance = compute_posterior(prior, sums)
        predicted = rides.design @ coefficients
        cars: dict[str, float] = {}
        if self.cars:
            cars = estimate_car_factors(rides.vehicles, predicted, rides.energy, rides.size, prior.noise)
        trees = None
        if self.trees and len(rides.energy) >= LEAST_TREE_RIDES:
            left = rides.energy / _factors(cars, rides.vehicles) - predicted
            trees = fit_trees(rides.asked, TREE_FEATURES, left / rides.size, rides.size, SIZE_COLUMN)
        return _VehicleModelFit(prior, coefficients, covariance, cars, trees)

    def _interval(self, groups: dict[str, _RideGroup], sums: dict[str, NormalEquations]) -> PredictionInterval | None:
        """Return the interval that covers the errors on held-out rides and on held-out vehicle models."""
        seen = self._held_out(groups, {key: deal_folds(len(group.energy), _FOLDS, 0) for key, group in groups.items()})
        unseen = {}
        for key, group in groups.items():
            if others := [other for name, other in sums.items() if name != key]:
                mean = compute_common_mean(others, np.array([s.physics for s in self.shared]))
                unseen[key] = group.held(group.energy - group.design @ mean)
        interval = calibrate_interval(seen, unseen)
        if not (self.cars or self.trees):
            return interval
        folds = {}
        for key, group in groups.items():
            cars, car = np.unique(group.vehicles.astype(str), return_inverse=True)
            folds[key] = deal_folds(len(cars), _FOLDS, 0)[car]
        held = self._held_out(groups, {key: fold for key, fold in folds.items() if fold.max() > 0})
        return widen_for_unseen_cars(interval, held, [car for group in groups.values() for car in group.vehicles])

    def _held_out(self, groups: dict[str, _RideGroup], part: dict[str, Ints]) -> dict[str, HeldOutErrors]:
        """Return the errors of rides under fits without their fold, for the vehicle models that have folds."""
        errors = {key: np.full(len(fold), np.nan) for key, fold in part.items()}
        for i in range(_FOLDS):
            kept = {key: group.rows(part[key] != i) if key in part else group for key, group in groups.items()}
            prior = self._prior({key: own.sums() for key, own in kept.items()})
            for key, fold in part.items():
                if (fold == i).any():
                    back = groups[key].rows(fold == i)
                    errors[key][fold == i] = back.energy - self._learn(prior, kept[key]).predict(back)
        return {key: groups[key].held(error) for key, error in errors.items()}


def adapt(model: LinearModel, rides: pd.DataFrame) -> LinearModel:
    """Return a model adapted to rides of one or more vehicle models, known to the model or not.

    The fit of a vehicle model becomes the posterior, given its rides. The prior is the existing fit; for a new vehicle
    model it is the common mean with the spread between vehicle models. All other parts of the model stay unchanged.

    Parameters
    ----------
    rides : DataFrame
        Ride table. Only the rides that are fit for training count; without any, the model stays as it is.
    """
    general = model.fits.get(ANY)
    if general is None or general.covariance is None or general.noise_kwh is None:
        raise ModelError(
            f"model {model.name} of recipe {model.recipe} does not tell how vehicle models differ: "
            "fit one of a recipe that pools"
        )
    _check(model.name, rides, _raw(model.terms))
    good, _ = select_trainable(rides, [*_raw(model.terms), ENERGY])
    if not len(good):
        return model
    fits, told = dict(model.fits), {}
    for key, rows in group_by_name(get_names(good, VEHICLE_MODEL)).items():
        if not key:
            continue
        known = fits.get(key, general)
        group = _group(model.terms, good.iloc[rows], known.fills)
        energy = group.energy / _factors(model.cars, group.vehicles)  # what the terms have to explain
        if trees := model.correction and (model.correction.get(key) or model.correction.get(ANY)):
            energy -= trees.predict(Columns(good.iloc[rows]))
        sums = group._replace(energy=energy).sums()
        noise = known.noise_kwh or general.noise_kwh
        prior = Prior(np.array(known.coefficients), np.array(known.covariance or general.covariance), noise)
        rides_before = known.rides if key in model.fits else 0
        with limit_to_one_thread():
            fits[key] = _fit(known, prior, *compute_early_posterior(prior, sums), rides=rides_before + len(rows))
        told[key] = len(rows)
    history = (*model.history, FitStep(action="adapt", rides=told).to_json())
    return stamp(msgspec.structs.replace(model, fits=fits, history=history))


def _raw(terms: tuple[Term, ...], asked: tuple[str, ...] = ()) -> list[str]:
    """Return the columns of the ride table behind the terms, the size of a ride and the features of the trees."""
    read = [column for term in terms for column in term.columns]
    return list(
        dict.fromkeys(raw for column in (*read, SIZE_COLUMN, "distance_km", *asked) for raw in list_raw_columns(column))
    )


def _check(name: str, rides: pd.DataFrame, columns: list[str]) -> None:
    """Raise ModelError if the table lacks a column."""
    if missing := [column for column in (*columns, ENERGY) if column not in rides]:
        raise ModelError(f"model {name}: column {missing[0]!r} is missing in the rides: make the tables again")


def _check_varies(name: str, groups: dict[str, _RideGroup]) -> None:
    """Raise ModelError if there are too few rides, or if their energy does not vary."""
    energy = np.concatenate([group.energy for group in groups.values()])
    if len(energy) < LEAST_POOLED_RIDES:
        raise ModelError(
            f"recipe {name}: {len(energy)} rides to fit to, and it needs {LEAST_POOLED_RIDES}: give more rides, or "
            "`--adapt` a model to them"
        )
    if not np.ptp(energy) > 0.0:
        raise ModelError(
            f"recipe {name}: {ENERGY} is {energy[0]:g} in all {len(energy):,} rides: nothing can be learned"
        )


def _group_by_vehicle_model(model: LinearModel, rides: pd.DataFrame) -> dict[str, _RideGroup]:
    """Return the trainable rides, by vehicle model."""
    good, _ = select_trainable(rides, [*_raw(model.terms, TREE_FEATURES), ENERGY])
    return {
        key or ANY: _group(model.terms, good.iloc[rows], model.fits.get(key, model.fits[ANY]).fills, TREE_FEATURES)
        for key, rows in group_by_name(get_names(good, VEHICLE_MODEL)).items()
    }


def _group(
    terms: tuple[Term, ...], rides: pd.DataFrame, fills: dict[str, float], asked: tuple[str, ...] = ()
) -> _RideGroup:
    """Return rides as a fit uses them; unknown values stay NaN in the features of the trees."""
    filled, plain = Columns(rides, fills), Columns(rides)
    return _RideGroup(
        design=build_design(terms, filled, len(rides)),
        asked=np.column_stack([np.empty((len(rides), 0)), *(plain[name] for name in asked)]),
        energy=get_numbers(rides, ENERGY),
        size=filled[SIZE_COLUMN],
        vehicles=np.array(get_names(rides, VEHICLE), dtype=object),
        scale_terms=compute_scale_terms(filled),
        distance=filled["distance_km"],
    )


def _factors(cars: dict[str, float], vehicles: NDArray[np.object_]) -> Floats:
    """Return the factor of the car of each ride, 1 where the car has none."""
    return np.array([cars.get(vehicle, 1.0) for vehicle in vehicles])


def _fit(start: Fit, prior: Prior, mean: Floats, covariance: Floats, **changes: Any) -> Fit:
    """Return a fit as a model file stores it."""
    found = msgspec.structs.replace(
        start,
        coefficients=tuple(mean.tolist()),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        noise_kwh=prior.noise,
    )
    return msgspec.structs.replace(found, **changes)


POOLED_RECIPES: Final = (
    PooledRecipe(
        "pooled_hybrid",
        "Pooled Hybrid Model",
        note="shrunk to what vehicle models share and to physics; for vehicle models never seen",
    ),
    PooledRecipe(
        "boosted_hybrid",
        "Boosted Hybrid Model",
        cars=True,
        trees=True,
        note="the pooled one with a factor of each car, and boosted trees for what is left",
    ),
)
"""Recipes beyond the paper, for selection by measurement."""
