"""Test that the scanner of usual samples changes no result: it decodes as `msgspec` does, to the bit, or not at all."""

import json
from random import Random

import numpy as np
import pytest

from socast.core.batch import Lanes
from socast.core.wire.decoder import Decoder
from socast.core.wire.json_scanner import JsonScanner, read_each_time
from socast.core.wire.message_block import PADDING, MessageBlock, MessageColumns
from socast.core.wire.messages import Message, Telemetry, encode
from socast.core.wire.name_lookup import NameLookup

CARS = "a", "taxi-7", "x" * 64
FIELDS = Telemetry.__struct_fields__
USUAL = {
    "vehicle_id": '"a"', "time_s": "1767600000.125", "ride_id": '"r-1"', "seq": "7", "latitude_deg": "45.5",
    "longitude_deg": "-73.612345", "elevation_m": "40", "speed_kmh": "0", "odometer_km": "12345.6", "soc_pct": "55.5",
    "battery_voltage_v": "360.0", "battery_current_a": "-20.5", "battery_temperature_c": "-0.0", "ambient_c": "-8.0",
    "hvac_w": "500", "occupants": "2", "charging": "false",
}  # fmt: skip
ODD = (
    *("null", "true", "false", "nul", "NaN", "-Infinity", "[]", "{}", '""', '"a"', '"r-2"', '"r\\u002d1"', '"é"', '"x'),
    *("0", "-0", "-0.0", "00", "01", "1.", ".5", "+1", "-", "1e2", "1E-2", "1e400", "-1e400", "1e-400", "5e-324"),
    *("9007199254740992", "9007199254740993", "9007199254740993.0", "18446744073709551616", "1" * 400, "-5", "1.0"),
    *("0.1234567890123456789", "123456789012345678", "1234567890123456789", f"0.{0:017}1", f"0.{0:030}1"),
    *("1767600000.1234567", "0.30000000000000004", "900719925474099.1", "9.007199254740993", "2.5 ", " 2.5", "2 .5"),
    f'"{"y" * 256}"', f'"{"y" * 257}"', f'"{"z" * 64}"', f'"{"z" * 65}"', '"\x00"', '"\t"', '"\x7f"', '"\\""',
)  # fmt: skip
BLANKS = ("", "", "", " ", "\n", "\t\r ", "\x0b", "\x00")
NAMES = (*FIELDS, *FIELDS, "unknown", "time_s\\u0000", "TIME_S")


def make_payload(rng: Random, car: str = "a") -> bytes:
    """Return the bytes of a sample, mostly of a car, that is more or less usual; about half are scanned."""
    odd = rng.choice((0.0, 0.0, 0.1, 0.5, 1.0))
    if rng.random() < 0.8:
        names = rng.sample(FIELDS[2:], rng.randrange(len(FIELDS) - 1))
    else:
        names = [rng.choice(NAMES) for _ in range(rng.randrange(21))]
    values = [(name, rng.choice(ODD) if rng.random() < odd else USUAL.get(name, "1")) for name in names]
    named = json.dumps(car if rng.random() < 0.9 else rng.choice((*CARS, "b")))
    members = [("vehicle_id", named), ("time_s", rng.choice(("1.5", "1767600000.125"))), *values]
    if rng.random() < 0.5:
        rng.shuffle(members)
    before, blank, after = (rng.choice(BLANKS) if rng.random() < 0.3 else "" for _ in range(3))
    text = ",".join(f'{blank}"{name}"{blank}:{value}' for name, value in members)
    whole = f"{before}{{{text}{blank}}}{after}".encode()
    shape = rng.choice(["whole"] * 8 + ["cut", "list", "other byte"])
    if shape == "list":
        return b"[" + whole + b"," + whole + b"]"
    at = rng.randrange(len(whole))
    if shape == "other byte":
        return whole[:at] + bytes([rng.randrange(256)]) + whole[at + 1 :]
    return whole[:at] if shape == "cut" else whole


def make_message(rng: Random, car: str) -> Message:
    """Return a message with such a sample under the key of the car."""
    return Message(f"fleet/{car}/telemetry", make_payload(rng, car), 0)


class BlindScanner(JsonScanner):
    """Scan nothing."""

    def scan(self, messages, lanes):
        return super().scan(messages, np.full_like(lanes, -1))


def scan_payloads(lanes, payloads):
    """Scan samples of the first car."""
    messages = MessageBlock.of([Message("fleet/a/telemetry", payload, 0) for payload in payloads])
    return JsonScanner(NameLookup(lanes)).scan(messages, np.zeros(len(payloads), np.int64))


