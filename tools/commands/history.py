"""Run `socast history`: show every step of a model and how its error fell."""

from pathlib import Path
from typing import Annotated

import typer

from socast.core import models
from socast.core.diagnose.add.records import summarise_history
from socast.tools.terminal.output import EffectFiles, HtmlFile, JsonFile, check_outputs, write_json
from socast.tools.terminal.report_output import show_report


def show_history(
    model: Annotated[str, typer.Argument(metavar="M", help="A model file.")],
    html_file: HtmlFile = None,
    json_file: JsonFile = None,
    _: EffectFiles = None,
) -> None:
    """Show the history of a model: every effect that was tried, and the error after each step against the noise."""
    loaded = models.load(model)
    check_outputs([Path(model)], html_file, json_file)
    write_json(json_file, "history", summarise_history(loaded).to_json())
    show_report("history", loaded, html_file, json_file)
