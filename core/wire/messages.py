"""Structs of the messages on the wire, field by field, and the keys under which they travel.

Names of fields carry their units. `socast.core.wire.decoder` turns payloads into columns in SI units.
"""

import re
from functools import lru_cache
from math import nan
from typing import Annotated, Final, Literal, NamedTuple

import msgspec
from msgspec import UNSET, Meta, UnsetType

from socast.core.columns import PowerSpan
from socast.core.wire.live_fields import LiveDisplay, Packing, TerminalHead, means

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

    vehicle_id: Annotated[str, means("Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, means("Time on the logger's own clock. [Unix s]")]
    ride_id: Annotated[
        Name | None, means("The logger's name of the ride in progress; null or absent between rides.")
    ] = None
    seq: Annotated[Count | None, means("The logger's sample counter.")] = None
    latitude_deg: Annotated[float | None, means("Latitude, WGS 84. [deg]")] = None
    longitude_deg: Annotated[float | None, means("Longitude, WGS 84. [deg]")] = None
    elevation_m: Annotated[float | None, means("Elevation above sea level. [m]")] = None
    speed_kmh: Annotated[float | None, means("Ground speed. [km/h]")] = None
    odometer_km: Annotated[float | None, means("Odometer. [km]")] = None
    soc_pct: Annotated[float | None, means("State of charge as displayed. [%]")] = None
    battery_voltage_v: Annotated[float | None, means("Voltage of the traction battery. [V]")] = None
    battery_current_a: Annotated[
        float | None, means("Current of the traction battery, positive when discharging. [A]")
    ] = None
    battery_temperature_c: Annotated[float | None, means("Temperature of the traction battery. [degC]")] = None
    ambient_c: Annotated[float | None, means("Temperature of the outside air. [degC]")] = None
    hvac_w: Annotated[float | None, means("Power of heating and air conditioning. [W]")] = None
    occupants: Annotated[Count | None, means("Number of people aboard, including the driver.")] = None
    charging: Annotated[bool | None, means("Whether the car is plugged in and charging.")] = None


class Vehicle(Wire):
    """Vehicle model of a car, and overrides of its catalogue entry: `fleet/{vehicle_id}/vehicle`."""

    vehicle_id: Annotated[str, means("Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, means("Time from which the message applies. [Unix s]")]
    model: Annotated[Name, means("Key of the vehicle model in the catalogue.")]
    nominal_capacity_kwh: Annotated[
        float | None, means("Rated energy of the new battery; replaces that of the catalogue. [kWh]")
    ] = None
    mass_kg: Annotated[float | None, means("Kerb mass; replaces that of the catalogue. [kg]")] = None
    drag_coefficient: Annotated[float | None, means("Drag coefficient; replaces that of the catalogue. [1]")] = None
    frontal_area_m2: Annotated[float | None, means("Frontal area; replaces that of the catalogue. [m2]")] = None
    rolling_resistance: Annotated[
        float | None,
        means("Rolling resistance coefficient, warm tyres on dry asphalt; replaces that of the catalogue. [1]"),
    ] = None
    period_s: Annotated[
        float | None,
        means(
            "Time between two samples of the logger, 0.1 to 60 s; 0 for a logger without a period, which "
            "sends a sample when a value has changed, and at least every 60 s. Without it the period is estimated. [s]"
        ),
    ] = None
    power_covers: Annotated[
        PowerSpan | None,
        means(
            "What voltage times current of a sample is: the power of its moment (`moment`, as without the field), or "
            "the mean over the period that ends at it (`before`), has it in its middle (`around`), or begins at it "
            "(`after`)."
        ),
    ] = None
    in_service_date: Annotated[Name | None, means("Date of first registration, ISO 8601; accepted and not used.")] = (
        None
    )


class Ride(Wire):
    """Begin or end of a ride, reported by dispatch: `fleet/{vehicle_id}/ride`."""

    vehicle_id: Annotated[str, means("Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, means("Time at which the ride begins or ends. [Unix s]")]
    ride_id: Annotated[Name, means("Name of the ride, as in its telemetry.")]
    event: Annotated[Literal["start", "end"], means("Whether the ride begins (start) or ends (end).")]
    driver_id: Annotated[Name | None, means("Identity of the driver.")] = None


class Leg(Wire):
    """Leg of a plan: a ride, or a charge with `charge_to_soc_pct` in place of the distance.

    `socast.core.wire.plan_checks` refuses a leg without a duration, and one that is neither a ride nor a charge.
    """

    distance_km: Annotated[float | None, means("Distance of a ride. [km]")] = None
    duration_s: Annotated[float, means("Duration of the leg. [s]")] = nan
    gained_m: Annotated[float | None, means("Sum of climbs; as usual of the fleet where unknown. [m]")] = None
    lost_m: Annotated[float | None, means("Sum of descents; as usual of the fleet where unknown. [m]")] = None
    charge_to_soc_pct: Annotated[float | None, means("State of charge up to which the car charges. [%]")] = None


class Plan(Wire):
    """Remaining legs of the shift, planned by dispatch: `fleet/{vehicle_id}/plan`."""

    vehicle_id: Annotated[str, means("Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, means("Time at which the plan was made. [Unix s]")]
    shift_end_s: Annotated[float, means("Time at which the shift ends. [Unix s]")]
    reserve_soc_pct: Annotated[float, means("State of charge that must remain. [%]")]
    legs: Annotated[list[Leg], means("Remaining legs, in their order.")]


class Weather(Wire):
    """Observation of a weather station, or forecast for its place: `weather/{station_id}`."""

    station_id: Annotated[str, means("Identity of the station, as in the key.")]
    time_s: Annotated[float, means("Time of the observation, or for which a forecast is. [Unix s]")]
    latitude_deg: Annotated[float, means("Latitude of the station, WGS 84. [deg]")]
    longitude_deg: Annotated[float, means("Longitude of the station, WGS 84. [deg]")]
    temperature_c: Annotated[float | None, means("Air temperature. [degC]")] = None
    wind_speed_kmh: Annotated[float | None, means("Wind speed. [km/h]")] = None
    wind_from_deg: Annotated[float | None, means("Direction the wind blows from, north 0, east 90. [deg]")] = None
    precipitation_mm: Annotated[float | None, means("Rain or melted snow since the last observation. [mm]")] = None
    pressure_hpa: Annotated[float | None, means("Air pressure at sea level. [hPa]")] = None
    humidity_pct: Annotated[float | None, means("Relative humidity. [%]")] = None
    solar_w_m2: Annotated[float | None, means("Global horizontal irradiance. [W/m2]")] = None
    issued_s: Annotated[
        float | None, means("Time at which a forecast was issued; absent for an observation. [Unix s]")
    ] = None


class Interval(Wire, omit_defaults=False):
    """Predicted quantity: its mean and its 5th and 95th percentile, in the unit of the field."""

    mean: Annotated[float, means("Mean.")]
    p05: Annotated[float, means("5th percentile.")]
    p95: Annotated[float, means("95th percentile.")]


class NextCharge(Wire, omit_defaults=False):
    """Forecast for the beginning of the next planned charge."""

    time_s: Annotated[float, means("Time at which the car is expected to charge. [Unix s]")]
    soc_pct: Annotated[Interval, means("State of charge then. [%]")]
    reserve_risk: Annotated[
        float | None, means("Probability that the state of charge falls below the reserve before. [1]")
    ]


class QualityCounts(Wire, omit_defaults=False):
    """Samples repaired or rejected since the ride began, by cause."""

    repaired_time: Annotated[int, means("Samples with a repaired time stamp.")]
    rejected_speed: Annotated[int, means("Samples with a rejected speed.")]
    duplicate: Annotated[int, means("Samples that came too late, or with the stamp and content of the last one.")]
    gap: Annotated[int, means("Gaps between samples.")]
    out_of_range: Annotated[int, means("Samples with a value outside its valid range.")]


class Forecast(Wire, omit_defaults=False):
    """Forecast for a vehicle, published by the consumer: `fleet/{vehicle_id}/forecast`."""

    # A further output is declared here with a default, so that forecasts of earlier versions can be read, and computed
    # as a column of `socast.core.forecast.forecast_rows.FORECAST_ROW`. The state, the terminal, the board of the
    # workbench and the pages of reference derive it; the table of outlooks and log lines name their fields.
    vehicle_id: Annotated[str, means("Identity of the vehicle, as in the key.")]
    time_s: Annotated[float, means("Repaired time of the newest sample. [Unix s]")]
    ride_id: Annotated[str | None, means("Name of the ride in progress; null outside rides and where it has none.")]
    model: Annotated[str, means("Name and version of the model.")]
    ride_distance_km: Annotated[
        float,
        means(
            "Distance driven in the ride so far. [km]",
            LiveDisplay("Ride", digits=1, packing=Packing("u2", 0.01), terminal=TerminalHead("ride\nkm", 2)),
        ),
    ]
    ride_duration_s: Annotated[float, means("Duration of the ride so far. [s]", LiveDisplay())]
    ride_energy_predicted_kwh: Annotated[
        float | None,
        means(
            "Energy of the ride so far, predicted. [kWh]",
            LiveDisplay("Predicted", digits=2, packing=Packing("i2", 0.01), terminal=TerminalHead("predicted\nkWh", 3)),
        ),
    ]
    ride_energy_measured_kwh: Annotated[
        float | None,
        means(
            "Energy of the ride so far, measured. [kWh]",
            LiveDisplay("Measured", digits=2, packing=Packing("i2", 0.01), terminal=TerminalHead("measured\nkWh", 3)),
        ),
    ]
    soc_pct: Annotated[
        float | None,
        means(
            "Filtered state of charge. [%]",
            LiveDisplay("Charge", "charge now", digits=1, narrow=True, packing=Packing("u2", 0.1)),
        ),
    ]
    soc_sd_pct: Annotated[float | None, means("Standard deviation of the filtered state of charge. [%]", LiveDisplay())]
    range_km: Annotated[
        Interval | None,
        means(
            "Distance that the car can drive now, without a pause, down to the reserve. [km]",
            LiveDisplay("Range", "range to the reserve", packing=Packing("u2", 0.1)),
        ),
    ]
    soc_end_of_shift_pct: Annotated[
        Interval | None,
        means(
            "State of charge at the end of the shift. [%]",
            LiveDisplay(
                "End of shift",
                "at the end of the shift",
                narrow=True,
                of_shift=True,
                packing=Packing("u1", 0.5, bounds=True),
                terminal=TerminalHead("at shift's\nend %"),
            ),
        ),
    ]
    reserve_risk: Annotated[
        float | None,
        means(
            "Probability that the state of charge falls below the reserve before the shift ends. [1]",
            LiveDisplay("Risk", "risk of the reserve", narrow=True, of_shift=True, packing=Packing("u1", 0.005)),
        ),
    ]
    quality: Annotated[QualityCounts, means("Samples repaired or rejected since the ride began, by cause.")]
    next_charge: Annotated[
        NextCharge | UnsetType | None, means("The next planned charge; absent where none is ahead.")
    ] = UNSET
    shift_end_s: Annotated[
        float | None,
        means("End of the shift, by its plan or the car's earlier shifts. [Unix s]", LiveDisplay()),
    ] = None


class LegOutlook(Wire, omit_defaults=False):
    """Forecast for a leg of a plan."""

    distance_km: Annotated[float, means("Distance of the leg, as planned; 0 of a charge. [km]")]
    duration_s: Annotated[float, means("Duration of the leg, as planned. [s]")]
    energy_kwh: Annotated[Interval | None, means("Energy that the leg draws from the battery. [kWh]")]
    soc_pct: Annotated[Interval | None, means("State of charge at the end of the leg. [%]")]
    charge_to_soc_pct: Annotated[
        float | UnsetType | None, means("State of charge up to which the car charges; absent for a ride. [%]")
    ] = UNSET
    reserve_risk: Annotated[
        float | UnsetType | None, means("Probability that a ride ends below the reserve; absent for a charge. [1]")
    ] = UNSET

    def is_charge(self) -> bool:
        """Return whether the leg is a charge, and no ride."""
        return self.charge_to_soc_pct is not UNSET and self.charge_to_soc_pct is not None


class Outlook(Wire, omit_defaults=False):
    """Forecast for the rest of a shift, in reply to a query of `fleet/{vehicle_id}/outlook`."""

    vehicle_id: Annotated[str, means("Identity of the vehicle.")]
    time_s: Annotated[float, means("Repaired time of the newest sample that the outlook uses. [Unix s]")]
    model: Annotated[str, means("Name and version of the model.")]
    soc_pct: Annotated[float | None, means("Filtered state of charge. [%]")]
    soc_sd_pct: Annotated[float | None, means("Standard deviation of the filtered state of charge. [%]")]
    usable_capacity_kwh: Annotated[float | None, means("Usable capacity of the battery. [kWh]")]
    usable_capacity_sd_kwh: Annotated[float | None, means("Standard deviation of the usable capacity. [kWh]")]
    consumption_scale: Annotated[
        float | None,
        means("Ratio of this car's consumption today to that of its vehicle model at the outside temperature. [1]"),
    ]
    asked: Annotated[LegOutlook | None, means("Candidate ride; null where the query has none.")]
    legs: Annotated[list[LegOutlook], means("Remaining legs of the plan, after the candidate ride.")]
    shift_end_s: Annotated[
        float | None, means("Time at which the shift ends, by the plan or by the car's earlier shifts. [Unix s]")
    ]
    soc_end_of_shift_pct: Annotated[
        Interval | None, means("State of charge at the end of the shift, including the candidate ride. [%]")
    ]
    reserve_soc_pct: Annotated[float, means("Reserve of the plan, or the usual one. [%]")]
    reserve_risk: Annotated[
        float | None,
        means(
            "Probability that the state of charge falls below the reserve before the shift ends, "
            "including the candidate ride. [1]"
        ),
    ]
    why_not: Annotated[str | None, means("Reason for which any of these is null, in words.")]
    next_charge: Annotated[
        NextCharge | UnsetType | None, means("The next planned charge; absent where none is ahead.")
    ] = UNSET
    waiting_energy_kwh: Annotated[
        float | None,
        means(
            "Energy of waits, with heating, and of empty ways until the next planned charge, or else the "
            "end of the shift, with the way home that no plan tells; null without a plan. [kWh]"
        ),
    ] = None


class Gain(Wire, omit_defaults=False):
    """By how much a model's error is smaller than the first model's, over whole vehicle-days that both predicted."""

    rides: Annotated[int, means("Rides that both models predicted, of vehicle-days that have ended.")]
    vehicle_days: Annotated[int, means("Vehicle-days that have ended.")]
    mean_kwh: Annotated[
        float | None,
        means(
            "Mean per ride of the first model's absolute error less this model's; "
            "null before a vehicle-day has ended. [kWh]"
        ),
    ]
    lower_kwh: Annotated[
        float | None, means("Lower end of its 95 % interval; null where too few vehicle-days have ended. [kWh]")
    ]
    upper_kwh: Annotated[
        float | None, means("Upper end of its 95 % interval; null where too few vehicle-days have ended. [kWh]")
    ]
    verdict: Annotated[
        Literal["better", "worse", "undecided"], means("`better` or `worse` where the interval excludes zero.")
    ]


class RideErrors(Wire, omit_defaults=False):
    """Running errors of a model, over rides that are fit for training and whose energy was measured."""

    vehicle_model: Annotated[str | None, means("Vehicle model of the rides; null for all rides.")]
    rides: Annotated[int, means("Rides that the model predicted.")]
    unpredicted_rides: Annotated[int, means("Rides that the model could not predict.")]
    mae_kwh: Annotated[float | None, means("Mean absolute error per ride. [kWh]")]
    mae_pct: Annotated[float | None, means("Sum of absolute errors over the sum of measured energies. [%]")]
    bias_kwh: Annotated[float | None, means("Mean of predicted less measured energy per ride. [kWh]")]
    gain: Annotated[
        Gain | None, means("Reduction of the error against the first model; null for the first model itself.")
    ]


class ModelErrors(Wire, omit_defaults=False):
    """Errors of a model in service, published as rides end: `models/{name}/{version}/errors`."""

    model: Annotated[str, means("Name and version of the model.")]
    first: Annotated[str, means("Name and version of the model that makes the forecasts.")]
    time_s: Annotated[float, means("End of the last ride that counts. [Unix s]")]
    overall: Annotated[RideErrors, means("Errors over all rides.")]
    by_vehicle_model: Annotated[
        list[RideErrors], means("Errors by vehicle model, in the order in which they were first met.")
    ]


class Cause(Wire, omit_defaults=False):
    """Possible cause of what a diagnosis found."""

    effect: Annotated[str, means("Name of the effect.")]
    probability: Annotated[float, means("Probability that it is the cause. [1]")]


class Finding(Wire, omit_defaults=False):
    """What the nightly diagnosis found: `findings/{who}/{effect}`, when it becomes sure and when it is gone."""

    who: Annotated[str, means("Vehicle, group or driver that it is about; `all` for all vehicles.")]
    effect: Annotated[str, means("Most probable cause when it was first found.")]
    time_s: Annotated[float, means("End of the last day that was diagnosed. [Unix s]")]
    status: Annotated[
        Literal["proposed", "sure", "gone"],
        means(
            "`sure` from a probability of 90 % on, if the interval of the share excludes zero and "
            "repeated looks do not explain it; `gone` if a later diagnosis no longer finds it."
        ),
    ]
    probability: Annotated[float, means("Probability that the finding is real. [1]")]
    causes: Annotated[list[Cause], means("Causes that hold 90 % of the probability.")]
    first_seen: Annotated[str, means("Last day of the diagnosis that found it first. [UTC date]")]
    sure_since: Annotated[str | None, means("Last day of the diagnosis that was sure first. [UTC date]")]
    since: Annotated[str | None, means("Day on which a change began; null for no change. [UTC date]")]
    share: Annotated[float | None, means("Energy that it takes, over all energy. [1]")]
    share_lower: Annotated[float | None, means("Lower end of the 95 % interval of the share. [1]")]
    share_upper: Annotated[float | None, means("Upper end of the 95 % interval of the share. [1]")]
    kwh_per_month: Annotated[float | None, means("Energy that it takes in a month. [kWh]")]
    range_km_per_month: Annotated[
        float | None, means("Distance that the fleet drives with this energy on average. [km]")
    ]
    words: Annotated[str, means("The finding as a sentence.")]
    commands: Annotated[
        list[str], means("Commands that add it to the model and run this model as a shadow; empty if no term holds it.")
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
    match key.split("/"):
        case [*_, "weather", station]:
            found = Address("weather", station)
        case [*_, "fleet", vehicle, kind] if kind in OF_VEHICLES or kind == BATCH:
            found = Address(kind, vehicle)
        case [*_, "models", name, version, "errors"]:
            found = Address("errors", f"{name}/{version}")
        case [*_, "findings", who, effect]:
            found = Address("finding", f"{who}/{effect}")
        case _:
            return None
    return found if all(map(IDENTITY.fullmatch, found.identity.split("/"))) else None


def encode(value: Wire) -> bytes:
    """Return the payload of a wire struct."""
    return msgspec.json.encode(value)
