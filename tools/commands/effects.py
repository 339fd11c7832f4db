"""`socast effects`: show the library of effects, and write and check files of user-defined effects."""

import ast
import inspect
from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from socast.core import effects
from socast.core.columns import SIGNALS
from socast.core.effects.declaration import Effect, Parameter
from socast.core.effects.source_file import render_source
from socast.core.errors import EffectError
from socast.core.formatting import everyday
from socast.tools.terminal.output import (
    EffectFiles,
    JsonFile,
    check_outputs,
    make_console,
    print_plain,
    refuse,
    refuse_existing,
    write_file,
    write_json,
)
from socast.tools.terminal.rich_table import Column, make_description, make_table

app = typer.Typer(help="The physical effects that models are made of, and your own.", no_args_is_help=True)

SIGNS = {1: "not negative", -1: "not positive", 0: "either"}
MEANINGS = {column.name: column for column in SIGNALS}


@app.command("list")
def list_effects(_: EffectFiles = None, json_file: JsonFile = None) -> None:
    """List every effect by topic.

    Each has its formula and its coefficient with unit and plausible range.

    Examples
    --------
    socast effects list
    socast effects list --effects my_effects.py --json - | jq '.effects[].name'
    """
    topics = effects.group_by_topic()
    table = _tabulate(())
    for topic, effects_of_topic in topics.items():
        table.add_section()
        table.add_row(Text(topic, "bold"))
        for effect in effects_of_topic:
            table.add_row(*_describe(effect))
    listed = [
        make_effect_record(effect, topic) for topic, effects_of_topic in topics.items() for effect in effects_of_topic
    ]
    write_json(json_file, "effects", {"effects": listed})
    make_console(json_file).print(table)


@app.command("show")
def show(
    name: Annotated[str, typer.Argument(metavar="E", help="Name of an effect, or of a variant of one.")],
    _: EffectFiles = None,
    json_file: JsonFile = None,
) -> None:
    """Show everything that an effect declares.

    This is its formula and source, its parameters, the effects that it is confused with and the data that show it.

    Examples
    --------
    socast effects show cold_rolling
    """
    effect = effects.get(name)
    topic = find_topic(effect)
    write_json(json_file, "effect", make_effect_record(effect, topic))
    description = make_description([(name, Text(text)) for name, text in _list_properties(effect, topic) if text])
    make_console(json_file).print(description)


@app.command("check")
def check_file(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.py", help="A Python file with functions under @effect. Checking it runs it.")
    ],
    json_file: JsonFile = None,
) -> None:
    """Check a file of your own effects.

    The checks are of arguments, units, finite values, and one value per row.

    Examples
    --------
    socast effects check my_effects.py
    """
    checked = effects.load_file(file)
    write_json(json_file, "effects", {"effects": [make_effect_record(effect, file.name) for effect in checked]})
    console = make_console(json_file)
    console.print(_tabulate(checked))
    count = f"{len(checked)} effect{'s' if len(checked) > 1 else ''}"
    console.print(Text(f"{count} in {file}: all checks passed."))


@app.command("new")
def new_file(
    file: Annotated[Path, typer.Argument(metavar="FILE.py", help="The Python file to write.")],
    origin: Annotated[str | None, typer.Option("--from", metavar="E", help="Begin with a copy of this effect.")] = None,
) -> None:
    """Write a file to begin your own effect with.

    The file holds one effect, or a copy of one, to be edited. It passes its check as it is.

    Examples
    --------
    socast effects new my_effects.py
    socast effects new my_effects.py --from cold_rolling
    """
    refuse((file.suffix != ".py", f"{file}: effects are written in Python: name a file that ends in .py"))
    refuse_existing(file)
    name = "my_effect" if origin is None else f"my_{effects.get(origin).base}"
    content = blank(name) if origin is None else from_effect(effects.get(origin), name)
    check_outputs((), file)
    write_file(file, content.encode())
    print_plain(
        make_console(),
        f"{file} holds the effect {name}. Edit it, then: socast effects check {file}",
    )


