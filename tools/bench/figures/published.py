"""Publish what a measurement found: keep it in `docs/figures.json`, and write it into the pages between marks.

A page shows a measured figure only inside a block, from `<!-- NAME begins -->` to `<!-- NAME ends -->`. A block holds
the lines of one measurement and says when, where and by which command they were made, or it is the table of results,
which takes single figures from several measurements.
"""

import os
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import msgspec

from socast.core.files import replacing

ROOT: Final = Path(__file__).resolve().parents[3]
KEPT: Final = ROOT / "docs" / "figures.json"
"""File that keeps the published figures."""
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


def read_published(path: Path = KEPT) -> dict[str, Published]:
    """Return the published figures by the name of their measurement; none without the file."""
    return msgspec.json.decode(path.read_bytes(), type=dict[str, Published]) if path.exists() else {}


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


def describe(one: Published) -> list[str]:
    """Return the lines of a block: where its figures come from, and the figures."""
    origin = f"Measured on {one.date} at commit {one.commit} ({one.machine}): `{one.command}`"
    return [origin, "", *one.lines]


def _find_commit() -> str:
    """Return the commit of the source tree, with a plus sign where the sources differ from it."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=8", "--dirty=+", "--exclude=*"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    return ended.stdout.strip() or "unknown"
