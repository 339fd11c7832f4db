"""Write a form outside the library as text: its formula, its unit, and a source file to edit."""

from functools import lru_cache
from typing import Final, NamedTuple

from socast.core.diagnose.forms.terms import FormTerm, Modulator
from socast.core.effects.declaration import Parameter
from socast.core.effects.source_file import render_source

ROOM_FOR: Final = 5.0
"""Factor on either side of the fitted coefficient within which it is plausible, until the author declares a range."""


class _Written(NamedTuple):
    """Hold a modulator as a formula and as code, with its constant."""

    formula: str
    code: str
    limit_text: str = ""
    name: str = ""
    parameter: Parameter | None = None


def format_formula(term: FormTerm) -> str:
    """Return the formula of the power of a term, with a coefficient c."""
    written = [_write(each) for each in term.modulators]
    factors = ["c", *(each.formula for each in written), *([term.carrier.symbol] if term.carrier.symbol else [])]
    return ", ".join([f"P = {' · '.join(factors)}", *(each.limit_text for each in written if each.limit_text)])


def derive_unit(term: FormTerm) -> str:
    """Return the unit of the coefficient of a term with which its power is in watt, as pint spells it."""
    unit = term.carrier.unit
    for each in term.modulators:
        of_variable = each.variable.unit
        if of_variable != "1" and each.shape != "decay":
            unit += f"/({of_variable})" if "/" in of_variable else f"/{of_variable}"
            unit += "^2" if each.shape == "square" else ""
    return unit


def list_symbols(term: FormTerm) -> dict[str, str]:
    """Return the symbols of the formula of a form with their meanings."""
    of_load = {term.carrier.symbol: term.carrier.meaning} if term.carrier.symbol else {}
    return {each.variable.symbol: each.variable.meaning for each in term.modulators} | of_load


def name_term(term: FormTerm) -> str:
    """Return the name of the effect of a term."""
    return "_and_".join([f"suggested_{term.carrier.name}", *sorted(term.variables)])


def format_source_file(term: FormTerm, coefficient: float, windows: int) -> str:
    """Return the source of a Python file with the effect of a term, which passes `socast effects check`."""
    written = [_write(each) for each in term.modulators]
    arguments = [*term.carrier.arguments, *(a for each in term.modulators for a in each.variable.arguments)]
    code = [*([term.carrier.code] if term.carrier.code else []), *(each.code for each in written)]
    meanings = ", ".join(f"{each.variable.meaning} {each.variable.symbol}" for each in term.modulators)
    bounds = sorted((float(f"{coefficient / ROOM_FOR:.2g}"), float(f"{coefficient * ROOM_FOR:.2g}")))
    return render_source(
        name_term(term),
        arguments=tuple(dict.fromkeys(arguments)) or ("dt",),
        body=f"return {' * '.join(code) or 'np.ones_like(dt)'}",
        documentation="\n\n".join(
            ["Describe the effect.", format_formula(term), *([f"With {meanings}."] if meanings else [])],
        ),
        coefficient="describe c",
        unit=derive_unit(term),
        low=bounds[0],
        high=bounds[1],
        source=f"suggested by {windows:,} windows of driving; range: a fifth to five times the fit. State here where "
        "formula and range are published",
        per=term.carrier.per,
        parameters={
            **term.carrier.parameters,
            **{each.name: each.parameter for each in written if each.parameter is not None},
        },
        confused_with=(term.carrier.alike,),
    )


@lru_cache(1024)
def _write(modulator: Modulator) -> _Written:
    """Return a modulator as a formula and as code."""
    x, code, unit = modulator.variable.symbol, modulator.variable.code, modulator.variable.unit
    if modulator.shape == "linear":
        return _Written(x, code)
    if modulator.shape == "square":
        return _Written(f"({x})²" if " " in x else f"{x}²", f"({code}) ** 2")
    limit, constant = f"{x}0", f"{modulator.variable.name}_{'scale' if modulator.shape == 'decay' else 'limit'}"
    formula, coded = {
        "above": (f"max({x} − {limit}, 0)", f"np.maximum({code} - {constant}, 0.0)"),
        "below": (f"max({limit} − {x}, 0)", f"np.maximum({constant} - {code}, 0.0)"),
        "decay": (f"exp(−{x}/{limit})", f"np.exp(-{code} / {constant})"),
    }[modulator.shape]
    at, grid = modulator.at, modulator.grid
    value = f"{limit} = {at:.4g}" + ("" if unit == "1" else f" {unit}")
    moved = Parameter(at, unit, grid[0], grid[-1], grid) if len(grid) > 1 else Parameter(at, unit)
    return _Written(formula, coded, value, constant, moved)
