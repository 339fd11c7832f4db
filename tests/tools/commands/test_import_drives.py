"""`socast import` converts one or several files, and reports each error in one line."""

import gzip
import json
from itertools import pairwise, permutations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from socast.core.batch import Lanes
from socast.core.errors import ImportFileError, SettingsError
from socast.core.wire.decoder import Decoder
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.import_drives import collect_drives
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.drive import make_messages
from tests.support.published_files import (
    BMW_HEADER,
    TWIZY_HEADER,
    bmw_file,
    overview,
    run_import,
    twizy_file,
    ved_file,
    ved_row,
    write_good_file,
)

NAMES = ("ved", "bmw-i3", "twizy")


def import_failure(*arguments):
    """Return the one line of the error that a command raises."""
    result = run_import(*arguments)
    assert isinstance(result.exception, ImportFileError), (result.output, result.exception)
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.mark.parametrize(("name", "other"), [*permutations(NAMES, 2)])
def test_error_names_the_importer_of_the_file(tmp_path, name, other):
    path = write_good_file(tmp_path, other)
    overview(tmp_path)
    error = import_failure(name, path, "--out", tmp_path / "x.mcap")
    assert error.startswith(f"{path}: has no column '")
    assert f"`socast import {other}`" in error
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    ("name", "column"),
    [("ved", "HV Battery Current[A]"), ("bmw-i3", "Battery Voltage [V]"), ("twizy", "Time"), ("twizy", "LAT")],
)
def test_error_names_a_missing_column(tmp_path, name, column):
    path = write_good_file(tmp_path, name)
    path.write_bytes(path.read_bytes().replace(column.encode(), b"Lunch", 1))
    error = import_failure(name, path, "--out", tmp_path / "x.mcap")
    assert f"{path}: has no column '{column}'" in error
    assert "use `socast" not in error


@pytest.mark.parametrize(
    ("name", "column", "line"),
    [("ved", "Vehicle Speed[km/h]", 5), ("bmw-i3", "Velocity [km/h]", 3), ("twizy", "Soc", 9)],
)
def test_error_gives_column_and_line_of_text_in_place_of_a_number(tmp_path, name, column, line):
    path = write_good_file(tmp_path, name)
    separator = ";" if name == "bmw-i3" else ","
    lines = path.read_bytes().decode("latin-1").split("\n")
    place = lines[0].split(separator).index(column)
    cells = lines[line - 1].split(separator)
    cells[place] = "fast"
    lines[line - 1] = separator.join(cells)
    path.write_bytes("\n".join(lines).encode("latin-1"))
    assert f"column '{column}' holds 'fast' in line {line}" in import_failure(name, path, "--out", tmp_path / "x.mcap")


def write_broken_files(folder, good):
    """Write one file of every kind that is not a table; return the words that each error must hold."""
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
        "ragged.csv": "cells, the header",
        "nowhere.csv": "does not exist",
    }


@pytest.mark.parametrize("name", NAMES)
def test_broken_files_give_errors_of_one_line(tmp_path, name):
    for name_of_file, words in write_broken_files(tmp_path, write_good_file(tmp_path, name)).items():
        error = import_failure(name, tmp_path / name_of_file, "--out", tmp_path / "x.mcap")
        assert str(tmp_path / name_of_file) in error
        assert words in error, error


def test_folder_without_tables_is_rejected(tmp_path):
    (tmp_path / "LICENSE").write_text("free")
    assert "holds no .csv" in import_failure("ved", tmp_path, "--out", tmp_path / "x.mcap")


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_garbage_raises_import_file_errors_only(tmp_path_factory, garbage):
    folder = tmp_path_factory.mktemp("garbage")
    path = folder / "TripA01.csv"
    overview(folder)
    for head in (b"", TWIZY_HEADER.encode() + b"\n", BMW_HEADER.encode("latin-1") + b"\n", b"\x1f\x8b"):
        path.write_bytes(head + garbage)
        for data_set in DATA_SETS.values():
            with pytest.raises(ImportFileError):
                data_set.read_drives(path, data_set.defaults)


def test_recording_says_which_data_set_and_settings_made_it(tmp_path):
    result = run_import("ved", write_good_file(tmp_path, "ved"), "--out", tmp_path / "x.mcap", "--period", 1)
    assert result.exit_code == 0, result.output
    about = McapSource(tmp_path / "x.mcap").metadata
    assert about["command"] == "import"
    assert json.loads(about["settings"]) == {"data_set": "ved", "period": 1.0}


@pytest.mark.parametrize(
    ("row", "column"),
    [
        (ved_row(1e15), "Timestamp(ms)"),
        (ved_row(0, day=1e12), "DayNum"),
        (ved_row(0, day=-3), "DayNum"),
    ],
)
def test_error_names_the_column_of_a_time_out_of_bounds(tmp_path, row, column):
    path = ved_file(tmp_path / "week.csv", [row, ved_row(0, day=row.split(",")[0])])
    assert f"column '{column}'" in import_failure("ved", path, "--out", tmp_path / "x.mcap")


def test_bmw_files_without_a_date_in_the_overview_are_rejected(tmp_path):
    path = bmw_file(tmp_path / "TripA01.csv")
    out = ("--out", tmp_path / "x.mcap")
    assert "Overview.xlsx: is missing" in import_failure("bmw-i3", path, *out)
    (tmp_path / "Overview.xlsx").write_bytes(b"no zip")
    assert "Overview.xlsx: is not an Excel workbook" in import_failure("bmw-i3", path, *out)
    overview(tmp_path, header=["Trip", "Day"])
    assert "no column 'Date'" in import_failure("bmw-i3", path, *out)
    overview(tmp_path, rows=[("TripA02", "2019-06-25_13-21-14")])
    assert "no trip 'TripA01' in its column 'Trip'" in import_failure("bmw-i3", path, *out)
    for nonsense in ("yesterday", "2019-13-25_13-21-14", None):
        overview(tmp_path, rows=[("TripA01", nonsense)])
        assert "column 'Date' of Overview.xlsx" in import_failure("bmw-i3", path, *out)


