"""The live table with one row per car, and the final table with one row per ride."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, tzinfo
from functools import partial
from math import floor, isfinite, nan
from types import TracebackType
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np
import pandas as pd
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from socast.core.evaluate.ride_filter import name_rides
from socast.core.forecast.status import VehicleStatus
from socast.core.formatting import format_count, format_half_width, format_minus
from socast.core.monitoring.shadow import ShadowModels
from socast.core.pipeline import Pipeline
from socast.core.vehicles.catalogue import OVERRIDES
from socast.core.wire.live_fields import LiveField, list_live_fields
from socast.core.wire.messages import Forecast, Interval
from socast.stream.loop import Tally
from socast.tools.terminal.model_comparison import WIDE, ErrorCourses, make_models_table
from socast.tools.terminal.output import make_console, print_plain
from socast.tools.terminal.recordings import QUIET_S
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.time_zone import format_local, name_zone

REDRAW_S = 0.25
"""Time between two updates of the table on a terminal. [s]"""
WARNED = 0.05
"""Smallest probability of ending a shift below the reserve at which a car is marked. [1]"""
WIDE_PICTURE, NARROW_PICTURE = 24, 12
"""Number of characters of the picture of a car's charge, in a wide and in a narrow terminal."""
MOST_RIDES = 60
"""Largest number of rides listed on a terminal; the JSON report lists all."""


SCALE, SPAN, MIDDLE, NOW = "·", "━", "┃", "●"
"""Characters of a charge: the scale, the interval of the forecast, its mean, and the present charge."""
RIDE_COLUMNS = (
    "vehicle_id",
    "ride_key",
    "ride_id",
    "vehicle_model",
    "start_s",
    "duration_s",
    "distance_km",
    "ambient_c",
    "energy_kwh",
    "energy_sd_kwh",
    "predicted_kwh",
    "error_pct",
    "fit_for_training",
    "unfit_reason",
)
"""Columns of the ride table of `replay`, `live` and `demo`, for the screen and for JSON."""


class LiveTable:
    """Show the newest state of every vehicle while messages stream; a context manager.

    A terminal shows a table that redraws. Any other output receives lines. The caller calls the object after each list
    of messages.

    Parameters
    ----------
    pipeline : Pipeline
        Pipeline that holds the state of the vehicles.
    console : Console, optional
        Console to print on; by default the one of `make_console`.
    zone : tzinfo, optional
        Time zone of the times; None is that of the system.
    shows_models : bool
        Whether to show shadow models beside the first, for engineers.
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(
        self,
        pipeline: Pipeline,
        title: str,
        *,
        console: Console | None = None,
        silent: bool = False,
        zone: tzinfo | None = UTC,
        shows_models: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipeline, self._title, self._clock, self._silent = pipeline, title, clock, silent
        self._console, self._zone = console or make_console(), zone
        self._due = clock() + QUIET_S * (not self._console.is_terminal)
        self._last: Tally | None = None
        self._before = count_received(pipeline.quality())  # a state goes on from those of earlier processes
        self._shadows = len(pipeline.shadows) if shows_models else 0
        self._courses = ErrorCourses()
        live = self._console.is_terminal and not silent
        # log lines are redirected above the table, but only if standard error is a terminal too
        on_screen = sys.stderr.isatty()
        self._live = (
            Live(console=self._console, auto_refresh=False, transient=True, redirect_stderr=on_screen) if live else None
        )

    def __enter__(self) -> Self:
        """Start to draw the table."""
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Clear the table, or print the last line if the output is not a terminal."""
        if self._live:
            self._live.stop()
        elif self._last is not None:
            self._due = 0.0
            self(self._last)

    def __call__(self, tally: Tally) -> None:
        """Draw the table or print a line, if it is due."""
        self._last, now = tally, self._clock()
        if self._silent or now < self._due:
            return
        self._due = now + (REDRAW_S if self._live else QUIET_S)
        cars = self._pipeline.status()
        if self._live:
            wide, errors = self._console.width >= WIDE, self._pipeline.shadows.errors()
            self._courses.add(errors)
            below = make_models_table(errors, wide=wide, courses=self._courses) if self._shadows else None
            rows = max(1, self._console.height - 7 - (below.row_count + 6 if below else 0))
            shadows = self._shadows if wide else 0
            counts = describe_counts(tally, count_received(self._pipeline.quality()) - self._before)
            fleet = make_fleet_table(cars, self._title, counts, rows, shadows, wide=wide, zone=self._zone)
            self._live.update(Group(fleet, below) if below else fleet, refresh=True)
        else:
            print_plain(self._console, format_fleet_line(cars, tally, self._zone))


