"""Structs of the messages on the wire, field by field, and the keys under which they travel.

Names of fields carry their units. `socast.core.wire.decoder` turns payloads into columns in SI units.
"""

import re
from collections.abc import Callable
from functools import lru_cache
from math import nan
from operator import attrgetter
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec
from msgspec import UNSET, Meta, UnsetType

IDENTITY: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
"""Valid identity of a vehicle or a station."""

LONGEST_KEY: Final = 512
"""Largest number of characters of a key."""
LONGEST_TEXT: Final = 256
"""Largest number of characters of a name: of a ride, a driver or a vehicle model."""

Name = Annotated[str, Meta(max_length=LONGEST_TEXT)]
Count = Annotated[int, Meta(ge=0, le=2**53)]


class Message(NamedTuple):
    """Hold what a transport delivers, before it is decoded.

    Parameters
    ----------
    key : str
        Zenoh key expression, or MCAP topic.
    payload : bytes
        UTF-8 JSON, or a batch in Arrow's stream format, verbatim.
    receipt_ns : int
        Unix time of receipt. [ns]
    """

    key: str
    payload: bytes
    receipt_ns: int


class Wire(msgspec.Struct, gc=False, omit_defaults=True):
    """Base of all messages and their parts."""


class Telemetry(Wire):
    """Sample of a logger, nominally every 3 s: `fleet/{vehicle_id}/telemetry`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, Meta(description="Time on the logger's own clock. [Unix s]")]
    ride_id: Annotated[
        Name | None, Meta(description="The logger's name of the ride in progress; null or absent between rides.")
    ] = None
    seq: Annotated[Count | None, Meta(description="The logger's sample counter.")] = None
    latitude_deg: Annotated[float | None, Meta(description="Latitude, WGS 84. [deg]")] = None
    longitude_deg: Annotated[float | None, Meta(description="Longitude, WGS 84. [deg]")] = None
    elevation_m: Annotated[float | None, Meta(description="Elevation above sea level. [m]")] = None
    speed_kmh: Annotated[float | None, Meta(description="Ground speed. [km/h]")] = None
    odometer_km: Annotated[float | None, Meta(description="Odometer. [km]")] = None
    soc_pct: Annotated[float | None, Meta(description="State of charge as displayed. [%]")] = None
    battery_voltage_v: Annotated[float | None, Meta(description="Voltage of the traction battery. [V]")] = None
    battery_current_a: Annotated[
        float | None, Meta(description="Current of the traction battery, positive when discharging. [A]")
    ] = None
    battery_temperature_c: Annotated[float | None, Meta(description="Temperature of the traction battery. [degC]")] = (
        None
    )
    ambient_c: Annotated[float | None, Meta(description="Temperature of the outside air. [degC]")] = None
    hvac_w: Annotated[float | None, Meta(description="Power of heating and air conditioning. [W]")] = None
    occupants: Annotated[Count | None, Meta(description="Number of people aboard, including the driver.")] = None
    charging: Annotated[bool | None, Meta(description="Whether the car is plugged in and charging.")] = None


class Vehicle(Wire):
    """Vehicle model of a car, and overrides of its catalogue entry: `fleet/{vehicle_id}/vehicle`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, Meta(description="Time from which the message applies. [Unix s]")]
    model: Annotated[Name, Meta(description="Key of the vehicle model in the catalogue.")]
    nominal_capacity_kwh: Annotated[
        float | None, Meta(description="Rated energy of the new battery; replaces that of the catalogue. [kWh]")
    ] = None
    mass_kg: Annotated[float | None, Meta(description="Kerb mass; replaces that of the catalogue. [kg]")] = None
    drag_coefficient: Annotated[
        float | None, Meta(description="Drag coefficient; replaces that of the catalogue. [1]")
    ] = None
    frontal_area_m2: Annotated[float | None, Meta(description="Frontal area; replaces that of the catalogue. [m2]")] = (
        None
    )
    rolling_resistance: Annotated[
        float | None,
        Meta(
            description="Rolling resistance coefficient, warm tyres on dry asphalt; replaces that of the catalogue. [1]"
        ),
    ] = None
    period_s: Annotated[
        float | None,
        Meta(
            description="Time between two samples of the logger, 0.1 to 60 s; 0 for a logger without a period, which "
            "sends a sample when a value has changed, and at least every 60 s. Without it the period is estimated. [s]"
        ),
    ] = None
    in_service_date: Annotated[
        Name | None, Meta(description="Date of first registration, ISO 8601; accepted and not used.")
    ] = None


