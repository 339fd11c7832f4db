"""`socast live --metrics` is watched by Prometheus and systemd, rotates its recording, and ends in time."""

import builtins
import signal
import socket
import time
from pathlib import Path
from threading import Event, Thread

import pytest

from socast.stream.health import HealthServer, HttpAddress
from socast.stream.metrics import make_registry
from socast.stream.recorder import list_recordings
from socast.stream.service_status import ServiceStatus
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import ZenohSink
from tests.support.commands import refused
from tests.support.live_consumers import consumers, logged
from tests.support.recorded_shift import shift
from tests.support.service import ask_page, read_metrics, systemd_socket
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


def follow_readiness(address: HttpAddress, end: Event, answers: list[tuple[int, str]]) -> None:
    """Ask whether a service is ready until an event, from before it exists."""
    while not end.wait(0.05):
        try:
            answers.append(ask_page(address, "/readyz"))
        except OSError:
            continue


def test_service_is_watched_from_its_start_to_its_end(tmp_path, monkeypatch):
    kept, endpoint = tmp_path / "kept", f"tcp/127.0.0.1:{find_free_port()}"
    address, started, answers = HttpAddress("127.0.0.1", find_free_port()), Event(), []
    follower = Thread(target=follow_readiness, args=(address, started, answers))
    follower.start()
    with systemd_socket(tmp_path) as (told, notify), consumers(tmp_path) as start:
        monkeypatch.setenv("NOTIFY_SOCKET", notify)
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        options = ("--record", kept, "--state", tmp_path / "fleet.state", "--metrics-per-car", "--period", 3)
        process, log = start("--listen", endpoint, "--metrics", address, *options)
        assert eventually(lambda: ask_page(address, "/readyz") == (200, "ok\n"))
        started.set()
        follower.join()
        assert answers[0][0] == 503
        assert any(reason.startswith("starting: ") for _, reason in answers)
        assert {code for code, _ in answers} <= {200, 503}
        assert [line["metrics"] for line in logged(log) if line["event"] == "listening"] == [str(address)]

        half = len(shift()) // 2
        with Node(Connection(connect=(endpoint,))) as node:
            sink = ZenohSink(node)
            sink.put(shift()[:half])
            assert eventually(lambda: scrape(address)["socast_messages_total"] == half)
            process.send_signal(signal.SIGHUP)
            assert eventually(lambda: list_recordings(kept)[0].stat().st_mtime < time.time() - 0.5)
            sink.put(shift()[half:])
            assert eventually(lambda: scrape(address)["socast_messages_total"] == len(shift()))
            assert eventually(lambda: scrape(address)["socast_recorded_total"] > half)
            sink.close()
        told.read()
        samples = scrape(address)
        repeated = len(shift()) - len({(m.key, m.payload) for m in shift()})
        assert samples["socast_duplicates_total"] == repeated
        assert samples["socast_recorded_total"] == len(shift()) - repeated
        assert samples["socast_unrecorded_total"] == 0.0
        assert samples['socast_rejected_total{cause="not_json"}'] == 1.0
        assert samples['socast_model_rides_total{model="extended_physical/1",result="predicted"}'] > 0.0
        assert samples['socast_vehicle_sample_age_seconds{vehicle="car-1"}'] > 0.0
        assert samples["socast_forecasts_total"] > 0.0
        assert samples["socast_state_age_seconds"] < 60.0
        assert samples["process_resident_memory_bytes"] > 1e7
        assert len(list_recordings(kept)) == 2

        with socket.create_connection(address):  # a client that sends nothing delays no stop
            began = time.monotonic()
            process.terminate()
            assert eventually(lambda: told.read() and process.poll() is not None)
            assert process.returncode == 0
            assert time.monotonic() - began < 20.0
        lines = told.read()
        assert lines.count("READY=1") == lines.count("STOPPING=1") == 1
        assert lines.count("WATCHDOG=1") > 3
        assert "STATUS=starting: compiling kernels" in lines
        assert any(line.startswith("STATUS=") and "vehicles active" in line for line in lines)


def scrape(address: HttpAddress) -> dict[str, float]:
    """Return the present metrics."""
    return read_metrics(ask_page(address, "/metrics")[1])


def test_busy_port_is_one_line_before_anything_else_starts(tmp_path, capsys):
    status = ServiceStatus()
    registry = make_registry(lambda: None, lambda: True, lambda: 0.0)
    with HealthServer(HttpAddress("127.0.0.1", 0), status, registry) as server:
        record = ("--record", tmp_path / "kept")
        message = refused(capsys, "live", "--listen", "tcp/127.0.0.1:0", "--metrics", server.address, *record)
    assert f"cannot serve metrics at {server.address}: Address already in use" in message
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("address", ["nine", "127.0.0.1", "1:2:3"])
def test_wrong_address_is_one_line(address, capsys):
    assert f"--metrics is '{address}'; give a port" in refused(capsys, "live", "--metrics", address)


def test_metrics_of_cars_need_an_address(capsys):
    assert "give --metrics ADDRESS too" in refused(capsys, "live", "--metrics-per-car")


def test_missing_package_is_one_line(capsys, monkeypatch):
    original = builtins.__import__

    def refuse(name, *rest):
        if name.startswith("prometheus_client"):
            raise ImportError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert "pip install 'socast[service]'" in refused(capsys, "live", "--metrics", "0")


def test_service_without_metrics_opens_no_port_and_tells_nobody(tmp_path, monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    with consumers(tmp_path) as start:
        process, log = start("--listen", "tcp/127.0.0.1:0")
        (line,) = [line for line in logged(log) if line["event"] == "listening"]
        assert "metrics" not in line
        listening = [port for port in list_listening_ports(process.pid) if str(port) not in line["endpoints"]]
        assert listening == []
        process.send_signal(signal.SIGHUP)  # no recording: nothing happens
        process.terminate()
        assert process.wait(20) == 0


def list_listening_ports(process: int) -> list[int]:
    """Return the TCP ports at which a process listens."""
    own = {str(link.readlink()) for link in Path(f"/proc/{process}/fd").iterdir()}
    rows = [line.split() for line in Path(f"/proc/{process}/net/tcp").read_text().splitlines()[1:]]
    return [int(row[1].rpartition(":")[2], 16) for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own]
