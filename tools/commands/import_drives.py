"""`socast import`: convert tables of one's own, and public data sets, to recordings that `replay` and `tables` read."""

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import typer
from rich.console import Console
from rich.progress import track

from socast.core.errors import ImportFileError, SettingsError
from socast.core.formatting import format_count
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_writer import replace_recording
from socast.stream.recording_metadata import INVENTED, make_metadata
from socast.tools.importers.data_sets import DATA_SETS, DataSet, get_data_set
from socast.tools.importers.drive import Drive, ReadOptions, make_messages, sort_drives
from socast.tools.importers.published import list_files
from socast.tools.importers.synthetic_shifts import START_SOC, SyntheticShift, concatenate_drives, make_plans
from socast.tools.importers.table.column_map import FileFormat, parse_map, read_map
from socast.tools.importers.table.conversion import (
    convert_tables,
    describe_missing,
    open_readable,
    open_tables,
    print_summary,
)
from socast.tools.importers.table.guess import (
    describe_preset,
    describe_unread,
    guess_map,
    make_guess_table,
    write_map_text,
)
from socast.tools.importers.table.presets import Preset, get_preset, load_presets
from socast.tools.importers.table.sampling import Sampling, find_holds
from socast.tools.importers.table.table_file import KINDS, list_tables
from socast.tools.importers.table.text_stream import SkippedFiles
from socast.tools.importers.table.time_words import TimeSource
from socast.tools.importers.table.weather_file import read_weather_file
from socast.tools.terminal.output import (
    HtmlFile,
    VehicleFiles,
    check_outputs,
    make_console,
    print_plain,
    refuse,
    write_file,
)
from socast.tools.terminal.time_zone import parse_zone

Step = TypeVar("Step")
PERIOD_S = 3.0
"""Default time between two samples. [s]"""
BLOCK = 4096
"""Number of messages written at a time."""
INVENTED_ORIGIN: Final = 1_577_836_800.0
"""Time of the first file of a sequence without an origin of its own: 2020-01-01. [Unix s]"""
TABLE_KINDS = tuple(KINDS)
"""Kinds of tables that are read with a map."""


