"""`socast evaluate-soc`: evaluate forecasts of the state of charge at the shift's end against the outcome."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import pandas as pd
import typer
from msgspec.structs import asdict

from socast.core import models
from socast.core.errors import SettingsError, read_input
from socast.core.evaluate.soc.recorders import RIDE_COLUMNS, LegRecorder, PlanRecorder, QueryTimes, match_legs_to_rides
from socast.core.evaluate.soc.records import SocEvaluation
from socast.core.evaluate.soc.report import evaluate_soc
from socast.core.files import UNREADABLE
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Message
from socast.stream.elevation_files import open_elevation
from socast.stream.source import Source, merge_sources
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options, warn_outside
from socast.tools.terminal.forecast_options import run_forecasts
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import (
    EffectFiles,
    HtmlFile,
    JsonFile,
    ModelName,
    VehicleFiles,
    check_outputs,
    select_model_files,
    write_json,
)
from socast.tools.terminal.recordings import Recordings, open_recordings, warn_of_losses
from socast.tools.terminal.report_output import show_report


class SocForecasts:
    """Collect the forecasts of a pipeline and their outcomes, while it takes the lists of `cut`.

    The caller calls the object after each list.

    Parameters
    ----------
    pipeline : Pipeline
        Pipeline that keeps its tables and its outlooks.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self._times, self._questions, self._plans = QueryTimes(), LegRecorder(pipeline.ask), PlanRecorder()
        self._due: str | None = None
        self._outlooks: list[pd.DataFrame] = []
        self._rides: list[pd.DataFrame] = []

    def cut(self, source: Source) -> Iterator[Sequence[Message]]:
        """Yield the messages of a source in parts that end where a vehicle is due for a query."""
        for messages in source:
            for message in messages:
                self._plans.record(message)
            for part, due in self._times.cut(messages):
                self._due = due
                yield part

    def __call__(self) -> None:
        """Query the vehicle that is due; without one, collect the outlooks and rides since the last time."""
        if self._due is None:
            self._collect()
        else:
            self._questions.query(self._due)

    def _collect(self) -> None:
        """Collect the outlooks and rides since the last call."""
        self._outlooks.append(self.pipeline.take_outlooks())
        self._rides.append(self.pipeline.take_rides()[["vehicle_id", "distance_km", *RIDE_COLUMNS]])
        self.pipeline.take_windows()

    def tables(self) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
        """Return all forecasts, shifts, legs and plans that were recorded; call this once."""
        self._collect()
        shifts = self.pipeline.take_shifts()
        legs = match_legs_to_rides(self._questions.table(), pd.concat(self._rides), shifts)
        return pd.concat(self._outlooks, ignore_index=True), shifts, legs, self._plans.table()

    def evaluated(self, displays: pd.DataFrame | None = None) -> SocEvaluation:
        """Return the evaluation of all forecasts, see `socast.core.evaluate.soc.report.evaluate_soc`."""
        return evaluate_soc(*self.tables(), displays)


class _Display(msgspec.Struct):
    """Hold what the healthy display of a shift shows."""

    vehicle_id: str
    begin_s: float
    step_s: Annotated[float, msgspec.Meta(gt=0.0)]
    shown_pct: list[float]
    fault: str | None = None


class _Truth(msgspec.Struct):
    """Hold what is read of the truth of a simulation."""

    displays: list[_Display] = []


def read_displays(path: Path) -> pd.DataFrame:
    """Return what healthy displays show, from the truth of a simulation with conditions."""
    try:
        displays = msgspec.json.decode(read_input(path), type=_Truth).displays
    except (OSError, *UNREADABLE) as error:
        raise SettingsError(f"{path} is not the truth of a simulation ({error}); give FILE.truth.json") from error
    if not displays:
        raise SettingsError(f"{path} holds no displays; simulate with --fleet or --conditions")
    return pd.DataFrame(map(asdict, displays))


@insert_cleaning_options
def evaluate_recordings(
    recordings: Recordings,
    *,
    model: ModelName = DEFAULT_MODEL,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    elevation: ElevationFiles = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Truth of a simulation with conditions: outcomes are then what a healthy display shows, also where "
            "the display is frozen, absent or jumps.",
        ),
    ] = None,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Evaluate forecasts of the state of charge at the shift's end against the outcome and against simple rules.

    Recordings run through the same loop as live telemetry, merged in time order. The fleet statistics are learned on
    the way, so no forecast depends on anything that came after it.

    Examples
    --------
    socast evaluate-soc january.mcap february.mcap --html soc.html --json soc.json
    """
    sources = open_recordings(recordings)
    displays = None if truth is None else read_displays(truth)
    read = [
        *recordings,
        *([truth] if truth else []),
        *select_model_files([model]),
        *(effects_file or ()),
        *(vehicles or ()),
        *(elevation or ()),
    ]
    check_outputs(read, json_file, html_file)
    elevation_map = open_elevation(elevation or ())
    forecasts = SocForecasts(Pipeline(models.load(model), settings, keep_outlooks=True, elevation_map=elevation_map))
    run_forecasts(forecasts.pipeline, sources, forecasts.cut(merge_sources(sources)), also=forecasts)
    warn_outside(forecasts.pipeline.quality())
    warn_of_losses(sources)
    result = forecasts.evaluated(displays)
    write_json(json_file, "evaluate-soc", result.to_json())
    show_report("soc.page", result, html_file, json_file)
