"""Test the whole kernel: ranges, missing values, energy, and independence from batches, other cars and old code."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.batch import Batch, Lanes
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.columns import TELEMETRY
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from tests.support.paths import ROOT
from tests.support.telemetry import PERIOD, cleaned, count, decoded, drive, picked, telemetry, without

N = 120

WILD = {
    "latitude_deg": 91.0,
    "longitude_deg": -1e308,
    "elevation_m": -32768.0,
    "speed_kmh": -1.0,
    "odometer_km": 1e300,
    "soc_pct": 127.5,
    "battery_voltage_v": 6553.5,
    "battery_current_a": -3276.8,
    "battery_temperature_c": -273.1,
    "ambient_c": 200.0,
    "hvac_w": -1.0,
    "occupants": 1000,
}


def full(n=N, seed=1):
    """Return a drive of a car that sends every field."""
    return without(drive(n, seed=seed), "metres") | {
        "elevation_m": np.full(n, 40.0),
        "odometer_km": 1000 + 0.01 * np.arange(n).round(1),
        "soc_pct": 90 - 0.01 * np.arange(n),
        "battery_voltage_v": np.full(n, 360.0),
        "battery_current_a": 10.0 + np.arange(n),
        "battery_temperature_c": np.full(n, 12.0),
        "ambient_c": np.full(n, -4.0),
        "hvac_w": np.full(n, 900.0),
        "occupants": np.full(n, 2, dtype=object),
    }


@pytest.mark.parametrize("field", WILD)
def test_value_out_of_range_is_missing_and_counted(field):
    columns, missing = full(), full()
    columns[field][[20, 40, 60]] = WILD[field]
    missing[field][[20, 40, 60]] = np.nan
    wild, plain = (cleaned(table) for table in (columns, missing))
    assert np.flatnonzero(wild.quality & Quality.OUT_OF_RANGE).tolist() == [20, 40, 60]
    assert np.array_equal(wild.quality & ~Quality.OUT_OF_RANGE, plain.quality)
    for name, one, other in zip(Clean._fields, wild, plain, strict=True):
        assert name == "quality" or np.array_equal(one, other, equal_nan=True), name


def test_drive_without_faults_has_no_quality_bits():
    columns = full()
    columns["speed_kmh"][:] = 36.0
    columns["latitude_deg"] = columns["latitude_deg"][0] + 0.00027 * np.arange(N)
    assert np.all(cleaned(columns).quality == 0)


MISSING = {
    "speed_kmh": Quality.SPEED_MISSING,
    "latitude_deg": Quality.POSITION_MISSING,
    "soc_pct": Quality.SOC_MISSING,
    "battery_voltage_v": Quality.POWER_MISSING,
    "battery_current_a": Quality.POWER_MISSING,
}


@pytest.mark.parametrize("field", MISSING)
def test_missing_value_is_flagged_if_the_car_sent_it_before(field):
    columns = full()
    columns[field][:10] = np.nan  # not sent yet
    columns[field][30:35] = np.nan
    bits = cleaned(columns).quality & MISSING[field]
    assert np.flatnonzero(bits).tolist() == [30, 31, 32, 33, 34]
    assert count(cleaned(without(columns, field)), MISSING[field]) == 0


@given(st.integers(0, 2**32 - 1))
def test_cleaned_values_lie_in_range_for_any_input(seed):
    rng = np.random.default_rng(seed)
    columns = rng.choice(
        [0.0, 1.0, -1.0, 1e3, 1e9, 1e308, -1e308, np.nan, np.inf, -np.inf, 0.5], (len(Batch._fields), 60)
    )
    columns[:2] = 0
    clean = Cleaner(Settings()).clean(Batch(columns[0].astype(int), columns[1].astype(int), *columns[2:]), 1)
    limits = {column.name: (column.low, column.high) for column in TELEMETRY}
    for name in ("soc", "ambient", "hvac", "occupants", "battery_temperature", "odometer", "latitude", "longitude"):
        values = getattr(clean, name)
        values = values[~np.isnan(values)]
        assert np.all((values >= limits[name][0]) & (values <= limits[name][1])), name
    for name in ("dt", "travel", "distance", "speed", "acceleration", "climb", "energy", "metered", "turn_rate"):
        assert np.all(np.isfinite(getattr(clean, name))), name
    assert clean.speed.max() <= Settings().speed_limit


def test_energy_is_the_trapezoidal_integral_of_power():
    columns = full()
    power = columns["battery_voltage_v"] * columns["battery_current_a"]
    clean = cleaned(columns)
    assert clean.energy.sum() == pytest.approx(np.trapezoid(power) * PERIOD)
    assert clean.metered.sum() == PERIOD * (N - 1)


def test_energy_is_interpolated_over_short_holes_only():
    columns = full()
    power = columns["battery_voltage_v"] * columns["battery_current_a"]
    short = np.r_[0:50, 55:N]
    clean = cleaned(picked(columns, short))
    assert clean.energy.sum() == pytest.approx(np.trapezoid(power) * PERIOD)
    long = np.r_[0:50, 80:N]
    clean = cleaned(picked(columns, long))
    whole = (np.trapezoid(power[:50]) + np.trapezoid(power[80:])) * PERIOD
    assert clean.energy.sum() == pytest.approx(whole)
    assert clean.metered.sum() == PERIOD * (49 + N - 81)


def test_samples_without_power_add_no_metered_time():
    columns = full()
    columns["battery_current_a"][50:60] = np.nan
    clean = cleaned(columns)
    assert clean.metered.sum() == PERIOD * (N - 1 - 10)
    assert np.all(clean.energy[50:60] == 0)


def test_quantum_of_soc_is_its_smallest_change():
    columns = full()
    columns["soc_pct"] = 90 - 0.5 * np.floor(np.arange(N) / 10)
    columns["soc_pct"][60] -= 0.25
    clean = cleaned(columns)
    assert np.isnan(clean.soc_step[5])
    assert clean.soc_step[20] == pytest.approx(0.005)
    assert clean.soc_step[-1] == pytest.approx(0.0025)


def test_soc_from_before_a_ride_is_not_used_for_it():
    columns = full()
    columns["ride_id"] = np.array(["A"] * 40 + ["B"] * 80, dtype=object)
    columns["soc_pct"][35:] = np.nan
    clean = cleaned(columns)
    assert clean.soc[39] == pytest.approx(0.8966)
    assert np.all(np.isnan(clean.soc[65:]))


def two_shifts(n=N):
    """Return two shifts of a car that names no rides; it was charged and moved in the night between them."""
    columns = drive(2 * n, speed=np.where(np.abs(np.arange(2 * n) - n) < 6, 0.0, 10.0))
    columns["soc_pct"] = np.r_[np.linspace(40, 30, n), np.linspace(95, 85, n)]
    columns["odometer_km"] = 1000 + columns["metres"] / 1000
    columns["time_s"][n:] += 8 * 3600.0
    columns["latitude_deg"][n:] += 0.02
    columns["odometer_km"][n:] += 2.3
    return without(columns, "ride_id", "metres")


def test_start_of_a_shift_changes_nothing_at_the_end_of_the_previous_shift():
    columns = two_shifts()
    clean = cleaned(without(columns, "seq"))
    old = clean.time < columns["time_s"][N]
    assert np.flatnonzero(old).tolist() == list(range(N + 1))  # the first sample of the new shift was not used
    assert clean.soc[old].min() == clean.soc[N] == pytest.approx(0.3)
    assert clean.soc[old].max() <= 0.4
    assert np.all(clean.soc[~old] > 0.84)
    assert clean.latitude[N] == clean.latitude[N - 1]
    assert np.all(clean.ride[old] == 0)
    assert np.all(clean.ride[~old] != 0)
    assert clean.distance[N] == 0


def test_night_without_counter_equals_night_with_restarted_counter():
    columns = two_shifts()
    columns["seq"][N:] = np.arange(N)
    known, alone = cleaned(columns), cleaned(without(columns, "seq"))
    used = np.arange(2 * N) != N
    assert known.time[N] == columns["time_s"][N]
    assert np.array_equal(known.soc[used], alone.soc[used])
    assert np.array_equal(known.ride[used], alone.ride[used])
    assert alone.time[used] == pytest.approx(known.time[used], abs=1e-3)
    assert alone.dt.sum() == pytest.approx(known.dt.sum(), abs=1e-3)
    assert alone.parked[-1] == pytest.approx(known.parked[-1], abs=1e-3)
    assert alone.distance.sum() == pytest.approx(known.distance.sum(), abs=1.0)
    assert known.distance.sum() > known.distance[:N].sum() + 2300.0


def test_detection_of_stops_has_hysteresis():
    columns = without(full(), "latitude_deg", "longitude_deg")
    speed = np.full(N, 10.0)
    speed[29] = 5.0
    speed[30:60] = 0.0
    speed[40:50] = 1.0  # creeps below the threshold of motion
    columns["speed_kmh"] = speed * 3.6
    clean = cleaned(columns)
    assert clean.stop.sum() == 1
    assert np.flatnonzero(clean.stopped).tolist() == list(range(30, 60))


def fleet(seed, cars=3, n=60):
    """Return the rows of several faulty cars, mixed."""
    rng = np.random.default_rng(seed)
    parts = []
    for car in range(cars):
        columns = full(n, seed=car)
        columns["time_s"] = columns["time_s"] + rng.normal(0, 0.8, n)
        for name in ("speed_kmh", "latitude_deg", "soc_pct"):
            columns[name][rng.random(n) < 0.1] = rng.choice([np.nan, 1500.0, 0.0])
        columns = picked(columns, np.repeat(np.arange(n), rng.choice([0, 1, 2], n, p=[0.1, 0.8, 0.1])))
        parts.append(telemetry(columns if car % 2 else without(columns, "seq", "ride_id"), f"car{car}"))
    places = np.concatenate([rng.uniform(0, 1, len(part)) for part in parts])
    owners = np.repeat(np.arange(cars), [len(part) for part in parts])
    order = owners[np.argsort(places)]
    streams = [iter(part) for part in parts]
    return [next(streams[owner]) for owner in order], parts


@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, 200), max_size=8))
def test_any_chunking_gives_the_same_bits(seed, cuts):
    batch = decoded(fleet(seed)[0])
    whole = Cleaner(Settings()).clean(batch, 3)
    edges = sorted({0, batch.size, *(min(cut, batch.size) for cut in cuts)})
    cleaner = Cleaner(Settings())
    parts = [cleaner.clean(batch.rows(a, b), 3) for a, b in pairwise(edges)]
    for i, column in enumerate(whole):
        assert np.array_equal(column, np.concatenate([part[i] for part in parts]), equal_nan=True), Clean._fields[i]


@given(seed=st.integers(0, 1000))
def test_other_vehicles_do_not_change_the_samples_of_a_vehicle(seed):
    mixed, parts = fleet(seed)
    lanes = Lanes()
    batch, _ = Decoder(lanes).decode(mixed)
    together = Cleaner(Settings()).clean(batch, 3)
    for car, part in enumerate(parts):
        mine = together.lane == lanes.lane(f"car{car}")
        alone = Cleaner(Settings()).clean(decoded(part), 1)
        for name, one, other in zip(Clean._fields, together, alone, strict=True):
            if name not in ("lane", "code"):
                assert np.array_equal(one[mine], other, equal_nan=True), name


def test_input_arrays_are_never_modified():
    batch = decoded(fleet(3)[0])
    before = [column.copy() for column in batch]
    for column in batch:
        column.flags.writeable = False
    Cleaner(Settings()).clean(batch, 3)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(batch, before, strict=True))


def test_new_lane_does_not_change_the_other_lanes():
    first, second = telemetry(full(), "a"), telemetry(full(seed=2), "b")
    lanes, cleaner = Lanes(), Cleaner(Settings())
    decoder = Decoder(lanes)
    out = []
    for messages in (first[:60], second, first[60:]):
        batch, _ = decoder.decode(messages)
        out.append(cleaner.clean(batch, len(lanes)))
    whole = cleaned(full())
    for name, a, b, c in zip(Clean._fields, out[0], out[2], whole, strict=True):
        assert np.array_equal(np.concatenate([a, b]), c, equal_nan=True), name


def test_empty_batch_changes_nothing():
    clean = Cleaner(Settings()).clean(decoded([]), 0)
    assert all(len(column) == 0 for column in clean)


def test_kernel_is_recompiled_when_one_of_its_modules_changes(tmp_path):
    """Numba itself checks only the file of the kernel, not the files that it imports."""
    Cleaner(Settings()).clean(decoded(telemetry(full())), 1)  # compiled at the latest now
    source = ROOT / "core"
    core = tmp_path / "socast" / "core"
    core.mkdir(parents=True)
    (core.parent / "__init__.py").touch()
    for file in [*source.glob("*.py"), *source.glob("cleaning/*.py"), *source.glob("cleaning/__pycache__/*.nb?")]:
        copy = core / file.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(file.read_bytes())
    print_cached = (
        "from socast.core.cleaning import kernel;"
        "print(kernel.__file__, kernel.clean_rows._cache._cache_file._load_index() != {});"
    )
    compile_it = (
        "from socast.core.settings import Settings; from socast.core.batch import Batch; import numpy as np;"
        "z = np.zeros(2, np.int64); f = [np.full(2, np.nan) for _ in Batch._fields[2:]]; f[0] = 1.7e9 + np.arange(2);"
        "kernel.Cleaner(Settings()).clean(Batch(z, z, *f), 1)"
    )

    def is_cached(*, then=""):
        command = [sys.executable, "-c", print_cached + then]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        file, answer = done.stdout.split()
        assert Path(file).parent == core / "cleaning"
        return answer == "True"

    is_cached(then=compile_it)
    assert is_cached()
    part = core / "cleaning" / "segmentation.py"
    part.write_text(part.read_text().replace("PARKED_FACTOR: Final = 4.0", "PARKED_FACTOR: Final = 5.0"))
    assert not is_cached()
