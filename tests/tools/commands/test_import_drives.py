"""`socast import`: what is wrong with a file in one line, and several files at a time."""

import gzip
from itertools import pairwise, permutations
from zoneinfo import ZoneInfo

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from typer.testing import CliRunner

from core.batch import Lanes
from core.errors import ImportFileError, SettingsError
from core.wire.decoder import Decoder
from stream.mcap_reader import McapSource
from tests.support.published_files import (
    BMW_HEADER,
    TWIZY_HEADER,
    bmw_file,
    made,
    overview,
    twizy_file,
    ved_file,
    ved_row,
)
from tools.commands.import_drives import app, collect
from tools.importers import bmw_i3, twizy, ved
from tools.importers.drive import messages

UTC_ZONE, BERLIN, CASABLANCA = ZoneInfo("UTC"), ZoneInfo("Europe/Berlin"), ZoneInfo("Africa/Casablanca")
run = CliRunner().invoke

NAMES = ("ved", "bmw-i3", "twizy")


def failure(*arguments):
    """Return the one line of the error that a command raises."""
    result = run(app, [str(argument) for argument in arguments])
    assert isinstance(result.exception, ImportFileError), (result.output, result.exception)
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.mark.parametrize(("name", "other"), [*permutations(NAMES, 2)])
def test_the_importer_that_fits_is_named(tmp_path, name, other):
    path = made(tmp_path, other)
    overview(tmp_path)
    error = failure(name, path, "--out", tmp_path / "x.mcap")
    assert error.startswith(f"{path}: has no column '")
    assert f"`socast import {other}`" in error
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    ("name", "column"),
    [("ved", "HV Battery Current[A]"), ("bmw-i3", "Battery Voltage [V]"), ("twizy", "Time"), ("twizy", "LAT")],
)
def test_a_missing_column_is_named(tmp_path, name, column):
    path = made(tmp_path, name)
    path.write_bytes(path.read_bytes().replace(column.encode(), b"Lunch", 1))
    error = failure(name, path, "--out", tmp_path / "x.mcap")
    assert f"{path}: has no column '{column}'" in error
    assert "use `socast" not in error


@pytest.mark.parametrize(
    ("name", "column", "line"),
    [("ved", "Vehicle Speed[km/h]", 5), ("bmw-i3", "Velocity [km/h]", 3), ("twizy", "Soc", 9)],
)
def test_text_in_place_of_a_number_is_located(tmp_path, name, column, line):
    path = made(tmp_path, name)
    separator = ";" if name == "bmw-i3" else ","
    lines = path.read_bytes().decode("latin-1").split("\n")
    place = lines[0].split(separator).index(column)
    cells = lines[line - 1].split(separator)
    cells[place] = "fast"
    lines[line - 1] = separator.join(cells)
    path.write_bytes("\n".join(lines).encode("latin-1"))
    assert f"column '{column}' holds 'fast' in line {line}" in failure(name, path, "--out", tmp_path / "x.mcap")


def wrecks(folder, good):
    """Write every kind of file that is no table, with a word that the error must hold."""
    (folder / "empty.csv").write_bytes(b"")
    (folder / "blank.csv").write_bytes(b"\n \n")
    (folder / "header.csv").write_bytes(good.read_bytes().split(b"\n")[0] + b"\n")
    (folder / "binary.csv").write_bytes(np.random.default_rng(1).bytes(5000))
    (folder / "cut.csv.gz").write_bytes(gzip.compress(good.read_bytes())[:-30])
    (folder / "false.csv.gz").write_bytes(b"\x1f\x8b" + bytes(range(200)))
    (folder / "prose.csv").write_text("Dear reader,\nthis is a letter; it has no columns.\n")
    (folder / "ragged.csv").write_bytes(good.read_bytes() + b"1,1,1;1;1\n")
    return {
        "empty.csv": "is empty",
        "blank.csv": "is empty",
        "header.csv": "no rows",
        "binary.csv": "not a table",
        "cut.csv.gz": "gzip",
        "false.csv.gz": "gzip",
        "prose.csv": "has no column",
        "ragged.csv": "is it whole?",
        "nowhere.csv": "does not exist",
    }


@pytest.mark.parametrize("name", NAMES)
def test_wrecks_are_one_line_each(tmp_path, name):
    for wreck, words in wrecks(tmp_path, made(tmp_path, name)).items():
        error = failure(name, tmp_path / wreck, "--out", tmp_path / "x.mcap")
        assert str(tmp_path / wreck) in error
        assert words in error, error


def test_a_folder_without_tables(tmp_path):
    (tmp_path / "LICENSE").write_text("free")
    assert "holds no .csv" in failure("ved", tmp_path, "--out", tmp_path / "x.mcap")


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_garbage_never_raises_anything_else(tmp_path_factory, garbage):
    folder = tmp_path_factory.mktemp("garbage")
    path = folder / "TripA01.csv"
    for head in (b"", TWIZY_HEADER.encode() + b"\n", BMW_HEADER.encode("latin-1") + b"\n", b"\x1f\x8b"):
        path.write_bytes(head + garbage)
        for reader in (
            lambda: ved.read_drives(path, UTC_ZONE),
            lambda: bmw_i3.read_drives(path, BERLIN, {"TripA01": "2019-06-25_13-21-14"}),
            lambda: twizy.read_drives(path, CASABLANCA),
        ):
            with pytest.raises(ImportFileError):
                reader()


@pytest.mark.parametrize(
    ("row", "column"),
    [
        (ved_row(1e15), "Timestamp(ms)"),
        (ved_row(0, day=1e12), "DayNum"),
        (ved_row(0, day=-3), "DayNum"),
    ],
)
def test_times_out_of_bounds_are_named(tmp_path, row, column):
    path = ved_file(tmp_path / "week.csv", [row, ved_row(0, day=row.split(",")[0])])
    assert f"column '{column}'" in failure("ved", path, "--out", tmp_path / "x.mcap")


