"""Test that logs with 1 to 60 s between rows, mixed periods, and values sent only on change give the same drive."""

import re

import numpy as np
import pandas as pd
import pytest

from tests.support.commands import called
from tests.support.own_tables import make_drive

DRIVE = make_drive(rows=7200, step=1.0)
DISTANCE_KM = DRIVE["distance"][-1] / 1000
KWH_PER_KM = np.trapezoid(DRIVE["power"], DRIVE["time"]) / 3.6e6 / DISTANCE_KM
FRAME = pd.DataFrame(
    {
        "time": DRIVE["time"],
        "speed_kmh": (DRIVE["speed"] * 3.6).round(1),
        "power_kw": (DRIVE["power"] / 1000).round(2),
        "soc": DRIVE["soc"].round(1),
    }
)


def keep_changes(frame):
    """Return rows that hold only what changed since the row before, with small steps left out."""
    coarse = frame.assign(speed_kmh=(frame["speed_kmh"] / 2).round() * 2, power_kw=frame["power_kw"].round())
    kept = coarse.where(coarse.diff() != 0)
    return kept.assign(time=frame["time"]).dropna(subset=["speed_kmh", "power_kw", "soc"], how="all")


def split_signals(frame):
    """Return rows that hold one signal each, a few tenths of a second apart."""
    parts = [
        frame[["time", name]].assign(time=frame["time"] + 0.3 * place)
        for place, name in enumerate(("speed_kmh", "power_kw", "soc"))
    ]
    return pd.concat(parts).sort_values("time")


def mix_periods(frame):
    """Return rows 1 s apart at first, then 5, 20 and 60 s apart."""
    parts = [frame.iloc[k * 1800 : (k + 1) * 1800 : step] for k, step in enumerate((1, 5, 20, 60))]
    return pd.concat(parts)


LOGS = {
    "1 s": (FRAME, 0.01),
    "10 s": (FRAME.iloc[::10], 0.01),
    "60 s": (FRAME.iloc[::60], 0.05),
    "mixed": (mix_periods(FRAME), 0.03),
    "on change": (keep_changes(FRAME), 0.02),
    "one signal per row": (split_signals(FRAME), 0.02),
    "one signal per row, every 10 s": (split_signals(FRAME.iloc[::10]), 0.03),
}


@pytest.mark.parametrize("name", LOGS)
def test_sparse_log_gives_the_distance_and_energy_of_the_drive(tmp_path, name):
    rows, tolerance = LOGS[name]
    file = tmp_path / "log.csv"
    rows.to_csv(file, index=False)
    printed, errors, code = called("import", "csv", file, "--guess", "-o", tmp_path / "log.mcap")
    assert code == 0, errors
    used, distance = map(float, re.findall(r"energy per km: ([\d.]+) kWh/km over ([\d.]+) km", printed)[0])
    assert distance == pytest.approx(DISTANCE_KM, rel=tolerance)
    assert used == pytest.approx(KWH_PER_KM, rel=2 * tolerance)
    carries_part = name.startswith(("on", "one"))
    assert ("hold the other" in " ".join(printed.split())) == carries_part


@pytest.mark.parametrize("period", [2, 15])
def test_period_joins_rows_and_keeps_the_energy(tmp_path, period):
    file = tmp_path / "log.csv"
    FRAME.to_csv(file, index=False)
    words = ("import", "csv", file, "--guess", "--period", period, "-o", tmp_path / "log.mcap")
    printed, errors, code = called(*words)
    assert code == 0, errors
    (samples,) = re.findall(r": ([\d,]+) samples", printed)
    assert int(samples.replace(",", "")) == pytest.approx(len(FRAME) / period, abs=2)
    used, distance = map(float, re.findall(r"energy per km: ([\d.]+) kWh/km over ([\d.]+) km", printed)[0])
    assert (used, distance) == pytest.approx((KWH_PER_KM, DISTANCE_KM), rel=0.02)
