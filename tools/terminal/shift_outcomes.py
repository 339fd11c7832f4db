"""The comparison of forecasts of each shift's end with its outcome, which `socast replay` prints last."""

from datetime import UTC, tzinfo
from typing import Any, Final

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from socast.core.evaluate.soc.cases import MOST_FORECAST_AGE, SHIFT_KEY
from socast.core.forecast.plan_tracker import CUT_SHORT_MARGIN
from socast.core.pipeline import Pipeline
from socast.tools.terminal.output import print_plain
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.time_zone import format_local, name_zone

AHEAD: Final = {"2h": 7200.0, "1h": 3600.0}
"""Lead times before a shift's end at which the report evaluates its forecast. [s]"""
MADE_AT: Final = ("begin", *AHEAD)
"""Names of the times at which the evaluated forecasts were made."""
MOST_SHIFTS: Final = 60
"""Largest number of shifts listed on a terminal; the JSON report lists all."""
MOST_ROWS: Final = 200_000
"""Number of stored forecasts above which those no longer needed are deleted."""
NO_INTERVALS: Final = (
    "the charge at the shift's end has no forecast, because there is no plan and too few shifts have ended: give "
    "recordings of earlier days with --warm-up REC"
)
_FIGURES: Final = {"mean": "soc_mean_pct", "p05": "soc_p05_pct", "p95": "soc_p95_pct"}


class ShiftOutcomes:
    """Collect the forecasts of shifts in progress, and compare those of ended shifts with the outcome.

    The caller calls the object after each list of messages.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._forecasts: list[pd.DataFrame] = []
        self._ended: list[pd.DataFrame] = []
        self._rows = 0
        self._newest = -np.inf
        self._records: list[dict[str, Any]] = []

    def __call__(self) -> None:
        """Collect the forecasts and the ended shifts of the pipeline since the last call."""
        forecasts, ended = self._pipeline.take_outlooks(), self._pipeline.take_shifts()
        self._newest = max(self._newest, forecasts["time_s"].max() if len(forecasts) else -np.inf)
        self._forecasts.append(forecasts[forecasts["soc_mean_pct"].notna()])
        self._ended.append(ended)
        self._rows += len(self._forecasts[-1])
        if self._rows > MOST_ROWS:
            self._settle()

    def records(self) -> list[dict[str, Any]]:
        """Return one record per ended shift, in order of their beginnings.

        Returns
        -------
        list of dict
            Each record has these fields:

            - `vehicle_id`, `vehicle_model`;
            - `begin_s`, `end_s`: Unix times of the shift's beginning and end [s];
            - `soc_begin_pct`, `soc_end_pct`: charge at the beginning, and charge as last reported [%];
            - `charged_s`: Unix time at which the car last charged after it had set out, or None [s];
            - `cut`: whether the recording ends before the shift;
            - `forecasts`: forecasts of the shift's end, by the name of the time at which they were made, see `MADE_AT`.

            A forecast is None if it does not exist. Otherwise it has `time_s` [s], `mean`, `p05`, `p95` [%] and `held`.
            `held` is whether the outcome was between `p05` and `p95`. It is None if the outcome is unknown, for example
            because the car charged after the forecast.
        """
        self()
        self._settle()
        return sorted(self._records, key=lambda shift: (shift["begin_s"], shift["vehicle_id"]))

    def _settle(self) -> None:
        """Make the records of ended shifts, and delete forecasts that are no longer needed."""
        if not self._forecasts:
            return
        forecasts, ended = pd.concat(self._forecasts), pd.concat(self._ended)
        of_shifts = dict(iter(forecasts.groupby(SHIFT_KEY, sort=False)))
        for _, shift in ended.iterrows():
            of_shift = of_shifts.pop(tuple(shift[name] for name in SHIFT_KEY), forecasts[:0])
            self._records.append(_record(shift, of_shift, self._newest))
        left = [_needed(of_shift) for of_shift in of_shifts.values()]
        self._forecasts, self._ended = [forecasts[:0], *left], [ended[:0]]
        self._rows = sum(map(len, left))


def _needed(forecasts: pd.DataFrame) -> pd.DataFrame:
    """Return the forecasts of a shift in progress that the report may still need: the first and the newest."""
    late = forecasts["time_s"] >= forecasts["time_s"].iloc[-1] - max(AHEAD.values()) - MOST_FORECAST_AGE
    late.iloc[0] = True
    kept: pd.DataFrame = forecasts.loc[late]
    return kept


def _record(shift: "pd.Series[Any]", forecasts: pd.DataFrame, newest: float) -> dict[str, Any]:
    """Return the record of a shift with its forecasts, which must be in order of time."""
    time = forecasts["time_s"].to_numpy(np.float64)
    places = {"begin": 0 if len(time) and time[0] <= shift["begin_s"] + MOST_FORECAST_AGE else -1}
    for name, ahead in AHEAD.items():
        at = shift["end_s"] - ahead
        place = int(np.searchsorted(time, at, side="right")) - 1
        places[name] = place if place >= 0 and time[place] >= at - MOST_FORECAST_AGE else -1
    names = ("vehicle_id", "vehicle_model", "begin_s", "end_s", "soc_begin_pct", "soc_end_pct", "charged_s")
    record = {name: None if pd.isna(shift[name]) else shift[name] for name in names}
    planned = forecasts["shift_end_s"][forecasts["planned"].astype(bool)]
    late = len(planned) > 0 and planned.iloc[-1] > shift["end_s"] + CUT_SHORT_MARGIN
    record["cut"] = bool(late and newest - shift["end_s"] < MOST_FORECAST_AGE)
    return record | {
        "forecasts": {
            name: _record_forecast(forecasts.iloc[place], record) if place >= 0 else None
            for name, place in places.items()
        }
    }


def _record_forecast(row: "pd.Series[Any]", shift: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a forecast of a shift's end, with whether the outcome was in its interval."""
    figures = {name: float(row[column]) for name, column in _FIGURES.items()}
    became, charged = shift["soc_end_pct"], shift["charged_s"]
    open_ = became is None or shift["cut"] or (charged is not None and charged >= row["time_s"])
    held = None if open_ else bool(figures["p05"] <= became <= figures["p95"])
    return {"time_s": float(row["time_s"])} | figures | {"held": held}


