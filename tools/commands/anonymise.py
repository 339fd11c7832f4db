"""`socast anonymise`: hide the names, places and dates of recordings, so that they can be shared."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random, SystemRandom
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np
import typer

from socast.core.files import UNREADABLE
from socast.core.formatting import format_count
from socast.core.wire.arrow_batch import PREFIX
from socast.core.wire.messages import Message, Weather, address
from socast.core.wire.sample_reader import SampleColumns, holds_samples, is_possible_fix, read_samples
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import replace_recording
from socast.stream.recording_metadata import make_metadata
from socast.stream.source import merge_sources
from socast.tools.anonymise.disguise import find_centre, keeps_days, make_disguise
from socast.tools.anonymise.message_rewriter import MessageRewriter
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, print_plain, refuse_existing, write_json
from socast.tools.terminal.recordings import Recordings, open_recordings, refuse_unusable, show_progress, warn_of_losses

HOUR_NS: Final = 3_600_000_000_000
"""An hour. [ns]"""
OLDEST_S: Final = 86400.0
"""Age at receipt up to which the time of a sample in a batch tells when a car sends. [s]"""
EVERY: Final = 10
"""One of so many samples of a car is read to find the centre of the area."""
MOST_PLACES: Final = 1 << 18
"""Largest number of positions that are kept to find the centre."""
REMAINS: Final = (
    "What remains can identify a person: times of day and distances of rides, odometers, elevations, the latitude, the "
    "shape of the streets, the weather, and a rare vehicle model or the figures of a vehicle message. Who knows a ride "
    "can find it again, and who compares streets or weather with public maps and archives can find the place and the "
    "date."
)
"""What the summary says at its end."""

DAYS_DIFFER: Final = (
    "days differ: cars send at all hours, and midnight UTC comes at another time of their day, so what is learned day "
    "by day (usable_capacity and energy_soc of tables, and forecasts) differs slightly"
)
"""What the summary says where no shift keeps the days."""


_decode_weather: Final = msgspec.json.Decoder(Weather).decode


class Extent(NamedTuple):
    """Hold times and place of recordings.

    Parameters
    ----------
    begin_s, end_s : float
        First and last time of receipt. [Unix s]
    centre : tuple of (float, float) or None
        Latitude and longitude of the centre of the positions, None if there are none. [deg]
    busy : list of bool
        Whether samples were received in each of the 24 hours of the day, UTC, or were in batches and have such a time.
    """

    begin_s: float
    end_s: float
    centre: tuple[float, float] | None
    busy: list[bool]


def anonymise(
    recordings: Recordings,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="F.mcap", help="Recording to write.")],
    json_file: JsonFile = None,
) -> None:
    """Hide names, places and dates of recordings, merged in time order, so that they can be shared.

    Names of cars, gateways, rides, drivers and stations are hashed with a random salt that is thrown away. One random
    rotation of the Earth moves and turns all positions, and wind directions turn alike. All times are shifted alike by
    whole weeks and hours, so that the sun and the season stay. Only fields of the wire contract pass.

    Distances, climbs, headwinds and energies stay: tables of the result are those of the original but for names, places
    and dates. The summary says what can still identify. An existing F.mcap is not overwritten.

    Examples
    --------
    socast anonymise kept/shift.mcap -o shared.mcap
    socast anonymise kept/*.mcap -o shared.mcap --json -
    """
    sources = open_recordings(recordings)
    check_outputs(recordings, out, json_file)
    refuse_existing(out)
    report = rewrite_recordings(sources, out, SystemRandom())
    write_json(json_file, "anonymise", report)
    console = make_console(json_file)
    print_plain(console, *describe(report, out))
    warn_of_losses(sources)


def rewrite_recordings(sources: Sequence[McapSource], out: Path, random: Random) -> dict[str, Any]:
    """Write recordings in a random disguise, and return what was changed and dropped.

    Returns
    -------
    dict
        `kept` and `dropped` (numbers of messages by kind and by cause), `names` (numbers of names by kind), `positions`
        (number), `days_stay` (whether samples of the same day, UTC, are of the same day again) and `remains` (what can
        still identify).
    """
    extent = find_extent(sources)
    disguise = make_disguise(random, *extent)
    rewriter = MessageRewriter(disguise)
    about = make_metadata("anonymise")
    with show_progress(sources, words="writing") as step, replace_recording(out, metadata=about) as sink:
        for messages in merge_sources(sources):
            sink.put([rewritten for each in messages if (rewritten := rewriter.rewrite(each)) is not None])
            step()
        refuse_unusable(sources, rewriter.kept.total())
    rewriter.dropped["of another contract"] = sum(source.losses.foreign.total() for source in sources)
    rewriter.dropped["for viewers"] = sum(source.viewer_messages.total() for source in sources)
    return {
        "kept": dict(rewriter.kept),
        "dropped": {cause: count for cause, count in rewriter.dropped.items() if count},
        "names": {kind: len(names) for kind, names in rewriter.names.items()},
        "positions": rewriter.positions,
        "days_stay": keeps_days(disguise.shift_s // 3600 % 24, extent.busy),
        "remains": REMAINS,
    }


def find_extent(sources: Sequence[McapSource]) -> Extent:
    """Return the times of recordings and the centre of their cars, or of their stations where no car has a position."""
    spans = [span for source in sources if (span := source.span_ns)]
    begin, end = (min(span[0] for span in spans), max(span[1] for span in spans)) if spans else (0, 0)
    cars: list[tuple[float, float]] = []
    stations: list[tuple[float, float]] = []
    hours: set[int] = set()
    with show_progress(sources, words="reading") as step:
        for source in sources:
            for messages in source:
                samples = [each for each in messages if holds_samples(each)]
                hours |= {each.receipt_ns // HOUR_NS % 24 for each in samples}
                for columns in _read_some(samples, hours):
                    is_fix = columns.find_fixes()
                    cars += zip(columns.latitude[is_fix].tolist(), columns.longitude[is_fix].tolist(), strict=True)
                stations += _read_stations(messages)
                for places in (cars, stations):
                    if len(places) > MOST_PLACES:
                        del places[::2]
                step()
    centre = find_centre(*np.array(cars or stations).T) if cars or stations else None
    return Extent(begin * 1e-9, end * 1e-9, centre, [hour in hours for hour in range(24)])


def describe(report: dict[str, Any], out: Path) -> list[str]:
    """Return the lines of the summary."""
    names = ", ".join(format_count(count, kind) for kind, count in report["names"].items() if count)
    dropped = ", ".join(f"{count:,} {cause}" for cause, count in report["dropped"].items())
    return [
        f"{out}: {format_count(sum(report['kept'].values()), 'message')}",
        f"changed: names of {names or 'nobody'}; {report['positions']:,} positions; all times",
        f"dropped: {dropped or 'no message'}; key prefixes, fields outside the contract, file metadata",
        *([] if report["days_stay"] else [DAYS_DIFFER]),
        report["remains"],
    ]


def _read_some(messages: Sequence[Message], hours: set[int]) -> Iterator[SampleColumns]:
    """Yield some samples of messages that hold samples; add the hours of all samples in batches."""
    single = [each for each in messages if not each.payload.startswith(PREFIX)]
    for samples in read_samples(single[::EVERY], Counter()):
        yield samples.columns
    batches = [each for each in messages if each.payload.startswith(PREFIX)]
    receipt_s = np.array([each.receipt_ns * 1e-9 for each in batches])
    for _, numbers, columns in read_samples(batches, Counter()):
        age_s = receipt_s[list(numbers)] - columns.time
        hours |= set(np.unique(columns.time[np.abs(age_s) <= OLDEST_S] // 3600.0 % 24.0).astype(int).tolist())
        yield SampleColumns(*(column[::EVERY] for column in columns))


def _read_stations(messages: Sequence[Message]) -> list[tuple[float, float]]:
    """Return some positions of weather stations."""
    found: list[tuple[float, float]] = []
    for message in [each for each in messages if (known := address(each.key)) and known.kind == "weather"][::EVERY]:
        try:
            value = _decode_weather(message.payload)
        except UNREADABLE:
            continue
        found.append((value.latitude_deg, value.longitude_deg))
    return [place for place in found if is_possible_fix(*np.array(place))]
