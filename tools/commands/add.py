"""`socast add`: an effect into a model, if it helps on rides that it was not fitted to."""

from pathlib import Path
from typing import Annotated

import typer

from core import models
from core.diagnose.add import add
from core.diagnose.add.terms import build_term_columns
from core.diagnose.dataset import gather_windows, join_tables
from core.diagnose.noise import compute_ride_noise_floor
from core.diagnose.ranking import LEAST_GAIN
from core.errors import ModelError
from core.models import BUILT_IN_MODELS, LinearModel
from tools.commands.diagnose import LeastGain, read_files, read_tables
from tools.terminal.output import EffectFiles, JsonFile, model_files, printer, writable, write_json


def add_effect(
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="Of `socast effects list`, or a variant of one.")],
    model: Annotated[str, typer.Option("--model", metavar="M", help="A model's name, or a model file.")],
    data: Annotated[list[Path], typer.Option("--data", metavar="TABLES|REC", help="Rides to fit to; may be repeated.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="M2", help="The model file to write.")],
    scope: Annotated[
        list[str] | None,
        typer.Option(metavar="SCOPE", help="Where it holds: vehicle=ID, since=YYYY-MM-DD, or both; else everywhere."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Add it even if it does not help.")] = False,
    effects_file: EffectFiles = None,
    least_gain: LeastGain = LEAST_GAIN,
    json_file: JsonFile = None,
) -> None:
    """Add an effect to a model, refit it, and tell the error before and after on held-out days and vehicles."""
    from tools.report import history  # noqa: PLC0415 - figures take seconds to import

    chosen = models.load(model)
    columns = build_term_columns(effect, scope or ())
    writable([*read_files(data), *model_files([model]), *(effects_file or ())], out, json_file)
    rides, windows = read_tables(data, chosen)
    floor = compute_ride_noise_floor(gather_windows(rides, windows, chosen))
    added = add.add_effect(
        chosen, effect, columns, join_tables(rides, windows), rides=rides, floor=floor, least=least_gain
    )
    write_json(json_file, added.trial)
    console = printer()
    history.print_trial(added.trial, console)
    if not added.trial["accepted"]:
        if not force:
            raise ModelError(_refused(chosen, model, added))
        added = add.force_addition(added)
    models.save(added.model, out)
    told = f"{out}: {chosen.name} with {effect}, version {added.model.version}; socast history {out} tells its steps"
    console.print(told, markup=False, highlight=False, soft_wrap=True)


def _refused(chosen: LinearModel, given: str, added: add.AdditionTrial) -> str:
    """Log the attempt in the model's own file, and return what to tell."""
    kept = "" if given in BUILT_IN_MODELS else _log(add.log_attempt(chosen, added.trial), Path(given))
    return f"{added.trial['effect']} is not added: {added.trial['reason']}{kept}; add it all the same with --force"


def _log(model: LinearModel, path: Path) -> str:
    """Write a model file anew, whole or not at all, and return what came of it."""
    file = path.resolve()
    beside = file.with_name(f"{file.name}.new")
    try:
        beside.write_bytes(models.encode_model(model))
        beside.replace(file)
    except OSError as error:
        return f" (and {path} cannot take the attempt into its history: {error.strerror})"
    return f" (the attempt is in the history of {path})"
