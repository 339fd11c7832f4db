"""Text of a file to begin an effect of one's own with: a pattern, a copy of an effect, or a formula."""

import ast
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from textwrap import dedent, indent
from types import ModuleType
from typing import Final

from core.columns import SIGNALS
from core.declaration import Effect, Parameter
from core.errors import EffectError

WIDTH: Final = 110
"""Characters a line of comment may have."""
_FUNCTION: Final = re.compile(r"[A-Za-z_]\w*")


def blank(name: str = "my_effect") -> str:
    """Return a file with one effect to be changed into one's own, and what it may use."""
    return render(
        name,
        arguments=("stop_rate", "ambient"),
        body="return stop_rate * np.maximum(inside - ambient, 0.0)",
        documentation="Say what it is: P = n max(T_in - T, 0), times J/K.",
        coefficient="what is fitted, in words",
        unit="J/K",
        low=300.0,
        high=30_000.0,
        source="where formula and range come from, to the page or DOI",
        per="time",
        parameters={"inside": Parameter(294.15, "K", 285.15, 299.15, grid=(288.15, 294.15, 298.15))},
        shown_by="which data shows it best (may be left out)",
        words="each stop costs {value} kJ for each degree that it is colder outside than {inside} (may be left out)",
        scale=1e-3,
    )


def from_effect(effect: Effect, name: str) -> str:
    """Return a file with a copy of an effect under another name.

    Raises
    ------
    EffectError
        Where its source is not at hand.
    """
    try:
        source = dedent(inspect.getsource(effect.function))
    except OSError as error:
        raise EffectError(f"effect {effect.base}: its source is not at hand: begin with an empty scaffold") from error
    (function,) = ast.parse(source).body
    if not isinstance(function, ast.FunctionDef):
        raise EffectError(f"effect {effect.base}: it is no plain function: begin with an empty scaffold")
    first = function.body[1]  # after the documentation
    body = dedent("\n".join(source.splitlines()[first.lineno - 1 :]))
    return render(
        name,
        arguments=tuple(a.arg for a in (*function.args.args, *function.args.kwonlyargs) if a.arg in effect.arguments),
        body=body,
        documentation=inspect.getdoc(effect.function) or "",
        coefficient=effect.coefficient,
        unit=effect.unit,
        low=effect.low,
        high=effect.high,
        source=effect.source,
        per=effect.per,
        parameters=effect.parameters,
        confused_with=(effect.base,),
        shown_by=effect.shown_by,
        words=effect.words,
        scale=effect.scale,
        imports=_imports(effect),
    )


def render(
    name: str,
    *,
    arguments: Sequence[str],
    body: str,
    documentation: str,
    coefficient: str,
    unit: str,
    low: float,
    high: float,
    source: str,
    per: str = "distance",
    parameters: Mapping[str, Parameter] | None = None,
    confused_with: Sequence[str] = (),
    shown_by: str = "",
    words: str = "",
    scale: float = 1.0,
    imports: Sequence[str] = (),
) -> str:
    """Return the text of a file with one effect, ready to be edited and checked.

    Parameters
    ----------
    name : str
        Of the function and the effect.
    arguments : sequence of str
        Columns that it takes.
    body : str
        Statements of the function, the last of which returns; numpy is `np`.
    documentation : str
        With the formula, as `P = ...`.
    coefficient, unit, low, high, source, per, parameters, confused_with, shown_by, words, scale
        As of `core.effects.effect`.
    imports : sequence of str
        Lines that import what the body needs besides numpy.

    Raises
    ------
    EffectError
        For a name that no function can have.
    """
    if not _FUNCTION.fullmatch(name):
        raise EffectError(f"effect {name!r}: a function cannot be called that: use letters, digits and _")
    given = dict(parameters or {})
    moved = ", ".join(f"{_text(n)}: {_parameter(p)}" for n, p in given.items())
    declared = [
        f"coefficient={_text(coefficient)}",
        f"unit={_text(unit)}",
        f"low={low!r}",
        f"high={high!r}",
        f"source={_text(source)}",
        *([f"per={_text(per)}"] if per != "distance" else []),
        *([f"parameters={{{moved}}}"] if given else []),
        *([f"confused_with=[{', '.join(map(_text, confused_with))}]"] if confused_with else []),
        *([f"shown_by={_text(shown_by)}"] if shown_by else []),
        *([f"words={_text(words)}"] if words else []),
        *([f"scale={scale!r}"] if scale != 1.0 else []),
    ]
    what = "Parameter, effect" if given else "effect"
    uses_numpy = ["import numpy as np", ""] if re.search(r"\bnp\.", body) else []
    lines = [
        '"""An effect of my own: check it with `socast effects check FILE`, then use it with `--effects FILE`."""',
        "",
        *uses_numpy,
        f"from core.effects import {what}",
        *imports,
        "",
        *_columns(),
        "",
        "",
        "@effect(",
        *(f"    {line}," for line in declared),
        ")",
        f"def {name}({', '.join((*arguments, *given))}):",
        indent(f'"""{documentation}\n"""' if "\n" in documentation else f'"""{documentation}"""', "    "),
        indent(body.rstrip(), "    "),
    ]
    return "\n".join(lines) + "\n"


def _text(said: str) -> str:
    """Return a string as Python has it, in double quotes."""
    return json.dumps(said, ensure_ascii=False)


def _parameter(parameter: Parameter) -> str:
    """Return the call that makes a parameter."""
    said = [repr(parameter.value), _text(parameter.unit)]
    if parameter.low is not None or parameter.high is not None:
        said += [repr(parameter.low), repr(parameter.high)]
    return f"Parameter({', '.join([*said, *([f'grid={parameter.grid!r}'] if parameter.grid else [])])})"


def _columns() -> list[str]:
    """Return comments that name every column that an effect may take."""
    lines = ["# Arguments are columns, in SI, filled in by name, and the names of parameters:"]
    for column in SIGNALS:
        unit = "" if column.unit == "1" else f" [{column.unit}]"
        lines.append(f"#   {column.name}{unit}: {column.meaning}"[:WIDTH])
    return lines


def _imports(effect: Effect) -> list[str]:
    """Return lines that import what a function takes from its module besides numpy."""
    code, there = effect.function.__code__, effect.function.__globals__
    taken = {name: there[name] for name in code.co_names if name in there}
    return [
        f"from {value.__module__} import {name}"
        for name, value in taken.items()
        if not isinstance(value, ModuleType) and hasattr(value, "__module__")
    ]