def import_drives(
    *,
    data_set: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="csv or parquet (files of your own, read with --map), or a public data set: ved (Vehicle Energy "
            "Dataset, electric cars, Ann Arbor), bmw-i3 (BMW i3, Munich, 10 Hz; needs "
            "Overview.xlsx beside the files) or twizy (Renault Twizy, Rabat, 1 Hz; no voltage and current).",
        ),
    ],
    paths: Annotated[list[Path], typer.Argument(metavar="PATHS", help="Files, plain or .gz, or folders of them.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE.mcap", help="Recording to write.")] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAP.toml", help="Csv and parquet: which column is what, in which unit."),
    ] = None,
    guess: Annotated[
        bool,
        typer.Option(
            "--guess", help="Csv and parquet: write a first MAP.toml from presets, names, units, ranges and physics."
        ),
    ] = False,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Csv and parquet: read the files as the export of a product: {', '.join(load_presets())}.",
        ),
    ] = None,
    html_file: HtmlFile = None,
    _: VehicleFiles = None,
    sequence: Annotated[
        float | None,
        typer.Option(
            metavar="H",
            min=0.1,
            max=8760.0,
            help="Csv and parquet: place files whose clocks begin at 0 one after another, H hours apart, at invented "
            "dates.",
        ),
    ] = None,
    weather: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Csv and parquet: observations of weather stations, as of Open-Meteo or of an airport.",
        ),
    ] = None,
    vehicle_model: Annotated[
        str | None,
        typer.Option(metavar="KEY", help="Csv and parquet: vehicle model of cars for which MAP.toml names none."),
    ] = None,
    vehicle: Annotated[
        list[int] | None,
        typer.Option(
            metavar="VEHID", help="Public data set ved: car to read; may be repeated. Default: all electric cars."
        ),
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.1,
            max=60.0,
            help=f"Time between two samples, approximately. Default: {PERIOD_S:g} for public data sets, as the rows "
            "come or [rows] of MAP.toml says for csv and parquet.",
        ),
    ] = None,
    shift_hours: Annotated[
        float | None,
        typer.Option(
            metavar="H",
            min=0.5,
            max=24.0,
            help="Public data sets: concatenate the rides of each car into synthetic shifts of H hours.",
        ),
    ] = None,
    time_zone: Annotated[
        str | None,
        typer.Option(
            metavar="ZONE",
            help="Public data sets: time zone of the clock in the files. Default: "
            f"{', '.join(f'{each.time_zone} ({name})' for name, each in DATA_SETS.items())}.",
        ),
    ] = None,
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Skip files that cannot be read, and name the cause.")
    ] = False,
) -> None:
    """Convert files of your own, or a public data set of real drives, to a recording.

    Examples
    --------
    socast import csv drives/ --guess --map cars.toml
    socast import csv positions.csv --preset teslamate --out tesla.mcap
    socast import csv drives/ --map cars.toml --out cars.mcap --html cars.html
    socast import bmw-i3 downloads/ --out i3.mcap
    """
    if data_set in TABLE_KINDS:
        changed = {
            "--vehicle": (vehicle, "name the cars in [vehicle] of the map"),
            "--shift-hours": (shift_hours, "leave it out: the drives keep their own times"),
            "--time-zone": (time_zone, "set zone in [time] of the map"),
        }
        for option, (value, remedy) in changed.items():
            if value:
                raise SettingsError(f"{option} applies to public data sets only; {remedy}")
        import_tables(
            data_set, paths, map_file, out, html_file, guess, preset, vehicle_model, period, skip_bad, sequence, weather
        )
        return
    chosen = get_data_set(data_set)
    of_tables, vehicles = (map_file, html_file, vehicle_model, preset, sequence, weather), tuple(vehicle or ())
    refuse(
        (
            guess or any(option is not None for option in of_tables),
            (
                "--map, --guess, --preset, --html, --sequence, --weather and --vehicle-model apply to csv and parquet "
                f"only; leave them out for {data_set}"
            ),
        ),
        (out is None, "--out is missing; name the recording to write, such as drives.mcap"),
    )
    assert out is not None  # checked above
    check_recording(out)
    if vehicles and data_set != "ved":
        raise SettingsError(f"--vehicle is {vehicles[0]}, but {data_set} holds one car; leave --vehicle out")
    reading = ReadOptions(parse_zone(time_zone or chosen.time_zone), vehicles)
    drives = collect_drives(paths, chosen, reading, skip_bad)
    read = {drive.vehicle_id for drive in drives}
    absent = [number for number in vehicles if f"ved-{number}" not in read]
    if absent or not drives:
        cars = f"VehId {absent[0]} with battery data" if absent else "electric car"
        raise ImportFileError(
            f"{paths[0]}: column 'VehId' has no {cars} in the files given; 10, 455 and 541 are electric"
        )
    period = PERIOD_S if period is None else period
    values = {"data_set": data_set, "vehicle": vehicles, "period": period, "time_zone": time_zone}
    usual = {"vehicle": (), "period": PERIOD_S, "time_zone": None}
    changes = {name: value for name, value in values.items() if value != usual.get(name)}
    write_recording(drives, out, period, shift_hours, changes)


def collect_drives(
    paths: Sequence[Path], data_set: DataSet, options: ReadOptions | None = None, skip_bad: bool = False
) -> list[Drive]:
    """Read the drives of all files and sort them by time."""
    console = Console(stderr=True)
    source_of: dict[tuple[str, str], Path] = {}
    drives: list[Drive] = []
    bad = 0
    files = list_files(paths)
    for path in _show_progress(files, "reading"):
        try:
            read = data_set.read_drives(path, options or data_set.defaults)
            _register(path, read, source_of)
        except ImportFileError as error:
            if not skip_bad:
                raise
            bad += 1
            print_plain(console, f"skipped: {error}", style="yellow")
            continue
        drives += read
    if bad == len(files):
        raise ImportFileError(f"{paths[0]}: none of the {bad} files given can be read")
    if bad:
        console.print(f"skipped {bad} of {len(files)} files", style="yellow")
    return sort_drives(drives)


