"""Verification of effects: power in watt by units, one finite number per row, independent of other rows."""

import ast
import linecache
import operator
import traceback
import warnings
from collections.abc import Mapping
from functools import cache, partialmethod
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import KMH
from socast.core.effects.declaration import SIGNAL_UNITS, Effect
from socast.core.errors import EffectError

ORDINARY_DRIVING: Final[Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "dt": (0.5, 30.0),
        "speed": (0.0, 130 * KMH),
        "acceleration": (-4.0, 4.0),
        "acceleration_spread": (0.0, 3.0),
        "distance": (0.0, 1000.0),
        "grade": (-0.35, 0.35),
        "heading": (-3.15, 6.3),
        "turn_rate": (-0.6, 0.6),
        "headwind": (-25.0, 25.0),
        "crosswind": (-25.0, 25.0),
        "air_density": (0.9, 1.5),
        "ambient": (233.15, 318.15),
        "precipitation": (0.0, 1e-5),
        "humidity": (0.0, 1.0),
        "solar": (0.0, 1200.0),
        "elapsed": (0.0, 7200.0),
        "parked": (0.0, 1e6),
        "stopped": (0.0, 1.0),
        "stop_rate": (0.0, 0.3),
        "soc": (0.0, 1.0),
        "battery_temperature": (243.15, 328.15),
        "current": (-400.0, 800.0),
        "hvac": (0.0, 8000.0),
        "occupants": (0.0, 7.0),
        "odometer": (0.0, 5e8),
        "time": (1.2e9, 2.0e9),
        "mass": (450.0, 3500.0),
        "accessory_scale": (0.0, 2.0),
        "rolling_resistance": (0.003, 0.05),
        "drag_area": (0.2, 4.0),
        "tyre_load": (4000.0, 35_000.0),
        "traction": (-15_000.0, 15_000.0),
        "wheel_power": (-300_000.0, 300_000.0),
        "braking_force": (0.0, 15_000.0),
        "charge": (0.0, 1.0),
        "pack_temperature": (233.15, 328.15),
        "vapour_pressure": (0.0, 5000.0),
        "water": (0.0, 0.01),
        "snow": (0.0, 0.1),
        "darkness": (0.0, 1.0),
        "sun_sine": (-1.0, 1.0),
    }
)
"""Lowest and highest value of each column in ordinary driving, over which an effect must be finite. [its unit]"""

_UNIT_ERRORS: Final = ("DimensionalityError", "OffsetUnitCalculusError", "UnitStrippedWarning")
_ROWS: Final = 257
_STANDING: Final = MappingProxyType(
    {
        "speed": 0.0,
        "acceleration": 0.0,
        "acceleration_spread": 0.0,
        "distance": 0.0,
        "stopped": 1.0,
        "turn_rate": 0.0,
        "traction": 0.0,
        "wheel_power": 0.0,
        "braking_force": 0.0,
    }
)


def check_effect(effect: Effect) -> None:
    """Check the units of an effect, and its values over ordinary driving.

    The effect is called with quantities, and then with 257 rows of ordinary driving: a standing car, all columns at
    their ends, and values in between. The check is repeated at the ends and on the grid of every parameter.

    Parameters
    ----------
    effect : Effect
        Effect to check.

    Raises
    ------
    EffectError
        Where the result times the coefficient's unit is not watt, is not one float per row, is not finite, depends on
        other rows, or changes its input; and where the function raises. The message names the line of the file where it
        is known.
    """
    rows = _ordinary_rows(effect.arguments)
    _check_unit(effect, rows)
    result = _call(effect, rows)
    if not isinstance(result, np.ndarray) or result.shape != (_ROWS,) or result.dtype != np.float64:
        got = f"{result.dtype} {result.shape}" if isinstance(result, np.ndarray) else type(result).__name__
        raise EffectError(f"effect {effect.name}: returns {got} for {_ROWS} rows: return one float per row")
    _check_finite(effect, rows, result)
    _check_parameters(effect, rows)
    for first, last in ((0, 1), (1, 2), (2, 19), (19, _ROWS), (5, 5)):
        part = _call(effect, {name: column[first:last] for name, column in rows.items()})
        if not np.array_equal(part, result[first:last]):
            raise EffectError(
                f"effect {effect.name}: rows {first} to {last} alone give another result than among all: "
                "compute each row by itself, without mean, sum, diff or cumsum"
            )


