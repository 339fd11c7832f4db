"""`socast history`: what was done to a model, step by step, and how its error fell."""

from pathlib import Path
from typing import Annotated

import typer

from core import models
from tools.terminal.output import EffectFiles, HtmlFile, JsonFile, report, writable, write_json


def show_history(
    model: Annotated[str, typer.Argument(metavar="M", help="A model file.")],
    html_file: HtmlFile = None,
    json_file: JsonFile = None,
    _: EffectFiles = None,
) -> None:
    """Tell a model's history: the error falling step by step, every attempt included, above the measurement's noise."""
    from tools.report import history  # noqa: PLC0415 - figures take seconds to import

    chosen = models.load(model)
    writable([Path(model)], html_file, json_file)
    write_json(json_file, history.summarise(chosen))
    report("history", chosen, html_file)
