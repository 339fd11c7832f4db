"""Provide shifts of several cars whose samples have every fault of a logger."""

import numpy as np

from socast.core.wire.messages import Message
from tests.support.telemetry import (
    drive,
    leaf,
    make_message,
    observed,
    picked,
    telemetry,
    without,
)

CARS = ("a", "b", "c")


def car(name, seed, n=120):
    """Return the messages of one car and shift: samples with every fault, rides, and messages of dispatch."""
    rng = np.random.default_rng(seed)
    columns = drive(n, seed=seed, elevation_m=40.0, battery_voltage_v=360.0)
    columns["battery_current_a"] = 5 + columns["speed_kmh"]
    columns["soc_pct"] = np.round(90 - 0.02 * np.arange(n), 1)
    columns["odometer_km"] = np.round(9000 + columns["metres"] / 1000, 1)
    columns["ambient_c"] = np.where(rng.random(n) < 0.5, np.nan, -5.0)
    columns["ride_id"] = np.array([("A", "B", None, "A")[4 * i // n] for i in range(n)], dtype=object)
    columns["time_s"] = columns["time_s"] + rng.normal(0, 0.5, n)
    columns["speed_kmh"][rng.random(n) < 0.05] = 1400.0
    columns["latitude_deg"][rng.random(n) < 0.05] = 0.0
    columns["latitude_deg"][40:52] = columns["latitude_deg"][39]
    columns["soc_pct"][rng.random(n) < 0.05] = 400.0
    order = np.argsort(np.arange(n) + rng.normal(0, 0.4, n))
    order = np.repeat(order, rng.choice([0, 1, 2], n, p=[0.08, 0.84, 0.08]))
    columns = picked(columns, order)
    if seed % 3 == 1:
        columns = without(columns, "seq", "ride_id")
    if seed % 3 == 2:
        columns = without(columns, "speed_kmh", "battery_current_a")
    messages = telemetry(columns, name)
    messages.insert(n // 2, leaf(name, mass_kg=1600.0))
    messages.insert(5, make_message("ride", name, ride_id="A", event="start", driver_id=f"driver of {name}"))
    bad = Message(f"fleet/{name}/telemetry", b'{"vehicle_id": 5}', 0)
    return [leaf(name), *messages[:50], bad, *messages[50:]]


def mixed(streams, seed):
    """Return streams merged at random, with the order within each stream kept."""
    rng = np.random.default_rng(seed)
    owners = np.repeat(np.arange(len(streams)), [len(stream) for stream in streams])
    rng.shuffle(owners)
    iterators = [iter(stream) for stream in streams]
    return [next(iterators[owner]) for owner in owners]


def shift(seed):
    """Return the messages of all cars and of the weather, merged at random."""
    weather = [
        observed(time=1_705_305_000.0 + 120 * i, temperature_c=-i, wind_speed_kmh=5.0 * i, wind_from_deg=30.0 * i)
        for i in range(4)
    ]
    return mixed([*(car(name, seed + i) for i, name in enumerate(CARS)), weather], seed)


def decodable_shift(seed):
    """Return the messages of `shift` that can be decoded; the others count whenever they come."""
    return [message for message in shift(seed) if message.payload != b'{"vehicle_id": 5}']
