"""A shift of a few cars, as messages, for tests of what carries them."""

import json

from socast.core.columns import SECONDS_PER_DAY
from socast.core.wire.messages import Message, Telemetry, Vehicle, Weather, encode

BEGIN = 1_516_017_600


def shift(samples: int = 400, cars: int = 3) -> list[Message]:
    """Make a shift of a few cars, with weather, a tunnel, duplicates and a payload that is no JSON."""
    out = [
        Message("weather/yul", encode(Weather("yul", BEGIN - 60.0, 45.47, -73.74, temperature_c=-12.0)), 0),
        *(
            Message(f"fleet/car-{c}/vehicle", encode(Vehicle(f"car-{c}", float(BEGIN), "nissan-leaf-2013")), 0)
            for c in range(cars)
        ),
    ]
    for i in range(samples):
        for c in range(cars):
            sample = Telemetry(
                vehicle_id=f"car-{c}",
                time_s=BEGIN + 3.0 * i + 0.1 * (i % 4),
                seq=i,
                ride_id=f"ride-{c}-{i // 150}",
                latitude_deg=45.5 + 2.7e-4 * i,
                longitude_deg=-73.6 + 0.01 * c,
                elevation_m=30.0 + i % 7,
                speed_kmh=1500.0 if i % 97 == 50 else 36.0,
                soc_pct=90.0 - i // 40,
                battery_voltage_v=360.0,
                battery_current_a=20.0 + c,
            )
            out += [Message(f"fleet/car-{c}/telemetry", encode(sample), 0)] * (2 if i % 89 == 7 else 1)
    out.insert(len(out) // 2, Message("fleet/car-0/telemetry", b"{not json", 0))
    return [m._replace(receipt_ns=BEGIN * 10**9 + n * 10**7) for n, m in enumerate(out)]


def make_two_days() -> list[Message]:
    """Make the same shift on two successive days."""
    return [*shift(), *(_move_by_a_day(message) for message in shift())]


def _move_by_a_day(message: Message) -> Message:
    """Return a message of the next day; a payload that is no JSON stays as it is."""
    try:
        content = json.loads(message.payload)
    except ValueError:
        return message
    content["time_s"] += SECONDS_PER_DAY
    return Message(message.key, json.dumps(content).encode(), message.receipt_ns + round(SECONDS_PER_DAY * 1e9))
