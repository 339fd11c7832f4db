"""What the fixtures of pytest do: replay recordings, write samples, and compare forecasts."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, Final

import msgspec
import pandas as pd
from rich.console import Console

from socast.core import models
from socast.core.errors import SettingsError
from socast.core.files import replacing
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message, Telemetry, encode
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.source import merge_sources
from socast.tools.testing.forecast_differences import compare_recordings, list_fields, show_comparison

WIDTH: Final = 120
"""Width of a difference in the output of pytest. [characters]"""


def replay_recordings(
    recordings: Sequence[str | Path], model: str | Path, out: Path
) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Any], Path]:
    """Replay recordings through a model.

    Parameters
    ----------
    recordings : sequence of str or Path
        Recordings, or folders that hold some, merged in the order of time.
    model : str or Path
        Name or file of a model.
    out : Path
        Receives the forecasts.

    Returns
    -------
    forecasts, rides : DataFrame
    quality : dict
    file : Path
        `out`.

    Raises
    ------
    SettingsError
        There is no recording.
    """
    files = [
        file for path in map(Path, recordings) for file in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])
    ]
    if not files:
        raise SettingsError(f"{', '.join(map(str, recordings)) or 'nothing'}: no recording to replay; give MCAP files")
    pipeline = Pipeline(models.load(str(model)))
    payloads: list[dict[str, Any]] = []
    with McapSink(out) as sink:
        for messages in merge_sources([McapSource(file) for file in files]):
            payloads += _record(sink, pipeline.push(messages))
        payloads += _record(sink, pipeline.finish())
    return pd.DataFrame(payloads), pipeline.take_rides(), pipeline.quality(), out


def write_samples(samples: Iterable[Mapping[str, Any]], path: Path) -> Path:
    """Write samples as a recording, and return its path.

    Raises
    ------
    SettingsError
        A sample has a field that the wire contract does not have, or a value of another kind.
    """
    with McapSink(path) as sink:
        for number, sample in enumerate(samples, start=1):
            try:
                telemetry = msgspec.convert(dict(sample), Telemetry)
            except msgspec.ValidationError as error:
                raise SettingsError(f"sample {number}: {error}") from None
            if unknown := sorted(sample.keys() - set(Telemetry.__struct_fields__)):
                raise SettingsError(f"sample {number}: telemetry has no field {unknown[0]!r}")
            receipt = round(telemetry.time_s * 1e9)
            sink.put([Message(f"fleet/{telemetry.vehicle_id}/telemetry", encode(telemetry), receipt)])
    return path


def check_forecasts(expected: Path, found: Path, tolerances: Mapping[str, float] | None, *, update: bool) -> str:
    """Return how the forecasts in a recording differ from expected ones, empty where they agree.

    Parameters
    ----------
    expected, found : Path
        Recordings that hold forecasts.
    tolerances : mapping of str to float, optional
        See `socast.tools.testing.forecast_differences.compare_recordings`.
    update : bool
        Whether to write the expected ones anew.
    """
    if update:
        with replacing(expected) as fresh:
            shutil.copyfile(found, fresh)
        return ""
    if not expected.is_file():
        return f"{expected}: does not exist; write it with pytest --socast-update"
    comparison = compare_recordings(expected, found, tolerances)
    if comparison.is_equal:
        return ""
    text = StringIO()
    show_comparison(comparison, Console(file=text, width=WIDTH))
    return f"{text.getvalue()}\nIf this is meant to be, write {expected} with pytest --socast-update."


def _record(sink: McapSink, messages: Sequence[Message]) -> list[dict[str, Any]]:
    """Record the forecasts among messages, and return their fields."""
    forecasts = [message for message in messages if message.key.endswith("/forecast")]
    sink.put(forecasts)
    return [dict(list_fields(msgspec.json.decode(message.payload))) for message in forecasts]
