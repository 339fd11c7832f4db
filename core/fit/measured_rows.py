"""Join the window table with its ride table: the measured rows to which physical models are fitted.

The total of a ride hides when its energy was drawn. Fits of physics and diagnosis therefore use windows of about one
minute where voltage and current are measured.

Where only the state of charge is measured, a window lasts until the state of charge changes. An unknown consumer then
shortens the very window in which it is sought, which biases everything that is fitted to the window. In that case the
whole ride is one row, because its ends do not depend on its energy.

All windows of a metered ride are metered. A choice of the more certain measurement window by window would select
windows by their energy.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.errors import ModelError
from socast.core.fit.measurement_noise import is_metered
from socast.core.fit.ride_blocks import ENERGY, find_measured, get_numbers

RIDE_COLUMNS: Final = ("ride_id", "date", "winter", "summer", "fit_for_training", "unfit_reason")
"""Columns of the ride table that each window receives."""
ENERGY_SD: Final = "energy_sd_kwh"


def join_tables(rides: pd.DataFrame, windows: pd.DataFrame) -> pd.DataFrame:
    """Return the measured rows of rides fit for training: their windows, or the whole ride where no meter measures."""
    for table, what in ((rides, "ride"), (windows, "window")):
        if lacking := [name for name in ("ride_key", "vehicle_id", "start_s", ENERGY) if name not in table]:
            raise ModelError(f"the {what} table has no column {lacking[0]!r}: make the tables again, `socast tables`")
    keys = pd.Index(rides["ride_key"])
    if not keys.is_unique:
        twice = keys[keys.duplicated()][0]
        raise ModelError(f"ride {twice} is in the ride table twice: give each recording's tables once")
    place = keys.get_indexer(windows["ride_key"])
    if len(keys) + len(place) and not (place >= 0).any():
        raise ModelError("no window belongs to any of the rides: give the windows.parquet that was made with the rides")
    good, by_power = find_measured(rides), is_metered(rides)
    own = {name: rides[name].to_numpy()[place] for name in RIDE_COLUMNS if name in rides}
    own |= {ENERGY: get_numbers(windows, "energy_vi_kwh"), ENERGY_SD: get_numbers(windows, "energy_vi_sd_kwh")}
    kept = (
        (place >= 0) & (good & by_power)[place] & np.isfinite(own[ENERGY]) & (get_numbers(windows, "duration_s") > 0.0)
    )
    others = windows.drop(columns=[name for name in own if name in windows])
    parts = pd.concat([others, pd.DataFrame(own, index=windows.index)], axis=1).loc[kept]
    whole = rides.loc[good & ~by_power, [name for name in parts.columns if name in rides]]
    table = pd.concat([parts, whole], ignore_index=True) if len(whole) else parts
    begin = table.groupby("ride_key", sort=False)["start_s"].transform("min")  # clock steps can interleave rides
    order = np.lexsort((get_numbers(table, "start_s"), pd.factorize(table["ride_key"])[0], begin))
    return table.iloc[order].sort_values("vehicle_id", kind="stable", ignore_index=True)
