"""Declare the truth of a recording with a known effect in it."""

from typing import Annotated

from socast.core.records import Record, declare


class SpikedDrive(Record, frozen=True):
    """Hold a drive with the effect."""

    vehicle_id: str
    begin_s: Annotated[float, declare("Time of its first sample. [Unix s]")]
    end_s: Annotated[float, declare("Time of its last sample. [Unix s]")]
    energy_kwh: Annotated[float, declare("Energy of the effect. [kWh]")]


class SpikeTruth(Record, frozen=True):
    """Hold what was put into a recording."""

    effect: str
    size: Annotated[float, declare("Energy of the effect over that of the cars and times that have it. [1]")]
    vehicles: Annotated[tuple[str, ...], declare("Cars that have it; empty for all.")]
    since_s: Annotated[float | None, declare("Time from which they have it; null for always. [Unix s]")]
    seed: int
    factor: Annotated[float, declare("Factor of the natural size of the effect. [1]")]
    made_weather: Annotated[bool, declare("Whether a made-up weather station was added.")]
    fields: Annotated[dict[str, str], declare("Car -> field of telemetry that was changed.")]
    samples: Annotated[int, declare("Number of samples that were changed.")]
    drives: list[SpikedDrive]
