"""Judge forecasts of the state of charge on simulated fleets in which much goes wrong, against goals.

Each seed gives the fleets of the chosen parts. Their messages pass the loop of live telemetry, so that a forecast rests
on nothing from its future. Outcomes are what healthy displays show, also where a display is faulty. Shares have
Wilson's 95 % intervals for as many independent cases as the vehicle-days are worth.

Example: python -m socast.tools.bench.soc_forecasts --fleet autumn --seeds 1-2 --keep build/soc
"""

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Final

import pandas as pd
from rich.console import Console

from socast.core import models
from socast.core.evaluate.soc.baselines import compute_baselines
from socast.core.evaluate.soc.cases import (
    HOURS_AHEAD,
    SHIFT_KEY,
    count_impossible_bounds,
    normalise_keys,
    replace_outcomes,
    select_cases,
)
from socast.core.evaluate.soc.planned_charges import select_charge_cases
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Message
from socast.stream.loop import run
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.bench.figures.published import make_parser, parse_seeds, write_json, write_table
from socast.tools.bench.soc_goals import COMPARED, NO_PLANS, Judged, Line, check_goals
from socast.tools.bench.soc_reference import compute_reference
from socast.tools.commands.evaluate_soc import SocForecasts
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.preset import load_preset
from socast.tools.simulator.settings import Simulation, get_fleet
from socast.tools.simulator.truth import Truth
from socast.tools.terminal.model_comparison import DEFAULT_MODEL

PARTS: Final = {
    "autumn": ("autumn", "autumn-heat"),
    "trouble": (
        "autumn-short",
        "autumn-faults",
        "autumn-no-plan",
        "autumn-no-shows",
        "autumn-plans",
        "autumn-way-home",
        "autumn-charges",
    ),
    "charges": ("charges",),
    "small": ("small",),
    "preset": ("preset",),
}
"""Fleets of each part."""
SOON: Final = 0.5
"""Time ahead at which forecasts are judged beside those of the evaluation. [h]"""
BLOCK: Final = 4096
"""Number of messages that the pipeline receives at a time."""


def main(arguments: list[str] | None = None) -> None:
    """Judge, and print a line for each goal."""
    parser = make_parser("soc_forecasts", __doc__, seeds="1", keep=None, json=None)
    parser.add_argument("--fleet", default="autumn", help=f"parts or fleets, of {', '.join(PARTS)}, all")
    parser.add_argument("--rides", type=int, default=20_000, help="number of rides of the preset")
    parser.add_argument("--recording", type=Path, help="recording to judge instead of fleets")
    parser.add_argument("--no-plans", action="store_true", help="leave out the plans of that recording")
    options = parser.parse_args(arguments)
    console = Console()
    if options.recording is not None:
        name, source = options.recording.stem, McapSource(options.recording)
        parts = (name + NO_PLANS, leave_out_plans(source)) if options.no_plans else (name, source)
        judged = [judge(parts[0], 0, 0.0, parts[1], None)]
    else:
        judged = []
        for seed in parse_seeds(options.seeds):
            for fleet in list_fleets(options.fleet):
                one = judge_fleet(fleet, seed, options.rides, options.keep)
                judged.append(one)
                console.print(f"{fleet}, seed {seed}: {len(one.cases)} forecasts in {one.seconds:.0f} s")
    lines = check_goals(judged)
    console.print("\n".join(tabulate(lines)), markup=False, highlight=False, soft_wrap=True)
    write_json(options.json, [line._asdict() for line in lines])


def list_fleets(text: str) -> list[str]:
    """Return the fleets of parts, or fleets by name.

    Examples
    --------
    >>> list_fleets("autumn,small")
    ['autumn', 'autumn-heat', 'small']
    """
    names = list(PARTS) if text == "all" else text.split(",")
    return [fleet for name in names for fleet in PARTS.get(name, (name,))]


