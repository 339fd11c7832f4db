"""Hold the waterfall against the truth of simulated fleets: `python -m socast.tools.bench.waterfall`.

Each seed simulates a fleet of one vehicle model, fits a recipe to its tables, and splits the measured energy as
`socast waterfall` does. The simulator knows the power of each physical cause in each of its steps, so it knows what
each term took. The powers of the road load are at the wheels. A model counts them at the battery, at what driving costs
there, and has the rest of what braking does not regain in a term of its own. The true energies are counted alike:

    k = 1 + powertrain losses while driving / energy at the wheels while driving, for each car,
    true energy of a cause = k times its energy at the wheels,
    losses in braking = k times the braking energy at the wheels, less what the battery receives of it.

They add up to the true energy at the battery. The losses include those of motors that turn without load: they are paid
for driving as all others are, and no accessory takes them. The mass of the occupants counts in rolling, climbing and
speed changes.
Speeding up and slowing are those from sample to sample of the logger: what changes faster cancels.
"""

import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from multiprocessing import get_context
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core import effects
from socast.core.condition.energy_parts import WAITING
from socast.core.condition.energy_split import split_energy
from socast.core.evaluate.compare.models import select_rides
from socast.core.fit.recipes import fit_to_windows
from socast.core.formatting import format_minus
from socast.tools.bench.coefficients import MODELS
from socast.tools.bench.condition_fleets import write_share
from socast.tools.bench.figures.published import (
    keep,
    make_parser,
    parse_seeds,
    publish,
    show_table,
    tell_errors,
    write_table,
)
from socast.tools.bench.measures import tabulate
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.hidden_shapes import EffectEnergies
from socast.tools.simulator.physics import (
    AIR_DENSITY,
    BATTERY_HEATING,
    BRAKE_DRAG,
    BRAKES,
    CLIMBING,
    COLD_ROLLING,
    COOLING,
    CORNERING,
    DRAG,
    DRYING,
    ELECTRONICS,
    HEADWIND,
    HEATING,
    INERTIA,
    LIGHTS,
    LOSSES,
    PAYLOAD,
    PERSON,
    ROLLING,
    SNOW,
    SPEED_ROLLING,
    TYRE_PRESSURE,
    WET_ROAD,
    WHEEL,
    WINTER_TYRES,
    State,
)
from socast.tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    PLAIN_PHENOMENA,
    STEP,
    STEPS_PER_SAMPLE,
    Faults,
    Simulation,
)
from socast.tools.simulator.shift import Shift
from socast.tools.simulator.truth import KWH, Truth

TYRES: Final = (
    *(ROLLING, SPEED_ROLLING, COLD_ROLLING, WET_ROAD, SNOW, TYRE_PRESSURE, WINTER_TYRES, CORNERING),
    BRAKE_DRAG,
)
AIR: Final = (DRAG, AIR_DENSITY, HEADWIND)
ACCESSORIES: Final = (ELECTRONICS, LIGHTS, HEATING, COOLING, DRYING, BATTERY_HEATING)
"""Causes that count in the terms of rolling, of air drag, and of climate and accessories."""
SEEDS: Final = "5101-5110"
"""Seeds on which nothing was chosen."""
RECIPE: Final = "road_load"
SETTINGS: Final = {
    "plain": (PLAIN_PHENOMENA._replace(payload=True), NO_FAULTS),
    "whole": (ALL_PHENOMENA, Faults()),
}
"""Physics that the terms describe, and all physics with faulty loggers."""
NEAR: Final = 0.1
"""Error of a term, over its true energy, that counts as none. [1]"""
HEADS: Final = (
    "term",
    "true, kWh/100 km",
    "bias",
    "half of the 95 % interval",
    "truth in the interval",
    "in it or within 10 %",
)
"""Heads of the tables."""
TITLES: Final = {
    "plain": "Physics that the terms describe:",
    "whole": "All physics of the simulator, much of which `road_load` lacks, and loggers with faults:",
}


