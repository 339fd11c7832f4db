"""Test the effects of motor, brakes and load against manual calculations."""

import pytest

from tests.support.one_row import power


def test_speed_loss_of_1_6_newton_seconds_per_metre_takes_a_kilowatt_at_90_km_h():
    assert 1.6 * power("drivetrain_loss_speed", speed=25) == pytest.approx(1000)
    assert power("drivetrain_loss_speed", speed=0) == 0


def test_torque_loss_grows_with_force_squared_in_both_directions():
    """A coefficient of 1.4e-4 W/N^2 gives 1.26 kW at 3 kN, which is 950 N m at the wheels."""
    assert 1.4e-4 * power("drivetrain_loss_torque", traction=3000) == pytest.approx(1260)
    assert power("drivetrain_loss_torque", traction=-3000) == power("drivetrain_loss_torque", traction=3000)
    assert power("drivetrain_loss_torque", traction=0) == 0


def test_brake_drag_of_40_newtons_takes_800_w_at_72_km_h():
    assert 40 * power("brake_drag", speed=20) == pytest.approx(800)


def test_payload_power_matches_manual_calculation():
    """A load of 10 kg takes 10 kg * 9.81 * 0.010 * 15 = 14.7 W at steady 15 m/s; up 5 % at 1 m/s^2, 236 W more."""
    level = {"rolling_resistance": 0.01, "grade": 0, "acceleration": 0, "speed": 15}
    assert 10 * power("payload", occupants=2, **level) == pytest.approx(14.71, abs=0.01)
    assert 10 * power("payload", occupants=4, **level) == pytest.approx(3 * 14.71, abs=0.03)
    steep = level | {"grade": 0.05, "acceleration": 1}
    assert 10 * power("payload", occupants=2, **steep) == pytest.approx(
        14.69 + 10 * 15 * (9.80665 * 0.05 + 1), abs=0.01
    )
    assert power("payload", occupants=1, **steep) == 0


def test_age_takes_a_share_of_driving_power_that_grows_with_the_odometer():
    """A share of 3 % per 100,000 km takes 450 W at 150,000 km and 10 kW; braking or new cars take none."""
    assert 0.03 * power("age", traction=500, braking_force=0, speed=20, odometer=1.5e8) == pytest.approx(450)
    assert power("age", traction=-500, braking_force=500, speed=20, odometer=1.5e8) == 0
    assert power("age", traction=500, braking_force=0, speed=20, odometer=0) == 0


def test_power_loss_grows_with_the_square_of_the_driving_power():
    """The loss is 2.5 % of 10 kW, 250 W, and four times as much at 20 kW, driving or braking."""
    assert 2.5e-6 * power("drivetrain_loss_power", wheel_power=10_000) == pytest.approx(250)
    assert 2.5e-6 * power("drivetrain_loss_power", wheel_power=20_000) == pytest.approx(1000)
    assert power("drivetrain_loss_power", wheel_power=-10_000) == power("drivetrain_loss_power", wheel_power=10_000)