class FleetColumn(NamedTuple):
    """Hold a column of the table of cars, and the function that returns the cell of a car."""

    column: Column
    make_cell: Callable[[VehicleStatus], str | Text]


def make_fleet_table(
    cars: Sequence[VehicleStatus],
    title: str,
    caption: str,
    rows: int,
    shadows: int = 0,
    *,
    wide: bool = True,
    zone: tzinfo | None = UTC,
) -> Table:
    """Return a table with one row per car: those at risk first, then those with the newest samples by name."""
    shown = _choose_cars(cars, rows)
    of_zone = name_zone([each.forecast.time_s for each in shown if isfinite(each.forecast.time_s)], zone)
    columns = _list_columns(of_zone, shadows, zone, wide=wide)
    rows_shown = [[each.make_cell(car) for each in columns] for car in shown]
    if len(cars) > len(shown):
        rows_shown.append([f"and {len(cars) - len(shown):,} more", *[""] * (len(columns) - 1)])
    return make_table([each.column for each in columns], title, caption, rows=rows_shown, expand=True)


def _list_columns(of_zone: str, shadows: int, zone: tzinfo | None, *, wide: bool) -> list[FleetColumn]:
    """Return the columns of the table of cars: those that fields of a forecast declare, and those around them."""

    def number(head: str, digits: int, make_cell: Callable[[VehicleStatus], str | Text]) -> FleetColumn:
        width = max(4 + digits, *map(len, head.split("\n")))
        return FleetColumn(Column(head, number=True, fixed=True, min_width=width), make_cell)

    columns = [FleetColumn(Column("car", fixed=True, min_width=8), lambda car: Text(car.forecast.vehicle_id))]
    columns += [number(f"time\n{of_zone}", 4, partial(_format_time, zone=zone))] if wide else []
    columns.append(number("SOC\n%", 1, lambda car: _format_number(car.soc_pct, 1)))
    for field in list_live_fields(Forecast):
        if (shown := field.display.terminal) is not None and (wide or not shown.wide):
            columns.append(number(shown.head, shown.digits, partial(_format_field, field=field, digits=shown.digits)))
        if field.name == "ride_energy_measured_kwh":
            columns.append(number("off\n%", 0, _format_off))
    for place in range(shadows):
        columns.append(number(f"by {place + 2}\nkWh", 2, partial(_format_shadow, place=place)))
    picture = Column("charge now ● and at\nshift's end ━┃━, 0–100 %" if wide else "0–100 %\n● now, ┃ end", fixed=True)
    columns.append(FleetColumn(picture, partial(_draw_charge, width=WIDE_PICTURE if wide else NARROW_PICTURE)))
    if wide:
        quality = Column("repaired or\nrejected", fixed=True, ratio=1)
        columns.append(FleetColumn(quality, lambda car: Text(_format_quality(car.forecast))))
    return columns


def _choose_cars(cars: Sequence[VehicleStatus], rows: int) -> list[VehicleStatus]:
    """Return the cars to show: by falling risk, in whole percent so that rows keep their places, then by name."""
    risky = [car for car in cars if _is_at_risk(car)]
    risky.sort(key=lambda car: (-round(car.forecast.reserve_risk or 0.0, 2), car.forecast.vehicle_id))
    others = [car for car in cars if not _is_at_risk(car)]
    others.sort(key=lambda car: car.forecast.time_s, reverse=True)
    others = others[: max(rows - len(risky), 0)]
    return risky[:rows] + sorted(others, key=lambda car: car.forecast.vehicle_id)


