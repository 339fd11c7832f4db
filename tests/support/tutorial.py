"""A page that shows commands and what they print: read, run, compared, renewed.

In its console blocks a line that begins with `$ ` is a command, and what follows is its output, where `...` stands for
any number of lines. Numbers may be off by `TOLERANCE`, or by one in the last digit printed, as another processor rounds
otherwise; the version of a model, which is made of all its digits, by anything.
"""

import re
import shlex
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from tests.support.paths import ROOT
from tools.cli import main

PAGE = ROOT / "docs" / "missing-effect.md"

BLOCK = re.compile(r"^```console\n(.*?)^```$", re.DOTALL | re.MULTILINE)
ELISION = "..."
TOLERANCE = 0.02
NUMBER = re.compile(r"(?<![^\s(\[│±])[+\-−±]?\d[\d,]*(?:\.\d+)?(?:e[+-]\d+)?(?=[.,;:]?(?:[\s)\]│%]|$))")
"""Whole words only: names, dates and versions are no numbers."""
VERSION = re.compile(r"\b[0-9a-f]{12}\b")
RULES = re.compile(r"[─-╿]+")
"""Lines of tables, as long as their columns are wide."""


class Shown(NamedTuple):
    """A command of the page, and what the page says that it prints."""

    command: str
    lines: list[str]


def shown(page: str) -> Iterator[Shown]:
    """Give the commands of a page, in order."""
    for block in BLOCK.findall(page):
        yield from _of_block(block)


def _of_block(block: str) -> Iterator[Shown]:
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, *lines = part.rstrip("\n").split("\n")
        yield Shown(command, lines)


def printed(command: str, folder: Path) -> list[str]:
    """Run a command of the page in a folder, in this process, and return the lines that it prints."""
    program, *arguments = shlex.split(command)
    assert program == "socast", f"{command} is not a command of the product"
    out, told = StringIO(), StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(told):
        code = _ended(arguments)
    assert code == 0, f"{command}: {told.getvalue()}"
    return [line.rstrip() for line in out.getvalue().strip("\n").split("\n")]


def _ended(arguments: list[str]) -> object:
    try:
        main(arguments)
    except SystemExit as ended:
        return ended.code
    return 0


def prepared(folder: Path) -> Path:
    """Return a folder in which the commands of the page can be run one after another."""
    (folder / "recordings").symlink_to(ROOT / "recordings")
    return folder


def skeleton(line: str) -> str:
    """Return what of a line does not depend on its numbers."""
    plain = RULES.sub("─", VERSION.sub("@", line))
    return " ".join(NUMBER.sub("#", plain).split())


def alike(told: str, line: str) -> bool:
    """Tell whether a printed line is the one told, but for rounding."""
    if skeleton(told) != skeleton(line):
        return False
    pairs = zip(_numbers(told), _numbers(line), strict=True)
    return all(_close(one, other) for one, other in pairs)


def _numbers(line: str) -> list[str]:
    return NUMBER.findall(VERSION.sub("@", line))


def _close(told: str, found: str) -> bool:
    """Tell whether two numbers are alike; of small counts, and of signs, only the same one is."""
    one, other = (float(re.sub("[,±]", "", text).replace("−", "-")) for text in (told, found))
    if "e" in told or "e" in found:
        return 0.5 <= one / other <= 2.0
    digits = len(told.partition(".")[2])
    last = 10.0**-digits if digits or abs(one) >= 10.0 else 0.0
    return abs(one - other) <= max(TOLERANCE * abs(one), 1.001 * last)


def difference(told: list[str], lines: list[str]) -> str | None:
    """Return the first line that is told and not printed, in order; None where there is none."""
    at, free = 0, False
    for line in told:
        if line.strip() == ELISION:
            free = True
            continue
        where = next((i for i in range(at, len(lines)) if alike(line, lines[i])), None) if free else at
        if where is None or where >= len(lines) or not alike(line, lines[where]):
            return line
        at, free = where + 1, False
    return None if free or at == len(lines) else f"(nothing more, where it prints) {lines[at]}"


def renewed(told: list[str], lines: list[str]) -> list[str] | None:
    """Return what is told with the numbers now printed; None where other words are."""
    out: list[str] = []
    at, free = 0, False
    for line in told:
        if line.strip() == ELISION:
            out.append(line)
            free = True
            continue
        ends = range(at, len(lines) if free else min(at + 1, len(lines)))
        where = next((i for i in ends if alike(line, lines[i])), None)
        where = next((i for i in ends if skeleton(line) == skeleton(lines[i])), None) if where is None else where
        if where is None:
            return None
        out.append(lines[where])
        at, free = where + 1, False
    return out if free or at == len(lines) else None
