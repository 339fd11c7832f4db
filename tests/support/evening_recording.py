"""Write `recordings/evening.mcap`: an evening shift of the demonstration's cars, one of which has a dragging brake.

The brake drags since `SINCE`. The nightly diagnosis of the mornings before finds it and publishes the finding during
the shift. The car with the drag comes from a simulation of the same fleet in which that effect is hidden in all cars.

Run `python -m tests.support.evening_recording` from the folder of the project.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import chdir
from datetime import UTC, datetime
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any, Final

from socast.core.diagnose.findings import make_finding_message
from socast.core.files import replacing
from socast.core.wire.messages import Message, address
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.cli import main
from socast.tools.terminal.night_watch import read_findings
from tests.support.paths import RECORDINGS

CAR, EFFECT, SIZE = "taxi-006", "brake_drag", 0.12
"""Car whose brake drags, and the share of the energy that this takes."""
SINCE: Final = datetime(2018, 1, 2, tzinfo=UTC)
"""When the brake begins to drag."""
NIGHT_S: Final = datetime(2018, 1, 18, 0, 4, tzinfo=UTC).timestamp()
"""When the nightly diagnosis has ended, four minutes after midnight UTC. [Unix s]"""
FLEET: Final = ("--vehicles", "7", "--seed", "24")
MORNINGS: Final = (
    *("--start", "2017-12-09T12:00", "--days", "40", "--shift-hours", "1.5"),
    *("--faults", "none,quantised=1,gps_noise=3,jitter=0.5"),
)
EVENING: Final = (
    *("--start", "2018-01-17T20:00", "--shift-hours", "6", "--charging", "night", "--faults", "errand=0"),
)


def write_evening(target: Path) -> None:
    """Simulate, diagnose and write the recording and its truth."""
    with TemporaryDirectory() as temporary, chdir(temporary):  # so that the finding names commands without a folder
        folder = Path()
        _write(folder / "kept.mcap", _simulate("morning", MORNINGS))
        copyfile(RECORDINGS / "fitted.json", "base.json")
        for _ in range(2):  # a finding is proposed first, and sure when a second diagnosis confirms it
            _run("diagnose", "kept.mcap", "--model", "base.json", "--findings", "findings.json")
        found = [one for one in read_findings(folder / "findings.json") if one.who == CAR and one.status == "sure"]
        at_night = [make_finding_message(one)._replace(receipt_ns=round(NIGHT_S * 1e9)) for one in found]
        if not at_night:
            raise SystemExit(f"the diagnosis of the mornings is not sure about {CAR}")
        _write(target, [*_simulate("evening", EVENING), *at_night])
        _write_truth(target.with_suffix(".truth.json"))


def _run(*words: Any) -> None:
    """Run a command of `socast`."""
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        if end.code:
            raise


def _simulate(name: str, options: Sequence[str]) -> Iterator[Message]:
    """Yield the messages of a fleet in which the brake of one car begins to drag."""
    healthy, dragging = Path(f"{name}.mcap"), Path(f"{name}-dragging.mcap")
    _run("simulate", "--out", healthy, *FLEET, *options)
    _run("simulate", "--out", dragging, *FLEET, *options, "--hidden", f"{EFFECT}:{SIZE}")
    for path in healthy, dragging:
        for block in McapSource(path):
            for message in block:
                is_late = message.receipt_ns >= SINCE.timestamp() * 1e9
                if (is_late and _is_of_car(message)) == (path == dragging):
                    yield message


def _is_of_car(message: Message) -> bool:
    """Return whether a message is of the car whose brake drags."""
    return (where := address(message.key)) is not None and where.identity == CAR


def _write(path: Path, messages: Iterator[Message] | list[Message]) -> None:
    """Write messages as a recording, in order of receipt."""
    with replacing(path) as temporary, McapSink(temporary) as sink:
        sink.put(sorted(messages, key=lambda message: message.receipt_ns))


def _write_truth(path: Path) -> None:
    """Write what was planted, the parameters of the cars, and the rides of the evening."""
    healthy, dragging = (
        json.loads(Path(f"evening{which}.truth.json").read_text(encoding="utf-8")) for which in ("", "-dragging")
    )
    rides = [ride for ride in healthy["rides"] if ride["vehicle_id"] != CAR]
    rides += [ride for ride in dragging["rides"] if ride["vehicle_id"] == CAR]
    used = {effect: sum(ride.get("hidden_kwh", {}).get(effect, 0.0) for ride in rides) for effect in (EFFECT,)}
    planted = {"vehicle_id": CAR, "effect": EFFECT, "since": SINCE.date().isoformat(), "energy_kwh": used[EFFECT]}
    blocks = [f'"planted": {json.dumps(planted)}', f'"cars": {json.dumps(healthy["cars"])}']
    lines = ",\n".join(json.dumps(ride) for ride in sorted(rides, key=lambda ride: ride["start_s"]))
    with replacing(path) as temporary:
        temporary.write_text("{" + ",\n".join([*blocks, f'"rides": [\n{lines}\n]']) + "}\n", encoding="utf-8")


if __name__ == "__main__":
    write_evening(RECORDINGS / "evening.mcap")