def _format_field(car: VehicleStatus, field: LiveField, digits: int) -> str | Text:
    """Return a field of a forecast; an interval is marked if the car risks ending below its reserve."""
    value = getattr(car.forecast, field.name)
    if car.is_shift_over and field.display.of_shift:
        return "shift over"
    if not isinstance(value, Interval):
        return "–" if value is None and field.is_interval else _format_number(value, digits)
    mean, low, high = (_format_number(each, digits) for each in msgspec.structs.astuple(value))
    return Text(f"{mean} {low}–{high}{'!' if _is_at_risk(car) else ' '}", style="red" if _is_at_risk(car) else "")


def _format_off(car: VehicleStatus) -> Text:
    """Return the error of the prediction of the ride in progress."""
    ride = car.forecast
    off = _compute_off_pct(ride.ride_energy_predicted_kwh, ride.ride_energy_measured_kwh)
    off = off if ride.ride_distance_km > 0 else nan
    return Text(_format_number(off, 0, sign=True), style="red" if abs(off) > 20 else "")


def _format_shadow(car: VehicleStatus, place: int) -> str:
    """Return the energy that a shadow model predicts of the ride in progress."""
    return _format_number(car.shadows_kwh[place], 3) if place < len(car.shadows_kwh) else ""


def _draw_charge(car: VehicleStatus, width: int) -> Text:
    """Return the picture of a car's charge now and at the end of its shift."""
    end = car.forecast.soc_end_of_shift_pct
    bounds = None if end is None else (end.mean, end.p05, end.p95)
    return draw_charge(car.soc_pct, bounds, width, "red" if _is_at_risk(car) else "cyan")


def draw_charge(now_pct: float, end_pct: tuple[float, float, float] | None, width: int, style: str = "cyan") -> Text:
    """Return a charge and its forecast on a scale from 0 to 100 %.

    Parameters
    ----------
    now_pct : float
        Present state of charge, NaN where unknown. [%]
    end_pct : tuple of (float, float, float), optional
        Mean, 5th and 95th percentile of the charge at the end of the shift. [%]

    Examples
    --------
    >>> draw_charge(80.0, (45.0, 30.0, 60.0), 10).plain
    '···━┃━━·●·'
    >>> draw_charge(float("nan"), None, 10).plain
    '··········'
    """

    def place(pct: float) -> int:
        return min(max(floor(pct / 100.0 * width), 0), width - 1)

    marks = [(SCALE, "dim")] * width
    if end_pct is not None:
        mean, low, high = map(place, end_pct)
        marks[low : high + 1] = [(SPAN, style)] * (high + 1 - low)
        marks[mean] = MIDDLE, f"bold {style}"
    if isfinite(now_pct):
        marks[place(now_pct)] = NOW, "bold"
    return Text.assemble(*marks)


def _is_at_risk(car: VehicleStatus) -> bool:
    """Return whether a car risks ending its shift below its reserve."""
    return (car.forecast.reserve_risk or 0.0) >= WARNED


def _format_time(car: VehicleStatus, zone: tzinfo | None) -> str:
    """Return the time of a car's newest sample."""
    return format_local(car.forecast.time_s, "%H:%M:%S", zone) if isfinite(car.forecast.time_s) else ""


def _format_quality(forecast: Forecast) -> str:
    """Return the numbers of samples of a ride that were repaired or rejected, by cause."""
    return _format_counts(msgspec.structs.asdict(forecast.quality))