class TermTruth(Truth):
    """Collect what each ride took at the wheels by term of the model, besides the usual truth."""

    def add_shift(
        self, name: str, shift: Shift, state: State, hidden: EffectEnergies | None, faults: Counter[str]
    ) -> None:
        """Record the rides of a shift."""
        first = len(self.rides)
        super().add_shift(name, shift, state, hidden, faults)
        parts, line = state.parts, shift.timeline
        wheel = parts[:, : len(WHEEL)].sum(axis=1)
        people = PERSON * line.occupants * (parts[:, PAYLOAD] != 0.0)
        faster = people * (line.after**2 - line.before**2) / (2.0 * STEP)
        higher = people / self.cars[name]["mass"] * parts[:, CLIMBING]
        stands = (line.before + line.after) == 0.0
        losses, on_board = parts[:, LOSSES], parts[:, ACCESSORIES].sum(axis=1)
        inertia, driven = parts[:, INERTIA] + faster, np.maximum(wheel, 0.0)
        powers = {
            "rolling": parts[:, TYRES].sum(axis=1) + parts[:, PAYLOAD] - faster - higher,
            "aero_drag": parts[:, AIR].sum(axis=1),
            "climbing": parts[:, CLIMBING] + higher,
            "accessories": np.where(stands, 0.0, on_board),
            WAITING: np.where(stands, on_board, 0.0),
            "driven": driven,
            "driving_losses": np.where(wheel >= 0.0, losses, 0.0),
            "braked": driven - wheel,
            "braking_losses": np.where(wheel < 0.0, losses, 0.0) + parts[:, BRAKES],
        }
        for ride, trip in zip(self.rides[first:], shift.trips, strict=True):
            inside = slice(trip.begin, trip.end)
            energies = {key: float(power[inside].sum()) for key, power in powers.items()}
            kinetic = inertia[inside]
            changes = np.add.reduceat(kinetic, np.arange(0, len(kinetic), STEPS_PER_SAMPLE))
            energies["inertia_positive"] = float(np.maximum(changes, 0.0).sum())
            energies["inertia_negative"] = float(np.minimum(changes, 0.0).sum())
            ride["terms_kwh"] = {key: energy * STEP / KWH for key, energy in energies.items()}


