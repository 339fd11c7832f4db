"""Test that every fault of a file is read rightly, or names its cause, its line and the remedy in one line."""

import pandas as pd
import pytest

from socast.tools.importers.table.text_stream import find_encoding
from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples

DRIVE = make_drive(300)
STAMPS = DRIVE["stamp"].strftime("%Y-%m-%dT%H:%M:%SZ")
ROWS = [
    [stamp, f"{speed * 3.6:.1f}", f"{12345 + km / 1000:.3f}", f"{power / 360:.2f}", "360.5"]
    for stamp, speed, km, power in zip(STAMPS, DRIVE["speed"], DRIVE["distance"], DRIVE["power"], strict=True)
]
NAMES = ["Time", "Speed(km/h)", "Odometer(km)", "Pack Current(A)", "Pack Voltage(V)"]
LINES = [",".join(each) for each in [NAMES, *ROWS]]
GROUPED = [f"{float(row[2]):,.1f}" for row in ROWS]


def group(mark, decimal=".", quote='"', separator=","):
    """Return the lines with thousands separators in the odometer, and this decimal mark in all numbers."""
    rows = []
    for row, text in zip(ROWS, GROUPED, strict=True):
        cells = [row[0], *(each.replace(".", decimal) for each in row[1:])]
        cells[2] = text.replace(",", "\0").replace(".", decimal).replace("\0", mark)
        quoted = [f"{quote}{each}{quote}" if separator in each else each for each in cells]
        rows.append(separator.join(quoted))
    return [separator.join(NAMES), *rows]


def put(*places):
    """Return the lines with others put in, given as line number and text."""
    lines = list(LINES)
    for number, text in sorted(places, reverse=True):
        lines.insert(number - 1, text)
    return lines


def import_guessed(tmp_path, content):
    """Import a file with a guessed map; return its samples, none where it is refused, and what was printed."""
    path = tmp_path / "drive.csv"
    path.write_bytes(content if isinstance(content, bytes) else ("\n".join(content) + "\n").encode())
    printed, errors, code = called("import", "csv", path, "--guess", "-o", tmp_path / "a.mcap")
    assert "Traceback" not in errors
    assert code in {0, 2}
    assert errors.count("\n") == (code == 2)
    return (read_samples(tmp_path / "a.mcap") if code == 0 else []), printed + errors


READ = {
    "quoted thousands with commas": group(","),
    "quoted thousands with points and decimal commas": group(".", ","),
    "thousands with points and semicolons": group(".", ",", separator=";"),
    "thousands with blanks and semicolons": group(" ", ",", separator=";"),
    "thousands with narrow blanks": group("\u202f"),
    "thousands with apostrophes": group("'"),
    "byte order mark within the file": put((3, "\ufeff" + LINES[1])),
    "NUL bytes between rows": ("\n".join(LINES[:100]) + "\n" + "\0" * 4096 + "\n".join(LINES[100:]) + "\n").encode(),
    "NUL bytes before the header": ("\0" * 4096 + "\n".join(LINES) + "\n").encode(),
    "mixed ends of lines": (
        "\r\n".join(LINES[:100]) + "\n" + "\r".join(LINES[100:200]) + "\r\n" + "\n".join(LINES[200:]) + "\n"
    ).encode(),
    "separator at the ends of rows": [LINES[0], *(f"{line}," for line in LINES[1:])],
    "separators at the ends of some rows": [
        LINES[0],
        *(f"{line},," if at % 7 == 0 else line for at, line in enumerate(LINES[1:])),
    ],
    "UTF-16 without a mark, little end first": ("\n".join(LINES) + "\n").encode("utf-16-le"),
    "UTF-16 without a mark, big end first": ("\n".join(LINES) + "\n").encode("utf-16-be"),
    "row of units": ["Time,Speed,Odometer,Pack Current,Pack Voltage", "UTC,km/h,km,A,V", *LINES[1:]],
    "row of units in brackets": [
        "Time,Speed,Odometer,Pack Current,Pack Voltage",
        "[-],[km/h],[km],[A],[V]",
        *LINES[1:],
    ],
    "blank lines": [line for each in LINES for line in (each, "")],
}


@pytest.mark.parametrize("fault", READ)
def test_harmless_fault_is_read_as_it_is_meant(tmp_path, fault):
    samples, printed = import_guessed(tmp_path, READ[fault])
    times = {each.time_s for each in samples}
    assert len(times) == 300, printed
    assert samples[-1].odometer_km == pytest.approx(12345 + DRIVE["distance"][-1] / 1000, abs=0.06)
    assert samples[-1].speed_kmh == pytest.approx(DRIVE["speed"][-1] * 3.6, abs=0.06)
    assert "does not agree" not in printed


