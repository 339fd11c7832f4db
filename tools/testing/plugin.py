"""Fixtures of pytest for tests with recordings, found by pytest where `socast` is installed.

Nothing is imported before a fixture is used, so that other tests start as fast as before.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from glob import glob
from os.path import relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import pandas as pd

    from socast.core.wire.messages import Message
    from socast.tools.testing.golden_files import Checked
    from socast.tools.testing.live_consumer import LiveConsumer
    from socast.tools.testing.replayed import Replayed

FIXTURE = "socast_recording"
"""Argument of a test that runs once for each recording of the project."""
RECORDINGS = "socast_recordings"
"""Setting, and marker of a test, with the patterns of these recordings."""
UPDATED = "socast_updated"
"""Property of a test that says what it has written."""
MODEL = "extended_physical"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes golden files, and the setting that names the recordings."""
    group = parser.getgroup("socast", "tests with recordings of socast")
    group.addoption(
        "--socast-update", action="store_true", help="write the golden files of socast_expect and socast_golden anew"
    )
    parser.addini(RECORDINGS, "recordings of socast_recording, as patterns", type="args", default=["recordings/*.mcap"])


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker."""
    config.addinivalue_line("markers", f"{RECORDINGS}(*patterns): recordings with which {FIXTURE} runs this test")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with the argument `socast_recording` once for each recording of the project."""
    if FIXTURE not in metafunc.fixturenames:
        return
    mark, root = metafunc.definition.get_closest_marker(RECORDINGS), metafunc.config.rootpath
    patterns = [str(each) for each in (mark.args if mark else metafunc.config.getini(RECORDINGS))]
    found = [each for pattern in patterns for each in glob(pattern, root_dir=root, recursive=True)]  # noqa: PTH207
    files = sorted({root / each for each in found})
    if not files:
        where = f"the marker {RECORDINGS}" if mark else f"{RECORDINGS} in the settings of pytest"
        pytest.fail(
            f"{metafunc.function.__name__}: no recording matches {', '.join(patterns)} in {root}; put recordings "
            f"there, or change {where}",
            pytrace=False,
        )
    stems = [file.stem for file in files]
    names = stems if len({*stems}) == len(stems) else [relpath(file, root) for file in files]
    metafunc.parametrize(FIXTURE, files, ids=names)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what golden files were written, and what this has changed."""
    reports = [report for group in terminalreporter.stats.values() for report in group]
    written = [
        str(text) for report in reports for name, text in getattr(report, "user_properties", ()) if name == UPDATED
    ]
    if written:
        terminalreporter.section("golden files of socast")
        for text in dict.fromkeys(written):
            terminalreporter.write_line(text)


@pytest.fixture
def socast_recording() -> Path:
    """Return a recording of the project; the test runs once for each, see the setting `socast_recordings`."""
    raise pytest.UsageError("socast_recording is an argument of tests; a fixture cannot take it")


@pytest.fixture
def _socast_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder for the files of this test; `tmp_path` belongs to the test, which may replay it as a whole."""
    return tmp_path_factory.mktemp("socast")


@pytest.fixture
def socast_replay(_socast_folder: Path) -> "Callable[..., Replayed]":
    """Return a function that replays recordings through a model.

    It takes a recording, a folder or several of them, and `model`, the name or file of a model, and returns the tables
    `forecasts`, `rides` and `quality`, `file`, the recording of the forecasts, and `losses`, what was damaged.
    `warm_up`, `effects`, `vehicles` and `elevation` take the files of these options of `socast replay`, and `settings`
    a mapping of the settings of cleaning.
    """

    def replay(*recordings: str | Path, model: str | Path = MODEL, **options: Any) -> "Replayed":
        __tracebackhide__ = True
        from socast.tools.testing.replayed import make_options, replay_recordings  # noqa: PLC0415 - imports everything

        with _plain_errors():
            made = make_options(model, **options)
            replayed = replay_recordings(recordings, made, _name_file(_socast_folder / "replayed"))
        for line in replayed.losses:
            warnings.warn(line, stacklevel=2)
        return replayed

    return replay


@pytest.fixture
def socast_car() -> "Callable[..., list[Message]]":
    """Return the function that makes the messages of a car, see `socast.tools.testing.made_recording.make_car`."""

    def make(*arguments: Any, **options: Any) -> "list[Message]":
        __tracebackhide__ = True
        from socast.tools.testing.made_recording import make_car  # noqa: PLC0415 - it imports everything

        with _plain_errors():
            return make_car(*arguments, **options)

    return make


