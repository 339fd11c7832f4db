"""Run `socast diagnose`: find where a model fails and why; with `--auto`, add effects until none is missing."""

import shlex
from collections.abc import Collection, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, TypeVar

import pandas as pd
import typer
from msgspec.structs import replace
from rich.console import Console

from socast.core import effects, models
from socast.core.diagnose.add import add
from socast.core.diagnose.add.holdout import select_final_days
from socast.core.diagnose.add.terms import build_term_columns
from socast.core.diagnose.findings import list_findings, measure_fleet_use, merge_findings
from socast.core.diagnose.gains import LEAST_GAIN
from socast.core.diagnose.inference.events import KnownEvent, read_events
from socast.core.diagnose.inference.groups import read_groups
from socast.core.diagnose.leading import find_addable
from socast.core.diagnose.records import CarDeviation, Diagnosis, FoundEpisode, NamedEffect
from socast.core.effects import ROAD_LOAD
from socast.core.errors import ModelError, SettingsError
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.ride_blocks import get_names
from socast.core.formatting import format_count
from socast.core.models import BUILT_IN_MODELS, VEHICLE, VEHICLE_MODEL, LinearModel
from socast.core.models.features import EFFECT_PREFIX, FEATURES, list_scope
from socast.core.wire.messages import Finding
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.night_watch import PAGE, read_findings, show_changes, write_condition, write_findings
from socast.tools.terminal.output import (
    EventsFile,
    HtmlFile,
    JsonFile,
    make_console,
    parse_date,
    print_plain,
    refuse,
    write_file,
    write_json,
)
from socast.tools.terminal.progress import show_elapsed
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import RideSource, insert_ride_source
from socast.tools.terminal.table_files import KEY

ENERGY_COLUMNS = (
    "energy_kwh",
    "energy_sd_kwh",
    "energy_vi_kwh",
    "energy_vi_sd_kwh",
    "energy_soc_kwh",
    "energy_soc_sd_kwh",
)
SHARED_COLUMNS = (KEY, VEHICLE, VEHICLE_MODEL, *ENERGY_COLUMNS, *(effect.energy_name for effect in ROAD_LOAD))
WINDOW_COLUMNS = (*SHARED_COLUMNS, *(name for name in FEATURES if name not in {"winter", "summer"}))
RIDE_COLUMNS = (*SHARED_COLUMNS, "ride_id", "date", "fit_for_training", *FEATURES)
"""Columns that diagnosis reads from the window and ride tables, in addition to those of candidate effects."""
MAX_STEPS = 8
"""Maximum number of effects that `--auto` adds."""

Entry = TypeVar("Entry", NamedEffect, CarDeviation)
LeastGain = Annotated[
    float, typer.Option(metavar="SHARE", min=0.0, max=1.0, help="Least gain that an effect must have.")
]