class Ride(Wire):
    """Begin or end of a ride, reported by dispatch: `fleet/{vehicle_id}/ride`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, Meta(description="Time at which the ride begins or ends. [Unix s]")]
    ride_id: Annotated[Name, Meta(description="Name of the ride, as in its telemetry.")]
    event: Annotated[Literal["start", "end"], Meta(description="Whether the ride begins (start) or ends (end).")]
    driver_id: Annotated[Name | None, Meta(description="Identity of the driver.")] = None


class Leg(Wire):
    """Leg of a plan: a ride, or a charge with `charge_to_soc_pct` in place of the distance.

    `socast.core.forecast.plan_checks` refuses a leg without a duration, and one that is neither a ride nor a charge.
    """

    distance_km: Annotated[float | None, Meta(description="Distance of a ride. [km]")] = None
    duration_s: Annotated[float, Meta(description="Duration of the leg. [s]")] = nan
    gained_m: Annotated[float | None, Meta(description="Sum of climbs; as usual of the fleet where unknown. [m]")] = (
        None
    )
    lost_m: Annotated[float | None, Meta(description="Sum of descents; as usual of the fleet where unknown. [m]")] = (
        None
    )
    charge_to_soc_pct: Annotated[float | None, Meta(description="State of charge up to which the car charges. [%]")] = (
        None
    )


class Plan(Wire):
    """Remaining legs of the shift, planned by dispatch: `fleet/{vehicle_id}/plan`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, Meta(description="Time at which the plan was made. [Unix s]")]
    shift_end_s: Annotated[float, Meta(description="Time at which the shift ends. [Unix s]")]
    reserve_soc_pct: Annotated[float, Meta(description="State of charge that must remain. [%]")]
    legs: Annotated[list[Leg], Meta(description="Remaining legs, in their order.")]


class Weather(Wire):
    """Observation of a weather station, or forecast for its place: `weather/{station_id}`."""

    station_id: Annotated[str, Meta(description="Identity of the station, as in the key.")]
    time_s: Annotated[float, Meta(description="Time of the observation, or for which a forecast is. [Unix s]")]
    latitude_deg: Annotated[float, Meta(description="Latitude of the station, WGS 84. [deg]")]
    longitude_deg: Annotated[float, Meta(description="Longitude of the station, WGS 84. [deg]")]
    temperature_c: Annotated[float | None, Meta(description="Air temperature. [degC]")] = None
    wind_speed_kmh: Annotated[float | None, Meta(description="Wind speed. [km/h]")] = None
    wind_from_deg: Annotated[
        float | None, Meta(description="Direction the wind blows from, north 0, east 90. [deg]")
    ] = None
    precipitation_mm: Annotated[
        float | None, Meta(description="Rain or melted snow since the last observation. [mm]")
    ] = None
    pressure_hpa: Annotated[float | None, Meta(description="Air pressure at sea level. [hPa]")] = None
    humidity_pct: Annotated[float | None, Meta(description="Relative humidity. [%]")] = None
    solar_w_m2: Annotated[float | None, Meta(description="Global horizontal irradiance. [W/m2]")] = None
    issued_s: Annotated[
        float | None, Meta(description="Time at which a forecast was issued; absent for an observation. [Unix s]")
    ] = None


class Interval(Wire, omit_defaults=False):
    """Predicted quantity: its mean and its 5th and 95th percentile, in the unit of the field."""

    mean: Annotated[float, Meta(description="Mean.")]
    p05: Annotated[float, Meta(description="5th percentile.")]
    p95: Annotated[float, Meta(description="95th percentile.")]


class NextCharge(Wire, omit_defaults=False):
    """Forecast for the beginning of the next planned charge."""

    time_s: Annotated[float, Meta(description="Time at which the car is expected to charge. [Unix s]")]
    soc_pct: Annotated[Interval, Meta(description="State of charge then. [%]")]
    reserve_risk: Annotated[
        float | None, Meta(description="Probability that the state of charge falls below the reserve before. [1]")
    ]


class QualityCounts(Wire, omit_defaults=False):
    """Samples repaired or rejected since the ride began, by cause."""

    repaired_time: Annotated[int, Meta(description="Samples with a repaired time stamp.")]
    rejected_speed: Annotated[int, Meta(description="Samples with a rejected speed.")]
    duplicate: Annotated[
        int, Meta(description="Samples that came too late, or with the stamp and content of the last one.")
    ]
    gap: Annotated[int, Meta(description="Gaps between samples.")]
    out_of_range: Annotated[int, Meta(description="Samples with a value outside its valid range.")]


