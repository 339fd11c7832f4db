"""A command that ends as asked ends with the exit code of that, however many signals come, and whenever they come."""

import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.commands import SOCAST
from tests.support.paths import RECORDINGS

ROUTER = "router", "--listen", "tcp/127.0.0.1:0"
LIVE = "live", "--listen", "tcp/127.0.0.1:0", "--state", "state", "--record", "recordings"
SERVE = "serve", RECORDINGS / "shift.mcap", "--no-browser", "--read-only", "--port", 0
pytestmark = pytest.mark.long
REPLAY = "replay", RECORDINGS / "shift.mcap", "--speed", 600
ASKING = signal.SIGTERM, signal.SIGINT
LONGEST_S = 30.0
SWALLOWING = """
import ctypes, sys, time, types

def main():
    print("begun", flush=True)
    ctypes.pythonapi.PyRun_SimpleString(b"import time; time.sleep(60)")
    time.sleep(60)

sys.modules["socast.tools.cli"] = types.SimpleNamespace(main=main)
from socast.__main__ import main
main()
"""
"""A command amid compiled code that prints whatever is raised in it, and goes on."""


@contextmanager
def started(command, folder):
    """Run a command in a process of its own, in a folder; give the process and its log."""
    log = folder / "log"
    with log.open("wb") as file:
        process = subprocess.Popen([*SOCAST, *map(str, command)], stderr=file, stdout=file, cwd=folder)
    try:
        yield process, log
    finally:
        process.kill()
        process.wait()
    text = log.read_text()
    assert not any(word in text for word in ("Traceback", "Exception", "Warning")), text


def storm(process, kinds, random_):
    """Send signals until a process has ended, and return its exit code."""
    deadline = time.monotonic() + LONGEST_S
    while process.poll() is None and time.monotonic() < deadline:
        process.send_signal(random_.choice(kinds))
        time.sleep(0.01 * random_.random())
    return process.wait(1.0)


def handles_signals(process):
    """Return whether a process has handlers of its own, which come before its first import."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> signal.SIGTERM - 1 & 1)


@pytest.mark.parametrize(
    ("command", "begun", "kinds", "codes"),
    [
        (ROUTER, b"listening", ASKING, {0, 130}),
        (ROUTER, b"listening", [*ASKING, signal.SIGHUP], {0, 130}),
        (ROUTER, b"listening", [signal.SIGTERM], {0}),
        (ROUTER, b"listening", [signal.SIGINT], {0, 130}),
        (SERVE, b"http", [*ASKING, signal.SIGHUP], {0}),
        (LIVE, b"listening", [*ASKING, signal.SIGHUP], {0, 130}),
        (LIVE, b"listening", [signal.SIGTERM, signal.SIGHUP], {0}),
    ],
)
def test_storm_of_signals_ends_a_service_as_one_signal_does(tmp_path, command, begun, kinds, codes):
    with started(command, tmp_path) as (process, log):
        while begun not in log.read_bytes():
            assert process.poll() is None, log.read_text()
            time.sleep(0.02)
        code = storm(process, kinds, random.Random(1))
    assert code in codes, log.read_text()
    assert (tmp_path / "state").exists() == (command == LIVE) or code == 130


@pytest.mark.parametrize("wait_s", [0.0, 0.2, 0.7, 1.5])
@pytest.mark.parametrize("command", [ROUTER, SERVE, LIVE, REPLAY], ids=lambda command: command[0])
def test_signals_while_a_command_opens_end_it_in_silence(tmp_path, command, wait_s):
    with started(command, tmp_path) as (process, log):
        while not handles_signals(process):
            time.sleep(0.001)
        time.sleep(wait_s)
        code = storm(process, [*ASKING, signal.SIGHUP] if command != LIVE else ASKING, random.Random(wait_s))
    assert code in {0, 130}, log.read_text()


def test_signal_amid_compiled_code_that_prints_exceptions_ends_a_command_in_silence():
    process = subprocess.Popen([sys.executable, "-c", SWALLOWING], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"begun\n"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=LONGEST_S) == (b"", b"")
        assert process.returncode == 130
    finally:
        process.kill()
        process.wait()


def test_ignored_hangup_stays_ignored():
    command = ["/bin/sh", "-c", 'trap "" HUP; exec "$@"', "sh", *SOCAST, *ROUTER]
    process = subprocess.Popen(command, stderr=subprocess.PIPE)
    try:
        assert b"listening" in process.stderr.readline()
        process.send_signal(signal.SIGHUP)
        time.sleep(0.2)
        assert process.poll() is None
        process.terminate()
        assert process.wait(LONGEST_S) == 0
    finally:
        process.kill()
        process.wait()
