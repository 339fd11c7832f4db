"""Wire structs, field by field as the wire contract has them, their payloads and their JSON schemas.

Names wear the wire's units. `core.decode` turns payloads into the SI columns that everything else works on.
"""

import re
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec

IDENTITY: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
"""What a vehicle or a station may be called."""

Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]


class Message(NamedTuple):
    """What a transport delivers, before anybody has looked inside.

    Parameters
    ----------
    key : str. Zenoh key expression, or MCAP topic.
    payload : bytes. UTF-8 JSON, verbatim.
    receipt_ns : int. Unix time at which it was received. [ns]
    """

    key: str
    payload: bytes
    receipt_ns: int


class Wire(msgspec.Struct, gc=False, omit_defaults=True):
    """Base of everything that travels."""


class Telemetry(Wire):
    """One logger sample, nominally every 3 s: `fleet/{vehicle_id}/telemetry`."""

    vehicle_id: str
    time_s: float
    ride_id: str | msgspec.UnsetType | None = msgspec.UNSET
    seq: Count | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    elevation_m: float | None = None
    speed_kmh: float | None = None
    odometer_km: float | None = None
    soc_pct: float | None = None
    battery_voltage_v: float | None = None
    battery_current_a: float | None = None
    battery_temperature_c: float | None = None
    ambient_c: float | None = None
    hvac_w: float | None = None
    occupants: Count | None = None
    charging: bool | None = None


class Vehicle(Wire):
    """What is known of a car, with overrides of its catalogue entry: `fleet/{vehicle_id}/vehicle`."""

    vehicle_id: str
    time_s: float
    model: str
    nominal_capacity_kwh: float | None = None
    mass_kg: float | None = None
    drag_coefficient: float | None = None
    frontal_area_m2: float | None = None
    rolling_resistance: float | None = None
    in_service_date: str | None = None


class Ride(Wire):
    """A ride begins or ends, says dispatch: `fleet/{vehicle_id}/ride`."""

    vehicle_id: str
    time_s: float
    ride_id: str
    event: Literal["start", "end"]
    driver_id: str | None = None


class Leg(Wire):
    """One leg of a plan."""

    distance_km: float
    duration_s: float
    gained_m: float | None = None
    lost_m: float | None = None


class Plan(Wire):
    """What remains of the shift: `fleet/{vehicle_id}/plan`."""

    vehicle_id: str
    time_s: float
    shift_end_s: float
    reserve_soc_pct: float
    legs: list[Leg]


class Weather(Wire):
    """One observation of a station: `weather/{station_id}`."""

    station_id: str
    time_s: float
    latitude_deg: float
    longitude_deg: float
    temperature_c: float | None = None
    wind_speed_kmh: float | None = None
    wind_from_deg: float | None = None
    precipitation_mm: float | None = None
    pressure_hpa: float | None = None
    humidity_pct: float | None = None
    solar_w_m2: float | None = None


class Interval(Wire, omit_defaults=False):
    """A predicted quantity: its mean and its 5th and 95th percentile."""

    mean: float
    p05: float
    p95: float


class QualityCounts(Wire, omit_defaults=False):
    """Samples repaired or rejected since the ride began, by cause."""

    repaired_time: int
    rejected_speed: int
    duplicate: int
    gap: int
    out_of_range: int


class Forecast(Wire, omit_defaults=False):
    """What the consumer publishes: `fleet/{vehicle_id}/forecast`."""

    vehicle_id: str
    time_s: float
    ride_id: str | None
    model: str
    ride_distance_km: float
    ride_duration_s: float
    ride_energy_predicted_kwh: float | None
    ride_energy_measured_kwh: float | None
    soc_pct: float | None
    soc_sd_pct: float | None
    range_km: Interval | None
    soc_end_of_shift_pct: Interval | None
    reserve_risk: float | None
    quality: QualityCounts


KINDS: Final[dict[str, type[Wire]]] = {
    "telemetry": Telemetry,
    "vehicle": Vehicle,
    "ride": Ride,
    "plan": Plan,
    "forecast": Forecast,
    "weather": Weather,
}
"""The last chunk of a vehicle's key, or `weather` -> the struct that travels under it."""


class Address(NamedTuple):
    """A key taken apart: the kind of message, and the vehicle or station that it speaks of."""

    kind: str
    identity: str


def address(key: str) -> Address | None:
    """Take a key apart; None for a key that is not of the contract. Chunks before it are a prefix.

    >>> address("montreal/fleet/taxi-7/telemetry")
    Address(kind='telemetry', identity='taxi-7')
    >>> address("weather/yul")
    Address(kind='weather', identity='yul')
    >>> address("fleet/taxi-7/lunch") is None
    True
    """
    chunks = key.split("/")
    if len(chunks) >= 2 and chunks[-2] == "weather" and IDENTITY.fullmatch(chunks[-1]):
        return Address("weather", chunks[-1])
    if len(chunks) >= 3 and chunks[-3] == "fleet" and chunks[-1] in KINDS and IDENTITY.fullmatch(chunks[-2]):
        return Address(chunks[-1], chunks[-2])
    return None


def schema(kind: str) -> dict[str, Any]:
    """Return the JSON schema of a kind, with every type plain: no references, no unions with null.

    MCAP viewers plot what they find as `properties` of an `object` and do not follow `$ref` or `anyOf`.

    >>> schema("telemetry")["properties"]["soc_pct"]
    {'type': 'number'}
    """
    (_,), components = msgspec.json.schema_components([KINDS[kind]], ref_template="{name}")

    def plain(node: dict[str, Any]) -> dict[str, Any]:
        if "$ref" in node:
            return plain(components[node["$ref"]])
        if "enum" in node:
            return {"type": "string"}
        if "anyOf" in node:
            return plain(next(option for option in node["anyOf"] if option.get("type") != "null"))
        out = {k: v for k, v in node.items() if k in {"title", "type", "description", "required"}}
        if "items" in node:
            out["items"] = plain(node["items"])
        if "properties" in node:
            out["properties"] = {name: plain(child) for name, child in node["properties"].items()}
        return out

    return plain(components[KINDS[kind].__name__])


def encode(value: Wire) -> bytes:
    """Return the payload of a wire struct."""
    return msgspec.json.encode(value)
