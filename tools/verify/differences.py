"""Collect the differences of steps between a compiled filter and filterpy's, car by car."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from math import inf

import numpy as np

from socast.core.batch import Floats
from socast.tools.verify.records import GOAL, CarDifference, FilterDifference


@dataclass
class Tally:
    """Count the steps of one car that were compared or passed over, with the largest differences."""

    compared: int = 0
    passed_over: Counter[str] = field(default_factory=Counter)
    mean: float = 0.0
    covariance: float = 0.0

    def add(self, difference: tuple[float, float], steps: int = 1) -> None:
        """Add compared steps with the largest differences of their means and covariances."""
        self.compared += steps
        self.mean, self.covariance = max(self.mean, difference[0]), max(self.covariance, difference[1])

    def join(self, other: "Tally") -> None:
        """Add the steps of another car."""
        self.passed_over += other.passed_over
        self.add((other.mean, other.covariance), other.compared)

    @property
    def steps(self) -> int:
        """Number of steps, compared or not."""
        return self.compared + self.passed_over.total()

    @property
    def meets_goal(self) -> bool | None:
        """Whether no difference exceeds the goal; None where nothing was compared."""
        return max(self.mean, self.covariance) <= GOAL if self.compared else None


class Tallies(defaultdict[str, Tally]):
    """Hold the tally of each car of one filter."""

    def __init__(self) -> None:
        super().__init__(Tally)

    def summarise(self, name: str) -> FilterDifference:
        """Return the differences of all cars and of each."""
        total = Tally()
        for tally in self.values():
            total.join(tally)
        cars = [
            CarDifference(
                vehicle_id=car,
                steps=tally.steps,
                compared=tally.compared,
                passed_over=_order(tally),
                mean=tally.mean if tally.compared else None,
                covariance=tally.covariance if tally.compared else None,
                meets_goal=tally.meets_goal,
            )
            for car, tally in sorted(self.items())
        ]
        return FilterDifference(
            filter=name,
            steps=total.steps,
            compared=total.compared,
            passed=total.passed_over.total(),
            passed_over=_order(total),
            mean=total.mean if total.compared else None,
            covariance=total.covariance if total.compared else None,
            meets_goal=total.meets_goal,
            cars=cars,
        )


def _order(tally: Tally) -> dict[str, int]:
    """Return the causes for which steps were passed over, the most frequent first."""
    return dict(tally.passed_over.most_common())


def measure_differences(
    mean: Floats, covariance: Floats, exact: Floats, exact_covariance: Floats
) -> tuple[float, float]:
    """Return the largest relative differences of means, (..., k), and covariances, (..., k, k).

    The scale of a mean is its exact value or its standard deviation, whichever is larger, and that of a covariance the
    product of both standard deviations. So a value near zero needs no other floor. What is not finite on either side
    differs without limit.

    Examples
    --------
    >>> measure_differences(np.array([2.0]), np.array([[4.5]]), np.array([1.0]), np.array([[4.0]]))
    (0.5, 0.125)
    >>> measure_differences(np.array([np.nan]), np.array([[4.0]]), np.array([1.0]), np.array([[4.0]]))
    (inf, 0.0)
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        sd = np.sqrt(np.diagonal(exact_covariance, axis1=-2, axis2=-1))
        of_mean = np.abs(mean - exact) / np.maximum(np.abs(exact), sd)
        of_covariance = np.abs(covariance - exact_covariance) / (sd[..., :, None] * sd[..., None, :])
    return _find_largest(of_mean), _find_largest(of_covariance)


def _find_largest(differences: Floats) -> float:
    """Return the largest of some differences, infinity if one is unknown."""
    largest = float(differences.max(initial=0.0))
    return inf if np.isnan(largest) else largest
