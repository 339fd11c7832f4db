"""Effects of tyres and road beyond a constant rolling resistance: cold, water, snow, low pressure, bends.

The base has P = c m g cos θ v. A coefficient here adds to c; in words it is a share of 0.010, typical of a car.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.effects.declaration import Expectation, Parameter, effect

_VTI: Final = "Carlson and Vieira 2018, VTI rapport 971"


@effect(
    coefficient="growth of the rolling resistance coefficient",
    unit="1/K",
    low=2.5e-5,
    high=3.75e-4,
    source="UN Regulation 117, annex 6, 6.2, and ISO 28580:2018: 0.8 % a kelvin of a car's tyres about 25 °C; range: "
    "0.2 to 3 % of 0.010 at the wheels, times 1.25, the energy at the battery over that at the wheels",
    parameters={"reference": Parameter(293.15, "K", 268.15, 303.15, grid=(278.15, 283.15, 288.15, 293.15, 298.15))},
    confused_with=("air_density", "battery_resistance", "cabin_heating", "cold_regen_limit", "snow"),
    shown_by="drives at one speed over a year; slow ones, where air does little, distinguish it from denser air",
    words="cold tyres: rolling resistance grows by {value} % of 0.010 for each degree below {reference}",
    scale=1e4,
    expected=Expectation(
        1.25e-4,
        1e-4,
        "1 % a kelvin of 0.010 at the wheels, between ISO 28580:2018 and winter tyres, 1.25 times that at the battery; "
        "spread (estimate)",
    ),
)
def cold_rolling(tyre_load: Floats, speed: Floats, ambient: Floats, reference: float) -> Floats:
    """Rubber that loses more in the cold: P = m g cos θ max(T0 - T, 0) v, times the growth of c per kelvin.

    T is the outside temperature; the warming of rolling tyres is part of the coefficient.
    """
    return tyre_load * speed * np.maximum(reference - ambient, 0.0)


@effect(
    coefficient="added rolling resistance coefficient on a wet road",
    unit="1",
    low=0.0003,
    high=0.008,
    source=f"{_VTI}, a review of 50 reports: water must be pushed aside and cools the tyre; range: 3 to 80 % of 0.010 "
    "(estimate)",
    parameters={"depth": Parameter(0.0003, "m", 0.00003, 0.003, grid=(0.0001, 0.0003, 0.001))},
    confused_with=("demisting", "humidity", "snow"),
    shown_by="the same roads in rain, in the hours after it and dry, above freezing, with a weather station near",
    words="wet road: rolling resistance is higher by {value} % of 0.010 where water is much deeper than {depth}",
    scale=1e4,
)
def wet_road(tyre_load: Floats, speed: Floats, water: Floats, depth: float) -> Floats:
    """Water under the tyres: P = m g cos θ (1 - exp(-h/h0)) v, times the added c.

    h is the water on the road, from rain and drying, see `socast.core.signals.weather`. Beyond a few h0 more water
    makes no difference.
    """
    return tyre_load * speed * (1.0 - np.exp(-water / depth))


@effect(
    coefficient="added rolling resistance coefficient on snow",
    unit="1",
    low=0.001,
    high=0.05,
    source=f"{_VTI}, a review of 50 reports: snow must be pressed and pushed aside; range: from slush in the ruts to "
    "some centimetres of loose snow (estimate)",
    parameters={"depth": Parameter(0.002, "m", 0.0001, 0.03, grid=(0.0005, 0.002, 0.008))},
    confused_with=("cold_rolling", "wet_road"),
    shown_by="drives during snowfall and in the hours after, beside days as cold without it",
    words="snow: rolling resistance is higher by {value} % of 0.010 where more than {depth} of it, melted, lies",
    scale=1e4,
)
def snow(tyre_load: Floats, speed: Floats, snow: Floats, depth: float) -> Floats:
    """Snow under the tyres: P = m g cos θ (1 - exp(-s/s0)) v, times the added c.

    s is the snow on the road as melted water, from snowfall and clearing, see `socast.core.signals.weather`. 2 mm
    melted are about 2 cm of fresh snow.
    """
    return tyre_load * speed * (1.0 - np.exp(-snow / depth))


@effect(
    coefficient="added rolling resistance coefficient",
    unit="1",
    low=0.0003,
    high=0.006,
    source="TRB Special Report 286 (2006), ch. 3, DOI 10.17226/11620: the less pressure, the more rolling resistance; "
    "range: 3 to 60 % of 0.010, at about 2 % for each 10 kPa that is missing (estimate)",
    confused_with=("brake_drag", "rolling"),
    shown_by="one car's drives before and after a date, or beside others of its model, with loads that differ",
    words="soft tyres: rolling resistance is higher by {value} % of 0.010",
    scale=1e4,
)
def tyre_pressure(tyre_load: Floats, speed: Floats) -> Floats:
    """Tyres with too little air: P = m g cos θ v, times the added c.

    The shape is that of rolling itself. The effect shows only where it comes and goes: in one car, or from a date on.
    """
    return tyre_load * speed


@effect(
    coefficient="cornering compliance of all tyres",
    unit="1/N",
    low=2e-6,
    high=3e-5,
    source="Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 6, slip angles; range: cornering coefficients "
    "of 0.05 to 0.3 of the load a degree, at 1200 to 2300 kg",
    parameters={"grip": Parameter(6.0, "m/s^2")},
    confused_with=("inertia_negative",),
    shown_by="winding roads and roundabouts, taken fast, beside straight ones",
    words="bends: the tyres yield by {value} rad for each meganewton of side force",
    scale=1e6,
)
def cornering(mass: Floats, speed: Floats, turn_rate: Floats, grip: float) -> Floats:
    """Tyres that slip sideways in bends: P = (m min(v |ω|, a_max))^2 v, times 1/C.

    A side force m v ω needs the slip angle m v ω / C, with cornering stiffness C, and is tilted back by that angle.
    Side accelerations above a_max are errors of the position, and are limited to a_max.
    """
    side = mass * np.minimum(speed * np.abs(turn_rate), grip)
    return side * side * speed
