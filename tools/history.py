"""`socast history`: what was done to a model, step by step, and how its error fell."""

from pathlib import Path
from typing import Annotated

import typer

from core import effects, models
from tools.diagnose import HtmlFile
from tools.output import EffectFiles, JsonFile, printer, writable, write_json


def show_history(
    model: Annotated[str, typer.Argument(metavar="M", help="A model file.")],
    html_file: HtmlFile = None,
    json_file: JsonFile = None,
    effects_file: EffectFiles = None,
) -> None:
    """Tell a model's history: the error falling step by step, every attempt included, above the measurement's noise."""
    from tools.report import history  # noqa: PLC0415 - figures take seconds to import

    for path in effects_file or ():
        effects.load_file(path)
    chosen = models.load(model)
    writable([Path(model)], html_file, json_file)
    console = printer()
    history.show(chosen, console)
    write_json(json_file, history.summary(chosen))
    if html_file:
        history.write(chosen, html_file)
        console.print(f"report in {html_file}", markup=False, highlight=False, soft_wrap=True)
