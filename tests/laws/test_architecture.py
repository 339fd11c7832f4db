"""The packages stand in the order of the data, and imports follow it: see ARCHITECTURE.md."""

import ast
import re
import threading
from collections import defaultdict
from functools import cache, reduce
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

from socast.core.pipeline import Pipeline
from socast.stream.loop import run
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import LatestOnlySink, ZenohSink
from socast.stream.zenoh_source import ZenohSource
from tests.support.paths import ROOT
from tests.support.telemetry import drive, leaf, telemetry
from tests.support.zenoh_sessions import eventually, router

ORDER = (
    *(
        "socast.core.errors",
        "socast.core.columns",
        "socast.core.batch",
        "socast.core.settings",
        "socast.core.formatting",
        "socast.core.records",
        "socast.core.files",
        "socast.core.compiled_cache",
    ),
    *(
        "socast.core.wire",
        "socast.core.cleaning",
        "socast.core.vehicles",
        "socast.core.signals",
        "socast.core.effects",
        "socast.core.totals",
        "socast.core.models",
    ),
    *(
        "socast.core.stats",
        "socast.core.forecast",
        "socast.core.monitoring",
        "socast.core.snapshot",
        "socast.core.pipeline",
    ),
    *("socast.core.fit", "socast.core.evaluate", "socast.core.diagnose", "socast.core.condition"),
    *("socast.stream", "socast.tools", "socast"),
)
"""Packages and root modules; each may import itself and those before it."""
MOST_PACKAGES, MOST_MODULES, MOST_LINES = 14, 10, 499
ONLY_IN = {
    "zenoh": r"stream/zenoh_\w+\.py",
    "mcap": r"stream/mcap_\w+\.py|tools/bench/replay\.py",
    "rasterio": r"stream/elevation_tiles\.py",
    "paho": r"stream/mqtt_\w+\.py",
}
"""Library of a transport or of a format -> files that may import it."""
CLOCKS = {"time", "threading", "asyncio", "socket"}
"""Modules that core must not import."""
ONE_NAME = re.compile(r"\bsocast(?:\.\w+)+")

SOURCES = sorted(path for package in ("core", "socast", "stream", "tools") for path in (ROOT / package).rglob("*.py"))
PLACES = {
    path: Path("socast")
    / path.relative_to(ROOT).relative_to("socast" if "socast" in path.relative_to(ROOT).parts else "")
    for path in SOURCES
}
"""Files of the code -> where they are when the product is installed."""
MODULES = {".".join(place.with_suffix("").parts).removesuffix(".__init__"): path for path, place in PLACES.items()}
PAGE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
WAY = re.findall(r"^\d+\. `([\w.]+)`, `([\w/]+)\.py`: ", PAGE, re.MULTILINE)
"""Functions of the way of a live sample, and their files."""
MOST_HOPS = 10
CALLERS = {f"socast.{name}" for name in ("stream.loop", "core.pipeline", "core.totals.sample_totals")} | {
    "socast.core.forecast.due_forecasts"
}
"""Modules that call the functions of the way in turn, and pass on what each returns."""


@cache
def parse(module: str) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


INPUT_OUTPUT = re.compile(
    r"\bopen\(|\.open\(|read_bytes\(|read_text\(|write_bytes\(|write_text\(|ParquetFile\(|ParquetWriter\(|"
    r"import subprocess|from joblib|import joblib|os\.replace|NamedTemporaryFile|write_whole\("
)
"""What reads or writes files, or starts processes."""
OUTSIDE = {
    "core/compiled_cache.py",  # the sources of kernels
    "core/effects/registry.py",  # files of the user's effects, imported in a process of their own first
    "core/errors.py",
    "core/evaluate/paper/published.py",  # the paper's tables, in the package
    "core/evaluate/paper/runs.py",
    "core/files.py",
    "core/fit/ride_blocks.py",
    "core/models/file.py",
    "core/vehicles/catalogue.py",  # the catalogue, in the package
}
"""Files of core that do: those of the page, their helpers, and data in the package."""