def write_recording(
    drives: Sequence[Drive],
    out: Path,
    period: float,
    shift_hours: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write drives as a recording and print a summary of it.

    Units: period [s].

    Parameters
    ----------
    shift_hours : float, optional
        Length of the synthetic shifts into which the rides of each car are concatenated; None keeps the rides. [h]
    """
    console = Console()
    print_plain(console, *(note for drive in drives for note in drive.notes))
    shifts = [] if shift_hours is None else concatenate_drives(drives, shift_hours)
    if shifts:
        print_plain(console, _describe_shifts(shifts))
        drives = [drive for shift in shifts for drive in shift.drives]
    plans = [make_plans(shift) for shift in shifts]
    first, later = [each[0] for each in plans], [plan for each in plans for plan in each[1:]]
    # a car knows its plan before its first sample; that of the other rides follows the last sample of one
    recording = sorted([*first, *make_messages(drives, period), *later], key=attrgetter("receipt_ns"))
    chosen = dict(settings or {}) | ({} if shift_hours is None else {"shift_hours": shift_hours})
    with replace_recording(out, metadata=make_metadata("import", settings=chosen)) as sink:
        for start in _show_progress(range(0, len(recording), BLOCK), "writing"):
            sink.put(recording[start : start + BLOCK])
    cars = len({drive.vehicle_id for drive in drives})
    hours = sum(float(drive.elapsed[-1]) for drive in drives) / 3600
    print_plain(
        console,
        f"{out}: {format_count(len(recording), 'message')}, {format_count(len(drives), 'ride')} of "
        f"{format_count(cars, 'car')}, {hours:.1f} h",
    )


def _describe_shifts(shifts: Sequence[SyntheticShift]) -> str:
    """Return a line that says how the rides were changed."""
    hours = [(shift.end - shift.drives[0].start) / 3600.0 for shift in shifts]
    return (
        f"concatenated into {len(shifts)} synthetic shifts of {min(hours):.1f} to {max(hours):.1f} h: rides are moved "
        f"in time, the state of charge continues from {START_SOC:g} %, plans are synthetic"
    )


def _register(path: Path, drives: list[Drive], source_of: dict[tuple[str, str], Path]) -> None:
    """Record which file holds each drive; raise an error if another file holds it too."""
    names = [(drive.vehicle_id, drive.ride_id) for drive in drives]
    for name in names:
        if name in source_of:
            raise ImportFileError(f"{path}: holds ride {name[1]}, as {source_of[name]} does; give each ride once")
    source_of.update(dict.fromkeys(names, path))


def _show_progress(steps: Sequence[Step], what: str) -> Iterable[Step]:
    """Show a progress bar on a terminal, nothing elsewhere."""
    console = Console(stderr=True)
    return track(steps, what, console=console, transient=True, disable=not console.is_terminal)


def import_tables(
    kind: str,
    paths: list[Path],
    map_file: Path | None,
    out: Path | None,
    html_file: Path | None,
    guess: bool,
    preset_name: str | None,
    vehicle_model: str | None,
    period: float | None,
    skip_bad: bool,
    sequence: float | None,
    weather_file: Path | None,
) -> None:
    """Guess a map of tables, or convert tables with a map, or both."""
    preset = None if preset_name is None else get_preset(preset_name)
    guesses = guess or preset is not None
    refuse(
        (
            map_file is None and not (guesses and out),
            f"--map is missing; name a map, or write a first one: socast import {kind} ... --guess --map MAP.toml",
        ),
        (
            out is None and not guesses,
            "--out is missing; name the recording to write, or use --guess to write a map only",
        ),
        (
            out is None and weather_file,
            "--weather is given without --out; its observations enter a recording, so name one too",
        ),
        (
            out is None and html_file,
            "--html is given without --out; the page shows an import, so name a recording too",
        ),
    )
    if out is not None:
        check_recording(out)
    files, console, content = list_tables(paths, kind), make_console(), b""
    if guesses:
        skipped = SkippedFiles(skip_bad)
        content = _guess(kind, files, map_file, vehicle_model, preset, skipped, console, tells_rest=out is None)
    if out is None:
        return
    beside = [each for each in (map_file, weather_file) if each is not None]
    check_outputs([*files, *beside], out, html_file)
    weather = read_weather_file(weather_file) if weather_file else None
    columns = read_map(map_file) if map_file else parse_map(content, Path(f"the map of {files[0]}"))
    if columns.vehicle.model is None:
        columns = columns._replace(vehicle=columns.vehicle._replace(model=vehicle_model))
    if period is not None:
        holds = columns.sampling.holds if columns.sampling else find_holds()
        columns = columns._replace(sampling=Sampling(period, holds))
    if sequence is not None:
        columns = columns._replace(time=place_in_sequence(columns.time, sequence))
    settings = {
        "kind": kind,
        "map": map_file and map_file.name,
        "preset": preset_name,
        "vehicle_model": vehicle_model,
        "period": period,
        "sequence": sequence,
        "weather": weather_file and weather_file.name,
        "dates": None if sequence is None else INVENTED,
    }
    chosen = {name: str(value) for name, value in settings.items() if value is not None}
    skipped = SkippedFiles(skip_bad)
    tables = open_tables(files, kind, columns, skipped)
    summary = convert_tables(tables, columns, out, chosen, skipped, weather)
    print_summary(summary, console)
    if html_file is not None:
        from socast.tools.report.imported import build_report  # noqa: PLC0415 - figures take seconds to import
        from socast.tools.report.page import write_report  # noqa: PLC0415 - ditto

        write_report(build_report(summary), html_file)
        print_plain(console, f"report in {html_file}")


def place_in_sequence(time: TimeSource, hours: float) -> TimeSource:
    """Return the clock of files that follow each other at invented dates.

    Parameters
    ----------
    hours : float
        Time from the last row of a file to the number 0 of the next one. [h]
    """
    if (
        time.unit_s is None
        or time.is_serial
        or time.origin_form
        or time.origin_column
        or time.day_from_file_name
        or len(time.columns) > 1
    ):
        raise SettingsError(
            "--sequence invents dates for clocks that begin at 0 in each file, and [time] of the map gives dates; "
            "leave --sequence out, or give the unit of the numbers only"
        )
    return time._replace(gap_s=3600.0 * hours, origin=max(time.origin, INVENTED_ORIGIN))


def _guess(
    kind: str,
    files: list[Path],
    map_file: Path | None,
    vehicle_model: str | None,
    preset: Preset | None,
    skipped: SkippedFiles,
    console: Console,
    *,
    tells_rest: bool,
) -> bytes:
    """Return a first map, written where a file is named, and show what was decided, and the rest if no import does."""
    if map_file is not None and map_file.exists():
        raise SettingsError(
            f"{map_file} is there already and would be overwritten; name another file, or leave --guess and --preset "
            "out to import with it"
        )
    check_outputs(files, map_file)
    tables = open_readable(files, kind, FileFormat(), skipped)
    guessed = guess_map(tables, preset, skipped)._replace(vehicle_model=vehicle_model)
    content = write_map_text(guessed, tables[0]).encode()
    if line := describe_preset(guessed):
        print_plain(console, line)
    console.print(make_guess_table(guessed))
    lines = [describe_unread(guessed), *guessed.time.doubts]
    if tells_rest:
        lines += [*skipped.list_lines(len(files)), *describe_missing([each.field for each in guessed.fields])]
    print_plain(console, *filter(None, lines), style="yellow")
    if map_file is None:
        console.print("the map is not kept; --map MAP.toml keeps it, so that you can correct it", markup=False)
        return content
    write_file(map_file, content)
    console.print(f"map in {map_file}: check it, then import with --map {map_file}", markup=False, soft_wrap=True)
    return content


def check_recording(out: Path) -> None:
    """Refuse a recording whose name does not end as recordings do."""
    if out.suffix != RECORDING:
        raise SettingsError(f"--out {out}: a recording ends in {RECORDING}; name it {out.with_suffix(RECORDING)}")
