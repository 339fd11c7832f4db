"""Effects of motor, gears, brakes and load beyond a constant efficiency."""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import GRAVITY
from socast.core.effects.declaration import Expectation, Parameter, effect

_LOSSES: Final = "Larminie and Lowry, Electric Vehicle Technology Explained, 2nd ed., Wiley 2012, ch. 7, motor losses"


@effect(
    coefficient="loss per speed squared",
    unit="N*s/m",
    low=0.1,
    high=6.0,
    source=f"{_LOSSES}: iron losses grow with speed, eddy currents with its square; range: 0.06 to 3.8 kW at 90 km/h "
    "(estimate)",
    confused_with=("aero_drag", "brake_drag", "roof_load"),
    shown_by="steady drives at many speeds: it grows faster than rolling and slower than drag",
    words="motor and gears lose {value} kW at 90 km/h by turning",
    scale=0.625,
    expected=Expectation(1.0, 1.5, "estimate: gears and bearings, and 1 % of iron loss; drivetrains differ widely"),
)
def drivetrain_loss_speed(speed: Floats) -> Floats:
    """Iron and oil that are stirred: P = v^2, times the loss per speed squared."""
    return speed * speed


@effect(
    coefficient="loss per force squared",
    unit="W/N^2",
    low=1e-5,
    high=8e-4,
    source=f"{_LOSSES}: copper losses grow with torque squared; range: 0.1 to 8 kW at a force of 3160 N, 1000 N m at "
    "the wheels (estimate)",
    confused_with=("age", "battery_resistance", "drivetrain_loss_power", "payload"),
    shown_by="hard and gentle driving over the same roads",
    words="motor and inverter lose {value} W at a force of 1000 N at the wheels",
    scale=1e6,
    expected=Expectation(2e-4, 2e-4, "estimate: copper loss of 2 % at 3 kN and 50 km/h; motors differ widely"),
)
def drivetrain_loss_torque(traction: Floats) -> Floats:
    """Copper that carries current: P = F^2, times the loss per force squared.

    F is the force at the wheels, torque over wheel radius, as the car's own road load demands it.
    """
    return traction * traction


@effect(
    coefficient="loss over the square of the power",
    unit="1/W",
    low=2e-8,
    high=5e-6,
    source=f"{_LOSSES}: copper and switching losses grow with the square of the current, and so, at the battery's "
    "voltage, of the power; range: 0.2 to 20 % at 40 kW",
    confused_with=("battery_resistance", "drivetrain_loss_torque"),
    shown_by="hard and gentle driving at the same speed, by a car whose battery's temperature varies",
    words="powertrain losses: {value} % of the power at 10 kW",
    scale=1e6,
    expected=Expectation(5e-7, 1e-6, "estimate: 1 % at 20 kW in battery and inverter; batteries differ widely"),
)
def drivetrain_loss_power(wheel_power: Floats) -> Floats:
    """Losses of inverter and motor with the current: P = (F v)^2, times the loss over the square of the power."""
    return wheel_power * wheel_power


@effect(
    coefficient="drag of the brake pads",
    unit="N",
    low=5.0,
    high=150.0,
    source="SAE 2015-01-2670, Drag Torque in Disk Brakes, DOI 10.4271/2015-01-2670; range: 0.4 to 11 N m a wheel of "
    "0.3 m (estimate)",
    confused_with=("age", "drivetrain_loss_speed", "rolling", "tyre_pressure"),
    shown_by="one car's drives before and after a date, or beside others of its model, with loads that differ",
    words="brakes that drag with {value} N",
)
def brake_drag(speed: Floats) -> Floats:
    """Brake pads that do not release: P = v, times the drag.

    The force depends neither on load nor on speed.
    """
    return speed


@effect(
    coefficient="mass per passenger beyond the 75 kg counted",
    unit="kg",
    low=-60.0,
    high=150.0,
    source="Regulation (EU) No 1230/2012, Art. 2(4)(a): 75 kg a driver; range: a child to twice a person (estimate)",
    parameters={"gravity": Parameter(GRAVITY, "m/s^2")},
    confused_with=("drivetrain_loss_torque",),
    shown_by="rides with and without passengers over the same roads, where cars report their passengers",
    words="each passenger weighs 75 kg and {value} kg",
)
def payload(
    occupants: Floats,
    rolling_resistance: Floats,
    grade: Floats,
    acceleration: Floats,
    speed: Floats,
    gravity: float,
) -> Floats:
    """Passengers and what they carry: P = (n - 1) (g (c cos θ + sin θ) + a) v, times a mass.

    n people are aboard, one of them the driver; the car's mass already includes 75 kg for each. The power is negative
    downhill and while the car slows.
    """
    road = rolling_resistance * np.sqrt(1.0 - grade * grade) + grade
    return (occupants - 1.0) * (gravity * road + acceleration) * speed


@effect(
    coefficient="share of driving power lost after 100,000 km",
    unit="1",
    low=0.005,
    high=0.2,
    source="estimate: bearings, gears, tyres and resistances that wear, 0.5 to 20 % after 100,000 km",
    parameters={"span": Parameter(1e8, "m")},
    confused_with=("brake_drag", "drivetrain_loss_torque"),
    shown_by="cars of one model with few and with many kilometres, or years of the same car",
    words="wear: {value} % more driving power for every 100,000 km",
    scale=100.0,
)
def age(traction: Floats, braking_force: Floats, speed: Floats, odometer: Floats, span: float) -> Floats:
    """Wear: P = max(F, 0) v s/s0, times the share lost after s0 = 100,000 km.

    s is the odometer's reading, and F the force at the wheels as the car's own road load demands it. max(F, 0)
    is F plus the braking force. Where the state of charge measures energy, a faded battery looks the same.
    """
    driving = np.maximum(traction + braking_force, 0.0)
    return driving * speed * (odometer / span)
