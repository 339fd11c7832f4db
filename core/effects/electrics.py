"""Effects of the 12 V side: constant consumers, and lights at night."""

import numpy as np

from socast.core.batch import Floats
from socast.core.effects.declaration import Parameter, effect


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
    parameters={
        "dark": Parameter(-0.1045, "1", -0.2, 0.2, grid=(-0.1045, -0.05, 0.0, 0.05, 0.1)),
        "twilight": Parameter(0.1045, "1"),
    },
    words="lights take {value} W after dark",
)
def night_lights(sun_sine: Floats, *, dark: float, twilight: float) -> Floats:
    """Lamps in the dark: P = min(max(1 + (s0 - s)/w, 0), 1), times a power.

    s is the sine of the elevation of the sun. All lamps are on below s0, by default the end of civil twilight, and
    fewer of them within the width w above it. Lamps that are switched by a sensor come on before sunset.
    """
    return np.clip(1.0 + (dark - sun_sine) / twilight, 0.0, 1.0)
