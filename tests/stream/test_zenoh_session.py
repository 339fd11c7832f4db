"""Zenoh sessions listen only at the configured endpoints and refuse invalid settings in one line."""

import os
import re
import socket
from pathlib import Path

import pytest

from socast.core.errors import SettingsError
from socast.stream.zenoh_session import (
    LOOPBACK,
    Connection,
    Node,
    _list_endpoints,
    _make_config,
    _read,
    _warn_if_open,
    find_free_port,
)
from tests.support.zenoh_sessions import router


@pytest.mark.parametrize("prefix", ["a/**", "*", "a b?", "a//b", "a$*", "a#b", "a\nb"])
def test_invalid_prefix_raises_settings_error(prefix):
    with pytest.raises(SettingsError, match="plain chunks") as caught:
        Node(Connection(listen=("tcp/127.0.0.1:0",), prefix=prefix))
    assert repr(prefix) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", [None, "peer", "router", "client"])
def test_node_listens_on_loopback_only_by_default(mode):
    assert all(end.startswith("tcp/127.0.0.1:") for end in _list_endpoints(_make_config(Connection(mode=mode))))
    assert _list_endpoints(_make_config(Connection(mode="router", listen=("tcp/0.0.0.0:7447",)))) == [
        "tcp/0.0.0.0:7447"
    ]


@pytest.mark.parametrize(
    ("options", "content", "delay"),
    [
        ({}, "", 0),
        ({"listen": (LOOPBACK,)}, "", 0),
        ({"connect": (LOOPBACK,)}, "", None),
        ({"connect": (LOOPBACK,), "mode": "router"}, "", None),
        ({"mode": "peer"}, "", None),
        ({}, "scouting: {delay: 70}", 70),
        ({}, "scouting: {multicast: {enabled: true}}", None),
        ({}, f'connect: {{endpoints: ["{LOOPBACK}"]}}', None),
    ],
)
def test_router_that_looks_for_no_other_node_does_not_wait_for_one(options, content, delay, tmp_path):
    file = tmp_path / "node.json5"
    file.write_text(f"{{mode: 'router', {content}}}" if not options else "{}")
    assert _read(_make_config(Connection(config=file, **options)), "scouting/delay") == delay


@pytest.mark.parametrize("mode", ["peer", "router"])
@pytest.mark.parametrize(
    ("content", "endpoints"),
    [
        ("/* listen: to nobody */", None),
        ("listen: {timeout_ms: 5}", None),
        ("id: 'a115e4'", None),
        ('listen: {endpoints: ["tcp/0.0.0.0:7555"]}', ["tcp/0.0.0.0:7555"]),
        (r'"list\u0065n": {endpoints: ["tcp/0.0.0.0:7555"]}', ["tcp/0.0.0.0:7555"]),
        ("listen: {endpoints: []}", []),
    ],
)
def test_only_endpoints_setting_in_file_replaces_default_endpoints(content, endpoints, mode, tmp_path):
    file = tmp_path / "node.json5"
    file.write_text(f"{{{content}}}")
    ends = _list_endpoints(_make_config(Connection(config=file, mode=mode)))
    if endpoints is None:
        assert [end.rpartition(":")[0] for end in ends] == ["tcp/127.0.0.1"]
    else:
        assert ends == endpoints


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"connect": ("tcp/127.0.0.1:1",)}, "tcp/127.0.0.1:1"),
        ({"connect": ("router.example",)}, "router.example"),
        ({"mode": "queen"}, "queen"),
        ({"config": Path("/nowhere.json5")}, "/nowhere.json5"),
    ],
)
def test_impossible_connection_raises_settings_error(settings, expected):
    with pytest.raises(SettingsError, match=expected) as caught:
        Node(Connection(**settings))
    assert "\n" not in str(caught.value)
    assert ".cargo" not in str(caught.value)


