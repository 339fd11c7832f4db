"""Effects of air beyond drag in still standard air: headwind, crosswind, air density, and loads on the roof.

The base has P = 1/2 ρ0 A_d v^3. Each effect is the difference that its cause makes. `headwind` and `air_density`
together are all that relative wind in air of the actual density adds.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import STANDARD_AIR_DENSITY
from socast.core.effects.declaration import Expectation, Parameter, effect

_DRAG: Final = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4"
_DENSITY: Final = Parameter(STANDARD_AIR_DENSITY, "kg/m^3")


@effect(
    coefficient="drag area that meets the wind",
    unit="m^2",
    low=0.1,
    high=1.6,
    source=f"{_DRAG}, relative wind; range: drag areas of cars (Hucho, ed., Aerodynamics of Road Vehicles, SAE 1998), "
    "down to a third, because a station's wind, at 10 m, is weaker between houses (estimate)",
    confused_with=("crosswind_yaw",),
    shown_by="drives both ways on windy days, above 50 km/h, with a weather station near",
    words="the wind meets {value} m² of drag area",
)
def headwind(speed: Floats, headwind: Floats, air_density: Floats) -> Floats:
    """Wind against the car, or behind it: P = 1/2 ρ ((v + w)|v + w| - v^2) v, times A_d.

    The power is negative with the wind behind, and zero for a standing car, on which wind does no work.
    """
    relative = speed + headwind
    return 0.5 * air_density * (relative * np.abs(relative) - speed * speed) * speed


@effect(
    coefficient="drag area times the growth of drag with yaw",
    unit="m^2",
    low=0.1,
    high=6.0,
    source="Windsor, Real World Drag Coefficient, Int. Vehicle Aerodynamics Conf. 2014, DOI 10.1533/9780081002452.1.3: "
    "up to 10 % more at small yaw; range: A_d (1 + k) with k to 8, less where the wind is sheltered (estimate)",
    parameters={"yaw_limit": Parameter(0.5, "1", 0.2, 0.9, grid=(0.35, 0.5, 0.7))},
    confused_with=("headwind",),
    shown_by="fast drives across the wind, on windy days",
    words="wind from the side meets {value} m² of drag area",
)
def crosswind_yaw(speed: Floats, headwind: Floats, crosswind: Floats, air_density: Floats, yaw_limit: float) -> Floats:
    """Drag that grows with the yaw angle of the wind: P = 1/2 ρ min(u^2, s^2 ((v + w)^2 + u^2)) v, times A_d (1 + k).

    This follows from C_d = C_d0 (1 + k sin^2 β), with the yaw angle β between the wind relative to the car and its
    axis, and crosswind u: the added force is 1/2 ρ A_d (1 + k) u^2. Beyond the yaw whose sine is s, the coefficient
    stays constant.
    """
    side = crosswind * crosswind
    relative = speed + headwind
    return 0.5 * air_density * np.minimum(side, yaw_limit * yaw_limit * (relative * relative + side)) * speed


@effect(
    coefficient="drag area",
    unit="m^2",
    low=0.3,
    high=2.0,
    source=f"{_DRAG}; ρ0: ISO 2533:1975; range: Hucho (ed.), Aerodynamics of Road Vehicles, SAE 1998",
    parameters={"air_density_standard": _DENSITY},
    confused_with=("cold_rolling", "battery_resistance"),
    shown_by="fast drives in frost and in heat, or at 0 and at 1000 m, at days of equal battery and tyre temperature",
    words="{value} m² of drag area meet the denser air of the cold",
    expected=Expectation(
        1.2, 0.3, "as of `aero_drag`: the same drag area in denser or thinner air; spread: its own", of="drag_area_m2"
    ),
)
def air_density(speed: Floats, air_density: Floats, air_density_standard: float) -> Floats:
    """Air of other density than at 15 °C and sea level: P = 1/2 (ρ - ρ0) v^3, times A_d.

    Air at -20 °C is 14 % denser than standard air. Air at 35 °C is 7 % thinner, and air at 1000 m 11 %, where the power
    is negative.
    """
    return 0.5 * (air_density - air_density_standard) * speed * speed * speed


@effect(
    coefficient="added drag area",
    unit="m^2",
    low=0.03,
    high=0.7,
    source="Chen and Meier 2016, Energy Policy 92:325-333, DOI 10.1016/j.enpol.2016.02.031: 0 to 25 % more fuel; "
    "range: 5 to 100 % of a drag area of 0.65 m² (estimate)",
    confused_with=("aero_drag", "drivetrain_loss_speed"),
    shown_by="one car's fast drives before and after a date, or beside others of its model",
    words="something adds {value} m² of drag area",
)
def roof_load(speed: Floats, air_density: Floats) -> Floats:
    """Rack, box or sign on the roof: P = 1/2 ρ v^3, times the added drag area.

    The shape is that of drag itself. The effect shows only where it comes and goes: in one car, or from a date on.
    """
    return 0.5 * air_density * speed * speed * speed