@insert_cluster_options
@insert_ride_source
def diagnose_rides(
    *,
    source: RideSource,
    model: Annotated[str, typer.Option("--model", metavar="M", help="Model: a name, or a model file.")],
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
    place: ClusterPlace | None,
    suggest: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.py", help="Write the form outside the library, if any, to a file as an effect to edit."
        ),
    ] = None,
    least_gain: LeastGain = 0.0,
    groups: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="Groups of vehicles to compare: columns vehicle_id,group."),
    ] = None,
    events: EventsFile = None,
    since: Annotated[
        str | None, typer.Option(metavar="DATE", help="Diagnose only rides from this UTC date on, such as 2018-11-01.")
    ] = None,
    findings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keep what was found in this file, and report what is new and what is gone."),
    ] = None,
    condition: Annotated[
        Path | None,
        typer.Option(
            metavar="F.json", help="Also write the condition of the cars over the last year, and F.html beside it."
        ),
    ] = None,
    auto: Annotated[bool, typer.Option("--auto", help="Add the first missing effect and repeat.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="M2", help="With --auto: the model file to write.")
    ] = None,
) -> None:
    """Find where a model fails, which physical effects it lacks, which cars changed, and what error remains.

    Examples
    --------
    socast diagnose tables --model fitted.json --html diagnosis.html --json diagnosis.json
    socast diagnose tables --model fitted.json --since 2018-11-01 --findings findings.json
    socast diagnose motorway.mcap --model fitted.json --speed-limit-kmh 180
    socast diagnose tables --model fitted.json --auto -o best.json
    """
    refuse(
        (auto != (out is not None), "--auto writes the final model: give --auto and -o M2 together, or neither"),
        (
            auto and (groups or events),
            "--groups and --events have no effect with --auto, which adds effects of all cars",
        ),
        (auto and condition, "--condition has no effect with --auto: run `socast condition`"),
        (auto and findings, "--findings has no effect with --auto, which adds what it finds: give one of the two"),
    )
    first_day = parse_date("--since", since) if since else None
    page = condition.with_suffix(PAGE) if condition else None
    refuse((condition is not None and condition == page, f"--condition is {condition}: name a file that ends in .json"))
    source.check(json_file, html_file, suggest, findings, condition, page, out, models=[model])
    loaded = models.load(model)
    dated = source.are_dated
    earlier = read_findings(findings) if findings else []
    known = read_events(events) if events else []
    with source.open_tables(loaded.effects, place) as made:
        table, windows = read_tables(made, loaded)
    if first_day is not None:
        table, windows = select_since(table, windows, first_day)
    console = make_console(json_file)
    for name in list_lacking_effects(source.effect_files, windows):
        console.print(
            f"{name} is not in the tables and is not tested: make them again with `socast tables --effects FILE`",
            style="yellow",
            soft_wrap=True,
        )
    if condition:  # first, because it needs fewer rides
        print_plain(console, _assess(table, loaded, condition, known))
    if auto and out is not None:
        loaded, result = _auto(loaded, table, windows, least_gain, console, dated=dated)
        models.save(loaded, out)
    else:
        of_vehicle = read_groups(groups) if groups else None
        result = _diagnose(loaded, table, windows, least_gain, of_vehicle, known, dated=dated)
        result = insert_commands(result, model, source)
        if findings:
            after = _keep_findings(result, table, earlier, findings)
    result = word_result(result)
    write_json(json_file, "diagnose", result)
    show_report("diagnosis.page", result, html_file, json_file, suggested=_write_suggestion(result, suggest))
    if html_file is not None:
        from socast.tools.report.diagnosis.page import print_links  # noqa: PLC0415 - figures take seconds to import

        print_links(result, html_file, console)
    if findings:
        show_changes(earlier, after, console)
    if out is not None:
        print_plain(
            console,
            f"{out}: version {loaded.version}; show its steps: socast history {out}",
        )


def list_lacking_effects(files: Sequence[Path], windows: pd.DataFrame) -> list[str]:
    """Return the effects of the user's files that the window table does not have."""
    from_files = [effect.name for path in files for effect in effects.group_by_topic().get(path.name, ())]
    return [name for name in from_files if f"{EFFECT_PREFIX}{name}" not in windows]


