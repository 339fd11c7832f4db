"""Bend the shape of a hidden effect at random, to test a library on forms that nobody chose.

The option `--hidden snow~bent7` selects the seventh bent shape of `snow`: its power raised to an exponent, multiplied
by a power of the speed and by an exponential of the outside temperature, and delayed if it does not act by motion.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.tools.simulator.hidden import EFFECTS, EffectInputs, PowerFunction, apply_lag

BENT: Final = "~bent"
"""Text between the name of an effect and the number of its bent shape."""
DELAYED: Final = frozenset(
    {
        "cabin_cooling",
        "cabin_heating",
        "cabin_warmup",
        "cold_battery_heating",
        "door_heat_loss",
        "humidity",
        "night_lights",
        "solar_load",
    }
)
"""Effects that act by time, whose bent shape may lag."""
EXPONENT: Final = 0.45
"""Largest absolute logarithm of the exponent. [1]"""
SPEED: Final = 0.35
"""Largest absolute exponent of the speed. [1]"""
TEMPERATURE: Final = 0.35
"""Largest absolute change of the logarithm over 20 K. [1]"""
LAG: Final = (20.0, 400.0)
"""Range of time constants, whose logarithm is uniform. [s]"""
LAGGED: Final = 0.5
"""Share of the bent shapes of `DELAYED` that lag."""
POWER: Final = 500.0
"""Power that an exponent does not change. [W]"""
PACE: Final = 12.0
"""Speed that the exponent of the speed does not change; half of it is the least speed that counts. [m/s]"""


def bend_shape(effect: str, number: int) -> PowerFunction:
    """Return the power of an effect in a bent shape."""
    power = EFFECTS[effect]
    rng = np.random.default_rng([number, *effect.encode()])
    exponent = float(np.exp(rng.uniform(-EXPONENT, EXPONENT)))
    speed, temperature = float(rng.uniform(-SPEED, SPEED)), float(rng.uniform(-TEMPERATURE, TEMPERATURE))
    lag = float(np.exp(rng.uniform(*np.log(LAG)))) if effect in DELAYED and rng.uniform() < LAGGED else 0.0

    def bent(view: EffectInputs) -> Floats:
        """Return the power of the bent effect. [W]"""
        plain = power(view)
        out = np.sign(plain) * POWER * (np.abs(plain) / POWER) ** exponent
        out = out * (np.maximum(view.trace.speed, PACE / 2.0) / PACE) ** speed
        out = out * np.exp(temperature * view.trace.ambient / 20.0)
        return np.asarray(apply_lag(out, lag) * view.trace.on if lag else out)

    return bent