def test_bmw_needs_its_overview_and_the_trip_in_it(tmp_path):
    path = bmw_file(tmp_path / "TripA01.csv")
    out = ("--out", tmp_path / "x.mcap")
    assert "Overview.xlsx: is missing" in failure("bmw-i3", path, *out)
    (tmp_path / "Overview.xlsx").write_bytes(b"no zip")
    assert "Overview.xlsx: is not an Excel workbook" in failure("bmw-i3", path, *out)
    with pytest.raises(ImportFileError, match="no column 'Date'"):
        overview(tmp_path, header=["Trip", "Day"])
    overview(tmp_path, rows=[("TripA02", "2019-06-25_13-21-14")])
    assert "no trip 'TripA01' in its column 'Trip'" in failure("bmw-i3", path, *out)
    for nonsense in ("yesterday", "2019-13-25_13-21-14", None):
        overview(tmp_path, rows=[("TripA01", nonsense)])
        assert "column 'Date' of Overview.xlsx" in failure("bmw-i3", path, *out)


def test_an_unreadable_date_or_time_throughout_is_named(tmp_path):
    path = twizy_file(tmp_path / "T3.csv", garbled=range(61))
    assert "column 'Date' holds '90/02/2032'" in failure("twizy", path, "--out", tmp_path / "x.mcap")
    path.write_text(twizy_file(path).read_text().replace(",08:", ",8 o'clock "))
    assert "column 'Time' holds" in failure("twizy", path, "--out", tmp_path / "x.mcap")


def test_a_car_that_is_not_there_is_an_error(tmp_path):
    path = ved_file(tmp_path / "week.csv")
    assert "VehId 7 " in failure("ved", path, "--vehicle", 7, "--out", tmp_path / "x.mcap")
    ved_file(path, [ved_row(0, engine=900), ved_row(1000, engine=900)])
    assert "no electric car" in failure("ved", path, "--out", tmp_path / "x.mcap")


def test_a_wrong_time_zone_is_an_error(tmp_path):
    result = run(
        app, ["ved", str(ved_file(tmp_path / "w.csv")), "--out", str(tmp_path / "x"), "--time-zone", "Mars/North"]
    )
    assert isinstance(result.exception, SettingsError)
    assert "Mars/North" in str(result.exception)


def test_a_ride_is_not_taken_twice(tmp_path):
    path = ved_file(tmp_path / "week.csv")
    (tmp_path / "week.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert "ved-455-1, as" in failure("ved", tmp_path, "--out", tmp_path / "x.mcap")


def test_bad_files_are_skipped_counted_and_named_on_request(tmp_path):
    good = made(tmp_path, "twizy")
    bad = wrecks(tmp_path, good)
    del bad["nowhere.csv"]
    out = tmp_path / "x.mcap"
    failure("twizy", tmp_path, "--out", out)
    result = run(app, ["twizy", str(tmp_path), "--skip-bad", "--out", str(out)])
    assert result.exit_code == 0, result.exception
    assert all(name in result.output for name in bad)
    assert f"skipped {len(bad)} of {len(bad) + 1} files" in result.output
    alone = tmp_path / "alone.mcap"
    run(app, ["twizy", str(good), "--out", str(alone)])
    assert out.read_bytes() == alone.read_bytes()


def test_only_bad_files_are_an_error_even_so(tmp_path):
    (tmp_path / "a.csv").write_text("")
    assert "none of the 1 files" in failure("ved", tmp_path, "--skip-bad", "--out", tmp_path / "x.mcap")


@pytest.mark.parametrize("name", NAMES)
def test_plain_and_gzipped_files_give_the_same_recording_to_the_byte(tmp_path, name):
    folder = tmp_path / "gz"
    folder.mkdir()
    path = made(tmp_path, name)
    (folder / f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
    overview(folder)
    results = [
        run(app, [name, str(source), "--out", str(tmp_path / f"{i}.mcap")]) for i, source in enumerate((path, folder))
    ]
    assert [result.exit_code for result in results] == [0, 0], results
    assert (tmp_path / "0.mcap").read_bytes() == (tmp_path / "1.mcap").read_bytes()


def test_the_order_of_the_files_does_not_matter_and_time_never_runs_back(tmp_path):
    paths = [ved_file(tmp_path / f"{i}.csv", [ved_row(ms, trip=i, day=9 - i) for ms in (0, 30_000)]) for i in range(4)]
    one, two = (
        messages(collect(order, lambda p: ved.read_drives(p, UTC_ZONE)), 3.0) for order in (paths, [*reversed(paths)])
    )
    assert one == two
    assert all(a.receipt_ns <= b.receipt_ns for a, b in pairwise(one))


@pytest.mark.parametrize("name", NAMES)
def test_the_recording_keeps_to_the_contract(tmp_path, name):
    out = tmp_path / "x.mcap"
    assert run(app, [name, str(made(tmp_path, name)), "--out", str(out)]).exit_code == 0
    recorded = [message for block in McapSource(out) for message in block]
    decoder = Decoder(Lanes())
    batch, events = decoder.decode(recorded)
    assert not decoder.rejected
    assert batch.size == 21
    assert batch.size + len(events) == len(recorded)


@pytest.mark.parametrize("period", [1.0, 5.0])
def test_another_period(tmp_path, period):
    path = made(tmp_path, "twizy")
    out = tmp_path / "x.mcap"
    run(app, ["twizy", str(path), "--out", str(out), "--period", str(period)])
    sent = [m for block in McapSource(out) for m in block if m.key.endswith("telemetry")]
    assert len(sent) == 60 / period + 1
