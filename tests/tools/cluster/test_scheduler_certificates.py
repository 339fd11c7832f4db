"""A scheduler elsewhere needs certificates, and a command that waits for one says so."""

import pytest

from socast.core.errors import SettingsError
from socast.tools.cluster.dask_runner import check_certificates, open_runner, parse_place


def test_a_scheduler_under_tls_without_certificates_is_one_line_with_the_variables(tmp_path):
    with (
        pytest.raises(SettingsError, match=r"export DASK_.*CA_FILE, DASK_.*CERT, DASK_.*KEY with") as error,
        open_runner(parse_place("tls://127.0.0.1:1", 2.0), tmp_path),
    ):
        pass
    assert "tls://127.0.0.1:1 needs certificates" in str(error.value)


def test_only_the_certificates_that_are_missing_are_named(tmp_path):
    file = tmp_path / "ca.pem"
    file.touch()
    files = {"ca_file": str(file), "cert": "nosuch.pem", "key": None}
    with pytest.raises(SettingsError, match="export DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY with"):
        check_certificates(files, "tls://a:1")
    with pytest.raises(SettingsError, match=r"CLIENT__CERT is nosuch\.pem, which is no file"):
        check_certificates({**files, "key": "-----BEGIN\n"}, "tls://a:1")


def test_the_command_says_for_which_scheduler_it_waits(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("socast.tools.cluster.dask_runner.CONNECT_S", 0.2)
    with (
        pytest.raises(SettingsError, match="cannot be reached"),
        open_runner(parse_place("tcp://127.0.0.1:1", 2.0), tmp_path),
    ):
        pass
    assert capsys.readouterr().err.startswith("connecting to tcp://127.0.0.1:1, for at most")
