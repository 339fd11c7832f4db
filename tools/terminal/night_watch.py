"""The option `--watch` of `socast live`: a diagnosis after every midnight, and the files that keep what it finds."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Any, Final

import msgspec
import pandas as pd
from msgspec.structs import replace
from rich.console import Console

from socast.core.condition.records import CarCondition, Trend
from socast.core.diagnose.findings import list_changes
from socast.core.diagnose.inference.events import KnownEvent, read_events
from socast.core.errors import SettingsError, read_input
from socast.core.files import UNREADABLE
from socast.core.fit.ride_blocks import get_names
from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Finding
from socast.stream.nightly_diagnosis import CarLevel, NightlyCondition, NightlyDiagnosis
from socast.stream.source import Sink
from socast.stream.zenoh_session import parse_prefix
from socast.tools.terminal.forecast_options import ForecastOptions
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import check_outputs, print_plain, write_json

LOW_PRIORITY: Final = 15
"""Niceness of the process, so that the loop goes first."""
MOST_DATES: Final = 365
"""Number of days before the last ride, this one included, over which the condition of the cars is assessed."""
PAGE: Final = ".html"
END_S: Final = 5.0
"""Time that the process has to end when it is asked to. [s]"""


class DiagnosisProcess:
    """Run `socast diagnose` beside the loop."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self._error = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            [sys.executable, "-m", "socast", "diagnose", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._error,
            start_new_session=True,  # a signal of the terminal ends the loop, which then ends the process
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, LOW_PRIORITY)

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        return self._process.poll()

    def get_error(self) -> str:
        """Return the last line that the process wrote to standard error."""
        self._error.seek(0)
        lines = self._error.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self._process.returncode}"

    def end(self) -> None:
        """End the process if it runs."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._error.close()


def check_watch(options: ForecastOptions, record: Path | None, watch: Path | None, events: Path | None) -> None:
    """Refuse --watch without recordings, and files that hold no findings or events, or cannot be written."""
    if watch is None:
        if events is not None:
            raise SettingsError("--events tells the nightly diagnosis what happened to cars: give --watch FILE too")
        return
    if record is None:
        raise SettingsError("--watch diagnoses what --record keeps: give --record DIR too")
    read = [*options.files, *([] if events is None else [events])]
    check_outputs(read, watch)
    check_outputs(read, *name_condition_files(watch))
    read_findings(watch)
    if events is not None:
        read_events(events)


def make_nightly_diagnosis(
    options: ForecastOptions, pipeline: Pipeline, sink: Sink, record: Path, file: Path, events: Path | None = None
) -> NightlyDiagnosis:
    """Return the diagnosis of the first model after every midnight, on the recordings of a folder."""
    arguments = [str(record), "--model", options.models[0] if options.models else DEFAULT_MODEL]
    arguments += [word for path in options.effect_files for word in ("--effects", str(path))]
    arguments += [word for path in options.vehicle_files for word in ("--vehicles", str(path))]
    if events is not None:
        arguments += ["--events", str(events)]
    data, _ = name_condition_files(file)
    arguments += ["--findings", str(file), "--condition", str(data)]
    return NightlyDiagnosis(
        lambda: pipeline.day_rollover.midnight,
        lambda: DiagnosisProcess(arguments),
        lambda: read_findings(file),
        sink,
        make_finding_fields,
        parse_prefix(options.prefix),
        read_condition=lambda: read_condition(data),
    )


def name_condition_files(watch: Path) -> tuple[Path, Path]:
    """Return the files beside the findings that hold the condition of the cars: its JSON and its page."""
    data = watch.with_name(f"{watch.stem}-condition.json")
    return data, data.with_suffix(PAGE)


def write_condition(path: Path, rides: pd.DataFrame, model: LinearModel, events: Sequence[KnownEvent] = ()) -> int:
    """Assess the condition of the cars over the last year of rides, write it and its page, and return their number.

    The year bounds the cost of a night.
    """
    from socast.core.condition.car_condition import assess_condition  # noqa: PLC0415 - imports an optimiser
    from socast.core.condition.car_days import select_car_day_columns  # noqa: PLC0415 - as above
    from socast.tools.report import condition, page  # noqa: PLC0415 - figures take seconds to import

    dates = get_names(rides, "date")
    first = date.fromisoformat(max(dates, default=date.max.isoformat())) - timedelta(days=MOST_DATES - 1)
    recent = select_car_day_columns(rides, model).loc[[day >= first.isoformat() for day in dates]]
    found = assess_condition(recent, model, events)
    page.write_report(condition.build_report(found), path.with_suffix(PAGE))
    write_json(path, "condition", replace(found, cars=list(map(_forget_days, found.cars))).to_json())
    return len(found.cars)


def _forget_days(car: CarCondition) -> CarCondition:
    """Return a car without the values of single days, so that the loop reads the file of a large fleet at once."""

    def forget(trend: Trend | None) -> Trend | None:
        return trend and replace(trend, dates=[], measured_pct=[], path_pct=[], path_sd_pct=[])

    return replace(car, consumption=forget(car.consumption), capacity=forget(car.capacity))


def read_condition(path: Path) -> NightlyCondition | None:
    """Return the levels of the cars of a file, None if the file does not exist."""
    try:
        cars = msgspec.json.decode(read_input(path), type=_Assessed).cars
        return NightlyCondition(path.stat().st_mtime, {car.vehicle_id: car.make_level() for car in cars})
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SettingsError(f"{path} cannot be read: {error.strerror}; remove it") from error
    except UNREADABLE as error:
        raise SettingsError(f"{path} is no condition of cars: {error}; remove it") from error


class _Level(msgspec.Struct):
    """Hold the last level of a quantity over what is expected, less 100 %. [%]"""

    level_pct: float


class _Car(msgspec.Struct):
    """Hold what the file tells of a car, as far as metrics hold it."""

    vehicle_id: str
    consumption: _Level | None = None
    capacity: _Level | None = None
    nominal_kwh: float | None = None

    def make_level(self) -> CarLevel:
        """Return the levels of the car."""
        ratio = 1.0 + self.consumption.level_pct / 100.0 if self.consumption else None
        usable = None
        if self.capacity is not None and self.nominal_kwh is not None:
            usable = self.nominal_kwh * (1.0 + self.capacity.level_pct / 100.0)
        return CarLevel(ratio, usable)


class _Assessed(msgspec.Struct):
    """Hold the cars of a report on their condition."""

    cars: list[_Car]


class _Content(msgspec.Struct):
    """Hold what the file holds besides its format."""

    findings: list[Finding]


def read_findings(path: Path) -> list[Finding]:
    """Return the findings of a file, none if the file does not exist."""
    try:
        return msgspec.json.decode(read_input(path), type=_Content).findings
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SettingsError(f"{path} cannot be read: {error.strerror}; name another file") from error
    except UNREADABLE as error:
        raise SettingsError(f"{path} is no file of findings: {error}; name another file") from error


def write_findings(path: Path, findings: Sequence[Finding]) -> None:
    """Replace the file of findings as a whole."""
    write_json(path, "findings", {"findings": msgspec.to_builtins(list(findings))})


def show_changes(before: Sequence[Finding], after: Sequence[Finding], console: Console) -> None:
    """Print the findings that became sure, with the commands that try them, and those that are gone."""
    changes = list_changes(before, after)
    lines = [line for one in changes for line in _describe_change(one)]
    print_plain(console, *lines or ["No finding became sure, and none is gone."])


def make_finding_fields(finding: Finding) -> dict[str, Any]:
    """Return a finding as the fields of a line of the log."""
    names = ("who", "effect", "status", "words", "probability", "kwh_per_month", "range_km_per_month")
    known = {name: value for name in names if (value := getattr(finding, name)) is not None}
    return known | dict(zip(("add", "shadow"), finding.commands, strict=False))


def _describe_change(finding: Finding) -> list[str]:
    """Return the lines of a finding that became sure or is gone."""
    if finding.status == "gone":
        return [f"Gone: {finding.words}"]
    return [f"Sure ({100.0 * finding.probability:.0f} %): {finding.words}", *finding.commands]