def decode_all(scanner, lists):
    """Decode lists of messages with a kind of scanner; return all that the decoder gave and its state."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("socast.core.wire.decoder.JsonScanner", scanner)
        decoder = Decoder(Lanes())
    out = []
    for messages in lists:
        batch, events = decoder.decode(messages, refusals := [])
        out.append(([column.tobytes() for column in batch], events, refusals))
        if len(decoder.rides) > 3:
            decoder.rides.keep(set(batch.ride[-1:].tolist()))
    return out, decoder.dump(), decoder.lanes.dump()


@pytest.mark.parametrize("seed", range(10))
def test_scanner_gives_the_same_bits_and_counts_as_msgspec(seed):
    rng = Random(seed)
    known = [Message(f"fleet/{car}/telemetry", encode(Telemetry(car, 1.0)), 0) for car in CARS]
    for _ in range(60):
        made = [[make_message(rng, rng.choice(CARS)) for _ in range(rng.randrange(9))] for _ in range(rng.randrange(5))]
        assert decode_all(JsonScanner, [known, *made]) == decode_all(BlindScanner, [known, *made])


def test_numbers_of_up_to_15_digits_are_scanned_to_the_bit():
    rng = np.random.default_rng(5)
    decoder = Decoder(Lanes())
    decoder.decode([Message("fleet/a/telemetry", b'{"vehicle_id":"a","time_s":1}', 0)])
    values = rng.integers(-(10**15), 10**15, 5000) / 10.0 ** rng.integers(0, 12, 5000)
    texts = [f"{value:.{places}f}" for value, places in zip(values, rng.integers(0, 9, 5000), strict=True)]
    texts = [text for text in texts if sum(map(str.isdigit, text)) <= 15 and float(text)]
    payloads = [b'{"vehicle_id":"a","time_s":1,"elevation_m":%s}' % text.encode() for text in texts]
    scan = scan_payloads(decoder.lanes, payloads)
    assert scan.is_scanned.all()
    batch, _ = decoder.decode([Message("fleet/a/telemetry", payload, 0) for payload in payloads])
    assert batch.elevation.tolist() == [float(text) for text in texts]


def test_usual_samples_of_known_vehicles_are_scanned():
    lanes = Lanes(["a"])
    payloads = [encode(Telemetry("a", 3.0 * i, ride_id="r", speed_kmh=12.3)) for i in range(5)]
    payloads.append(json.dumps({"vehicle_id": "a", "time_s": 15.25, "charging": True, "seq": None}).encode())
    scan = scan_payloads(lanes, payloads)
    assert scan.is_scanned.all()
    assert scan.list_pending() == [(0, "r")]
    assert scan.first[:5].tolist() == [0] * 5


def test_rides_that_alternate_within_a_block_have_the_codes_of_their_names():
    known = [Message(f"fleet/{car}/telemetry", encode(Telemetry(car, 1.0)), 0) for car in "ab"]
    rides = [
        ("a", "x"),
        ("a", "x"),
        ("b", "x"),
        ("a", "y"),
        ("b", "x"),
        ("a", "x"),
        ("a", None),
        ("a", "x"),
        ("b", "z"),
    ]
    sent = [Message(f"fleet/{car}/telemetry", encode(Telemetry(car, 2.0, ride_id=ride)), 0) for car, ride in rides]
    decoder = Decoder(Lanes())
    decoder.decode(known)
    for _ in range(2):
        batch, _ = decoder.decode(sent)
        assert decoder.rides.names(batch.ride.tolist()) == [ride for _, ride in rides]
    assert decode_all(JsonScanner, [known, sent, sent[::-1]]) == decode_all(BlindScanner, [known, sent, sent[::-1]])


def test_ride_of_the_sample_before_needs_no_name_until_codes_change():
    decoder = Decoder(Lanes())
    for ride in "xy":
        decoder.decode([Message("fleet/a/telemetry", encode(Telemetry("a", 1.0, ride_id=ride)), 0)] * 2)
    decoder.rides.keep(set())
    batch, _ = decoder.decode([Message("fleet/a/telemetry", encode(Telemetry("a", 2.0, ride_id="y")), 0)])
    assert decoder.rides.names(batch.ride.tolist()) == ["y"]


@pytest.mark.parametrize("seed", range(10))
def test_times_are_those_of_msgspec_to_the_bit(seed):
    rng = Random(seed)
    for _ in range(100):
        payloads = [make_payload(rng) for _ in range(rng.randrange(1, 9))]
        block = MessageBlock.of([Message("k", payload, 0) for payload in payloads])
        with pytest.MonkeyPatch.context() as patch:
            times = read_each_time(block)
            patch.setattr("socast.core.wire.json_scanner._scan_times", lambda *_: None)
            assert times.tobytes() == read_each_time(block).tobytes()


def test_times_of_usual_samples_are_scanned(monkeypatch):
    monkeypatch.setattr("socast.core.wire.json_scanner.read_time", lambda _: pytest.fail("was not scanned"))
    block = MessageBlock.of([Message("k", encode(Telemetry("a", time_s, soc_pct=50.0)), 0) for time_s in (1.5, 3.25)])
    assert read_each_time(block).tolist() == [1.5, 3.25]


@pytest.mark.parametrize("rest", [b" ", b"\n", b"0", b'"', b"}", b'"seq":7}', b"l}", b"y" * 300])
def test_bytes_after_a_payload_are_no_part_of_it(rest):
    lanes, rng = Lanes(["a"]), Random(3)
    for _ in range(100):
        payload, cut = make_payload(rng), []
        for after in (b"\0", rest):
            text = np.frombuffer(payload + after + bytes(PADDING), np.uint8)
            zero = np.zeros(1, np.int64)
            one = MessageBlock(MessageColumns(["fleet/a/telemetry"], zero, text, zero, zero + len(payload)))
            scan = JsonScanner(NameLookup(lanes)).scan(one, np.zeros(1, np.int64))
            cut.append((scan.is_scanned.tolist(), scan.table.tobytes() if scan.is_scanned[0] else b""))
        assert cut[0] == cut[1]