WRITES = re.compile(r"\.write_(?:text|bytes)\(|open\([^)\n]*\"[wxa]b?\"|OSFile\(|(?<!class )\bMcapSink\(")
"""What writes files under their own name."""
WRITERS = {
    "core/files.py",
    "stream/mcap_writer.py",
    "stream/recorder.py",  # recordings of a service have new names, and are read while they grow
    "stream/state_file.py",  # under `replacing`
    "tools/cluster/cleaning.py",  # files of a job, which are removed at its end
    "tools/cluster/decoding.py",
    "tools/cluster/job.py",
    "tools/cluster/ordering.py",
    "tools/security/folder.py",  # under `replacing`
    "tools/simulator/car_files.py",  # scratch
    "tools/terminal/kernels.py",  # in a temporary folder
    "tools/terminal/output.py",  # tries whether a file can be written
}
"""Files that do; others write through `core/files.py` and `replace_recording`, so that a full disk spoils nothing."""


def docstrings(tree: ast.Module) -> set[int]:
    """Return the identities of the docstrings and of the texts that describe constants."""
    return {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }


@cache
def import_names(module: str) -> frozenset[str]:
    """Return everything that a module imports, also for type checkers alone, and what it names in text as a module."""
    tree = parse(module)
    texts = docstrings(tree)
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import"
            full = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in MODULES else node.module or "" for name in full.values()}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in texts:
            named = {name for name in ONE_NAME.findall(node.value) if name in MODULES}
            names |= {name for name in named if not module.startswith(f"{name}.")}  # its own package is loaded anyway
    return frozenset(names)


@cache
def imported_modules(module: str) -> frozenset[str]:
    """Return the modules of this repository that a module imports."""
    return (import_names(module) & set(MODULES)) - {module}


def place(module: str) -> int:
    """Return the place in `ORDER` of the package that a module belongs to."""
    parts = module.split(".")
    inner = {"core": 3, "stream": 2, "tools": 2}.get(parts[1] if len(parts) > 1 else "", 1)
    return ORDER.index(".".join(parts[:inner]))


def test_no_import_runs_upward():
    upward = {
        (module, name)
        for module in set(MODULES) - {"socast.core"}
        for name in imported_modules(module) - {"socast.core"}
        if place(name) > place(module)
    }
    assert upward == set()
    assert imported_modules("socast.core") == set()


def test_folders_are_imported_under_the_name_of_the_product():
    """The folders `core`, `stream` and `tools` are installed in `socast`; a user's project may have such names."""
    for module in MODULES:
        names = {name.partition(".")[0] for name in import_names(module)}
        assert names.isdisjoint({"core", "stream", "tools", "recordings"}), module


def test_imports_have_no_cycle():
    order = TopologicalSorter({module: imported_modules(module) for module in MODULES})
    order.prepare()  # raises CycleError, which names the modules


def test_root_of_core_is_small():
    packages = [path for path in (ROOT / "core").iterdir() if (path / "__init__.py").exists()]
    modules = [path for path in (ROOT / "core").glob("*.py") if path.name != "__init__.py"]
    assert len(packages) <= MOST_PACKAGES
    assert len(modules) <= MOST_MODULES


def test_transport_is_imported_only_in_its_files():
    for module, path in MODULES.items():
        libraries = {name.partition(".")[0] for name in import_names(module)}
        for library, files in ONLY_IN.items():
            assert library not in libraries or re.fullmatch(files, str(path.relative_to(ROOT))), (module, library)


def test_core_reads_no_clock():
    readers = {module for module in MODULES if module.startswith("socast.core") and CLOCKS & import_names(module)}
    assert readers == set()


def test_core_reads_writes_and_starts_processes_in_few_files_only():
    found = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "core").rglob("*.py")
        if INPUT_OUTPUT.search(path.read_text(encoding="utf-8"))
    }
    assert found == OUTSIDE


def test_what_is_kept_is_written_whole():
    found = {
        str(path.relative_to(ROOT))
        for path in SOURCES
        if not path.is_relative_to(ROOT / "tools" / "bench") and WRITES.search(path.read_text(encoding="utf-8"))
    }
    assert found == WRITERS


