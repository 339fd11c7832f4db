"""Collect the true values of a simulation, for the file beside its recording and for tests."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from socast.core.batch import Floats
from socast.core.errors import SettingsError
from socast.core.files import write_whole
from socast.tools.simulator.car_files import ShiftTruth
from socast.tools.simulator.cars import Car
from socast.tools.simulator.conditions import NO_CONDITIONS
from socast.tools.simulator.hidden_shapes import EffectEnergies
from socast.tools.simulator.logger import Equipment
from socast.tools.simulator.physics import PARTS, State
from socast.tools.simulator.settings import PERIOD, PRESET_SETTINGS, STEP, Simulation
from socast.tools.simulator.shift import Shift
from socast.tools.simulator.world import compute_elevation, to_plane

KWH = 3.6e6
DISPLAY_STEPS = 120
"""Steps between two recorded values of a display."""


@dataclass
class Truth:
    """Collect true values while the messages of a simulation are taken.

    Attributes
    ----------
    factors : dict of str to float
        Factor of each hidden effect. [1]
    rides : list of dict
        For each ride: its true distance, and the heights that it gains and loses; its energy at the terminals of the
        battery (`energy_kwh`, the integral of voltage times current); the loss inside the battery
        (`battery_resistance_kwh`); the parts that add up to `energy_kwh`; and the energy of each hidden effect.
    cars : dict of str to dict
        For each car: its true parameters in SI units, its model, and what its logger lacks.
    faults : dict of str to Counter
        Number of faults of the logger of each car, by kind.
    displays : list of dict
        For each shift of a simulation with conditions: `vehicle_id`; `begin_s` and the time `step_s` between values
        [s]; `soc_pct`, the true state of charge, and `shown_pct`, what a healthy display shows [%]; and the `fault` of
        the display, None without one.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    factors: dict[str, float] = field(default_factory=dict)
    rides: list[dict[str, Any]] = field(default_factory=list)
    cars: dict[str, dict[str, Any]] = field(default_factory=dict)
    faults: dict[str, Counter[str]] = field(default_factory=dict)
    messages: int = 0
    displays: list[dict[str, Any]] = field(default_factory=list)

    def describe(self, simulation: Simulation, factors: dict[str, float]) -> None:
        """Record the settings of a simulation."""
        unused = ("preset", "rides") if simulation.preset is None else PRESET_SETTINGS
        values = {name: value for name, value in asdict(simulation).items() if name not in unused}
        self.settings = values | {
            "start": simulation.start.isoformat(),
            "hidden": dict(simulation.hidden),
            "phenomena": [name for name, on in simulation.phenomena._asdict().items() if on],
        }
        if simulation.conditions == NO_CONDITIONS:
            del self.settings["conditions"]
        self.factors = factors

    def add_car(self, name: str, model: str, car: Car, equipment: Equipment) -> None:
        """Record a car."""
        parameters = {key: float(f"{value:.6g}") for key, value in car._asdict().items()}
        self.cars[name] = {"model": model, "logger_lacks": list(equipment.lacks)} | parameters
        if equipment.period != PERIOD:
            self.cars[name]["logger_period_s"] = equipment.period
        self.faults[name] = Counter()

    def add_shift(
        self, name: str, shift: Shift, state: State, hidden: EffectEnergies | None, faults: Counter[str]
    ) -> None:
        """Record the rides of a shift."""
        self.faults[name] += faults
        heights = compute_elevation(*to_plane(shift.timeline.u, shift.timeline.v))
        climb = np.diff(heights, prepend=heights[0])
        for index, trip in enumerate(shift.trips):
            inside = slice(trip.begin, trip.end)
            parts = state.parts[inside].sum(axis=0) * STEP / KWH
            used = zip(PARTS, parts.tolist(), strict=True)
            ride: dict[str, Any] = {
                "vehicle_id": name,
                "ride_id": trip.ride_id,
                "driver_id": trip.driver_id,
                "start_s": shift.time + STEP * trip.begin,
                "end_s": shift.time + STEP * trip.end,
                "distance_km": round(float(shift.timeline.moved[inside].sum()) / 1000, 4),
                "gained_m": round(float(np.maximum(climb[inside], 0.0).sum()), 2),
                "lost_m": round(float(np.maximum(-climb[inside], 0.0).sum()), 2),
                "soc_start_pct": round(100 * float(state.soc[trip.begin]), 3),
                "soc_end_pct": round(100 * float(state.soc[trip.end - 1]), 3),
                "energy_kwh": round(float(parts.sum()), 5),
                "battery_resistance_kwh": round(float(state.loss[inside].sum()) * STEP / KWH, 5),
                "parts_kwh": {part: round(energy, 5) for part, energy in used if abs(energy) >= 5e-6},
            }
            if hidden is not None:
                energies = zip(self.factors, hidden.effects[index] / KWH, strict=True)
                ride["hidden_kwh"] = {effect: round(float(energy), 5) for effect, energy in energies}
            self.rides.append(ride)

    def add_display(self, name: str, begin: float, state: State, shown: Floats, fault: str | None) -> None:
        """Record the state of charge of a shift, and what its display would show without a fault.

        Units: begin [s], shown [%].
        """
        at = slice(DISPLAY_STEPS - 1, None, DISPLAY_STEPS)
        self.displays.append(
            {
                "vehicle_id": name,
                "begin_s": begin,
                "step_s": DISPLAY_STEPS * STEP,
                "fault": fault,
                "soc_pct": np.round(np.clip(100.0 * state.soc[at], 0.0, 100.0), 2).tolist(),
                "shown_pct": np.round(shown[at], 2).tolist(),
            }
        )

    def take_shifts(self, shifts: Iterable[ShiftTruth], faults: Mapping[str, Counter[str]]) -> None:
        """Take what was recorded of shifts elsewhere."""
        for shift in shifts:
            self.rides += shift.rides
            self.displays += shift.displays
        self.faults.update(faults)

    def summary(self) -> dict[str, Any]:
        """Return totals over all rides, and the size of each hidden effect."""
        total = sum(ride["energy_kwh"] for ride in self.rides)
        distance = sum(ride["distance_km"] for ride in self.rides)
        parts: Counter[str] = Counter()
        for ride in self.rides:
            parts.update(ride["parts_kwh"])
        hidden = {}
        for effect, factor in self.factors.items():
            energies = np.array([ride["hidden_kwh"][effect] for ride in self.rides])
            hidden[effect] = {
                "size": self.settings["hidden"][effect],
                "factor": float(f"{factor:.6g}"),
                "energy_kwh": round(float(energies.sum()), 4),
                "share": round(float(energies.sum()) / total, 5),
                "absolute_share": round(float(np.abs(energies).sum()) / total, 5),
            }
        faults: Counter[str] = sum(self.faults.values(), Counter())
        return {
            "messages": self.messages,
            "rides": len(self.rides),
            "distance_km": round(distance, 3),
            "energy_kwh": round(total, 4),
            "kwh_per_km": round(total / distance, 4) if distance else None,
            "battery_resistance_kwh": round(sum(ride["battery_resistance_kwh"] for ride in self.rides), 4),
            "parts_kwh": {part: round(parts[part], 4) for part in PARTS if part in parts},
            "hidden": hidden,
            "faults": dict(faults),
        }

    def write(self, path: Path) -> None:
        """Write the truth as JSON that a person can read, with one line for each ride."""
        faults = {name: dict(counts) for name, counts in self.faults.items()}
        blocks = {"simulation": self.settings, "total": self.summary()}
        lines = [f'"{name}": {json.dumps(block, indent=1)}' for name, block in blocks.items()]
        lines += [_table("cars", self.cars), _table("faults", faults)]
        rides = ",\n  ".join(json.dumps(ride) for ride in self.rides)
        lines.append(f'"rides": [\n  {rides}\n]')
        if self.displays:
            displays = ",\n  ".join(json.dumps(display) for display in self.displays)
            lines.append(f'"displays": [\n  {displays}\n]')
        try:
            write_whole(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())
        except OSError as error:
            raise SettingsError(f"{path} cannot be written: {error.strerror}; choose another place") from error


def _table(name: str, rows: dict[str, Any]) -> str:
    """Return a JSON object of objects with one line for each."""
    lines = ",\n  ".join(f"{json.dumps(key)}: {json.dumps(row)}" for key, row in rows.items())
    return f'"{name}": {{\n  {lines}\n}}'
