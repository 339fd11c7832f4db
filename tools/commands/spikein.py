"""`socast spikein`: put a known effect into recordings of real cars, so that a diagnosis can be judged on them."""

import re
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.progress import TaskProgressColumn, TimeRemainingColumn

from socast.core.errors import SettingsError
from socast.core.formatting import format_count
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import OTHER, get_power
from socast.tools.simulator.settings import parse_start
from socast.tools.spikein.choice import ScoreChoice
from socast.tools.spikein.recording import write_spiked
from socast.tools.spikein.records import SpikeTruth
from socast.tools.spikein.spike import Spike
from socast.tools.terminal.output import (
    HtmlFile,
    JsonFile,
    check_outputs,
    make_console,
    print_plain,
    refuse,
    split_names,
    write_json,
)
from socast.tools.terminal.progress import show_bar
from socast.tools.terminal.recordings import Recordings, open_recordings, warn_of_losses
from socast.tools.terminal.report_output import show_report

LARGEST: Final = 0.5
"""Largest size of an effect. [1]"""


def spikein(
    recordings: Recordings,
    *,
    effect: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Effect: {', '.join(sorted(EFFECTS))}; followed by {OTHER}, the same phenomenon by another formula. "
            "With --score: names separated by commas, by default all.",
        ),
    ] = None,
    size: Annotated[
        str,
        typer.Option(
            metavar="SHARE",
            help="Energy of the effect over that of the cars, such as 3% or 0.03. With --score: several, as 2%,4%.",
        ),
    ] = "3%",
    vehicles: Annotated[
        str | None, typer.Option(metavar="A,B", help="Cars that have the effect. Default: all.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(metavar="DATE", help="Day or time, UTC, from which they have it. Default: always.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of tyre pressures, brakes, wear and made-up weather.")] = 0,
    score: Annotated[
        bool, typer.Option("--score", help="Diagnose the recordings with and without each effect, and compare.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="F.mcap", help="Recording to write; not with --score.")
    ] = None,
    html_file: HtmlFile = None,
    json_file: JsonFile = None,
) -> None:
    """Put a known effect into recordings, merged in time order, and write its truth beside the result.

    The current of each sample changes by the power of the effect over the voltage; of a car that sends no current, the
    state of charge changes. All other bytes stay. The formulas are those of the simulator and not those of the models,
    so a diagnosis that finds the effect has not merely met its own formula again. Drives without the effect are the
    placebo: compare what is said of both, or let --score compare them for many effects and sizes.

    Where the effect needs wind, rain, sun or humidity and the recordings hold no weather, a made-up station is added.

    Examples
    --------
    socast spikein recordings/autumn.mcap --effect headwind --size 4% -o spiked.mcap
    socast spikein drives.mcap --effect standby --size 3% --vehicles car-1 --since 2023-05-05 -o spiked.mcap
    socast spikein drives.mcap --score --effect headwind,standby,cabin_heating --size 2%,4% --html score.html
    """
    refuse(
        (
            score == (out is not None),
            "a recording is written with -o F.mcap, and none with --score: give one of the two",
        ),
        (not score and effect is None, f"--effect is missing; choose from {', '.join(sorted(EFFECTS))}"),
        (not score and html_file is not None, "--html shows a score: give --score, or leave it out"),
    )
    begin = parse_start(since).timestamp() if since else None
    cars = split_names(vehicles)
    if score:
        chosen = split_names(effect or ",".join(sorted(EFFECTS)))
        choice = ScoreChoice(chosen, tuple(map(parse_size, split_names(size))), cars, begin, (seed,))
        _score(recordings, choice, html_file, json_file)
        return
    assert out is not None  # checked above
    assert effect is not None  # checked above
    sources = open_recordings(recordings)
    truth_file = out.with_name(f"{out.name}.truth.json")
    check_outputs(recordings, out, truth_file, json_file)
    truth = write_spiked(sources, Spike(effect, parse_size(size), cars, begin, seed), out)
    write_json(json_file, "spikein", truth)
    console = make_console(json_file)
    print_plain(console, *describe(truth, out, truth_file))
    warn_of_losses(sources)


def _score(recordings: list[Path], choice: ScoreChoice, html_file: Path | None, json_file: Path | None) -> None:
    """Score the diagnosis and show the result."""
    from socast.tools.spikein.score import score_spikes  # noqa: PLC0415 - what diagnoses takes seconds to import

    for name in choice.effects:
        get_power(name)
    open_recordings(recordings)
    check_outputs(recordings, html_file, json_file)
    with show_bar("scoring", TaskProgressColumn(), TimeRemainingColumn()) as report:
        result = score_spikes(recordings, choice, report)
    write_json(json_file, "spikein-score", result)
    show_report("spikein", result, html_file, json_file)


def parse_size(text: str) -> float:
    """Return a share of the energy from `3%` or `0.03`.

    Examples
    --------
    >>> parse_size("3%"), parse_size("0.03")
    (0.03, 0.03)
    """
    found = re.fullmatch(r"\s*(\d*\.?\d+)\s*(%?)\s*", text)
    size = float(found[1]) / (100.0 if found[2] else 1.0) if found else 0.0
    if not 0.0 < size <= LARGEST:
        raise SettingsError(f"the size is {text!r}, must be above 0 and at most {LARGEST:.0%}, such as 3%")
    return size


def describe(truth: SpikeTruth, out: Path, truth_file: Path) -> list[str]:
    """Return the lines of the summary."""
    cars = {drive.vehicle_id for drive in truth.drives}
    energy = sum(drive.energy_kwh for drive in truth.drives)
    drives, many = format_count(len(truth.drives), "drive"), format_count(len(cars), "car")
    share = f"{truth.effect} takes {truth.size:.1%} of the energy of {drives} of {many}, {energy:+.2f} kWh"
    lines = [
        f"{out}: {share}; {format_count(truth.samples, 'sample')} changed",
        f"{truth_file}: what was put in, drive by drive",
    ]
    if truth.made_weather:
        lines.append("the recordings hold no weather, so a made-up station was added")
    return lines
