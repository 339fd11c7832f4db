"""Whether an effect is what it says: watt by units, one number a row, finite, and blind to the rows around it."""

import warnings
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from core.batch import Floats
from core.columns import KMH
from core.effects.declaration import SIGNAL_UNITS, Effect
from core.errors import EffectError

ORDINARY: Final[Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "dt": (0.5, 30.0),
        "speed": (0.0, 130 * KMH),
        "acceleration": (-4.0, 4.0),
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
        "charge": (0.0, 1.0),
        "pack_temperature": (233.15, 328.15),
        "vapour_pressure": (0.0, 5000.0),
        "water": (0.0, 0.01),
        "snow": (0.0, 0.1),
        "darkness": (0.0, 1.0),
    }
)
"""What a car on a road meets: an effect must be finite over it. Name of a column -> lowest, highest. [its unit]"""

_ROWS: Final = 257
_STANDING: Final = MappingProxyType(
    {"speed": 0.0, "acceleration": 0.0, "distance": 0.0, "stopped": 1.0, "turn_rate": 0.0, "traction": 0.0}
)


def check_effect(effect: Effect) -> None:
    """Check an effect's units, and its values over ordinary driving.

    Parameters
    ----------
    effect : Effect
        Called with quantities, then with 257 rows of ordinary driving: a standing car, every column at its ends, and in
        between; and so at the ends of each parameter's bounds.

    Raises
    ------
    EffectError
        Where the result times the coefficient's unit is not watt, is not one float a row, is not finite, depends on
        other rows, or changes its input; and where the function raises.
    """
    rows = _ordinary_rows(effect.arguments)
    _check_unit(effect, rows)
    result = _called(effect, rows)
    if not isinstance(result, np.ndarray) or result.shape != (_ROWS,) or result.dtype != np.float64:
        got = f"{result.dtype} {result.shape}" if isinstance(result, np.ndarray) else type(result).__name__
        raise EffectError(f"effect {effect.name}: returns {got} for {_ROWS} rows: return one float for every row")
    _check_finite(effect, rows, result)
    _check_parameters(effect, rows)
    for first, last in ((0, 1), (1, 2), (2, 19), (19, _ROWS), (5, 5)):
        part = _called(effect, {name: column[first:last] for name, column in rows.items()})
        if not np.array_equal(part, result[first:last]):
            raise EffectError(
                f"effect {effect.name}: rows {first} to {last} alone give another result than among all: "
                "a row must not depend on the others, so no mean, sum, diff or cumsum"
            )


def _ordinary_rows(names: tuple[str, ...]) -> dict[str, Floats]:
    """Return columns of ordinary driving: a standing car, all low, all high, then at random; not to be written to."""
    random = np.random.default_rng(20)
    rows = {}
    for name in ORDINARY:  # all of them, so that the rows are the same for every effect
        low, high = ORDINARY[name]
        column = low + (high - low) * random.random(_ROWS)
        column[:3] = _STANDING.get(name, (low + high) / 2), low, high
        column.flags.writeable = False
        rows[name] = column
    return {name: rows[name] for name in names}


def _called(effect: Effect, columns: Mapping[str, Any], constants: Mapping[str, Any] | None = None) -> Any:
    """Return what the function returns, any exception told as the effect's."""
    try:
        with np.errstate(all="ignore"):
            return effect.power(columns, constants)
    except Exception as error:  # whatever a user's function raises
        raise EffectError(f"effect {effect.name}: raises {type(error).__name__}: {_line(error)}") from error


def _check_parameters(effect: Effect, rows: Mapping[str, Floats]) -> None:
    """Check values at the ends of every parameter's bounds and on its grid: fitting may go there."""
    for name, parameter in effect.parameters.items():
        for value in sorted({*parameter.bounds, *parameter.grid} - {parameter.value}):
            moved = {**effect.constants, name: value}
            _check_finite(effect, rows, _called(effect, rows, moved), f"{name}={value:g} {parameter.unit}, ")


def _check_finite(effect: Effect, rows: Mapping[str, Floats], result: Floats, with_what: str = "") -> None:
    bad = np.flatnonzero(~np.isfinite(result))
    if bad.size:
        at = (f"{name}={rows[name][bad[0]]:g} {SIGNAL_UNITS[name]}" for name in effect.arguments)
        where = with_what + ", ".join(at)
        raise EffectError(f"effect {effect.name}: gives {result[bad[0]]} at {where}, which a car can meet: guard it")


@cache
def _units() -> Any:
    """Return pint's registry; half of pint's cost is reading it, and only checks need it."""
    import pint  # noqa: PLC0415

    return pint.UnitRegistry()


def _unit(effect: Effect, text: str) -> Any:
    try:
        return _units().Unit(text)
    except Exception as error:  # pint raises half a dozen kinds, tokenize's among them
        raise EffectError(f"effect {effect.name}: unit {text!r} is none that pint knows: {_line(error)}") from error


def _check_unit(effect: Effect, rows: Mapping[str, Floats]) -> None:
    """Call the effect with quantities: the result times the coefficient's unit must be exactly watt."""
    quantity = _units().Quantity
    columns = {name: quantity(column, _unit(effect, SIGNAL_UNITS[name])) for name, column in rows.items()}
    constants = {}
    for name, parameter in effect.parameters.items():
        unit = _unit(effect, parameter.unit)
        si = quantity(1.0, unit).to_base_units()
        if si.magnitude != 1.0:
            raise EffectError(
                f"effect {effect.name}: parameter {name} is in [{parameter.unit}], and columns are in SI units: "
                f"give its value in [{si.units:~}]"
            )
        constants[name] = quantity(parameter.value, unit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            result = _called(effect, columns, constants)
        except EffectError as error:
            cause = error.__cause__
            if type(cause).__name__ not in ("DimensionalityError", "OffsetUnitCalculusError", "UnitStrippedWarning"):
                raise
            raise EffectError(
                f"effect {effect.name}: units do not fit: {_line(cause)}; a number with a dimension must be a parameter"
            ) from error
    got = getattr(result, "units", _units().dimensionless)
    product = got * _unit(effect, effect.unit)
    watt = _units().Unit("W")
    if not product.is_compatible_with(watt) or not np.isclose(
        quantity(1.0, product).to(watt).magnitude, 1.0, rtol=1e-12
    ):
        raise EffectError(
            f"effect {effect.name}: function gives [{got:~}], times the coefficient's [{effect.unit}] that is "
            f"[{product:~}], not [W]: put the formula, the coefficient's unit or a parameter's unit right"
        )


def _line(error: BaseException | None) -> str:
    """Return what an exception says, as one line."""
    return " ".join(str(error).split())
