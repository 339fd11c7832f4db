"""A command that ends as asked ends with the exit code of that, however many signals come meanwhile."""

import random
import signal
import subprocess
import time

import pytest

from tests.support.commands import SOCAST

ROUTER = "router", "--listen", "tcp/127.0.0.1:0"


@pytest.mark.parametrize(
    ("command", "begun", "kinds", "code"),
    [
        (ROUTER, b"listening", [signal.SIGTERM, signal.SIGINT], {0, 130}),
        (ROUTER, b"listening", [signal.SIGTERM], {0}),
        (ROUTER, b"listening", [signal.SIGINT], {0, 130}),
    ],
)
def test_storm_of_signals_ends_a_service_as_one_signal_does(tmp_path, command, begun, kinds, code):
    random_, log = random.Random(1), tmp_path / "log"
    with log.open("wb") as file:
        process = subprocess.Popen([*SOCAST, *map(str, command)], stderr=file, stdout=file)
    try:
        while begun not in log.read_bytes():
            assert process.poll() is None, log.read_text()
            time.sleep(0.02)
        deadline = time.monotonic() + 30.0
        while process.poll() is None and time.monotonic() < deadline:
            process.send_signal(random_.choice(kinds))
            time.sleep(0.01 * random_.random())
        assert process.wait(1.0) in code, log.read_text()
    finally:
        process.kill()
        process.wait()
    assert "Traceback" not in log.read_text()