def _list_properties(effect: Effect, topic: str) -> list[tuple[str, str]]:
    """Return the labels and texts of the description of an effect."""
    unit = "" if effect.unit == "1" else f" [{effect.unit}]"
    paragraphs = effect.documentation.split("\n\n")[1:]
    parameters = list(map(_parameter, effect.parameters, effect.parameters.values(), effect.constants.values()))
    return [
        ("effect", f"{effect.name} ({topic})"),
        ("what it is", effect.summary.partition(": P = ")[0]),
        ("formula", effect.formula),
        ("", "\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)),
        ("coefficient", effect.coefficient + unit),
        ("plausible", f"{_range(effect)}{unit}, sign {SIGNS[effect.sign]}"),
        ("in words", f"for example: {effect.in_words((effect.low + effect.high) / 2)}"),
        ("acts", "by motion, over the time that the distance took" if effect.per == "distance" else "all the time"),
        ("parameters", "\n".join(parameters)),
        ("takes", "\n".join(map(_column, effect.arguments))),
        ("source", effect.source),
        ("confused with", ", ".join(effect.confused_with)),
        ("shown by", effect.shown_by),
        ("in tables as", ", ".join(_tabulated(effect))),
    ]


def _tabulate(listed: Iterable[Effect]) -> Table:
    """Return a table of effects."""
    columns = [
        Column("effect", fixed=True),
        Column("formula", ratio=1),
        Column("coefficient", ratio=1),
        Column("plausible"),
        Column("per", fixed=True),
    ]
    return make_table(columns, rows=map(_describe, listed))


def _describe(effect: Effect) -> Sequence[str | Text]:
    """Return the row of an effect."""
    unit = "" if effect.unit == "1" else f" [{effect.unit}]"
    return effect.name, Text(effect.formula), Text(effect.coefficient + unit), _range(effect), effect.per


def _range(effect: Effect) -> str:
    """Return the text of the plausible range of a coefficient."""
    return f"{effect.low:g} to {effect.high:g}"


def _parameter(name: str, parameter: Parameter, value: float) -> str:
    """Return the text of a parameter: value, bounds, and values in tables."""
    low, high = parameter.bounds
    text = f"{name} = {value:g} {parameter.unit}".removesuffix(" 1")
    if (shown := everyday(value, parameter.unit)) not in text:
        text += f" ({shown})"
    text += f", {low:g} to {high:g}" if low < high else ", fixed"
    return text + (f"; in tables at {', '.join(f'{v:g}' for v in parameter.grid)}" if parameter.grid else "")


def _column(name: str) -> str:
    """Return the text of a column: name, unit and meaning."""
    column = MEANINGS[name]
    unit = "" if column.unit == "1" else f" [{column.unit}]"
    return f"{name}{unit}: {column.meaning}"


def _tabulated(effect: Effect) -> list[str]:
    """Return the table columns of an effect and its variants."""
    base = effects.get(effect.base)
    return [each.energy_name for each in (base, *base.variants)]


def find_topic(effect: Effect) -> str:
    """Return the topic of an effect: of the library, or the name of the user's file."""
    return next(
        topic
        for topic, effects_of_topic in effects.group_by_topic().items()
        if effect.base in [e.name for e in effects_of_topic]
    )


def make_effect_record(effect: Effect, topic: str) -> dict[str, Any]:
    """Return the declaration of an effect, for JSON."""
    return {
        "name": effect.name,
        "topic": topic,
        "summary": effect.summary,
        "formula": effect.formula,
        "coefficient": effect.coefficient,
        "unit": effect.unit,
        "plausible": [effect.low, effect.high],
        "sign": effect.sign,
        "per": effect.per,
        "columns": list(effect.arguments),
        "parameters": {
            name: {"value": effect.constants[name], "unit": p.unit, "bounds": list(p.bounds), "grid": list(p.grid)}
            for name, p in effect.parameters.items()
        },
        "source": effect.source,
        "confused_with": list(effect.confused_with),
        "shown_by": effect.shown_by,
        "words": effect.words,
        "scale": effect.scale,
        "tabulated": _tabulated(effect),
    }


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
