"""Describe in sentences where the error of a model lives, and what would show its cause."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from socast.core.diagnose.records import Diagnosis, ErrorLocation, LocatedLoad
from socast.tools.report.table import format_count, format_percent

UNITS: Final = {
    "ride": "ride",
    "day": "vehicle-day",
    "driver": "driver",
    "date": "date, alike in all vehicles,",
    "car": "vehicle",
}
"""A unit of each level, after `Each`."""
LOADS: Final = {
    "constant": "has its own constant load of ±{size}",
    "rolling": "has its own rolling resistance, ±{size} of that of the catalogue",
    "drag": "has its own air drag, ±{size} of that of the catalogue",
    "climbing": "uses its own energy per metre climbed, ±{size} of the energy of the climb",
    "braking": "loses its own share of the braking energy, ±{size} of it",
    "beginning": "has its own load of ±{size} at the beginning of rides, which decays within about five minutes",
}
"""What the units of a level differ in."""
KIND_NAMES: Final = {
    "constant": "per second",
    "rolling": "per km",
    "drag": "per km and speed squared",
    "climbing": "per metre climbed",
    "braking": "per braking",
    "beginning": "at the beginning of a ride",
}
"""Short names of the kinds."""
LEVEL_NAMES: Final = {"ride": "ride", "day": "vehicle-day", "driver": "driver", "date": "date", "car": "vehicle"}
"""Short names of the levels."""
CAUSES: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = {
    "constant": {
        "ride": ("something that a person switches, such as heating or air conditioning", "Log the climate power."),
        "day": (
            "something that stays on for a day: a climate setting, or weather that no column describes",
            "Log the climate power, sunshine and humidity.",
        ),
        "driver": ("a habit of the driver, such as the climate setting", "Log the climate power."),
        "date": ("weather that no column describes", "Log sunshine, humidity and precipitation."),
        "car": ("a device or a standby load of the vehicle", "Measure the power of the standing vehicles."),
    },
    "rolling": {
        "ride": ("a load or a road surface that changes from ride to ride", "Log occupants and payload."),
        "day": ("tyre pressure, or a wet or snowy road", "Log tyre pressure and precipitation."),
        "driver": ("the way of driving, or the usual load of the driver", "Log payload, and speed more often."),
        "date": ("the state of the roads: wet, snowy or cold", "Log precipitation and road temperature."),
        "car": ("tyres, wheel alignment or dragging brakes", "Check tyre pressure and brakes of these vehicles."),
    },
    "drag": {
        "ride": ("wind, an open window, or speed that is measured wrongly", "Log wind near the road."),
        "day": ("wind, or something on the roof for a day", "Log wind near the road, and roof loads."),
        "driver": ("open windows, or a roof load of the driver", "Ask these drivers."),
        "date": ("wind or air density", "Log wind and air pressure from a station nearby."),
        "car": ("a roof load, or a body that differs", "Look at these vehicles."),
    },
    "climbing": {
        "ride": ("payload, or elevation that is wrong", "Log payload, and use a map of elevation."),
        "day": ("payload, or the calibration of the barometer", "Log payload, and use a map of elevation."),
        "driver": ("payload", "Log payload."),
        "date": ("air pressure that is taken for elevation", "Use a map of elevation."),
        "car": ("the mass of the vehicle, or its elevation sensor", "Weigh these vehicles."),
    },
    "braking": {
        "ride": ("a limit of regeneration, such as a full or cold battery", "Log the limit of the charging power."),
        "day": ("regeneration limited by the cold, or its setting", "Log the limit and the setting of regeneration."),
        "driver": ("the way of braking, or the setting of regeneration", "Log the setting of regeneration."),
        "date": ("regeneration limited by the cold", "Log battery temperature and the charging limit."),
        "car": ("the setting or the software of regeneration", "Compare the settings of these vehicles."),
    },
    "beginning": {
        "ride": (
            "warming up or cooling down of the cabin, or of the drive",
            "Log the climate power and the time parked.",
        ),
        "day": ("warming up that depends on the day, such as an icy windscreen", "Log the climate power."),
        "driver": ("a habit of the driver, such as heating before the drive", "Log the climate power."),
        "date": ("warming up that depends on the weather", "Log the climate power and humidity."),
        "car": ("the heater of the vehicle", "Log the climate power."),
    },
}
"""Likely cause and remedy of each kind of load, by level."""
JUDGED_BY: Final = {
    "elevation": "climbing",
    "wind": "wind",
    "precipitation": "wet or snowy roads",
    "humidity": "drying of the air",
    "outside temperature": "heating and cooling by temperature",
    "time parked": "a cabin that cooled down before the ride",
    "occupants": "payload",
    "battery temperature": "a cold battery",
    "driver": "differences between drivers",
    "climate power": "how much of an error the climate control causes",
}
"""What cannot be judged without a signal."""
TELEMETRY: Final = "fleet/{vehicle}/telemetry"
WEATHER: Final = "weather/{station}"
FIELDS: Final[Mapping[str, tuple[str, str]]] = {
    "elevation": ("elevation_m", TELEMETRY),
    "outside temperature": ("ambient_c", TELEMETRY),
    "occupants": ("occupants", TELEMETRY),
    "battery temperature": ("battery_temperature_c", TELEMETRY),
    "climate power": ("hvac_w", TELEMETRY),
    "driver": ("driver_id", "fleet/{vehicle}/ride"),
    "wind": ("wind_speed_kmh and wind_from_deg", WEATHER),
    "precipitation": ("precipitation_mm", WEATHER),
    "humidity": ("humidity_pct", WEATHER),
}
"""Fields that hold each signal, and the topic whose messages have them."""
NONE_ABSENT: Final[Mapping[str, str]] = MappingProxyType({})
LEAST_SHARE: Final = 0.005
"""Least share of the squared error that is mentioned."""


def format_size(value: float, unit: str) -> str:
    """Return a size with its unit.

    Examples
    --------
    >>> format_size(1478.5, "W"), format_size(22.6, "%")
    ('1,480 W', '23 %')
    """
    if unit != "W":
        return f"{value:.0f} %"
    return f"{float(f'{value:.3g}'):,.0f} W" if value >= 1000.0 else f"{value:.0f} W"


def describe_location(result: Diagnosis) -> list[str]:
    """Return where the error of a model lives, a line for each load, and what the data cannot show."""
    location = result.error_location
    known_in = dict.fromkeys(location.absent_signals, "")  # in which rides a signal is known, in words
    known_in |= {
        each: f"{format_count(counts[0])} of {format_count(counts[1])} rides"
        for each, counts in location.partial_signals.items()
        if each in known_in
    }
    lines = describe_shares(location)
    lines += [describe_load(load, known_in) for load in location.loads]
    if not location.loads and location.estimates:
        lines.append("No load differs between rides, days or vehicles beyond what sampling causes.")
    if known_in:
        unseen = (
            f"{JUDGED_BY[each]} ({f'{each} in {rides} only' if rides else f'no {each}'})"
            for each, rides in known_in.items()
            if each in JUDGED_BY
        )
        lines.append(f"These data cannot show {', '.join(unseen)}.")
    return lines


def describe_load(load: LocatedLoad, absent: Mapping[str, str] = NONE_ABSENT) -> str:
    """Return a load in a person's words, with its likely cause and a remedy.

    Parameters
    ----------
    absent : mapping of str to str
        Signals that most rides lack, each with the rides that have it in words, such as `15 of 31 rides`.
    """
    level, kind = load.level, load.kind
    size, low, high = (format_size(value, load.unit) for value in (load.size, load.low, load.high))
    what = LOADS[kind].format(size=size)
    cause, remedy = CAUSES[kind][level]
    if "climate power" in remedy and "climate power" not in absent:
        remedy = "The drives contain the measured climate power: compare it."
    elif "climate power" in remedy and (rides := absent["climate power"]):
        remedy = f"{rides} contain the measured climate power: compare it there. {remedy}"
    mean = "" if kind == "constant" else f", {load.size_w:.0f} W on average"
    text = (
        f"Each {UNITS[level]} {what} (95 % interval {low.removesuffix(' W').removesuffix(' %')} to {high}{mean}), "
        f"which the model does not explain: {cause}. {remedy}"
    )
    rivals = [KIND_NAMES[each] for each in load.other_kinds]
    rivals += [f"per {LEVEL_NAMES[each]}" for each in load.other_levels]
    return f"{text} Not distinguishable from a load {' or '.join(rivals)}." if rivals else text


def advise_recording(result: Diagnosis) -> list[str]:
    """Return the fields of absent signals that would show the cause of a load, and where they are documented."""
    location = result.error_location
    remedies = [CAUSES[load.kind][load.level][1] for load in location.loads]
    wanted = [name for name in location.absent_signals if name in FIELDS and any(name in each for each in remedies)]
    if not wanted:
        return []
    fields = ", ".join(f"{FIELDS[name][0]} in {FIELDS[name][1]} ({name})" for name in wanted)
    documented = "docs/reference/wire.md documents fields and topics, docs/guide/import.md the columns of CSV files"
    return [f"Record {fields}: {documented}."]


def describe_shares(location: ErrorLocation) -> list[str]:
    """Return how much of the error is measurement noise, and how much is unexplained at which level."""
    shares = dict(location.shares)
    if not shares:
        return []
    most = "at most " if location.noise_limited else ""
    parts = [f"{most}{format_percent(shares.pop('measurement', 0.0), 0)} is measurement noise"]
    scatter = shares.pop("scatter", 0.0)
    if scatter >= LEAST_SHARE:
        parts.append(f"{format_percent(scatter, 0)} is unexplained within rides")
    parts += [
        f"{format_percent(share, 0)} is unexplained and differs from {LEVEL_NAMES[name]} to {LEVEL_NAMES[name]}"
        for name, share in shares.items()
        if share >= LEAST_SHARE
    ]
    text = f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else parts[0]
    how = "all terms refitted for each vehicle, with any smooth curve of temperature"
    lines = [f"Of the squared error of rides ({how}), {text}."]
    if most:
        lines.append(
            "The noise that follows from the uncertainty of the measured energy exceeds the scatter of windows: it is "
            "overestimated for these drives, and its share is an upper limit."
        )
    return lines
