"""The text of a file with one effect, ready to be edited, checked and loaded."""

import json
import re
from collections.abc import Mapping, Sequence
from textwrap import indent
from typing import Final

from socast.core.columns import SIGNALS
from socast.core.effects.declaration import Parameter
from socast.core.errors import EffectError

WIDTH: Final = 110
"""Most characters of a comment line."""
_FUNCTION: Final = re.compile(r"[A-Za-z_]\w*")


def render_source(
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
    """Return the text of a file with one effect, ready to be edited and checked."""
    if not _FUNCTION.fullmatch(name):
        raise EffectError(f"effect {name!r}: not the name of a function: use letters, digits and _")
    constants = dict(parameters or {})
    moved = ", ".join(f"{_quote(n)}: {_parameter(p)}" for n, p in constants.items())
    declared = [
        f"coefficient={_quote(coefficient)}",
        f"unit={_quote(unit)}",
        f"low={low!r}",
        f"high={high!r}",
        f"source={_quote(source)}",
        f"per={_quote(per)}",
        *([f"parameters={{{moved}}}"] if constants else []),
        *([f"confused_with=[{', '.join(map(_quote, confused_with))}]"] if confused_with else []),
        *([f"shown_by={_quote(shown_by)}"] if shown_by else []),
        *([f"words={_quote(words)}"] if words else []),
        *([f"scale={scale!r}"] if scale != 1.0 else []),
    ]
    imported = "Parameter, effect" if constants else "effect"
    uses_numpy = ["import numpy as np", ""] if re.search(r"\bnp\.", body) else []
    lines = [
        '"""An effect of my own: check it with `socast effects check FILE`, then use it with `--effects FILE`."""',
        "",
        *uses_numpy,
        f"from socast import {imported}",
        *imports,
        "",
        *_columns(),
        "",
        "",
        "@effect(",
        *(f"    {line}," for line in declared),
        ")",
        f"def {name}({', '.join((*arguments, *constants))}):",
        indent(f'"""{documentation}\n"""' if "\n" in documentation else f'"""{documentation}"""', "    "),
        indent(body.rstrip(), "    "),
    ]
    return "\n".join(lines) + "\n"


def _quote(parts: str) -> str:
    """Return a Python string literal in double quotes."""
    return json.dumps(parts, ensure_ascii=False)


def _parameter(parameter: Parameter) -> str:
    """Return the call that makes a parameter."""
    parts = [repr(parameter.value), _quote(parameter.unit)]
    if parameter.low is not None or parameter.high is not None:
        parts += [repr(parameter.low), repr(parameter.high)]
    return f"Parameter({', '.join([*parts, *([f'grid={parameter.grid!r}'] if parameter.grid else [])])})"


def _columns() -> list[str]:
    """Return comments that name every column that an effect may take."""
    lines = ["# Arguments are columns in SI units, filled in by name, and names of parameters:"]
    for column in SIGNALS:
        unit = "" if column.unit == "1" else f" [{column.unit}]"
        lines.append(f"#   {column.name}{unit}: {column.meaning}"[:WIDTH])
    return lines
