"""Run `socast add`: add an effect to a model if it helps on rides to which it was not fitted."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import pandas as pd
import typer

from socast.core import models
from socast.core.diagnose.add import add
from socast.core.diagnose.add.records import UNDECIDED
from socast.core.diagnose.add.terms import build_term_columns
from socast.core.diagnose.gains import LEAST_GAIN
from socast.core.diagnose.residual_survey import survey_model
from socast.core.errors import ModelError
from socast.core.evaluate.compare.records import ResidualSurvey
from socast.core.fit.measured_rows import join_tables
from socast.core.models import LinearModel
from socast.tools.commands.diagnose import LeastGain, read_tables
from socast.tools.terminal.output import (
    HtmlFile,
    JsonFile,
    make_console,
    print_plain,
    write_json,
)
from socast.tools.terminal.progress import show_elapsed
from socast.tools.terminal.ride_source import RideSource, insert_ride_source


@insert_ride_source
def add_effect(
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="Effect of `socast effects list`, or a variant.")],
    *,
    source: RideSource,
    model: Annotated[str, typer.Option("--model", metavar="M", help="Model name or file; the file is not changed.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="M2",
            help="Model file to write, not M. If the effect is refused: M with the attempt in its history.",
        ),
    ],
    scope: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCOPE", help="Where the effect holds: vehicle=ID, since=YYYY-MM-DD or both; default all."
        ),
    ] = None,
    even_if_undecided: Annotated[
        bool, typer.Option("--even-if-undecided", help="Add the effect where the rides do not decide whether it helps.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Add the effect even if it does not help.")] = False,
    least_gain: LeastGain = LEAST_GAIN,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Add an effect to a model, refit it, and compare the errors on held-out days and vehicles."""
    from socast.tools.report import history, page  # noqa: PLC0415 - figures take seconds to import

    source.check(out, json_file, html_file, models=[model])
    base = models.load(model)
    build_term_columns(effect, scope or ())  # refuses a wrong scope before the rides are read
    tables = read_tables(source, base)
    with show_elapsed("fitting with and without the effect"):
        added = try_effect(base, effect, scope or (), *tables, least=least_gain)
    write_json(json_file, "add", added.trial.to_json())
    console = make_console(json_file)
    if html_file:
        surveys = survey_both(base, added.model, *tables)
        page.write_report(history.build_trial_report(added.trial, surveys), html_file)
    history.print_trial(added.trial, console)
    if html_file:
        print_plain(console, f"report in {html_file}")
    if not added.trial.accepted:
        undecided = added.trial.outcome == UNDECIDED
        if not (force or (undecided and even_if_undecided)):
            models.save(add.log_attempt(base, added.trial), out)
            what, option = ("undecided", "--even-if-undecided") if undecided else ("refused", "--force")
            raise ModelError(
                f"{effect} is not added, it is {what}: {added.trial.reason}; {out} holds model {base.name} without it, "
                f"and the attempt in its history; add the effect all the same with {option}"
            )
        added = add.force_addition(added)
    models.save(added.model, out)
    print_plain(
        console,
        f"{out}: {base.name} with {effect}, version {added.model.version}; show its steps: socast history {out}",
    )


def survey_both(
    before: LinearModel, after: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame
) -> list[ResidualSurvey]:
    """Return where two models fail on the windows of rides; an empty list where the windows do not show it."""
    try:
        return [msgspec.convert(survey_model(rides, windows, model), ResidualSurvey) for model in (before, after)]
    except ModelError:
        return []


def try_effect(
    model: LinearModel,
    effect: str,
    scope: Sequence[str],
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    *,
    least: float = LEAST_GAIN,
    report: Callable[[float, str], None] = lambda *_: None,
) -> add.AdditionTrial:
    """Return the trial of an effect on the rides of two tables.

    Parameters
    ----------
    report : callable
        Function that receives the share of the work that is done and the step in words.
    """
    columns = build_term_columns(effect, scope)
    joined = join_tables(rides, windows)
    return add.add_effect(model, effect, columns, joined, rides=rides, least=least, report=report)
