"""`socast effects`: look at the library of effects, and check a file of one's own."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from core import effects
from core.effects import Effect
from tools.output import JsonFile, write_json

app = typer.Typer(help="The physical effects that models are made of, and your own.", no_args_is_help=True)


@app.command("list")
def list_effects(
    file: Annotated[
        list[Path] | None, typer.Option("--effects", metavar="FILE", help="A file of your own effects to list too.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """List every effect: formula, coefficient with unit and plausible range, source."""
    for path in file or ():
        effects.load_file(path)
    _show(list(effects.library().values()), json_file)


@app.command("check")
def check_file(
    file: Annotated[Path, typer.Argument(help="A Python file with functions under @effect. Checking it runs it.")],
    json_file: JsonFile = None,
) -> None:
    """Check a file of your own effects: arguments, units, finite values, one value a row."""
    found = effects.load_file(file)
    _show(found, json_file)
    count = f"{len(found)} effect{'s' if len(found) > 1 else ''}"
    Console().print(Text(f"{count} in {file}: all checks passed."))


def _show(listed: list[Effect], json_file: Path | None) -> None:
    """Print effects as a table, and write them to a file where one is given."""
    table = Table(show_lines=True)
    table.add_column("effect", no_wrap=True)
    table.add_column("formula, source", ratio=1)
    table.add_column("coefficient")
    table.add_column("plausible", no_wrap=True)
    for effect in listed:
        unit = "" if effect.unit == "1" else f" [{effect.unit}]"
        formula = Text.assemble(effect.formula, "\n", (effect.source, "dim"))
        table.add_row(effect.name, formula, Text(effect.coefficient + unit), f"{effect.low:g} to {effect.high:g}")
    Console().print(table)
    write_json(json_file, [_plain(effect) for effect in listed])


def _plain(effect: Effect) -> dict[str, Any]:
    """Return what is declared of an effect, as JSON has it."""
    return {
        "name": effect.name,
        "summary": effect.summary,
        "formula": effect.formula,
        "coefficient": effect.coefficient,
        "unit": effect.unit,
        "plausible": [effect.low, effect.high],
        "per": effect.per,
        "columns": list(effect.arguments),
        "parameters": {
            name: {"value": p.value, "unit": p.unit, "bounds": list(p.bounds)} for name, p in effect.parameters.items()
        },
        "source": effect.source,
    }
