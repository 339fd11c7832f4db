"""Read MCAP recordings and Parquet tables into pandas."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from socast.core import effects
from socast.core.batch import Lanes
from socast.core.errors import ModelError, RecordingError
from socast.core.forecast.forecast_table import tabulate_forecasts as _tabulate_forecasts
from socast.core.models import EXTENDED_PHYSICAL, LinearModel
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.stream.elevation_files import open_elevation
from socast.stream.loop import feed as _feed
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources

__all__ = ["Tables", "make_tables", "read_forecasts", "read_messages", "read_samples", "read_tables"]

RIDES, WINDOWS = "rides.parquet", "windows.parquet"


class Tables(NamedTuple):
    """Hold the two tables that models are fitted to and evaluated on.

    Parameters
    ----------
    rides : DataFrame
        One row per ride.
    windows : DataFrame
        One row per window of a ride, nominally 60 s.
    quality : dict
        Counters of the samples that were repaired or rejected, by cause; empty for tables read from files.
    """

    rides: pd.DataFrame
    windows: pd.DataFrame
    quality: dict[str, Any]


def read_messages(*recordings: str | Path) -> Iterator[Message]:
    """Yield the messages of MCAP recordings, merged in the order of their receipt.

    Parameters
    ----------
    *recordings : str or Path
        MCAP files. A file whose writer was killed is read as far as it is whole.

    Yields
    ------
    Message
        Key, payload as it was sent, and time of receipt. [ns]

    Raises
    ------
    RecordingError
        Where a file cannot be read.

    Examples
    --------
    >>> next(read_messages("recordings/shift.mcap")).key
    'weather/yul'
    """
    for messages in _blocks(recordings):
        yield from messages


def read_samples(*recordings: str | Path) -> pd.DataFrame:
    """Return the telemetry of recordings as it was sent, one row per sample, before any cleaning.

    Parameters
    ----------
    *recordings : str or Path
        MCAP files.

    Returns
    -------
    (n, columns) DataFrame
        `vehicle_id`, `ride_id` and the columns of the data dictionary's telemetry section, in SI units. A value that
        the car did not send is NaN.

    Raises
    ------
    RecordingError
        Where a file cannot be read, or holds no telemetry.

    Examples
    --------
    >>> samples = read_samples("recordings/shift.mcap")
    >>> bool((samples["speed"].max() > 250.0))  # a tunnel, in m/s
    True
    """
    decoder, parts = Decoder(Lanes()), []
    for messages in _blocks(recordings):
        batch, _ = decoder.decode(messages)
        parts.append(pd.DataFrame(batch._asdict()))
    samples = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
    if samples.empty:
        raise RecordingError(f"{', '.join(map(str, recordings)) or 'no recording'}: no telemetry: give recordings")
    vehicles = samples.pop("lane").map(dict(enumerate(decoder.lanes.names)))
    rides = decoder.rides.names(samples.pop("ride"))
    samples.insert(0, "vehicle_id", vehicles)
    samples.insert(1, "ride_id", rides)
    return samples


def read_forecasts(messages: Iterable[Message]) -> pd.DataFrame:
    """Return forecast messages as a table, one row per forecast.

    Parameters
    ----------
    messages : iterable of Message
        What `Pipeline.push` returned, or `read_messages` of a recording of forecasts. Other messages are passed over.

    Returns
    -------
    (n, columns) DataFrame
        All fields of a forecast message; nested fields are joined by a dot, such as `range_km.mean`. A value that is
        absent or null is NaN.

    Examples
    --------
    >>> import socast
    >>> pipeline = socast.Pipeline(socast.load_model("extended_physical"))
    >>> forecasts = read_forecasts(pipeline.push(list(read_messages("recordings/shift.mcap"))))
    >>> "ride_energy_predicted_kwh" in forecasts
    True
    """
    return _tabulate_forecasts(messages)


def make_tables(
    *recordings: str | Path,
    model: LinearModel = EXTENDED_PHYSICAL,
    settings: Settings | None = None,
    also: Sequence[str] | None = None,
    elevation: Sequence[str | Path] = (),
) -> Tables:
    """Clean recordings and return their ride table and window table.

    Parameters
    ----------
    *recordings : str or Path
        MCAP files, merged in the order of receipt.
    model : LinearModel
        A model whose effects the tables must hold.
    settings : Settings, optional
        Thresholds of the cleaning.
    also : sequence of str, optional
        Names of further effects; by default every effect of the library with its variants.
    elevation : sequence of str or Path
        Maps that correct the elevation of fixes: SRTM tiles, GeoTIFF, or maps of `socast elevation learn`.

    Raises
    ------
    RecordingError
        Where a file cannot be read.
    SettingsError
        Where a map cannot be read.
    EffectError
        Where an effect is unknown.

    Examples
    --------
    >>> tables = make_tables("recordings/shift.mcap")
    >>> set(tables.windows["ride_key"]) <= set(tables.rides["ride_key"])
    True
    """
    wanted = effects.list_tabulated() if also is None else list(also)
    elevation_map = open_elevation([Path(file) for file in elevation])
    pipeline = Pipeline(
        model,
        settings or Settings(),
        also=wanted,
        keep_forecasts=False,
        two_sided=True,
        elevation_map=elevation_map,
    )
    for _ in _feed(_blocks(recordings), pipeline):
        pass
    return Tables(pipeline.take_rides(), pipeline.take_windows(), pipeline.quality())


def read_tables(*folders: str | Path) -> Tables:
    """Return the tables that `socast tables` wrote.

    Parameters
    ----------
    *folders : str or Path
        Folders that hold `rides.parquet` and `windows.parquet`. The ride keys of several folders get the folder's
        position as prefix, so that they stay distinct.

    Raises
    ------
    ModelError
        Where a file is missing or is no Parquet table.
    """
    rides: list[pd.DataFrame] = []
    windows: list[pd.DataFrame] = []
    for place, folder in enumerate(map(Path, folders)):
        prefix = f"{place}/" if len(folders) > 1 else ""
        for name, tables in ((RIDES, rides), (WINDOWS, windows)):
            try:
                table = pd.read_parquet(folder / name)
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or " ".join(str(error).split())
                raise ModelError(
                    f"{folder / name}: cannot read a table: {reason}; name a folder that `socast tables` made"
                ) from error
            tables.append(table.assign(ride_key=prefix + table["ride_key"].astype(str)))
    if not rides:
        raise ModelError("no folder of tables is given: name folders that `socast tables` made")
    return Tables(pd.concat(rides, ignore_index=True), pd.concat(windows, ignore_index=True), {})


def _blocks(recordings: Sequence[str | Path]) -> Iterator[Sequence[Message]]:
    """Yield messages in the order of their receipt."""
    return merge_sources([McapSource(path) for path in recordings])
