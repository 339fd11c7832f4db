"""The pages of the documentation, their links, and the calls of commands in them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from tests.support.paths import ROOT

PAGES: Final = (
    ROOT / "README.md",
    ROOT / "ARCHITECTURE.md",
    ROOT / "CHANGELOG.md",
    ROOT / "BENCHMARKS.md",
    ROOT / "recordings" / "README.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md")),
)
"""Every page."""
GUIDES: Final = sorted((ROOT / "docs" / "guide").glob("*.md"))
TUTORIAL: Final = ROOT / "docs" / "missing-effect.md"

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.MULTILINE)
_INCLUDED = re.compile(r"^<!-- included: ([\w./-]+) -->$", re.MULTILINE)


class Call(NamedTuple):
    """A call of a command that a page shows and that no test runs."""

    page: Path
    arguments: list[str]


def read(page: Path) -> str:
    """Return the text of a page, with the pages that it includes."""
    text = page.read_text(encoding="utf-8")
    return _INCLUDED.sub(lambda marker: read(ROOT / marker[1]), text)


def name_of(page: Path) -> str:
    """Return the path of a page in the project."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in one language."""
    return [content for kind, content in _FENCE.findall(read(page)) if kind == language]


def links(page: Path) -> list[str]:
    """Return the targets of the links of a page, code blocks left out."""
    return _LINK.findall(_FENCE.sub("", page.read_text(encoding="utf-8")))


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub and the site form them."""
    names: set[str] = set()
    for heading in _HEADING.findall(_FENCE.sub("", read(page))):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower().strip()
        anchor = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        names.add(anchor)
    return names


def shown_calls() -> Iterator[Call]:
    """Yield the calls of `socast` in the `sh` blocks of all pages."""
    for page in PAGES:
        for block in blocks(page, "sh"):
            for line in block.splitlines():
                program, *arguments = shlex.split(line, comments=True) or [""]
                if program == "socast":
                    yield Call(page, arguments)
