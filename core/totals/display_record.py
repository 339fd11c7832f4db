"""The record of what the display of a car stands for: the columns that `socast.core.totals.display_yield` learns."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

DISPLAY_YIELD: Final = np.dtype(
    [
        ("inverse", "f8"),  # of the usable capacity [1/kWh]
        ("curve", "f8"),  # of the energy over the charge [1]
        ("inverse_variance", "f8"),  # [1/kWh^2]
        ("covariance", "f8"),  # of both [1/kWh]
        ("curve_variance", "f8"),  # [1]
        ("reading_variance", "f8"),  # of a fall of the charge, beyond that of its quantum [1]
        ("contradicted", "f8"),  # 1 where a healthy charge and V·I contradict each other
    ]
)
"""What the state of charge of a car stands for, see `socast.core.totals.display_yield`."""


def create_unknown_yields(rows: int) -> NDArray[Any]:
    """Return the yields of displays of which nothing is known.

    Returns
    -------
    (rows,) DISPLAY_YIELD
        NaN in every field but `contradicted`, which is 0.
    """
    return _UNKNOWN.repeat(rows)


_UNKNOWN: Final = np.array([(np.nan,) * (len(DISPLAY_YIELD.names or ()) - 1) + (0.0,)], DISPLAY_YIELD)
