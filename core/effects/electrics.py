"""Effects of the 12 V side: constant consumers, and lights at night."""

from typing import Final

import numpy as np

from core.batch import Floats
from core.effects.declaration import Effect, effect


@effect(
    coefficient="constant power",
    unit="W",
    low=15.0,
    high=1000.0,
    source="estimate: control units, pumps, screens and radio, a taxi's meter and radio with them",
    per="time",
    confused_with=("auxiliary", "night_lights"),
    shown_by="standing and slow cars in mild weather, by day",
    words="something takes {value} W all the time",
)
def standby(dt: Floats) -> Floats:
    """Consumers that are always on beyond the base: P = 1, times a power."""
    return np.ones_like(dt, dtype=np.float64)


@effect(
    coefficient="power of the lights",
    unit="W",
    low=15.0,
    high=400.0,
    source="UN Regulation 37: 2 filament lamps of 55 W, category H7; LED lamps take a third; range: with rear lamps, "
    "dashboard and converter losses, up to a taxi's sign and beams (estimate)",
    per="time",
    confused_with=("standby",),
    shown_by="standing and slow cars by day and by night, as warm",
    words="lights take {value} W after dark",
)
def night_lights(darkness: Floats) -> Floats:
    """Lamps after sunset: P = d, times a power.

    The darkness d is 0 while the sun is up and 1 from the end of civil twilight.
    """
    return darkness


ELECTRICS: Final[tuple[Effect, ...]] = (standby, night_lights)
"""Effects of the 12 V side, in the order of the list."""