@pytest.fixture
def socast_make_recording(_socast_folder: Path) -> Callable[..., Path]:
    """Return a function that writes a recording and returns the file.

    It takes the messages of cars that `socast_car` makes, or lists of samples, mappings with the fields of the
    telemetry of the wire contract such as `vehicle_id`, `time_s` and `speed_kmh`.
    """

    def write(*parts: "Iterable[Message | Mapping[str, Any]]", name: str = "") -> Path:
        __tracebackhide__ = True
        from socast.tools.testing.made_recording import (  # noqa: PLC0415 - it imports everything
            gather_messages,
            write_recording,
        )

        with _plain_errors():
            return write_recording(gather_messages(*parts), _name_file(_socast_folder / "made", name))

    return write


@pytest.fixture
def socast_expect(
    request: pytest.FixtureRequest, socast_replay: "Callable[..., Replayed]"
) -> "Callable[..., Replayed]":
    """Return a function that replays a recording and fails where its forecasts are not those of a file.

    It takes the recording or several, the file, `tolerances`, and the options of `socast_replay`, and returns what that
    does. With `--socast-update`, it writes the file.
    """

    def expect(
        recording: str | Path | Sequence[str | Path],
        expected: str | Path,
        *,
        model: str | Path = MODEL,
        tolerances: Mapping[str, float | str] | None = None,
        **options: Any,
    ) -> "Replayed":
        __tracebackhide__ = True
        from socast.tools.testing.golden_files import check_forecasts, refuse_mistakes  # noqa: PLC0415 - imports everything

        recordings = [recording] if isinstance(recording, str | Path) else recording
        with _plain_errors():
            refuse_mistakes(Path(expected), recordings, tolerances, update=_updates(request))
        replayed = socast_replay(*recordings, model=model, **options)
        with _plain_errors():
            checked = check_forecasts(Path(expected), replayed.file, tolerances, update=_updates(request))
        _report(request, checked, replayed.losses)
        return replayed

    return expect


@pytest.fixture
def socast_golden(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Return a function that fails where a table is not that of a file.

    It takes the `DataFrame`, the file, whose name ends with `.csv` or `.parquet`, `key`, the columns that name a row,
    and `tolerances`. With `--socast-update`, it writes the file.
    """

    def check(
        table: "pd.DataFrame",
        expected: str | Path,
        *,
        key: Sequence[str] = (),
        tolerances: Mapping[str, float | str] | None = None,
    ) -> None:
        __tracebackhide__ = True
        from socast.tools.testing.golden_files import check_table  # noqa: PLC0415 - it imports everything

        with _plain_errors():
            checked = check_table(Path(expected), table, key=key, tolerances=tolerances, update=_updates(request))
        _report(request, checked)

    return check


@pytest.fixture
def socast_live(_socast_folder: Path) -> "Iterator[Callable[..., LiveConsumer]]":
    """Return a function that starts a live consumer on loopback, which ends with the test.

    It takes `model`, the name or file of a model. What is published to the consumer with `publish` gives the tables of
    `results`, and after its end those of `finish`.
    """
    with ExitStack() as ending:

        def start(*, model: str | Path = MODEL) -> "LiveConsumer":
            from socast.tools.testing.live_consumer import LiveConsumer  # noqa: PLC0415 - it imports everything

            with _plain_errors():
                return ending.enter_context(LiveConsumer(model, _name_file(_socast_folder / "live")))

        yield start


def _name_file(folder: Path, name: str = "") -> Path:
    """Return a recording in a folder, by default with a number that none of the folder has."""
    folder.mkdir(exist_ok=True)
    file = folder / (name or f"{len(list(folder.iterdir()))}.mcap")
    file.touch()
    return file


def _updates(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--socast-update"))


@contextmanager
def _plain_errors() -> Iterator[None]:
    """Fail with the one line of an error of the product, without a traceback through its source."""
    from socast.core.errors import SocastError  # noqa: PLC0415 - other tests load nothing of the product

    try:
        yield
    except SocastError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None


def _report(request: pytest.FixtureRequest, checked: "Checked", losses: Sequence[str] = ()) -> None:
    """Fail with what differs, and keep what was written for the summary."""
    __tracebackhide__ = True
    damaged = [f"the recording is damaged: {line}" for line in losses]
    if checked.written:
        request.node.user_properties.append((UPDATED, "\n".join([checked.written, *damaged])))
    if checked.difference:
        pytest.fail("\n".join([*damaged, checked.difference]), pytrace=False)
