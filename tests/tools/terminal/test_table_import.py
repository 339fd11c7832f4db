"""Test the options of `socast import csv` and what it prints and draws."""

import numpy as np
import pandas as pd
import pytest

from socast.tools.terminal.table_files import are_dated
from tests.support.commands import called, done, refused
from tests.support.own_tables import abrp, teslamate

OTHERS = [
    (["--guess"], "--map is missing"),
    (["--map", "{tmp}/map.toml"], "--out is missing"),
    (["--map", "{tmp}/map.toml", "--guess", "--html", "{tmp}/x.html"], "--html is given without --out"),
    (["--map", "{tmp}/map.toml", "--guess", "--time-zone", "UTC"], "--time-zone applies to public data sets only"),
    (["--map", "{tmp}/map.toml", "--out", "{tmp}/car.csv"], "a recording ends in .mcap; name it"),
    (["--guess", "--out", "{tmp}/car.mcap", "--html", "{tmp}/car.csv"], "is read and would be overwritten"),
]


@pytest.mark.parametrize(("options", "words"), OTHERS, ids=[words for _, words in OTHERS])
def test_options_that_do_not_fit_are_refused_in_one_line(tmp_path, capsys, options, words):
    file = abrp(tmp_path / "car.csv")
    assert words in refused(capsys, "import", "csv", file, *(option.format(tmp=tmp_path) for option in options))


def test_options_of_tables_are_refused_for_public_data_sets(tmp_path, capsys):
    assert "apply to csv and parquet only" in refused(capsys, "import", "ved", tmp_path, "--guess", "-o", "x.mcap")
    assert "--out is missing" in refused(capsys, "import", "ved", tmp_path)


def test_folder_without_tables_is_refused(tmp_path, capsys):
    assert "holds no file that ends in" in refused(capsys, "import", "parquet", tmp_path, "--guess", "--map", "m.toml")


def test_page_draws_each_car_and_shows_each_comparison(tmp_path):
    map_file, page = tmp_path / "map.toml", tmp_path / "page.html"
    file = teslamate(tmp_path / "car.csv")
    done("import", "csv", file, "--guess", "--map", map_file, "-o", tmp_path / "a.mcap", "--html", page)
    text = page.read_text(encoding="utf-8")
    assert "odometer against speed" in text
    assert "by positions" in text
    assert 'content="import 1"' in text


def test_summary_of_wrong_data_names_value_limit_and_remedy(tmp_path):
    map_file = tmp_path / "map.toml"
    file = abrp(tmp_path / "car.csv")
    done("import", "csv", file, "--guess", "--map", map_file)
    text = map_file.read_text(encoding="utf-8")
    map_file.write_text(text.replace('"speed", unit = "km/h"', '"speed", unit = "m/s"'), encoding="utf-8")
    printed, _, code = called("import", "csv", file, "--map", map_file, "-o", tmp_path / "a.mcap")
    assert code == 0
    (line,) = [line for line in printed.splitlines() if "does not agree: odometer against speed" in line]
    assert "ratio 0.278 (limit: ratio from 0.9 to 1.1); the speed is probably in km/h, not m/s" in line


MAP = """[time]
column = "t"
unit = "s"

[vehicle]
name = "car"
model = "nissan-leaf-2013"

[fields]
speed_kmh = { column = "v", unit = "km/h" }
soc_pct = { column = "soc", unit = "%" }
"""


@pytest.fixture
def trips(tmp_path):
    """Write three trips whose clocks begin at 0, and the map of them."""
    (tmp_path / "map.toml").write_text(MAP)
    for number in range(3):
        rows = "\n".join(f"{3 * i},{30 + i % 5},{80 - 0.01 * i}" for i in range(200))
        (tmp_path / f"trip_{number}.csv").write_text(f"t,v,soc\n{rows}\n")
    return tmp_path


def import_trips(folder, *more):
    files = sorted(folder.glob("*.csv"))
    done("import", "csv", *files, "--map", folder / "map.toml", "--out", folder / "trips.mcap", *more)


def test_files_in_sequence_follow_each_other_with_the_gap(trips):
    import_trips(trips, "--sequence", 6)
    done("tables", trips / "trips.mcap", "--out", trips / "tables")
    begin = pd.read_parquet(trips / "tables" / "rides.parquet")["start_s"].to_numpy()
    assert begin[0] == 1_577_836_800.0
    assert np.diff(begin) == pytest.approx(6 * 3600 + 597.0, abs=3.0)


@pytest.mark.parametrize(("more", "dated"), [(("--sequence", 6), False), ((), True)])
def test_recording_and_tables_know_whether_their_dates_are_invented(trips, more, dated):
    if dated:
        (trips / "map.toml").write_text(MAP.replace('unit = "s"', 'unit = "s"\norigin = "2024-05-01"'))
        for file in sorted(trips.glob("*.csv"))[1:]:
            file.unlink()
    import_trips(trips, *more)
    done("tables", trips / "trips.mcap", "--out", trips / "tables")
    assert are_dated([trips / "trips.mcap"]) == dated
    assert are_dated([trips / "tables" / "rides.parquet"]) == dated


def test_sequence_is_refused_where_the_map_tells_the_dates(trips, capsys):
    (trips / "map.toml").write_text(MAP.replace('unit = "s"', 'format = "%H:%M"'))
    given = ("--map", trips / "map.toml", "--out", trips / "trips.mcap", "--sequence", 6)
    assert "leave --sequence out" in refused(capsys, "import", "csv", trips / "trip_0.csv", *given)
