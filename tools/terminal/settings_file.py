"""The option `--settings`: a TOML file with the options of a command by their long names.

The file sets defaults, so options on the command line take precedence. Names, types and limits are those of the
options themselves. A mistake in the file is one line with the file, the line number, the value, what it must be, and
the remedy.
"""

import inspect
import re
import tomllib
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Union, get_args, get_origin

import typer

from socast.core.errors import SettingsError, read_input
from socast.core.files import UNREADABLE_TOML, parse_toml

_PLACES: Final = "socast.settings_places"
"""Key under which the context of a command keeps where each setting stands."""
_OWN: Final = "--settings"
_WANTED: Final[dict[type, tuple[tuple[type, ...], str]]] = {
    bool: ((bool,), "true or false"),
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
}
"""Type of an option -> types in TOML, and their name for people; every other option takes text."""
_TEXT: Final = ((str,), "text in quotes")


def _apply_settings(context: typer.Context, file: Path | None) -> Path | None:
    """Let the file set the defaults of the command."""
    if file is not None and not context.resilient_parsing:
        values, places = read_settings(file, context.command)
        context.default_map = values
        context.meta[_PLACES] = places
    return file


SettingsFile = Annotated[
    Path | None,
    typer.Option(
        _OWN,
        metavar="F.toml",
        help="Read options from this file, by their long names; the command line takes precedence.",
        is_eager=True,
        callback=_apply_settings,
    ),
]


def read_settings(file: Path, command: Any) -> tuple[dict[str, Any], dict[str, str]]:
    """Read the settings of a command.

    Parameters
    ----------
    file : Path
        TOML file: long names of options without dashes before them; a list where an option may be repeated.
    """
    try:
        content = read_input(file)
    except OSError as error:
        raise SettingsError(f"{file} cannot be read: {error.strerror}; give an existing file with {_OWN}") from error
    try:
        text = content.decode()
        settings = parse_toml(text)
    except UNREADABLE_TOML as error:
        raise SettingsError(explain_toml(file, content, error)) from error
    options = list_settings(command)
    annotations = inspect.signature(command.callback).parameters
    values: dict[str, Any] = {}
    places: dict[str, str] = {}
    for key, value in settings.items():
        place = f"{file}, line {find_line(text, key)}"
        if key not in options:
            raise SettingsError(f"{place}: {_refuse_name(key, value, list(options), command.name)}")
        name = options[key].name
        if wanted := _find_mistake(value, annotations[name].annotation):
            raise SettingsError(
                f"{place}: --{key} is {_shorten(value)}, must be {wanted}; `socast {command.name} --help`"
            )
        values[name], places[name] = value, place
    return values, places


def list_settings(command: Any) -> dict[str, Any]:
    """Return the options of a command that a settings file may hold, by their long names without dashes."""
    long = {opt: each for each in command.params for opt in each.opts if opt.startswith("--") and opt != _OWN}
    return {opt.removeprefix("--"): each for opt, each in long.items()}


def name_place(context: typer.Context | None, parameter: Any) -> str:
    """Return the file and the line of the value of a parameter, with a colon; empty where no file sets it."""
    if context is None or parameter is None:
        return ""
    source = context.get_parameter_source(parameter.name)
    places: dict[str, str] = context.meta.get(_PLACES, {})
    is_of_file = source is not None and source.name == "DEFAULT_MAP" and parameter.name in places
    return f"{places[parameter.name]}: " if is_of_file else ""


def find_place(context: typer.Context, words: str) -> str:
    """Return the place of the option that an error message begins with, such as `--prefix is ...`; empty for others."""
    named = re.match(r"(?:--)?([a-z-]+) is ", words)
    return name_place(context, list_settings(context.command).get(named[1])) if named else ""


def explain_toml(file: Path, content: bytes, error: Exception) -> str:
    """Return what is wrong with a file that is not TOML."""
    if isinstance(error, UnicodeDecodeError):
        return f"{file} is not UTF-8 from byte {error.start} on; save it as UTF-8"
    if not isinstance(error, tomllib.TOMLDecodeError):  # nested too deeply, or a number of too many digits
        return f"{file} is not TOML: {error}; write NAME = VALUE, each name once, and text in quotes"
    text = content.decode()
    words, _, end = str(error).rpartition(" (at ")
    at = re.fullmatch(r"line (\d+), column (\d+)\)", end)
    place = f"line {at[1]}, column {at[2]}" if at else f"line {len(text.splitlines())}, at the end"
    wrong = _shorten(text.splitlines()[(int(at[1]) if at else 0) - 1].strip()) if text.strip() else ""
    return f"{file}, {place}: {wrong} is not TOML: {words}; write NAME = VALUE, each name once, and text in quotes"


def find_line(text: str, *keys: str) -> int:
    r"""Return the number of the line that sets a key below tables, or of the last table on the way that is there.

    Examples
    --------
    >>> find_line("[time]\ncolumn = 'a'\n[vehicle]\ncolumn = 'b'", "vehicle", "column")
    4
    """
    at = 0
    for key in keys:
        name = rf"(?:{re.escape(key)}|\"{re.escape(key)}\"|'{re.escape(key)}')"
        found = re.compile(rf"^[ \t]*(?:\[+[ \t]*[\w.\"']*)?{name}[ \t]*[=.\]]", re.MULTILINE).search(text, at)
        at = found.start() if found else at
    return text.count("\n", 0, at) + 1


def _refuse_name(key: str, value: Any, names: list[str], command: str) -> str:
    """Return why a key is no setting, and what it may be."""
    if isinstance(value, dict):
        return f"'{key}' is a table; write each option as NAME = VALUE, without tables"
    if f"--{key}" == _OWN:
        return "a settings file cannot name another one; join them"
    near = get_close_matches(key, names, 1)
    hint = f"did you mean '{near[0]}'?" if near else "leave it out;"
    return f"no setting '{key}': {hint} `socast {command} --help` lists the options"


def _find_mistake(value: Any, annotation: Any) -> str:
    """Return what a value must be, where it is something else."""
    while get_origin(annotation) in {Annotated, Union, UnionType}:
        annotation = next(part for part in get_args(annotation) if part is not type(None))
    is_repeatable = get_origin(annotation) is list
    kind = get_args(annotation)[0] if is_repeatable else annotation
    types, words = _WANTED.get(kind, _TEXT)
    parts = value if is_repeatable and isinstance(value, list) else [value]
    is_right = isinstance(value, list) == is_repeatable and all(
        isinstance(part, types) and (bool in types or not isinstance(part, bool)) for part in parts
    )
    return "" if is_right else f"a list of {words}, such as ['a', 'b']" if is_repeatable else words


def _shorten(value: Any) -> str:
    """Return a value as a person recognises it, cut where it is long."""
    text = repr(value) if isinstance(value, str | list) else str(value).lower()
    return text if len(text) <= 60 else f"{text[:57]}..."
