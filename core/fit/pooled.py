"""Recipes past the paper: hybrids that are pooled across vehicle models and cars, with trees for what is left.

The terms are physical ones by sign (what is paid uphill does not come back downhill), what the paper's models do not
tell of (a cabin that has cooled down while parked, the sun, doors, a full or frozen battery), and the odometer. They
are scaled by the catalogue's figures of the car, so that their coefficients carry over to a vehicle model never seen.
Of those `accessory_scale` is an estimate, for some cars from drives of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from core.batch import Floats
from core.errors import ModelError
from core.fit.calibration import HeldOutErrors, assign_folds, calibrate_interval
from core.fit.fitting import build_design, fit_terms, limit_to_one_thread
from core.fit.partial_pooling import (
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
from core.fit.ride_blocks import ENERGY, RideFrame, get_names, get_numbers, select_trainable
from core.fit.trees import fit_trees
from core.models import ANY, VEHICLE, VEHICLE_MODEL, Fit, LinearModel, Term, stamp
from core.models.features import Columns, derive_coefficient_unit, list_raw_columns
from core.models.interval import PredictionInterval, compute_scale_terms
from core.models.trees import Trees

SIZE_COLUMN: Final = "size_kwh"
EFFICIENCY: Final = 1.2
"""Energy out of the battery over energy at the wheels. Estimated: 83 % from battery to wheel."""
REGENERATION: Final = 0.7
"""Energy into the battery over energy given back at the wheels. Estimated: 83 % again, and some friction braking."""
LEAST_TREE_RIDES: Final = 400
"""Rides of a vehicle model for trees of its own."""
LEAST_POOLED_RIDES: Final = 10
"""Rides that a fit needs; fewer can be told to a model that there is, with `adapt`."""
_FOLDS: Final = 3
"""Parts of the rides that are kept back in turn, for the interval."""


class SharedTerm(NamedTuple):
    """A term whose coefficient vehicle models share in part.

    Parameters
    ----------
    name : str
    columns : tuple of str
    physics : float
        What the coefficient is by physics, 0 where that does not tell.
    climate : bool
        It shares the factor of the climate, else that of the drive.
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
"""Terms of the pooled recipes. Drag is there in still and in moving air: the wind of a weather station is not that of
the street. Temperatures and the odometer stand for what a battery yields, and for tyres."""

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
"""What trees may ask about: conditions of a ride, not its length, so that they hold in the middle of one too."""


class _RideGroup(NamedTuple):
    """Rides of one vehicle model, as its fit sees them; all (n, ...)."""

    design: Floats
    asked: Floats
    energy: Floats
    size: Floats
    vehicles: NDArray[np.object_]
    scale_terms: Floats
    distance: Floats

    def sums(self) -> NormalEquations:
        """Return their normal equations."""
        return sum_normal_equations(self.design, self.energy, self.size)

    def rows(self, which: NDArray[np.bool_]) -> "_RideGroup":
        """Return some of the rides."""
        columns: Any = (column[which] for column in self)
        return _RideGroup(*columns)

    def held(self, error: Floats) -> HeldOutErrors:
        """Return errors with what their scale depends on."""
        return HeldOutErrors(error, self.scale_terms, self.distance)


