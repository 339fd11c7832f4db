"""Tables made in one run over the messages, and by the stages of a cluster, to be compared to the bit."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from socast.core import effects
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Message
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.job import Job
from socast.tools.cluster.runner import InProcessRunner, Runner
from socast.tools.cluster.tables import make_tables
from socast.tools.commands.tables import COUNTED_BY_NAME
from socast.tools.terminal.ride_source import tabulate
from socast.tools.terminal.table_files import read
from tests.support.mcap_recordings import BEGIN, SECOND, write_recording

Tables = tuple[pd.DataFrame, pd.DataFrame, dict[str, Any], list[list[str]]]


def make_whole(paths: Sequence[Path]) -> Tables:
    """Return the tables, counters and losses of a serial run."""
    pipeline = Pipeline(also=effects.list_tabulated(), keep_forecasts=False, two_sided=True)
    sources, parts = [McapSource(path) for path in paths], []
    tabulate(sources, pipeline, lambda rides, windows: parts.append((rides, windows)), [].append)
    rides, windows = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    return rides, windows, pipeline.quality(), [source.losses.lines() for source in sources]


def make_job(paths: Sequence[Path], folder: Path, parts: int, settings: Settings = Settings()) -> Job:  # noqa: B008
    """Return the description of a run whose files are in a folder."""
    folder.mkdir(exist_ok=True)
    return Job(tuple(paths), folder, parts, EXTENDED_PHYSICAL.name, tuple(effects.list_tabulated()), settings)


def make_parts(
    paths: Sequence[Path], folder: Path, parts: int, span_bytes: int, runner: Runner | None = None
) -> Tables:
    """Return the tables, counters and losses of a run by stages."""
    sources = [McapSource(path) for path in paths]
    job = make_job(paths, folder, parts)
    made = make_tables(job, sources, folder, runner or InProcessRunner(), span_bytes=span_bytes)
    rides, windows = (read([folder / f"{name}.parquet"]) for name in ("rides", "windows"))
    assert (len(rides), len(windows)) == (made.rides, made.windows)
    return rides, windows, made.quality, [source.losses.lines() for source in sources]


def assert_same(one: Tables, other: Tables) -> None:
    """Assert that tables, counters and losses are equal to the bit."""
    for mine, theirs in zip(one[:2], other[:2], strict=True):
        assert list(mine.columns) == list(theirs.columns)
        pd.testing.assert_frame_equal(mine, theirs, check_exact=True)
        for name in mine.select_dtypes("number"):
            assert get_bytes(mine[name]) == get_bytes(theirs[name]), name
    assert {**one[2], **sort_counters(one[2])} == {**other[2], **sort_counters(other[2])}
    assert one[3] == other[3]


def get_bytes(column: "pd.Series[float]") -> bytes:
    """Return the bytes of numbers as a Parquet file holds them: without the sign of unknown values."""
    values = column.to_numpy()
    return values[~pd.isna(values)].tobytes()


def sort_counters(quality: dict[str, Any]) -> dict[str, Any]:
    """Return the counters by name without zeros, in the order of names."""
    return {name: {key: n for key, n in sorted(quality[name].items()) if n} for name in COUNTED_BY_NAME}


def receive(messages: Sequence[Message], every_s: float = 0.5) -> list[Message]:
    """Return messages with times of receipt in their order; some are equal."""
    return [message._replace(receipt_ns=BEGIN + int(i // 3 * every_s * SECOND)) for i, message in enumerate(messages)]


def record(folder: Path, *recordings: Sequence[Message]) -> list[Path]:
    """Write recordings and return their paths."""
    return [write_recording(folder / f"{i}.mcap", list(messages), 3000) for i, messages in enumerate(recordings)]