def test_every_file_has_fewer_than_500_lines():
    files = [*SOURCES, *sorted((ROOT / "tests").rglob("*.py"))]
    lengths = {str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines()) for file in files}
    assert {name: length for name, length in lengths.items() if length > MOST_LINES} == {}


def test_public_names_of_core_and_stream_are_unique():
    defined = defaultdict(list)
    for module in MODULES:
        if module.startswith(("socast.core", "socast.stream")):
            for node in parse(module).body:
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                    defined[node.name].append(module)
    assert {name: modules for name, modules in defined.items() if len(modules) > 1} == {}


def test_every_test_folder_mirrors_a_folder_of_the_code():
    for folder in sorted((ROOT / "tests").rglob("test_*.py")):
        parts = folder.relative_to(ROOT / "tests").parent.parts
        if parts and parts[0] in {"core", "stream", "tools", "socast"}:
            assert (ROOT / Path(*parts)).is_dir(), folder


def test_page_names_every_package_and_only_files_that_exist():
    folders = {name.replace(".", "/").removeprefix("socast/") for name in ORDER}
    missing = {folder for folder in folders if (ROOT / folder).is_dir() and f"{folder}/" not in PAGE}
    assert missing == set()
    files = set(re.findall(r"`((?:[\w.]+/)*\w+\.(?:py|toml|md|json))`", PAGE))
    known = {str(path.relative_to(ROOT)) for path in ROOT.rglob("*.*") if ".venv" not in path.parts}
    unknown = {file for file in files if not any(path == file or path.endswith(f"/{file}") for path in known)}
    assert unknown == set()


def test_page_fits_one_page():
    assert len(PAGE.split()) < 1500


def test_way_of_a_sample_has_few_hops_and_none_back():
    modules = [f"socast.{file.replace('/', '.')}" for _, file in WAY]
    assert 2 < len(modules) == len(set(modules)) <= MOST_HOPS + 1
    at = modules.index("socast.core.pipeline")
    assert all(module.startswith("socast.stream.") for module in (*modules[:at], modules[-1]))
    steps = [place(module) for module in modules[at + 1 : -1]]
    assert steps == sorted(steps)
    assert max(steps) < place("socast.core.pipeline")


def test_live_sample_takes_the_way_that_the_page_lists():
    """Its functions run in the order of the page, once each; between two of them are only their known callers."""
    codes = {find_code(f"socast.{file.replace('/', '.')}", name): number for number, (name, file) in enumerate(WAY)}
    received, queued, fed, taken, *_ = codes
    hops, strangers = [], set()

    def watch(frame, event, result):
        code = frame.f_code
        if code not in codes:
            return
        if event == "return":  # these run all the time, and hold the sample when they hand it on
            if (code is received and result.messages) or (code is queued and result):
                hops.append(codes[code])
        elif event == "call" and code not in {received, queued, fed}:
            if code is taken:
                hops.append(codes[frame.f_back.f_code])
            hops.append(codes[code])
            strangers.update(list_callers(frame) - CALLERS)

    pipeline, stop = Pipeline(), threading.Event()
    pipeline.take([leaf()])
    (message,) = telemetry(drive(1))
    threading.setprofile(watch)
    try:
        with router(recovery=False) as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
            source, sinks = ZenohSource(node, stop), [LatestOnlySink(ZenohSink(node))]
            loop = threading.Thread(target=run, args=(source, pipeline, sinks), kwargs={"keep_open": True})
            loop.start()
            assert eventually(ZenohSink(client).has_subscriber)
            client.session.put(message.key, message.payload)
            assert eventually(lambda: len(hops) >= len(WAY))
            stop.set()
            loop.join(60)
    finally:
        threading.setprofile(None)
        stop.set()
    assert [WAY[hop][0] for hop in hops] == [name for name, _ in WAY]
    assert strangers == set()


def find_code(module, name):
    """Return the code of a function of a module; the names of the page exist."""
    return reduce(getattr, name.split("."), import_module(module)).__code__


def list_callers(frame):
    """Return the modules of the code that called a function, without its own module."""
    own, names = frame.f_globals["__name__"], set()
    while (frame := frame.f_back) is not None:
        names.add(frame.f_globals["__name__"])
    return {name for name in names if name.startswith("socast.")} - {own}
