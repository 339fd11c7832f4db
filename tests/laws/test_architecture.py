"""The structure is what ARCHITECTURE.md says it is."""

import ast
import re
from pathlib import Path

import pytest

from tests.support.paths import ROOT

SOURCES = sorted(path for package in ("core", "stream", "tools") for path in (ROOT / package).rglob("*.py"))
PAGE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
MAY_IMPORT = {"core": {"core"}, "stream": {"core", "stream"}, "tools": {"core", "stream", "tools"}}
LAYERS = ["", "learn", "evaluate", "diagnose"]
"""Packages of core, each above those before it; the files of core itself are the lowest."""
ONLY_IN = {"zenoh": r"stream/zenoh_\w+\.py", "mcap": r"stream/mcap_io\.py|tools/bench/measures\.py"}
"""Package of a transport -> which files may import it."""
ids = pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))


def imported(path: Path) -> set[str]:
    """Return the modules that a file imports, in full."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@ids
def test_imports_run_from_tools_to_stream_to_core(path):
    ours = {name.partition(".")[0] for name in imported(path)} & set(MAY_IMPORT)
    assert ours <= MAY_IMPORT[path.relative_to(ROOT).parts[0]]


@ids
def test_each_transport_is_imported_where_it_is_served(path):
    foreign = {name.partition(".")[0] for name in imported(path)}
    for package, files in ONLY_IN.items():
        assert package not in foreign or re.fullmatch(files, str(path.relative_to(ROOT)))


@ids
def test_nothing_in_core_imports_the_pipeline_or_looks_at_a_clock(path):
    if path.relative_to(ROOT).parts[0] != "core":
        return
    modules = imported(path)
    assert path.stem == "pipeline" or "core.pipeline" not in modules
    assert not {"time", "threading", "asyncio", "socket"} & modules


@ids
def test_inside_core_imports_run_one_way(path):
    place = path.relative_to(ROOT).parts
    if place[0] != "core":
        return
    own = LAYERS.index(place[1]) if place[1] in LAYERS else 0
    above = {f"core.{layer}" for layer in LAYERS[own + 1 :]}
    assert not {name for name in imported(path) if ".".join(name.split(".")[:2]) in above}


@ids
def test_a_file_reads_in_one_sitting(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < 500


def test_the_page_names_every_file_of_core_and_stream_and_no_other():
    named = set(re.findall(r"`(?:core/|stream/)?(\w+\.py)`", PAGE))
    files = {path.name for path in SOURCES if path.parent.name in {"core", "stream"} and path.name != "__init__.py"}
    assert files - named == set()
    everywhere = {path.name for path in SOURCES} | {path.name for path in (ROOT / "tests").glob("*.py")}
    assert named - everywhere == set()
