"""`socast compare`: compare models with the measured energy of rides, in a terminal, as JSON and as one HTML page."""

import dataclasses
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import msgspec
import pandas as pd
import typer
from msgspec.structs import replace

from socast.core import models
from socast.core.diagnose.residual_survey import survey_model
from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.compare.datasets import compare_datasets
from socast.core.evaluate.compare.models import ComparedRides, compare_predictions, select_rides
from socast.core.evaluate.compare.records import Comparison, DatasetContrast, ResidualSurvey, RideTrace
from socast.core.evaluate.compare.ride_trace import find_ride, trace_ride
from socast.core.models import LinearModel
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.model_comparison import name_as_given
from socast.tools.terminal.output import HtmlFile, JsonFile, check_outputs, refuse, select_model_files, write_json
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import BothTables, RideSource, insert_ride_source
from socast.tools.terminal.table_files import KEY


@insert_cluster_options
@insert_ride_source
def compare_models(
    *,
    source: RideSource,
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
    refuse((ride is not None and against, "--ride shows one ride of the first rides; leave out --against"))
    other = dataclasses.replace(source, given=against or ())
    read = select_model_files(model)
    for each in (source, other) if against else (source,):
        each.check()
        read += each.list_read_files()
    check_outputs(read, json_file, html_file)
    chosen = named(model)
    wanted = [name for each in chosen.values() for name in each.effects]
    with ExitStack() as folders:
        first, second = (folders.enter_context(each.open_tables(wanted, place)) for each in (source, other))
        if ride is not None:
            trace = _trace(first, ride, chosen, wanted)
            write_json(json_file, "compare", {"trace": trace.to_json()})
            show_report("comparison.trace", trace, html_file, json_file)
            return
        table, read_windows, read_all = _read(first, wanted)
        selected, given = select_rides(table, chosen), dict(zip(chosen, model, strict=True))
        words = ["socast", "compare", *source.list_words()]
        result = compare_predictions(
            selected, lambda label, key: shlex.join([*words, "--model", given[label], "--ride", key])
        )
        result = replace(result, failures=_find_failures(read_all, selected, chosen))
        if against:
            shown = " ".join(map(str, source.given)), " ".join(map(str, against))
            result = replace(result, against=_against(selected, second.read_rides(wanted), shown, chosen))
        write_json(json_file, "compare", result.to_json())
        if html_file is not None:
            result = replace(result, traces=_trace_worst(result, table, read_windows, chosen))
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
    short = list(map(name_as_given, given))
    labels = [name if short.count(label) > 1 else label for name, label in zip(given, short, strict=True)]
    return {label: models.load(name) for label, name in zip(labels, given, strict=True)}


def _read(
    source: RideSource, wanted: Sequence[str]
) -> tuple[pd.DataFrame, Callable[[str], pd.DataFrame], Callable[[], BothTables]]:
    """Return the ride table, and functions that read the windows of a ride by its key, and both tables."""
    if source.is_recorded:
        rides, windows = source.read(wanted, library=False)
        return rides, lambda _: windows, lambda: (rides, windows)
    return source.read_rides(), source.read_windows_of, lambda: source.read(wanted)


def _find_failures(
    read_all: Callable[[], BothTables], compared: ComparedRides, chosen: Mapping[str, LinearModel]
) -> ResidualSurvey:
    """Return where the windows of the compared rides show that the first model fails; why not, where they cannot."""
    label, model = next(iter(chosen.items()))
    try:
        survey = survey_model(*read_all(), model, set(compared.rides["ride_key"].astype(str)))
    except (ModelError, SettingsError) as error:
        return ResidualSurvey(model=label, why_not=str(error))
    return msgspec.convert({"model": label, **survey}, ResidualSurvey)


def _trace_worst(
    result: Comparison,
    rides: pd.DataFrame,
    read_windows: Callable[[str], pd.DataFrame],
    chosen: Mapping[str, LinearModel],
) -> dict[str, RideTrace]:
    """Return the traces of the rides with the largest errors of all models; without rides that have none."""
    worst = [ride.ride for one in result.models.values() for ride in (*one.worst.absolute, *one.worst.relative)]
    traces = {}
    for key in dict.fromkeys(worst):
        row = find_ride(rides, key)
        with suppress(ModelError, SettingsError):  # no windows beside the table, or too few of this ride
            traces[key] = trace_ride(row, read_windows(str(row[KEY].iloc[0])), chosen)
    return traces


def _trace(source: RideSource, name: str, chosen: Mapping[str, LinearModel], wanted: Sequence[str]) -> RideTrace:
    """Return the trace of a ride."""
    rides, read_windows, _ = _read(source, wanted)
    row = find_ride(rides, name)
    if KEY not in row:
        raise ModelError(f"column {KEY!r} is missing in the ride table: make it again with `socast tables`")
    return trace_ride(row, read_windows(str(row[KEY].iloc[0])), chosen)


def _against(
    compared: ComparedRides, rides: pd.DataFrame, shown: tuple[str, str], chosen: Mapping[str, LinearModel]
) -> DatasetContrast:
    """Return the differences between two sets of rides, and the errors of models on the second set."""
    other = select_rides(rides, chosen)
    second = compare_predictions(other)
    return replace(
        compare_datasets(compared, other, chosen),
        first=shown[0],
        second=shown[1],
        about=second.about,
        second_models=second.models,
    )
