"""Define the conditions that a simulation may add: weather, habits, displays and plans that go wrong, new and old cars.

Each is a switch of its own and is off by default, so that a simulation without them gives the same bytes as before.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Final, NamedTuple

from socast.core.errors import SettingsError

FROZEN, ABSENT, JUMPING = "frozen", "absent", "jumping"
DISPLAY_FAULTS: Final = (FROZEN, ABSENT, JUMPING)
"""Kinds of faults of a display of the state of charge."""
_SHARES: Final = ("waits", "no_shows", "plan_spread", "replans", "way_home", "no_plan", "aged_packs")


class Spell(NamedTuple):
    """Describe a cold snap or a heat wave.

    Parameters
    ----------
    day : int
        Days from the first day of the simulation to the first day of the spell.
    kelvin : float
        Warmest hour of the spell above the warmest hour since the first day; if negative, its coldest hour below the
        coldest hour since then. [K]
    """

    day: int
    kelvin: float
    days: int


class DisplayFault(NamedTuple):
    """Describe a fault of the display of the state of charge of one car.

    Parameters
    ----------
    day : int
        Days from the first day of the simulation to the first faulty day.
    """

    car: int
    kind: str
    day: int
    days: int


class Newcomers(NamedTuple):
    """Describe cars that join the fleet, with drivers of their own.

    Parameters
    ----------
    cars : int
        Number of cars, the last of the fleet.
    day : int
        Days from the first day of the simulation to their first shift.
    """

    cars: int
    day: int


NO_NEWCOMERS: Final = Newcomers(0, 0)


@dataclass(frozen=True)
class Conditions:
    """Select conditions; by default there are none.

    Parameters
    ----------
    heater_habits : bool
        Drivers keep to their cars, and each has a set point; some heat the cabin before the shift, some save heat.
    coulomb_display : bool
        The display counts charge, drifts, and is a curve over the state of charge; see `displays`.
    display_faults : tuple of DisplayFault
        Displays that freeze, are absent or jump.
    waits : float
        Probability after each ride of a wait of 10 to 50 min with the climate control on.
    no_shows : float
        Probability before each ride of another planned ride whose passenger does not come.
    plan_spread : float
        Standard deviation of the planned distance and duration of a ride over the true ones. A quarter of the variance
        is common to the rides of a shift. [1]
    replans : float
        Probability at the end of each ride that dispatch replaces what it had planned after it.
    way_home : float
        Share of the shifts at whose end the car drives home, which is in no plan.
    no_plan : float
        Share of the shifts without any plan.
    planned_charges : bool
        The plan contains the charges of the shift as legs of their own.
    aged_packs : float
        Share of the cars with 58 to 72 % of their usable capacity, which loses 0.05 % a day.
    battery_sizes : tuple of float
        Nominal capacities, assigned in turn and announced by the cars. [kWh]
    weather_forecasts : bool
        The stations also publish forecasts of the temperature, see `weather.make_forecasts`.
    periods : tuple of float
        Times between two samples of the loggers, assigned in turn; 0 for a logger that sends a sample only when a value
        has changed. [s]
    """

    spells: tuple[Spell, ...] = ()
    heater_habits: bool = False
    coulomb_display: bool = False
    display_faults: tuple[DisplayFault, ...] = ()
    waits: float = 0.0
    no_shows: float = 0.0
    plan_spread: float = 0.0
    replans: float = 0.0
    way_home: float = 0.0
    no_plan: float = 0.0
    planned_charges: bool = False
    aged_packs: float = 0.0
    battery_sizes: tuple[float, ...] = ()
    newcomers: Newcomers = NO_NEWCOMERS
    weather_forecasts: bool = False
    periods: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Raise an error for a value out of bounds."""
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SettingsError(f"condition {name} is {getattr(self, name):g}; give 0 to 1")
        for spell in self.spells:
            if spell.day < 1 or spell.days < 1 or not 0.0 < abs(spell.kelvin) <= 40.0:
                raise SettingsError(f"spell {':'.join(map(str, spell))}; give a day from 1, up to 40 K, and its days")
        for fault in self.display_faults:
            if fault.kind not in DISPLAY_FAULTS or fault.car < 1 or fault.day < 0 or fault.days < 1:
                raise SettingsError(
                    f"display fault {':'.join(map(str, fault))}; give a car from 1, {' or '.join(DISPLAY_FAULTS)}, "
                    "a day from 0, and its days"
                )
        if any(not 5.0 <= size <= 200.0 for size in self.battery_sizes):
            raise SettingsError(f"battery sizes {self.battery_sizes}; give 5 to 200 kWh")
        for period in self.periods:
            if period % 0.5 or not 0.0 <= period <= 60.0:
                raise SettingsError(f"period is {period:g} s; give a multiple of 0.5 s up to 60 s, or 0")

    def find_display_fault(self, car: int, day: int) -> str | None:
        """Return the fault of the display of a car on a day, None without one."""
        for fault in self.display_faults:
            if fault.car == car + 1 and fault.day <= day < fault.day + fault.days:
                return fault.kind
        return None


NO_CONDITIONS: Final = Conditions()


def _parse(record: Any, text: str) -> Any:
    """Return a record whose fields are divided by colons."""
    return record(*(kind(part) for kind, part in zip(record.__annotations__.values(), text.split(":"), strict=True)))


_PARTS: Final[dict[str, tuple[str, Callable[[str], Any], str]]] = {
    "spell": ("spells", partial(_parse, Spell), "spell=30:-15:3, a day, kelvins and days"),
    "display_fault": (
        "display_faults",
        partial(_parse, DisplayFault),
        "display_fault=2:frozen:10:5, a car, a kind, a day and days",
    ),
    "battery_size": ("battery_sizes", float, "battery_size=24"),
    "period": ("periods", float, "period=10"),
}
"""Condition that may be repeated -> its field, its parser and an example."""
_EXAMPLES: Final = {"newcomers": "newcomers=1:20, cars and a day"}
CONDITION_NAMES: Final = (
    *_PARTS,
    *(field.name for field in fields(Conditions) if field.name not in {part[0] for part in _PARTS.values()}),
)
"""Names that `parse_conditions` knows."""


def parse_conditions(text: str, base: Conditions = NO_CONDITIONS) -> Conditions:
    """Return conditions from text, added to others.

    Examples
    --------
    >>> parse_conditions("waits=0.2,spell=30:-15:3").spells
    (Spell(day=30, kelvin=-15.0, days=3),)
    """
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        if name not in CONDITION_NAMES:
            raise SettingsError(f"no condition is called {name!r}; choose from {', '.join(CONDITION_NAMES)}")
        try:
            base = _add(base, name, value)
        except ValueError:
            example = _PARTS[name][2] if name in _PARTS else _EXAMPLES.get(name, f"{name}=0.2")
            raise SettingsError(f"condition {name} has value {value!r}; write it as {example}") from None
    return base


def _add(base: Conditions, name: str, value: str) -> Conditions:
    """Return conditions with one more."""
    change: dict[str, Any]
    if name in _PARTS:
        field, parse, _ = _PARTS[name]
        change = {field: (*getattr(base, field), parse(value))}
    elif name == "newcomers":
        change = {name: _parse(Newcomers, value)}
    elif isinstance(getattr(base, name), bool):
        if value:
            raise SettingsError(f"condition {name} has value {value!r}; write it without a value")
        change = {name: True}
    else:
        change = {name: float(value)}
    return replace(base, **change)