def check_tables(model: LinearModel, rides: pd.DataFrame, windows: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the tables, checked for every column that diagnosis reads."""
    for table, what, needed in ((rides, "ride", RIDE_COLUMNS), (windows, "window", WINDOW_COLUMNS)):
        if missing := [name for name in needed if name not in table]:
            raise ModelError(
                f"column {missing[0]!r} is missing in the {what} table: make the tables again with `socast tables`"
            )
    check_vehicles(model, rides)
    return rides, windows


def read_tables(source: RideSource, model: LinearModel) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride and window tables that a diagnosis needs."""
    return check_tables(model, *source.read(model.effects))


def check_vehicles(model: LinearModel, rides: pd.DataFrame) -> None:
    """Refuse rides if the model was fitted to none of their vehicle models."""
    known = set(model.training.vehicle_models) if model.training else set()
    present = {name for name in get_names(rides, VEHICLE_MODEL) if name}
    if known and present and not known & present:
        raise ModelError(
            f"model {model.name} was fitted to {', '.join(sorted(known))}, and these rides are of "
            f"{', '.join(sorted(present))}: give a model of these vehicles, or fit one with `socast fit`"
        )


def select_since(rides: pd.DataFrame, windows: pd.DataFrame, first: date) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride and window tables from a UTC date on."""
    dates = get_names(rides, "date")
    kept = rides.loc[[day >= first.isoformat() for day in dates]]
    if kept.empty:
        last = max(dates, default="no date")
        raise SettingsError(f"--since is {first}, and the last ride is on {last}: give an earlier date")
    return kept, windows.loc[windows["ride_key"].isin(kept["ride_key"])]


def insert_commands(result: Diagnosis, model: str, source: RideSource) -> Diagnosis:
    """Return a diagnosis whose missing effects and deviations have the command that adds them, if a term can hold them.

    `commands` holds this command, and the one that runs the model with the effect as a shadow. The command of an
    episode shows the ride with the largest part of it.
    """
    stem = model if model in BUILT_IN_MODELS else str(Path(model).with_suffix(""))
    data, own = [str(path) for path in source.given], source.list_options()

    def show_command(episode: FoundEpisode) -> FoundEpisode:
        words = ["socast", "compare", *data, "--model", model, "--ride", episode.rides[0]]
        return replace(episode, command=shlex.join([*words, *own]))

    def add_command(entry: Entry) -> Entry:
        if not entry.columns:
            return entry
        name, scope = parse_term(entry)
        within: list[str] = [word for part in scope for word in ("--scope", part)]
        file = f"{stem}-{name.partition('@')[0]}.json"
        command = shlex.join(["socast", "add", name, *data, "--model", model, *own, *within, "-o", file])
        shadow = shlex.join(["socast", "live", "--model", model, "--model", file, *own])
        return replace(entry, command=command, commands=[command, shadow])

    return replace(
        result,
        episodes=list(map(show_command, result.episodes)),
        missing=list(map(add_command, result.missing)),
        deviations=list(map(add_command, result.deviations)),
    )


def parse_term(entry: NamedEffect | CarDeviation) -> tuple[str, list[str]]:
    """Return the name of a missing effect, or of its variant, and its scope."""
    names = [column.removeprefix(EFFECT_PREFIX) for column in entry.columns if column.startswith(EFFECT_PREFIX)]
    return names[0], list_scope(entry.columns)


def _assess(rides: pd.DataFrame, model: LinearModel, path: Path, events: Sequence[KnownEvent]) -> str:
    """Write the condition of the cars, and return what was written, or why it cannot be told."""
    try:
        return f"condition of {format_count(write_condition(path, rides, model, events), 'car')} in {path}"
    except ModelError as error:
        return f"no condition of the cars: {error}"


def _keep_findings(result: Diagnosis, rides: pd.DataFrame, earlier: list[Finding], file: Path) -> list[Finding]:
    """Merge what a diagnosis found into the findings of a file, and return them."""
    use = measure_fleet_use(rides)
    merged = merge_findings(earlier, list_findings(result, use), use)
    write_findings(file, merged)
    return merged


def _diagnose(
    model: LinearModel,
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    least_gain: float,
    groups: Mapping[str, str] | None = None,
    events: Sequence[KnownEvent] = (),
    leave_out: Collection[str] | None = None,
    *,
    dated: bool = True,
) -> Diagnosis:
    """Return the diagnosis of tables."""
    from socast.core.diagnose.diagnosis import diagnose  # noqa: PLC0415 - it takes a second to import

    with show_elapsed("diagnosing"):
        return diagnose(
            rides, windows, model, leave_out=leave_out, least_gain=least_gain, groups=groups, events=events, dated=dated
        )


def word_result(result: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the sentences with which its report begins and ends."""
    from socast.tools.report.diagnosis import sentences  # noqa: PLC0415 - tables of reports take a second to import

    return replace(result, headline=sentences.describe_verdict(result), next_step=sentences.describe_next_step(result))


def _auto(
    model: LinearModel,
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    least_gain: float,
    console: Console,
    *,
    dated: bool,
) -> tuple[LinearModel, Diagnosis]:
    """Return the model after the last step of the loop, and the last diagnosis."""
    from socast.tools.report import history  # noqa: PLC0415 - figures take seconds to import
    from socast.tools.report.diagnosis import page  # noqa: PLC0415 - figures take seconds to import

    final = select_final_days(model.history, get_names(rides, "date"))
    rows = join_tables(rides, windows)
    tried: set[str] = set()
    for step in range(1, MAX_STEPS + 1):
        result = _diagnose(model, rides, windows, least_gain, leave_out=final, dated=dated)
        entry = find_addable(result, tried)
        page.print_step(result, step, entry, console)
        if entry is None:
            page.print_lines(["The loop ends here: no further effect lowers the error beyond doubt."], console)
            break
        name, scope = parse_term(entry)
        try:
            added = add.add_effect(
                model,
                name,
                build_term_columns(name, scope),
                rows,
                rides=rides,
                least=max(least_gain, LEAST_GAIN),
            )
        except ModelError as error:
            page.print_lines([f"The loop ends here: {error}"], console)
            break
        history.print_trial(added.trial, console)
        if not added.trial.accepted:
            model = add.log_attempt(model, added.trial)
            tried.add(entry.effect)
            continue
        model = added.model
    history.show(model, console)
    return model, result


def _write_suggestion(result: Diagnosis, path: Path | None) -> str | None:
    """Write the form outside the library if there is one and a path is given, and return the path."""
    source = next((one.file for one in result.unknown if one.file), None)
    if not (path and source):
        return None
    write_file(path, source.encode())
    return str(path)
