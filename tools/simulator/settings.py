"""What a simulation is told: its size, its physics, its hidden effects and the faults of its loggers."""

import re
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from typing import Final, NamedTuple

from core.errors import SettingsError

STEP: Final = 0.5
"""Time step of the physics. [s]"""
PERIOD: Final = 3.0
"""Nominal period of the logger. [s]"""
STEPS_PER_SAMPLE: Final = int(PERIOD / STEP)
UTC_OFFSET: Final = -5 * 3600.0
"""Montreal's standard time against UTC. [s]"""
LONGEST: Final = 3660
"""Days that a simulation may span, with those that it leaves out."""
MODELS: Final = ("kia-soul-ev-2015", "tesla-model-s", "nissan-leaf-2016", "kia-soul-ev-2015", "tesla-model-x")
"""Car models handed out in turn where the user names none."""
RIDES: Final = 20_000
"""Rides of a preset where the user names no number."""
LOW, NIGHT = "low", "night"
CHARGING: Final = (LOW, NIGHT)
"""When cars charge: in a shift too, where dispatch finds them low; or between shifts alone."""


class Phenomena(NamedTuple):
    """Refinements of the physics, each of which can be left out.

    With all of them off there remain rolling resistance, climbing, drag, inertia of the kerb mass, a constant
    powertrain efficiency and electronics. `PLAIN` has `climate` beside, which is then heating or cooling at the steady
    state of the ambient temperature.
    """

    speed_rolling: bool = True
    """Rolling resistance grows with the square of the speed."""
    cold_rolling: bool = True
    """Tyres roll harder while they are cold, and warm up on the road."""
    wet_road: bool = True
    """Water on the road has to be displaced."""
    snow: bool = True
    """So has snow."""
    tyre_pressure: bool = True
    """Tyres are below their pressure, each car's by its own amount."""
    winter_tyres: bool = True
    """Winter tyres, where a car has them on, roll harder."""
    payload: bool = True
    """People aboard weigh something."""
    air_density: bool = True
    """Cold and high pressure make the air dense."""
    headwind: bool = True
    """Wind along and across the car."""
    cornering: bool = True
    """Tyres that slip sideways in bends resist."""
    brake_drag: bool = True
    """Brake pads rub, each car's by its own amount."""
    motor_map: bool = True
    """Losses of the powertrain depend on load and speed."""
    regen_limit: bool = True
    """Regeneration fades at low speed and is limited in power."""
    cold_regen_limit: bool = True
    """A cold battery takes little charge."""
    regen_full_battery: bool = True
    """A full battery takes none."""
    battery_resistance: bool = True
    """The battery has an internal resistance, which grows in the cold."""
    cold_battery_heating: bool = True
    """A cold pack is heated electrically."""
    cabin_warmup: bool = True
    """The cabin stores heat: it has to be warmed or cooled after parking."""
    door_heat_loss: bool = True
    """Open doors exchange the cabin's air; needs `cabin_warmup`."""
    solar_load: bool = True
    """The sun heats the cabin; needs `cabin_warmup`."""
    humidity: bool = True
    """Moist air is dried, against fog on the windows and for comfort."""
    night_lights: bool = True
    """Lamps are lit in the dark."""
    age: bool = True
    """Older batteries hold less and resist more."""
    climate: bool = True
    """The cabin is heated and cooled."""


ALL_PHENOMENA: Final = Phenomena()
PLAIN_PHENOMENA: Final = Phenomena(*[False] * len(Phenomena._fields))._replace(climate=True)


