"""Run `socast import csv` and `socast import parquet`: guess a map, convert with it, and show what was found."""

from pathlib import Path

from rich.console import Console

from core.errors import ImportFileError, SettingsError
from tools.importers.table.column_map import FileFormat, read_map
from tools.importers.table.conversion import convert_tables, open_tables
from tools.importers.table.guess import guess_map
from tools.importers.table.import_summary import print_summary
from tools.importers.table.map_text import make_guess_table, write_map_text
from tools.importers.table.table_file import KINDS, list_tables, open_table
from tools.terminal.output import check_outputs, make_console

TABLE_KINDS = tuple(KINDS)
"""Kinds of tables that `socast import` reads with a map."""


def import_tables(
    kind: str,
    paths: list[Path],
    map_file: Path | None,
    out: Path | None,
    vehicle_model: str | None,
    *,
    guess: bool,
    html_file: Path | None,
) -> None:
    """Guess a map of tables, or convert tables with a map, or both.

    Parameters
    ----------
    kind : str
        `csv` or `parquet`.
    paths : list of Path
        Files and folders.
    map_file : Path, optional
        The map.
    out : Path, optional
        The recording; None only guesses.
    vehicle_model : str, optional
        Vehicle model of cars for which the map names none.
    guess : bool
        Whether to write the map first.
    html_file : Path, optional
        Page with a picture of what agrees.

    Raises
    ------
    SettingsError
        If the options do not fit each other.
    ImportFileError
        If a file or the map cannot be read.
    """
    if map_file is None:
        raise SettingsError(
            f"--map is missing; name a map, or write a first one: socast import {kind} ... --guess --map MAP.toml"
        )
    if out is None and not guess:
        raise SettingsError("--out is missing; name the recording to write, or use --guess to write a map only")
    if html_file is not None and out is None:
        raise SettingsError("--html is given without --out; the page shows an import, so name a recording too")
    files = list_tables(paths, kind)
    console = make_console()
    if guess:
        _write_guess(kind, files, map_file, console)
    if out is None:
        return
    check_outputs([*files, map_file], out, html_file)
    columns = read_map(map_file)
    if columns.vehicle.model is None:
        columns = columns._replace(vehicle=columns.vehicle._replace(model=vehicle_model))
    tables = open_tables(files, kind, columns)
    summary = convert_tables(tables, columns, out, _list_settings(kind, map_file, vehicle_model))
    print_summary(summary, console)
    if html_file is not None:
        from tools.report.imported import write  # noqa: PLC0415 - figures take seconds to import

        write(summary, html_file)
        console.print(f"report in {html_file}", markup=False, highlight=False, soft_wrap=True)


def _list_settings(kind: str, map_file: Path, vehicle_model: str | None) -> dict[str, str]:
    """Return the settings of the import for the metadata of the recording."""
    chosen = {} if vehicle_model is None else {"vehicle_model": vehicle_model}
    return {"kind": kind, "map": map_file.name} | chosen


def _write_guess(kind: str, files: list[Path], map_file: Path, console: Console) -> None:
    """Write a first map and show what was decided."""
    if map_file.exists():
        raise SettingsError(
            f"{map_file} is there already and would be overwritten; name another file or leave --guess out"
        )
    check_outputs(files, map_file)
    tables = [open_table(file, kind, FileFormat()) for file in files]
    guessed = guess_map(tables)
    try:
        map_file.write_text(write_map_text(guessed, tables[0]), encoding="utf-8")
    except OSError as error:
        raise ImportFileError(f"{map_file} cannot be written: {error.strerror}; name another file") from error
    console.print(make_guess_table(guessed))
    console.print(f"map in {map_file}: check it, then import with --map {map_file}", markup=False, soft_wrap=True)
