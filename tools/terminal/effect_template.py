"""Templates for files of user-defined effects: an empty effect, or a copy of an existing one."""

import ast
import inspect
from textwrap import dedent
from types import ModuleType

from socast.core.effects.declaration import Effect, Parameter
from socast.core.effects.source_file import render_source
from socast.core.errors import EffectError


def blank(name: str = "my_effect") -> str:
    """Return the text of a file with one example effect that the user edits."""
    return render_source(
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
    """Return the text of a file with a copy of an effect under another name."""
    try:
        source = dedent(inspect.getsource(effect.function))
    except OSError as error:
        raise EffectError(f"effect {effect.base}: its source is not at hand: begin with an empty scaffold") from error
    (function,) = ast.parse(source).body
    if not isinstance(function, ast.FunctionDef):
        raise EffectError(f"effect {effect.base}: it is no plain function: begin with an empty scaffold")
    first = function.body[1]  # the statement after the docstring
    body = dedent("\n".join(source.splitlines()[first.lineno - 1 :]))
    return render_source(
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


def _imports(effect: Effect) -> list[str]:
    """Return import statements for the names that a function uses from its module, without imported modules."""
    code, there = effect.function.__code__, effect.function.__globals__
    taken = {name: there[name] for name in code.co_names if name in there}
    return [
        f"from {value.__module__} import {name}"
        for name, value in taken.items()
        if not isinstance(value, ModuleType) and hasattr(value, "__module__")
    ]