def test_file_without_any_readable_date_or_time_is_rejected(tmp_path):
    path = twizy_file(tmp_path / "T3.csv", garbled=range(61))
    assert "column 'Date' holds '90/02/2032'" in import_failure("twizy", path, "--out", tmp_path / "x.mcap")
    path.write_text(twizy_file(path).read_text().replace(",08:", ",8 o'clock "))
    assert "column 'Time' holds" in import_failure("twizy", path, "--out", tmp_path / "x.mcap")


def test_selecting_an_absent_car_is_an_error(tmp_path):
    path = ved_file(tmp_path / "week.csv")
    assert "VehId 7 " in import_failure("ved", path, "--vehicle", 7, "--out", tmp_path / "x.mcap")
    ved_file(path, [ved_row(0, engine=900), ved_row(1000, engine=900)])
    assert "no electric car" in import_failure("ved", path, "--out", tmp_path / "x.mcap")


def test_unknown_time_zone_is_an_error(tmp_path):
    result = run_import("ved", ved_file(tmp_path / "w.csv"), "--out", tmp_path / "x.mcap", "--time-zone", "Mars/North")
    assert isinstance(result.exception, SettingsError)
    assert "Mars/North" in str(result.exception)


def test_vehicle_option_is_rejected_for_data_sets_of_one_car(tmp_path):
    result = run_import("twizy", write_good_file(tmp_path, "twizy"), "--vehicle", 7, "--out", tmp_path / "x.mcap")
    assert isinstance(result.exception, SettingsError)
    assert "leave --vehicle out" in str(result.exception)


def test_unknown_data_set_is_an_error(tmp_path):
    result = run_import("lunch", tmp_path, "--out", tmp_path / "x.mcap")
    assert isinstance(result.exception, SettingsError)
    assert "choose from csv, parquet, ved, bmw-i3, twizy" in str(result.exception)


def test_ride_in_two_files_is_an_error(tmp_path):
    path = ved_file(tmp_path / "week.csv")
    (tmp_path / "week.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert "ved-455-1, as" in import_failure("ved", tmp_path, "--out", tmp_path / "x.mcap")


def test_skip_bad_skips_counts_and_names_bad_files(tmp_path):
    good = write_good_file(tmp_path, "twizy")
    bad = write_broken_files(tmp_path, good)
    del bad["nowhere.csv"]
    out = tmp_path / "x.mcap"
    import_failure("twizy", tmp_path, "--out", out)
    result = run_import("twizy", tmp_path, "--skip-bad", "--out", out)
    assert result.exit_code == 0, result.exception
    assert all(name in result.output for name in bad)
    assert f"skipped {len(bad)} of {len(bad) + 1} files" in result.output
    alone = tmp_path / "alone.mcap"
    run_import("twizy", good, "--out", alone)
    assert out.read_bytes() == alone.read_bytes()


def test_skip_bad_with_bad_files_only_is_an_error(tmp_path):
    (tmp_path / "a.csv").write_text("")
    assert "none of the 1 files" in import_failure("ved", tmp_path, "--skip-bad", "--out", tmp_path / "x.mcap")


@pytest.mark.parametrize("name", NAMES)
def test_plain_and_gzipped_files_give_identical_recordings(tmp_path, name):
    folder = tmp_path / "gz"
    folder.mkdir()
    path = write_good_file(tmp_path, name)
    (folder / f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
    overview(folder)
    results = [run_import(name, source, "--out", tmp_path / f"{i}.mcap") for i, source in enumerate((path, folder))]
    assert [result.exit_code for result in results] == [0, 0], results
    assert (tmp_path / "0.mcap").read_bytes() == (tmp_path / "1.mcap").read_bytes()


def test_recording_is_in_order_of_time_whatever_the_order_of_files(tmp_path):
    paths = [ved_file(tmp_path / f"{i}.csv", [ved_row(ms, trip=i, day=9 - i) for ms in (0, 30_000)]) for i in range(4)]
    one, two = (make_messages(collect_drives(order, DATA_SETS["ved"]), 3.0) for order in (paths, [*reversed(paths)]))
    assert one == two
    assert all(a.receipt_ns <= b.receipt_ns for a, b in pairwise(one))


@pytest.mark.parametrize("name", NAMES)
def test_recording_decodes_completely(tmp_path, name):
    out = tmp_path / "x.mcap"
    assert run_import(name, write_good_file(tmp_path, name), "--out", out).exit_code == 0
    recorded = [message for block in McapSource(out) for message in block]
    decoder = Decoder(Lanes())
    batch, events = decoder.decode(recorded)
    assert not decoder.rejected
    assert batch.size == 21
    assert batch.size + len(events) == len(recorded)


@pytest.mark.parametrize("period", [1.0, 5.0])
def test_period_sets_the_number_of_samples(tmp_path, period):
    path = write_good_file(tmp_path, "twizy")
    out = tmp_path / "x.mcap"
    run_import("twizy", path, "--out", out, "--period", period)
    sent = [m for block in McapSource(out) for m in block if m.key.endswith("telemetry")]
    assert len(sent) == 60 / period + 1
