"""Terms of the right dimension that are not of the library: a carrier times functions of what a window knows.

A modulator is a plain function of one variable: itself, its square, what it is above or below a limit, or its decay.
The coefficient has whatever unit makes the product with the carrier a power in watt, so that every such term has a
right dimension.

A window's modulator is the value at its middle, or its mean, where an effect has it row by row. For what changes within
a minute, speed above all, the coefficient of such a term is that of the effect by about, not quite.
"""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.diagnose.free_form.building_blocks import Carrier, Variable

QUANTILES: Final = (0.1, 0.25, 0.5, 0.75, 0.9)
"""Shares of the windows below the limits and scales that are tried."""


class Modulator(NamedTuple):
    """A function of one variable.

    Parameters
    ----------
    variable : Variable
    shape : str
        See `SHAPES`.
    at : float
        Limit or scale; 0 for shapes that have neither.
    grid : tuple of float
        Limits or scales that are tried beside it, ascending.
    """

    variable: Variable
    shape: str
    at: float = 0.0
    grid: tuple[float, ...] = ()

    def evaluate(self, x: Floats) -> Floats:
        """Return its values, of those of its variable."""
        return SHAPES[self.shape](x, self.at)

    @property
    def effort(self) -> int:
        """How much there is to it."""
        return (1 if self.shape == "linear" else 2) + bool(self.variable.follows)


SHAPES: Final[Mapping[str, Callable[[Floats, float], Floats]]] = MappingProxyType(
    {
        "linear": lambda x, _: x,
        "square": lambda x, _: x**2,
        "above": lambda x, at: np.maximum(x - at, 0.0),
        "below": lambda x, at: np.maximum(at - x, 0.0),
        "decay": lambda x, at: np.exp(-x / at),
    }
)
"""Functions of a variable and of a limit or a scale."""
LIMITED: Final = ("above", "below", "decay")
"""Shapes whose limit or scale is looked for."""


class FreeTerm(NamedTuple):
    """A carrier times modulators of different variables; their energy is the product in each window."""

    carrier: Carrier
    modulators: tuple[Modulator, ...] = ()

    @property
    def effort(self) -> int:
        """How much there is to it."""
        return sum(each.effort for each in self.modulators)

    @property
    def variables(self) -> frozenset[str]:
        """Names of what it depends on beside its carrier."""
        return frozenset(each.variable.name for each in self.modulators)

    def is_plainer_than(self, other: "FreeTerm") -> bool:
        """Tell whether it says less than another, of the same.

        Of the same carrier; or of any, where the other depends on speed beside: carriers differ by that above all.
        """
        same = self.carrier.name == other.carrier.name or "speed" in other.variables - self.variables
        known = other.variables | {each.variable.follows for each in other.modulators}
        return same and self.variables <= known and self.effort < other.effort


def list_modulators(variable: Variable, x: Floats) -> Iterator[Modulator]:
    """Give the functions of a variable that are tried, limits and scales from a grid of its quantiles.

    Parameters
    ----------
    variable : Variable
    x : (n,) float
        Its values.
    """
    if np.ptp(x) == 0.0:
        return
    grid = choose_limits(x, variable.unit)
    for shape in variable.shapes:
        if shape not in LIMITED:
            yield Modulator(variable, shape)
            continue
        ats = tuple(at for at in grid if at > 0.0 or shape != "decay")
        for at in ats:
            yield Modulator(variable, shape, at, ats)


def choose_limits(x: Floats, unit: str) -> tuple[float, ...]:
    """Return rounded quantiles of a variable within its values, ascending; those above the least, where many have that.

    Examples
    --------
    >>> choose_limits(np.linspace(260.3, 300.7, 101), "K")
    (264.0, 270.0, 280.0, 291.0, 297.0)
    >>> choose_limits(np.array([0.0] * 6 + [0.2, 0.4, 0.6]), "1")
    (0.24, 0.3, 0.4, 0.5, 0.56)
    """
    low, high = float(x.min()), float(x.max())
    varied = x[x > low] if low < high and np.mean(x == low) > QUANTILES[1] else x
    found = (float(f"{at:.0f}") if unit == "K" else float(f"{at:.2g}") for at in np.quantile(varied, QUANTILES))
    return tuple(sorted({at for at in found if low < at < high}))
