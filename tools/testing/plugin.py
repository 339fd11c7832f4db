"""Fixtures of pytest for tests with recordings, found by pytest where `socast` is installed.

Nothing is imported before a fixture is used, so that other tests start as fast as before.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

if TYPE_CHECKING:
    import pandas as pd

RECORDING = "socast_recording"
"""Argument of a test that runs once for each recording of the project."""


class Replayed(NamedTuple):
    """Hold what a replay gave.

    Parameters
    ----------
    forecasts : DataFrame
        One row per forecast with the fields of the payload; those of an object have its name before them, such as
        `range_km.mean`.
    rides : DataFrame
        The ride table.
    quality : dict
        Counters of the samples that were repaired or rejected, by cause, and of messages.
    file : Path
        Recording of the forecasts.
    """

    forecasts: "pd.DataFrame"
    rides: "pd.DataFrame"
    quality: dict[str, Any]
    file: Path


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes expectations, and the setting that names the recordings."""
    group = parser.getgroup("socast", "tests with recordings of socast")
    group.addoption("--socast-update", action="store_true", help="write the forecasts that tests expect anew")
    parser.addini("socast_recordings", "recordings of the project, as a pattern", default="recordings/*.mcap")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with the argument `socast_recording` once for each recording of the project."""
    if RECORDING not in metafunc.fixturenames:
        return
    root, pattern = metafunc.config.rootpath, str(metafunc.config.getini("socast_recordings"))
    files = sorted(root.glob(pattern))
    metafunc.parametrize(RECORDING, files, ids=[file.relative_to(root).as_posix() for file in files])


@pytest.fixture
def socast_replay(tmp_path: Path) -> Callable[..., Replayed]:
    """Return a function that replays recordings through a model.

    It takes a recording, a folder or several of them, and `model`, the name or file of a model, and returns `Replayed`.
    """
    from socast.tools.testing.replayed import replay_recordings  # noqa: PLC0415 - it imports everything

    def replay(*recordings: str | Path, model: str | Path = "extended_physical") -> Replayed:
        number = len(list(tmp_path.glob("forecasts-*.mcap")))
        return Replayed(*replay_recordings(recordings, model, tmp_path / f"forecasts-{number}.mcap"))

    return replay


@pytest.fixture
def socast_make_recording(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a recording of samples.

    It takes samples, mappings with the fields of the telemetry of the wire contract such as `vehicle_id`, `time_s` and
    `speed_kmh`, in the order of their time, and returns the file.
    """
    from socast.tools.testing.replayed import write_samples  # noqa: PLC0415 - it imports everything

    def write(samples: Iterable[Mapping[str, Any]], name: str = "made.mcap") -> Path:
        return write_samples(samples, tmp_path / name)

    return write


@pytest.fixture
def socast_expect(request: pytest.FixtureRequest, socast_replay: Callable[..., Replayed]) -> Callable[..., Replayed]:
    """Return a function that replays a recording and fails where its forecasts are not those of a file.

    It takes the recording, the file, `model` and `tolerances`, the largest difference of a field by its name. With
    `--socast-update`, it writes the file.
    """
    from socast.tools.testing.replayed import check_forecasts  # noqa: PLC0415 - it imports everything

    def expect(
        recording: str | Path | Sequence[str | Path],
        expected: str | Path,
        *,
        model: str | Path = "extended_physical",
        tolerances: Mapping[str, float] | None = None,
    ) -> Replayed:
        __tracebackhide__ = True
        recordings = [recording] if isinstance(recording, str | Path) else recording
        replayed = socast_replay(*recordings, model=model)
        update = bool(request.config.getoption("--socast-update"))
        if difference := check_forecasts(Path(expected), replayed.file, tolerances, update=update):
            pytest.fail(difference, pytrace=False)
        return replayed

    return expect
