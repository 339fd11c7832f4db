"""Test that published files of the Vehicle Energy Dataset are read in all their variants."""

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

from socast.tools.importers import ved
from socast.tools.importers.drive import ReadOptions, make_messages
from tests.support.published_files import VED_HEADER, ved_file, ved_row

UTC_ZONE = ReadOptions(ZoneInfo("UTC"))


def test_ved_day_numbers_count_from_november_2017(tmp_path):
    (drive,) = ved.read_drives(
        ved_file(tmp_path / "week.csv", [ved_row(250, day=1.5), ved_row(3000, day=1.5)]), UTC_ZONE
    )
    assert drive.start == datetime(2017, 11, 1, 12, tzinfo=UTC).timestamp() + 0.25
    (local,) = ved.read_drives(tmp_path / "week.csv", ReadOptions(ZoneInfo("America/Detroit")))
    assert local.start - drive.start == 4 * 3600


def test_ved_weekly_file_gives_only_electric_cars(tmp_path):
    rows = [ved_row(ms, trip=trip) for trip in (1, 2) for ms in (0, 1000, 2000)]
    rows += [ved_row(ms, vehicle=9, engine=1200) for ms in (0, 1000)]
    rows += [ved_row(ms, vehicle=8, current=None) for ms in (0, 1000)]
    rows += [ved_row(ms, vehicle=10) for ms in (0, 1000)]
    path = ved_file(tmp_path / "VED_171101_week.csv", rows)
    assert [d.ride_id for d in ved.read_drives(path, UTC_ZONE)] == ["ved-10-1", "ved-455-1", "ved-455-2"]
    assert [d.ride_id for d in ved.read_drives(path, UTC_ZONE._replace(vehicles=[455]))] == ["ved-455-1", "ved-455-2"]
    assert ved.read_drives(path, UTC_ZONE._replace(vehicles=[8])) == []


ENGINE_NAMES = {"MAF[g/sec]", "Engine RPM[RPM]", "Absolute Load[%]"}


def test_ved_extract_without_engine_columns_gives_the_same_messages(tmp_path):
    keep = [i for i, name in enumerate(VED_HEADER.split(",")) if "Fuel" not in name and name not in ENGINE_NAMES]
    ved_file(tmp_path / "week.csv")
    lines = [line.split(",") for line in (tmp_path / "week.csv").read_text().splitlines()]
    (tmp_path / "trip.csv").write_text("\n".join(",".join(line[i] for i in keep) for line in lines))
    (whole,), (extract,) = (ved.read_drives(tmp_path / name, UTC_ZONE) for name in ("week.csv", "trip.csv"))
    assert make_messages([whole], 3.0) == make_messages([extract], 3.0)


def test_ved_uses_kilowatts_of_air_conditioning_where_watts_are_missing(tmp_path):
    rows = [ved_row(ms).replace(",0.1,100,", ",0.25,NaN,") for ms in (0, 3000)]
    (drive,) = ved.read_drives(ved_file(tmp_path / "week.csv", rows), UTC_ZONE)
    assert drive.rows["hvac_w"].tolist() == [1150.0, 1150.0]
