"""`socast verify`: compare the compiled Kalman filters with filterpy's on recordings."""

from typing import Annotated

import typer

from socast.core import models
from socast.core.settings import Settings
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options
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
from socast.tools.terminal.recordings import Recordings, open_recordings, show_progress, warn_of_losses
from socast.tools.terminal.report_output import show_report
from socast.tools.verify.recordings import verify_filters


@insert_cleaning_options
def verify(
    recordings: Recordings,
    *,
    cars: Annotated[bool, typer.Option("--cars", help="Show each car too.")] = False,
    model: ModelName = DEFAULT_MODEL,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    elevation: ElevationFiles = None,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Compare the Kalman filters of the state of charge and of the elevation with filterpy's.

    The recordings run as in `socast replay` and `socast tables`, and the same steps run through filterpy. The exit code
    is 1 where a relative difference exceeds the goal of 1e-9, or no step was compared.

    Examples
    --------
    socast verify recordings/shift.mcap
    socast verify kept/*.mcap --cars --json verified.json --html verified.html
    """
    sources = open_recordings(recordings)
    read = [*recordings, *select_model_files([model]), *(effects_file or ()), *(vehicles or ()), *(elevation or ())]
    check_outputs(read, json_file, html_file)
    loaded = models.load(model)
    with show_progress(sources) as step:
        result = verify_filters(sources, loaded, settings, elevation or (), step)
    write_json(json_file, "verify", result.to_json())
    show_report("verification", result, html_file, json_file, cars=cars)
    warn_of_losses(sources)
    raise typer.Exit(0 if result.meets_goal else 1)
