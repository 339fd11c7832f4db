"""Run `socast import csv` and `socast import parquet`: guess a map, convert with it, and show what was found."""

from pathlib import Path
from typing import Final, NamedTuple

from rich.console import Console

from socast.core.errors import ImportFileError, SettingsError
from socast.core.files import write_whole
from socast.stream.mcap_format import RECORDING
from socast.stream.recording_metadata import INVENTED
from socast.tools.importers.table.column_map import FileFormat, parse_map, read_map
from socast.tools.importers.table.conversion import convert_tables, open_readable, open_tables
from socast.tools.importers.table.guess import guess_map
from socast.tools.importers.table.import_summary import describe_missing, print_summary
from socast.tools.importers.table.map_text import describe_preset, describe_unread, make_guess_table, write_map_text
from socast.tools.importers.table.presets import Preset, get_preset
from socast.tools.importers.table.sampling import Sampling, find_holds
from socast.tools.importers.table.skipped_files import SkippedFiles
from socast.tools.importers.table.table_file import KINDS, list_tables
from socast.tools.importers.table.time_source import TimeSource
from socast.tools.importers.table.weather_file import read_weather_file
from socast.tools.terminal.output import check_outputs, make_console

INVENTED_ORIGIN: Final = 1_577_836_800.0
"""Time of the first file of a sequence without an origin of its own: 2020-01-01. [Unix s]"""
TABLE_KINDS = tuple(KINDS)
"""Kinds of tables that `socast import` reads with a map."""


class TableImport(NamedTuple):
    """Hold the options of an import of tables.

    Parameters
    ----------
    map_file, out, html_file : Path, optional
        The map, the recording (None only guesses) and a page with a picture of what agrees.
    preset : str, optional
        Name of the export that the tables are.
    vehicle_model : str, optional
        Vehicle model of cars for which the map names none.
    period : float, optional
        Time between two samples; None is that of the map. [s]
    skip_bad : bool
        Whether to skip and count files that cannot be read.
    sequence : float, optional
        Time between files that follow each other at invented dates. [h]
    weather : Path, optional
        File of weather stations.
    """

    map_file: Path | None
    out: Path | None
    html_file: Path | None
    guess: bool
    preset: str | None
    vehicle_model: str | None
    period: float | None
    skip_bad: bool = False
    sequence: float | None = None
    weather: Path | None = None


def import_tables(kind: str, paths: list[Path], options: TableImport) -> None:
    """Guess a map of tables, or convert tables with a map, or both."""
    map_file, out = options.map_file, options.out
    preset = None if options.preset is None else get_preset(options.preset)
    guesses = options.guess or preset is not None
    _check_options(kind, options, guesses)
    files = list_tables(paths, kind)
    console = make_console()
    content = _guess(kind, files, options, preset, console) if guesses else None
    if out is None:
        return
    beside = [each for each in (map_file, options.weather) if each is not None]
    check_outputs([*files, *beside], out, options.html_file)
    weather = read_weather_file(options.weather) if options.weather else None
    columns = read_map(map_file) if map_file else parse_map(content or b"", Path(f"the map of {files[0]}"))
    if columns.vehicle.model is None:
        columns = columns._replace(vehicle=columns.vehicle._replace(model=options.vehicle_model))
    if options.period is not None:
        holds = columns.sampling.holds if columns.sampling else find_holds()
        columns = columns._replace(sampling=Sampling(options.period, holds))
    if options.sequence is not None:
        columns = columns._replace(time=place_in_sequence(columns.time, options.sequence))
    skipped = SkippedFiles(options.skip_bad)
    tables = open_tables(files, kind, columns, skipped)
    summary = convert_tables(tables, columns, out, _list_settings(kind, options), skipped, weather)
    print_summary(summary, console)
    if options.html_file is not None:
        from socast.tools.report.imported import build_report  # noqa: PLC0415 - figures take seconds to import
        from socast.tools.report.page import write_report  # noqa: PLC0415 - ditto

        write_report(build_report(summary), options.html_file)
        console.print(f"report in {options.html_file}", markup=False, highlight=False, soft_wrap=True)


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


def _check_options(kind: str, options: TableImport, guesses: bool) -> None:
    """Refuse options that do not fit each other."""
    if options.map_file is None and not (guesses and options.out):
        raise SettingsError(
            f"--map is missing; name a map, or write a first one: socast import {kind} ... --guess --map MAP.toml"
        )
    if options.out is None and not guesses:
        raise SettingsError("--out is missing; name the recording to write, or use --guess to write a map only")
    if options.out is not None:
        check_recording(options.out)
    if options.weather is not None and options.out is None:
        raise SettingsError("--weather is given without --out; its observations enter a recording, so name one too")
    if options.html_file is not None and options.out is None:
        raise SettingsError("--html is given without --out; the page shows an import, so name a recording too")


def _list_settings(kind: str, options: TableImport) -> dict[str, str]:
    """Return the settings of the import for the metadata of the recording."""
    chosen = {
        "map": options.map_file and options.map_file.name,
        "preset": options.preset,
        "vehicle_model": options.vehicle_model,
        "period": options.period,
        "sequence": options.sequence,
        "weather": options.weather and options.weather.name,
        "dates": None if options.sequence is None else INVENTED,
    }
    return {"kind": kind} | {name: str(value) for name, value in chosen.items() if value is not None}


def _guess(kind: str, files: list[Path], options: TableImport, preset: Preset | None, console: Console) -> bytes:
    """Return a first map, written where a file is named, and show what was decided."""
    map_file = options.map_file
    if map_file is not None and map_file.exists():
        raise SettingsError(
            f"{map_file} is there already and would be overwritten; name another file, or leave --guess and --preset "
            "out to import with it"
        )
    check_outputs(files, map_file)
    skipped = SkippedFiles(options.skip_bad)
    tables = open_readable(files, kind, FileFormat(), skipped)
    guessed = guess_map(tables, preset, skipped)._replace(vehicle_model=options.vehicle_model)
    content = write_map_text(guessed, tables[0]).encode()
    if line := describe_preset(guessed):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(make_guess_table(guessed))
    lines = [describe_unread(guessed), *guessed.time.doubts]
    if options.out is None:  # an import says the rest itself
        lines += [*skipped.list_lines(len(files)), *describe_missing([each.field for each in guessed.fields])]
    for line in filter(None, lines):
        console.print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)
    if map_file is None:
        console.print("the map is not kept; --map MAP.toml keeps it, so that you can correct it", markup=False)
        return content
    try:
        write_whole(map_file, content)
    except OSError as error:
        raise ImportFileError(f"{map_file} cannot be written: {error.strerror}; name another file") from error
    console.print(f"map in {map_file}: check it, then import with --map {map_file}", markup=False, soft_wrap=True)
    return content


def check_recording(out: Path) -> None:
    """Refuse a recording whose name does not end as recordings do."""
    if out.suffix != RECORDING:
        raise SettingsError(f"--out {out}: a recording ends in {RECORDING}; name it {out.with_suffix(RECORDING)}")
