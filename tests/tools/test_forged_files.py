"""A forged file of any kind is refused in one line of bounded length."""

import json
import os
import subprocess
from contextlib import suppress
from threading import Thread

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from socast.core import errors, models
from socast.core.errors import SocastError
from socast.core.models.file import encode_model
from socast.tools.cli import LONGEST_LINE
from socast.tools.commands.evaluate_soc import read_displays
from socast.tools.security.folder import _read_json
from socast.tools.terminal.night_watch import read_condition, read_findings
from socast.tools.terminal.table_files import read as read_table
from socast.tools.terminal.table_files import read_source
from tests.support.commands import refused
from tests.support.paths import RECORDINGS

DEPTH = 3000
CONTENTS = {
    "nothing": b"",
    "zeros": bytes(50),
    "another encoding": b"a = '\xff'",
    "open lists": b"[" * DEPTH,
    "nested lists": b"[" * DEPTH + b"]" * DEPTH,
    "nested objects": b'{"a":' * DEPTH + b"1" + b"}" * DEPTH,
    "nested TOML": b"a = " + b"[" * DEPTH + b"]" * DEPTH,
    "nested TOML tables": b"a = " + b"{a=" * DEPTH + b"1" + b"}" * DEPTH,
    "nested signs": b"a = " + b"-" * 100_000 + b"1",
    "key of 100,000 parts": b".".join([b"a"] * 100_000) + b" = 1",
    "5,000 digits of TOML": b"a = 1" + b"0" * 5000,
    "5,000 digits of JSON": b'{"a": 1' + b"0" * 5000 + b"}",
    "lone surrogate": b'{"a": "\\ud800"}',
    "path": b'"../../etc/passwd" = 1\n',
    "long line": b"x" * 1_000_000,
    "JSON5 that is nested 100,000 times": b"{connect: " + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "numbers in place of names": b'{"mode": 1, "connect": 2, "listen": {"endpoints": 5}}',
}
COMMANDS = {
    "model.json": ("history",),
    "cars.toml": ("vehicles", "list", "--vehicles"),
    "live.toml": ("live", "--settings"),
    "map.toml": ("import", "csv", RECORDINGS / "logger.csv", "--map"),
    "effects.py": ("effects", "check"),
    "router.json5": ("router", "--listen", "tcp/127.0.0.1:0", "--config"),
    "adapt.json": ("fit", RECORDINGS / "shift.mcap", "--out", "unused.json", "--adapt"),
}
STATE = "live.state", ("live", "--listen", "tcp/127.0.0.1:0", "--state")


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize(("name", "command"), [*COMMANDS.items(), STATE])
def test_forged_file_is_one_line(tmp_path, capsys, name, command, content):
    if (name, content) == ("live.toml", "nothing"):
        pytest.skip("an empty file sets nothing")
    path = tmp_path / name
    path.write_bytes(CONTENTS[content])
    assert len(refused(capsys, *command, path)) < LONGEST_LINE + 100


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize(
    "read", [read_findings, read_condition, read_displays, lambda path: _read_json(path, ""), read_source]
)
def test_forged_file_is_no_traceback_where_the_product_reads_its_own(tmp_path, read, content):
    path = tmp_path / "quality.json"
    path.write_bytes(CONTENTS[content])
    with suppress(SocastError):
        read(path)


BEGIN = "from socast import effect\n"
DECLARED = "@effect(coefficient='c', unit='N', low=0, high=60, source='s')\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            f"{DECLARED}def big({', '.join(f'c{i}' for i in range(9_000))}):\n    return c0\n",
            "9,000 is more than 100",
        ),
        ("".join(f"{DECLARED}def e{i}(speed):\n    return speed\n" for i in range(5000)), "5,000 is more than 1,000"),
    ],
    ids=["columns", "effects"],
)
def test_file_of_too_many_effects_or_columns_is_one_line(tmp_path, capsys, content, words):
    path = tmp_path / "effects.py"
    path.write_text(BEGIN + content)
    assert words in refused(capsys, "effects", "check", path)


