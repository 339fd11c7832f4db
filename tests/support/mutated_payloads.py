"""Mutate the messages of a fleet, and check that nothing raises and that nothing implausible is published.

`python -m tests.support.mutated_payloads --count 1000000` runs until that many payloads were mutated.
`python -m tests.support.mutated_payloads --strangers 1000000` sends as many made-up vehicles and stations instead, and
prints the memory before and after.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator
from math import isfinite
from typing import Any, Final

import msgspec
import numpy as np
import psutil

from socast.core.columns import TELEMETRY
from socast.core.errors import AskError
from socast.core.pipeline import Pipeline
from socast.core.vehicles.catalogue import BOUNDS, load_catalogue
from socast.core.wire.messages import Forecast, Leg, Message, Outlook, Plan, encode
from tests.support.fleet_days import CARS, DAY, DAYS, START, days, trained_pipeline
from tests.support.telemetry import make_message, observed

STRANGE: Final = (
    *(None, True, False, "", "now", "é\u0000", "1705305600", [], {}, [1, [2]], {"mean": 1}, "x" * 5000),
    *(-1, 0, 2**53, 2**63, 2**64, 10**400, -(10**30), 1e308, -1e308, 1e-320, 5e10, 91.0, -181.0, 1.5, 100, 1500, 2000),
)
"""Values that replace that of a field."""
LITERALS: Final = (b"NaN", b"Infinity", b"-Infinity", b"1e999", b"-0", b"01", b"tru", b"'a'", b"null", b"")
"""Texts that replace the value of a field; some are not JSON."""
FACTORS: Final = (-1.0, 0.0, 0.1, 10.0, 100.0, 1e-9, 1e9)
TO_WIRE: Final = {
    "latitude_deg": 180 / np.pi,
    "longitude_deg": 180 / np.pi,
    "speed_kmh": 3.6,
    "odometer_km": 1e-3,
    "soc_pct": 100.0,
}
"""Factor from the unit of a column to that of its field; temperatures have an offset instead."""
RANGES: Final = {
    each.source: (
        each.low * TO_WIRE.get(each.source, 1.0) - 273.15 * each.source.endswith("_c"),
        each.high * TO_WIRE.get(each.source, 1.0) - 273.15 * each.source.endswith("_c"),
    )
    for each in TELEMETRY
    if each.source not in {"charging", "time_s"}
}
"""Valid range of each field of telemetry, in its unit."""
WEATHER: Final = {
    "temperature_c": (-75.0, 65.0),
    "wind_speed_kmh": (0.0, 400.0),
    "wind_from_deg": (0.0, 360.0),
    "precipitation_mm": (0.0, 1000.0),
    "pressure_hpa": (800.0, 1100.0),
    "humidity_pct": (0.0, 100.0),
    "solar_w_m2": (0.0, 1500.0),
}
"""Valid range of each field of an observation, in its unit."""
SHARES: Final = (0.02, 0.3, 0.9)
"""Share of the messages of a car that are mutated one by one, on a day."""


class Mutator:
    """Make days of a fleet whose messages are mutated.

    Parameters
    ----------
    seed : int

    Attributes
    ----------
    mutated : int
        Number of payloads that were mutated so far.
    """

    def __init__(self, seed: int) -> None:
        self.mutated = 0
        self._rng = np.random.default_rng(seed)
        self._base = [(m.key, json.loads(m.payload)) for m in days((0,))]

    def make_days(self) -> Iterator[list[Message]]:
        """Yield the messages of one day after another, without end."""
        day = DAYS
        while True:
            yield self._make_day(day)
            day += 1

    def _make_day(self, day: int) -> list[Message]:
        rng = self._rng
        held = {car: self._pick_held_values() for car in CARS}
        share = {car: SHARES[int(rng.integers(len(SHARES)))] for car in CARS}
        out = []
        for place, (key, fields) in enumerate(self._base):
            if place % 200 == 0:
                out += [self._make_weather(day, place), self._make_vehicle(day), self._make_plan(day)]
            car = key.split("/")[1]
            value = fields | {name: fields[name] + DAY * day for name in ("time_s", "shift_end_s") if name in fields}
            if "legs" not in fields and "event" not in fields and held[car]:
                value |= {name: values[place % len(values)] for name, values in held[car].items()}
                self.mutated += 1
            payload = json.dumps(value).encode()
            if rng.random() < share[car]:
                payload = self._mutate(value, payload)
                self.mutated += 1
            out.append(Message(key, payload, int(1e9 * (START + DAY * day + 3.0 * place))))
        return out

    def _pick_held_values(self) -> dict[str, list[Any]]:
        """Return fields of a car that have other values for a whole day: extremes, constants, or a walk."""
        rng = self._rng
        names = list(RANGES)
        out: dict[str, list[Any]] = {}
        for _ in range(int(rng.integers(0, 4))):
            name = names[int(rng.integers(len(names)))]
            low, high = RANGES[name]
            ends = [low, high, 0.0, low + 0.5 * (high - low), float(rng.uniform(low, high))]
            length = int(rng.choice([1, 2, 7, 400]))
            if rng.random() < 0.5:
                out[name] = [ends[int(rng.integers(len(ends)))] for _ in range(length)]
            else:
                out[name] = np.clip(np.cumsum(rng.normal(0.0, 0.02 * (high - low), length)), low, high).tolist()
        if rng.random() < 0.1:
            out["charging"] = [bool(rng.random() < 0.5)]
        if rng.random() < 0.2:
            out["ride_id"] = ["for a whole day"]
        if "seq" in out or "occupants" in out:
            out |= {name: [int(abs(each)) for each in out[name]] for name in ("seq", "occupants") if name in out}
        return out

    def _make_weather(self, day: int, place: int) -> Message:
        rng = self._rng
        fields = {name: float(rng.choice([low, high, rng.uniform(low, high)])) for name, (low, high) in WEATHER.items()}
        self.mutated += 1
        return observed("yul" if rng.random() < 0.5 else f"s{place}", START + DAY * day + 3.0 * place, **fields)

    def _make_vehicle(self, day: int) -> Message:
        rng = self._rng
        fields: dict[str, Any] = {"model": str(rng.choice([*load_catalogue(), "horse"]))}
        for name, (low, high) in BOUNDS.items():
            if name != "accessory_scale" and rng.random() < 0.3:
                fields[name] = float(rng.choice([low, high, rng.uniform(low, high), -1.0, 1e308]))
        self.mutated += 1
        return make_message("vehicle", CARS[int(rng.integers(len(CARS)))], START + DAY * day, **fields)

    def _make_plan(self, day: int) -> Message:
        rng = self._rng
        car, now = CARS[int(rng.integers(len(CARS)))], START + DAY * day
        self.mutated += 1
        fields = {"vehicle_id": car, "time_s": now, **self.make_plan_fields(now)}
        return Message(f"fleet/{car}/plan", json.dumps(fields).encode(), int(now * 1e9))

    def make_plan_fields(self, now: float) -> dict[str, Any]:
        """Return the fields of a plan of extreme legs."""
        rng = self._rng
        legs = []
        for _ in range(int(rng.integers(0, 6))):
            km = float(rng.choice([0.0, 1000.0, rng.uniform(0.0, 1000.0), 5.0]))
            leg = {"distance_km": km, "duration_s": float(rng.choice([km * 18.0, 86_400.0, 18.0 * km + 60.0]))}
            if rng.random() < 0.5:
                leg |= {"gained_m": float(rng.choice([0.0, 5000.0])), "lost_m": float(rng.choice([0.0, 5000.0]))}
            legs.append(leg)
        end = now + float(rng.choice([7200.0, 0.0, 48 * 3600.0, 1e5]))
        return {"shift_end_s": end, "reserve_soc_pct": float(rng.choice([0.0, 20.0, 100.0, 50.0])), "legs": legs}

    def _mutate(self, value: dict[str, Any], payload: bytes) -> bytes:
        """Return a payload with one random change."""
        rng = self._rng
        value = dict(value)
        names = list(value)
        name, other = names[int(rng.integers(len(names)))], names[int(rng.integers(len(names)))]
        at = int(rng.integers(len(payload)))
        kind = int(rng.integers(13))
        if kind == 0:  # bits
            changed = bytearray(payload)
            for _ in range(int(rng.integers(1, 4))):
                changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
            return bytes(changed)
        if kind == 1:
            return payload[:at]
        if kind == 2:
            return payload[:at] + rng.bytes(int(rng.integers(4))) + payload[at + int(rng.integers(4)) :]
        if kind == 3:
            literal = LITERALS[int(rng.integers(len(LITERALS)))]
            return payload[:-1] + b', "' + name.encode() + b'": ' + literal + b"}"
        if kind == 4:
            nested = (b"[" * 3000, b'{"a":' * 3000, b"[" * 500 + b"]" * 500)[int(rng.integers(3))]
            return payload[:-1] + b', "' + (name if rng.random() < 0.5 else "x").encode() + b'": ' + nested + b"}"
        if kind == 5:
            return b"[" + payload + b"," + (payload[:at] if rng.random() < 0.3 else payload) + b"]"
        if kind == 6:
            del value[name]
        elif kind == 7:
            value[name], value[other] = value[other], value[name]
        elif kind == 8:
            value[name + "é\u202e"] = value.pop(name)
        elif kind == 9 and isinstance(value[name], float | int):
            value[name] = value[name] * FACTORS[int(rng.integers(len(FACTORS)))]
        elif kind == 10 and name in RANGES:
            value[name] = float(rng.uniform(*RANGES[name]))
        elif kind == 11 and "time_s" in value:
            value["time_s"] += float(rng.choice([-86_400.0, -3600.0, -3.0, 0.0, 30.0, 3600.0, 86_400.0, 1e6]))
        else:
            value[name] = STRANGE[int(rng.integers(len(STRANGE)))]
        return json.dumps(value).encode()


def find_faults(forecast: Forecast | Outlook) -> list[str]:
    """Return what is implausible in a forecast or an answer, in words."""
    faults = [f"{name} is {value}" for name, value in _list_numbers(forecast) if not isfinite(value)]
    intervals = [("soc_end_of_shift_pct", forecast.soc_end_of_shift_pct, 0.0, 100.0)]
    numbers = [("soc_pct", forecast.soc_pct, 0.0, 100.0), ("soc_sd_pct", forecast.soc_sd_pct, 0.0, 100.0)]
    numbers.append(("reserve_risk", forecast.reserve_risk, 0.0, 1.0))
    if isinstance(forecast, Forecast):
        numbers.append(("ride_energy_predicted_kwh", forecast.ride_energy_predicted_kwh, -2000.0, 2000.0))
        numbers.append(("ride_energy_measured_kwh", forecast.ride_energy_measured_kwh, -2000.0, 2000.0))
        numbers.append(("ride_distance_km", forecast.ride_distance_km, 0.0, 10_000.0))
        numbers.append(("ride_duration_s", forecast.ride_duration_s, 0.0, 1e7))
        intervals.append(("range_km", forecast.range_km, 0.0, 20_000.0))
    else:
        numbers.append(("usable_capacity_kwh", forecast.usable_capacity_kwh, 0.1, 801.0))
        numbers.append(("consumption_scale", forecast.consumption_scale, 0.01, 100.0))
        for leg in [*forecast.legs, *([forecast.asked] if forecast.asked else [])]:
            intervals.append(("leg soc_pct", leg.soc_pct, 0.0, 100.0))
            intervals.append(("leg energy_kwh", leg.energy_kwh, -2000.0, 20_000.0))
    for name, interval, low, high in intervals:
        if interval is not None:
            numbers += [(name, each, low, high) for each in (interval.mean, interval.p05, interval.p95)]
            if not interval.p05 <= interval.mean <= interval.p95:
                faults.append(f"{name} is out of order: {interval}")
    faults += [f"{name} is {each}" for name, each, low, high in numbers if each is not None and not low <= each <= high]
    return faults


def _list_numbers(value: Any, name: str = "") -> list[tuple[str, float]]:
    """Return every number in a struct, with its name."""
    if isinstance(value, float | int):
        return [(name, value)]
    if isinstance(value, list):
        return [each for part in value for each in _list_numbers(part, name)]
    if isinstance(value, msgspec.Struct):
        return [
            each
            for field in value.__struct_fields__
            for each in _list_numbers(getattr(value, field), f"{name} {field}")
        ]
    return []


class Check:
    """Run mutated messages through a trained pipeline, and count what is implausible.

    Attributes
    ----------
    pipeline : Pipeline
    faults : Counter of str
        Implausible values, by field.
    examples : dict of str to str
        One example of each.
    forecasts, answers, refusals : int
    """

    def __init__(self, seed: int) -> None:
        self.pipeline, self.mutator = trained_pipeline(), Mutator(seed)
        self.faults: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        self.forecasts = self.answers = self.refusals = 0
        self._rng = np.random.default_rng([seed, 1])

    def run(self, count: int, most_per_list: int = 4000) -> None:
        """Push messages until a number of payloads was mutated."""
        for messages in self.mutator.make_days():
            start = 0
            while start < len(messages):
                stop = start + int(self._rng.integers(1, most_per_list))
                for message in self.pipeline.push(messages[start:stop]):
                    self.forecasts += 1
                    self._note(msgspec.json.decode(message.payload, type=Forecast))
                start = stop
                self._ask()
            self.pipeline.take_rides()
            self.pipeline.take_windows()
            if self.mutator.mutated >= count:
                return

    def _ask(self) -> None:
        """Ask for the outlook of every car, some with a ride or a plan of their own."""
        for car in CARS:
            km = float(self._rng.choice([0.1, 20.0, 1000.0]))
            leg = Leg(km, 18.0 * km, *([5000.0, 0.0] if self._rng.random() < 0.5 else []))
            state = self.pipeline.engine.state
            lane = self.pipeline.lanes.find(car)
            now = float(state["time"][lane]) if lane is not None and lane < len(state) else 0.0
            fields = self.mutator.make_plan_fields(now)
            plan = msgspec.convert({"vehicle_id": car, "time_s": now, **fields}, Plan)
            try:
                outlook = self.pipeline.ask(
                    car, leg if self._rng.random() < 0.5 else None, plan if self._rng.random() < 0.5 else None
                )
            except AskError:
                self.refusals += 1
                continue
            self.answers += 1
            self._note(msgspec.json.decode(encode(outlook), type=Outlook))

    def _note(self, value: Forecast | Outlook) -> None:
        for fault in find_faults(value):
            name = f"{type(value).__name__} {fault.split(' is ')[0]}"
            self.faults[name] += 1
            self.examples.setdefault(name, fault)


def send_strangers(pipeline: Pipeline, count: int, per_list: int = 5000) -> None:
    """Push one sample of each of many made-up vehicles, and one observation of each of as many stations."""
    for first in range(0, count, per_list):
        messages = []
        for number in range(first, min(first + per_list, count)):
            seconds = START + 1e-3 * number
            sample = {"vehicle_id": f"stranger-{number}", "time_s": seconds, "ride_id": f"r{number}", "soc_pct": 50.0}
            key = f"fleet/stranger-{number}/telemetry"
            messages.append(Message(key, json.dumps(sample).encode(), int(1e9 * seconds)))
            messages.append(observed(f"station-{number}", seconds, (45.0 + 1e-6 * number, -73.0), temperature_c=1.0))
        pipeline.push(messages)


def main() -> None:
    """Run the check, and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--strangers", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    process, began = psutil.Process(), time.monotonic()
    if options.strangers:
        pipeline = Pipeline()
        send_strangers(pipeline, 1000)
        before = process.memory_info().rss
        send_strangers(pipeline, options.strangers)
        after = process.memory_info().rss
        print(f"{options.strangers} made-up vehicles and stations in {time.monotonic() - began:.0f} s: resident memory")
        print(f"{before / 1e6:.0f} MB before and {after / 1e6:.0f} MB after; {pipeline.quality()}")
        return
    check = Check(options.seed)
    check.run(options.count)
    print(f"{check.mutator.mutated} mutated payloads in {time.monotonic() - began:.0f} s, {check.forecasts} forecasts,")
    print(f"{check.answers} answers, {check.refusals} refusals; resident {process.memory_info().rss / 1e6:.0f} MB")
    print(f"implausible: {dict(check.faults)} {check.examples}")
    print(check.pipeline.quality())


if __name__ == "__main__":
    main()
