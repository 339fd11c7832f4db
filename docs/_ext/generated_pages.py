"""Sphinx extension: fill pages from the code and from the project's own pages when the documentation is built.

A page that contains the comment `<!-- generated: NAME -->` receives the Markdown of the generator of that name in its
place. The comment `<!-- included: PATH -->` is replaced by a page of the project, whose path is relative to the root of
the project. Such pages are read anew in every build, so that they never lag behind the code.

Links that work on the pages of a repository also work on the site: a link to a page of the project leads to its copy on
the site, and a link to any other file becomes the name of that file.
"""  # noqa: INP001

import os.path
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import command_pages
import effect_pages
import table_pages
import wire_pages
from sphinx.application import Sphinx

DOCS: Final = Path(__file__).parents[1]
ROOT: Final = DOCS.parent
MARKER: Final = re.compile(r"^<!-- (generated|included): ([\w./-]+) -->$", re.MULTILINE)
LINK: Final = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
GENERATORS: Final[Mapping[str, Callable[[], str]]] = {
    "commands": command_pages.commands,
    "effects": effect_pages.effects,
    "telemetry-columns": table_pages.telemetry_columns,
    "signal-columns": table_pages.signal_columns,
    "ride-columns": table_pages.ride_columns,
    "window-columns": table_pages.window_columns,
    **wire_pages.generators(),
}
"""Name in the comment -> function that returns Markdown."""
COPIES: Final[Mapping[str, str]] = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "BENCHMARKS.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "recordings/README.md": "recordings.md",
}
"""Page of the project -> its copy on the site."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("source-read", _fill)
    app.connect("env-get-outdated", _outdated)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _skip(_app: Sphinx, _kind: str, _name: str, member: object, _skip: bool, _options: Any) -> bool | None:
    """Skip the fields of a named tuple, which its docstring describes."""
    return True if type(member).__name__ == "_tuplegetter" else None


def _fill(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace every marker of a page, then adapt its links."""
    path = app.env.doc2path(page)
    text = _with_links(source[0], Path(path), Path(path))
    source[0] = MARKER.sub(lambda marker: _content(marker[1], marker[2], Path(path)), text)


def _content(kind: str, name: str, page: Path) -> str:
    """Return what takes the place of a marker on a page."""
    if kind == "generated":
        return GENERATORS[name]()
    origin = ROOT / name
    return _with_links(origin.read_text(encoding="utf-8"), origin, page)


def _with_links(text: str, origin: Path, page: Path) -> str:
    """Return a text of one page with its links adapted to another page of the site."""

    def adapted(link: re.Match[str]) -> str:
        image, words, target, anchor = link.groups()
        file = Path(os.path.normpath(origin.parent / target))
        if "://" in target or not file.exists() or (origin == page and DOCS in file.parents):
            return link[0]
        name = file.relative_to(ROOT).as_posix()
        if name not in COPIES and DOCS not in file.parents:
            return words if words.startswith("`") or words != name else f"`{name}`"
        there = DOCS / COPIES.get(name, file.relative_to(DOCS) if DOCS in file.parents else "")
        return f"{image}[{words}]({os.path.relpath(there, page.parent)}{anchor or ''})"

    return LINK.sub(adapted, text)


def _outdated(app: Sphinx, env: Any, _added: set[str], _changed: set[str], _removed: set[str]) -> list[str]:
    """Return the pages that hold generated or included parts."""
    return [page for page in env.found_docs if MARKER.search(Path(app.env.doc2path(page)).read_text(encoding="utf-8"))]
