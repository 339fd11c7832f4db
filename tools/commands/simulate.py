"""`socast simulate`: a fleet of electric taxis in a Montreal year, as a recording, and the truth about it beside."""

from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from stream.mcap_writer import McapSink
from tools.simulator.fleet import count_shifts
from tools.simulator.fleet import simulate as messages_of
from tools.simulator.hidden import EFFECTS
from tools.simulator.hidden_shapes import OTHER
from tools.simulator.preset import PRESETS, load_preset, refuse_unused_settings
from tools.simulator.settings import (
    CHARGING,
    LOW,
    MODELS,
    RIDES,
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
    vehicles: Annotated[int | None, typer.Option(help="How many cars, by default 5.")] = None,
    days: Annotated[int | None, typer.Option(help="How many days, one shift a car each; by default 1.")] = None,
    start: Annotated[
        str,
        typer.Option(
            metavar="DATE",
            help="First day, 2018-01-15: shifts are spread over it. Or a time, 2018-01-15T12:00 (UTC): all begin then.",
        ),
    ] = "2018-01-15",
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.")] = 0,
    day_step: Annotated[
        int | None, typer.Option(help="Days from one simulated day to the next, to cover seasons; by default 1.")
    ] = None,
    shift_hours: Annotated[
        float | None, typer.Option(metavar="HOURS", help="Length of every shift, by default 7 to 10 h.")
    ] = None,
    models: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help=f"Catalogue keys of the car models, handed out in turn; by default {', '.join(MODELS)}.",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A fleet that was described elsewhere, over a year, instead of --vehicles, --days, --day-step, "
            f"--shift-hours and --models: {', '.join(PRESETS)}.",
        ),
    ] = None,
    rides: Annotated[
        int | None, typer.Option(metavar="N", help=f"How many rides a preset has, by default {RIDES:,}.")
    ] = None,
    charging: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            help=f"When cars charge: {', '.join(CHARGING)}. {LOW}: in a shift too, where dispatch finds one low. "
            "night: between shifts alone, so that some end below their reserve, or empty.",
        ),
    ] = LOW,
    hidden: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT[:SIZE]",
            help="Add an effect that no model knows of, by default 0.03 of the energy; may be repeated. "
            f"Effects: {', '.join(sorted(EFFECTS))}; NAME{OTHER} is the same in another shape.",
        ),
    ] = None,
    faults: Annotated[
        str,
        typer.Option(
            metavar="RATES",
            help="Faults of the loggers: default (or the preset's), none, name=rate, or none,name=rate. "
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
    size: dict[str, Any] = {
        "vehicles": vehicles,
        "days": days,
        "day_step": day_step,
        "shift_hours": shift_hours,
        "models": None if models is None else parse_models(models),
        "rides": rides,
    }
    size = {name: value for name, value in size.items() if value is not None}
    refuse_unused_settings(preset, list(size))
    simulation = Simulation(
        start=parse_start(start),
        seed=seed,
        hidden=tuple(parse_hidden(text) for text in hidden or ()),
        faults=parse_faults(faults, Faults() if preset is None else load_preset(preset).fleet.faults),
        phenomena=parse_phenomena(phenomena),
        preset=preset,
        charging=charging,
        **size,
    )
    truth = record(simulation, out)
    total = truth.summary()
    per_km = 1000 * (total["kwh_per_km"] or 0)
    console = Console()
    console.print(
        f"{out}: {total['messages']:,} messages, {total['rides']:,} rides of {len(truth.cars)} cars, "
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
        bar = progress.add_task("driving shifts", total=count_shifts(simulation))
        messages = messages_of(simulation, truth, lambda shifts: progress.advance(bar, shifts))
        with McapSink(out) as sink:
            while block := list(islice(messages, BLOCK)):
                sink.put(block)
                truth.messages += len(block)
    truth.write(out.with_suffix(".truth.json"))
    return truth
