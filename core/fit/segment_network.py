"""Fit the segment model on which the paper builds: a neural network on micro-segments, summed over the ride.

De Cauwer et al. divide drives into micro-segments, and describe each by speed, acceleration, height and weather. They
learn the energy of a micro-segment by multiple linear regression, and by a neural network for nonlinear relations. In
this module a micro-segment is a window of the window table. The model serves as a reference row of the evaluation. It
needs to know how a ride will be driven minute by minute, so it serves no forecast and has no model file.

The training target is the energy of rides, because a state of charge in steps of half a percent carries no information
about a single minute. Each window receives the energy that a linear regression on the sums of rides expects of it; sums
of windows obey the same linear relation as windows. The rest of the ride's energy is divided in proportion to the
duration of the windows. On rides with measured voltage and current, this target was at least as good as the measured
energy of each window.

References
----------
De Cauwer, Van Mierlo, Coosemans, Energies 8 (2015) 8573, DOI 10.3390/en8088573. De Cauwer, Verbeke, Coosemans, Faid,
Van Mierlo, Energies 10 (2017) 608, DOI 10.3390/en10050608.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Final

import numpy as np
import pandas as pd
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.fit.regression import Moments, solve

SEGMENT_FEATURES: Final = (
    ("duration_s",),
    ("distance_km",),
    ("average_speed_kmh",),
    ("effect_rolling", "rolling_resistance"),
    ("effect_climbing_up",),
    ("effect_climbing_down",),
    ("effect_aero_drag_wind", "drag_area_m2"),
    ("effect_inertia_positive",),
    ("effect_inertia_negative",),
    ("effect_accessories",),
    ("ambient_c",),
    ("stops",),
    ("precipitation_mm_h",),
    ("wind_speed_kmh",),
)
"""Features of a micro-segment, each a product of columns of the window table."""
HIDDEN: Final = (32,)
"""Neurons of the hidden layer."""
EPOCHS: Final = 20
BATCH: Final = 500
RATE: Final = 0.005
"""Learning rate of Adam. A smaller rate over more epochs was no better, and slower."""
MOST_WINDOWS: Final = 20_000
"""Approximate limit of windows to train a network on; beyond it, the training draws rides at random."""
LEAST_NETWORK_RIDES: Final = 50
"""Fewest rides for a network."""

Ordinals = np.ndarray[Any, np.dtype[np.int64]]


@dataclass(frozen=True)
class Network:
    """Predict the energy of micro-segments with a trained network.

    Parameters
    ----------
    mean, scale : (features,) float
        Mean and standard deviation of each feature, by which it is standardised.
    energy_mean, energy_scale : float
        Mean and standard deviation of the energy of a micro-segment. [kWh]
    """

    mean: Floats
    scale: Floats
    energy_mean: float
    energy_scale: float
    inner: MLPRegressor

    def energy(self, features: Floats) -> Floats:
        """Return the energy of micro-segments.

        Units: returns [kWh].

        Parameters
        ----------
        features : (n, features) float
            Features of the micro-segments; NaN counts as the mean.
        """
        standard = np.nan_to_num((features - self.mean) / self.scale)
        return self.inner.predict(standard) * self.energy_scale + self.energy_mean


@dataclass(frozen=True)
class Segments:
    """Hold the micro-segments of rides, those of each ride in sequence.

    Parameters
    ----------
    keys : Index of (m,) str
        Keys of the rides.
    first : (m + 1,) int64
        Position of the first micro-segment of each ride; the last entry is the number of micro-segments.
    features : (n, features) float
        Features of the micro-segments, see `SEGMENT_FEATURES`.
    duration : (n,) float
        Duration of the micro-segments. [s]
    """

    keys: pd.Index
    first: Ordinals
    features: Floats
    duration: Floats

    def of(self, rides: pd.DataFrame) -> tuple[Ordinals, Ordinals]:
        """Return the micro-segments of rides."""
        at = self.keys.get_indexer(pd.Index(rides["ride_key"]))
        known = np.flatnonzero(at >= 0)
        begin, count = self.first[at[known]], np.diff(self.first)[at[known]]
        ride = np.repeat(known, count)
        within = np.arange(len(ride)) - np.repeat(np.cumsum(count) - count, count)
        return np.repeat(begin, count) + within, ride


def build_segments(windows: pd.DataFrame) -> Segments:
    """Return the micro-segments of a window table."""
    needed = dict.fromkeys(("ride_key", "window", *(name for product in SEGMENT_FEATURES for name in product)))
    if missing := [name for name in needed if name not in windows]:
        raise ModelError(f"column {missing[0]!r} is missing in the window table: make it with `socast tables`")
    order = windows.sort_values(["ride_key", "window"], kind="stable")
    keys, first = np.unique(order["ride_key"].to_numpy(dtype=object).astype(str), return_index=True)
    columns = [order[list(product)].to_numpy(np.float64).prod(axis=1) for product in SEGMENT_FEATURES]
    return Segments(
        keys=pd.Index(keys),
        first=np.append(first, len(order)).astype(np.int64),
        features=np.column_stack(columns),
        duration=order["duration_s"].to_numpy(np.float64),
    )


@dataclass(frozen=True)
class SegmentModel:
    """Predict the energy of rides with one network per vehicle model.

    Parameters
    ----------
    segments : Segments
        Micro-segments of all rides. They include the rides to predict: this model needs to know how they were driven.
    train_other : callable
        Train the network for all other vehicle models, on all rides together. The first use calls it; most splits never
        use it.
    """

    segments: Segments
    networks: dict[str, Network]
    train_other: Callable[[], Network]

    @cached_property
    def other(self) -> Network:
        """Return the network for all other vehicle models."""
        return self.train_other()

    def predict_energy(self, rides: pd.DataFrame) -> Floats:
        """Return the energy of rides.

        Returns
        -------
        (n,) float
            Energy, NaN for a ride without micro-segments. [kWh]
        """
        energy = np.full(len(rides), np.nan)
        models = rides["vehicle_model"].to_numpy(dtype=object)
        for name in set(models.tolist()):
            network = self.networks.get(name) or self.other
            rows = np.flatnonzero(models == name)
            at, ride = self.segments.of(rides.iloc[rows])
            if len(at):
                sums = np.bincount(ride, weights=network.energy(self.segments.features[at]), minlength=len(rows))
                energy[rows] = np.where(np.bincount(ride, minlength=len(rows)) > 0, sums, np.nan)
        return energy


@dataclass(frozen=True)
class SegmentRecipe:
    """Fit a segment model to rides and their micro-segments.

    Parameters
    ----------
    segments : Segments
        Micro-segments of all rides, including those to predict.
    name, title : str
        Name in code and files, and title for people.
    """

    segments: Segments
    seed: int = 0
    name: str = "segment_network"
    title: str = "Segment Model (Neural Network on Micro-Segments)"

    def fit(self, rides: pd.DataFrame) -> SegmentModel:
        """Return a model with a network for each vehicle model that has enough rides, and one for all others."""
        if (rides_with_windows := self._rides(rides)) < LEAST_NETWORK_RIDES:
            raise ModelError(
                f"{rides_with_windows:,} rides have windows, and a network needs {LEAST_NETWORK_RIDES}: give more rides"
            )
        groups = {str(name): of_model for name, of_model in rides.groupby("vehicle_model", sort=True)}
        networks = {
            name: self._network(of_model)
            for name, of_model in groups.items()
            if self._rides(of_model) >= LEAST_NETWORK_RIDES
        }
        return SegmentModel(self.segments, networks, partial(self._network, rides))

    def _rides(self, rides: pd.DataFrame) -> int:
        return int(rides["ride_key"].isin(self.segments.keys).sum())

    def _network(self, rides: pd.DataFrame) -> Network:
        """Return a network trained on rides."""
        at, ride = self.segments.of(rides)
        features, energy = self.segments.features[at].copy(), rides["energy_kwh"].to_numpy(np.float64)
        features[:, np.isnan(features).all(axis=0)] = 0.0  # a feature without measurements carries no information
        mean, scale = np.nanmean(features, axis=0), np.nanstd(features, axis=0)
        target = share_out_energy(
            np.where(np.isnan(features), mean, features), self.segments.duration[at], ride, energy
        )
        rng = np.random.default_rng(self.seed)
        drawn = np.zeros(len(rides), dtype=bool)
        drawn[rng.permutation(len(rides))[: max(round(len(rides) * MOST_WINDOWS / len(at)), 1)]] = True
        kept = drawn[ride]
        untrained = MLPRegressor(
            hidden_layer_sizes=HIDDEN,
            batch_size=min(BATCH, int(kept.sum())),
            learning_rate_init=RATE,
            max_iter=EPOCHS,
            n_iter_no_change=EPOCHS,
            random_state=self.seed,
        )
        centre, spread = float(target[kept].mean()), float(target[kept].std()) or 1.0
        network = Network(mean, np.where(scale > 0.0, scale, 1.0), centre, spread, untrained)
        standard = np.nan_to_num((features[kept] - network.mean) / network.scale)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # the training stops early on purpose
            untrained.fit(standard, (target[kept] - centre) / spread)
        return network


def share_out_energy(features: Floats, duration: Floats, ride: Ordinals, energy: Floats) -> Floats:
    """Return the energy of each micro-segment, such that those of a ride add up to the energy of the ride.

    Units: energy [kWh], returns [kWh].

    Parameters
    ----------
    features : (n, features) float
        Features of the micro-segments, without NaN.
    """
    count = np.bincount(ride, minlength=len(energy))
    columns = np.column_stack([features, np.ones(len(ride))])
    sums = np.column_stack([np.bincount(ride, weights=column, minlength=len(energy)) for column in columns.T])
    moments = Moments.of(np.column_stack([sums, energy])[count > 0])
    expected = columns @ solve(moments, constant=False).coefficients
    beyond = energy - np.bincount(ride, weights=expected, minlength=len(energy))
    time = np.bincount(ride, weights=duration, minlength=len(energy))
    share = np.divide(duration, time[ride], out=1.0 / count[ride], where=time[ride] > 0.0)
    return expected + beyond[ride] * share