class Forecast(Wire, omit_defaults=False):
    """Forecast for a vehicle, published by the consumer: `fleet/{vehicle_id}/forecast`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, Meta(description="Repaired time of the newest sample. [Unix s]")]
    ride_id: Annotated[
        str | None, Meta(description="Name of the ride in progress; null outside rides and where it has none.")
    ]
    model: Annotated[str, Meta(description="Name and version of the model.")]
    ride_distance_km: Annotated[float, Meta(description="Distance driven in the ride so far. [km]")]
    ride_duration_s: Annotated[float, Meta(description="Duration of the ride so far. [s]")]
    ride_energy_predicted_kwh: Annotated[float | None, Meta(description="Energy of the ride so far, predicted. [kWh]")]
    ride_energy_measured_kwh: Annotated[float | None, Meta(description="Energy of the ride so far, measured. [kWh]")]
    soc_pct: Annotated[float | None, Meta(description="Filtered state of charge. [%]")]
    soc_sd_pct: Annotated[float | None, Meta(description="Standard deviation of the filtered state of charge. [%]")]
    range_km: Annotated[
        Interval | None,
        Meta(description="Distance that the car can drive now, without a pause, down to the reserve. [km]"),
    ]
    soc_end_of_shift_pct: Annotated[Interval | None, Meta(description="State of charge at the end of the shift. [%]")]
    reserve_risk: Annotated[
        float | None,
        Meta(description="Probability that the state of charge falls below the reserve before the shift ends. [1]"),
    ]
    quality: Annotated[QualityCounts, Meta(description="Samples repaired or rejected since the ride began, by cause.")]
    next_charge: Annotated[
        NextCharge | UnsetType | None, Meta(description="The next planned charge; absent where none is ahead.")
    ] = UNSET
    shift_end_s: Annotated[
        float | None, Meta(description="End of the shift, by its plan or the car's usual shifts. [Unix s]")
    ] = None


class LegOutlook(Wire, omit_defaults=False):
    """Forecast for a leg of a plan."""

    distance_km: Annotated[float, Meta(description="Distance of the leg, as planned; 0 of a charge. [km]")]
    duration_s: Annotated[float, Meta(description="Duration of the leg, as planned. [s]")]
    energy_kwh: Annotated[Interval | None, Meta(description="Energy that the leg draws from the battery. [kWh]")]
    soc_pct: Annotated[Interval | None, Meta(description="State of charge at the end of the leg. [%]")]
    charge_to_soc_pct: Annotated[
        float | UnsetType | None,
        Meta(description="State of charge up to which the car charges; absent for a ride. [%]"),
    ] = UNSET
    reserve_risk: Annotated[
        float | UnsetType | None,
        Meta(description="Probability that a ride ends below the reserve; absent for a charge. [1]"),
    ] = UNSET

    def is_charge(self) -> bool:
        """Return whether the leg is a charge, and no ride."""
        return self.charge_to_soc_pct is not UNSET and self.charge_to_soc_pct is not None


class Outlook(Wire, omit_defaults=False):
    """Forecast for the rest of a shift, in reply to a query of `fleet/{vehicle_id}/outlook`."""

    vehicle_id: Annotated[str, Meta(description="Identity of the vehicle.")]
    time_s: Annotated[float, Meta(description="Repaired time of the newest sample that the outlook uses. [Unix s]")]
    model: Annotated[str, Meta(description="Name and version of the model.")]
    soc_pct: Annotated[float | None, Meta(description="Filtered state of charge. [%]")]
    soc_sd_pct: Annotated[float | None, Meta(description="Standard deviation of the filtered state of charge. [%]")]
    usable_capacity_kwh: Annotated[float | None, Meta(description="Usable capacity of the battery. [kWh]")]
    usable_capacity_sd_kwh: Annotated[
        float | None, Meta(description="Standard deviation of the usable capacity. [kWh]")
    ]
    consumption_scale: Annotated[
        float | None, Meta(description="Ratio of this car's consumption today to the model's prediction. [1]")
    ]
    asked: Annotated[LegOutlook | None, Meta(description="Candidate ride; null where the query has none.")]
    legs: Annotated[list[LegOutlook], Meta(description="Remaining legs of the plan, after the candidate ride.")]
    shift_end_s: Annotated[
        float | None,
        Meta(description="Time at which the shift ends, by the plan or by the car's usual shifts. [Unix s]"),
    ]
    soc_end_of_shift_pct: Annotated[
        Interval | None, Meta(description="State of charge at the end of the shift, including the candidate ride. [%]")
    ]
    reserve_soc_pct: Annotated[float, Meta(description="Reserve of the plan, or the usual one. [%]")]
    reserve_risk: Annotated[
        float | None,
        Meta(
            description="Probability that the state of charge falls below the reserve before the shift ends, "
            "including the candidate ride. [1]"
        ),
    ]
    why_not: Annotated[str | None, Meta(description="Reason for which any of these is null, in words.")]
    next_charge: Annotated[
        NextCharge | UnsetType | None, Meta(description="The next planned charge; absent where none is ahead.")
    ] = UNSET
    waiting_energy_kwh: Annotated[
        float | None,
        Meta(
            description="Energy of waits, with heating, and of empty ways until the next planned charge, or else the "
            "end of the shift; null without a plan. [kWh]"
        ),
    ] = None


class Gain(Wire, omit_defaults=False):
    """By how much a model's error is smaller than the first model's, over whole vehicle-days that both predicted."""

    rides: Annotated[int, Meta(description="Rides that both models predicted, of vehicle-days that have ended.")]
    vehicle_days: Annotated[int, Meta(description="Vehicle-days that have ended.")]
    mean_kwh: Annotated[
        float | None,
        Meta(
            description="Mean per ride of the first model's absolute error less this model's; "
            "null before a vehicle-day has ended. [kWh]"
        ),
    ]
    lower_kwh: Annotated[
        float | None,
        Meta(description="Lower end of its 95 % interval; null where too few vehicle-days have ended. [kWh]"),
    ]
    upper_kwh: Annotated[
        float | None,
        Meta(description="Upper end of its 95 % interval; null where too few vehicle-days have ended. [kWh]"),
    ]
    verdict: Annotated[
        Literal["better", "worse", "undecided"],
        Meta(description="`better` or `worse` where the interval excludes zero."),
    ]


class RideErrors(Wire, omit_defaults=False):
    """Running errors of a model, over rides that are fit for training and whose energy was measured."""

    vehicle_model: Annotated[str | None, Meta(description="Vehicle model of the rides; null for all rides.")]
    rides: Annotated[int, Meta(description="Rides that the model predicted.")]
    unpredicted_rides: Annotated[int, Meta(description="Rides that the model could not predict.")]
    mae_kwh: Annotated[float | None, Meta(description="Mean absolute error per ride. [kWh]")]
    mae_pct: Annotated[float | None, Meta(description="Sum of absolute errors over the sum of measured energies. [%]")]
    bias_kwh: Annotated[float | None, Meta(description="Mean of predicted less measured energy per ride. [kWh]")]
    gain: Annotated[
        Gain | None,
        Meta(description="Reduction of the error against the first model; null for the first model itself."),
    ]


class ModelErrors(Wire, omit_defaults=False):
    """How a model fares in service, published as rides end: `models/{name}/{version}/errors`."""

    model: Annotated[str, Meta(description="Name and version of the model.")]
    first: Annotated[str, Meta(description="Name and version of the model that makes the forecasts.")]
    time_s: Annotated[float, Meta(description="End of the last ride that counts. [Unix s]")]
    overall: Annotated[RideErrors, Meta(description="Errors over all rides.")]
    by_vehicle_model: Annotated[
        list[RideErrors], Meta(description="Errors by vehicle model, in the order in which they were first met.")
    ]


class Cause(Wire, omit_defaults=False):
    """Possible cause of what a diagnosis found."""

    effect: Annotated[str, Meta(description="Name of the effect.")]
    probability: Annotated[float, Meta(description="Probability that it is the cause. [1]")]


class Finding(Wire, omit_defaults=False):
    """What the nightly diagnosis found: `findings/{who}/{effect}`, when it becomes sure and when it is gone."""

    who: Annotated[str, Meta(description="Vehicle, group or driver that it is about; `all` for all vehicles.")]
    effect: Annotated[str, Meta(description="Most probable cause when it was first found.")]
    time_s: Annotated[float, Meta(description="End of the last day that was diagnosed. [Unix s]")]
    status: Annotated[
        Literal["proposed", "sure", "gone"],
        Meta(
            description="`sure` from a probability of 90 % on, if the interval of the share excludes zero and "
            "repeated looks do not explain it; `gone` if a later diagnosis no longer finds it."
        ),
    ]
    probability: Annotated[float, Meta(description="Probability that the finding is real. [1]")]
    causes: Annotated[list[Cause], Meta(description="Causes that hold 90 % of the probability.")]
    first_seen: Annotated[str, Meta(description="Last day of the diagnosis that found it first. [UTC date]")]
    sure_since: Annotated[str | None, Meta(description="Last day of the diagnosis that was sure first. [UTC date]")]
    since: Annotated[str | None, Meta(description="Day on which a change began; null for no change. [UTC date]")]
    share: Annotated[float | None, Meta(description="Energy that it takes, over all energy. [1]")]
    share_lower: Annotated[float | None, Meta(description="Lower end of the 95 % interval of the share. [1]")]
    share_upper: Annotated[float | None, Meta(description="Upper end of the 95 % interval of the share. [1]")]
    kwh_per_month: Annotated[float | None, Meta(description="Energy that it takes in a month. [kWh]")]
    range_km_per_month: Annotated[
        float | None, Meta(description="Distance that the fleet drives with this energy on average. [km]")
    ]
    words: Annotated[str, Meta(description="The finding as a sentence.")]
    commands: Annotated[
        list[str],
        Meta(
            description="Commands that add it to the model and run this model as a shadow; empty if no term holds it."
        ),
    ]


OF_VEHICLES: Final[dict[str, type[Wire]]] = {
    "telemetry": Telemetry,
    "vehicle": Vehicle,
    "ride": Ride,
    "plan": Plan,
    "forecast": Forecast,
}
"""Last chunk of a vehicle's key -> struct of its message."""
BATCH: Final = "batch"
"""Last chunk of the key of a gateway's batches, whose payload is Arrow, see `socast.core.wire.arrow_batch`."""
KINDS: Final[dict[str, type[Wire]]] = OF_VEHICLES | {"weather": Weather, "errors": ModelErrors, "finding": Finding}
"""Kind of message -> its struct."""


