"""`socast waterfall`: split the measured energy of rides into the terms of a model and what it does not explain."""

from typing import Annotated

import typer

from socast.core.condition.energy_split import FLEET, GROUP_COLUMNS, parse_ways, split_energy
from socast.tools.terminal.model_comparison import load_as_given
from socast.tools.terminal.output import HtmlFile, JsonFile, ModelName, write_json
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import RideSource, insert_ride_source


@insert_ride_source
def show_waterfall(
    *,
    source: RideSource,
    model: ModelName,
    by: Annotated[
        str,
        typer.Option(
            metavar="WAY,…",
            help="Also split the energy of each car, month, driver, vehicle model or class of the mean speed. WAY is "
            f"{FLEET}, {', '.join(GROUP_COLUMNS)}; several split that of each combination.",
        ),
    ] = FLEET,
    price: Annotated[float | None, typer.Option(metavar="PRICE", help="Price of a kWh, in any currency.")] = None,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
) -> None:
    """Show where the measured energy goes: how much each term of a model takes, and what remains unexplained.

    The parts add up to the measured energy of the rides that are fit for training, measured and predicted. Nothing is
    fitted here.

    Examples
    --------
    socast waterfall tables --model fitted.json --html waterfall.html
    socast waterfall recordings/shift.mcap --model extended_physical --by car --price 0.12
    socast waterfall tables --model fitted.json --by car,speed
    socast waterfall tables --model fitted.json --by month --json - | jq .groups
    """
    parse_ways(by)
    source.check(json_file, html_file, models=[model])
    chosen = load_as_given(model)
    with source.open_tables(chosen.effects) as opened:
        result = split_energy(opened.read_rides(chosen.effects), chosen, by=by, price=price)
    write_json(json_file, "waterfall", result.to_json())
    show_report("waterfall", result, html_file, json_file)
