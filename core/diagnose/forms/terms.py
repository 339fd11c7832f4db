"""Build terms of the right dimension that the library does not have: a carrier times functions of variables.

A modulator is a simple function of one variable: the variable itself, its square, its excess above or below a limit, or
its decay. The unit of the coefficient makes the product with the carrier a power in watt, so every term has the right
dimension.

The modulator of a window is its value in the middle of the window, or its mean, while an effect evaluates it row by
row. For variables that change within a minute, above all speed, the coefficient therefore equals that of the effect
only approximately.
"""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.forms.building_blocks import Carrier, Variable

QUANTILES: Final = (0.1, 0.25, 0.5, 0.75, 0.9)
"""Quantiles of the windows at which limits and scales are tried."""


class Modulator(NamedTuple):
    """Hold a function of one variable.

    Parameters
    ----------
    at : float
        Limit or scale; 0 for shapes that have neither. [unit of the variable]
    grid : tuple of float
        Limits or scales that are tried as alternatives, ascending. [unit of the variable]
    """

    variable: Variable
    shape: str
    at: float = 0.0
    grid: tuple[float, ...] = ()

    def evaluate(self, x: Floats) -> Floats:
        """Return the function of values of the variable, (n,)."""
        return SHAPES[self.shape](x, self.at)


SHAPES: Final[Mapping[str, Callable[[Floats, float], Floats]]] = MappingProxyType(
    {
        "linear": lambda x, _: x,
        "square": lambda x, _: x**2,
        "above": lambda x, at: np.maximum(x - at, 0.0),
        "below": lambda x, at: np.maximum(at - x, 0.0),
        "decay": lambda x, at: np.exp(-x / at),
    }
)
"""Functions of the values of a variable and of a limit or scale, by name."""
LIMITED: Final = ("above", "below", "decay")
"""Shapes with a limit or a scale."""


class FormTerm(NamedTuple):
    """Hold a carrier and modulators of different variables, whose product is the energy in each window."""

    carrier: Carrier
    modulators: tuple[Modulator, ...] = ()

    @property
    def variables(self) -> frozenset[str]:
        """Names of the variables of its modulators."""
        return frozenset(each.variable.name for each in self.modulators)


def list_modulators(variable: Variable, x: Floats) -> Iterator[Modulator]:
    """Yield the functions of a variable to try, with limits and scales at quantiles of its values."""
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
    """Return rounded quantiles of a variable, ascending; where many values equal the least one, of the others.

    Examples
    --------
    >>> choose_limits(np.linspace(260.3, 300.7, 101), "K")
    (264.0, 270.0, 280.0, 291.0, 297.0)
    >>> choose_limits(np.array([0.0] * 6 + [0.2, 0.4, 0.6]), "1")
    (0.24, 0.3, 0.4, 0.5, 0.56)
    """
    low, high = float(x.min()), float(x.max())
    varied = x[x > low] if low < high and np.mean(x == low) > QUANTILES[1] else x
    rounded = (float(f"{at:.0f}") if unit == "K" else float(f"{at:.2g}") for at in np.quantile(varied, QUANTILES))
    return tuple(sorted({at for at in rounded if low < at < high}))
