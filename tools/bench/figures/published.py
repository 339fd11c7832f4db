"""The frame of a measurement: its options, what it keeps and uses again, its table, and what it publishes in the pages.

A page shows a measured figure only inside a block, from `<!-- NAME begins -->` to `<!-- NAME ends -->`. A block holds
the lines of one measurement and says when, where and by which command they were made, or it is the table of results,
which takes single figures from several measurements. `docs/figures.json` keeps them.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from socast.core.errors import SettingsError, SocastError
from socast.core.files import replacing
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
_BLOCK: Final = re.compile(r"<!-- (?P<name>[a-z-]+) begins -->\n(?P<body>.*?)<!-- (?P=name) ends -->", re.DOTALL)
RESULTS: Final = "results"
"""Name of the block."""
ROWS: Final = (
    ("error of the energy of rides (wMAPE)", "evaluation", "wmape", "wmape_on"),
    ("the same on real drives", "real-drives", "wmape", "wmape_on"),
    ("the same of drives of a Tesla Model 3 (MAPE)", "real-cars", "error", "error_on"),
    ("error below baselines", "evaluation", "below", "below_on"),
    ("90 % prediction intervals of rides", "evaluation", "inside", "inside_on"),
    ("state of charge at the end of the shift, 2 h ahead", "soc-forecasts", "error", "error_on"),
    ("hidden effect named first", "hidden-effects", "right", "right_on"),
    ("another effect named first", "hidden-effects", "wrong", "wrong_on"),
    ("names given with 90 % or more", "hidden-effects", "sure", "sure_on"),
    (
        "hidden effect that the library lacks: another named with 90 % or more",
        "hidden-effects",
        "outside",
        "outside_on",
    ),
    ("known effect in real cars named", "real-cars", "named", "named_on"),
    ("one car that began to use 6 % more", "siblings", "found", "found_on"),
    ("drives of faulty loggers that are fit for training and wrong", "league", "wrong", "wrong_on"),
)
"""Result, measurement, and the names of its figure and of what it was measured on."""


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


def run_command(tree: Path, words: Sequence[str]) -> None:
    """Run a command of `socast` from a source tree."""
    done = subprocess.run(  # noqa: S603 - the words are ours
        [sys.executable, "-m", "socast", *words],
        cwd=tree,  # `-m` searches the working folder first
        env={**os.environ, "PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SocastError(f"{tree}: socast {' '.join(words)} ended with code {done.returncode}: {done.stderr.strip()}")


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


ROOT: Final = Path(__file__).resolve().parents[3]
KEPT: Final = ROOT / "docs" / "figures.json"
"""File that keeps the published figures."""


class Published(msgspec.Struct, frozen=True):
    """Hold what a measurement found.

    Parameters
    ----------
    commit : str
        Commit of the source tree, with a plus sign where the sources differed from it.
    machine : str
        Number of cores and version of Python.
    values : dict of str to str
        Single figures for the table of results.
    """

    command: str
    date: str
    commit: str
    machine: str
    lines: list[str]
    values: dict[str, str]


def list_results(published: Mapping[str, Published]) -> list[str]:
    """Return the lines of the table, without measurements that have not been published."""
    rows = [
        (result, one.values[figure], one.values.get(on, ""), one.date)
        for result, name, figure, on in ROWS
        if (one := published.get(name)) and figure in one.values
    ]
    return write_table(["result", "figure", "on what", "measured"], rows)


def publish(name: str, command: str, lines: Sequence[str], values: Mapping[str, str] | None = None) -> None:
    """Keep the figures of a measurement, and write them into the pages that have a block of its name."""
    known = read_published()
    known[name] = Published(
        command,
        datetime.now(UTC).date().isoformat(),
        _find_commit(),
        f"{os.cpu_count()} cores, Python {platform.python_version()}",
        list(lines),
        dict(values or {}),
    )
    with replacing(KEPT) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(dict(sorted(known.items())))) + b"\n")
    write_pages()


def read_published() -> dict[str, Published]:
    """Return the published figures by the name of their measurement; none without the file."""
    return msgspec.json.decode(KEPT.read_bytes(), type=dict[str, Published]) if KEPT.exists() else {}


def list_pages() -> list[Path]:
    """Return the pages that may have blocks."""
    return [ROOT / "README.md", ROOT / "BENCHMARKS.md", *sorted((ROOT / "docs").rglob("*.md"))]


def list_blocks(text: str) -> Iterator[tuple[str, str]]:
    """Yield name and content of each block of a page."""
    for block in _BLOCK.finditer(text):
        yield block["name"], block["body"]


def write_pages() -> None:
    """Write the published figures into all pages."""
    published = read_published()
    for path in list_pages():
        text = path.read_text(encoding="utf-8")
        if (new := render_page(text, published)) != text:
            with replacing(path) as temporary:
                temporary.write_text(new, encoding="utf-8")


def render_page(text: str, published: Mapping[str, Published]) -> str:
    """Return a page with the published figures in its blocks; a block without any stays as it is."""

    def render(block: re.Match[str]) -> str:
        name = block["name"]
        if name != RESULTS and name not in published:
            return block.group()
        lines = list_results(published) if name == RESULTS else describe(published[name])
        return "\n".join([f"<!-- {name} begins -->", *lines, "", f"<!-- {name} ends -->"])

    return _BLOCK.sub(render, text)


def write_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table.

    >>> write_table(["what", "goal"], [("speed", "2")])
    ['| what | goal |', '|---|---|', '| speed | 2 |']
    """
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(row)} |" for row in rows)]


def write_goal(low: float, high: float) -> str:
    """Return the words of a goal for a share.

    >>> write_goal(0.8, 1.0), write_goal(0.93, 0.97), write_goal(0.0, 0.006)
    ('>= 80 %', '93 to 97 %', '<= 0.6 %')
    """
    if high >= 1.0:
        return f">= {100.0 * low:g} %"
    return f"{100.0 * low:g} to {100.0 * high:g} %" if low > 0.0 else f"<= {100.0 * high:g} %"


def write_verdict(met: bool | None) -> str:
    """Return whether a goal is met, in a word; none without a goal."""
    return {True: "met", False: "missed", None: ""}[met]


def describe(one: Published) -> list[str]:
    """Return the lines of a block: where its figures come from, and the figures."""
    origin = f"Measured on {one.date} at commit {one.commit} ({one.machine}): `{one.command}`"
    return [origin, "", *one.lines]


def _find_commit() -> str:
    """Return the commit of the source tree, with a plus sign where the sources differ from it."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=8", "--dirty=+", "--exclude=*"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    return ended.stdout.strip() or "unknown"
