"""Recordings of a few lines: cars whose values follow a profile, with faults of their loggers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeAlias

import msgspec
import numpy as np

from socast.core.errors import SettingsError, suggest_names
from socast.core.wire.messages import Message, Telemetry, Vehicle, encode
from socast.stream.mcap_writer import replace_recording
from socast.tools.simulator.logger import SPIKES

START_S: Final = 1_705_320_000.0
"""Time of the first sample by default, 2024-01-15 12:00 UTC. [Unix s]"""
LATE_S: Final = 60.0
"""Time after which late samples arrive, from the end of their span. [s]"""
CLOCK_S: Final = 3600.0
"""Time by which a wrong clock is ahead. [s]"""
WHOLE: Final = ("lost", "repeated", "late", "clock_ahead", "not_json")
"""Faults of samples."""
OF_FIELD: Final = ("missing", "frozen", "spike")
"""Faults of one field, whose name follows, such as `missing_soc_pct`."""

Profile: TypeAlias = float | Sequence[tuple[float, float]] | Callable[[float], float]
"""A value, points (time since the start [s], value) between which values are interpolated, or a function of time."""
Span: TypeAlias = tuple[float, float]
Sample: TypeAlias = dict[str, Any]


def make_car(
    vehicle: str = "taxi-1",
    *,
    duration_s: float | None = None,
    period_s: float = 3.0,
    start_s: float = START_S,
    ride_id: str | None = "ride-1",
    vehicle_model: str | None = "kia-soul-ev-2015",
    faults: Mapping[str, Span] | None = None,
    **profiles: Profile,
) -> list[Message]:
    """Return the messages of a car whose values follow profiles.

    Parameters
    ----------
    duration_s : float, optional
        Time from the first sample to the last; by default the last time of the profiles, or 600 s. [s]
    vehicle_model : str, optional
        Key of the catalogue, which a `vehicle` message announces; without it the model of the car is unknown.
    faults : mapping of str to tuple, optional
        Fault, one of `WHOLE` or one of `OF_FIELD` with a field, -> its begin and its end after the start. [s]
    **profiles : Profile
        Fields of the telemetry, such as `speed_kmh` or `soc_pct`. By default the car drives at 36 km/h and 80 %.
    """
    given: dict[str, Profile] = {"speed_kmh": 36.0, "soc_pct": 80.0, **profiles}
    fields = [name for name in Telemetry.__struct_fields__ if name not in ("vehicle_id", "time_s", "ride_id", "seq")]
    if unknown := [name for name in given if name not in fields]:
        raise SettingsError(f"{unknown[0]!r} is no field of the telemetry; {suggest_names(unknown[0], fields)}")
    ends = [float(each[-1][0]) for each in given.values() if isinstance(each, Sequence)]
    last_s = duration_s if duration_s is not None else max(ends, default=600.0)
    if not (period_s > 0.0 and last_s >= 0.0):
        raise SettingsError(f"duration_s={last_s:g}, period_s={period_s:g}: give 0 or more, and more than 0")
    ages = np.arange(0.0, last_s + 1e-6, period_s)
    values = {name: [_follow(profile, age, name) for age in ages.tolist()] for name, profile in given.items()}
    samples: list[tuple[float, Sample]] = []
    for i, age in enumerate(ages.tolist()):
        named: Sample = {"vehicle_id": vehicle, "time_s": start_s + age, "ride_id": ride_id, "seq": i}
        samples.append((age, named | {name: column[i] for name, column in values.items()}))
    made = list(_add_faults(samples, faults or {}, fields))
    first = [] if vehicle_model is None else [Vehicle(vehicle, start_s, vehicle_model)]
    about = [Message(f"fleet/{vehicle}/vehicle", encode(each), round(start_s * 1e9)) for each in first]
    return about + sorted(
        (Message(f"fleet/{vehicle}/telemetry", payload, round((start_s + age) * 1e9)) for age, payload in made),
        key=lambda message: message.receipt_ns,
    )


def make_messages(samples: Iterable[Mapping[str, Any]]) -> list[Message]:
    """Return samples with the fields of the telemetry as messages."""
    messages = []
    for number, sample in enumerate(samples, start=1):
        try:
            telemetry = msgspec.convert(dict(sample), Telemetry)
        except msgspec.ValidationError as error:
            raise SettingsError(f"sample {number}: {error}") from None
        if unknown := sorted(sample.keys() - set(Telemetry.__struct_fields__)):
            known = suggest_names(unknown[0], Telemetry.__struct_fields__)
            raise SettingsError(f"sample {number}: telemetry has no field {unknown[0]!r}; {known}")
        receipt_ns = round(telemetry.time_s * 1e9)
        messages.append(Message(f"fleet/{telemetry.vehicle_id}/telemetry", encode(telemetry), receipt_ns))
    return messages


def gather_messages(*parts: Iterable[Message | Mapping[str, Any]]) -> list[Message]:
    """Return the messages of several cars, or of lists of samples, in the order of their receipt."""
    items = list(chain.from_iterable(parts))
    messages = [item for item in items if isinstance(item, Message)]
    messages += make_messages(item for item in items if not isinstance(item, Message))
    return sorted(messages, key=lambda message: message.receipt_ns)


def write_recording(messages: Sequence[Message], path: Path) -> Path:
    """Write messages as a recording, and return its path."""
    with replace_recording(path) as sink:
        sink.put(messages)
    return path


def _follow(profile: Profile, age: float, name: str) -> Any:
    """Return the value of a profile at a time after the start."""
    if callable(profile):
        return profile(age)
    if isinstance(profile, Sequence) and not isinstance(profile, str):
        times, values = zip(*profile, strict=True)
        if wrong := [each for each in (*times, *values) if not isinstance(each, int | float)]:
            raise SettingsError(f"{name}: {wrong[0]!r} is no number; give points of (seconds after the start, value)")
        if list(times) != sorted(times):
            raise SettingsError(f"{name}: the times of the points {list(times)} must ascend")
        return float(np.interp(age, times, values))
    return profile


def _add_faults(
    samples: Sequence[tuple[float, Sample]], faults: Mapping[str, Span], fields: Sequence[str]
) -> Iterable[tuple[float, bytes]]:
    """Yield the time after the start at which each sample arrives [s], and its payload."""
    kept = {name: _parse_fault(name, fields) for name in faults}
    held: Sample = {}
    for age, sample in samples:
        active = [name for name, (begin, end) in faults.items() if begin <= age < end]
        sent, arrival = dict(sample), age
        for name in active:
            kind, field = kept[name]
            if kind == "missing":
                sent[field] = None
            elif kind == "frozen":
                sent[field] = held.setdefault(name, sample[field])
            elif kind == "spike":
                sent[field] = SPIKES[field]
            elif kind == "clock_ahead":
                sent["time_s"] += CLOCK_S
            elif kind == "late":
                arrival = faults[name][1] + LATE_S
        if "lost" in active:
            continue
        payload = encode(msgspec.convert(sent, Telemetry))
        yield arrival, payload[:-1] if "not_json" in active else payload
        if "repeated" in active:
            yield arrival, payload


def _parse_fault(name: str, fields: Sequence[str]) -> tuple[str, str]:
    """Return kind and field of a fault."""
    if name in WHOLE:
        return name, ""
    kind, _, field = name.partition("_")
    if kind not in OF_FIELD:
        known = ", ".join([*WHOLE, *(f"{each}_FIELD" for each in OF_FIELD)])
        raise SettingsError(f"there is no fault {name!r}; known are {known}")
    allowed = [each for each in fields if kind != "spike" or each in SPIKES]
    if field not in allowed:
        raise SettingsError(f"fault {name!r}: {kind} is not possible for {field!r}; {suggest_names(field, allowed)}")
    return kind, field