class TermEnergy(NamedTuple):
    """Hold the energy of a term in a fleet.

    Parameters
    ----------
    truth, value, half, per_100km : float
        True energy, that of the waterfall, half of its 95 % interval [kWh]; the first per distance [kWh/100 km].
    """

    seed: int
    physics: str
    term: str
    truth: float
    value: float
    half: float
    per_100km: float

    @property
    def is_held(self) -> bool:
        """Whether the interval holds the true energy."""
        return abs(self.value - self.truth) <= self.half

    @property
    def is_right(self) -> bool:
        """Whether the interval holds the true energy, or the error is small."""
        return self.is_held or abs(self.value - self.truth) <= NEAR * abs(self.truth)


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Run the measurement, print its tables and write its JSON file, which is used again."""
    parser = make_parser("waterfall", __doc__, seeds=SEEDS, json=None, publish=False)
    parser.add_argument("--processes", type=int, default=2, help="number of processes")
    options = parser.parse_args(arguments)
    kept = keep(options.json, lambda: measure_fleets(parse_seeds(options.seeds), options.processes))
    energies, lines = [TermEnergy(**each) for each in kept["energies"]], list[str]()
    for physics, title in TITLES.items():
        rows = list_rows([each for each in energies if each.physics == physics])
        show_table(title, HEADS, rows)
        lines += ["", title, "", *write_table(HEADS, rows)]
    if options.publish:
        fleets = len({each.seed for each in energies})
        about = (
            f"{fleets} simulated fleets of three cars for each table, which drive two hours on each of five days. "
            f"The terms are those of `{RECIPE}`, fitted to the same rides. The goal is that the interval holds the "
            "true energy, or that the error is within 10 % of it. Losses of the powertrain while driving count in each "
            "cause by its energy at the wheels. In parentheses: 95 % interval (Wilson)."
        )
        publish("waterfall", f"python -m socast.tools.bench.waterfall --seeds {options.seeds}", [about, *lines])


def measure_fleets(seeds: Sequence[int], processes: int) -> dict[str, Any]:
    """Return the energies of all fleets, as JSON holds them."""
    cases = [(seed, physics) for seed in seeds for physics in SETTINGS]
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:  # a fork would copy locks of threads
        energies = [each._asdict() for fleet in pool.map(measure_fleet, *zip(*cases, strict=True)) for each in fleet]
    return {"recipe": RECIPE, "energies": energies}


def measure_fleet(seed: int, physics: str) -> list[TermEnergy]:
    """Return the energies of the terms of a simulated fleet beside the true ones."""
    phenomena, faults = SETTINGS[physics]
    truth = TermTruth()
    simulation = Simulation(
        vehicles=3,
        days=5,
        day_step=73,
        shift_hours=2.0,
        start=datetime(2018, 1, 15, tzinfo=UTC),
        seed=seed,
        models=(MODELS[seed % len(MODELS)],),
        phenomena=phenomena,
        faults=faults,
    )
    also = list(effects.list_tabulated())
    rides, windows = tabulate(list(simulate(simulation, truth)), also=also, two_sided=True)
    model = fit_to_windows(RECIPE, rides, windows)
    known = {(ride["vehicle_id"], ride["ride_id"]) for ride in truth.rides}  # rides without a name have no truth
    rides = rides[[each in known for each in zip(rides["vehicle_id"], rides["ride_id"], strict=True)]]
    split = split_energy(rides, model)
    chosen = select_rides(rides, {model.name: model}).rides
    true = sum_terms(truth, set(zip(chosen["vehicle_id"], chosen["ride_id"], strict=True)))
    per = 100.0 / split.fleet.distance_km
    return [
        TermEnergy(seed, physics, share.name, truth_kwh, energy.value, energy.ci95 or 0.0, per * truth_kwh)
        for share in split.fleet.shares
        if (truth_kwh := true.get(share.name)) is not None and (energy := share.energy_kwh).value is not None
    ]


def sum_terms(truth: Truth, rides: set[tuple[str, str]]) -> dict[str, float]:
    """Return the true energy of each term at the battery over some rides, named by car and ride. [kWh]"""
    out: dict[str, float] = defaultdict(float)
    for name in truth.cars:
        sums: dict[str, float] = defaultdict(float)
        for ride in truth.rides:
            if ride["vehicle_id"] == name and (name, ride["ride_id"]) in rides:
                for term, energy in ride["terms_kwh"].items():
                    sums[term] += energy
        for term in ("accessories", WAITING):
            out[term] += sums.pop(term, 0.0)
        driven, losses, braked, lost = (
            sums.pop(key, 0.0) for key in ("driven", "driving_losses", "braked", "braking_losses")
        )
        cost = 1.0 + losses / driven if driven else 1.0
        for term, energy in sums.items():
            out[term] += cost * energy
        out["braking"] += (cost - 1.0) * braked + lost
    return dict(out)


def list_rows(energies: Sequence[TermEnergy]) -> list[list[str]]:
    """Return how near the energies of each term are to the true ones, as cells below `HEADS`."""
    rows = []
    for term in dict.fromkeys(each.term for each in energies):
        mine = [each for each in energies if each.term == term]
        truth, value, half, per = np.array([each[3:] for each in mine]).T
        size = np.abs(truth).sum()
        rows.append(
            [
                term,
                format_minus(f"{per.mean():.2f}"),
                format_minus(f"{100.0 * (value - truth).sum() / size:.1f} %"),
                f"{100.0 * half.sum() / size:.1f} %",
                write_share([each.is_held for each in mine]),
                write_share([each.is_right for each in mine]),
            ]
        )
    return rows


if __name__ == "__main__":
    sys.exit(main())
