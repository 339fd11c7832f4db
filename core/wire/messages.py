"""Wire structs, field by field as the wire contract has them, their payloads and their JSON schemas.

Names wear the wire's units. `core.wire.decoder` turns payloads into the SI columns that everything else works on.
"""

import re
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
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


class LegOutlook(Wire, omit_defaults=False):
    """What is expected of a leg.

    Parameters
    ----------
    distance_km, duration_s : float
        As planned. [km], [s]
    energy_kwh : Interval or None
        That it takes from the battery. [kWh]
    soc_pct : Interval or None
        State of charge at its end. [%]
    """

    distance_km: float
    duration_s: float
    energy_kwh: Interval | None
    soc_pct: Interval | None


class Outlook(Wire, omit_defaults=False):
    """What is expected of the rest of a shift, in reply to a query of `fleet/{vehicle_id}/outlook`.

    Parameters
    ----------
    time_s : float
        Of the newest sample that it rests on. [Unix seconds]
    model : str
        Name and version of the model that made it.
    soc_pct, soc_sd_pct : float or None
        Filtered state of charge and its standard deviation, now. [%]
    usable_capacity_kwh, usable_capacity_sd_kwh : float or None
        Of the battery, and its standard deviation. [kWh]
    consumption_scale : float or None
        What this car takes today, over what the model says. [1]
    asked : LegOutlook or None
        The ride asked for; None where none was.
    legs : list of LegOutlook
        The remaining legs of the plan, after the ride asked for.
    shift_end_s : float or None
        By the plan, or as the car's shifts usually end. [Unix seconds]
    soc_end_of_shift_pct : Interval or None
        State of charge when the shift ends, with the ride asked for. [%]
    reserve_soc_pct : float
        Of the plan, or what is usual. [%]
    reserve_risk : float or None
        Probability that the state of charge falls below the reserve before the shift ends, with the ride asked for.
    why_not : str or None
        Why any of these is None, in words.
    """

    vehicle_id: str
    time_s: float
    model: str
    soc_pct: float | None
    soc_sd_pct: float | None
    usable_capacity_kwh: float | None
    usable_capacity_sd_kwh: float | None
    consumption_scale: float | None
    asked: LegOutlook | None
    legs: list[LegOutlook]
    shift_end_s: float | None
    soc_end_of_shift_pct: Interval | None
    reserve_soc_pct: float
    reserve_risk: float | None
    why_not: str | None


class Gain(Wire, omit_defaults=False):
    """By how much a model's error is smaller than the first model's, over whole vehicle-days that both predicted.

    Parameters
    ----------
    rides, vehicle_days : int
        Of vehicle-days that have ended; rides that both models predicted.
    mean_kwh : float or None
        Absolute error of the first model, less that of this one, a ride; None where no vehicle-day has ended.
    lower_kwh, upper_kwh : float or None
        Between what it lies, with 95 % for all shadows together and however often one looks (`core.stats.confidence_sequence`); None
        where too few vehicle-days have ended to tell.
    verdict : str
        `better` or `worse` where those exclude zero.
    """

    rides: int
    vehicle_days: int
    mean_kwh: float | None
    lower_kwh: float | None
    upper_kwh: float | None
    verdict: Literal["better", "worse", "not told"]


class RideErrors(Wire, omit_defaults=False):
    """Running errors of a model, over rides that are fit for training and whose energy was measured.

    Parameters
    ----------
    vehicle_model : str or None
        Whose rides; None for all.
    rides, unpredicted_rides : int
        That it predicted, and that it could not.
    mae_kwh, bias_kwh : float or None
        Mean absolute error and mean error (predicted less measured) a ride.
    mae_pct : float or None
        Sum of absolute errors over the sum of measured energies.
    gain : Gain or None
        Against the first model; None of the first itself.
    """

    vehicle_model: str | None
    rides: int
    unpredicted_rides: int
    mae_kwh: float | None
    mae_pct: float | None
    bias_kwh: float | None
    gain: Gain | None


class ModelErrors(Wire, omit_defaults=False):
    """How a model fares in service, published as rides end: `models/{name}/{version}/errors`.

    Parameters
    ----------
    model, first : str
        Name and version, of the model and of the one that makes the forecasts.
    time_s : float
        End of the last ride that counts.
    overall : RideErrors
    by_vehicle_model : list of RideErrors
        In the order in which they were first met.
    """

    model: str
    first: str
    time_s: float
    overall: RideErrors
    by_vehicle_model: list[RideErrors]


OF_VEHICLES: Final[dict[str, type[Wire]]] = {
    "telemetry": Telemetry,
    "vehicle": Vehicle,
    "ride": Ride,
    "plan": Plan,
    "forecast": Forecast,
}
"""The last chunk of a vehicle's key -> the struct that travels under it."""
KINDS: Final[dict[str, type[Wire]]] = OF_VEHICLES | {"weather": Weather, "errors": ModelErrors}
"""All kinds of message -> the struct of each."""


class Address(NamedTuple):
    """A key taken apart: the kind of message, and the vehicle, station or model (with its version) it speaks of."""

    kind: str
    identity: str


@lru_cache(maxsize=1 << 16)
def address(key: str) -> Address | None:
    """Take a key apart; None for a key that is not of the contract. Chunks before it are a prefix.

    >>> address("montreal/fleet/taxi-7/telemetry")
    Address(kind='telemetry', identity='taxi-7')
    >>> address("weather/yul")
    Address(kind='weather', identity='yul')
    >>> address("models/hybrid/2/errors")
    Address(kind='errors', identity='hybrid/2')
    >>> address("fleet/taxi-7/lunch") is None
    True
    """
    chunks = key.split("/")
    if len(chunks) >= 2 and chunks[-2] == "weather" and IDENTITY.fullmatch(chunks[-1]):
        return Address("weather", chunks[-1])
    if len(chunks) >= 3 and chunks[-3] == "fleet" and chunks[-1] in OF_VEHICLES and IDENTITY.fullmatch(chunks[-2]):
        return Address(chunks[-1], chunks[-2])
    if (
        len(chunks) >= 4
        and chunks[-4] == "models"
        and chunks[-1] == "errors"
        and all(map(IDENTITY.fullmatch, chunks[-3:-1]))
    ):
        return Address("errors", "/".join(chunks[-3:-1]))
    return None


def model_identity(model: str) -> str:
    """Return name and version of a model as chunks of a key, whatever else they hold replaced.

    >>> model_identity("hybrid interactions/2")
    'hybrid_interactions/2'
    """
    name, _, version = model.rpartition("/")
    return "/".join(re.sub(r"[^A-Za-z0-9_.-]", "_", part)[:64] or "_" for part in (name, version))


def identity(value: Wire) -> str:
    """Return the vehicle, station or model that a message speaks of, as its key names it."""
    named = _NAMES.get(type(value))
    if named is None:
        raise TypeError(f"{type(value).__name__} does not travel by itself")
    return named(value)


_NAMES: Final[dict[type[Wire], Callable[[Any], str]]] = {
    **dict.fromkeys(OF_VEHICLES.values(), attrgetter("vehicle_id")),
    Weather: attrgetter("station_id"),
    ModelErrors: lambda errors: model_identity(errors.model),
}
"""How a message of each kind tells of whom it speaks."""


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
