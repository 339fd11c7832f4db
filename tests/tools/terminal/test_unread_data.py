"""`socast import csv` says what it did not read, what is missing, and which files it skipped."""

import gzip

import pytest

from tests.support.commands import called

ROWS = "".join(f"2024-05-01T12:00:{second:02}Z,{second},5,7\n" for second in range(60))


def run(*arguments):
    """Return the standard output of an import that ends well."""
    printed, errors, code = called("import", "csv", *arguments)
    assert code == 0, errors
    return printed


def refused(*arguments):
    """Return the one line of the error of an import."""
    _, errors, code = called("import", "csv", *arguments)
    assert code != 0
    assert len(errors.splitlines()) == 1
    return errors


def test_columns_that_are_not_read_and_missing_speed_are_printed_without_a_map(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("time,soc,power_kw,colour\n" + ROWS)
    printed = run(file, "--guess", "--out", tmp_path / "a.mcap")
    assert 'not read: "colour"\n' in printed
    assert printed.count("no speed was found: nothing can be predicted") == 1


def test_missing_speed_and_power_are_printed_where_only_a_map_is_written(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("time,soc,elevation,colour\n" + ROWS)
    printed = run(file, "--guess", "--map", tmp_path / "a.toml")
    assert "no speed was found: nothing can be predicted" in printed
    assert "no power was found, and no voltage with current: the state of charge alone measures the energy" in printed


@pytest.fixture
def folder(tmp_path):
    """Return a folder of one good file and three that cannot be read."""
    path = tmp_path / "rides"
    path.mkdir()
    (path / "a.csv").write_text("time,speed_kmh,soc,power_kw\n" + ROWS)
    (path / "b.csv").write_bytes(bytes(range(256)) * 20)
    (path / "c.csv.gz").write_bytes(b"no gzip")
    (path / "d.csv.gz").write_bytes(gzip.compress(ROWS.encode())[:40])
    return path


def test_bad_files_of_a_folder_are_skipped_and_counted_by_cause(folder, tmp_path):
    printed = run(folder, "--guess", "--skip-bad", "--out", tmp_path / "a.mcap")
    assert "60 samples of 1 car, 0.0 h, from 60 rows in 1 file\n" in printed
    assert "skipped 2 of 4 files (c.csv.gz and 1 more): is no gzip file, or is incomplete\n" in printed
    assert "skipped 1 of 4 files (b.csv): is no text file\n" in printed


def test_letters_that_are_no_utf8_late_in_a_file_cost_no_row_but_their_own(folder, tmp_path):
    for name in ("b.csv", "c.csv.gz", "d.csv.gz"):
        (folder / name).unlink()
    lines = "".join(
        f"2024-05-02T{row // 3600:02}:{row // 60 % 60:02}:{row % 60:02}Z,{row},5,7\n" for row in range(80000)
    )
    (folder / "b.csv").write_bytes(
        b"time,speed_kmh,soc,power_kw\n" + lines.encode() * 2 + b"2024-05-03T00:00:00Z,\xff,5,7\n"
    )
    printed = run(folder, "--guess", "--skip-bad", "--out", tmp_path / "a.mcap")
    assert "in 2 files\n" in printed
    assert "windows-1252" in printed.lower()
    assert "skipped" not in printed


def test_only_bad_files_are_one_line_with_their_causes(folder, tmp_path):
    (folder / "a.csv").unlink()
    message = refused(folder, "--guess", "--skip-bad", "--out", tmp_path / "a.mcap")
    assert "none of the 3 files given can be read" in message


def test_bad_file_ends_the_import_with_its_cause_unless_it_is_skipped(folder, tmp_path):
    assert "b.csv: is no text file; leave it out" in refused(folder, "--guess", "--out", tmp_path / "a.mcap")
    (folder / "b.csv").unlink()
    message = refused(folder, "--guess", "--out", tmp_path / "a.mcap")
    assert "c.csv.gz: is no gzip file, or is incomplete; copy it again, or leave it out" in message


@pytest.mark.parametrize("source", ["csv", "twizy"])
def test_recording_of_another_ending_is_refused(folder, tmp_path, source):
    options = ("--guess",) if source == "csv" else ()
    _, errors, code = called("import", source, folder / "a.csv", *options, "--out", tmp_path / "x.csv")
    assert code != 0
    assert f"--out {tmp_path / 'x.csv'}: a recording ends in .mcap; name it {tmp_path / 'x.mcap'}" in errors
