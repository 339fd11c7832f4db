"""`socast condition`: how each car is doing, in a terminal, as JSON and as one HTML page."""

from typing import Annotated

import typer

from socast.core.condition.car_condition import assess_condition
from socast.core.condition.car_days import list_car_day_columns
from socast.core.diagnose.inference.events import read_events
from socast.tools.terminal.model_comparison import load_as_given
from socast.tools.terminal.output import EventsFile, HtmlFile, JsonFile, write_json
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import RideSource, insert_ride_source


@insert_ride_source
def show_condition(
    *,
    source: RideSource,
    model: Annotated[str, typer.Option("--model", metavar="M", help="A model's name, or a model file.")],
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
    events: EventsFile = None,
) -> None:
    """Tell how each car is doing: what it takes beside its siblings, what its battery holds, and since when.

    The consumption of each day is compared with what the model predicts and with the other cars of the vehicle model on
    the same dates, so that weather and traffic count little. The usable capacity is that of the energy by voltage and
    current over the fall of the display. Cars with a finding come first.

    Examples
    --------
    socast condition tables --model fitted.json --html condition.html
    socast condition tables --model fitted.json --events workshop.csv
    socast condition recordings/autumn.mcap --model extended_physical
    socast condition tables --model fitted.json --json - | jq '.cars[0]'
    """
    source.check(json_file, html_file, models=[model])
    known = read_events(events) if events else []
    chosen = load_as_given(model)
    result = assess_condition(source.read_rides(chosen.effects, list_car_day_columns(chosen)), chosen, known)
    write_json(json_file, "condition", result.to_json())
    show_report("condition", result, html_file, json_file)