class Address(NamedTuple):
    """Parts of a key: the kind of message, and the vehicle, gateway, station, model or finding that it is about.

    A model includes its version, and a finding consists of who and effect.
    """

    kind: str
    identity: str


@lru_cache(maxsize=1 << 16)
def address(key: str) -> Address | None:
    """Return the parts of a key, None for a key that is not of the contract. Chunks before it are a prefix.

    >>> address("montreal/fleet/taxi-7/telemetry")
    Address(kind='telemetry', identity='taxi-7')
    >>> address("weather/yul")
    Address(kind='weather', identity='yul')
    >>> address("models/hybrid/2/errors")
    Address(kind='errors', identity='hybrid/2')
    >>> address("findings/taxi-7/tyre_pressure")
    Address(kind='finding', identity='taxi-7/tyre_pressure')
    >>> address("fleet/depot-3/batch")
    Address(kind='batch', identity='depot-3')
    >>> address("fleet/taxi-7/lunch") is None
    True
    """
    chunks = key.split("/")
    if len(chunks) >= 2 and chunks[-2] == "weather" and IDENTITY.fullmatch(chunks[-1]):
        return Address("weather", chunks[-1])
    is_of_fleet = len(chunks) >= 3 and chunks[-3] == "fleet" and (chunks[-1] in OF_VEHICLES or chunks[-1] == BATCH)
    if is_of_fleet and IDENTITY.fullmatch(chunks[-2]):
        return Address(chunks[-1], chunks[-2])
    if (
        len(chunks) >= 4
        and chunks[-4] == "models"
        and chunks[-1] == "errors"
        and all(map(IDENTITY.fullmatch, chunks[-3:-1]))
    ):
        return Address("errors", "/".join(chunks[-3:-1]))
    if len(chunks) >= 3 and chunks[-3] == "findings" and all(map(IDENTITY.fullmatch, chunks[-2:])):
        return Address("finding", "/".join(chunks[-2:]))
    return None