@dataclass(frozen=True)
class Faults:
    """How often the loggers err. Every rate is a probability a sample unless it says otherwise; 0 switches it off.

    Parameters
    ----------
    jitter : float. Stamps that are off by up to 0.9 s either way.
    repeated : float. Stamps equal to the stamp before.
    late : float. Samples that arrive 10 to 90 s late.
    out_of_order : float. Samples overtaken by the one or two after them.
    clock_step : float. The clock steps by 5 to 120 s, and steps back at the next such event.
    duplicate : float. Samples sent twice.
    gap : float. Gaps of 2 to 40 samples that begin.
    tunnel : float. Tunnel passages on which the fix freezes and then jumps.
    null_island : float. Fixes at 0/0.
    gps_noise : float. Standard deviation of a fix along each axis. [m]
    elevation_noise : float. Standard deviation of the elevation. [m]
    quantised : float. 1: state of charge in the car's own steps; 0: as it is.
    spike : float. Samples with one value out of its range.
    missing : float. Samples that lack one field.
    undecodable : float. Payloads cut short, garbled, or of a wrong type.
    power_cycle : float. The logger restarts, loses 5 to 20 samples, and counts from 0.
    false_start : float. Rides that follow a ride of a few seconds, where a driver began by mistake.
    errand : float. Rides that go on for more than an hour, to a garage or a car wash.
    unequipped : float. Share of the cars that lack something: wheel speed, V and I, ambient, ride names, odometer.
    """

    jitter: float = 0.5
    repeated: float = 0.01
    late: float = 0.003
    out_of_order: float = 0.003
    clock_step: float = 0.0001
    duplicate: float = 0.005
    gap: float = 0.0005
    tunnel: float = 1.0
    null_island: float = 0.001
    gps_noise: float = 3.0
    elevation_noise: float = 2.0
    quantised: float = 1.0
    spike: float = 0.0005
    missing: float = 0.003
    undecodable: float = 0.0003
    power_cycle: float = 0.00005
    false_start: float = 0.06
    errand: float = 0.01
    unequipped: float = 0.6


NO_FAULTS: Final = Faults(**{field.name: 0.0 for field in fields(Faults)})
_SIZES: Final = {"gps_noise", "elevation_noise"}
PRESET_SETTINGS: Final = ("vehicles", "days", "day_step", "shift_hours", "models")
"""Settings of a simulation that a preset has of its own."""
_LIMITS: Final = (("vehicles", 1, 10_000), ("days", 1, LONGEST), ("day_step", 1, 366), ("rides", 100, 1_000_000))


class Hidden(NamedTuple):
    """A hidden effect and its share of the energy of the rides."""

    effect: str
    size: float = 0.03


@dataclass(frozen=True)
class Simulation:
    """Everything that a simulated recording depends on.

    Parameters
    ----------
    vehicles, days : int
    start : datetime. First day, UTC. With a time of day other than midnight every shift begins about then;
        else the shifts are spread over the day, Montreal time.
    seed : int
    day_step : int. Days from one simulated day to the next; 1 simulates each.
    shift_hours : float or None. Length of every shift; None draws 7 to 10 h. [h]
    models : tuple of str. Catalogue keys, handed out in turn.
    hidden : tuple of Hidden
    faults : Faults
    phenomena : Phenomena
    preset : str or None. A fleet that a file describes; then `SIZES` say nothing.
    rides : int. How many rides a preset has, those not counted that a driver began by mistake.
    charging : str. One of `CHARGING`. By night alone, a plan may ask for more than the battery has: a car that is empty
        stops, and its shift is over.
    """

    vehicles: int = 5
    days: int = 1
    start: datetime = datetime(2018, 1, 15, tzinfo=UTC)
    seed: int = 0
    day_step: int = 1
    shift_hours: float | None = None
    models: tuple[str, ...] = MODELS
    hidden: tuple[Hidden, ...] = ()
    faults: Faults = Faults()
    phenomena: Phenomena = ALL_PHENOMENA
    preset: str | None = None
    rides: int = RIDES
    charging: str = LOW

    def __post_init__(self) -> None:
        """Refuse a size that cannot be simulated."""
        for name, low, high in _LIMITS:
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingsError(f"{name} is {value}; give {low} to {high}")
        if not 1980 <= self.start.year < 2100:
            raise SettingsError(f"the first day is {self.start:%Y-%m-%d}; give one in 1980 to 2099")
        if self.days * self.day_step > LONGEST:
            raise SettingsError(
                f"{self.days} days, one in {self.day_step}, are too many; give a span of {LONGEST} days"
            )
        if self.shift_hours is not None and not 0.25 <= self.shift_hours <= 12:
            raise SettingsError(f"a shift of {self.shift_hours} h; give 0.25 to 12 h")
        if self.charging not in CHARGING:
            raise SettingsError(f"charging is {self.charging!r}; choose from {', '.join(CHARGING)}")
        if self.seed < 0:
            raise SettingsError(f"seed is {self.seed}; give 0 or more")
        _check_hidden(self.hidden)


