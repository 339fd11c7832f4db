"""Define the settings of a simulation: its size, its physics, hidden effects and faults of loggers; and named fleets.

`socast simulate --fleet NAME` makes a named fleet, on which forecasts of the state of charge are judged. All of them
follow `Phenomena.foreign`, whose laws are not those of the effects library, and hold displays that count charge. None
of their values was chosen for a forecast.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from socast.core.errors import SettingsError
from socast.tools.simulator.conditions import (
    ABSENT,
    FROZEN,
    JUMPING,
    NO_CONDITIONS,
    NO_NEWCOMERS,
    Conditions,
    DisplayFault,
    Newcomers,
    Spell,
)

STEP: Final = 0.5
"""Time step of the physics. [s]"""
PERIOD: Final = 3.0
"""Nominal period of the logger. [s]"""
STEPS_PER_SAMPLE: Final = int(PERIOD / STEP)
UTC_OFFSET: Final = -5 * 3600.0
"""Difference of Montreal's standard time from UTC. [s]"""
LONGEST_SPAN: Final = 3660
"""Largest number of days that a simulation spans, skipped days included."""
DEFAULT_MODELS: Final = ("kia-soul-ev-2015", "tesla-model-s", "nissan-leaf-2016", "kia-soul-ev-2015", "tesla-model-x")
"""Car models that are assigned in turn by default."""
DEFAULT_RIDES: Final = 20_000
"""Default number of rides of a preset."""
LOW, NIGHT = "low", "night"
CHARGING: Final = (LOW, NIGHT)
"""When cars charge: `night` between shifts only, `low` also in a shift at a low estimated state of charge."""


class Phenomena(NamedTuple):
    """Switch refinements of the physics on and off.

    Without any of them the physics has rolling resistance, climbing, drag, inertia of the kerb mass, a constant
    efficiency of the powertrain, and electronics. `PLAIN_PHENOMENA` adds `hills`, and `climate`, which then heats or
    cools for the steady state at the outside temperature.
    """

    speed_rolling: bool = True
    """Rolling resistance grows with the square of the speed."""
    cold_rolling: bool = True
    """Cold tyres have more rolling resistance and warm up on the road."""
    wet_road: bool = True
    """Tyres displace water on the road."""
    snow: bool = True
    """Tyres displace snow on the road."""
    tyre_pressure: bool = True
    """Tyre pressure is too low; each car has its own deficit."""
    winter_tyres: bool = True
    """Winter tyres have more rolling resistance while they are mounted."""
    payload: bool = True
    """Occupants have mass."""
    air_density: bool = True
    """The density of air depends on temperature and pressure."""
    headwind: bool = True
    """Wind blows along and across the car."""
    cornering: bool = True
    """Tyres that slip sideways in bends take power."""
    brake_drag: bool = True
    """Brake pads rub; each car has its own force."""
    motor_map: bool = True
    """Losses of the powertrain depend on load and speed."""
    regen_limit: bool = True
    """Regeneration fades at low speed and its power is limited."""
    cold_regen_limit: bool = True
    """A cold battery accepts little charging power."""
    regen_full_battery: bool = True
    """A full battery accepts no charging power."""
    battery_resistance: bool = True
    """The battery has an internal resistance, which increases in the cold."""
    cold_battery_heating: bool = True
    """An electric heater warms a cold battery."""
    cabin_warmup: bool = True
    """The cabin stores heat, so it is warmed or cooled after parking."""
    door_heat_loss: bool = True
    """Open doors exchange the air of the cabin; this needs `cabin_warmup`."""
    solar_load: bool = True
    """The sun heats the cabin; this needs `cabin_warmup`."""
    humidity: bool = True
    """Moist air is dried, against fog on the windows and for comfort."""
    night_lights: bool = True
    """Lamps are on in the dark."""
    age: bool = True
    """Older batteries have less capacity and more resistance."""
    climate: bool = True
    """The cabin is heated and cooled."""
    hills: bool = True
    """Streets follow the hills; without them the land is flat."""
    foreign: bool = False
    """Cabin, heater, cold tyres and battery follow the other laws of `physics`; this needs `cabin_warmup`."""


ALL_PHENOMENA: Final = Phenomena()
PLAIN_PHENOMENA: Final = Phenomena(*[False] * len(Phenomena._fields))._replace(climate=True, hills=True)


