"""Make the stream of many cars at little cost, as input of the benchmarks."""

from collections.abc import Iterator

import numpy as np

from socast.core.wire.messages import Message, Telemetry, Vehicle, encode

START_S = 1_767_600_000.0
PERIOD_S = 3.0


def name_car(car: int) -> str:
    """Return the identifier of a car."""
    return f"taxi-{car:07d}"


def make_vehicles(cars: int) -> list[Message]:
    """Return a vehicle message of each car."""
    return [
        Message(
            f"fleet/{name_car(car)}/vehicle", encode(Vehicle(name_car(car), START_S, "kia-soul-ev-2015")), int(START_S)
        )
        for car in range(cars)
    ]


def make_rounds(cars: int, first: int, count: int, seed: int = 0) -> Iterator[list[Message]]:
    """Yield rounds of telemetry; a round has one sample of every car."""
    rng = np.random.default_rng(seed + first)
    phase = np.linspace(0.0, 300.0, cars, endpoint=False)
    for turn in range(first, first + count):
        now = START_S + PERIOD_S * turn
        stamps = now + rng.normal(0.0, 0.3, cars)
        speed = np.maximum(0.0, 40.0 + 45.0 * np.sin((now + phase) / 23.0))
        angle = (now - START_S + phase) / 90.0
        columns = (
            stamps,
            45.5 + 0.01 * np.sin(angle),
            -73.6 + 0.014 * np.cos(angle),
            40.0 + 15.0 * np.sin(angle) + rng.normal(0.0, 1.0, cars),
            speed,
            np.clip(90.0 - 0.01 * turn - phase / 10.0, 5.0, 100.0).round(1),
            360.0 - 0.05 * speed,
            (3.0 + speed).round(1),
        )
        messages = []
        for car, (stamp, latitude, longitude, elevation, kmh, soc, volt, ampere) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            name = name_car(car)
            sample = Telemetry(
                name,
                round(stamp, 3),
                ride_id=f"{car}-{turn // 400}",
                seq=turn,
                latitude_deg=round(latitude, 6),
                longitude_deg=round(longitude, 6),
                elevation_m=round(elevation, 1),
                speed_kmh=round(kmh, 1),
                soc_pct=soc,
                battery_voltage_v=round(volt, 1),
                battery_current_a=ampere,
                ambient_c=-8.0,
            )
            messages.append(Message(f"fleet/{name}/telemetry", encode(sample), int(now * 1e9)))
        yield messages
