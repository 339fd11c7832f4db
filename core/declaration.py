"""What an effect is: a pure function of columns with a declared coefficient, and the check that it is what it says.

The declaration is all that fitting, listing and diagnosing an effect need to know of it. Whoever wants to use effects,
or to write one, imports `core.effects`.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from core.batch import Floats
from core.columns import SIGNALS
from core.errors import EffectError

SIGNAL_UNITS: Final[Mapping[str, str]] = MappingProxyType({column.name: column.unit for column in SIGNALS})
"""Name of a column that an effect may ask for -> its unit."""


@dataclass(frozen=True)
class Parameter:
    """A constant inside an effect: a set point, a time constant, a density.

    Parameters
    ----------
    value : float
        What it is unless fitting finds better.
    unit : str
        As pint spells it; `1` for a pure number.
    low, high : float, optional
        Bounds within which fitting may move it. Left out, it is fixed.
    """

    value: float
    unit: str
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        """Refuse a value outside its bounds."""
        low, high = self.bounds
        if not (isfinite(self.value) and isfinite(low) and isfinite(high) and low <= self.value <= high):
            raise EffectError(
                f"parameter {self.value:g} {self.unit} is outside its bounds {low:g} to {high:g}: widen them"
            )

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value, in the parameter's own unit; equal where it is fixed."""
        return (self.value if self.low is None else self.low, self.value if self.high is None else self.high)


@dataclass(frozen=True, eq=False)
class Effect:
    """One physical cause of consumption: power = coefficient * function(columns).

    Parameters
    ----------
    name : str
        Of the phenomenon; that of the function.
    function : callable
        Elementwise numpy over the columns named by its arguments; power per unit of the coefficient.
    coefficient : str
        What is fitted, in words or by its textbook name.
    unit : str
        Of the coefficient, as pint spells it: unit times the function's result is watt.
    low, high : float
        Closed interval of plausible coefficients. [unit]
    source : str
        Where formula and range come from, to the page or DOI.
    per : {"distance", "time"}
        Whether it acts by the car's motion, and so over the time that the driven distance took, or all the time.
    formula : str
        `P = ...`, from the function's docstring.
    arguments : tuple of str
        Columns that it needs, in the order of the function's arguments.
    parameters : mapping of str to Parameter
        Its constants by name.
    constants : mapping of str to float
        The parameters' values.
    """

    name: str
    function: Callable[..., Floats]
    coefficient: str
    unit: str
    low: float
    high: float
    source: str
    per: Literal["distance", "time"]
    formula: str
    arguments: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    constants: Mapping[str, float]

    @property
    def energy_name(self) -> str:
        """Column of the ride and window tables with its energy per unit of coefficient, in kWh/unit."""
        return f"effect_{self.name}"

    @property
    def summary(self) -> str:
        """First line of its documentation."""
        return (inspect.getdoc(self.function) or "").partition("\n")[0]

    def power(self, columns: Mapping[str, Floats], parameters: Mapping[str, float] | None = None) -> Floats:
        """Return the power per unit of the coefficient. Nothing is checked: this is the hot path.

        Parameters
        ----------
        columns : mapping of str to (n,) float
            At least `arguments`; see `core.columns.SIGNALS`.
        parameters : mapping of str to float, optional
            Values in place of the declared ones.

        Returns
        -------
        (n,) float
            Row by row, so that rows may be cut into blocks at will. NaN where a column is. [W/unit]
        """
        constants = self.constants if parameters is None else {**self.constants, **parameters}
        return self.function(**{name: columns[name] for name in self.arguments}, **constants)


def effect(
    *,
    coefficient: str,
    unit: str,
    low: float,
    high: float,
    source: str,
    per: Literal["distance", "time"] = "distance",
    parameters: Mapping[str, Parameter] | None = None,
) -> Callable[[Callable[..., Floats]], Effect]:
    """Declare a function of columns to be an effect of the same name.

    Arguments of the function are names of `core.columns.SIGNALS`, filled in by name, and names of `parameters`. A
    number that has a dimension must be a parameter, or units do not come out. The docstring holds the formula, as
    `P = ...`.

    Parameters
    ----------
    coefficient, unit, low, high, source, per, parameters
        See `Effect`. Without `per` the effect acts by the car's motion.

    Returns
    -------
    callable
        Turns the function into an `Effect`.

    Raises
    ------
    EffectError
        For an argument that is neither a column nor a parameter, and for a declaration that is incomplete.

    Examples
    --------
    >>> @effect(coefficient="drag of the brake pads", unit="N", low=0, high=60, source="Barton 2001, p. 3")
    ... def brake_drag(speed):
    ...     '''Brake pads that rub: P = F v.'''
    ...     return speed
    >>> brake_drag.power({"speed": np.array([0.0, 10.0])})
    array([ 0., 10.])
    """
    constants = dict(parameters or {})

    def declare(function: Callable[..., Floats]) -> Effect:
        name = function.__name__
        names = tuple(inspect.signature(function).parameters)
        if unknown := [n for n in names if n not in constants and n not in SIGNAL_UNITS]:
            raise EffectError(
                f"effect {name}: argument {unknown[0]!r} is neither a parameter nor a column; "
                f"columns are {', '.join(SIGNAL_UNITS)}"
            )
        if idle := [n for n in constants if n not in names]:
            raise EffectError(
                f"effect {name}: parameter {idle[0]!r} is declared but is no argument of the function: drop it"
            )
        arguments = tuple(n for n in names if n not in constants)
        if not arguments:
            raise EffectError(f"effect {name}: it takes no column; a constant power is the effect 'auxiliary'")
        if not -np.inf < low < high < np.inf:
            raise EffectError(
                f"effect {name}: plausible range {low:g} to {high:g} is empty or endless: give low < high"
            )
        if per not in ("distance", "time"):
            raise EffectError(f"effect {name}: per={per!r}: say 'distance' (acts by motion) or 'time'")
        if not source.strip() or not coefficient.strip():
            raise EffectError(f"effect {name}: source and coefficient must be said, in words that can be looked up")
        formula = re.search(r"P = .*\S", inspect.getdoc(function) or "")
        if formula is None:
            raise EffectError(f"effect {name}: its docstring has no formula: write it there, as 'P = ...'")
        return Effect(
            name=name,
            function=function,
            coefficient=coefficient,
            unit=unit,
            low=float(low),
            high=float(high),
            source=source,
            per=per,
            formula=formula.group().rstrip("."),
            arguments=arguments,
            parameters=MappingProxyType(constants),
            constants=MappingProxyType({n: p.value for n, p in constants.items()}),
        )

    return declare