def format_fleet_line(cars: Sequence[VehicleStatus], tally: Tally, zone: tzinfo | None = UTC) -> str:
    """Return one line on the fleet for a log: the counts of messages, and the car with the newest sample."""
    counts = f"{tally.seconds:5.1f} s  {tally.received:7,} messages  {len(cars):3} cars"
    if not cars:
        return counts
    car = max(cars, key=lambda car: car.forecast.time_s)
    newest = car.forecast
    return (
        f"{counts}  {format_local(newest.time_s, '%H:%M:%S %Z', zone)}  {newest.vehicle_id}: "
        f"SOC {_format_number(car.soc_pct, 1)} %, {_format_number(newest.ride_distance_km, 2)} km, "
        f"predicted {_format_number(newest.ride_energy_predicted_kwh, 3)} kWh, "
        f"measured {_format_number(newest.ride_energy_measured_kwh, 3)} kWh  {_format_quality(newest)}"
    ).rstrip()


def add_predictions(rides: pd.DataFrame, models: ShadowModels) -> pd.DataFrame:
    """Return a ride table with the predictions of models, in order of the rides' starts.

    Returns
    -------
    DataFrame
        The ride table with `predicted_kwh`, the prediction of the first model, and `error_pct`, its error in percent of
        the measured energy. The error is NaN for a measured energy of at most 0.05 kWh. With shadows, `shadows_kwh` is
        a dict of the prediction of each shadow by name and version. [kWh]
    """
    columns = {str(name): column for name, column in rides.items()}
    predicted, *others = models.predict_energy(columns, len(rides))
    if others:
        labels = [monitor.label for monitor in models.monitors[1:]]
        rows = zip(*(energies.tolist() for energies in others), strict=True)
        predictions = [dict(zip(labels, row, strict=True)) for row in rows]
        rides = rides.assign(shadows_kwh=pd.Series(predictions, index=rides.index, dtype=object))
    measured = rides["energy_kwh"].to_numpy(np.float64)
    error = np.full(len(rides), np.nan)
    np.divide(100.0 * (predicted - measured), measured, out=error, where=measured > 0.05)
    return rides.assign(predicted_kwh=predicted, error_pct=error).sort_values(["start_s", "vehicle_id"])