def _check_hidden(hidden: tuple[Hidden, ...]) -> None:
    """Refuse hidden effects that are named twice, or are too large together."""
    effects = [each.effect for each in hidden]
    for effect in effects:
        if effects.count(effect) > 1:
            raise SettingsError(f"hidden effect {effect} is given {effects.count(effect)} times; give it once")
    total = sum(each.size for each in hidden)
    if any(each.size <= 0 for each in hidden) or total > 0.5:
        raise SettingsError(f"hidden effects add up to {total:g} of the energy; give sizes above 0, 0.5 in all")


def parse_start(text: str) -> datetime:
    """Return a day or a time from ISO text; what names no zone is UTC.

    Raises
    ------
    SettingsError
        If it is neither.
    """
    try:
        start = datetime.fromisoformat(text)
    except ValueError:
        raise SettingsError(f"start {text!r} is not a date; write it as 2018-01-15 or 2018-01-15T12:00") from None
    return start.astimezone(UTC) if start.tzinfo else start.replace(tzinfo=UTC)


def parse_models(text: str) -> tuple[str, ...]:
    """Return catalogue keys from a list with commas.

    Raises
    ------
    SettingsError
        If it is empty. Whether the models exist is asked when the simulation begins.
    """
    models = tuple(filter(None, (part.strip() for part in text.split(","))))
    if not models:
        raise SettingsError(f"models {text!r} names none; give catalogue keys such as {MODELS[0]}")
    return models


def parse_faults(text: str, usual: Faults = Faults()) -> Faults:
    """Return faults from `default`, `none`, or `name=rate,...` over the defaults, `none,name=rate` over none.

    >>> parse_faults("none,gap=0.01").gap, parse_faults("late=0").late, parse_faults("none").jitter
    (0.01, 0.0, 0.0)

    Raises
    ------
    SettingsError
        For a fault that does not exist, or a rate that is none.
    """
    faults, known = usual, [field.name for field in fields(Faults)]
    for part in filter(None, (part.strip() for part in text.split(","))):
        if part in {"default", "none"}:
            faults = NO_FAULTS if part == "none" else usual
            continue
        name, _, rate = part.partition("=")
        limit = 100.0 if name in _SIZES else 1.0
        if name not in known:
            raise SettingsError(f"no fault is called {name!r}; choose from {', '.join(known)}")
        if not re.fullmatch(r"\d*\.?\d+(e-?\d+)?", rate) or float(rate) > limit:
            raise SettingsError(f"fault {name} has rate {rate!r}; give {name}=0 to {name}={limit:g}")
        faults = replace(faults, **{name: float(rate)})
    return faults


def parse_phenomena(text: str) -> Phenomena:
    """Return switches from `all`, `plain`, or a list: `plain,headwind`, `all,-snow`.

    >>> parse_phenomena("all,-snow").snow, parse_phenomena("plain,headwind").headwind
    (False, True)

    Raises
    ------
    SettingsError
        For a phenomenon that does not exist.
    """
    phenomena = ALL_PHENOMENA
    for part in filter(None, (part.strip() for part in text.split(","))):
        name = part.removeprefix("-")
        if part in {"all", "plain"}:
            phenomena = ALL_PHENOMENA if part == "all" else PLAIN_PHENOMENA
        elif name in Phenomena._fields:
            phenomena = phenomena._replace(**{name: name == part})
        else:
            raise SettingsError(
                f"no phenomenon is called {name!r}; choose from all, plain, {', '.join(Phenomena._fields)}"
            )
    return phenomena


def parse_hidden(text: str) -> Hidden:
    """Return a hidden effect from `name` or `name:size`.

    >>> parse_hidden("headwind:0.02")
    Hidden(effect='headwind', size=0.02)

    Raises
    ------
    SettingsError
        For a size that is no number. Whether the effect exists is asked when the simulation begins.
    """
    name, _, size = text.partition(":")
    if size and not re.fullmatch(r"\d*\.?\d+", size):
        raise SettingsError(f"hidden effect {name} has size {size!r}; give a share of the energy such as {name}:0.03")
    return Hidden(name, float(size)) if size else Hidden(name)
