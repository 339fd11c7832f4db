"""Write a recording with a known effect in it, and the truth beside it."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from socast.core.errors import SettingsError
from socast.core.files import write_whole
from socast.core.wire.messages import Message, encode
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import replace_recording
from socast.stream.recording_metadata import make_metadata
from socast.stream.source import merge_sources
from socast.tools.spikein.car_readings import FleetReader, FleetReadings
from socast.tools.spikein.made_weather import make_weather
from socast.tools.spikein.payload_changes import change_payload
from socast.tools.spikein.records import SpikeTruth
from socast.tools.spikein.spike import Spike, make_spikes
from socast.tools.terminal.recordings import show_progress

NEEDS_WEATHER: Final = frozenset({"headwind", "wet_road", "snow", "humidity", "solar_load", "roof_load~other"})
"""Effects that nothing can name without observations of a station."""


def read_fleet(sources: Sequence[McapSource]) -> FleetReadings:
    """Return the samples of recordings."""
    reader = FleetReader()
    with show_progress(sources, words="reading") as step:
        for messages in merge_sources(sources):
            reader.take(messages)
            step()
    fleet = reader.finish()
    if not fleet.cars:
        raise SettingsError(f"{sources[0].path}: no samples of telemetry; give a recording of cars")
    return fleet


def write_spiked(sources: Sequence[McapSource], spike: Spike, out: Path) -> SpikeTruth:
    """Write recordings with an effect in them, and its truth; return the truth.

    The truth is also written to `<out>.truth.json`. Where the effect needs weather and no station is in the
    recordings, a made-up one is added.
    """
    fleet = read_fleet(sources)
    is_made = spike.effect.partition("~")[0] in NEEDS_WEATHER and not fleet.weather
    if is_made:
        fleet = fleet._replace(weather=make_weather(fleet.cars, spike.seed))
    spikes, factor = make_spikes(fleet, spike)
    changes: dict[int, dict[int, tuple[str, float]]] = defaultdict(dict)
    for each in spikes:
        for at in np.flatnonzero(each.added):
            message, place = int(each.readings.message[at]), int(each.readings.place[at])
            changes[message][place] = each.field, float(each.added[at])
    weather = [
        Message(f"weather/{each.station_id}", encode(each), round(each.time_s * 1e9))
        for each in (fleet.weather if is_made else [])
    ]
    _copy(sources, changes, weather, out)
    truth = SpikeTruth(
        effect=spike.effect,
        size=spike.size,
        vehicles=spike.vehicles,
        since_s=spike.since_s,
        seed=spike.seed,
        factor=factor,
        made_weather=is_made,
        fields={each.readings.vehicle_id: each.field for each in spikes},
        samples=sum(len(places) for places in changes.values()),
        drives=[drive for each in spikes for drive in each.drives],
    )
    text = msgspec.json.format(msgspec.json.encode(truth.to_json()), indent=1)
    write_whole(out.with_name(f"{out.name}.truth.json"), text)
    return truth


def _copy(
    sources: Sequence[McapSource],
    changes: dict[int, dict[int, tuple[str, float]]],
    weather: list[Message],
    out: Path,
) -> None:
    """Write the messages of recordings, some of them changed, and observations between them."""
    number, due = 0, 0
    again = [McapSource(source.path) for source in sources]
    about = make_metadata("spikein")
    with show_progress(again, words="writing") as step, replace_recording(out, metadata=about) as sink:
        for messages in merge_sources(again):
            written: list[Message] = []
            for message in messages:
                while due < len(weather) and weather[due].receipt_ns <= message.receipt_ns:
                    written.append(weather[due])
                    due += 1
                written.append(_change(message, changes.get(number)))
                number += 1
            sink.put(written)
            step()
        sink.put(weather[due:])


def _change(message: Message, places: dict[int, tuple[str, float]] | None) -> Message:
    """Return a message with the changes of its samples."""
    if places is None:
        return message
    payload = message.payload
    for name in {name for name, _ in places.values()}:
        payload = change_payload(payload, name, {at: value for at, (field, value) in places.items() if field == name})
    return message._replace(payload=payload)