PLACES = {
    "a circle of links": lambda path: path.symlink_to(path.name),
    "a folder": lambda path: path.mkdir(),
    "a pipe without a writer": os.mkfifo,
    "absent": lambda _: None,
}
READERS = {
    **COMMANDS,
    "events.csv": ("condition", RECORDINGS / "shift.mcap", "--model", "extended_physical", "--events"),
    "plan.json": ("ask", "taxi-1", "--plan"),
    "tile.hgt": ("tables", RECORDINGS / "shift.mcap", "--out", "unused", "--elevation"),
    "tile.zip": ("tables", RECORDINGS / "shift.mcap", "--out", "unused", "--elevation"),
    "map.parquet": ("elevation", "info"),
    "shift.mcap": ("info",),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", READERS)
def test_what_stands_in_place_of_a_file_is_one_line(tmp_path, capsys, monkeypatch, name, place):
    monkeypatch.setattr(errors, "LONGEST_WAIT_S", 0.1)
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    PLACES[place](path)
    refused(capsys, *READERS[name], path)


def test_endless_device_in_place_of_an_archive_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tile.zip").symlink_to("/dev/zero")
    assert "it is no file" in refused(capsys, *READERS["tile.zip"], "tile.zip")


@pytest.mark.parametrize(("name", "command"), [("router.json5", COMMANDS["router.json5"]), STATE])
def test_endless_pipe_ends_at_the_limit(tmp_path, capsys, monkeypatch, name, command):
    monkeypatch.setattr(errors, "LARGEST_INPUT", 1 << 22)
    monkeypatch.setattr(errors.read_input, "__defaults__", (1 << 22,))
    path = tmp_path / name
    os.mkfifo(path)
    writer = subprocess.Popen(["/bin/sh", "-c", f"exec yes > {path}"])
    try:
        assert "above the limit of 4,194,304" in refused(capsys, *command, path)
    finally:
        writer.kill()
        writer.wait()


def test_pipe_with_a_writer_is_read(tmp_path, capsys):
    path = tmp_path / "cars.toml"
    os.mkfifo(path)
    writer = Thread(target=path.write_text, args=("[x]\nmass_kg = 1800\n",))
    writer.start()
    assert "nominal_capacity_kwh" in refused(capsys, *COMMANDS["cars.toml"], path)
    writer.join()


@pytest.mark.parametrize(
    "parts",
    [
        [pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["a", "a"])],
        [pa.table({"a": [1.0]}), pa.table({"a": [[1.0]]})],
        [pa.table({"a": [1.0]}), pa.table({"a": ["x"]})],
    ],
)
def test_parts_of_a_table_that_contradict_each_other_are_refused(tmp_path, parts):
    for number, part in enumerate(parts):
        pq.write_table(part, tmp_path / f"{number}.parquet")
    with pytest.raises(SocastError, match="no Parquet table: ") as caught:
        read_table([tmp_path])
    assert "\n" not in str(caught.value)


def test_file_that_says_that_it_holds_a_billion_rows_is_refused(tmp_path):
    path = tmp_path / "rides.parquet"
    pq.write_table(pa.table({f"column_{i}": np.arange(1.0) for i in range(20)}), path)
    content = path.read_bytes()
    size = int.from_bytes(content[-8:-4], "little")
    begin, foot = content[: -8 - size], content[-8 - size : -8]
    forged = foot.replace(b"\x16\x02", b"\x16\x80\xa0\xb7\x87\xe9\x05")  # 1 and 10^11 as zigzag numbers
    path.write_bytes(begin + forged + len(forged).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(SocastError, match=r"rows of 20 columns, about .* GB, above the .* GB of memory"):
        read_table([path])


@pytest.mark.parametrize("displays", ["3", '"x"', "[1]", '{"a": 1}', '[{"vehicle_id": 1}]', "[" * DEPTH])
def test_forged_displays_are_refused(tmp_path, displays):
    path = tmp_path / "x.truth.json"
    path.write_text(f'{{"displays": {displays}}}')
    with pytest.raises(SocastError, match="is not the truth of a simulation"):
        read_displays(path)


VALUES = ["1e400", "1" + "0" * 400, "NaN", "null", "[]", "{}", "true", '"\\ud800"', "[" * DEPTH + "]" * DEPTH]


def list_places(value, place=()):
    """Return the place of each value in nested lists and dictionaries."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place, *(found for name, each in inner for found in list_places(each, (*place, name)))]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: value[:20])
def test_model_file_with_a_forged_value_anywhere_is_read_or_refused(tmp_path, value):
    content = json.loads(encode_model(models.load("extended_physical")))
    path = tmp_path / "model.json"
    for place in list_places(content)[1:]:
        forged = json.loads(json.dumps(content))
        inner = forged
        for name in place[:-1]:
            inner = inner[name]
        inner[place[-1]] = "@"
        path.write_text(json.dumps(forged).replace('"@"', value))
        with suppress(SocastError):
            models.load(path, verify=False)
