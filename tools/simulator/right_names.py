"""List the effects of the library that are right names for a hidden effect of the simulator."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from socast.tools.simulator.hidden_shapes import strip_shape

RIGHT_NAMES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "drivetrain_loss": ("drivetrain_loss_power", "drivetrain_loss_torque", "drivetrain_loss_speed"),
        "humidity": ("humidity", "demisting"),
    }
)
"""Right names where the library has another name for a cause than the simulator, or several names.

`drivetrain_loss`: the loss of the simulator grows with the square of the power at the wheels. The library has one
effect that grows with the square of the power, one with the square of the force and one with that of the speed.
Together they make up the loss. `humidity`: the effect of the simulator is the drying of damp air, by relative humidity.
The library calls that `demisting`, and calls the latent load of cooling, by vapour pressure, `humidity`. Both dry air.
"""


def get_right_names(effect: str) -> tuple[str, ...]:
    """Return the effects of the library that are right names for a hidden effect."""
    return RIGHT_NAMES.get(strip_shape(effect), (strip_shape(effect),))
