"""Where the system gives too little, a command says so in one line."""

import re
import subprocess

import pytest

from tests.support.commands import SOCAST
from tests.support.paths import RECORDINGS

ROUTER = "router", "--listen", "tcp/127.0.0.1:0"
REPLAY = "replay", str(RECORDINGS / "shift.mcap")


def refused_under(limit, command):
    """Run a command under a limit of the shell, check that it is refused, and return the one line that it prints."""
    shell = ["/bin/sh", "-c", f'ulimit {limit}; exec "$@"', "sh", *SOCAST, *command]
    ended = subprocess.run(shell, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 2, ended.stderr
    assert re.fullmatch(r"socast: [^\n]+\n", ended.stderr), ended.stderr
    return ended.stderr


@pytest.mark.parametrize("files", [8, 12, 13, 14, 16, 20])
def test_too_few_open_files_are_named_before_zenoh_aborts(files):
    words = refused_under(f"-n {files}", ROUTER)
    assert f"of at most {files}, and Zenoh needs 24 more: raise it with `ulimit -n 256`" in words


@pytest.mark.parametrize("megabytes", [200, 300, 400, 500, 600])
def test_too_small_an_address_space_is_named(megabytes):
    assert f"limited to {megabytes} MiB" in refused_under(f"-v {megabytes * 1024}", REPLAY)


@pytest.mark.parametrize("megabytes", [600, 800, 1000, 1300, 1600])
def test_too_small_an_address_space_is_named_before_zenoh_aborts(megabytes):
    assert f"limited to {megabytes} MiB" in refused_under(f"-v {megabytes * 1024}", ROUTER)
