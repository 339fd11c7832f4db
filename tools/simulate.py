"""`socast simulate`: a fleet of electric taxis in a Montreal year, as a recording, and the truth about it beside."""

from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from stream.mcap_io import McapSink
from tools.simulator.fleet import simulate as messages_of
from tools.simulator.hidden import EFFECTS
from tools.simulator.settings import (
    MODELS,
    Faults,
    Phenomena,
    Simulation,
    parse_faults,
    parse_hidden,
    parse_models,
    parse_phenomena,
    parse_start,
)
from tools.simulator.truth import Truth

BLOCK = 4096
"""Messages handed to the recording at a time."""


def simulate(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.mcap", help="The recording to write.")],
    vehicles: Annotated[int, typer.Option(help="How many cars.")] = 5,
    days: Annotated[int, typer.Option(help="How many days, one shift a car each.")] = 1,
    start: Annotated[
        str,
        typer.Option(
            metavar="DATE",
            help="First day, 2018-01-15: shifts are spread over it. Or a time, 2018-01-15T12:00 (UTC): all begin then.",
        ),
    ] = "2018-01-15",
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.")] = 0,
    day_step: Annotated[int, typer.Option(help="Days from one simulated day to the next, to cover seasons.")] = 1,
    shift_hours: Annotated[
        float | None, typer.Option(metavar="HOURS", help="Length of every shift. [default: 7 to 10 h]")
    ] = None,
    models: Annotated[
        str, typer.Option(metavar="A,B", help="Catalogue keys of the car models, handed out in turn.")
    ] = ",".join(MODELS),
    hidden: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT[:SIZE]",
            help="Add an effect that no model knows of, by default 0.03 of the energy; may be repeated. "
            f"Effects: {', '.join(sorted(EFFECTS))}.",
        ),
    ] = None,
    faults: Annotated[
        str,
        typer.Option(
            metavar="RATES",
            help="Faults of the loggers: default, none, name=rate, or none,name=rate. "
            f"Names: {', '.join(field.name for field in fields(Faults))}.",
        ),
    ] = "default",
    phenomena: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Refinements of the physics: all, plain, all,-snow or plain,headwind. "
            f"Names: {', '.join(Phenomena._fields)}.",
        ),
    ] = "all",
) -> None:
    """Simulate a fleet of electric taxis; FILE.truth.json beside the recording tells what really happened."""
    simulation = Simulation(
        vehicles=vehicles,
        days=days,
        start=parse_start(start),
        seed=seed,
        day_step=day_step,
        shift_hours=shift_hours,
        models=parse_models(models),
        hidden=tuple(parse_hidden(text) for text in hidden or ()),
        faults=parse_faults(faults),
        phenomena=parse_phenomena(phenomena),
    )
    truth = record(simulation, out)
    total = truth.summary()
    per_km = 1000 * (total["kwh_per_km"] or 0)
    console = Console()
    console.print(
        f"{out}: {total['messages']:,} messages, {total['rides']:,} rides of {vehicles} cars, "
        f"{total['distance_km']:,.0f} km, {total['energy_kwh']:,.0f} kWh, {per_km:.0f} Wh/km",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    for effect, what in total["hidden"].items():
        console.print(f"hidden: {effect}, {what['absolute_share']:.2%} of the energy", markup=False, highlight=False)


def record(simulation: Simulation, out: Path) -> Truth:
    """Write a simulation's recording, and its truth beside it.

    Parameters
    ----------
    simulation : Simulation
    out : Path
        The recording; the truth goes to the same name with `.truth.json`.

    Returns
    -------
    Truth
        Complete.

    Raises
    ------
    SettingsError
        For what cannot be simulated, before anything is written.
    RecordingError
        Where the recording cannot be written.
    """
    truth = Truth()
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("driving shifts", total=simulation.vehicles * simulation.days)
        messages = messages_of(simulation, truth, lambda shifts: progress.advance(bar, shifts))
        with McapSink(out) as sink:
            while block := list(islice(messages, BLOCK)):
                sink.put(block)
                truth.messages += len(block)
    truth.write(out.with_suffix(".truth.json"))
    return truth
