"""A broker keeps what was not acknowledged; wrong addresses and credentials are one line."""

import subprocess
from dataclasses import replace

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from socast.core.errors import SettingsError
from socast.stream.mqtt_source import Broker, MqttSource, parse_broker
from socast.stream.zenoh_session import find_free_port
from socast.tools.security.certificates import Authority, now_utc
from tests.support.mqtt_broker import MqttBroker, needs_mosquitto
from tests.support.zenoh_sessions import eventually


@pytest.fixture
def broker(tmp_path):
    with MqttBroker(tmp_path) as running:
        yield running


def publish(broker, *texts, retain=False):
    """Publish texts with QoS 1, and wait until the broker has acknowledged them."""
    client = Client(CallbackAPIVersion.VERSION2, "publisher")
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    for text in texts:
        client.publish("a/b", text, qos=1, retain=retain).wait_for_publish(60)
    client.disconnect()
    client.loop_stop()


def take(source, number):
    """Return so many messages."""
    messages = []
    assert eventually(lambda: len(messages) >= number or messages.extend(source.take(0.1)))
    return messages


@needs_mosquitto
def test_message_that_was_not_acknowledged_comes_again_in_the_next_session(broker):
    with MqttSource(Broker(broker.url), ["a/+"]) as source:
        publish(broker, "one", "two")
        first, _ = take(source, 2)
        source.acknowledge([first.ticket])
        assert source.unacknowledged == 1
    publish(broker, "three")
    with MqttSource(Broker(broker.url), ["a/+"]) as source:
        messages = take(source, 2)
        assert [message.payload for message in messages] == [b"two", b"three"]
        assert source.counts["again"] == 1


@needs_mosquitto
def test_acknowledgement_of_a_lost_connection_is_left_out_and_nothing_is_lost(broker):
    with MqttSource(Broker(broker.url), ["a/+"]) as source:
        publish(broker, "one")
        (message,) = take(source, 1)
        broker.stop()
        assert eventually(lambda: source.counts["disconnections"] == 1)
        source.acknowledge([message.ticket])
        broker.start()
        (again,) = take(source, 1)
        assert (again.payload, source.counts["too_late"], source.counts["connections"]) == (b"one", 1, 2)
        assert again.connection != message.connection
        source.acknowledge([again.ticket])
    with MqttSource(Broker(broker.url), ["a/+"]) as source:
        assert source.take(0.5) == []


@needs_mosquitto
def test_retained_message_is_marked(broker):
    publish(broker, "old", retain=True)
    with MqttSource(Broker(broker.url), ["a/+"]) as source:
        (message,) = take(source, 1)
        assert message.is_retained
        publish(broker, "new", retain=True)
        (message,) = take(source, 1)
        assert not message.is_retained


@needs_mosquitto
def test_wrong_password_is_refused_in_one_line(tmp_path):
    secrets = tmp_path / "secrets"
    subprocess.run(["mosquitto_passwd", "-b", "-c", secrets, "fleet", "right"], check=True, capture_output=True)
    with MqttBroker(tmp_path, f"allow_anonymous false\npassword_file {secrets}") as broker:
        MqttSource(Broker(broker.url, user="fleet", password="right"), ["a"]).close()
        with pytest.raises(SettingsError, match=r"refuses the connection: .*check user, password"):
            MqttSource(Broker(broker.url, user="fleet", password="wrong"), ["a"])


@needs_mosquitto
def test_tls_checks_the_broker_and_shows_it_a_certificate(tmp_path):
    now = now_utc()
    authority, own = Authority.create(now)
    _, foreign = Authority.create(now)
    files = {"ca": own, "other": foreign, "client": authority.issue("bridge", 1, now, 30.0)}
    files["broker"] = authority.issue("router", 1, now, 30.0, ["127.0.0.1"])
    for name, credential in files.items():
        (tmp_path / f"{name}.pem").write_text(credential.certificate, encoding="utf-8")
        (tmp_path / f"{name}.key").write_text(credential.key, encoding="utf-8")
    settings = (
        f"allow_anonymous true\ncafile {tmp_path}/ca.pem\ncertfile {tmp_path}/broker.pem\n"
        f"keyfile {tmp_path}/broker.key\nrequire_certificate true"
    )
    with MqttBroker(tmp_path, settings) as broker:
        url = broker.url.replace("mqtt:", "mqtts:")
        known = Broker(url, authority=tmp_path / "ca.pem")
        shown = replace(known, certificate=tmp_path / "client.pem", key=tmp_path / "client.key")
        MqttSource(shown, ["a"]).close()
        with pytest.raises(SettingsError, match="certificate verify failed"):
            MqttSource(replace(shown, authority=tmp_path / "other.pem"), ["a"])
        with pytest.raises(SettingsError, match=r"no broker answers|it ends the connection"):
            MqttSource(known, ["a"])


def test_broker_that_does_not_run_is_one_line():
    with pytest.raises(SettingsError, match=r"no broker answers at mqtt://127\.0\.0\.1:.*start it"):
        MqttSource(Broker(f"mqtt://127.0.0.1:{find_free_port()}"), ["a"])


@pytest.mark.parametrize(
    "url", ["localhost", "http://a", "mqtt://", "mqtt://a:b", "mqtt://a:1/b", "mqtt://[", "mqtt://a:99999"]
)
def test_wrong_address_is_one_line(url):
    with pytest.raises(SettingsError, match=r"--broker is .*write mqtt://HOST:PORT"):
        parse_broker(url)


def test_password_in_the_address_is_refused_and_not_repeated():
    with pytest.raises(SettingsError, match="--password-file") as error:
        parse_broker("mqtt://fleet:hunter2@broker.example")
    assert "hunter2" not in str(error.value)


def test_files_of_tls_that_cannot_be_read_are_one_line(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.pem cannot be read"):
        MqttSource(Broker("mqtts://127.0.0.1", authority=tmp_path / "none.pem"), ["a"])
    with pytest.raises(SettingsError, match="which uses no TLS"):
        MqttSource(Broker("mqtt://127.0.0.1", authority=tmp_path / "none.pem"), ["a"])
    with pytest.raises(SettingsError, match="give --certificate FILE too"):
        MqttSource(Broker("mqtts://127.0.0.1", key=tmp_path / "none.pem"), ["a"])
