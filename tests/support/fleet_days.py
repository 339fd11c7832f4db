"""Days of a small fleet that drives by plan, and a pipeline that is trained with some of them."""

from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from socast.core.forecast.day_rollover import WINDOW_SAMPLES
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Forecast, Message
from socast.stream.mcap_writer import McapSink
from tests.support.telemetry import START, Columns, leaf, make_message, observed, telemetry

CARS = ("a", "b", "c", "d", "e", "f")
DAYS = 5
"""Number of training days."""
DAY = 86_400.0
PERIOD = 15.0
LEGS, LEG, RIDE = 8, 900.0, 600.0
"""Number of legs of a shift, and the duration of each with and without its pause. [s]"""
SHIFT = LEGS * LEG
CHARGED_LEG = 4
"""Leg that `columns_with_charge` replaces by a charge."""
CAPACITY = 21.6
"""Approximate usable capacity. [kWh]"""
SETTINGS = Settings(period=PERIOD, forecast_time=60.0)
RESERVE = 20.0


def speeds(car: str, day: int) -> np.ndarray:
    """Return the speed of each leg, (LEGS,). [m/s]"""
    return np.random.default_rng([ord(car), day]).uniform(8.0, 14.0, LEGS)


def log_consumption(car: str, day: int) -> float:
    """Return the log of the consumption of a car on a day over 0.16 kWh/km: the car's part and the day's."""
    return float(0.15 * np.sin(ord(car)) + 0.05 * np.random.default_rng([ord(car), day, 1]).normal())


def columns(car: str, day: int, quantum: float = 0.5, hours: float = SHIFT / 3600.0) -> Columns:
    """Return the samples of a shift without faults, with a leg and a pause every quarter of an hour."""
    passed = PERIOD * np.arange(int(3600.0 * hours / PERIOD) + 1)
    leg = np.minimum(passed // LEG, LEGS - 1).astype(int)
    riding = (passed % LEG < RIDE) & (passed < SHIFT)
    into = np.minimum(passed % LEG, RIDE - passed % LEG)
    speed = np.where(riding, np.select([into == 0.0, into <= PERIOD], [0.0, 4.0], speeds(car, day)[leg]), 0.0)
    metres = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * PERIOD)])
    used = np.exp(log_consumption(car, day)) * 0.16 * metres / 1000.0 + 0.3 * passed / 3600.0
    soc = 95.0 - 100.0 * used / CAPACITY
    names = np.array([f"{car}-{day}-{number}" for number in leg], dtype=object)
    names[~riding] = None
    begin = START + DAY * day + 7.0 * CARS.index(car)
    made = {
        "time_s": begin + passed,
        "seq": np.arange(len(passed)),
        "ride_id": names,
        "speed_kmh": 3.6 * speed,
        "soc_pct": np.round(soc / quantum) * quantum,
        "ambient_c": np.full(len(passed), 10.0 - 2.0 * (day % 3)),
        "metres": metres,
    }
    if car in "ab":
        power = 1000.0 * np.diff(used, prepend=0.0) * 3600.0 / PERIOD
        made |= {"battery_voltage_v": np.full(len(passed), 360.0), "battery_current_a": power / 360.0}
    return made


def columns_with_charge(car: str, day: int, to_pct: float = 90.0, sends: bool = True) -> Columns:
    """Return the samples of a shift in which the car charges instead of driving the leg `CHARGED_LEG`.

    Parameters
    ----------
    car : str
    day : int
    to_pct : float
        Charge when it departs. [%]
    sends : bool
        Whether it sends samples while it charges.
    """
    sent = columns(car, day)
    passed = sent["time_s"] - sent["time_s"][0]
    stands = (passed >= LEG * CHARGED_LEG - 1.0) & (passed < LEG * (CHARGED_LEG + 1) - 1.0)
    plugged = stands & (passed >= LEG * CHARGED_LEG + 60.0) & (passed < LEG * CHARGED_LEG + 840.0)
    sent["speed_kmh"][stands], sent["ride_id"][stands] = 0.0, None
    before, after = np.flatnonzero(plugged)[0] - 1, np.flatnonzero(plugged)[-1] + 1
    soc = sent["soc_pct"]
    soc[stands] = soc[before]
    soc[plugged] = np.round(2.0 * np.linspace(soc[before], to_pct, int(plugged.sum()))) / 2.0
    begins = np.flatnonzero(stands)[-1] + 1
    soc[begins:] += to_pct - soc[begins]
    soc[after:begins] = to_pct
    made = sent | {"charging": plugged}
    return made if sends else {name: values[~plugged] for name, values in made.items()}