def _ordinary_rows(names: tuple[str, ...]) -> dict[str, Floats]:
    """Return read-only columns of ordinary driving: a standing car, all lowest, all highest, then random rows."""
    random = np.random.default_rng(20)
    rows = {}
    for name in ORDINARY_DRIVING:  # all columns, so that the rows are the same for every effect
        low, high = ORDINARY_DRIVING[name]
        column = low + (high - low) * random.random(_ROWS)
        column[:3] = _STANDING.get(name, (low + high) / 2), low, high
        column.flags.writeable = False
        rows[name] = column
    return {name: rows[name] for name in names}


def _call(effect: Effect, columns: Mapping[str, Any], constants: Mapping[str, Any] | None = None) -> Any:
    """Return the result of the function; raise any exception as an `EffectError`."""
    try:
        with np.errstate(all="ignore"):
            return effect.power(columns, constants)
    except Exception as error:  # whatever a user's function raises
        raise EffectError(_explain(effect, error)) from error


def _check_parameters(effect: Effect, rows: Mapping[str, Floats]) -> None:
    """Check values at the ends of every parameter's bounds and on its grid, where fitting may move it."""
    for name, parameter in effect.parameters.items():
        for value in sorted({*parameter.bounds, *parameter.grid} - {parameter.value}):
            moved = {**effect.constants, name: value}
            _check_finite(effect, rows, _call(effect, rows, moved), f"{name}={value:g} {parameter.unit}, ")


def _check_finite(effect: Effect, rows: Mapping[str, Floats], result: Floats, with_what: str = "") -> None:
    """Refuse a result that is not finite, with the row where it occurs."""
    bad = np.flatnonzero(~np.isfinite(result))
    if bad.size:
        at = (f"{name}={rows[name][bad[0]]:g} {SIGNAL_UNITS[name]}" for name in effect.arguments)
        where = with_what + ", ".join(at)
        raise EffectError(
            f"effect {effect.name}: gives {result[bad[0]]} at {where}, which occurs in ordinary driving: guard it"
        )


@cache
def _registry() -> Any:
    """Return pint's registry, loaded on first use: half of pint's cost is reading it, and only checks need it."""
    import pint  # noqa: PLC0415

    registry: Any = pint.UnitRegistry()
    # pint returns False where a quantity is compared with another dimension by `==`; here it is an error, as by `<`
    registry.Quantity.__eq__ = partialmethod(registry.Quantity.compare, op=operator.eq)
    registry.Quantity.__ne__ = partialmethod(registry.Quantity.compare, op=operator.ne)
    return registry


def _spell(unit: Any) -> str:
    """Return a unit as pint abbreviates it, `1` for that of a pure number."""
    return f"{unit:~}" or "1"


def _parse_unit(effect: Effect, text: str) -> Any:
    """Return the unit that a text spells."""
    try:
        return _registry().Unit(text)
    except Exception as error:  # pint raises half a dozen kinds, tokenize's among them
        raise EffectError(
            f"effect {effect.name}: pint does not know the unit {text!r}: {_as_line(error)}: spell it as pint does"
        ) from error


def _check_unit(effect: Effect, rows: Mapping[str, Floats]) -> None:
    """Call the effect with quantities; the result times the coefficient's unit must be exactly watt."""
    quantity = _registry().Quantity
    columns = {name: quantity(column, _parse_unit(effect, SIGNAL_UNITS[name])) for name, column in rows.items()}
    constants = {}
    for name, parameter in effect.parameters.items():
        unit = _parse_unit(effect, parameter.unit)
        si = quantity(1.0, unit).to_base_units()
        if si.magnitude != 1.0:
            raise EffectError(
                f"effect {effect.name}: parameter {name} is in [{parameter.unit}], but columns are in SI units: "
                f"give its value in [{_spell(si.units)}]"
            )
        constants[name] = quantity(parameter.value, unit)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("error")
        try:
            result = effect.power(columns, constants)
        except Exception as error:  # whatever a user's function raises
            raise EffectError(_explain_unit_error(effect, error) or _explain(effect, error)) from error
    unit = getattr(result, "units", _registry().dimensionless)
    product = unit * _parse_unit(effect, effect.unit)
    watt = _registry().Unit("W")
    if not product.is_compatible_with(watt) or not np.isclose(
        quantity(1.0, product).to(watt).magnitude, 1.0, rtol=1e-12
    ):
        raise EffectError(
            f"effect {effect.name}: function gives [{_spell(unit)}], times the coefficient's [{effect.unit}] that is "
            f"[{_spell(product)}], not [W]: correct the formula, the coefficient's unit or a parameter's unit"
        )


