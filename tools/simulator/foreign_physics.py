"""Follow other laws of cabin, heater, tyres and battery than those of the effects library.

- The cabin is two masses, its air and its interior. It loses heat through walls and through leaks that grow with speed.
- Heating saturates towards the set point. A heat pump has a share of Carnot's efficiency and frosts about 0 °C.
- The resistance of rubber grows exponentially as it cools.
- The resistance of the battery follows Vogel, Fulcher and Tammann, and grows as the battery empties. A cold battery
  gives less of its energy.
"""

from typing import Final

import numpy as np
from numba import njit

from socast.core.columns import ZERO_CELSIUS

AIR_SHARE: Final = 0.2
"""Share of the heat capacity of the cabin that is in its air. [1]"""
CONTACT: Final = 70.0
"""Heat that the interior gives to the air per kelvin. [W/K]"""
APPROACH: Final = 2.5
"""Distance from the set point at which heating and cooling reach 63 % of their power. [K]"""
CARNOT: Final = 0.36
"""Efficiency of a heat pump or cooler over Carnot's. [1]"""
CONDENSER: Final = 48.0
"""Temperature at which a heat pump gives its heat. [°C]"""
EVAPORATOR: Final = 6.0
"""Temperature at which a cooler takes up heat. [°C]"""
GLASS: Final = 165.0, 200.0
"""Slope and ideal glass temperature of the electrolyte. [K]"""
RUBBER: Final = 60.0
"""Cooling of a tyre by which its resistance grows by a factor of e. [K]"""


@njit(cache=False)
def compute_heat_pump_cop(ambient: float, best: float) -> float:
    """Return heat over electric power, between 1 and that of a warm day; 1 for a resistance heater. [1]"""
    if best <= 1.0:
        return 1.0
    cop = CARNOT * (CONDENSER + ZERO_CELSIUS) / max(CONDENSER - ambient, 15.0)
    frost = 1.0 - 0.22 * np.exp(-((ambient / 3.5) ** 2))
    return float(max(1.0, min(1.25 * best, cop * frost)))


@njit(cache=False)
def compute_cooler_cop(ambient: float) -> float:
    """Return cold over electric power. [1]"""
    return float(CARNOT * (EVAPORATOR + ZERO_CELSIUS) / max(ambient + 18.0 - EVAPORATOR, 20.0))


@njit(cache=False)
def compute_demand(power: float, distance: float) -> float:
    """Return the electric power at a distance from the set point. [W]"""
    return float(power * (1.0 - np.exp(-max(distance, 0.0) / APPROACH)))


@njit(cache=False)
def compute_cabin_loss(loss: float, speed: float, door: float) -> float:
    """Return the heat that walls, leaks and open doors lose per kelvin. [W/K]"""
    return float(loss * (0.7 + 0.3 * np.sqrt(speed / 8.0)) + 220.0 * door)


@njit(cache=False)
def compute_cold_rolling(tyre: float) -> float:
    """Return the rolling resistance of tyres over that at 25 °C, minus 1. [1]"""
    return float(np.exp((25.0 - tyre) / RUBBER) - 1.0)


@njit(cache=False)
def compute_resistance_ratio(pack: float, soc: float) -> float:
    """Return the resistance of the battery over that at 25 °C and half charge. [1]"""
    slope, glass = GLASS
    kelvin = max(pack, -50.0) + ZERO_CELSIUS
    thick = np.exp(slope / (kelvin - glass) - slope / (25.0 + ZERO_CELSIUS - glass))
    return float(thick * (1.0 + 0.8 * np.exp(-max(soc, 0.0) / 0.12)))


@njit(cache=False)
def compute_cold_yield(pack: float) -> float:
    """Return the share of its energy that a battery gives at a temperature. [1]"""
    return float(1.0 - 0.11 * (1.0 - np.tanh((pack + 22.0) / 24.0)))
