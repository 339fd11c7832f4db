"""Output of all commands: common options, checks of output files, JSON reports and the console."""

import os
import sys
from collections.abc import Iterable, Mapping
from datetime import date
from errno import EACCES
from math import isnan
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import msgspec
import typer
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.files import write_whole

STANDARD_OUTPUT: Final = Path("-")
"""The file name that means standard output."""
REPORT_VERSIONS: Final[Mapping[str, int]] = {
    "add": 2,
    "anonymise": 1,
    "ask": 1,
    "before-after": 1,
    "check": 1,
    "cluster": 1,
    "compare": 2,
    "condition": 1,
    "demo": 1,
    "diagnose": 7,
    "effect": 1,
    "effects": 1,
    "elevation": 1,
    "evaluate": 1,
    "evaluate-soc": 1,
    "findings": 1,
    "fit": 1,
    "history": 2,
    "import": 1,
    "info": 1,
    "quality": 1,
    "replay": 1,
    "secure": 1,
    "spikein": 1,
    "spikein-score": 1,
    "tables": 1,
    "vehicles": 1,
    "verify": 1,
    "waterfall": 3,
}
"""Name -> format version of each JSON report.

A version rises when a field is removed, is renamed or changes its meaning; it stays when a field is added.
"""
PIPE_WIDTH: Final = 120
"""Width of tables if the output is not a terminal. [characters]"""


def load_effects(files: list[Path] | None) -> list[Path] | None:
    """Load files of effects before the command starts, so that it knows these effects."""
    if files:
        from socast.core import effects  # noqa: PLC0415 - takes 0.2 s to import, and most commands are given no file

        for file in files:
            effects.load_file(file)
    return files


def load_vehicles(files: list[Path] | None) -> list[Path] | None:
    """Add the cars of data sheets to the catalogue before the command starts."""
    if files:
        from socast.core.vehicles import add_vehicles  # noqa: PLC0415 - most commands are given no file
        from socast.tools.terminal.vehicle_files import load_vehicle_file  # noqa: PLC0415 - ditto

        for file in files:
            add_vehicles(load_vehicle_file(file))
    return files


def _refuse_standard_output(file: Path | None) -> Path | None:
    """Refuse `-` as the file of an HTML page."""
    if file == STANDARD_OUTPUT:
        raise SettingsError("--html is '-', and standard output takes no page; name a file such as report.html")
    return file


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json", metavar="FILE", help="Write the results as JSON too; `-` prints them instead, for a pipe to jq."
    ),
]
HtmlFile = Annotated[
    Path | None,
    typer.Option("--html", metavar="FILE", help="Write a report with figures.", callback=_refuse_standard_output),
]
ModelName = Annotated[str, typer.Option(metavar="M", help="Name of a model, or a model file.")]
EventsFile = Annotated[
    Path | None,
    typer.Option(
        "--events",
        metavar="FILE.csv",
        help="Known events that may have changed a car, such as repairs: columns date,vehicle_id,what.",
    ),
]
EffectFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects", metavar="FILE", help="Load this file of your own effects; may be repeated.", callback=load_effects
    ),
]

VehicleFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--vehicles",
        metavar="FILE",
        help="Add the cars of this file of data sheets to the catalogue; may be repeated.",
        callback=load_vehicles,
    ),
]


class _PipedConsole(Console):
    """Print to a console that becomes silent when its reader has gone, instead of ending the process."""

    reader_has_gone: ClassVar[bool] = False

    def on_broken_pipe(self) -> None:
        """Discard all later output, so that the command can continue and write its files."""
        _PipedConsole.reader_has_gone = True
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def has_lost_reader() -> bool:
    """Return whether the reader of standard output has gone before the command printed everything."""
    return _PipedConsole.reader_has_gone


def make_console(json_file: Path | None = None) -> Console:
    """Return the console for tables and text: standard output, or standard error if the JSON report goes to the former.

    Returns
    -------
    rich.console.Console
        Console as wide as the terminal; without one as the variable COLUMNS says, or `PIPE_WIDTH`.
    """
    stderr = json_file == STANDARD_OUTPUT
    console = _PipedConsole(stderr=stderr)
    if console.is_terminal or os.environ.get("COLUMNS", "").isdigit():
        return console
    return _PipedConsole(stderr=stderr, width=PIPE_WIDTH)


