"""The pipeline returns distance, duration and energy of imported real drives as the cars measured them."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

from socast.core.batch import Lanes
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import CAUSES, Quality
from socast.core.columns import EARTH_RADIUS, KMH
from socast.core.effects import get_library
from socast.core.evaluate.paper.protocol import evaluate, select_recipes
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.import_drives import collect_drives, write_recording
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.drive import LONGEST_HOLD, Drive, make_messages
from tests.support.paths import ROOT

DATA = ROOT.parent / "shared" / "data"
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}"),
]

PERIOD = 3.0
AUTOBAHN = Settings(speed_limit=180 * KMH)
"""The BMW drove up to 152 km/h, above the limit of a taxi in town, and has no positions to replace rejected speeds."""


class Imported(NamedTuple):
    """Hold a data set before and after the pipeline."""

    drives: list[Drive]
    messages: list[Message]
    settings: Settings
    pipeline: Pipeline
    rides: pd.DataFrame
    windows: pd.DataFrame


FOLDERS = {"ved": ("ved_ev", Settings()), "bmw-i3": ("bmw_i3", AUTOBAHN), "twizy": ("rsk_twizy", Settings())}
"""Folder and settings of each data set."""


@cache
def import_data_set(name: str) -> Imported:
    """Import a data set and send it through the pipeline."""
    folder, settings = FOLDERS[name]
    drives = collect_drives([DATA / folder], DATA_SETS[name])
    sent = make_messages(drives, PERIOD)
    pipeline = Pipeline(settings=settings, also=list(get_library()))
    pipeline.push(sent)
    pipeline.finish()
    return Imported(drives, sent, settings, pipeline, pipeline.take_rides(), pipeline.take_windows())


def integrate_rows(drive: Drive) -> tuple[float, float]:
    """Return distance [km] and energy [kWh] of the rows of a drive, without gaps."""
    step = np.diff(drive.elapsed)
    step = np.where(step <= LONGEST_HOLD, step, 0.0)
    km = drive.rows["speed_kmh"][:-1] @ step / 3600
    if "battery_voltage_v" not in drive.rows:
        return km, np.nan
    return km, (drive.rows["battery_voltage_v"] * drive.rows["battery_current_a"])[:-1] @ step / 3.6e6


def find_longest_gap(drive: Drive) -> float:
    """Return the longest time between two rows of a drive. [s]"""
    return float(np.diff(drive.elapsed).max())


def is_cut(drive: Drive, settings: Settings) -> bool:
    """Return whether a silence within a drive ends its ride, so that it becomes two rides of one name."""
    return find_longest_gap(drive) > settings.gap_time


def join_truth(name: str) -> pd.DataFrame:
    """Return the ride table joined with distance, energy and duration of the rows of each drive that is one ride."""
    imported = import_data_set(name)
    truth = [
        (d.ride_id, *integrate_rows(d), d.elapsed[-1], find_longest_gap(d) > LONGEST_HOLD)
        for d in imported.drives
        if not is_cut(d, imported.settings)
    ]
    names = ["ride_id", "driven_km", "drawn_kwh", "driven_s", "has_gap"]
    uncut = imported.rides.drop_duplicates("ride_id", keep=False)
    return pd.DataFrame(truth, columns=names).merge(uncut, on="ride_id", validate="one_to_one")


def largest_error(table: pd.DataFrame, column: str, truth: str) -> tuple[float, str]:
    """Return the largest relative error of a column and the ride that has it."""
    error = (table[column] / table[truth] - 1).abs()
    print(f"{column}: median {error.median():.4%}, largest {error.max():.4%} of {len(error)}")
    return float(error.max()), str(table["ride_id"][error.idxmax()])


ALL = pytest.mark.parametrize("name", ["ved", "bmw-i3", "twizy"])


@ALL
def test_every_drive_becomes_a_ride_and_every_sample_is_counted(name):
    imported = import_data_set(name)
    quality = imported.pipeline.quality()
    sent = sum(message.key.endswith("/telemetry") for message in imported.messages)
    assert quality["received"]["telemetry"] == sent
    assert sum(quality["received"].values()) == len(imported.messages)
    assert not quality["undecodable"]
    assert not quality["unpredictable"]
    expected = [d.ride_id for d in imported.drives for _ in range(2 if is_cut(d, imported.settings) else 1)]
    assert sorted(imported.rides["ride_id"]) == sorted(expected)
    assert len(expected) - len(imported.drives) == (1 if name == "ved" else 0)
    assert quality["samples"]["duplicate"] == quality["samples"]["late"] == 0
    assert {cause: int(imported.rides[f"quality_{cause}"].sum()) for cause in CAUSES} == quality["samples"]
    assert imported.windows["duration_s"].sum() == pytest.approx(imported.rides["duration_s"].sum())


@ALL
def test_distance_agrees_with_wheels_within_two_per_cent(name):
    assert largest_error(join_truth(name), "distance_km", "driven_km") < (0.02, "")


@ALL
def test_duration_agrees_with_drive(name):
    table = join_truth(name)
    assert (table["duration_s"] - table["driven_s"]).abs().max() < PERIOD


def test_bmw_energy_agrees_with_ten_hertz_rows_within_one_per_cent():
    table = join_truth("bmw-i3")
    trusted = table[~table["ride_id"].isin(["TripB02", "TripB13"])]
    assert len(trusted) == 29
    assert largest_error(trusted, "energy_vi_kwh", "drawn_kwh") < (0.01, "")


def test_ved_energy_agrees_with_rows_within_one_per_cent():
    table = join_truth("ved")
    whole = table[~table["has_gap"]]
    assert len(whole) == 134
    assert largest_error(whole, "energy_vi_kwh", "drawn_kwh") < (0.01, "")


@ALL
def test_messages_keep_distance_and_energy_within_one_per_mille(name):
    imported = import_data_set(name)
    batch, _ = Decoder(Lanes()).decode(imported.messages)
    ride = np.asarray(batch.ride)
    order = list(dict.fromkeys(ride.tolist()))
    for code, drive in zip(order, imported.drives, strict=True):
        if np.diff(drive.elapsed).max() > LONGEST_HOLD:
            continue
        rows = ride == code
        km, kwh = integrate_rows(drive)
        assert np.trapezoid(batch.speed[rows], batch.stamp[rows]) / 1000 == pytest.approx(km, rel=1e-3)
        if not np.isnan(kwh):
            power = (batch.voltage * batch.current)[rows]
            assert np.trapezoid(power, batch.stamp[rows]) / 3.6e6 == pytest.approx(kwh, rel=1e-3)


@ALL
def test_position_jumps_do_not_become_speed(name):
    imported = import_data_set(name)
    lanes = Lanes()
    batch, _ = Decoder(lanes).decode(imported.messages)
    clean = Cleaner(imported.settings).clean(batch, len(lanes))
    unbridged = (clean.quality & Quality.BRIDGED) == 0
    assert clean.speed[unbridged].max() <= batch.speed.max() + 0.01 * KMH
    assert clean.speed.max() <= imported.settings.speed_limit + 1e-9
    assert np.abs(clean.acceleration).max() < 8.0


def test_twizy_position_jumps_are_flagged():
    imported = import_data_set("twizy")
    lanes = Lanes()
    batch, _ = Decoder(lanes).decode(imported.messages)
    clean = Cleaner(imported.settings).clean(batch, len(lanes))
    north = np.diff(batch.latitude) * EARTH_RADIUS
    east = np.diff(batch.longitude) * EARTH_RADIUS * np.cos(batch.latitude[1:])
    farthest = imported.settings.speed_limit * PERIOD + 55.0  # positions may be off by 50 m, and the clock by a little
    jumps = (np.diff(batch.ride) == 0) & (np.hypot(north, east) > farthest)
    assert jumps.sum() > 400
    assert np.all(clean.quality[1:][jumps] & Quality.POSITION_JUMP)


def test_twizy_rides_get_the_weather_of_their_station():
    rides = import_data_set("twizy").rides.set_index("ride_id")
    assert rides["ambient_c"].between(17, 28).all()
    assert (rides["quality_ambient_assumed"] == 0).all()
    assert rides.loc["T3_04_26_2021_1", "wind_speed_kmh"] == pytest.approx(6.17 * 3.6)


def test_cold_drives_of_the_leaf_use_more_energy_per_km():
    table = join_truth("ved")
    rate = table["energy_vi_kwh"] / table["distance_km"]
    cold, mild = (rate[part].median() for part in (table["ambient_c"] < -5, table["ambient_c"] > 10))
    assert cold > 1.5 * mild > 0.15
    assert table["hvac_kwh"].notna().all()


def test_bmw_energy_agrees_with_state_of_charge():
    table = join_truth("bmw-i3").set_index("ride_id").drop(["TripB02", "TripB13"])
    per_cent = table["soc_start_pct"] - table["soc_end_pct"]
    capacity = table["energy_vi_kwh"] / per_cent * 100
    assert capacity.median() == pytest.approx(22.75, abs=0.8)
    assert capacity.between(20.5, 25).all()


@ALL
def test_recording_gives_the_same_rides_as_messages_in_memory(name, tmp_path):
    imported = import_data_set(name)
    write_recording(imported.drives, tmp_path / "a.mcap", PERIOD)
    write_recording(imported.drives, tmp_path / "b.mcap", PERIOD)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    replayed = Pipeline(settings=imported.settings, also=list(get_library()))
    for block in McapSource(tmp_path / "a.mcap"):
        replayed.push(block)
    replayed.finish()
    pd.testing.assert_frame_equal(replayed.take_rides(), imported.rides)


def evaluate_by_date(name: str, recipes: str) -> dict[str, float]:
    """Return the mean error of each recipe on the last fifth of the dates. [kWh]"""
    result = evaluate(import_data_set(name).rides, select_recipes(recipes, None, 0), repeats=2)
    return {recipe: next(iter(errors.values())) for recipe, errors in result.splits["date"].items()}


def test_fitted_models_predict_the_leaf_better_than_physics():
    error = evaluate_by_date("ved", "basic_physical,extended_physical,fitted_physical,hybrid,boosted_hybrid")
    assert set(error) >= {"extended_physical", "fitted_physical", "hybrid", "boosted_hybrid"}
    assert all(value < 0.6 * error["basic_physical"] for name, value in error.items() if name != "basic_physical")


def test_fitted_models_predict_the_i3_better_than_physics():
    error = evaluate_by_date("bmw-i3", "basic_physical,extended_physical,fitted_physical")
    assert error["extended_physical"] < 0.5 * error["basic_physical"]
    assert error["fitted_physical"] < 0.5 * error["basic_physical"]


@ALL
def test_no_drive_is_unfit_for_its_speed(name):
    assert (
        not import_data_set(name)
        .rides["unfit_reason"]
        .isin(["speed_rejected", "speed_missing", "distance_bridged"])
        .any()
    )


def test_drive_with_a_silence_of_eleven_minutes_is_two_rides_that_use_no_energy_in_between():
    imported = import_data_set("ved")
    (drive,) = (d for d in imported.drives if is_cut(d, imported.settings))
    parts = imported.rides[imported.rides["ride_id"] == drive.ride_id]
    km, kwh = integrate_rows(drive)
    assert parts["distance_km"].sum() == pytest.approx(km, rel=0.02)
    assert parts["energy_vi_kwh"].sum() == pytest.approx(kwh, rel=0.02)
