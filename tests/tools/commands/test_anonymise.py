"""`socast anonymise` keeps tables, and leaves no trace of names, places and dates in the file."""

import json
from io import BytesIO
from random import Random

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import SocastError
from socast.core.wire.messages import Message, Telemetry, encode
from socast.stream.mcap_format import read_records
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.commands.anonymise import REMAINS, find_extent, rewrite_recordings
from tests.support.batched_recordings import make_batch
from tests.support.commands import done, refused
from tests.support.paths import RECORDINGS

pytestmark = pytest.mark.long
HIDDEN = {"ride_id", "ride_key", "vehicle_id", "driver_id", "date", "winter", "summer", "start_s", "end_s"}
HIDDEN |= {f"{name}_{end}_deg" for name in ("latitude", "longitude") for end in ("start", "end")} | {"wind_from_deg"}
"""Columns of names, dates, places and compass directions."""
TURNED = ("wind_speed_kmh", "effect_aero_drag_wind", "effect_headwind", "effect_crosswind_yaw", "effect_cornering")
LIT = "effect_night_lights"
"""Columns that depend on headings, and on the sun."""


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Return the folder with an anonymised shift and its tables."""
    return share(tmp_path_factory.mktemp("shared"), "shift")


def share(folder, name):
    """Anonymise a recording and make its tables."""
    report = rewrite_recordings([McapSource(RECORDINGS / f"{name}.mcap")], folder / "shared.mcap", Random(7))
    assert report["days_stay"]
    done("tables", folder / "shared.mcap", "--out", folder)
    return folder


def read_sorted(folder, name):
    """Return a table in an order that names do not change."""
    table = pd.read_parquet(folder / f"{name}.parquet")
    return table.sort_values(["odometer_km", "duration_s", "distance_km"], ignore_index=True)


def check_tables(before_folder, after_folder):
    """Check that every column but those of names, dates and places is the same."""
    for name in ("rides", "windows"):
        before, after = read_sorted(before_folder, name), read_sorted(after_folder, name)
        assert list(before) == list(after)
        assert len(before) == len(after)
        for column in set(before) - HIDDEN:
            one, other = before[column], after[column]
            if not pd.api.types.is_numeric_dtype(one):
                assert one.equals(other), column
                continue
            scale = np.nanmax(np.abs(one.to_numpy(np.float64)), initial=0.0)
            limit = 0.05 if column.startswith(LIT) else 5e-3 if column.startswith(TURNED) else 1e-5
            np.testing.assert_allclose(other, one, rtol=1e-6, atol=limit * scale, err_msg=column)


def test_every_column_of_a_shift_but_names_dates_and_places_stays(shared, shift_tables):
    check_tables(shift_tables, shared)


def test_every_column_of_an_autumn_but_names_dates_and_places_stays(tmp_path, autumn_tables):
    check_tables(autumn_tables, share(tmp_path, "autumn"))


def test_names_dates_and_places_are_others(shared, shift_tables):
    before, after = read_sorted(shift_tables, "rides"), read_sorted(shared, "rides")
    for name in ("vehicle_id", "driver_id", "ride_key", "date"):
        assert not set(before[name].dropna()) & set(after[name].dropna()), name
    assert (np.abs(after["start_s"] - before["start_s"]) > 365 * 86400).all()
    moved = np.abs(after["longitude_start_deg"] - before["longitude_start_deg"])
    assert moved.min() > 5.0


def test_output_holds_no_byte_of_a_name_or_of_the_writer(shared):
    source = McapSource(RECORDINGS / "shift.mcap")
    names = {b"taxi", b"simulate", b"recordings"}
    for message in (each for block in source for each in block):
        try:
            fields = json.loads(message.payload)
        except ValueError:
            continue
        for each in fields if isinstance(fields, list) else [fields]:
            if isinstance(each, dict):
                kinds = ("vehicle_id", "station_id", "ride_id", "driver_id")
                names |= {str(each[kind]).encode() for kind in kinds if each.get(kind)}
    assert len(names) > 60
    data = read_all_bytes(shared / "shared.mcap")
    assert {name for name in names if name in data} == set()


def read_all_bytes(path):
    """Return the bytes of a recording, and those of its decompressed chunks."""
    import zstandard  # noqa: PLC0415

    whole = path.read_bytes()
    parts = [whole]
    for opcode, body in read_records(BytesIO(whole), 8, len(whole) - 16, len(whole)):
        if opcode == 6:
            begin = body.index(b"zstd") + 4 + 8
            parts.append(zstandard.ZstdDecompressor().decompress(body[begin:], max_output_size=1 << 26))
    assert len(parts) > 1
    return b"".join(parts)


def test_metadata_says_only_which_command_wrote_it(shared):
    assert set(McapSource(shared / "shared.mcap").metadata) == {"version", "command"}
    assert McapSource(shared / "shared.mcap").metadata["command"] == "anonymise"


def test_two_runs_differ_and_the_same_random_numbers_give_the_same_bytes(tmp_path):
    write(tmp_path / "own.mcap", "fleet/van-of-anna/telemetry")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        rewrite_recordings([McapSource(tmp_path / "own.mcap")], tmp_path / name, Random(seed))
    a, b, c = ((tmp_path / name).read_bytes() for name in "abc")
    assert a == b != c


def test_summary_says_what_was_dropped_and_what_remains(tmp_path, capsys):
    write(tmp_path / "own.mcap", "depot/fleet/van-of-anna/telemetry", "depot/notes", "fleet/van-of-anna/forecast")
    done("anonymise", tmp_path / "own.mcap", "-o", tmp_path / "shared.mcap", "--json", tmp_path / "report.json")
    shown = capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["dropped"] == {"unknown key": 1, "of consumers": 1}
    assert report["names"]["car"] == 1
    assert "dropped: 1 unknown key, 1 of consumers" in shown
    assert REMAINS in shown
    assert b"anna" not in read_all_bytes(tmp_path / "shared.mcap")


def test_a_file_that_is_there_is_not_overwritten(tmp_path, capsys):
    write(tmp_path / "own.mcap", "fleet/van-of-anna/telemetry")
    (tmp_path / "shared.mcap").write_bytes(b"kept")
    message = refused(capsys, "anonymise", tmp_path / "own.mcap", "-o", tmp_path / "shared.mcap")
    assert "shared.mcap is there already and would be overwritten; name another file" in message
    assert (tmp_path / "shared.mcap").read_bytes() == b"kept"


def write(path, *keys):
    """Write a recording with one sample under each key."""
    with McapSink(path) as sink:
        sample = encode(Telemetry("van-of-anna", 1.7e9, latitude_deg=45.5, longitude_deg=-73.6))
        sink.put([Message(key, sample, round(1.7e18) + at) for at, key in enumerate(keys)])


def write_batches(path):
    """Write batches that came hours after their samples, and one that cannot be read; return the samples."""
    times = 1.7e9 + 60.0 * np.arange(240)
    samples = [
        {"vehicle_id": "van-of-anna", "time_s": time, "ride_id": "anna-7", "plate": "XYZ"}
        | {"latitude_deg": 45.5 + 0.0007 * at, "longitude_deg": -73.6 + 0.0003 * at}
        for at, time in enumerate(times.tolist())
    ]
    receipt_ns = round((times[-1] + 7200.0) * 1e9)
    with McapSink(path) as sink:
        batches = [make_batch(samples[at : at + 80], "depot/fleet/north-gate/batch", receipt_ns) for at in (0, 80, 160)]
        sink.put([*batches, batches[0]._replace(payload=batches[0].payload[:-99])])
    return samples


def test_batches_of_gateways_pass_and_leave_no_trace_of_names_dates_and_places(tmp_path):
    samples = write_batches(tmp_path / "own.mcap")
    report = rewrite_recordings([McapSource(tmp_path / "own.mcap")], tmp_path / "shared.mcap", Random(1))
    assert (report["kept"], report["dropped"]) == ({"batch": 3}, {"damaged batches": 1})
    assert {kind: count for kind, count in report["names"].items() if count} == {"car": 1, "gateway": 1, "ride": 1}
    assert report["positions"] == len(samples)
    data = read_all_bytes(tmp_path / "shared.mcap")
    assert [text for text in (b"anna", b"north", b"depot", b"XYZ", b"plate") if text in data] == []
    numbers = {value for sample in samples for value in sample.values() if isinstance(value, float)}
    assert len(numbers) == 3 * len(samples)
    assert not any(np.float64(number).tobytes() in data for number in numbers)


def test_extent_of_batches_has_their_place_and_the_hours_of_their_samples(tmp_path):
    write_batches(tmp_path / "own.mcap")
    extent = find_extent([McapSource(tmp_path / "own.mcap")])
    assert extent.centre == pytest.approx((45.584, -73.564), abs=0.005)
    assert [hour for hour, is_busy in enumerate(extent.busy) if is_busy] == [0, 1, 2, 4, 22, 23]


def test_wrong_calls_are_one_line(tmp_path, capsys):
    shift = RECORDINGS / "shift.mcap"
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(shift.read_bytes())
    assert "would be overwritten" in refused(capsys, "anonymise", copy, "-o", copy)
    assert "cannot be read" in refused(capsys, "anonymise", tmp_path / "none.mcap", "-o", tmp_path / "a.mcap")
    assert "--out" in refused(capsys, "anonymise", shift)
    write(tmp_path / "notes.mcap", "depot/notes")
    with pytest.raises(SocastError, match="no message that socast can read"):
        rewrite_recordings([McapSource(tmp_path / "notes.mcap")], tmp_path / "b.mcap", Random(1))