@pytest.mark.parametrize(("mode", "connect"), [(None, ()), ("peer", ()), ("router", ("tcp/127.0.0.1:1",))])
def test_taken_port_raises_error_that_names_remedy(mode, connect):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SettingsError, match=str(port)) as caught:
            Node(Connection(listen=(f"tcp/127.0.0.1:{port}",), connect=connect, mode=mode))
    assert re.fullmatch(rf"cannot listen at tcp/127\.0\.0\.1:{port}: .*in use.*another endpoint.*", str(caught.value))


@pytest.mark.parametrize("option", ["connect", "listen"])
def test_plain_endpoint_beside_certificates_is_refused_with_the_one_to_give(option, tmp_path: Path):
    (tmp_path / "a.json5").write_text("{mode: 'router', transport: {link: {protocols: ['tls']}}}")
    settings = {option: ("tcp/127.0.0.1:7447",), "config": tmp_path / "a.json5"}
    with pytest.raises(SettingsError, match=rf"--{option} is tcp/.* allows only tls: give tls/127.0.0.1:7447, or"):
        Node(Connection(**settings))


def test_failed_connection_is_not_reported_as_failed_listening():
    listen = (f"tcp/127.0.0.1:{find_free_port()}",)
    with pytest.raises(SettingsError, match="is a router running there"):
        Node(Connection(connect=("tcp/127.0.0.1:1",), listen=listen))


def test_configuration_may_come_through_a_pipe():
    end, other = os.pipe()
    os.write(other, b'{mode: "client"}')
    os.close(other)
    assert _read(_make_config(Connection(config=Path(f"/dev/fd/{end}"))), "mode") == "client"
    os.close(end)


def test_command_line_overrides_configuration_file(tmp_path: Path):
    file = tmp_path / "node.json5"
    file.write_text('{mode: "client", /* the depot */ connect: {endpoints: ["tcp/127.0.0.1:1"]}}')
    with pytest.raises(SettingsError, match=r"127\.0\.0\.1:1\D"):
        Node(Connection(config=file))
    with router() as (_, endpoint), Node(Connection(config=file, connect=(endpoint,))) as client:
        assert client.endpoints == []


def test_client_without_endpoints_joins_loopback():
    assert _read(_make_config(Connection(mode="client")), "connect/endpoints") == [LOOPBACK]


SECURED = '{access_control: {enabled: %s, default_permission: "%s"}, transport: {link: {tls: {enable_mtls: %s}}}}'


@pytest.mark.parametrize(
    ("listen", "settings", "warns"),
    [
        ("tcp/127.0.0.1:7447", None, False),
        ("tcp/[::1]:7447", None, False),
        ("tcp/localhost:7447", None, False),
        ("unixsock-stream//tmp/socast", None, False),
        ("tcp/0.0.0.0:7447", None, True),
        ("tcp/[::]:7447#iface=eth0", None, True),
        ("tcp/10.0.0.5:7447", None, True),
        ("tls/router.example:7447", None, True),
        ("tls/router.example:7447", SECURED % ("true", "deny", "true"), False),
        ("tls/router.example:7447", SECURED % ("true", "deny", "false"), True),
        ("tls/router.example:7447", SECURED % ("true", "allow", "true"), True),
        ("tls/router.example:7447", SECURED % ("false", "deny", "true"), True),
        ("tcp/10.0.0.5:7447", SECURED % ("true", "deny", "true"), True),
    ],
)
def test_listening_beyond_loopback_without_security_warns_once(tmp_path, caplog, listen, settings, warns):
    file = tmp_path / "node.json5" if settings else None
    if file:
        file.write_text(settings)
    _warn_if_open(_make_config(Connection(listen=(listen,), config=file)))
    assert len(caplog.records) == warns
    if warns:
        assert listen in caplog.text
        assert "`socast secure init`" in caplog.text


def test_node_that_listens_beyond_loopback_warns(caplog):
    with Node(Connection(listen=("tcp/0.0.0.0:0",))):
        pass
    (record,) = caplog.records
    assert "anybody who reaches tcp/0.0.0.0:" in record.message