def print_plain(console: Console, *lines: str, style: str = "", wraps: bool = False) -> None:
    """Print lines as they are, without markup; a line is broken only if it `wraps`."""
    for line in lines:
        console.print(line, style=style, markup=False, highlight=False, soft_wrap=not wraps)


def refuse(*mistakes: tuple[object, str]) -> None:
    """Raise `SettingsError` with the words of the first mistake that was made.

    Parameters
    ----------
    *mistakes : tuple of (object, str)
        Whether a mistake was made, and what it is with its remedy.
    """
    for is_made, words in mistakes:
        if is_made:
            raise SettingsError(words)


def refuse_existing(file: Path) -> None:
    """Refuse to overwrite a file."""
    refuse((file.exists(), f"{file} is there already and would be overwritten; name another file"))


def write_json(path: Path | None, report: str, value: Mapping[str, Any] | msgspec.Struct) -> None:
    """Write a report as JSON: first its format, then its fields, with NaN and infinity as null.

    Examples
    --------
    >>> write_json(Path("-"), "tables", {"rides": []})
    {
      "format": {
        "report": "tables",
        "version": 1
      },
      "rides": []
    }
    """
    if path is None:
        return
    builtins = msgspec.to_builtins(value) if isinstance(value, msgspec.Struct) else value
    content = {"format": {"report": report, "version": REPORT_VERSIONS[report]}, **builtins}
    text = msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
    if path == STANDARD_OUTPUT:
        sys.stdout.write(text.decode())
        sys.stdout.flush()
        return
    write_file(path, text)


def write_file(path: Path, content: bytes) -> None:
    """Write a file as a whole; one that is there is replaced."""
    try:
        write_whole(path, content)
    except OSError as error:
        raise SettingsError(f"{path} cannot be written: {error.strerror}; name a file in an existing folder") from error


def select_model_files(given: Iterable[str]) -> list[Path]:
    """Return the model files among the models that the command line names."""
    from socast.core.models import BUILT_IN_MODELS  # noqa: PLC0415 - imports numba, which `socast effects` does without

    return [Path(name) for name in given if name not in BUILT_IN_MODELS]


def check_outputs(inputs: Iterable[Path], *outputs: Path | None) -> None:
    """Refuse outputs that cannot be written or would overwrite an input, before the command does any work."""
    read, written = set(map(os.path.realpath, inputs)), set[str]()
    for path in outputs:
        if path is None or path == STANDARD_OUTPUT:
            continue
        if (place := os.path.realpath(path)) in read:  # unlike `resolve`, it takes links in a circle
            raise SettingsError(f"{path} is read and would be overwritten; name another file to write")
        if place in written:
            raise SettingsError(f"{path} is to be written twice; name another file for one of the two")
        written.add(place)
        reason = "Is a directory" if path.is_dir() else "" if path.parent.is_dir() else "No such file or directory"
        if reason:
            raise SettingsError(f"{path} cannot be written: {reason}; name a file in an existing folder")
        try:
            _try_to_write(Path(place))
        except OSError as error:
            raise SettingsError(
                f"{path} cannot be written: {error.strerror}; name a file that you may write, or another folder"
            ) from error


def _try_to_write(path: Path) -> None:
    """Open a file for writing without changing it; for anything but a plain file, only check the permission.

    A check of permissions alone is not enough. Root has every permission, but some file systems refuse files.
    """
    if not path.exists():
        path.open("xb").close()
        path.unlink()
    elif path.is_file():
        path.open("ab").close()
    elif not os.access(path, os.W_OK):
        raise PermissionError(EACCES, os.strerror(EACCES))


def parse_date(place: str, text: str) -> date:
    """Return the date of an option or of a field."""
    try:
        return date.fromisoformat(text.strip())
    except ValueError:
        raise SettingsError(f"{place} is '{text}'; give a date such as 2018-11-20") from None


def split_names(text: str | None) -> tuple[str, ...]:
    """Return the parts of a list separated by commas."""
    return tuple(filter(None, (part.strip() for part in (text or "").split(","))))


def parse_speed(text: str) -> float:
    """Return the speed of a replay from the command line, relative to real time.

    Examples
    --------
    >>> parse_speed("60"), parse_speed("10x"), parse_speed("max")
    (60.0, 10.0, inf)
    """
    try:
        value = float("inf") if text == "max" else float(text.removesuffix("x"))
    except ValueError:
        value = 0.0
    if isnan(value) or value <= 0:
        raise SettingsError(f"--speed is '{text}'; give a number above 0 such as 60, or max")
    return value
