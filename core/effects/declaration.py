"""The declaration of an effect: a pure function of columns with a named coefficient, and checks of its completeness.

The declaration holds all that fitting, listing and diagnosis need to know of an effect. Import `socast.core.effects` to
use effects, and `socast` to write one.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from string import Formatter
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SIGNALS
from socast.core.errors import EffectError
from socast.core.formatting import everyday, rounded

SIGNAL_UNITS: Final[Mapping[str, str]] = MappingProxyType({column.name: column.unit for column in SIGNALS})
"""Unit of each column that an effect may take, by name."""
VARIANT: Final = "@"
"""Separator between the name of an effect and its changed parameters: `cold_rolling@reference=283.15`."""


@dataclass(frozen=True)
class Parameter:
    """Declare a constant inside an effect: a set point, a time constant, a density.

    Parameters
    ----------
    value : float
        Value until fitting finds a better one. [unit]
    unit : str
        Unit as pint spells it; `1` for a pure number.
    low, high : float, optional
        Bounds within which fitting may move the value. Without them it is fixed. [unit]
    grid : tuple of float, optional
        Values within the bounds, ascending, including the declared one. Tables hold the effect at each of them, so that
        the best value is found without going back to the samples. [unit]
    """

    value: float
    unit: str
    low: float | None = None
    high: float | None = None
    grid: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a value outside its bounds, and an invalid grid."""
        low, high = self.bounds
        if not (isfinite(self.value) and isfinite(low) and isfinite(high) and low <= self.value <= high):
            raise EffectError(
                f"parameter {self.value:g} {self.unit} is outside its bounds {low:g} to {high:g}: widen them"
            )
        if self.grid and (
            self.value not in self.grid
            or tuple(sorted(set(self.grid))) != self.grid
            or not low <= self.grid[0] <= self.grid[-1] <= high
        ):
            raise EffectError(
                f"grid {', '.join(map(format_shortest, self.grid))} of a parameter must ascend, hold its value "
                f"{format_shortest(self.value)} and stay within its bounds {low:g} to {high:g}"
            )

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value, equal where the parameter is fixed. [unit]"""
        return (self.value if self.low is None else self.low, self.value if self.high is None else self.high)


def format_shortest(value: float) -> str:
    """Return the shortest decimal that reads back to a number, as in the names of variants.

    Examples
    --------
    >>> format_shortest(283.15), format_shortest(0.0003), format_shortest(600.0)
    ('283.15', '0.0003', '600')
    """
    return np.format_float_positional(value, trim="-")


@dataclass(frozen=True)
class Expectation:
    """State what is known of a coefficient before any data: a Gaussian.

    Parameters
    ----------
    mean, sd : float
        Mean and standard deviation. [unit of the coefficient, or 1 where `of` names a figure of the car]
    source : str
        Source of both, to the page or DOI, or the estimate.
    of : str
        Figure of the car, as a column of the ride table, in multiples of which both are given; empty for none.
    """

    mean: float
    sd: float
    source: str
    of: str = ""

    def __post_init__(self) -> None:
        """Refuse a mean or a spread that is no Gaussian, and a missing source."""
        if not (isfinite(self.mean) and isfinite(self.sd) and self.sd > 0.0):
            raise EffectError(f"expected coefficient {self.mean:g} ± {self.sd:g} is no Gaussian: give finite numbers")
        if not self.source.strip():
            raise EffectError(f"expected coefficient {self.mean:g} ± {self.sd:g} has no source: name one")


@dataclass(frozen=True, eq=False)
class Effect:
    """Describe one physical cause of consumption: power = coefficient * function(columns).

    Parameters
    ----------
    name : str
        Name of the phenomenon and of the function.
    function : callable
        Elementwise numpy over the columns named by its arguments; power per unit of the coefficient. [W/unit]
    coefficient : str
        Fitted quantity, in words or by its textbook name.
    unit : str
        Unit of the coefficient, as pint spells it: this unit times that of the function's result is watt.
    low, high : float
        Closed interval of plausible coefficients. [unit]
    source : str
        Source of the formula and the range, to the page or DOI.
    per : {"distance", "time"}
        Whether the effect acts through the car's motion, and so over the time of the distance driven, or all the time.
    formula : str
        `P = ...`, from the function's docstring.
    arguments : tuple of str
        Columns that it needs, in the order of the function's arguments.
    parameters : mapping of str to Parameter
        Its constants by name.
    constants : mapping of str to float
        Values of the parameters: the declared ones, except in a variant.
    confused_with : tuple of str
        Names of effects that data often cannot distinguish from it.
    shown_by : str
        Data that show it best.
    words : str
        Meaning of a coefficient in plain words, with places for `{value}` and for parameters.
    scale : float
        Factor from the coefficient to that value.
    expected : Expectation, optional
        Coefficient before any data. Without it, the plausible range stands for one.
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
    confused_with: tuple[str, ...] = ()
    shown_by: str = ""
    words: str = ""
    scale: float = 1.0
    expected: Expectation | None = None

    @property
    def base(self) -> str:
        """Name of the effect of which this is a variant; its own name where it is none."""
        return self.name.partition(VARIANT)[0]

    @property
    def sign(self) -> int:
        """Sign that physics demands of the coefficient: 1, -1, or 0 where both are possible."""
        return 1 if self.low >= 0.0 else -1 if self.high <= 0.0 else 0

    @property
    def energy_name(self) -> str:
        """Column of the ride and window tables with its energy per unit of the coefficient. [kWh/unit]"""
        return f"effect_{self.name}"

    @property
    def documentation(self) -> str:
        """Docstring of the function."""
        return inspect.getdoc(self.function) or ""

    @property
    def summary(self) -> str:
        """First line of the docstring."""
        return self.documentation.partition("\n")[0]

    def power(self, columns: Mapping[str, Floats], parameters: Mapping[str, float] | None = None) -> Floats:
        """Return the power per unit of the coefficient, without any checks: this is the hot path.

        Parameters
        ----------
        columns : mapping of str to (n,) float
            At least `arguments`; see `socast.core.columns.SIGNALS`.
        parameters : mapping of str to float, optional
            Values in place of the declared ones.

        Returns
        -------
        (n,) float
            Power of each row, independent of other rows, so that rows may be cut into blocks. NaN where a column is
            NaN. [W/unit]
        """
        constants = self.constants if parameters is None else {**self.constants, **parameters}
        return self.function(**{name: columns[name] for name in self.arguments}, **constants)

    def variant(self, parameters: Mapping[str, float]) -> "Effect":
        """Return the effect with other parameter values and the name for them; itself where no value differs.

        Parameters
        ----------
        parameters : mapping of str to float
            New values by name.

        Raises
        ------
        EffectError
            For a parameter that the effect does not have or that is fixed, and for a value outside its bounds.
        """
        for name, value in parameters.items():
            parameter = self.parameters.get(name)
            if parameter is None:
                known = ", ".join(self.parameters) or "none"
                raise EffectError(f"effect {self.base}: it has no parameter {name!r}; it has {known}")
            low, high = parameter.bounds
            if low == high:
                raise EffectError(f"effect {self.base}: parameter {name} is fixed at {low:g} {parameter.unit}")
            if not low <= value <= high:
                raise EffectError(
                    f"effect {self.base}: parameter {name} is {value:g} {parameter.unit}, but must be from {low:g} to "
                    f"{high:g}"
                )
        constants = {**self.constants, **parameters}
        changed = [f"{n}={format_shortest(v)}" for n, v in constants.items() if v != self.parameters[n].value]
        name = VARIANT.join([self.base, ",".join(changed)]) if changed else self.base
        return self if name == self.name else replace(self, name=name, constants=MappingProxyType(constants))

    @property
    def variants(self) -> tuple["Effect", ...]:
        """Variants held in the tables: the other values of each parameter's grid, one changed at a time."""
        changes = [(n, v) for n, p in self.parameters.items() for v in p.grid if v != p.value]
        return tuple(self.variant({name: value}) for name, value in changes)

    @property
    def largest(self) -> float:
        """Largest plausible absolute value of the coefficient. [unit]"""
        return max(abs(self.low), abs(self.high))

    def is_plausible(self, begin: float, end: float) -> bool:
        """Return whether an interval of the coefficient reaches the plausible range. [unit]"""
        return begin <= self.high and end >= self.low

    def in_words(self, value: float, half: float | None = None) -> str:
        """Return the meaning of a coefficient in plain words.

        Parameters
        ----------
        value : float
            Coefficient. [unit]
        half : float, optional
            Half the width of its interval, which sets the number of digits. [unit]
        """
        if half is not None and half > abs(self.high - self.low):
            return f"{self.coefficient}: these data do not determine it"
        number = rounded(value * self.scale, None if half is None else half * abs(self.scale))
        if not self.words:
            return f"{self.coefficient} {number}" + ("" if self.unit == "1" else f" {self.unit}")
        constants = {name: everyday(v, self.parameters[name].unit) for name, v in self.constants.items()}
        return self.words.format(value=number, **constants)


