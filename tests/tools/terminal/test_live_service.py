"""The live service takes its locks before anything slow begins, and frees them if a later step fails."""

from pathlib import Path

import pytest

from socast.stream.recorder import Recorder
from socast.stream.state_file import StateFile
from tests.support.commands import refused


@pytest.mark.parametrize("option", ["--record", "--state"])
def test_second_consumer_is_refused_before_kernels_are_compiled(option, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr("socast.tools.terminal.live_service.compile_kernels", lambda *_: pytest.fail("compiled"))
    path = tmp_path / "kept"
    with Recorder(path) if option == "--record" else StateFile(path):
        assert "kept is in use by process" in refused(capsys, "live", option, path)


def test_locks_are_free_after_a_start_that_failed(tmp_path: Path, capsys):
    files = ("--record", tmp_path / "kept", "--state", tmp_path / "cars")
    assert "127.0.0.1:1" in refused(capsys, "live", "--connect", "tcp/127.0.0.1:1", *files)
    with Recorder(tmp_path / "kept"), StateFile(tmp_path / "cars"):
        pass
