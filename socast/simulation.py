"""Simulate a fleet whose physics is richer than any model of the product."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from socast.tools.commands.simulate import write_simulation as _write_simulation
from socast.tools.simulator import settings as _settings

__all__ = ["simulate_fleet"]


def simulate_fleet(
    path: str | Path,
    *,
    vehicles: int = 5,
    days: int = 1,
    start: datetime = datetime(2018, 1, 15, tzinfo=UTC),
    shift_hours: float | None = None,
    hidden: tuple[str, ...] = (),
    faults: str = "default",
    seed: int = 0,
) -> dict[str, Any]:
    """Write the recording of a simulated fleet, and beside it the truth.

    Parameters
    ----------
    path : str or Path
        The MCAP recording to write. The truth goes to the same name with `.truth.json`.
    vehicles : int
        Number of cars.
    days : int
        Number of days, with one shift per car and day.
    start : datetime
        First day.
    shift_hours : float, optional
        Length of every shift; by default 7 to 10 h. [h]
    hidden : tuple of str
        Effects that no model knows of, such as `cold_rolling:0.03` for 3 % of the energy.
    faults : str
        Faults of the loggers: `default`, `none`, or rates such as `none,tunnel=0.1`.
    seed : int
        The same seed gives the same bytes.

    Returns
    -------
    dict
        Summary of the truth: messages, rides, distance [km], energy [kWh] and the share of each hidden effect.

    Raises
    ------
    SettingsError
        Where something cannot be simulated; nothing is written then.
    RecordingError
        Where the recording cannot be written.
    """
    size: dict[str, Any] = {} if shift_hours is None else {"shift_hours": shift_hours}
    simulation = _settings.Simulation(
        vehicles=vehicles,
        days=days,
        start=start,
        seed=seed,
        hidden=tuple(_settings.parse_hidden(text) for text in hidden),
        faults=_settings.parse_faults(faults),
        **size,
    )
    summary: dict[str, Any] = _write_simulation(simulation, Path(path)).summary()
    return summary
