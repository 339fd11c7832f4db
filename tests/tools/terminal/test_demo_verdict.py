"""The demonstration ends with how cars and models fared, and with what to do next."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from socast.core import models
from socast.tools.terminal.demo_verdict import (
    compute_errors_pct,
    list_next_commands,
    make_car_records,
    show_cars,
    show_end,
    write_verdict,
)
from tests.support.paths import ROOT

LABELS = ("road_load/1", "extended_physical/1")
QUALITY = {"samples": {"late": 3, "gap": 2}, "undecodable": {"not json": 1}, "lost": 4, "missed": 0}


def make_rides(measured=(1.0, 3.0), first=(1.1, 2.7), second=(0.5, 2.0)):
    return pd.DataFrame(
        {
            "vehicle_id": "taxi-1",
            "vehicle_model": "nissan-leaf-2016",
            "fit_for_training": [True, True, False],
            "distance_km": [5.0, 15.0, 1.0],
            "energy_kwh": [*measured, 9.0],
            "predicted_kwh": [*first, 1.0],
            "shadows_kwh": [{LABELS[1]: value} for value in (*second, np.nan)],
        }
    )


def make_shift(mean, low, high, end):
    return {"vehicle_id": "taxi-1", "soc_end_pct": end, "forecasts": {"1h": {"mean": mean, "p05": low, "p95": high}}}


def write(rides, shift):
    cars = make_car_records(rides, [shift], LABELS)
    model = models.load(str(ROOT / "recordings" / "fitted.json"))
    return cars, write_verdict(cars, compute_errors_pct(rides, LABELS), model, QUALITY)


def test_error_is_that_of_rides_fit_for_training():
    assert compute_errors_pct(make_rides(), LABELS) == pytest.approx({LABELS[0]: 10.0, LABELS[1]: 37.5})


def test_verdict_has_a_line_on_energy_charge_and_stream():
    _, (energy, charge, stream) = write(make_rides(), make_shift(50.0, 45.0, 55.0, 48.0))
    assert energy.startswith("Energy: the fitted road_load is off by 10 % per ride, extended_physical by 38 %;")
    assert "rolling takes 1.7 times the catalogue's energy" in energy
    assert "off by 2.0 % on average; 1 of 1" in charge
    assert "5 faults" in stream
    assert "4 samples lost" in stream


@pytest.mark.parametrize(("end", "held"), [(44.6, 1), (44.4, 0), (55.4, 1), (55.6, 0)])
def test_outcome_within_half_a_step_of_the_interval_is_inside(end, held):
    _, (_, charge, _) = write(make_rides(), make_shift(50.0, 45.0, 55.0, end))
    assert f"{held} of 1 outcomes" in charge


def test_car_without_a_forecast_has_dashes():
    cars = make_car_records(make_rides(), [], LABELS)
    console = Console(file=io.StringIO(), width=80)
    show_cars(console, cars, LABELS)
    assert console.file.getvalue().split("taxi-1")[1].split()[:7] == ["2", "20", "4.0", "10", "38", "–", "–"]


@pytest.mark.parametrize("has_workbench", [True, False])
def test_end_fits_80_columns_and_names_three_commands(has_workbench):
    paths = [Path("recordings") / name for name in ("shift.mcap", "autumn.mcap", "history.mcap")]
    commands = list_next_commands(*paths, has_workbench=has_workbench)
    _, verdict = write(make_rides(), make_shift(50.0, 45.0, 55.0, 48.0))
    console = Console(file=io.StringIO(), width=80)
    show_end(console, verdict, commands)
    text = console.file.getvalue()
    assert len(commands) == 3
    assert all(command in text for command, _ in commands)
    assert max(map(len, text.splitlines())) <= 80
    assert ("socast serve" in text) == has_workbench