def effect(
    *,
    coefficient: str,
    unit: str,
    low: float,
    high: float,
    source: str,
    per: Literal["distance", "time"] = "distance",
    parameters: Mapping[str, Parameter] | None = None,
    confused_with: Sequence[str] = (),
    shown_by: str = "",
    words: str = "",
    scale: float = 1.0,
    expected: Expectation | None = None,
) -> Callable[[Callable[..., Floats]], Effect]:
    """Declare a function of columns to be an effect of the same name.

    Arguments of the function are names of `socast.core.columns.SIGNALS`, filled in by name, and names of `parameters`.
    A number that has a dimension must be a parameter, because units are checked. The docstring holds the formula, as `P
    = ...`.

    Parameters
    ----------
    coefficient, unit, low, high, source, per, parameters, confused_with, shown_by, words, scale, expected
        See `Effect`. The first five are required; without `per` the effect acts through the car's motion.

    Returns
    -------
    callable
        Decorator that turns the function into an `Effect`.

    Raises
    ------
    EffectError
        For an argument that is neither a column nor a parameter, and for an incomplete declaration.

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
                f"effect {name}: parameter {idle[0]!r} is declared but is not an argument of the function: remove it"
            )
        arguments = tuple(n for n in names if n not in constants)
        if not arguments:
            raise EffectError(f"effect {name}: it takes no column: for a constant power use the effect 'auxiliary'")
        if not -np.inf < low < high < np.inf:
            raise EffectError(
                f"effect {name}: plausible range {low:g} to {high:g} is empty or infinite: give low < high"
            )
        if per not in ("distance", "time"):
            raise EffectError(f"effect {name}: per={per!r}: write 'distance' (acts through motion) or 'time'")
        if not source.strip() or not coefficient.strip():
            raise EffectError(f"effect {name}: source or coefficient is empty: describe both in words")
        _check_words(name, words, constants)
        formula = re.search(r"P = .*\S", inspect.getdoc(function) or "")
        if formula is None:
            raise EffectError(f"effect {name}: its docstring has no formula: write one as 'P = ...'")
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
            confused_with=(confused_with,) if isinstance(confused_with, str) else tuple(confused_with),
            shown_by=shown_by,
            words=words,
            scale=scale,
            expected=expected,
        )

    return declare


def _check_words(name: str, words: str, constants: Mapping[str, Parameter]) -> None:
    """Refuse words with placeholders that nothing fills."""
    try:
        places = [(field, spec or conversion) for _, field, spec, conversion in Formatter().parse(words)]
    except ValueError as error:
        raise EffectError(f"effect {name}: words are not a format string: {error}: pair every brace") from error
    for field, form in places:
        if field is not None and (form or field not in {"value", *constants}):
            raise EffectError(
                f"effect {name}: words have a place for {field + (':' + form if form else '')!r}: use only {{value}} "
                "and parameters, which come rounded"
            )
