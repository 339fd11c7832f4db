"""State how far the error of rides falls towards the measurement noise when a model takes a step.

The error above the noise is what remains of the mean absolute error after the error that measurement noise alone causes
on the same rides (`socast.core.fit.measurement_noise`) is subtracted. The share removed is the fall of the error over
the error above the noise before the step. All intervals are 95 % intervals by vehicle-day; they hold the chance of days
and not an error of the estimated noise.

`ErrorFall` is the record of one comparison and `ErrorStep` that of one step in the history of a model. Every picture
and table of a falling error is drawn from them.
"""

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.fit.measurement_noise import MEAN_OVER_SD
from socast.core.models.features import list_scope
from socast.core.stats.clustered import compute_clustered_mean, compute_fieller_interval
from socast.core.stats.scores import Codes

ATTEMPTS: Final = ("add", "refused", "undecided")
"""Actions in the history of a model that tried an effect."""


class Spread(NamedTuple):
    """Hold a value and half the width of its 95 % interval, NaN where they are unknown. [kWh]"""

    value: float = nan
    ci95: float = nan


class RemovedShare(NamedTuple):
    """Hold a share and the ends of its 95 % interval, NaN where they are unknown. [1]"""

    value: float = nan
    low: float = nan
    high: float = nan


class ErrorFall(NamedTuple):
    """Hold the errors of two models on the same rides, and how far the second one is nearer to the noise.

    Parameters
    ----------
    mae_before_kwh, mae_after_kwh : float
        Mean absolute error of a ride. [kWh]
    fall : float
        Fall of this error as a share of it. [1]
    change_kwh : Spread
        After less before, negative for an improvement. [kWh]
    noise_kwh : float
        Mean absolute error that measurement noise alone causes on these rides, NaN where it is unknown. [kWh]
    above_before_kwh, above_after_kwh : Spread
        Error above the noise. [kWh]
    removed : RemovedShare
        Share of the error above the noise that the step removed. Unknown where nothing beyond the noise was there
        before, and where the noise is overestimated. [1]
    """

    rides: int = 0
    clusters: int = 0
    mae_before_kwh: float = nan
    mae_after_kwh: float = nan
    fall: float = nan
    change_kwh: Spread = Spread()
    noise_kwh: float = nan
    above_before_kwh: Spread = Spread()
    above_after_kwh: Spread = Spread()
    removed: RemovedShare = RemovedShare()

    @property
    def is_noise_known(self) -> bool:
        """Whether the measurement noise of these rides is known."""
        return isfinite(self.noise_kwh)

    @property
    def is_noise_overestimated(self) -> bool:
        """Whether the error is clearly below the noise, which every error contains."""
        return any(each.value + each.ci95 < 0.0 for each in (self.above_before_kwh, self.above_after_kwh))

    @property
    def is_noise_reached(self) -> bool:
        """Whether the error after the step is not distinguished from that of measurement noise alone."""
        after = self.above_after_kwh
        return not self.is_noise_overestimated and after.value - after.ci95 <= 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the record as a mapping, as the history of a model file holds it."""
        fields = self._asdict().items()
        return {key: value._asdict() if isinstance(value, Spread | RemovedShare) else value for key, value in fields}


class ErrorStep(NamedTuple):
    """Hold one step of a model: an effect that was tried, and the fall of the error.

    Parameters
    ----------
    effect : str
        Effect.
    scope : sequence of str
        Where it holds, such as `vehicle=taxi-003`; empty for all vehicles and dates.
    forced : bool
        Whether the effect was added although the trial did not accept it.
    held_out, final : ErrorFall
        Errors on the held-out days, to which the coefficient of the effect was not fitted, and on the final hold-out
        days, to which nothing was fitted. The latter has no rides where there were none of these days.
    """

    effect: str
    scope: Sequence[str]
    action: str
    forced: bool
    held_out: ErrorFall
    final: ErrorFall


def measure_fall(measured: Floats, before: Floats, after: Floats, noise: Floats, clusters: Codes) -> ErrorFall:
    """Return the errors of two models on the same rides.

    Units: measured [kWh], before [kWh], after [kWh].

    Parameters
    ----------
    noise : (n,) float
        Variance of the measured energy, NaN where it is unknown. Such a ride has the mean noise of the others. [kWh^2]

    Notes
    -----
    With the absolute errors b and a before and after, and the expected absolute error n of the noise, the share removed
    is the ratio of the means of b - a and b - n; Fieller's interval holds for a denominator near zero too.
    """
    if not len(measured):
        return ErrorFall()
    worse, better = np.abs(before - measured), np.abs(after - measured)
    mae, change = float(worse.mean()), compute_clustered_mean(better - worse, clusters)
    fall = ErrorFall(
        rides=len(measured),
        clusters=len(np.unique(clusters)),
        mae_before_kwh=mae,
        mae_after_kwh=float(better.mean()),
        fall=-change.value / mae if mae > 0.0 else 0.0,
        change_kwh=Spread(change.value, change.ci95),
    )
    known = np.isfinite(noise)
    if not known.any():
        return fall
    alone = MEAN_OVER_SD * np.sqrt(np.where(known, noise, 0.0))
    alone = np.where(known, alone, alone[known].mean())
    above = [compute_clustered_mean(error - alone, clusters) for error in (worse, better)]
    fall = fall._replace(
        noise_kwh=float(alone.mean()),
        above_before_kwh=Spread(above[0].value, above[0].ci95),
        above_after_kwh=Spread(above[1].value, above[1].ci95),
    )
    if fall.is_noise_overestimated:
        return fall
    return fall._replace(removed=RemovedShare(*compute_fieller_interval(worse - better, worse - alone, clusters)))


def list_error_steps(history: Sequence[Mapping[str, Any]]) -> list[ErrorStep]:
    """Return the steps in the history of a model that tried an effect, the oldest first.

    An entry of an earlier release has no error above the noise, and an incomplete one no errors at all; what is missing
    is unknown.
    """
    return [read_step(entry) for entry in history if entry.get("action") in ATTEMPTS]


def read_step(entry: Mapping[str, Any]) -> ErrorStep:
    """Return the step of an entry in the history of a model, or of a trial."""
    action = entry.get("action") or entry.get("outcome")
    return ErrorStep(
        str(entry.get("effect")),
        read_scope(entry),
        str(action),
        bool(entry.get("forced")),
        read_fall(entry.get("of_effect")),
        read_fall(entry.get("final")),
    )


def read_scope(entry: Mapping[str, Any]) -> list[str]:
    """Return the scope of the effect of an entry in the history of a model."""
    columns = entry.get("columns")
    return list_scope(map(str, columns)) if isinstance(columns, list) else []


def read_fall(given: Any) -> ErrorFall:
    """Return the record of a mapping that `ErrorFall.to_dict` made; what it lacks is unknown."""
    if not isinstance(given, Mapping):
        return ErrorFall()

    def read(key: str) -> float:
        return _number(given.get(key))

    def read_spread(key: str) -> Spread:
        of = given.get(key)
        return Spread(_number(of.get("value")), _number(of.get("ci95"))) if isinstance(of, Mapping) else Spread()

    removed = given.get("removed")
    share = removed if isinstance(removed, Mapping) else {}
    return ErrorFall(
        rides=int(np.nan_to_num(read("rides"))),
        clusters=int(np.nan_to_num(read("clusters"))),
        mae_before_kwh=read("mae_before_kwh"),
        mae_after_kwh=read("mae_after_kwh"),
        fall=read("fall"),
        change_kwh=read_spread("change_kwh"),
        noise_kwh=read("noise_kwh"),
        above_before_kwh=read_spread("above_before_kwh"),
        above_after_kwh=read_spread("above_after_kwh"),
        removed=RemovedShare(*(_number(share.get(key)) for key in RemovedShare._fields))
        if isinstance(share, Mapping)
        else RemovedShare(),
    )


def _number(value: Any) -> float:
    """Return a number, NaN where it is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else nan
