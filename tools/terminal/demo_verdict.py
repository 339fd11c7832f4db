"""The end of the demonstration: results of cars and models, a verdict in three lines, and three commands."""

from collections.abc import Sequence
from datetime import UTC, tzinfo
from pathlib import Path
from shutil import which
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from socast.core.errors import AskError
from socast.core.models import LinearModel
from socast.core.models.interval import ANY
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Finding, Forecast, Leg, address
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.ask import HIGH_RISK, verdict
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.time_zone import format_local

HALF_STEP: Final = 0.5
"""Half of the coarsest step of a display, within which an outcome counts as inside its interval. [%]"""

MUCH: Final = 1.2
"""Coefficient from which the verdict names a term. [1]"""

RIDE: Final = Leg(18.0, 1500.0)
"""Ride that two cars are asked to take."""


def make_car_records(
    rides: pd.DataFrame, shifts: Sequence[dict[str, Any]], models: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the results of each car.

    Returns
    -------
    list of dict
        `vehicle_id`, `vehicle_model`, `rides`, `km`, `measured_kwh`, `errors_pct` by model (mean absolute error over
        the measured energy), and `soc_pct` [%]: `forecast` (an hour before the end: `mean`, `p05`, `p95`) and `end`.
    """
    ends = {shift["vehicle_id"]: shift for shift in shifts}
    records = []
    for vehicle, part in _select_fit(rides).groupby("vehicle_id"):
        shift = ends.get(vehicle)
        records.append(
            {
                "vehicle_id": vehicle,
                "vehicle_model": part["vehicle_model"].iloc[0],
                "rides": len(part),
                "km": float(part["distance_km"].sum()),
                "measured_kwh": float(part["energy_kwh"].sum()),
                "errors_pct": compute_errors_pct(part, models),
                "soc_pct": {"forecast": shift and shift["forecasts"]["1h"], "end": shift and shift["soc_end_pct"]},
            }
        )
    return records


def compute_errors_pct(rides: pd.DataFrame, models: Sequence[str]) -> dict[str, float]:
    """Return the mean absolute error of each model over the measured energy of rides that are fit for training. [%]"""
    fit = _select_fit(rides)
    measured = fit["energy_kwh"].to_numpy(np.float64)
    predicted = {models[0]: fit["predicted_kwh"].to_numpy(np.float64)}
    for label in models[1:]:
        predicted[label] = np.array([each[label] for each in fit["shadows_kwh"]], np.float64)
    return {
        label: float(100.0 * np.abs(energy - measured).sum() / measured.sum()) for label, energy in predicted.items()
    }


def _select_fit(rides: pd.DataFrame) -> pd.DataFrame:
    """Return the rides that are fit for training, with both energies."""
    fit: pd.DataFrame = rides[rides["fit_for_training"] & rides["predicted_kwh"].notna() & rides["energy_kwh"].notna()]
    return fit


def show_cars(console: Console, cars: Sequence[dict[str, Any]], models: Sequence[str]) -> None:
    """Print a row for each car."""
    columns = [
        Column("car", fixed=True),
        *(Column(head, number=True, fixed=True) for head in ("rides", "km", "measured\nkWh")),
        *(Column("_\n".join(shorten(label).split("_")) + "\nerror %", number=True, fixed=True) for label in models),
        *(Column(head, number=True, fixed=True) for head in ("end %,\nforecast\n1 h before", "end %,\nreported")),
    ]
    rows = []
    for car in cars:
        soc, end = car["soc_pct"]["forecast"], car["soc_pct"]["end"]
        row = (
            car["vehicle_id"],
            f"{car['rides']}",
            f"{car['km']:.0f}",
            f"{car['measured_kwh']:.1f}",
            *(f"{car['errors_pct'][label]:.0f}" for label in models),
            f"{soc['mean']:.0f} {soc['p05']:.0f}–{soc['p95']:.0f}" if soc else "–",
            f"{end:.0f}" if end is not None else "–",
        )
        rows.append(row)
    console.print(make_table(columns, "The shift, car by car", rows=rows))


def shorten(label: str) -> str:
    """Return the name of a model in a label `name/version`.

    Examples
    --------
    >>> shorten("road_load/d0c9e7502ae8")
    'road_load'
    """
    return label.partition("/")[0]


def write_verdict(
    cars: Sequence[dict[str, Any]], errors_pct: dict[str, float], model: LinearModel, quality: dict[str, Any]
) -> list[str]:
    """Return the verdict: a line on energy, one on the charge and one on the stream."""
    first, *others = errors_pct
    fitted = "the fitted " if model.training else ""
    energy = f"Energy: {fitted}{shorten(first)} is off by {errors_pct[first]:.0f} % per ride"
    energy += "".join(f", {shorten(other)} by {errors_pct[other]:.0f} %" for other in others)
    energy += f"; {model.training.rides:,} earlier rides show {_describe_fit(model)}." if model.training else "."
    known = [(car["soc_pct"]["forecast"], car["soc_pct"]["end"]) for car in cars]
    known = [(soc, end) for soc, end in known if soc and end is not None]
    charge = "Charge: no shift ended with a forecast an hour before."
    if known:
        error = float(np.mean([abs(soc["mean"] - end) for soc, end in known]))
        held = sum(soc["p05"] - HALF_STEP <= end <= soc["p95"] + HALF_STEP for soc, end in known)
        charge = (
            f"Charge: an hour before the end, forecasts are off by {error:.1f} % on average; {held} of {len(known)} "
            "outcomes are inside the 90 % interval."
        )
    repaired, lost = sum(quality["samples"].values()), quality["lost"]
    undecodable = sum(quality["undecodable"].values())
    stream = (
        f"Stream: {repaired:,} faults of samples repaired or rejected, {undecodable:,} undecodable messages, {lost:,} "
        f"samples lost by loggers, {quality['missed']:,} messages missed."
    )
    return [energy, charge, stream]


def _describe_fit(model: LinearModel) -> str:
    """Return what a fit changed most against the catalogue."""
    fit = model.fits[ANY]
    shares = [
        (value, term.name.replace("_", " "))
        for term, value in zip(model.terms, fit.coefficients, strict=True)
        if term.unit == "1"
    ]
    most, name = max(shares, default=(1.0, ""))
    return f"that {name} takes {most:.1f} times the catalogue's energy" if most > MUCH else "what its coefficients are"


def list_next_commands(
    recording: Path, tutorial: Path, history: Path | None = None, *, has_workbench: bool
) -> list[tuple[str, str]]:
    """Return three commands with what each shows."""
    own = ("socast live --record kept --state fleet.state", "forecast and record your own cars")
    if has_workbench:
        learned = f" --warm-up {history}" if history else ""
        return [
            (f"socast serve {recording}{learned}", "the same shift on a map, in a browser"),
            (f"socast serve {tutorial}", "find the effect that a model lacks, and add it"),
            own,
        ]
    return [
        (f"socast evaluate-soc {recording}", "how good the forecasts of the charge are"),
        (f"socast tables {tutorial} --out autumn", "the first step to the effect that a model lacks"),
        own,
    ]


def show_end(console: Console, verdict: Sequence[str], commands: Sequence[tuple[str, str]]) -> None:
    """Print the verdict and the next commands."""
    console.print()
    for sentence in verdict:
        topic, _, rest = sentence.partition(":")
        console.print(Text.assemble((f"{topic}:", "bold"), rest), soft_wrap=False)
    console.print(Text("\nNext:", style="bold"))
    if which("socast") is None:
        console.print("  . .venv/bin/activate", style="cyan", highlight=False)
    width = max(len(command) for command, _ in commands)
    for command, what in commands:
        line = Text.assemble("  ", (command, "cyan"))
        if width + len(what) + 6 <= console.width:
            line.append(f"{'':{width - len(command)}}  {what}", "dim")
            console.print(line, soft_wrap=True)
        else:
            console.print(line, soft_wrap=True)
            console.print(Text(f"    {what}", style="dim"), soft_wrap=True)


class Warned(NamedTuple):
    """Hold since when a car has been at high risk of falling below its reserve, and its newest sample. [Unix s]"""

    since_s: float
    newest_s: float


class AlarmWatch:
    """Collect which cars are at high risk and since when, and ask two of them about a ride, as a watch of the loop.

    Parameters
    ----------
    ask_at : int
        Number of received messages from which the question is put.

    Attributes
    ----------
    warned : dict of str to Warned
        Cars whose risk is above `HIGH_RISK` without interruption.
    answers : list of str
        Answers of the car with the largest risk and of the one with the smallest, as `socast ask` gives them.
    asked_s : float
        Time of the newest sample when they were asked. [Unix s]
    """

    def __init__(self, pipeline: Pipeline, ask_at: int) -> None:
        self._pipeline, self._ask_at = pipeline, ask_at
        self.warned: dict[str, Warned] = {}
        self.answers: list[str] = []
        self.asked_s = 0.0

    def __call__(self, tally: Tally) -> None:
        """Look at the newest forecasts."""
        known = [car.forecast for car in self._pipeline.status() if car.forecast.reserve_risk is not None]
        for car in known:
            if (car.reserve_risk or 0.0) > HIGH_RISK:
                since = self.warned.get(car.vehicle_id, Warned(car.time_s, 0.0)).since_s
                self.warned[car.vehicle_id] = Warned(since, car.time_s)
            else:
                self.warned.pop(car.vehicle_id, None)
        if not self.answers and tally.received >= self._ask_at and known:
            self._ask(known)

    def _ask(self, cars: Sequence[Forecast]) -> None:
        """Ask the car with the largest risk and the one with the smallest whether they can take a ride."""
        by_risk = sorted(cars, key=lambda car: (-(car.reserve_risk or 0.0), car.vehicle_id))
        self.asked_s = max(car.time_s for car in cars)
        for name in dict.fromkeys((by_risk[0].vehicle_id, by_risk[-1].vehicle_id)):
            try:
                self.answers.append(": ".join(verdict(self._pipeline.ask(name, RIDE))))
            except AskError:  # the car has no shift at that moment
                continue

    def list_sentences(self, zone: tzinfo | None = UTC) -> list[str]:
        """Return a line on the cars at risk and one on the question; fewer where there is nothing to tell."""
        out = []
        if self.warned:
            first = sorted(self.warned.items(), key=lambda item: item[1])
            told = [
                f"{car} from {format_local(each.since_s, '%H:%M', zone)} on, "
                f"{(each.newest_s - each.since_s) / 3600.0:.1f} h before its end"
                for car, each in first
            ]
            out.append(f"Alarms: the risk was over {100.0 * HIGH_RISK:.0f} % for {'; for '.join(told)}.")
        if self.answers:
            out.append(f"Asked at {format_local(self.asked_s, '%H:%M %Z', zone)}: {'. '.join(self.answers)}.")
        return out


def read_findings(recording: McapSource) -> list[str]:
    """Return what the nightly diagnosis published while the recording was made, as sentences."""
    found: dict[str, Finding] = {}
    for block in recording:
        for message in block:
            if (where := address(message.key)) is not None and where.kind == "finding":
                found[where.identity] = msgspec.json.decode(message.payload, type=Finding)
    return [f"Finding: {one.words}." for one in found.values() if one.status == "sure"]
