"""`socast serve` prints an address for one browser, stops cleanly, and reports every mistake in one line."""

import re
import signal
import socket
import subprocess
import sys

from tests.support.commands import SOCAST, refused
from tests.support.paths import RECORDINGS
from tests.support.web_requests import Client

SHIFT = RECORDINGS / "shift.mcap"


class Printed:
    """A server in another process, known by the address that it printed."""

    def __init__(self, address):
        self.address = address
        self.origin = address.partition("/enter")[0]
        self.port = int(self.origin.rpartition(":")[2])


def test_command_serves_a_recording_and_stops_cleanly():
    command = [*SOCAST, "serve", str(SHIFT), "--port", "0", "--no-browser", "--read-only"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as served:
        printed = ""
        while "Ctrl-C" not in printed:
            printed += (line := served.stdout.readline())
            assert line, served.stderr.read()
        (address,) = re.findall(r"http://127\.0\.0\.1:\d+/enter\?token=\S+", printed)
        client = Client(Printed(address))
        session = client.get("/api/session").record()
        code = client.post("/api/player", {"action": "pause"}).code
        served.send_signal(signal.SIGINT)
        out, err = served.communicate(timeout=30)
    assert session["fleet"]["mode"] == "replay"
    assert (session["read_only"], code) == (True, 403)
    assert "Address for another browser" in out
    assert (served.returncode, err) == (0, "")


def test_mistakes_are_one_line(capsys, tmp_path):
    assert "--live" in refused(capsys, "serve", "--connect", "tcp/127.0.0.1:1")
    assert "--shard-by belong to --live" in refused(capsys, "serve", "--shard-by", "chunk")
    assert "none.mcap" in refused(capsys, "serve", tmp_path / "none.mcap", "--no-browser")
    assert "given twice" in refused(capsys, "serve", SHIFT, SHIFT, "--no-browser")
    assert "none.pmtiles" in refused(capsys, "serve", "--tiles", tmp_path / "none.pmtiles", "--no-browser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"cannot listen at 127.0.0.1:{port}" in refused(capsys, "serve", "--port", port, "--no-browser")


def test_missing_extra_is_named_with_the_remedy(capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "socast.tools.workbench.fleet.tiles", raising=False)
    monkeypatch.setitem(sys.modules, "pmtiles", None)
    message = refused(capsys, "serve", SHIFT, "--no-browser")
    assert "pmtiles" in message
    assert "pip install 'socast[workbench]'" in message
