"""A few shifts as examples: how the forecast of the end narrowed while the car drove."""

from typing import Any, Final

import numpy as np
import pandas as pd

from core.evaluate.soc.cases import SHIFT_KEY, normalise_keys

MOST_POINTS: Final = 240
"""Forecasts that an example has at most."""
EXAMPLE_HOURS_AHEAD: Final = 2
"""Of the forecast by which shifts are told apart. [h]"""
EXAMPLE_COLUMNS: Final = ("soc", "soc_mean", "soc_p05", "soc_p95")


def select_examples(cases: pd.DataFrame, outlooks: pd.DataFrame) -> list[dict[str, Any]]:
    """Return shifts that a reader should see: the coldest, the warmest, a middling and the worst forecast of all.

    Among those with a forecast at the earliest time ahead that any has, up to `EXAMPLE_HOURS_AHEAD`.

    Returns
    -------
    list of dict
        `why` it is shown, `vehicle_id`, `vehicle_model`, `shift`, `date`, `ambient_c`, `soc_end_pct`,
        `reserve_soc_pct`, and of its forecasts `hours_ahead` of the end and `EXAMPLE_COLUMNS` in per cent.
    """
    ahead = min(EXAMPLE_HOURS_AHEAD, int(cases["hours"].max()))
    found = cases[cases["hours"] == ahead].reset_index(drop=True)
    error = (found["soc_mean_pct"] - found["soc_end_pct"]).abs()
    by_warmth = found["ambient_c"].dropna().sort_values(kind="stable").index.tolist()
    by_error = error.sort_values(kind="stable").index.tolist()
    asked = {"worst": by_error[-1], "middling": by_error[len(by_error) // 2]}
    if by_warmth:
        asked = {"coldest": by_warmth[0], "warmest": by_warmth[-1], **asked}
    chosen: dict[int, str] = {}
    for why, place in asked.items():
        chosen[place] = f"{chosen[place]}, {why}" if place in chosen else why
    made = normalise_keys(outlooks)
    return [_example(why, found.iloc[place], made) for place, why in chosen.items()]


def _example(why: str, case: "pd.Series[Any]", outlooks: pd.DataFrame) -> dict[str, Any]:
    """Return a shift and its forecasts, thinned out."""
    own = outlooks[(outlooks[SHIFT_KEY[0]] == case[SHIFT_KEY[0]]) & (outlooks[SHIFT_KEY[1]] == case[SHIFT_KEY[1]])]
    own = own[own["time_s"] <= case["end_s"]].sort_values("time_s", kind="stable")
    own = own.iloc[np.unique(np.linspace(0, len(own) - 1, min(MOST_POINTS, len(own))).astype(int))]
    reserve = own["reserve_soc_pct"].dropna()
    return {
        "why": why,
        "vehicle_id": case["vehicle_id"],
        "vehicle_model": case["vehicle_model"],
        "shift": case["shift"],
        "date": str(pd.Timestamp(case["begin_s"], unit="s").date()),
        "ambient_c": case["ambient_c"],
        "soc_end_pct": case["soc_end_pct"],
        "reserve_soc_pct": reserve.iloc[-1] if len(reserve) else np.nan,
        "hours_ahead": ((case["end_s"] - own["time_s"]) / 3600.0).tolist(),
        **{f"{name}_pct": own[f"{name}_pct"].tolist() for name in EXAMPLE_COLUMNS},
    }