def make_ride_records(rides: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a ride table with predictions, for JSON."""
    names = [*RIDE_COLUMNS, *(["shadows_kwh"] if "shadows_kwh" in rides else [])]
    known = rides[names].astype(object)
    text = ["ride_id", "vehicle_model", "unfit_reason"]
    known[text] = known[text].where(known[text].notna(), None)
    columns = [known[name].tolist() for name in names]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def show_rides(console: Console, rides: pd.DataFrame, quality: dict[str, Any], zone: tzinfo | None = UTC) -> None:
    """Print a ride table with predictions, the totals, and the reasons why rides are unfit for training."""
    wide = console.width >= WIDE
    numbers = ("min", "km", *(("°C",) if wide else ()), "predicted\nkWh", "measured\nkWh", "off %")
    shown = rides.tail(MOST_RIDES)
    start = f"start\n{name_zone(shown['start_s'].tolist(), zone)}"
    columns = [
        *(Column(head, fixed=True) for head in ("ride", *((start,) if wide else ()))),
        *(Column(head, number=True, fixed=True) for head in numbers),
        Column("unfit for\ntraining", fixed=True),
    ]
    rows: list[Sequence[str | Text]] = []
    for name, ride in zip(name_rides(shown), make_ride_records(shown), strict=True):
        start = format_local(ride["start_s"], "%m-%d %H:%M", zone)
        row = (
            Text(name),
            *((start,) if wide else ()),
            _format_number(ride["duration_s"] / 60, 1),
            _format_number(ride["distance_km"], 2),
            *((_format_number(ride["ambient_c"], 0),) if wide else ()),
            _format_number(ride["predicted_kwh"], 3),
            f"{_format_number(ride['energy_kwh'], 3)}{format_half_width(ride['energy_sd_kwh'], 2)}",
            _format_number(ride["error_pct"], 0, sign=True),
            Text((ride["unfit_reason"] or "").replace("_", " ")),
        )
        rows.append(row)
    caption = "±: half of the 95 % interval"
    caption += f"; the last {MOST_RIDES} of {len(rides):,} rides" if len(rides) > MOST_RIDES else ""
    if rows:
        console.print(make_table(columns, "Rides, predicted against measured", caption, rows=rows))
    print_plain(console, *summary(rides, quality), wraps=True)


def summary(rides: pd.DataFrame, quality: dict[str, Any]) -> list[str]:
    """Return sentences on the totals of a ride table and on rejected data."""
    fit = rides[rides["fit_for_training"] & rides["predicted_kwh"].notna() & rides["energy_kwh"].notna()]
    cars = format_count(rides["vehicle_id"].nunique(), "car")
    lines = [f"{format_count(len(rides), 'ride')} of {cars}, {rides['distance_km'].sum():.1f} km"]
    if len(fit):
        predicted, measured = fit["predicted_kwh"].sum(), fit["energy_kwh"].sum()
        absolute = (fit["predicted_kwh"] - fit["energy_kwh"]).abs().sum()
        lines.append(
            f"{len(fit):,} fit for training: predicted {predicted:.2f} kWh, measured {measured:.2f} kWh "
            f"({_format_number(_compute_off_pct(predicted, measured), 1, sign=True)} %); "
            f"mean absolute error {100 * absolute / measured:.1f} % of the energy"
        )
    for what, counts in (
        ("unfit for training", quality["unfit"]),
        ("repaired or rejected samples", quality["samples"]),
        ("messages that could not be decoded", quality["undecodable"]),
        ("vehicle messages that allow no prediction", quality["unpredictable"]),
    ):
        if text := _format_counts(counts):
            lines.append(f"{what}: {text}")
    return lines + describe_unknown_models(quality["unknown_models"])


def describe_unknown_models(unknown: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a line for each vehicle model that is not in the catalogue, with its cars and the remedy.

    Examples
    --------
    >>> lines = describe_unknown_models({"horse": ["taxi-7", "taxi-8", "taxi-9", "taxi-10"]})
    >>> lines[0].partition(":")[0]
    "the vehicle model 'horse' of taxi-7, taxi-8, taxi-9 and 1 more is not in the catalogue"
    """
    *most, last = OVERRIDES
    lines = []
    for model, cars in unknown.items():
        named = ", ".join(cars[:3]) + (f" and {len(cars) - 3:,} more" if len(cars) > 3 else "")
        lines.append(
            f"the vehicle model {model!r} of {named} is not in the catalogue: no energy of theirs is predicted; "
            f"describe it with `socast vehicles new` and give the file with --vehicles, or send {', '.join(most)} and "
            f"{last} in their vehicle messages"
        )
    return lines


def _format_counts(counts: Mapping[str, int]) -> str:
    """Return the text of the counts above zero, such as `name 3, other 1`."""
    return ", ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in counts.items() if count)


def count_received(quality: Mapping[str, Any]) -> Counter[str]:
    """Return the counts of quality that the text below the table of cars has."""
    return Counter({"undecodable": sum(quality["undecodable"].values()), "rides": quality["rides"]})


def describe_counts(tally: Tally, received: Mapping[str, int]) -> str:
    """Return the text below the table of cars; all counts are those of this process."""
    rate = tally.received / tally.seconds if tally.seconds > 0 else 0.0
    return (
        f"since the start: {format_count(tally.received, 'message')} ({rate:,.0f} a second), "
        f"{format_count(tally.forecasts, 'forecast')}, {tally.missed:,} missed, "
        f"{received['undecodable']:,} undecodable, {format_count(received['rides'], 'ride')} ended"
    )


def _compute_off_pct(predicted: float | None, measured: float | None) -> float:
    """Return the error of a prediction; NaN where unknown, or if the measured energy is at most 0.05 kWh. [%]"""
    if predicted is None or measured is None:
        return nan
    return 100.0 * (predicted - measured) / measured if measured > 0.05 else nan


def _format_number(value: float | None, digits: int, *, sign: bool = False) -> str:
    """Return the text of a number, a dash if it is unknown."""
    if value is None or not isfinite(value):
        return "–"
    return format_minus(f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}")
