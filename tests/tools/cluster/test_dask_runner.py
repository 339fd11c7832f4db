"""Workers of Dask give the serial tables although one is killed, and nothing but loopback can reach them."""

import os
import signal
import sys

import psutil
import pytest

from socast.core.errors import RecordingError, SettingsError
from socast.tools.cluster.dask_runner import ClusterPlace, open_runner, parse_place
from socast.tools.cluster.runner import InProcessRunner
from socast.tools.cluster.simulation import TRUTH, write_recording
from socast.tools.cluster.workers import Workers
from socast.tools.simulator.fleet import prepare_fleet
from socast.tools.simulator.settings import Simulation
from tests.support.cluster_tables import assert_same, make_parts, make_whole
from tests.support.commands import refused
from tests.support.mortal_tasks import die_once, fail
from tests.support.paths import ROOT

SHIFT = ROOT / "recordings" / "shift.mcap"
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    with open_runner(ClusterPlace("", 2, 4.0), tmp_path_factory.mktemp("scratch")) as opened:
        yield opened


def test_killed_worker_costs_its_task_only(runner, tmp_path):
    results = list(runner.run("mortal", die_once, [(tmp_path / "mark", value) for value in range(6)]))
    assert results == [0, 10, 20, 30, 40, 50]
    assert runner.count_repeats()["mortal"] >= 1
    assert sorted(record.number for record in runner.records if record.stage == "mortal") == list(range(6))


def test_workers_give_the_serial_tables_while_one_is_killed(runner, tmp_path):
    killed = []

    def kill(record):
        if not killed and record.stage == "decode":
            killed.append(record.process)
            os.kill(record.process, signal.SIGKILL)

    runner._on_end = kill
    made = make_parts([SHIFT], tmp_path / "parts", 4, 200_000, runner)
    runner._on_end = None
    assert_same(make_whole([SHIFT]), made)
    assert killed
    assert all(record.process != killed[0] for record in runner.records if record.stage in {"clean", "write"})


def test_workers_give_the_serial_recording_while_one_is_killed(runner, tmp_path):
    fleet = prepare_fleet(Simulation(vehicles=4, days=2, shift_hours=0.5, seed=3))
    outs = [tmp_path / f"{name}.mcap" for name in ("serial", "parallel")]
    killed = []

    def kill(record):
        if not killed:
            killed.append(record.process)
            os.kill(record.process, signal.SIGKILL)

    for out, by in zip(outs, (InProcessRunner(), runner), strict=True):
        runner._on_end = kill
        (tmp_path / out.stem).mkdir()
        write_recording(fleet, out, Workers(by, tmp_path / out.stem, lambda *_: None))
    runner._on_end = None
    assert killed
    for suffix in (".mcap", TRUTH):
        serial, parallel = (out.with_suffix(suffix).read_bytes() for out in outs)
        assert serial == parallel


def test_error_of_a_task_is_that_of_the_command(runner):
    with pytest.raises(RecordingError, match=r"^a\.mcap cannot be read$"):
        list(runner.run("failing", fail, [("a.mcap",)]))


def test_processes_listen_on_loopback_only(runner):
    assert runner.workers == 2
    own = psutil.Process()
    listening = [
        socket.laddr.ip
        for process in [own, *own.children(recursive=True)]
        for socket in process.net_connections("tcp")
        if socket.status == psutil.CONN_LISTEN
    ]
    assert listening
    assert set(listening) <= {"127.0.0.1", "::1"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("local:0", "local:N with 1 to"),
        ("local:x", "local:N with 1 to"),
        ("host:8786", "tls://host:8786"),
        ("tcp://10.0.0.5:8786", "is not encrypted"),
        ("tls://host", "tls://host:8786"),
    ],
)
def test_other_places_are_refused_in_one_line(text, words, tmp_path, capsys):
    assert words in refused(capsys, "tables", SHIFT, "--out", tmp_path / "out", "--cluster", text)


@pytest.mark.parametrize("text", ["tcp://127.0.0.1:8786", "tls://scheduler.example:8786"])
def test_scheduler_on_loopback_or_with_tls_is_accepted(text):
    assert parse_place(text, 2.0).address == text


def test_absent_package_is_named_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(SettingsError, match=r'pip install "socast\[cluster\]"'),
        open_runner(parse_place("local:2", 2.0), tmp_path),
    ):
        pass
