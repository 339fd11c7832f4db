"""`socast vehicles`: show the vehicle catalogue, and describe cars of one's own by their data sheets."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from socast.core.formatting import format_count
from socast.core.vehicles import VehicleModel, is_drag_area_assumed, list_assumed, load_catalogue, read_data_sheets
from socast.core.wire.messages import IDENTITY
from socast.tools.terminal.output import (
    JsonFile,
    VehicleFiles,
    check_outputs,
    make_console,
    print_plain,
    refuse,
    refuse_existing,
    write_file,
    write_json,
)
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.vehicle_files import load_vehicle_file, make_data_sheet

app = typer.Typer(help="The vehicle catalogue, and cars of your own.", no_args_is_help=True)

DataSheets = Annotated[Path, typer.Argument(metavar="FILE.toml", help="File of data sheets.")]


@app.command("list")
def list_vehicles(_: VehicleFiles = None, json_file: JsonFile = None) -> None:
    """List the vehicle models that forecasts know, with their figures.

    A tilde marks a figure that is estimated.

    Examples
    --------
    socast vehicles list
    socast vehicles list --vehicles my-cars.toml
    """
    _show(load_catalogue(), json_file)


@app.command("new")
def new_file(
    file: DataSheets,
    mass_kg: Annotated[float, typer.Option(metavar="KG", help="Kerb mass, with the battery and nobody aboard.")],
    capacity_kwh: Annotated[float, typer.Option(metavar="KWH", help="Rated energy of the new battery.")],
    key: Annotated[
        str | None, typer.Option(metavar="KEY", help="Key of the model; by default the name of the file.")
    ] = None,
    drag_area_m2: Annotated[
        float | None, typer.Option(metavar="M2", help="Drag coefficient times frontal area.")
    ] = None,
    rated_kwh_per_100km: Annotated[
        float | None, typer.Option("--rated-kwh-per-100km", metavar="KWH", help="Official consumption.")
    ] = None,
) -> None:
    """Write the data sheet of a car of your own.

    What is not known is left out: the usual value of the catalogue is used, and a fit corrects it from rides.

    Examples
    --------
    socast vehicles new my-van.toml --mass-kg 2100 --capacity-kwh 75 --drag-area-m2 1.1
    """
    refuse_existing(file)
    name = key if key is not None else file.stem
    is_wrong = not IDENTITY.fullmatch(name) or "." in name
    refuse((is_wrong, f"--key is '{name}', must be up to 64 letters, digits, _ and -; name the car with --key"))
    text = make_data_sheet(name, mass_kg, capacity_kwh, drag_area_m2, rated_kwh_per_100km)
    vehicles = read_data_sheets(text, str(file))
    check_outputs((), file)
    write_file(file, text.encode())
    _show(vehicles, None)
    print_plain(make_console(), f"data sheet in {file}: give it with --vehicles {file}")


@app.command("check")
def check_file(file: DataSheets, json_file: JsonFile = None) -> None:
    """Check a file of data sheets, and show what is assumed.

    Examples
    --------
    socast vehicles check my-van.toml
    """
    vehicles = load_vehicle_file(file)
    _show(vehicles, json_file)
    console = make_console(json_file)
    for key, vehicle in vehicles.items():
        assumed = ", ".join(list_assumed(vehicle)) or "nothing"
        console.print(Text(f"{key}: usual values of the catalogue: {assumed}"), soft_wrap=True)
    console.print(Text(f"{format_count(len(vehicles), 'vehicle')} in {file}: all checks passed."))


def _show(vehicles: Mapping[str, VehicleModel], json_file: Path | None) -> None:
    """Print vehicle models as a table, and write them as JSON."""
    records = [{**vars(vehicle), "sources": dict(vehicle.sources)} for vehicle in vehicles.values()]
    write_json(json_file, "vehicles", {"vehicles": records})
    heads = ("mass,\nkg", "drag\narea, m²", "rolling\nresistance", "battery,\nkWh", "rated,\nkWh/km")
    rows = []
    for key, vehicle in sorted(vehicles.items()):
        assumed = set(list_assumed(vehicle))
        figures = [
            _format(vehicle.mass_kg, "mass_kg" in assumed),
            _format(vehicle.drag_area_m2, is_drag_area_assumed(vehicle)),
            _format(vehicle.rolling_resistance, "rolling_resistance" in assumed),
            _format(vehicle.nominal_capacity_kwh, "nominal_capacity_kwh" in assumed),
            _format(vehicle.rated_kwh_per_km, "rated_kwh_per_km" in assumed),
        ]
        rows.append([Text(key), *map(Text, figures)])
    columns = [Column("model"), *(Column(head, number=True) for head in heads)]
    make_console(json_file).print(make_table(columns, rows=rows))


def _format(value: float | None, assumed: bool) -> str:
    """Return a figure, with a tilde where it is estimated."""
    return "–" if value is None else f"{'~' * assumed}{value:.4g}"
