"""Test that a car with a mean power that it does not announce is named."""

import numpy as np

from socast.core.wire.messages import Telemetry
from socast.tools.importers.drive import make_message
from socast.tools.terminal.fault_report import find_mean_powers
from tests.support.own_tables import make_drive

FINE = 10
"""Rows of the drive in a sample of 3 s."""


def make_block(name, covers):
    """Return the samples of a car whose power covers some rows of the drive beside each sample."""
    d = make_drive(400 * FINE, 0.3)
    sums = np.append(0.0, np.cumsum(d["power"]))
    low, high = covers
    at = FINE * np.arange(2, 398)
    power = (sums[at + high] - sums[at + low]) / (high - low)
    return [
        make_message(
            f"fleet/{name}/telemetry",
            Telemetry(
                name, time, speed_kmh=speed * 3.6, battery_voltage_v=360.0, battery_current_a=float(watts) / 360.0
            ),
        )
        for time, speed, watts in zip(d["time"][at].tolist(), d["speed"][at].tolist(), power, strict=True)
    ]


def test_mean_power_is_named_unless_the_car_announces_it():
    blocks = [make_block("mean", (-FINE, 0)), make_block("moment", (0, 1)), make_block("said", (-FINE, 0))]
    found = find_mean_powers(blocks, {"said"})
    assert list(found) == ["mean"]
    assert "announce power_covers 'before'" in found["mean"]