@dataclass(frozen=True)
class Faults:
    """Set the rates of faults of the loggers.

    A rate is the probability for each sample unless stated otherwise; 0 switches the fault off.

    Parameters
    ----------
    jitter : float
        Time stamps off by up to 0.9 s in either direction.
    repeated : float
        Time stamps equal to the stamp before.
    late : float
        Samples that arrive 10 to 90 s late.
    out_of_order : float
        Samples overtaken by the next one or two.
    clock_step : float
        Steps of the clock by 5 to 120 s; the next such event steps it back.
    gap : float
        Begins of gaps of 2 to 40 samples.
    tunnel : float
        Probability for each passage of a tunnel that the position freezes and then jumps.
    gps_noise : float
        Standard deviation of a position along each axis. [m]
    elevation_noise : float
        Standard deviation of the elevation. [m]
    quantised : float
        1 gives the state of charge in the steps of the car, 0 gives it exactly.
    spike : float
        Samples with one value out of range.
    undecodable : float
        Payloads that are cut, garbled, or of a wrong type.
    power_cycle : float
        Restarts of the logger, which loses 5 to 20 samples and counts from 0.
    false_start : float
        Probability for each ride that a ride of a few seconds, begun by mistake, precedes it.
    errand : float
        Probability for each ride that it continues for about an hour, to a garage or a car wash.
    unequipped : float
        Share of the cars that may lack something: wheel speed, voltage and current, ambient, ride names, odometer.
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
"""Settings of a simulation that a preset defines itself."""
_LIMITS: Final = (("vehicles", 1, 10_000), ("days", 1, LONGEST_SPAN), ("day_step", 1, 366), ("rides", 100, 1_000_000))


class Hidden(NamedTuple):
    """Select a hidden effect and its size.

    Parameters
    ----------
    size : float
        Share of the energy of the rides. [1]
    """

    effect: str
    size: float = 0.03


@dataclass(frozen=True)
class Simulation:
    """Hold everything that a simulated recording depends on.

    Parameters
    ----------
    vehicles, days : int
        Number of cars, and of days with one shift of each car.
    start : datetime
        First day in UTC. With a time of day other than midnight every shift begins at about that time; otherwise the
        shifts are spread over the day in Montreal.
    day_step : int
        Days from one simulated day to the next; 1 simulates every day.
    shift_hours : float or None
        Length of every shift; None draws 7 to 10 h. [h]
    models : tuple of str
        Keys of the vehicle catalogue, assigned in turn.
    preset : str or None
        Name of a fleet that a file describes; then the settings in `PRESET_SETTINGS` have no effect.
    rides : int
        Number of rides of a preset, without those begun by mistake.
    charging : str
        One of `CHARGING`. With `night` a plan may need more energy than the battery holds. A car with an empty battery
        stops, and its shift ends.
    conditions : Conditions
        Weather, habits, displays and plans that go wrong, and cars that join or age.
    """

    vehicles: int = 5
    days: int = 1
    start: datetime = datetime(2018, 1, 15, tzinfo=UTC)
    seed: int = 0
    day_step: int = 1
    shift_hours: float | None = None
    models: tuple[str, ...] = DEFAULT_MODELS
    hidden: tuple[Hidden, ...] = ()
    faults: Faults = Faults()
    phenomena: Phenomena = ALL_PHENOMENA
    preset: str | None = None
    rides: int = DEFAULT_RIDES
    charging: str = LOW
    conditions: Conditions = NO_CONDITIONS

    def __post_init__(self) -> None:
        """Raise an error for a size that cannot be simulated."""
        for name, low, high in _LIMITS:
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingsError(f"{name} is {value}; give {low} to {high}")
        if not 1980 <= self.start.year < 2100:
            raise SettingsError(f"the first day is {self.start:%Y-%m-%d}; give one in 1980 to 2099")
        if self.days * self.day_step > LONGEST_SPAN:
            raise SettingsError(
                f"{self.days} days at a step of {self.day_step} span too long; give {LONGEST_SPAN} days at most"
            )
        if self.shift_hours is not None and not 0.25 <= self.shift_hours <= 12:
            raise SettingsError(f"a shift of {self.shift_hours} h; give 0.25 to 12 h")
        if self.charging not in CHARGING:
            raise SettingsError(f"charging is {self.charging!r}; choose from {', '.join(CHARGING)}")
        if self.seed < 0:
            raise SettingsError(f"seed is {self.seed}; give 0 or more")
        _check_hidden(self.hidden)
        _check_conditions(self)


def _check_hidden(hidden: tuple[Hidden, ...]) -> None:
    """Raise an error for hidden effects that are given twice or are too large together."""
    effects = [each.effect for each in hidden]
    for effect in effects:
        if effects.count(effect) > 1:
            raise SettingsError(f"hidden effect {effect} is given {effects.count(effect)} times; give it once")
    total = sum(each.size for each in hidden)
    if any(each.size <= 0 for each in hidden) or total > 0.5:
        raise SettingsError(f"hidden effects add up to {total:g} of the energy; give sizes above 0, 0.5 in all")


def _check_conditions(simulation: Simulation) -> None:
    """Raise an error for conditions that the fleet cannot have."""
    wanted = simulation.conditions
    own = wanted.heater_habits or wanted.aged_packs or wanted.battery_sizes or wanted.newcomers.cars
    if simulation.preset is not None and own:
        raise SettingsError(
            f"preset {simulation.preset} has its own cars and drivers; leave out heater_habits, aged_packs, "
            "battery_size and newcomers"
        )
    cars, day = wanted.newcomers
    if simulation.preset is None and not (0 <= cars < simulation.vehicles and 0 <= day < simulation.days):
        raise SettingsError(
            f"newcomers {cars}:{day} in a fleet of {simulation.vehicles} cars over {simulation.days} days; leave one "
            "car and one day"
        )


def parse_start(text: str) -> datetime:
    """Return a day or a time from ISO text; text without a zone is in UTC."""
    try:
        start = datetime.fromisoformat(text)
    except ValueError:
        raise SettingsError(f"start {text!r} is not a date; write it as 2018-01-15 or 2018-01-15T12:00") from None
    return start.astimezone(UTC) if start.tzinfo else start.replace(tzinfo=UTC)


def parse_models(text: str) -> tuple[str, ...]:
    """Return catalogue keys from a comma-separated list."""
    models = tuple(filter(None, (part.strip() for part in text.split(","))))
    if not models:
        raise SettingsError(f"models {text!r} names none; give catalogue keys such as {DEFAULT_MODELS[0]}")
    return models


def parse_faults(text: str, usual: Faults = Faults()) -> Faults:
    """Return rates of faults from text.

    Examples
    --------
    >>> parse_faults("none,gap=0.01").gap, parse_faults("late=0").late, parse_faults("none").jitter
    (0.01, 0.0, 0.0)
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
    """Return the switches of the physics from text.

    Parameters
    ----------
    text : str
        `all` (all that are on by default), `plain`, or a list such as `plain,headwind` or `all,-snow`.

    Examples
    --------
    >>> parse_phenomena("all,-snow").snow, parse_phenomena("plain,headwind").headwind
    (False, True)
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

    Examples
    --------
    >>> parse_hidden("headwind:0.02")
    Hidden(effect='headwind', size=0.02)
    """
    name, _, size = text.partition(":")
    if size and not re.fullmatch(r"\d*\.?\d+", size):
        raise SettingsError(f"hidden effect {name} has size {size!r}; give a share of the energy such as {name}:0.03")
    return Hidden(name, float(size)) if size else Hidden(name)