def judge_fleet(fleet: str, seed: int, rides: int, keep: Path | None) -> Judged:
    """Simulate a fleet, or read it where it was kept, and judge its forecasts."""
    simulation = make_simulation(fleet, seed, rides)
    truth, first = Truth(), simulation.start.timestamp()
    if keep is None:
        messages = simulate(simulation, truth)
        return judge(fleet, seed, first, make_blocks(messages), truth)
    keep.mkdir(parents=True, exist_ok=True)
    name = f"{fleet}-{rides}-{seed}" if fleet == "preset" else f"{fleet}-{seed}"
    recording, displays = keep / f"{name}.mcap", keep / f"{name}.displays.json"
    if not displays.exists():
        with McapSink(recording) as sink:
            for block in make_blocks(simulate(simulation, truth)):
                sink.put(block)
        displays.write_text(json.dumps(truth.displays) + "\n", encoding="utf-8")
    truth.displays = json.loads(displays.read_text(encoding="utf-8"))
    return judge(fleet, seed, first, McapSource(recording), truth)


def make_simulation(fleet: str, seed: int, rides: int) -> Simulation:
    """Return the simulation of a named fleet, or of the preset."""
    if fleet == "preset":
        return Simulation(preset="teo", rides=rides, seed=seed, faults=load_preset("teo").fleet.faults)
    return get_fleet(fleet, seed)


def make_blocks(messages: Iterator[Message]) -> Iterator[list[Message]]:
    """Yield messages in lists."""
    while block := list(islice(messages, BLOCK)):
        yield block


def leave_out_plans(source: Iterable[Sequence[Message]]) -> Iterator[list[Message]]:
    """Yield messages in lists without the plans."""
    for block in source:
        yield [message for message in block if not message.key.endswith("/plan")]


def judge(
    fleet: str, seed: int, first_day_s: float, source: Iterable[Sequence[Message]], truth: Truth | None
) -> Judged:
    """Pass messages through the loop of live telemetry, and compare its forecasts with outcomes and baselines."""
    begun = time.perf_counter()
    forecasts = SocForecasts(Pipeline(models.load(DEFAULT_MODEL), Settings(), keep_outlooks=True))
    run(forecasts.cut(source), forecasts.pipeline, watch=lambda _: forecasts())
    outlooks, shifts, legs, plans = forecasts.tables()
    displays = pd.DataFrame(truth.displays) if truth is not None and truth.displays else None
    if displays is not None:
        shifts = replace_outcomes(shifts, displays)
    selected = select_cases(outlooks, shifts, find_wanted(shifts))
    tables = outlooks, shifts, plans
    cases, of_cases = selected.cases, (compute_baselines, compute_reference)
    cases = pd.concat([cases, *(baseline(cases, *tables) for baseline in of_cases)], axis=1)
    legs = pd.concat([legs, compute_baselines(legs, *tables), compute_reference(legs, *tables)], axis=1)
    charges = select_charge_cases(outlooks, shifts, plans)
    return Judged(
        fleet,
        seed,
        first_day_s,
        cases,
        selected.unlearned,
        legs,
        outlooks[COMPARED],
        count_impossible_bounds(outlooks, plans),
        time.perf_counter() - begun,
        charges.get("to the charge", pd.DataFrame()),
        charges.get("over the charge", pd.DataFrame()),
    )


def find_wanted(shifts: pd.DataFrame) -> pd.DataFrame:
    """Return the times ahead at which the forecasts of each shift are judged."""
    ended = normalise_keys(shifts)[[*SHIFT_KEY, "end_s"]]
    hours = sorted((*HOURS_AHEAD, SOON))
    wanted = pd.concat([ended.assign(hours=each, wanted_s=ended["end_s"] - 3600.0 * each) for each in hours])
    return wanted.drop(columns="end_s").reset_index(drop=True)


def tabulate(lines: list[Line]) -> list[str]:
    """Return a Markdown table of lines."""
    rows = [(line.fleet, line.what, line.goal, line.measured, line.verdict) for line in lines]
    return write_table(["fleet", "what", "goal", "measured", ""], rows)


if __name__ == "__main__":
    main()
