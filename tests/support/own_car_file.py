"""Make the file of the tutorial of one's own car: `python -m tests.support.own_car_file` writes it and its truth.

The same drives are simulated twice, without and with a hidden effect. The file holds the first ones before a date and
the second ones from it on, and of each sample only its time, speed and power. The physics of the simulation is richer
than that of the model that the tutorial fits.
"""

import json
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import msgspec

from socast.core.wire.messages import Telemetry
from socast.stream.mcap_reader import McapSource
from tests.support.commands import done
from tests.support.paths import ROOT

FILE: Final = ROOT / "recordings" / "commuter.csv"
TRUTH: Final = FILE.with_suffix(".truth.json")
SINCE: Final = "2019-06-19"
HIDDEN: Final = "standby"
STANDBY: Final = 100.0
"""Power of the hidden effect at natural size. [W]"""
SHARE: Final = 0.1
"""Share of the energy that the effect has when it is on. [1]"""
OPTIONS: Final = (
    "--vehicles 1 --models nissan-leaf-2016 --days 36 --start 2019-06-01 --shift-hours 1 --faults none --seed 3 "
    "--phenomena plain,payload,speed_rolling,motor_map,regen_limit,battery_resistance,headwind,air_density,cornering,"
    "brake_drag,-climate,-hills"
)


def read_lines(recording: Path) -> list[str]:
    """Return the lines of a recording's samples in rides, as a simple logger would write them."""
    decode = msgspec.json.Decoder(Telemetry).decode
    samples = [decode(m.payload) for block in McapSource(recording) for m in block if m.key.endswith("/telemetry")]
    lines = []
    for sample in sorted(samples, key=lambda each: each.time_s):
        speed, voltage, current = sample.speed_kmh, sample.battery_voltage_v, sample.battery_current_a
        if sample.ride_id is not None and None not in {speed, voltage, current}:
            stamp = f"{datetime.fromtimestamp(round(sample.time_s), UTC):%Y-%m-%d %H:%M:%S}"
            lines.append(f"{stamp},{speed:.1f},{(voltage or 0) * (current or 0) / 1000:.2f}")
    return lines


def main() -> None:
    """Simulate the drives, and write the file and its truth."""
    with TemporaryDirectory() as name:
        plain, other = Path(name) / "plain.mcap", Path(name) / "other.mcap"
        done("simulate", "--out", plain, *OPTIONS.split())
        done("simulate", "--out", other, *OPTIONS.split(), "--hidden", f"{HIDDEN}:{SHARE}")
        before = [line for line in read_lines(plain) if line < SINCE]
        after = [line for line in read_lines(other) if line >= SINCE]
        hidden = json.loads(other.with_suffix(".truth.json").read_text(encoding="utf-8"))["total"]["hidden"]
    FILE.write_text("\n".join(["time,speed_kmh,power_kw", *before, *after]) + "\n", encoding="utf-8")
    truth = {"since": SINCE, "effect": HIDDEN, **hidden[HIDDEN]}
    TRUTH.write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
    print(f"{FILE.name}: {len(before) + len(after):,} rows")


if __name__ == "__main__":
    main()
