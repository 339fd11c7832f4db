"""Gather the columns of energy by which sampling distorts windows: what a model must not mistake for an effect.

Voltage, current and speed are sampled every few seconds, and not quite at the same time.

- Lag: power that is measured a second after the motion belongs, by the change of the power, to another window.
- Unresolved braking: a car that brakes between two samples loses energy that no sample shows. The tables contain an
  estimate (`socast.core.signals.signals.compute_braking_force`), which is uncertain.

A fit estimates both beside its coefficients, with priors, and diagnosis projects them off. No prediction contains them:
the lag nearly cancels over a ride, and the coefficient of unresolved braking is what its estimate lacks, about zero. In
the recording of the tutorial, it shifts predictions by 0.4 %.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.columns import JOULES_PER_KWH
from socast.core.fit.ride_blocks import get_numbers_if_present

DISTORTED_COLUMNS: Final = ("power_start_w", "power_end_w", "unresolved_braking_kwh")
"""Columns of the tables from which the distortions are computed; a ride table has the last one only."""
DISTORTIONS: Final = {"power_lag_s": 1.0, "unresolved_braking_share": 0.4}
"""Standard deviation of the coefficient of each column about zero.

The lag is that of two instruments that sample every 1 to 3 s [s]. Unresolved braking may be twice its estimate or none,
times the usual share of braking energy that is lost [1].
"""


DISTORTIONS_BESIDE_LOSSES: Final = DISTORTIONS | {"unresolved_braking_share": 0.2}
"""The same beside a term of losses by torque, which tells of hard driving.

Without such a term, the estimate of unresolved braking takes its place: in 63 drives of a Model 3 at 1 Hz its
coefficient becomes -0.8, and predictions, which do not have it, are 3 % too high. Twice the estimate and none are then
two standard deviations. Chosen on that car; those of a Leaf and an i3 at 1 to 3 s do not depend on it.
"""


def gather_distortions(table: pd.DataFrame) -> Floats:
    """Return the columns of `DISTORTIONS`, zero where a table does not have them.

    Returns
    -------
    (n, 2) float
        Change of the power from the first to the last sample [kWh/s]; estimate of the unresolved braking energy [kWh].
    """
    start, end, unresolved = (get_numbers_if_present(table, name, 0.0) for name in DISTORTED_COLUMNS)
    return np.column_stack([np.nan_to_num(end - start) / JOULES_PER_KWH, np.nan_to_num(unresolved)])
