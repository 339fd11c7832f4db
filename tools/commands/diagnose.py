"""`socast diagnose`: where a model fails and why, from tables or recordings; with `--auto` the loop to the end."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from rich.console import Console

from core import effects, models
from core.diagnose.add import add
from core.diagnose.add.holdout import select_final_days
from core.diagnose.add.terms import build_term_columns
from core.diagnose.dataset import gather_windows, join_tables
from core.diagnose.noise import compute_ride_noise_floor
from core.diagnose.ranking import LEAST_GAIN
from core.effects.road_load import ROAD_LOAD
from core.errors import ModelError, SettingsError
from core.evaluate.paper.results import to_json_values
from core.fit.ride_blocks import get_names
from core.models import BUILT_IN_MODELS, VEHICLE, VEHICLE_MODEL, LinearModel
from core.models.features import EFFECT_PREFIX, FEATURES, is_scope
from tools.commands.evaluate import KEY, read
from tools.commands.fit import RECORDING, Rides, inputs
from tools.commands.tables import WINDOWS, in_memory
from tools.terminal.output import EffectFiles, HtmlFile, JsonFile, model_files, printer, report, writable, write_json

MEASURED = ("energy_kwh", "energy_sd_kwh", "energy_vi_kwh", "energy_vi_sd_kwh", "energy_soc_kwh", "energy_soc_sd_kwh")
OF_BOTH = (KEY, VEHICLE, VEHICLE_MODEL, *MEASURED, *(effect.energy_name for effect in ROAD_LOAD))
OF_WINDOWS = (*OF_BOTH, *(name for name in FEATURES if name not in {"winter", "summer"}))
OF_RIDES = (*OF_BOTH, "ride_id", "date", "fit_for_training", *FEATURES)
"""Columns that diagnosis reads of either table, beside those of candidate effects."""
MOST_STEPS = 8
"""Effects that `--auto` adds at most."""

LeastGain = Annotated[
    float, typer.Option(metavar="SHARE", min=0.0, max=1.0, help="Gain below which an effect is not worth its place.")
]


def diagnose_rides(
    rides: Rides,
    model: Annotated[str, typer.Option("--model", metavar="M", help="A model's name, or a model file.")],
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
    effects_file: EffectFiles = None,
    suggest: Annotated[
        Path | None, typer.Option(metavar="FILE.py", help="Write the suggested effect, if any, ready to edit.")
    ] = None,
    least_gain: LeastGain = LEAST_GAIN,
    auto: Annotated[
        bool, typer.Option("--auto", help="Add what is missing, look again, until nothing is to be gained.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="M2", help="With --auto: the model to write.")
    ] = None,
) -> None:
    """Tell where a model fails, which physical effect it lacks, and what remains."""
    if auto != (out is not None):
        raise SettingsError("--auto writes the model that it comes to: give --auto and -o M2 together, or neither")
    chosen = models.load(model)
    writable([*read_files(rides), *model_files([model]), *(effects_file or ())], json_file, html_file, suggest, out)
    table, windows = read_tables(rides, chosen)
    console = printer()
    for name in lacking(effects_file or (), windows):
        console.print(
            f"{name} is not in the tables and is not asked of: make them anew with `socast tables --effects FILE`",
            style="yellow",
            soft_wrap=True,
        )
    if auto and out is not None:
        chosen, result = _auto(chosen, table, windows, least_gain, console)
        models.save(chosen, out)
    else:
        result = _diagnosed(chosen, *_not_set_apart(chosen, table, windows, console), least_gain)
        say_commands(result, model, rides, effects_file or ())
    write_json(json_file, result)
    report("diagnosis.page", result, html_file, suggested=_suggested(result, suggest))
    if out is not None:
        told = f"{out}: version {chosen.version}; socast history {out} tells its steps"
        console.print(told, markup=False, highlight=False, soft_wrap=True)


def lacking(files: Sequence[Path], windows: pd.DataFrame) -> list[str]:
    """Return the effects of one's own that tables were made without."""
    own = [effect.name for path in files for effect in effects.group_by_topic().get(path.name, ())]
    return [name for name in own if f"{EFFECT_PREFIX}{name}" not in windows]