def plan_with_charge(car: str, day: int, time: float, to_pct: float = 90.0) -> Message:
    """Return the plan of a shift with a charge instead of the leg `CHARGED_LEG`."""
    legs: list[dict[str, float]] = [
        {"distance_km": RIDE * v / 1000.0, "duration_s": RIDE} for v in speeds(car, day).tolist()
    ]
    legs[CHARGED_LEG] = {"duration_s": 780.0, "charge_to_soc_pct": to_pct}
    return plan(car, day, time, legs=legs)


def plan(car: str, day: int, time: float, last: int = LEGS, **changed) -> Message:
    """Return the plan of the last legs of a shift."""
    begin = START + DAY * day
    left = [{"distance_km": RIDE * v / 1000.0, "duration_s": RIDE} for v in speeds(car, day)[LEGS - last :].tolist()]
    fields = {"shift_end_s": begin + SHIFT, "reserve_soc_pct": RESERVE, "legs": left}
    return make_message("plan", car, time, **(fields | changed))


def shift(car: str, day: int, sent: Columns | None = None, planned: bool = True) -> list:
    """Return the messages of a shift, with the plan and the driver after the first sample."""
    return list(_make_usual_shift(car, day, planned) if sent is None else _make_shift(car, day, sent, planned))


@cache
def _make_usual_shift(car: str, day: int, planned: bool) -> list:
    return _make_shift(car, day, columns(car, day), planned)


def _make_shift(car: str, day: int, sent: Columns, planned: bool) -> list:
    """Return each message of a shift with its time."""
    begin = float(sent["time_s"][0])
    samples = telemetry(sent, car)
    drives = make_message(
        "ride", car, begin, ride_id=f"{car}-{day}-0", event="start", driver_id=f"driver {(ord(car) + day) % 3}"
    )
    first = [samples[0], *([plan(car, day, begin)] if planned else []), drives]
    times = [begin] * len(first) + sent["time_s"][1:].tolist()
    return list(zip(times, [*first, *samples[1:]], strict=True))


def merged(*streams: list) -> list:
    """Return the messages of several streams in the order of time, stable within each stream."""
    return [message for _, message in sorted((each for stream in streams for each in stream), key=lambda each: each[0])]


def days(numbers, cars=CARS, **options) -> list:
    """Return the messages of whole days."""
    return [m for day in numbers for m in merged(*(shift(car, day, **options) for car in cars))]


def idle_morning(day: int, car: str = "f") -> list[Message]:
    """Return the samples of one idle car in the morning of a day, until no other car is active."""
    passed = PERIOD * np.arange(WINDOW_SAMPLES + 2)
    begun = {name: np.repeat(values[:1], len(passed)) for name, values in columns(car, day).items()}
    begun["time_s"] = begun["time_s"] - 3600.0 - passed[::-1]
    begun["seq"] = np.arange(len(passed))
    begun["ride_id"][:] = None
    return telemetry(begun, car)


@cache
def learned(number: int = DAYS, planned: bool = True) -> bytes:
    """Return the snapshot of a pipeline that is trained with some days, at the beginning of the next one."""
    pipeline = Pipeline(settings=SETTINGS)
    pipeline.push([observed(temperature_c=10.0), *(leaf(car) for car in CARS), *days(range(number), planned=planned)])
    pipeline.push(idle_morning(number))
    pipeline.take_rides()
    pipeline.take_windows()
    return pipeline.snapshot()


def trained_pipeline(number: int = DAYS, planned: bool = True, settings: Settings = SETTINGS, **options) -> Pipeline:
    """Return a pipeline that is trained with some days."""
    pipeline = Pipeline(settings=settings, **options)
    pipeline.restore(learned(number, planned))
    return pipeline


def forecasts(messages: list, car: str) -> dict[float, Forecast]:
    """Return the forecasts of a car by time."""
    published = [msgspec.json.decode(m.payload, type=Forecast) for m in messages if m.key == f"fleet/{car}/forecast"]
    return {each.time_s: each for each in published}


def recorded(path: Path, numbers) -> None:
    """Write a recording of whole days, with each message received 10 ms after the one before."""
    messages = [observed(temperature_c=10.0), *(leaf(car) for car in CARS), *days(numbers)]
    begin = START + DAY * min(numbers)
    with McapSink(path) as sink:
        sink.put([m._replace(receipt_ns=int(begin * 1e9) + i * 10**7) for i, m in enumerate(messages)])
