"""Timed streams of messages of several cars, with messages of dispatch between the samples."""

from collections.abc import Sequence

import pandas as pd

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from tests.support.telemetry import PERIOD, START, drive, leaf, make_message, telemetry, without

SPEED = 10.0
Timed = list[tuple[float, Message]]


def sent(car: str, samples: int, first: int = 0, ahead: float = 0.0, name: str | None = "r1") -> Timed:
    """Return samples of a moving car, from number `first` on, by a logger whose clock may be ahead. [s]"""
    columns = drive(samples, speed=SPEED, battery_voltage_v=360.0, battery_current_a=20.0)
    columns["time_s"] = columns["time_s"] + PERIOD * first + ahead
    columns["seq"] = columns["seq"] + first
    columns["ride_id"][:] = name
    messages = telemetry(columns if name else without(columns, "ride_id"), car)
    return [(START + PERIOD * (first + i), message) for i, message in enumerate(messages)]


def dispatched(time: float, car: str, ride_id: str, event: str) -> Timed:
    """Return a message of dispatch."""
    return [(time, make_message("ride", car, time, ride_id=ride_id, event=event))]


def shift(car: str, rides: int = 3) -> Timed:
    """Return rides of a car, each of which dispatch ends before the last five samples that name it."""
    messages = [(START - 1.0, leaf(car))]
    for number in range(rides):
        begin, name = 120 * number, f"{car}{number}"
        messages += sent(car, 100, first=begin, name=name)
        messages += dispatched(START + PERIOD * (begin + 94) + 0.5, car, name, "end")
    return messages


def in_order(*streams: Timed) -> list[Message]:
    """Return the messages of streams in the order of time, stable within each stream."""
    return [message for _, message in sorted((each for stream in streams for each in stream), key=lambda each: each[0])]


def count_ended(messages: Sequence[Message], pipeline: Pipeline | None = None) -> list[int]:
    """Return the number of rides that have ended after each message, of a pipeline that takes them one by one."""
    pipeline = pipeline or Pipeline(keep_forecasts=False)
    ended = []
    for message in messages:
        pipeline.take([message])
        ended.append(pipeline.quality()["rides"])
    return ended


def run_parts(parts: Sequence[Sequence[Message]], *, restart: bool = False) -> tuple[list[bytes], list[pd.DataFrame]]:
    """Return the forecasts, and the ride and window tables, of messages that come in parts."""
    pipeline = Pipeline()
    out: list[bytes] = []
    tables: list[list[pd.DataFrame]] = [[], []]
    for part in parts:
        out += [message.payload for message in pipeline.push(part)]
        if restart:
            for table, taken in zip(tables, (pipeline.take_rides(), pipeline.take_windows()), strict=True):
                table.append(taken)
            kept, pipeline = pipeline.snapshot(), Pipeline()
            pipeline.restore(kept)
    pipeline.finish()
    for table, taken in zip(tables, (pipeline.take_rides(), pipeline.take_windows()), strict=True):
        table.append(taken)
    return out, [pd.concat([part for part in some if len(part)], ignore_index=True) for some in tables]