def _checked(model: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables that diagnosis can read.

    Raises
    ------
    ModelError
        Where a column is missing, or the rides are of other vehicles than the model.
    """
    for table, what, needed in ((rides, "ride", OF_RIDES), (windows, "window", OF_WINDOWS)):
        if missing := [name for name in needed if name not in table]:
            raise ModelError(
                f"column {missing[0]!r} is missing in the {what} table: make the tables anew, with `socast tables`"
            )
    check_vehicles(model, rides)
    return rides, windows


def read_files(given: Sequence[Path]) -> list[Path]:
    """Return every file that is read for what the command line names: recordings, or rides and the windows beside."""
    files = inputs(given)
    return files if files[0].suffix == RECORDING else [*files, *(file.with_name(WINDOWS) for file in files)]


def read_tables(given: Sequence[Path], model: LinearModel) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return ride and window table, of tables or made of recordings, with every effect that is known.

    Raises
    ------
    SettingsError
        Where there are no windows beside the rides.
    ModelError
        Where a table cannot be read.
    """
    files = inputs(given)
    if files[0].suffix == RECORDING:
        return _checked(model, *in_memory(files, [*model.effects, *effects.list_tabulated()]))
    beside = [file.with_name(WINDOWS) for file in files]
    for file in beside:
        if not file.is_file():
            raise SettingsError(
                f"{file.parent} holds no {WINDOWS}; diagnosis goes by windows: name a folder that `socast tables` made"
            )
    return _checked(model, read(files), read(beside))


def check_vehicles(model: LinearModel, rides: pd.DataFrame) -> None:
    """Refuse rides of none of the vehicle models that a model was fitted to.

    Raises
    ------
    ModelError
    """
    known = set(model.training.vehicle_models) if model.training else set()
    there = {name for name in get_names(rides, VEHICLE_MODEL) if name}
    if known and there and not known & there:
        raise ModelError(
            f"model {model.name} was fitted to {', '.join(sorted(known))}, and these rides are of "
            f"{', '.join(sorted(there))}: give a model of these vehicles, or fit one with `socast fit`"
        )


def before(rides: pd.DataFrame, windows: pd.DataFrame, apart: tuple[str, ...]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the tables without the days that are set apart."""
    kept = rides.loc[~np.isin(np.asarray(get_names(rides, "date"), dtype=str), list(apart))]
    return kept, windows.loc[windows["ride_key"].isin(kept["ride_key"])]


def say_commands(result: dict[str, Any], model: str, given: Sequence[Path], brought: Sequence[Path] = ()) -> None:
    """Enter, with each effect that is missing, the command that adds it."""
    stem = model if model in BUILT_IN_MODELS else str(Path(model).with_suffix(""))
    for found in result.get("missing") or ():
        name, scopes = term_of(found)
        words = ["socast", "add", name, "--model", model]
        words += [word for path in given for word in ("--data", str(path))]
        words += [word for path in brought for word in ("--effects", str(path))]
        words += [word for scope in scopes for word in ("--scope", scope)]
        found["command"] = shlex.join([*words, "-o", f"{stem}-{name.partition('@')[0]}.json"])


def term_of(found: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the name of an effect that is missing, or of its variant, and its scopes."""
    columns = [str(column) for column in found.get("columns") or ()]
    own = [column.removeprefix(EFFECT_PREFIX) for column in columns if column.startswith(EFFECT_PREFIX)]
    return own[0] if own else str(found.get("variant") or found["effect"]), [c for c in columns if is_scope(c)]


def _diagnosed(model: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame, least_gain: float) -> dict[str, Any]:
    """Return the diagnosis, as JSON has it."""
    from core.diagnose.diagnosis import diagnose  # noqa: PLC0415 - boosted trees take a second to import

    found: dict[str, Any] = to_json_values(diagnose(rides, windows, model, least_gain=least_gain))
    return found


def _not_set_apart(
    model: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame, console: Console
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the tables without days that the model's history has set apart, and say so."""
    apart = (
        select_final_days(model.history, get_names(rides, "date")) if any(e.get("final") for e in model.history) else ()
    )
    if apart:
        told = f"Not looked at: rides of {', '.join(apart)}, which the model's history has set apart."
        console.print(told, markup=False, highlight=False, soft_wrap=True)
    return before(rides, windows, apart)


def _auto(
    model: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame, least_gain: float, console: Console
) -> tuple[LinearModel, dict[str, Any]]:
    """Return the model that the loop comes to, and its last diagnosis."""
    from tools.report import history  # noqa: PLC0415 - figures take seconds to import
    from tools.report.diagnosis import page  # noqa: PLC0415 - figures take seconds to import

    apart = select_final_days(model.history, get_names(rides, "date"))
    seen = before(rides, windows, apart)
    rows, floor = join_tables(rides, windows), compute_ride_noise_floor(gather_windows(rides, windows, model))
    for step in range(1, MOST_STEPS + 1):
        result = _diagnosed(model, *seen, least_gain)
        page.print_step(result, step, console)
        found = next((m for m in result.get("missing") or () if m["effect"] == result.get("verdict")), None)
        if found is None:
            break
        name, scopes = term_of(found)
        try:
            added = add.add_effect(
                model, name, build_term_columns(name, scopes), rows, rides=rides, floor=floor, least=least_gain
            )
        except ModelError as error:
            page.print_lines([f"The loop ends here: {error}"], console)
            break
        history.print_trial(added.trial, console)
        if not added.trial["accepted"]:
            model = add.log_attempt(model, added.trial)
            page.print_lines(["The loop ends here: what the diagnosis names does not help on held-out rides."], console)
            break
        model = added.model
    history.show(model, console)
    return model, result


def _suggested(result: dict[str, Any], path: Path | None) -> str | None:
    """Write the effect that is suggested, if it is wanted and there is one, and return where it is."""
    text = result.get("suggestion_file")
    if not (path and text):
        return None
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"{path} cannot be written: {error.strerror}; name a file in another folder") from error
    return str(path)
