"""What commands have in common: arguments, and what they do with results: JSON files, tables, reports."""

import os
from collections.abc import Iterable
from errno import EACCES
from importlib import import_module
from math import isnan
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console

from core.errors import SettingsError


def _load(files: list[Path] | None) -> list[Path] | None:
    """Load effects before the command begins, so that it knows them."""
    if files:
        from core import effects  # noqa: PLC0415 - takes 0.2 s to import, and most commands are given no file

        for file in files:
            effects.load_file(file)
    return files


JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the table as JSON too.")]
HtmlFile = Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write a report with figures.")]
ModelName = Annotated[str, typer.Option(metavar="M", help="Model: a name, or a model file.")]
EffectFiles = Annotated[
    list[Path] | None,
    typer.Option("--effects", metavar="FILE", help="A file of your own effects; may be repeated.", callback=_load),
]

PIPE_WIDTH = 120
"""Columns that tables may take where there is no terminal."""


def printer() -> Console:
    """Return what prints to standard output, as wide as the terminal, or `PIPE_WIDTH` where there is none."""
    console = Console()
    return console if console.is_terminal else Console(width=PIPE_WIDTH)


def write_json(path: Path | None, value: Any) -> None:
    """Write a value as JSON, NaN as null; nothing where there is no path.

    Raises
    ------
    SettingsError
        Where the file cannot be written.
    """
    if path is None:
        return
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")
    except OSError as error:
        raise SettingsError(
            f"{path} cannot be written: {error.strerror}; name a file in a folder that is there"
        ) from error


def report(name: str, result: Any, html_file: Path | None, **options: Any) -> None:
    """Print the tables of a result, and write its page where that is wanted.

    Parameters
    ----------
    name : str
        Module of `tools.report` that shows it; loaded here, as figures take seconds to import.
    result : Any
    html_file : Path, optional
    options : Any
        For what shows it.
    """
    shown, console = import_module(f"tools.report.{name}"), printer()
    shown.show(result, console, **options)
    if html_file:
        shown.write(result, html_file, **options)
        console.print(f"report in {html_file}", markup=False, highlight=False, soft_wrap=True)


def model_files(given: Iterable[str]) -> list[Path]:
    """Return the files among models that the command line names."""
    from core.models import BUILT_IN_MODELS  # noqa: PLC0415 - imports numba, which `socast effects` does without

    return [Path(name) for name in given if name not in BUILT_IN_MODELS]


def writable(inputs: Iterable[Path], *outputs: Path | None) -> None:
    """Refuse, before any work is done, outputs that cannot be written or would overwrite what is read.

    Raises
    ------
    SettingsError
        Where an output is an input or another output, a folder, in a folder that is not there, or may not be written.
    """
    read, written = {path.resolve() for path in inputs}, set[Path]()
    for path in outputs:
        if path is None:
            continue
        if path.resolve() in read:
            raise SettingsError(f"{path} is read and would be overwritten; name another file to write")
        if path.resolve() in written:
            raise SettingsError(f"{path} is to be written twice; name another file for one of the two")
        written.add(path.resolve())
        reason = "Is a directory" if path.is_dir() else "" if path.parent.is_dir() else "No such file or directory"
        if reason:
            raise SettingsError(f"{path} cannot be written: {reason}; name a file in a folder that is there")
        try:
            _try_to_write(path.resolve())
        except OSError as error:
            raise SettingsError(
                f"{path} cannot be written: {error.strerror}; name a file that you may write, or another folder"
            ) from error


def _try_to_write(path: Path) -> None:
    """Open a file for writing and leave all as it was; of what is no plain file, such as a pipe, ask only.

    Permissions do not tell all: root has them everywhere, yet some file systems take no files.
    """
    if not path.exists():
        path.open("xb").close()
        path.unlink()
    elif path.is_file():
        path.open("ab").close()
    elif not os.access(path, os.W_OK):
        raise PermissionError(EACCES, os.strerror(EACCES))


def speed(text: str) -> float:
    """Return a speed from the command line: a number, or `max`.

    Raises
    ------
    SettingsError
        For anything else.

    Examples
    --------
    >>> speed("60"), speed("10x"), speed("max")
    (60.0, 10.0, inf)
    """
    try:
        value = float("inf") if text == "max" else float(text.removesuffix("x"))
    except ValueError:
        value = 0.0
    if isnan(value) or value <= 0:
        raise SettingsError(f"--speed is '{text}'; give a number above 0 such as 60, or max")
    return value
