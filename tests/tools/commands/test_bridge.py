"""`socast bridge` passes signals on as telemetry; wrong calls are one line."""

import json
import os
import signal
import subprocess
import sys

import pytest

from socast.core.errors import SettingsError
from socast.tools.commands.bridge import PASSWORD, parse_models, read_password
from tests.support.commands import refused
from tests.support.mqtt_broker import needs_mosquitto
from tests.support.mqtt_outage import run_outage, wait_for_line
from tests.support.paths import ROOT
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


@needs_mosquitto
def test_restart_of_the_broker_loses_nothing_that_it_had_acknowledged(tmp_path):
    outcome = run_outage(cars=30, minutes=4.0, speed=60.0, folder=tmp_path)
    assert outcome.lost == []
    assert outcome.acknowledged == 30 * 24 * 7
    assert outcome.bridge["source.disconnections"] == 1
    assert outcome.bridge["vehicles"] == 30


def test_vss_signals_of_a_car_arrive_as_telemetry_and_the_end_is_logged():
    with RouterProcess() as router, router.join() as node:
        rows: list[dict] = []
        telemetry = node.session.declare_subscriber(
            "depot/fleet/*/*", lambda sample: rows.append(json.loads(sample.payload.to_bytes()))
        )
        options = ["--connect", router.endpoint, "--prefix", "depot", "--from-prefix", "cars", "--model", "bmw-i3-2014"]
        command = [sys.executable, "-m", "socast", "bridge", "vss", "--json-log", "--report", "0.2", *options]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as bridge:
            wait_for_line(bridge, '"counters"')

            def publish() -> bool:
                for path, value in (("Speed", "50"), ("Powertrain/TractionBattery/CurrentCurrent", "-20")):
                    node.session.put(f"cars/taxi-7/Vehicle/{path}", value)
                return len(rows) > 1

            assert eventually(publish)
            bridge.send_signal(signal.SIGTERM)
            log = [json.loads(line) for line in bridge.communicate(timeout=60)[1].splitlines()]
        telemetry.undeclare()
    assert bridge.returncode == 0
    end = log[-1]
    assert (end["event"], end["vehicles"]) == ("bridge ends", 1)
    assert end["source.messages"] > 1
    assert rows[0]["model"] == "bmw-i3-2014"
    assert {"vehicle_id": "taxi-7", "speed_kmh": 50.0, "battery_current_a": 20.0}.items() <= rows[-1].items()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--broker", "localhost"], "write mqtt://HOST:PORT"),
        (["--broker", "mqtt://u:p@localhost"], "--broker holds a user or password"),
        (["--broker", "mqtt://a", "--key", "a.pem"], "which uses no TLS; write mqtts://"),
        (["--broker", "mqtt://a", "--topics", "x/#"], "give plain levels such as ovms"),
        (["--broker", "mqtt://a", "--model", "horse"], "--model names horse"),
        (["--broker", "mqtt://a", "--password-file", "none"], "none cannot be read: no such file or directory"),
        (["--broker", "mqtt://a", "--period", "0"], "period"),
    ],
)
def test_wrong_call_is_one_line_before_a_router_is_joined(capsys, options, words):
    assert words in refused(capsys, "bridge", "ovms", "--connect", "tcp/127.0.0.1:1", *options)


def test_router_that_does_not_run_is_one_line(capsys):
    assert "Zenoh cannot be joined" in refused(capsys, "bridge", "vss", "--connect", "tcp/127.0.0.1:1")


def test_password_comes_from_a_file_or_the_environment(tmp_path):
    file = tmp_path / "secret"
    file.write_text("right\nrest\n", encoding="utf-8")
    assert read_password(file, {PASSWORD: "other"}) == "right"
    assert read_password(None, {PASSWORD: "other"}) == "other"
    assert read_password(None, {}) is None
    file.write_text("\n", encoding="utf-8")
    with pytest.raises(SettingsError, match="is empty; write the password into its first line"):
        read_password(file, os.environ)


def test_car_with_two_models_is_refused():
    assert parse_models(["a=bmw-i3-2014", "tesla-model-s"]) == {"a": "bmw-i3-2014", "*": "tesla-model-s"}
    with pytest.raises(SettingsError, match="--model gives a two models"):
        parse_models(["a=bmw-i3-2014", "a=tesla-model-s"])