class _VehicleModelFit(NamedTuple):
    """What was learned of one vehicle model."""

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
    """A recipe whose coefficients are pooled across vehicle models, and that can learn a new one from few rides.

    In its models the covariance of the fit `*` is the spread between vehicle models: that of a new one about the mean.

    Parameters
    ----------
    name, title : str
    shared : tuple of Shared
    cars : bool
        Each car has a factor of its own.
    trees : bool
        Boosted trees correct what is left.
    note : str
        What a reader should know.
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
        """Terms of the model."""
        return tuple(Term(name=s.name, columns=s.columns, unit=derive_coefficient_unit(s.columns)) for s in self.shared)

    def fit(self, rides: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
        """Return a model fitted to the rides of a table that are fit for training, with an interval.

        Parameters
        ----------
        rides : DataFrame
            A ride table.
        covariance : bool
            Calibrate an interval too; without, a fit is faster. The covariance is there in any case.

        Raises
        ------
        ModelError
            Where a column is missing, or no ride can be trained on.
        """
        _check(self.name, rides, _raw(self.terms, TREE_FEATURES))
        with limit_to_one_thread():
            return stamp(self._fitted(rides, covariance=covariance))

    def _fitted(self, rides: pd.DataFrame, *, covariance: bool) -> LinearModel:
        """Return the model, see `fit`."""
        start = fit_terms(self, RideFrame(rides), covariance=False)
        groups = dict(_groups(start, rides))
        _check_varies(self.name, groups)
        sums = {key: group.sums() for key, group in groups.items()}
        prior = self._prior(sums)
        fits = {ANY: _fit(start.fits[ANY], prior, prior.mean, prior.covariance)}
        learned = {key: self._learn(prior, group) for key, group in groups.items()}
        errors = {}
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
        return msgspec.structs.replace(
            start,
            fits=fits,
            history=({"action": "fit", "recipe": self.name, "mae_in_sample_kwh": errors},),
            cars={car: factor for own in learned.values() for car, factor in own.cars.items()},
            correction={key: own.trees for key, own in learned.items() if own.trees is not None} or None,
            interval=self._interval(groups, sums) if covariance else None,
        )

    def adapt(self, model: LinearModel, rides: pd.DataFrame) -> LinearModel:
        """Return a model that was told of some rides, see `adapt`."""
        return adapt(model, rides)

    def _prior(self, sums: dict[str, NormalEquations]) -> Prior:
        """Return what the vehicle models have in common."""
        climate = np.array([s.climate for s in self.shared])
        sums = {key: own for key, own in sums.items() if own.rides}
        return estimate_prior(sums, np.array([s.physics for s in self.shared]), (~climate, climate))

    def _learn(self, prior: Prior, rides: _RideGroup) -> _VehicleModelFit:
        """Return what rides of one vehicle model tell of it."""
        own = _own(prior, rides.sums())
        coefficients, covariance = compute_posterior(own, rides.sums())
        predicted = rides.design @ coefficients
        cars: dict[str, float] = {}
        if self.cars:
            cars = estimate_car_factors(rides.vehicles, predicted, rides.energy, rides.size, own.noise)
        trees = None
        if self.trees and len(rides.energy) >= LEAST_TREE_RIDES:
            left = rides.energy / _factors(cars, rides.vehicles) - predicted
            trees = fit_trees(rides.asked, TREE_FEATURES, left / rides.size, rides.size, SIZE_COLUMN)
        return _VehicleModelFit(own, coefficients, covariance, cars, trees)

    def _interval(self, groups: dict[str, _RideGroup], sums: dict[str, NormalEquations]) -> PredictionInterval | None:
        """Return the interval that errors call for: on rides kept back, and on vehicle models kept back."""
        errors = {key: np.empty(len(group.energy)) for key, group in groups.items()}
        part = {key: assign_folds(len(group.energy), _FOLDS) for key, group in groups.items()}
        for i in range(_FOLDS):
            kept = {key: group.rows(part[key] != i) for key, group in groups.items()}
            prior = self._prior({key: own.sums() for key, own in kept.items()})
            for key, group in groups.items():
                back = group.rows(part[key] == i)
                errors[key][part[key] == i] = back.energy - self._learn(prior, kept[key]).predict(back)
        seen = {key: group.held(errors[key]) for key, group in groups.items()}
        unseen = {}
        for key, group in groups.items():
            others = [other for name, other in sums.items() if name != key]
            if others:
                mean = compute_common_mean(others, np.array([s.physics for s in self.shared]))
                unseen[key] = group.held(group.energy - group.design @ mean)
        return calibrate_interval(seen, unseen)


def adapt(model: LinearModel, rides: pd.DataFrame) -> LinearModel:
    """Return a model that was told of some rides of a vehicle model, known to it or not.

    What the model knew (of a new vehicle model: what all have in common, and how much they differ) is the prior, the
    rides are the evidence, and the fit of their vehicle model becomes the posterior. Everything else stays.

    Parameters
    ----------
    model : LinearModel
        Of a recipe that pools.
    rides : DataFrame
        A ride table; of its rides those that are fit for training. None at all leaves the model as it is.

    Raises
    ------
    ModelError
        Where the model cannot tell how sure it is, or a column is missing.
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
    kinds = np.array(get_names(good, VEHICLE_MODEL), dtype=object)
    for key in sorted(set(kinds) - {""}):
        known = fits.get(key, general)
        group = _linear_part(model, key, good.iloc[np.flatnonzero(kinds == key)], known.fills)
        noise = known.noise_kwh or general.noise_kwh
        prior = Prior(np.array(known.coefficients), np.array(known.covariance or general.covariance), noise)
        rides_before = known.rides if key in model.fits else 0
        with limit_to_one_thread():
            fits[key] = _fit(
                known, prior, *compute_early_posterior(prior, group.sums()), rides=rides_before + len(group.energy)
            )
        told[key] = len(group.energy)
    history = (*model.history, {"action": "adapt", "rides": told})
    return stamp(msgspec.structs.replace(model, fits=fits, history=history))