def _explain_unit_error(effect: Effect, error: Exception) -> str:
    """Return the message for units that do not fit, empty for any other error."""
    compares = isinstance(error, ValueError) and str(error).startswith("Cannot compare")
    if not compares and type(error).__name__ not in _UNIT_ERRORS:
        return ""
    place, code = _locate(effect, error)
    where = f" in `{code}`" if code else ""
    number, unit = _find_bare_number(effect, code), _find_unit(error)
    if not number or not unit:
        return (
            f"{place}effect {effect.name}: units do not fit{where}: {_as_line(error)}: correct the formula; a number "
            "with a dimension must be a Parameter"
        )
    return (
        f"{place}effect {effect.name}: {number} has no unit, but meets a quantity in [{unit}]{where}: make {number} a "
        f'Parameter: declare parameters={{"limit": Parameter({number}, "{unit}")}}, add the argument limit to the '
        f"function, and write limit in place of {number}"
    )


def _locate(effect: Effect, error: Exception) -> tuple[str, str]:
    """Return the file and line where the effect's file raised an error, and the expression there, where known."""
    file = effect.function.__code__.co_filename
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    if not frames or file.startswith("<"):
        return "", ""
    last = frames[-1]
    text = linecache.getline(file, last.lineno or 0).encode()
    one_line = last.lineno == last.end_lineno and last.colno is not None
    code = text[last.colno : last.end_colno].decode(errors="replace") if one_line else text.decode().strip()
    return f"{file}:{last.lineno}: ", code


def _find_bare_number(effect: Effect, code: str) -> str:
    """Return the first number without a unit that is an operand or an argument of an expression, empty without any."""
    try:
        (statement,) = ast.parse(code).body
    except (SyntaxError, ValueError):
        return ""
    node: Any = getattr(statement, "value", None)
    operands = [node]
    if isinstance(node, ast.Compare):
        operands = [node.left, *node.comparators]
    elif isinstance(node, ast.BinOp) and not isinstance(statement, ast.AugAssign):
        operands = [node.left, node.right]
    elif isinstance(node, ast.Call):
        operands = [*node.args, *(keyword.value for keyword in node.keywords)]
    for operand in operands:
        value = _evaluate(effect, operand)
        if value:  # pint lets 0 meet any unit
            return ast.unparse(operand)
    return ""


def _evaluate(effect: Effect, node: ast.expr | None) -> float:
    """Return the value of an expression of literal numbers and numbers of the file, 0 for any other expression."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.Name(id=name) if name not in (*effect.arguments, *effect.parameters):
            number = effect.function.__globals__.get(name)
            return float(number) if isinstance(number, int | float) else 0.0
        case ast.UnaryOp(operand=operand):
            return _evaluate(effect, operand)
        case ast.BinOp(left=left, right=right):
            return _evaluate(effect, left) and _evaluate(effect, right)
    return 0.0


def _find_unit(error: Exception) -> str:
    """Return the unit of the quantity that met a number: pint's error names it, or its frame holds the quantity."""
    units = [getattr(error, name, None) for name in ("units1", "units2")]
    trace = error.__traceback__
    while trace is not None:
        units.append(getattr(trace.tb_frame.f_locals.get("self"), "units", None))
        trace = trace.tb_next
    spelled = [f"{unit:~}".replace(" ", "") for unit in units if isinstance(unit, _registry().Unit)]
    return next((unit for unit in spelled if unit), "")


def _explain(effect: Effect, error: Exception) -> str:
    """Return the message for an error that the effect's function raises."""
    place, _ = _locate(effect, error)
    return f"{place}effect {effect.name}: raises {type(error).__name__}: {_as_line(error)}: correct the function"


def _as_line(error: BaseException | None) -> str:
    """Return the text of an exception as one line."""
    return " ".join(str(error).split())
