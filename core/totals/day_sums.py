"""Named arrays of sums, which a daily update takes and begins anew."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from socast.core.batch import Floats


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


class DailyLearner:
    """Learn from sums that lose weight day by day.

    Attributes
    ----------
    known, today : Sums that have taken effect, and those since the last daily update.
    """

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self.known, self.today = DaySums(**shapes), DaySums(**shapes)
        self.fit()

    def fit(self) -> None:
        """Compute what follows from the known sums."""

    def take_day(self, memory: float, weight: float = 1.0) -> None:
        """Let the sums of the day take effect with a weight, and the known ones keep a share of theirs."""
        self.known.age(memory, self.today, weight)
        self.today.clear()
        self.fit()

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.known.dump(), self.today.dump()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        known, today = state
        self.known.load(known)
        self.today.load(today)
        self.fit()
