"""The filter of the state of charge by filterpy, the witness of `socast.core.forecast.soc_filter`.

The state is (s, a, c), as there. The covariance follows the slopes at the point where the shift began; the mean follows
the equations themselves, by an input that makes up the difference. Rejected readings and resets are not described.
"""

from typing import Any, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.soc_filter import COMPARED_ENERGY, CONSUMPTION_WANDER, METER_SAMPLING_SD, UNMODELLED_POWER
from socast.core.forecast.soc_reading import READING_SD


class Stretch(NamedTuple):
    """Hold what a car did from one event to the next.

    Parameters
    ----------
    predicted, used : float
        Predicted and measured energy, NaN where unknown. [kWh]
    duration : float
        [s]
    capacity : float
        Energy that the full battery holds at the slope of the display, NaN where unknown. [kWh]
    noise : float
        Variance of the energy of a stretch that takes 1 kWh. [kWh]
    """

    predicted: float
    used: float
    duration: float
    capacity: float
    noise: float


def get_mean(car: Any) -> Floats:
    """Return the estimate (s, a, c) of a car, a FILTER_STATE."""
    return np.array([car["soc"], car["log_consumption"], car["log_capacity"]])


def get_covariance(car: Any) -> Floats:
    """Return the covariance matrix of charge, consumption and capacity of a car, a FILTER_STATE."""
    ss, sa, sc, aa, ac, cc = (car[f"p_{name}"] for name in ("ss", "sa", "sc", "aa", "ac", "cc"))
    return np.array([[ss, sa, sc], [sa, aa, ac], [sc, ac, cc]])


class SocWitness:
    """Run filterpy's filter from the state of a car on, a FILTER_STATE."""

    def __init__(self, car: Any) -> None:
        from filterpy.kalman import KalmanFilter  # noqa: PLC0415 - its import takes a second

        self.usual, self.size = car["usual"], car["begin_log_capacity"]
        self.kalman = KalmanFilter(dim_x=3, dim_z=1)
        self.kalman.x, self.kalman.P = get_mean(car)[:, None], get_covariance(car)
        self.fall, self.predicted, self.used = (float(car[f]) for f in ("fall", "compared_predicted", "compared_used"))

    @property
    def mean(self) -> Floats:
        """Estimate, (3,)."""
        return np.asarray(self.kalman.x[:, 0])

    @property
    def covariance(self) -> Floats:
        """Covariance of the estimate, (3, 3)."""
        return np.asarray(self.kalman.P)

    def predict(self, stretch: Stretch) -> None:
        """Predict the state at the end of a stretch, by the measured energy, or by the predicted where that is NaN."""
        predicted, used, duration, capacity, noise = stretch
        if np.isnan(capacity) or duration <= 0.0:
            return
        kalman = self.kalman
        kalman.predict(F=np.eye(3), Q=np.diag([0.0, CONSUMPTION_WANDER**2 * duration / 3600.0, 0.0]))
        if np.isnan(predicted) and np.isnan(used):
            fall = UNMODELLED_POWER * duration / 3600.0 / capacity
            self.fall += fall
            kalman.predict(F=np.eye(3), Q=np.diag([fall**2, 0.0, 0.0]))
            return
        if np.isnan(used):
            by_a, blur = 1.0, noise * abs(predicted) / capacity**2
            fall = np.exp(kalman.x[1, 0] - kalman.x[2, 0]) * predicted / capacity
            slope = np.exp(self.usual) * predicted / capacity
        else:
            if not np.isnan(predicted):
                self.predicted, self.used = self.predicted + predicted, self.used + used
            if self.predicted >= COMPARED_ENERGY:
                self.compare(noise + METER_SAMPLING_SD**2)
            by_a, blur = 0.0, METER_SAMPLING_SD**2 * abs(used) / capacity**2
            fall, slope = (used / (capacity * np.exp(size)) for size in (kalman.x[2, 0], self.size))
        self.fall += slope
        along = np.array([[1.0, -by_a * slope, slope], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        made_up = kalman.x - [[fall], [0.0], [0.0]] - along @ kalman.x
        kalman.predict(u=made_up, B=np.eye(3), F=along, Q=np.diag([blur, 0.0, 0.0]))

    def take_driver(self, car: Any) -> None:
        """Take the driver that is named for a car, a FILTER_STATE, into account, if it is another one.

        The first driver of a shift is a measurement of `a - c`. A second one replaces the first one's part of it.
        """
        if car["next_driver"] < 0.0 or car["next_driver"] == car["driver"]:
            return
        kalman, usual, prior = self.kalman, self.usual, car["usual_variance"]
        wandered = CONSUMPTION_WANDER**2 * max(car["time"] - car["begin"], 0.0) / 3600.0
        mean, variance = (car[f"next_driver_{name}"] - car[f"driver_{name}"] for name in ("mean", "variance"))
        self.usual = usual + mean
        if car["driver"] >= 0.0:
            kept = 1.0 - car["driver_variance"] / (prior + wandered)
            along = np.array([[1.0, 0.0, 0.0], [0.0, kept, 1.0 - kept], [0.0, 0.0, 1.0]])
            blur = kept * car["driver_variance"] + car["next_driver_variance"]
            added = np.array([[0.0], [(1.0 - kept) * usual + mean], [0.0]])
            kalman.predict(u=added, B=np.eye(3), F=along, Q=np.diag([0.0, blur, 0.0]))
        elif variance < 0.0:
            noise = 1.0 / (1.0 / (prior + variance) - 1.0 / prior)
            seen = noise * (self.usual / (prior + variance) - usual / prior)
            kalman.update(seen, noise + wandered, np.array([[0.0, 1.0, -1.0]]))

    def compare(self, variance: float) -> None:
        """Update by the measured energy of a stretch, with the variance of its residual over its energy. [kWh]"""
        kalman, predicted, used = self.kalman, self.predicted, self.used
        seen = np.array([[0.0, np.exp(self.size + self.usual) * predicted, 0.0]])
        kalman.update(used - np.exp(kalman.x[1, 0]) * predicted + seen @ kalman.x, variance * predicted, seen)
        self.predicted = self.used = 0.0

    def update_with_step(
        self, before: float, reported: float, quantum: float, *, is_trusted: bool = True, is_frozen: bool = False
    ) -> None:
        """Update by a step from one reported value to another.

        A step that is not trusted, one that ends a frozen value and one far beyond the used charge keep the covariance.
        """
        change = reported - before
        beyond = 0.0 if is_frozen else max(abs(change) - abs(self.fall) - quantum, 0.0)
        at, variance = reported, quantum**2 / 12.0 + beyond**2 / 4.0
        if abs(change) < 1.5 * quantum and not is_frozen:  # somewhere between the boundary and what was used since
            sign = -np.sign(change)
            since = min(max(sign * self.fall, 0.0), quantum)
            at = reported + sign * 0.5 * (quantum - since)
            variance = (0.1 * quantum) ** 2 + since**2 / 12.0
        covariance = self.kalman.P
        self.kalman.update(at, variance + READING_SD**2, np.array([[1.0, 0.0, 0.0]]))
        if is_frozen or not is_trusted or beyond > abs(self.fall) + quantum:
            self.kalman.P = covariance

    def note_reading(self) -> None:
        """Note that a charge was reported."""
        self.fall = 0.0