COLD_SNAP: Final = Spell(day=32, kelvin=-15.0, days=4)
HEAT_WAVE: Final = Spell(day=32, kelvin=10.0, days=4)
_SETTLED: Final = Conditions(
    heater_habits=True, coulomb_display=True, waits=0.4, battery_sizes=(30.0, 40.0), newcomers=Newcomers(1, 20)
)
_AUTUMN: Final = Simulation(
    vehicles=12,
    days=45,
    start=datetime(2018, 10, 1, tzinfo=UTC),
    shift_hours=6.0,
    charging=NIGHT,
    models=("nissan-leaf-2016",),
    faults=Faults(undecodable=0.0, clock_step=0.0),
    phenomena=ALL_PHENOMENA._replace(foreign=True),
    conditions=replace(_SETTLED, spells=(COLD_SNAP,)),
)
_SHORT: Final = replace(_AUTUMN, vehicles=6, days=25, conditions=replace(_SETTLED, newcomers=Newcomers(1, 15)))
_SMALL: Final = replace(
    _AUTUMN,
    vehicles=3,
    days=20,
    start=datetime(2018, 11, 5, tzinfo=UTC),
    shift_hours=3.0,
    models=("nissan-leaf-2013",),
    conditions=Conditions(heater_habits=True, coulomb_display=True, waits=0.4, aged_packs=2 / 3),
)


def _with(fleet: Simulation, **changes: Any) -> Simulation:
    """Return a fleet with other conditions."""
    return replace(fleet, conditions=replace(fleet.conditions, **changes))


FLEETS: Final[Mapping[str, Simulation]] = MappingProxyType(
    {
        "autumn": _AUTUMN,
        "autumn-heat": _with(_AUTUMN, spells=(HEAT_WAVE,)),
        "autumn-forecast": _with(_AUTUMN, weather_forecasts=True),
        "autumn-short": _SHORT,
        "autumn-faults": _with(
            _SHORT,
            display_faults=(
                DisplayFault(1, FROZEN, 8, 10),
                DisplayFault(2, ABSENT, 8, 10),
                DisplayFault(3, JUMPING, 8, 10),
            ),
        ),
        "autumn-no-plan": _with(_SHORT, no_plan=1.0),
        "autumn-no-shows": _with(_SHORT, no_shows=0.15),
        "autumn-way-home": _with(_SHORT, way_home=0.8),
        "autumn-plans": _with(_SHORT, plan_spread=0.5, replans=0.1),
        "autumn-charges": _with(replace(_SHORT, charging=LOW, shift_hours=8.0), planned_charges=True),
        "charges": replace(
            _AUTUMN,
            days=20,
            charging=LOW,
            shift_hours=8.0,
            conditions=replace(_SETTLED, newcomers=NO_NEWCOMERS, planned_charges=True),
        ),
        "small": _SMALL,
    }
)
"""Name of each fleet -> its simulation with the seed 0."""


def get_fleet(name: str, seed: int) -> Simulation:
    """Return the simulation of a named fleet."""
    if name not in FLEETS:
        raise SettingsError(f"no fleet is called {name!r}; choose from {', '.join(FLEETS)}")
    return replace(FLEETS[name], seed=seed)
