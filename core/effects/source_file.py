"""Text of a file with one effect, ready to be edited, checked and loaded."""

import json
import re
from collections.abc import Mapping, Sequence
from textwrap import indent
from typing import Final

from core.columns import SIGNALS
from core.effects.declaration import Parameter
from core.errors import EffectError

WIDTH: Final = 110
"""Characters a line of comment may have."""
_FUNCTION: Final = re.compile(r"[A-Za-z_]\w*")


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