def _linear_part(model: LinearModel, key: str, rides: pd.DataFrame, fills: dict[str, float]) -> _RideGroup:
    """Return rides of a vehicle model, with the energy that the model's terms have to tell: without trees and cars."""
    group = _group(model.terms, rides, fills)
    energy = group.energy / _factors(model.cars, group.vehicles)
    trees = model.correction and (model.correction.get(key) or model.correction.get(ANY))
    return group._replace(energy=energy - trees.predict(Columns(rides)) if trees else energy)


def _raw(terms: tuple[Term, ...], asked: tuple[str, ...] = ()) -> list[str]:
    """Return the columns of the ride table that terms, the size of a ride and what is asked are made of."""
    read = [column for term in terms for column in term.columns]
    return list(
        dict.fromkeys(raw for column in (*read, SIZE_COLUMN, "distance_km", *asked) for raw in list_raw_columns(column))
    )


def _check(name: str, rides: pd.DataFrame, columns: list[str]) -> None:
    """Refuse a table that lacks a column."""
    if missing := [column for column in (*columns, ENERGY) if column not in rides]:
        raise ModelError(f"model {name}: column {missing[0]!r} is missing in the rides: make the tables anew")


def _check_varies(name: str, groups: dict[str, _RideGroup]) -> None:
    """Refuse rides that are too few, or of which nothing can be learned."""
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


def _groups(model: LinearModel, rides: pd.DataFrame) -> Iterator[tuple[str, _RideGroup]]:
    """Give the rides that can be trained on, by vehicle model."""
    good, _ = select_trainable(rides, [*_raw(model.terms, TREE_FEATURES), ENERGY])
    kinds = np.array(get_names(good, VEHICLE_MODEL), dtype=object)
    for key in sorted(set(kinds)):
        fills = model.fits[key if key in model.fits else ANY].fills
        yield (key or ANY, _group(model.terms, good.iloc[np.flatnonzero(kinds == key)], fills, TREE_FEATURES))


def _group(
    terms: tuple[Term, ...], rides: pd.DataFrame, fills: dict[str, float], asked: tuple[str, ...] = ()
) -> _RideGroup:
    """Return some rides as a fit sees them; trees see what is unknown as such."""
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
    """Return the factor of each ride's car, 1 where it has none."""
    return np.array([cars.get(vehicle, 1.0) for vehicle in vehicles])


def _own(prior: Prior, sums: NormalEquations) -> Prior:
    """Return the prior with the noise of a vehicle model's own rides, where they are enough to tell it."""
    if sums.rides < 2 * len(prior.mean):
        return prior
    scale = np.sqrt(np.maximum(np.diag(sums.gram) / sums.weight, 1e-12))
    return prior._replace(noise=estimate_noise(sums, prior.mean, scale))


def _fit(start: Fit, prior: Prior, mean: Floats, covariance: Floats, **changes: Any) -> Fit:
    """Return what a model file holds of a fit."""
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
"""Recipes past the paper, to be chosen from by measurement."""
