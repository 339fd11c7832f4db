"""`socast compare`: compare models with the measured energy of rides, in a terminal, as JSON and as one HTML page."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import typer

from socast.core import models
from socast.core.diagnose.residual_survey import survey_model
from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.compare.datasets import compare_datasets
from socast.core.evaluate.compare.models import ComparedRides, compare_predictions, select_rides
from socast.core.evaluate.compare.ride_trace import find_ride, trace_ride
from socast.core.evaluate.paper.results import to_json_values
from socast.core.models import BUILT_IN_MODELS, LinearModel
from socast.core.settings import Settings
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.commands.diagnose import read_both_tables
from socast.tools.commands.fit import RECORDING, Rides, inputs, ride_files
from socast.tools.commands.tables import WINDOWS, in_memory, tables_by_workers
from socast.tools.terminal.cleaning_options import insert_cleaning_options, refuse_cleaning_of_tables, word_settings
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.output import (
    EffectFiles,
    HtmlFile,
    JsonFile,
    VehicleFiles,
    check_outputs,
    select_model_files,
    show_report,
    write_json,
)
from socast.tools.terminal.table_files import KEY, is_table, read

RideTables = tuple[pd.DataFrame, pd.DataFrame]
"""Ride table and window table."""


@insert_cluster_options
@insert_cleaning_options
def compare_models(
    rides: Rides,
    *,
    model: Annotated[
        list[str], typer.Option("--model", metavar="M", help="A model's name, or a model file; may be repeated.")
    ],
    against: Annotated[
        list[Path] | None,
        typer.Option(metavar="TABLES|REC", help="Other rides to compare with these; may be repeated."),
    ] = None,
    ride: Annotated[
        str | None, typer.Option(metavar="KEY", help="Show the trace of this ride instead, by ride_key or ride_id.")
    ] = None,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    place: ClusterPlace | None,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Compare models with the measured energy of rides: how far off, under which conditions, in which rides.

    All models are compared on the same rides: those that are fit for training and that every model predicts. Nothing is
    fitted here.

    Examples
    --------
    socast compare tables --model fitted.json --model extended_physical --html compared.html
    socast compare recordings/shift.mcap --model extended_physical --ride 'taxi-005#1'
    socast compare motorway.mcap --model fitted.json --speed-limit-kmh 180
    socast compare tables --model fitted.json --json - | jq .models
    """
    if ride is not None and against:
        raise SettingsError("--ride shows one ride of the first rides; leave out --against")
    files = [*inputs(rides), *inputs(against or ())]
    refuse_cleaning_of_tables(files, settings)
    read = [
        *files,
        *select_model_files(model),
        *(effects_file or ()),
        *(vehicles or ()),
    ]
    check_outputs(read, json_file, html_file)
    chosen, words = named(model), [*_words(rides, effects_file or (), vehicles or ()), *word_settings(settings)]
    wanted, loaded = [name for each in chosen.values() for name in each.effects], (effects_file or (), vehicles or ())
    with ExitStack() as folders:
        first, second = (
            folders.enter_context(tables_by_workers(given, place, wanted, *loaded, settings))
            for given in (rides, against or ())
        )
        if ride is not None:
            result: dict[str, Any] = {"trace": _trace(first, ride, chosen, settings)}
        else:
            table, read_windows, read_all = _read(first, chosen, settings)
            selected = select_rides(table, chosen)
            result = compare_predictions(selected)
            _say_commands(result, words, dict(zip(chosen, model, strict=True)))
            result["failures"] = _find_failures(read_all, selected, chosen)
            if against:
                shown = " ".join(map(str, rides)), " ".join(map(str, against))
                result["against"] = _against(selected, second, shown, chosen, settings)
        result = to_json_values(result)
        write_json(json_file, "compare", result)
        if html_file is not None and ride is None:
            result["traces"] = to_json_values(_trace_worst(result, table, read_windows, chosen))
    show_report("comparison.page", result, html_file, json_file)


def named(given: Sequence[str]) -> dict[str, LinearModel]:
    """Load models, and return them by the labels that a reader knows.

    Returns
    -------
    dict
        Models by label. The label is the name of a built-in model or of the file, or the path if two files have the
        same name.
    """
    if twice := [name for i, name in enumerate(given) if name in given[:i]]:
        raise SettingsError(f"--model {twice[0]} is given twice; give it once")
    short = [name if name in BUILT_IN_MODELS else Path(name).stem for name in given]
    labels = [name if short.count(label) > 1 else label for name, label in zip(given, short, strict=True)]
    return {label: models.load(name) for label, name in zip(labels, given, strict=True)}


def _recorded(given: Sequence[Path]) -> bool:
    """Return whether the given files are recordings."""
    return given[0].suffix == RECORDING


