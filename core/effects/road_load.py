"""The base effects: the road load of a car, and the power of its accessories.

Each returns power per unit of its coefficient, for the force balance of a car on a road,

    F = m g (c cos θ + sin θ) + 1/2 ρ A_d (v + w)|v + w| + m a,    power = F v,

with mass m, gravity g, rolling resistance c, road angle θ, air density ρ, drag area A_d, speed v, headwind w and
acceleration a.

A NaN in any column that an effect takes gives NaN in that row and nowhere else: no effect guesses. The meaning of an
unknown wind or grade is decided where the columns are made. Only `auxiliary` has a value in every row.

References
----------
Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4, "Road Loads". De Cauwer, Van Mierlo, Coosemans, Energies 8
(2015) 8573, DOI 10.3390/en8088573, whose equation is eq. (1) of "Predicting Electric Vehicle Consumption: A Hybrid
Physical-Empirical Model".
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import GRAVITY, STANDARD_AIR_DENSITY
from socast.core.effects.declaration import Expectation, Parameter, effect
from socast.core.vehicles import ACCESSORIES, AccessoryCurve

_GRAVITY: Final = {"gravity": Parameter(GRAVITY, "m/s^2")}
_BALANCE: Final = "De Cauwer et al. 2015, Energies 8:8573, DOI 10.3390/en8088573"
_POWERTRAIN: Final = (
    "mean: 1 over driveline times motor efficiency, 0.92 times 0.91, Fiori, Ahn and Rakha 2016, Applied Energy "
    "168:257, DOI 10.1016/j.apenergy.2016.01.097"
)
_DRAG_AREAS: Final = "range: Hucho (ed.), Aerodynamics of Road Vehicles, SAE 1998, cars, and roof loads"


@effect(
    coefficient="rolling resistance coefficient",
    unit="1",
    low=0.004,
    high=0.025,
    source="Gillespie 1992, ch. 4; range: TRB Special Report 286 (2006), DOI 10.17226/11620, and wet or cold roads",
    parameters=_GRAVITY,
    confused_with=("brake_drag", "tyre_pressure"),
    expected=Expectation(
        1.25,
        0.25,
        f"{_POWERTRAIN}, 5 % for cold and wet roads; spread (estimate): tyres 0.15, road and weather 0.15, losses 0.1",
        of="rolling_resistance",
    ),
)
def rolling(mass: Floats, grade: Floats, speed: Floats, gravity: float) -> Floats:
    """Tyres that flex: P = m g cos θ v, times c.

    The effect does not depend on speed, temperature or water: see `socast.core.effects.tyres`.
    """
    return mass * speed * gravity * np.sqrt(1.0 - grade * grade)


@effect(
    coefficient="share of the climb paid",
    unit="1",
    low=0.6,
    high=1.6,
    source=f"{_BALANCE}; range: 1 at the wheel, drivetrain and regeneration losses about it",
    parameters=_GRAVITY,
    expected=Expectation(1.1, 0.1, "estimate: 1 both ways at the wheel, losses uphill; spread: losses and load"),
)
def climbing(mass: Floats, grade: Floats, speed: Floats, gravity: float) -> Floats:
    """Potential energy: P = m g sin θ v, negative downhill."""
    return mass * speed * gravity * grade


@effect(
    coefficient="share of the climb paid uphill",
    unit="1",
    low=0.8,
    high=1.8,
    source=f"{_BALANCE}, uphill part; range: 1 at the wheel, 1/efficiency at the battery",
    parameters=_GRAVITY,
    expected=Expectation(1.19, 0.15, f"{_POWERTRAIN}; spread (estimate): losses 0.1, load 0.1"),
)
def climbing_up(mass: Floats, grade: Floats, speed: Floats, gravity: float) -> Floats:
    """Potential energy gained uphill: P = m g max(sin θ, 0) v."""
    return mass * speed * gravity * np.maximum(grade, 0.0)


@effect(
    coefficient="share of the descent regained",
    unit="1",
    low=0.0,
    high=1.0,
    source=f"{_BALANCE}, downhill part; range: 0 friction brakes only, 1 perfect regeneration",
    confused_with=("braking",),
    parameters=_GRAVITY,
    expected=Expectation(0.75, 0.2, "estimate: the same losses on the way back, and friction brakes"),
)
def climbing_down(mass: Floats, grade: Floats, speed: Floats, gravity: float) -> Floats:
    """Potential energy regained downhill: P = m g min(sin θ, 0) v, never positive."""
    return mass * speed * gravity * np.minimum(grade, 0.0)


@effect(
    coefficient="drag area",
    unit="m^2",
    low=0.3,
    high=2.0,
    source=f"{_BALANCE}; {_DRAG_AREAS}",
    parameters={"air_density_standard": Parameter(STANDARD_AIR_DENSITY, "kg/m^3")},
    confused_with=("drivetrain_loss_speed", "roof_load"),
    expected=Expectation(
        1.2, 0.2, f"{_POWERTRAIN}; spread (estimate): catalogue 0.1, wind and air 0.15, losses 0.1", of="drag_area_m2"
    ),
)
def aero_drag(speed: Floats, air_density_standard: float) -> Floats:
    """Drag in still standard air: P = 1/2 ρ0 v^3, times A_d.

    ρ0 is 1.225 kg/m^3 (ISO 2533:1975). Air at -20 °C is 14 % denser, which this effect ignores: see `aero_drag_wind`.
    """
    return speed * speed * speed * (0.5 * air_density_standard)


@effect(
    coefficient="drag area",
    unit="m^2",
    low=0.3,
    high=2.0,
    source=f"Gillespie 1992, ch. 4, relative wind; {_DRAG_AREAS}",
    expected=Expectation(
        1.2, 0.2, f"{_POWERTRAIN}; spread (estimate): catalogue 0.1, wind and air 0.15, losses 0.1", of="drag_area_m2"
    ),
)
def aero_drag_wind(speed: Floats, headwind: Floats, air_density: Floats) -> Floats:
    """Drag in air of the actual density and wind: P = 1/2 ρ (v + w)|v + w| v, times A_d.

    The power is negative where a tail wind overtakes the car, and zero for a standing car, on which wind does no work.
    Crosswind is ignored.
    """
    relative = speed + headwind
    return 0.5 * air_density * relative * np.abs(relative) * speed


@effect(
    coefficient="inertial mass over mass",
    unit="1",
    low=0.6,
    high=1.6,
    source=f"{_BALANCE}; range: 1 for the car as a point, a few percent more with rotating parts, losses about it",
    expected=Expectation(1.1, 0.15, "estimate: 4 % of rotating parts, losses; spread: losses, load"),
)
def inertia(mass: Floats, acceleration: Floats, speed: Floats) -> Floats:
    """Kinetic energy: P = m a v, negative when slowing."""
    return mass * acceleration * speed


@effect(
    coefficient="share of kinetic energy paid",
    unit="1",
    low=0.8,
    high=1.8,
    source=f"{_BALANCE}, speeding up; range: 1 at the wheel, rotating parts and 1/efficiency at the battery",
    expected=Expectation(1.2, 0.12, f"{_POWERTRAIN}; spread (estimate): losses, load"),
)
def inertia_positive(mass: Floats, acceleration: Floats, speed: Floats) -> Floats:
    """Kinetic energy gained: P = m max(a, 0) v."""
    return mass * speed * np.maximum(acceleration, 0.0)


@effect(
    coefficient="share of kinetic energy saved",
    unit="1",
    low=0.0,
    high=1.8,
    source=f"{_BALANCE}, slowing; range: 0 friction brakes only, up to that of speeding up beside `braking`",
    confused_with=("braking", "cornering"),
    expected=Expectation(1.2, 0.12, f"as `inertia_positive`, because `braking` has the loss; {_POWERTRAIN}"),
)
def inertia_negative(mass: Floats, acceleration: Floats, speed: Floats) -> Floats:
    """Kinetic energy saved by slowing: P = m min(a, 0) v, never positive.

    Kinetic energy that overcomes the road load saves its worth at the battery, 1/efficiency, as it was paid. The rest
    is the loss that `braking` describes. In a model without `braking`, the coefficient is the share regained, up to 1.
    """
    return mass * speed * np.minimum(acceleration, 0.0)


@effect(
    coefficient="loss at the battery over braking energy",
    unit="1",
    low=0.0,
    high=1.4,
    source="Larminie and Lowry, Electric Vehicle Technology Explained, 2nd ed., Wiley 2012, ch. 8, regenerative "
    "braking; range: 0 perfect regeneration, 1/efficiency friction brakes only",
    confused_with=("climbing_down", "inertia_negative"),
    expected=Expectation(
        0.4,
        0.15,
        "1/0.84 - 0.84 x 0.94 = 0.4: losses both ways, and the share exp(-0.0411 m/s^2 / d) that brakes regain at a "
        "deceleration d, Fiori, Ahn and Rakha 2016, DOI 10.1016/j.apenergy.2016.01.097: 0.94 at 0.7 m/s^2 (estimate: "
        "town traffic); spread (estimate): cars and their brakes",
    ),
)
def braking(braking_force: Floats, speed: Floats) -> Floats:
    """Braking energy that is not regained: P = mean of max(-F, 0) over a step, times v, with F of the car's road load.

    The mean includes braking between two samples, as estimated from changes of the acceleration.

    Powertrains lose both ways. With an efficiency η when driving and η_r when braking, the power at the battery is
    F v / η + (1/η - η_r) max(-F, 0) v. The other base effects have coefficients of 1/η at every sign, and this
    one has 1/η - η_r. It is 1/η, above 1, where only friction brakes act: the battery delivered 1/η for each unit of
    kinetic energy that the brakes turn into heat.
    """
    return braking_force * speed


@effect(
    coefficient="accessory power over the reference curve",
    unit="1",
    low=0.2,
    high=3.0,
    source=f"{_BALANCE}, eq. (2) of the hybrid model's paper; curve: Vehicle Energy Dataset, arXiv:1905.02081",
    per="time",
    parameters={
        "heating_full": Parameter(ACCESSORIES.heating_full, "K", 233.15, 268.15),
        "heating_off": Parameter(ACCESSORIES.heating_off, "K", 273.15, 293.15),
        "cooling_on": Parameter(ACCESSORIES.cooling_on, "K", 290.15, 301.15),
        "cooling_full": Parameter(ACCESSORIES.cooling_full, "K", 301.65, 318.15),
        "heating": Parameter(ACCESSORIES.heating, "W", 500.0, 8000.0),
        "standby": Parameter(ACCESSORIES.standby, "W", 0.0, 1500.0),
        "cooling": Parameter(ACCESSORIES.cooling, "W", 200.0, 5000.0),
    },
    confused_with=("cabin_cooling", "cabin_heating"),
    expected=Expectation(1.0, 0.4, "estimate: drives of one car, arXiv:1905.02081; other cars and drivers differ"),
)
def accessories(
    ambient: Floats,
    accessory_scale: Floats,
    *,
    heating_full: float,
    heating_off: float,
    cooling_on: float,
    cooling_full: float,
    heating: float,
    standby: float,
    cooling: float,
) -> Floats:
    """Climate control and all else on board: P = s P_aux(T), in five segments of outside temperature T.

    s is the car's own scale; see `socast.core.vehicles.AccessoryCurve`.
    """
    curve = AccessoryCurve(heating_full, heating_off, cooling_on, cooling_full, heating, standby, cooling)
    return accessory_scale * curve.power(ambient)


@effect(
    coefficient="constant power",
    unit="W",
    low=0.0,
    high=3000.0,
    source="energy balance; range: some 0.3 kW of control units, pumps and lights, up to all of climate control",
    per="time",
    confused_with=("standby",),
    expected=Expectation(800.0, 500.0, "estimate: 0.3 kW of control units, and climate control over a year"),
)
def auxiliary(dt: Floats) -> Floats:
    """Consumers that are always on: P = 1, times a constant power."""
    return np.ones_like(dt, dtype=np.float64)
