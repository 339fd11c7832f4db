"""Commands on pages of the documentation: find them, run them, compare their output, renew it.

In a console block, a line that begins with `$ ` is a command; the lines after it are its output. A line `...` in the
output stands for any number of lines. A printed number may differ by `TOLERANCE`, or by one in its last digit, because
another processor rounds otherwise. The version of a model may differ altogether, because it depends on every digit.
"""

import re
import shlex
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from socast.tools.cli import main
from tests.support.libraries import restored_libraries
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "missing-effect.md"
"""The tutorial."""

BLOCK = re.compile(r"^```console\n(.*?)^```$", re.DOTALL | re.MULTILINE)
ELISION = "..."
TOLERANCE = 0.02
NUMBER = re.compile(r"(?<![^\s(\[│±])[+\-−±]?\d[\d,]*(?:\.\d+)?(?:e[+-]\d+)?(?=[.,;:]?(?:[\s)\]│%]|$))")
"""Whole words only: names, dates and versions are not numbers."""
VERSION = re.compile(r"\b[0-9a-f]{12}\b")
RULES = re.compile(r"[─-╿]+")
"""Lines of tables; their length depends on the width of the columns."""


class DocumentedCommand(NamedTuple):
    """A command on a page, and the output that the page shows."""

    command: str
    lines: list[str]


class Shell:
    """Run the commands of pages in one folder, each command once.

    Parameters
    ----------
    folder : Path
        Working folder of the commands, see `prepare_folder`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._outputs: dict[str, list[str]] = {}

    def run(self, command: str) -> list[str]:
        """Return the lines that a command prints, from the first time that it ran."""
        if command not in self._outputs:
            self._outputs[command] = run_command(command, self.folder)
        return self._outputs[command]


def documented_commands(page: str) -> Iterator[DocumentedCommand]:
    """Yield the commands of a page, in order."""
    for block in BLOCK.findall(page):
        yield from _commands_of_block(block)


def _commands_of_block(block: str) -> Iterator[DocumentedCommand]:
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, *lines = part.rstrip("\n").split("\n")
        yield DocumentedCommand(command, lines)


def run_command(command: str, folder: Path) -> list[str]:
    """Run a command in a folder and return the lines that it prints.

    It runs in this process, which saves seconds of imports, and leaves no effect or vehicle model behind.
    """
    program, *arguments = shlex.split(command)
    assert program == "socast", f"{command} is not a command of the project"
    out, errors = StringIO(), StringIO()
    code: object = 0
    with restored_libraries(), chdir(folder), redirect_stdout(out), redirect_stderr(errors):
        try:
            main(arguments)
        except SystemExit as ended:
            code = ended.code
    assert code == 0, f"{command}: {errors.getvalue()}"
    return [line.rstrip() for line in out.getvalue().strip("\n").split("\n")]


def prepare_folder(folder: Path) -> Path:
    """Return a folder in which the commands of a page can run one after another."""
    (folder / "recordings").symlink_to(ROOT / "recordings")
    return folder


def skeleton(line: str) -> str:
    """Return the part of a line that does not depend on its numbers."""
    plain = RULES.sub("─", VERSION.sub("@", line))
    return " ".join(NUMBER.sub("#", plain).split())


def lines_match(shown: str, printed: str) -> bool:
    """Return whether a printed line equals the line shown, except for rounding."""
    if skeleton(shown) != skeleton(printed):
        return False
    pairs = zip(_numbers(shown), _numbers(printed), strict=True)
    return all(_numbers_match(one, other) for one, other in pairs)


def _numbers(line: str) -> list[str]:
    return NUMBER.findall(VERSION.sub("@", line))


def _numbers_match(shown: str, printed: str) -> bool:
    """Return whether two numbers are equal except for rounding; small counts and signs must be the same."""
    one, other = (float(re.sub("[,±]", "", text).replace("−", "-")) for text in (shown, printed))
    if "e" in shown or "e" in printed:
        return 0.5 <= one / other <= 2.0
    digits = len(shown.partition(".")[2])
    last = 10.0**-digits if digits or abs(one) >= 10.0 else 0.0
    return abs(one - other) <= max(TOLERANCE * abs(one), 1.001 * last)


def first_difference(shown: list[str], printed: list[str]) -> str | None:
    """Return the first line that is shown and not printed, in order; None where there is none."""
    at, free = 0, False
    for line in shown:
        if line.strip() == ELISION:
            free = True
            continue
        candidates = range(at, len(printed) if free else min(at + 1, len(printed)))
        where = next((i for i in candidates if lines_match(line, printed[i])), None)
        if where is None:
            return line
        at, free = where + 1, False
    return None if free or at == len(printed) else f"(nothing more, where it prints) {printed[at]}"


def renew_lines(shown: list[str], printed: list[str]) -> list[str] | None:
    """Return the lines shown with the numbers that are printed; None where the words differ."""
    out: list[str] = []
    at, free = 0, False
    for line in shown:
        if line.strip() == ELISION:
            out.append(line)
            free = True
            continue
        candidates = range(at, len(printed) if free else min(at + 1, len(printed)))
        where = next((i for i in candidates if lines_match(line, printed[i])), None)
        if where is None:
            where = next((i for i in candidates if skeleton(line) == skeleton(printed[i])), None)
        if where is None:
            return None
        out.append(printed[where])
        at, free = where + 1, False
    return out if free or at == len(printed) else None