TOLD = {
    "thousands that divide a cell": (
        group(",", quote=""),
        0,
        ["thousands", "line 2: '2024-05-01T14:00:00Z", "without"],
    ),
    "thousands that divide some cells": (
        [*LINES[:50], *group(",", quote="")[50:]],
        49,
        ["251 rows with more cells than the header, because thousands separators divide", "line 51:"],
    ),
    "decimal commas that divide cells": (
        [LINES[0], *(line.replace(".", ",") for line in LINES[1:])],
        0,
        ["decimal commas divide their numbers", "line 2:", "with ';' between the cells"],
    ),
    "rows with fewer cells": (
        put((12, "2024-05-01T14:00:00Z,1")),
        300,
        ["1 row with another number of cells than the header; first in drive.csv line 12: '2024-05-01T14:00:00Z,1'"],
    ),
    "a blank line before a short row": (put((5, ""), (12, "2024,1")), 300, ["first in drive.csv line 13: '2024,1'"]),
    "the header again": (put((100, LINES[0])), 300, ["1 row with the header again", "line 100: 'Time'"]),
    "a longer header": (
        put((100, "Time,Speed(km/h),Odometer(km),SOC(%),Pack Voltage(V),Latitude")),
        0,
        ["line 100 holds another header (Time,Speed(km/h),Odometer(km)", "divide the file there"],
    ),
    "a header of other columns": (
        put((100, "Time,Odometer(km),Speed(km/h),Pack Voltage(V),Pack Current(A)")),
        0,
        ["line 100 holds another header (Time, Odometer(km)", "divide the file there"],
    ),
    "a sum below the rows": (
        [*LINES, "Total,,123.4,,"],
        300,
        ["1 row with a time that cannot be read", "line 302: 'Total'"],
    ),
    "a remark below the rows": ([*LINES, "# end of log"], 300, ["another number of cells", "line 302: '# end of log'"]),
    "a row cut off at the end": ([*LINES, "2024-05-01T1"], 300, ["line 302: '2024-05-01T1'"]),
    "an open quote": (
        put((100, '"2024-05-01T14:00:00Z,1,2,3,4')),
        300,
        ["1 row with a quote that is opened and not closed", "(close or remove it); first in drive.csv line 100"],
    ),
    "an open quote in the header": (['Time,"Speed', *LINES[1:]], 0, ["line 1 opens a quote that is not closed"]),
    "NUL bytes": (
        ("\n".join(LINES[:99]) + "\n" + "\0" * 512 + "\n".join(LINES[99:]) + "\n").encode(),
        300,
        ["512 NUL bytes, as a loss of power leaves them, are left out, the first in line 100"],
    ),
    "letters of Latin-1 after 256 kB": (
        b"Time,Speed(km/h),Driver\n"
        + b"".join(
            f"{stamp},{at % 50},Bil\n".encode()
            for at, stamp in enumerate(
                pd.date_range(STAMPS[0], periods=12000, freq="1s").strftime("%Y-%m-%dT%H:%M:%SZ")
            )
        )
        + "2024-05-02T14:00:00Z,7,Från\n".encode("latin-1"),
        12001,
        ["1 letters from line 12002 on are no UTF-8 and are read as windows-1252 (Latin-1); set encoding in [file]"],
    ),
    "a cell that is no number": (put((50, "2024-05-01T14:00:00Z,fast,,,")), 300, ["hold no number, such as 'fast'"]),
    "no row": (LINES[:1], 0, ["has a header and no rows"]),
    "only spaces": ([" ", ""], 0, ["is empty"]),
}


@pytest.mark.parametrize("fault", TOLD)
def test_fault_is_told_with_its_cause_its_line_and_the_remedy(tmp_path, fault):
    content, count, words = TOLD[fault]
    samples, printed = import_guessed(tmp_path, content)
    for each in words:
        assert each in printed
    assert abs(len(samples) - count) <= 1 or not count


ENCODINGS = [
    ("Höhe (m),Außentemperatur (°C)", "windows-1252"),
    ("Température (°C),Altitude", "mac_roman"),
    ("Température (°C),Altitude", "cp850"),
    ("Geschwindigkeit über Grund,Höhe", "windows-1252"),
    ("vitesse mesurée,arrêt,état", "mac_roman"),
    ("plain", "utf-8"),
    ("Höhe", "utf-8"),
    ("time,speed,soc", "utf-16-be"),
]


@pytest.mark.parametrize(("text", "encoding"), ENCODINGS)
def test_encoding_follows_from_the_first_bytes(text, encoding):
    assert find_encoding(f"{text}\n1,2\n".encode(encoding)) == encoding


def test_files_of_two_encodings_that_were_joined_are_read(tmp_path):
    header = "Time,Speed(km/h),Fahrer\n"
    first = "".join(f"{stamp},{at % 50},Jürgen\n" for at, stamp in enumerate(STAMPS[:150]))
    second = "".join(f"{stamp},{at % 50},Jörg\n" for at, stamp in enumerate(STAMPS[150:]))
    samples, _ = import_guessed(tmp_path, (header + first).encode() + second.encode("latin-1"))
    assert len(samples) == 300


def test_map_names_an_encoding_that_does_not_fit_is_one_line(tmp_path):
    path, map_file = tmp_path / "a.csv", tmp_path / "map.toml"
    path.write_bytes(b"Time,v\n2024-05-01T14:00:00Z,1\n" + b"\xff\xfe\xff,1\n")
    map_file.write_text(
        '[file]\nencoding = "ascii"\n[vehicle]\nname = "a"\n[time]\ncolumn = "Time"\n'
        '[fields]\nspeed_kmh = { column = "v" }'
    )
    _, errors, code = called("import", "csv", path, "--map", map_file, "-o", tmp_path / "a.mcap")
    assert (code, errors.count("\n")) == (2, 1)
    assert "holds bytes that are no ascii" in errors
    assert "set encoding in [file] of the map, such as utf-8 or latin-1" in errors
