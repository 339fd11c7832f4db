"""`socast simulate`: simulate electric taxis in Montreal, and write a recording and its truth."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.formatting import format_count
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.simulation import write_recording
from socast.tools.cluster.workers import open_workers
from socast.tools.simulator.conditions import CONDITION_NAMES, parse_conditions
from socast.tools.simulator.fleet import prepare_fleet
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import BENT, OTHER
from socast.tools.simulator.preset import PRESETS, load_preset, refuse_unused_settings
from socast.tools.simulator.settings import (
    CHARGING,
    DEFAULT_MODELS,
    DEFAULT_RIDES,
    FLEETS,
    LOW,
    NIGHT,
    Faults,
    Phenomena,
    Simulation,
    get_fleet,
    parse_faults,
    parse_hidden,
    parse_models,
    parse_phenomena,
    parse_start,
)
from socast.tools.simulator.truth import Truth
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.output import check_outputs, print_plain

FIRST_DAY = "2018-01-15"
FLEET, TROUBLE = "Fleet", "Physics and faults"
"""Titles of options in the help text."""


@insert_cluster_options
def simulate(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.mcap", help="Recording to write.")],
    vehicles: Annotated[int | None, typer.Option(help="Number of cars. Default: 5.", rich_help_panel=FLEET)] = None,
    days: Annotated[
        int | None, typer.Option(help="Number of days, with one shift of each car. Default: 1.", rich_help_panel=FLEET)
    ] = None,
    start: Annotated[
        str,
        typer.Option(
            metavar="DATE",
            help="First day, such as 2018-01-15: shifts are spread over the day. "
            "Or a time in UTC, such as 2018-01-15T12:00: every shift begins then.",
            rich_help_panel=FLEET,
        ),
    ] = FIRST_DAY,
    seed: Annotated[int, typer.Option(help="Random seed; the same seed gives the same bytes.")] = 0,
    day_step: Annotated[
        int | None,
        typer.Option(
            help="Days from one simulated day to the next, to cover seasons. Default: 1.", rich_help_panel=FLEET
        ),
    ] = None,
    shift_hours: Annotated[
        float | None,
        typer.Option(metavar="HOURS", help="Length of every shift. Default: 7 to 10 h.", rich_help_panel=FLEET),
    ] = None,
    models: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help=f"Catalogue keys of car models, assigned in turn. Default: {', '.join(DEFAULT_MODELS)}.",
            rich_help_panel=FLEET,
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Described fleet over a year, instead of --vehicles, --days, --day-step, --shift-hours and --models. "
            f"Names: {', '.join(PRESETS)}.",
            rich_help_panel=FLEET,
        ),
    ] = None,
    rides: Annotated[
        int | None,
        typer.Option(
            metavar="N", help=f"Number of rides of a preset. Default: {DEFAULT_RIDES:,}.", rich_help_panel=FLEET
        ),
    ] = None,
    charging: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            help=f"When cars charge: {', '.join(CHARGING)}. With {NIGHT} they charge between shifts only, so some "
            f"shifts end below the reserve or empty. With {LOW} they also charge in a shift at a low state of charge.",
            rich_help_panel=FLEET,
        ),
    ] = LOW,
    hidden: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT[:SIZE]",
            help="Effect to hide from the models, as a share of the energy; may be repeated. Default size: 0.03. "
            f"Effects: {', '.join(sorted(EFFECTS))}. NAME{OTHER} is the same effect in another shape, "
            f"NAME{BENT}7 in the seventh of its random shapes.",
            rich_help_panel=TROUBLE,
        ),
    ] = None,
    faults: Annotated[
        str,
        typer.Option(
            metavar="RATES",
            help="Faults of the loggers: default (or those of the preset), none, name=rate, or none,name=rate. "
            f"Names: {', '.join(field.name for field in fields(Faults))}.",
            rich_help_panel=TROUBLE,
        ),
    ] = "default",
    phenomena: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Refinements of the physics: all, plain, or a list such as all,-snow or plain,headwind. "
            f"Names: {', '.join(Phenomena._fields)}.",
            rich_help_panel=TROUBLE,
        ),
    ] = "all",
    conditions: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Conditions to add, such as waits=0.2,spell=30:-15:3 (on day 30, 15 K below anything before, for "
            "3 days) or display_fault=2:frozen:10:5 (car 2, on day 10, for 5 days). "
            f"Names: {', '.join(CONDITION_NAMES)}.",
            rich_help_panel=TROUBLE,
        ),
    ] = "",
    fleet: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Fleet on which forecasts are judged, which sets everything except the seed; conditions are added. "
            f"Names: {', '.join(FLEETS)}.",
            rich_help_panel=FLEET,
        ),
    ] = None,
    place: ClusterPlace | None = None,
) -> None:
    """Simulate electric taxis; write a recording and its truth, FILE.truth.json.

    Examples
    --------
    socast simulate --out small.mcap --vehicles 2 --shift-hours 2
    socast simulate --out large.mcap --vehicles 1000 --days 6 --cluster local:2
    """
    size: dict[str, Any] = {
        "vehicles": vehicles,
        "days": days,
        "day_step": day_step,
        "shift_hours": shift_hours,
        "models": None if models is None else parse_models(models),
        "rides": rides,
    }
    size = {name: value for name, value in size.items() if value is not None}
    if fleet is not None:
        others = (preset, start, charging, hidden or None, faults, phenomena)
        if size or others != (None, FIRST_DAY, LOW, None, "default", "all"):
            raise SettingsError(f"fleet {fleet} has its own settings; leave out all others but --seed and --conditions")
        known = get_fleet(fleet, seed)
        simulation = replace(known, conditions=parse_conditions(conditions, known.conditions))
    else:
        refuse_unused_settings(preset, list(size))
        simulation = Simulation(
            start=parse_start(start),
            seed=seed,
            hidden=tuple(parse_hidden(text) for text in hidden or ()),
            faults=parse_faults(faults, Faults() if preset is None else load_preset(preset).fleet.faults),
            phenomena=parse_phenomena(phenomena),
            preset=preset,
            charging=charging,
            conditions=parse_conditions(conditions),
            **size,
        )
    truth = write_simulation(simulation, out, place)
    total = truth.summary()
    per_km = 1000 * (total["kwh_per_km"] or 0)
    console = Console()
    print_plain(
        console,
        f"{out}: {format_count(total['messages'], 'message')}, {format_count(total['rides'], 'ride')} of "
        f"{format_count(len(truth.cars), 'car')}, "
        f"{total['distance_km']:,.0f} km, {total['energy_kwh']:,.0f} kWh, {per_km:.0f} Wh/km",
    )
    for effect, what in total["hidden"].items():
        console.print(f"hidden: {effect}, {what['absolute_share']:.2%} of the energy", markup=False, highlight=False)


def write_simulation(simulation: Simulation, out: Path, place: ClusterPlace | None = None) -> Truth:
    """Write the recording of a simulation, and its truth beside it."""
    fleet = prepare_fleet(simulation)
    check_outputs((), out)
    with open_workers(place, out.resolve().parent, "simulation") as workers:
        return write_recording(fleet, out, workers)
