"""What the programs of all measurements have in common: their options, what they keep, their tables and their end."""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from socast.core.errors import SettingsError, SocastError
from socast.tools.terminal.rich_table import Column, make_table

NEEDED: Final = object()
"""Default of an option that must be given."""
_OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "seeds": {"help": "seeds, such as 4001-4040 or 7,9"},
    "keep": {"type": Path, "help": "folder for what is made of each seed or car; what is in it is used again"},
    "json": {"type": Path, "help": "file for the figures"},
    "publish": {"action": "store_true", "help": "write the table to the pages"},
    "ved": {"type": Path, "help": "folder with the files of the Vehicle Energy Dataset"},
    "i3": {"type": Path, "help": "folder with the drives of the BMW i3"},
    "model3": {"type": Path, "help": "folder with the drives of the Tesla Model 3"},
}
"""Options that several measurements have."""


def make_parser(name: str, about: str | None, **options: Any) -> argparse.ArgumentParser:
    """Return the parser of a module of the benchmarks, with some of the usual options and their defaults."""
    parser = argparse.ArgumentParser(f"python -m socast.tools.bench.{name}", description=(about or "").splitlines()[0])
    for option, default in options.items():
        needed = {"required": True} if default is NEEDED else {"default": default}
        parser.add_argument(f"--{option}", **_OPTIONS[option] | needed)
    return parser


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a list of numbers and ranges.

    Examples
    --------
    >>> parse_seeds("1-3,7")
    [1, 2, 3, 7]
    """
    out: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if match is None:
            raise SettingsError(f"--seeds is {text!r}; give numbers and ranges, such as 4001-4040,4050")
        out += range(int(match[1]), int(match[2] or match[1]) + 1)
    return out


def tell_errors(main: Callable[..., None]) -> Callable[..., int]:
    """Let a program return 0, or 2 after an error of its user, which it prints."""

    @wraps(main)
    def run(arguments: list[str] | None = None) -> int:
        try:
            main(arguments)
        except SocastError as error:
            print(error, file=sys.stderr)
            return 2
        return 0

    return run


def keep(file: Path | None, make: Callable[[], Any]) -> Any:
    """Return what a JSON file holds; where it does not exist, make it first."""
    if file is None:
        return make()
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, make())
    return json.loads(file.read_text(encoding="utf-8"))


def write_json(file: Path | None, content: Any) -> None:
    """Write figures to a file, if one was asked for."""
    if file is not None:
        file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def show_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: str | None = None) -> None:
    """Print a table.

    Parameters
    ----------
    numbers : str, optional
        For each column `n` if it holds numbers, any other letter if not; by default all but the first do.
    """
    kinds = numbers or "-" + "n" * (len(heads) - 1)
    table = make_table([Column(head, number=kind == "n") for head, kind in zip(heads, kinds, strict=True)], title)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