def _summed(
    given: Sequence[Path], chosen: Mapping[str, LinearModel], settings: Settings
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride table and the window table of recordings."""
    wanted = [name for model in chosen.values() for name in model.effects]
    return in_memory(given, wanted, settings=settings)


def _rides(given: Sequence[Path], chosen: Mapping[str, LinearModel], settings: Settings) -> pd.DataFrame:
    """Return the ride table of recordings or of files of rides."""
    return _summed(given, chosen, settings)[0] if _recorded(given) else read(ride_files(given))


def _read(
    given: Sequence[Path], chosen: Mapping[str, LinearModel], settings: Settings
) -> tuple[pd.DataFrame, Callable[[str], pd.DataFrame], Callable[[], RideTables]]:
    """Return the ride table, and functions that read the windows of a ride by its key, and both tables."""
    if _recorded(given):
        rides, windows = _summed(given, chosen, settings)
        return rides, lambda _: windows, lambda: (rides, windows)
    files, wanted = ride_files(given), [name for model in chosen.values() for name in model.effects]
    return read(files), lambda key: _windows(files, key), lambda: read_both_tables(given, wanted)


def _find_failures(
    read_all: Callable[[], RideTables], compared: ComparedRides, chosen: Mapping[str, LinearModel]
) -> dict[str, Any]:
    """Return where the windows of the compared rides show that the first model fails; why not, where they cannot."""
    label, model = next(iter(chosen.items()))
    try:
        survey = survey_model(*read_all(), model, set(compared.rides["ride_key"].astype(str)))
    except (ModelError, SettingsError) as error:
        return {"model": label, "why_not": str(error), "charts": []}
    return {"model": label, **survey}


def _trace_worst(
    result: Mapping[str, Any],
    rides: pd.DataFrame,
    read_windows: Callable[[str], pd.DataFrame],
    chosen: Mapping[str, LinearModel],
) -> dict[str, Any]:
    """Return the traces of the rides with the largest errors of all models; without rides that have none."""
    worst = [ride for of_model in result["models"].values() for listed in of_model["worst"].values() for ride in listed]
    traces = {}
    for key in dict.fromkeys(str(ride["ride"]) for ride in worst):
        row = find_ride(rides, key)
        with suppress(ModelError, SettingsError):  # no windows beside the table, or too few of this ride
            traces[key] = trace_ride(row, read_windows(str(row[KEY].iloc[0])), chosen)
    return traces


def _trace(given: Sequence[Path], name: str, chosen: Mapping[str, LinearModel], settings: Settings) -> dict[str, Any]:
    """Return the trace of a ride."""
    if _recorded(given):
        rides, windows = _summed(given, chosen, settings)
        return trace_ride(find_ride(rides, name), windows, chosen)
    files = ride_files(given)
    row = find_ride(read(files), name)
    if KEY not in row:
        raise ModelError(f"column {KEY!r} is missing in the ride table: make it again with `socast tables`")
    return trace_ride(row, _windows(files, str(row[KEY].iloc[0])), chosen)


def _windows(files: Sequence[Path], key: str) -> pd.DataFrame:
    """Return the windows of a ride, from the window table beside its ride table."""
    place, ride_key = (0, key) if len(files) == 1 else (int(key.partition("/")[0]), key.partition("/")[2])
    file = files[place].with_name(WINDOWS)
    if not is_table(file):
        raise SettingsError(f"{file.parent} holds no {WINDOWS}; a trace needs the windows that `socast tables` makes")
    try:
        windows: pd.DataFrame = pq.read_table(file, filters=[(KEY, "==", ride_key)]).to_pandas()
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise ModelError(f"{file}: cannot read windows: {reason}; a trace needs what `socast tables` made") from error
    return windows.assign(**{KEY: key})


def _against(
    compared: ComparedRides,
    against: Sequence[Path],
    shown: tuple[str, str],
    chosen: Mapping[str, LinearModel],
    settings: Settings,
) -> dict[str, Any]:
    """Return the differences between two sets of rides, and the errors of models on the second set."""
    other = select_rides(_rides(against, chosen, settings), chosen)
    second = compare_predictions(other)
    return {
        "first": shown[0],
        "second": shown[1],
        "about": second["about"],
        "second_models": second["models"],
        **compare_datasets(compared, other, chosen),
    }


def _words(rides: Sequence[Path], effect_files: Sequence[Path], vehicle_files: Sequence[Path]) -> list[str]:
    """Return the first words of a command that reads the same rides with the same effects."""
    brought = [word for path in effect_files for word in ("--effects", str(path))]
    brought += [word for path in vehicle_files for word in ("--vehicles", str(path))]
    return ["socast", "compare", *map(str, rides), *brought]


def _say_commands(result: Mapping[str, Any], words: Sequence[str], given: Mapping[str, str]) -> None:
    """Insert into the record of each of the worst rides the command that shows its trace."""
    for label, of_model in result["models"].items():
        for worst in (ride for rides in of_model["worst"].values() for ride in rides):
            worst["command"] = shlex.join([*words, "--model", given[label], "--ride", worst["ride"]])
