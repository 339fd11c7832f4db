"""Name the load of the forms outside the library that is most like that of an effect of the library."""

from types import MappingProxyType
from typing import Final

from socast.core import effects

LOADS: Final = MappingProxyType(
    {
        "braking_force": "braking",
        "traction": "traction",
        "wheel_power": "traction",
        "tyre_load": "rolling",
        "stop_rate": "stopping",
        "grade": "climbing",
        "speed": "drag",
    }
)
"""Signals that effects read -> load of the forms; the first that an effect reads decides; without one, a power."""


def find_load(effect: str) -> str:
    """Return the load on which an effect acts."""
    arguments = effects.get(effect).arguments
    return next((load for signal, load in LOADS.items() if signal in arguments), "auxiliary")