def identify_model(model: str) -> str:
    """Return name and version of a model as chunks of a key, with all other characters replaced.

    >>> identify_model("hybrid interactions/2")
    'hybrid_interactions/2'
    """
    name, _, version = model.rpartition("/")
    return join_chunks(name, version)


def join_chunks(*names: str) -> str:
    """Return names as chunks of a key, with all characters replaced that a name on the wire does not have.

    >>> join_chunks("depot north", "tyre_pressure")
    'depot_north/tyre_pressure'
    """
    return "/".join(re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:64] or "_" for name in names)


def identity(value: Wire) -> str:
    """Return the vehicle, station, model or finding that a message is about, as its key names it."""
    named = _NAMES.get(type(value))
    if named is None:
        raise TypeError(f"{type(value).__name__} does not travel by itself")
    return named(value)


_NAMES: Final[dict[type[Wire], Callable[[Any], str]]] = {
    **dict.fromkeys(OF_VEHICLES.values(), attrgetter("vehicle_id")),
    Weather: attrgetter("station_id"),
    ModelErrors: lambda errors: identify_model(errors.model),
    Finding: lambda finding: join_chunks(finding.who, finding.effect),
}
"""Struct -> function that returns the identity in a message."""


def encode(value: Wire) -> bytes:
    """Return the payload of a wire struct."""
    return msgspec.json.encode(value)