def show_outcomes(console: Console, shifts: list[dict[str, Any]], zone: tzinfo | None = UTC) -> None:
    """Print one row per ended shift, or the reason why there is no forecast to compare."""
    if not shifts:
        return
    if not any(forecast for shift in shifts for forecast in shift["forecasts"].values()):
        print_plain(console, NO_INTERVALS, wraps=True)
        return
    of_zone = name_zone([shift["begin_s"] for shift in shifts[-MOST_SHIFTS:]], zone)
    numbers = ("at its\nbeginning", "forecast\nthen", "2 h before\nthe end", "1 h before\nthe end", "outcome")
    columns = [
        *(Column(head, fixed=True) for head in ("car", f"shift, {of_zone}")),
        *(Column(head, number=True, fixed=True) for head in numbers),
        *(Column(head, fixed=True) for head in ("held", "")),
    ]
    caption = "in brackets: 90 % interval"
    caption += f"; the last {MOST_SHIFTS} of {len(shifts):,} shifts" if len(shifts) > MOST_SHIFTS else ""
    rows = [_cells(shift, zone) for shift in shifts[-MOST_SHIFTS:]]
    title = "Charge at the shift's end, forecast against outcome, %"
    console.print(make_table(columns, title, caption, rows=rows, repeated=2))
    print_plain(console, *summary(shifts), wraps=True)


def summary(shifts: list[dict[str, Any]]) -> list[str]:
    """Return one sentence per lead time on how often the outcome was within the interval."""
    lines = []
    for name, words in zip(MADE_AT, ("at the beginning", "2 h before the end", "1 h before the end"), strict=True):
        held = [
            forecast["held"]
            for shift in shifts
            if (forecast := shift["forecasts"][name]) and forecast["held"] is not None
        ]
        if held:
            lines.append(f"forecast {words}: {sum(held):,} of {len(held):,} outcomes were within the 90 % interval")
    return lines


def _cells(shift: dict[str, Any], zone: tzinfo | None) -> list[str | Text]:
    """Return the cells of a shift's row."""
    held = [forecast["held"] for forecast in shift["forecasts"].values() if forecast and forecast["held"] is not None]
    verdict = f"{sum(held)} of {len(held)}" if held else "–"
    return [
        Text(shift["vehicle_id"]),
        f"{format_local(shift['begin_s'], '%m-%d %H:%M', zone)}–{format_local(shift['end_s'], '%H:%M', zone)}",
        _percent(shift["soc_begin_pct"]),
        *(_interval(shift["forecasts"][name]) for name in MADE_AT),
        _percent(shift["soc_end_pct"]),
        Text(verdict, style="" if all(held) else "red"),
        _note(shift, zone),
    ]


def _note(shift: dict[str, Any], zone: tzinfo | None) -> str:
    """Return the reason why forecasts of a shift may not be comparable with its outcome."""
    charged = [] if shift["charged_s"] is None else [f"charged {format_local(shift['charged_s'], '%H:%M', zone)}"]
    return ", ".join([*charged, *(["in progress"] if shift["cut"] else [])])


def _interval(forecast: dict[str, Any] | None) -> str:
    """Return the text of a mean and its interval."""
    return "–" if forecast is None else f"{forecast['mean']:.0f} ({forecast['p05']:.0f} to {forecast['p95']:.0f})"


def _percent(value: float | None) -> str:
    """Return the text of a charge, a dash if it is unknown."""
    return "–" if value is None else f"{value:.0f}"
