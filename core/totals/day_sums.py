"""Named arrays of sums, which a daily update takes and begins anew, and a Bayesian regression that learns from them.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, sections 14.2 and 14.8, ISBN 978-1-4398-4095-5.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from socast.core.batch import Floats

_ROUNDS: Final = 5  # between coefficients and variance


class DaySums:
    """Hold named arrays of sums of floats, in the order in which they are added."""

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self._parts = {name: np.zeros(shape) for name, shape in shapes.items()}

    def add(self, name: str, values: ArrayLike, at: Any = ()) -> None:
        """Add values to an array, or to the place `at` of it, at which no cell stands twice."""
        self._parts[name][at] += values

    def get(self, name: str) -> Floats:
        """Return an array of sums, which `add` changes."""
        return self._parts[name]

    def age(self, memory: float, today: "DaySums", weight: float = 1.0) -> None:
        """Let the sums so far keep a share of their weight, and add those of a day with a weight."""
        for name, known in self._parts.items():
            self.add(name, weight * today.get(name) - (1.0 - memory) * known)

    def clear(self) -> None:
        """Set all sums to 0, in new arrays."""
        self._parts = {name: np.zeros(part.shape) for name, part in self._parts.items()}

    def dump(self) -> bytes:
        """Return the sums as bytes."""
        return b"".join(part.tobytes() for part in self._parts.values())

    def load(self, state: bytes) -> None:
        """Replace the sums by those that `dump` returned; raise ValueError where they are none."""
        values = np.frombuffer(state)
        if len(values) != sum(part.size for part in self._parts.values()) or np.isnan(values).any():
            raise ValueError("sums of another number, or not a number")
        for name, part in self._parts.items():
            self._parts[name], values = values[: part.size].reshape(part.shape).copy(), values[part.size :]


class NoisePrior(NamedTuple):
    """Hold the variance of the noise before any data, and the number of observations that it counts as."""

    variance: float
    weight: float


class DailyRegression:
    """Learn the coefficients of a linear regression day by day, where older days lose weight.

    An observation y has terms x: y = x · coefficients + noise, where the variance of the noise is v times a given one,
    g. Observations are kept as sums: of their weights w, and of w x x^T / g, w x y / g and w y^2 / g. Coefficients and
    v are computed from each other in a few rounds.

    Parameters
    ----------
    sd : Standard deviation of each coefficient before any data, (n,) float; the mean is 0.
    noise : Prior of v.

    Attributes
    ----------
    coefficients, covariance : Mean and covariance, (n,) and (n, n) float.
    variance : Variance v of the noise over the given one.
    known, today : Sums that have taken effect, and those since the last daily update.
    """

    def __init__(self, sd: Floats, noise: NoisePrior) -> None:
        self._precision, self._noise, n = np.diag(sd**-2.0), noise, len(sd)
        shapes: dict[str, tuple[int, ...]] = {"weight": (), "matrix": (n, n), "right": (n,), "squares": ()}
        self.known, self.today = DaySums(**shapes), DaySums(**shapes)
        self.fit()

    def observe(self, terms: Floats, values: Floats, variance: Floats) -> None:
        """Add m observations, each with the weight 1/m, for the next daily update; terms (m, n), the others (m,)."""
        weighted = terms.T / (len(values) * variance)
        self.today.add("weight", 1.0)
        self.today.add("matrix", weighted @ terms)
        self.today.add("right", weighted @ values)
        self.today.add("squares", np.mean(values**2 / variance))

    def take_day(self, memory: float, weight: float = 1.0) -> None:
        """Let the sums of the day take effect with a weight, and the known ones keep a share of theirs."""
        self.known.age(memory, self.today, weight)
        self.today.clear()
        self.fit()

    def fit(self) -> None:
        """Compute coefficients and variance from the known sums."""
        weight, matrix, right, squares = (self.known.get(name) for name in ("weight", "matrix", "right", "squares"))
        self.variance = self._noise.variance
        for _ in range(_ROUNDS):
            self.covariance = np.linalg.inv(matrix / self.variance + self._precision)
            self.coefficients = self.covariance @ right / self.variance
            rest = squares - 2.0 * self.coefficients @ right + self.coefficients @ matrix @ self.coefficients
            prior = self._noise.weight * self._noise.variance
            self.variance = (prior + max(float(rest), 0.0)) / (self._noise.weight + float(weight))

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.known.dump(), self.today.dump()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        known, today = state
        self.known.load(known)
        self.today.load(today)
        self.fit()
