"""Name the fleets on which forecasts of the state of charge are judged; `socast simulate --fleet NAME` makes one.

All of them follow `Phenomena.foreign`, whose laws are not those of the effects library, and hold displays that count
charge. None of their values was chosen for a forecast.
"""

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, Final

from socast.core.errors import SettingsError
from socast.tools.simulator.conditions import (
    ABSENT,
    FROZEN,
    JUMPING,
    NO_NEWCOMERS,
    Conditions,
    DisplayFault,
    Newcomers,
    Spell,
)
from socast.tools.simulator.settings import ALL_PHENOMENA, LOW, NIGHT, Faults, Simulation

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
