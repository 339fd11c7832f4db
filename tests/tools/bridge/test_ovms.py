"""Metrics of OVMS modules are read with their units and signs; what cannot be read is counted by cause."""

import json

import pytest

from socast.core.errors import SettingsError
from socast.stream.mqtt_source import MqttMessage, Ticket
from socast.tools.bridge.ovms import METRICS, OvmsReader, OvmsSource, parse_topic_prefix
from socast.tools.bridge.row_assembler import RowAssembler

NOW = 1_700_000_000.0


@pytest.fixture
def assembler():
    return RowAssembler()


def read(reader, name, text, *, at=0.0, user="me", car="DEMO", retained=False, connection=0):
    """Give a reader a metric."""
    topic = f"ovms/{user}/{car}/metric/{name}"
    reader.read(MqttMessage(topic, text.encode(), NOW + at, retained, connection, Ticket(1, connection)))


def rows(assembler):
    assembler.close_due()
    return [json.loads(message.payload) for message in assembler.pop()[0]]


def test_burst_of_a_module_becomes_a_sample_of_the_contract(assembler):
    reader = OvmsReader(assembler)
    burst = {
        "m/time/utc": "2023-11-14 22:13:10 UTC",
        "v/b/current": "12.5",
        "v/b/power": "4.4",
        "v/b/soc": "96.3",
        "v/b/temp": "13",
        "v/b/voltage": "357.4",
        "v/c/charging": "no",
        "v/e/temp": "-4.5",
        "v/p/altitude": "327.8",
        "v/p/gpslock": "yes",
        "v/p/gpsspeed": "48.1",
        "v/p/latitude": "51.302300",
        "v/p/longitude": "7.390060",
        "v/p/odometer": "57913.1",
        "v/p/speed": "49.5",
    }
    for name, text in burst.items():
        read(reader, name, text)
    assert rows(assembler) == [
        {
            "vehicle_id": "DEMO",
            "time_s": 1_699_999_990.0,
            "seq": 0,
            "latitude_deg": 51.3023,
            "longitude_deg": 7.39006,
            "elevation_m": 327.8,
            "speed_kmh": 49.5,
            "odometer_km": 57913.1,
            "soc_pct": 96.3,
            "battery_voltage_v": 357.4,
            "battery_current_a": 12.5,
            "battery_temperature_c": 13.0,
            "ambient_c": -4.5,
            "charging": False,
        }
    ]


def test_metrics_are_those_that_the_reader_subscribes_to(assembler):
    topics = OvmsReader(assembler, "/fleet/one/").list_topics()
    assert {f"fleet/one/+/+/metric/{name}" for name in METRICS} <= set(topics)
    assert len(topics) == len(METRICS) + 2


@pytest.mark.parametrize(
    ("name", "text", "cause"),
    [
        ("v/b/soc", "full", "bad_value"),
        ("v/b/soc", "nan", "bad_value"),
        ("v/b/soc", "1e400", "bad_value"),
        ("v/b/soc", "", "undefined"),
        ("v/b/soc", "9" * 5000, "bad_value"),
        ("v/c/charging", "perhaps", "bad_value"),
        ("v/z/other", "1", "bad_value"),
        ("m/time/utc", "soon", "bad_value"),
        ("m/time/utc", "1970-01-01 00:01:00 UTC", "bad_time"),
    ],
)
def test_value_that_cannot_be_read_is_counted_and_released(assembler, name, text, cause):
    read(OvmsReader(assembler), name, text)
    assert assembler.counts == {cause: 1}
    assert assembler.pop() == ([], [Ticket(1, 0)])


@pytest.mark.parametrize("topic", ["", "ovms", "ovms/me", "ovms/me/car/v/b/soc", "other/me/car/metric/v/b/soc"])
def test_topic_of_another_form_is_counted(assembler, topic):
    OvmsReader(assembler).read(MqttMessage(topic, b"1", NOW, False, 0, None))
    assert assembler.counts == {"bad_topic": 1}


def test_retained_value_is_of_unknown_age_and_left_out(assembler):
    read(OvmsReader(assembler), "v/p/speed", "90", retained=True)
    assert assembler.counts == {"stale": 1}


def test_second_user_with_a_car_of_the_same_name_is_left_out(assembler):
    reader = OvmsReader(assembler)
    read(reader, "v/b/soc", "50")
    read(reader, "v/b/soc", "70", user="other")
    assert [row["soc_pct"] for row in rows(assembler)] == [50.0]
    assert assembler.counts["same_name"] == 1


def test_module_that_has_gone_leaves_no_held_values(assembler):
    reader = OvmsReader(assembler)
    read(reader, "v/p/speed", "50")
    read(reader, "s/v3/connected", "no", at=1.0)
    read(reader, "v/b/soc", "50", at=2.0)
    assert ["speed_kmh" in row for row in rows(assembler)] == [True, False]


def test_backlog_after_a_reconnection_keeps_the_times_of_the_module(assembler):
    reader = OvmsReader(assembler)
    read(reader, "m/time/utc", "2023-11-14 22:13:20 UTC")
    read(reader, "v/p/speed", "50")
    assembler.close_due()
    for step in (20, 25, 30):
        if step > 20:
            read(reader, "m/time/utc", f"2023-11-14 22:13:{step} UTC", at=600.0, connection=2)
        read(reader, "v/p/odometer", f"{step}", at=600.0, connection=2)
    assert [(row["time_s"] - NOW, row.get("odometer_km")) for row in rows(assembler)] == [
        (0.0, None),
        (0.0, 20.0),
        (5.0, 25.0),
        (10.0, 30.0),
    ]


@pytest.mark.parametrize("text", ["a/#", "+/b", "a//b"])
def test_topics_with_wildcards_are_refused_in_one_line(text):
    with pytest.raises(SettingsError, match=r"--topics is .*give plain levels"):
        parse_topic_prefix(text)


class Window:
    """A source whose broker sends so many messages before it waits for acknowledgements."""

    def __init__(self, messages, window):
        self.unacknowledged = 0
        self.counts = {}
        self._messages, self._window = messages, window

    def take(self, _):
        number = self._window - self.unacknowledged
        taken, self._messages = self._messages[:number], self._messages[number:]
        self.unacknowledged += len(taken)
        return taken

    def acknowledge(self, tickets):
        self.unacknowledged -= len(tickets)


def test_broker_that_waits_for_acknowledgements_gets_them_and_is_named_in_the_log(assembler, caplog):
    topic = "ovms/me/car-{}/metric/v/b/soc"
    messages = [MqttMessage(topic.format(at), b"50", NOW, False, 0, Ticket(at, 0)) for at in range(2500)]
    window = Window(messages, 20)
    source = OvmsSource(window, OvmsReader(assembler))
    rows_seen = 0
    for _ in range(400):
        source.feed(0.0)
        if source.is_stalled():
            assembler.close_due()
        done, tickets = assembler.pop()
        source.acknowledge(tickets)
        rows_seen += len(done)
    assert rows_seen == 2500
    assert caplog.text.count("max_inflight_messages") == 1
