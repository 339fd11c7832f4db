"""Compile the numba kernels once after installation, and report the progress.

The kernels are compiled by running a few made-up messages through every step. The cache beside the sources keeps them,
so that a later start loads them in a fraction of a second. `make` runs this module after the installation; without
that, the first command that needs the kernels compiles them.

The kernel of the cleaning takes half of the time. With two processors or more, another process compiles it, and this
one first compiles what does not need its result.
"""

import argparse
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

from socast.core.batch import NO_RIDE, Batch, Lanes
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_smoother import smooth_elevation
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.silences import FleetSilences, select_inputs
from socast.core.condition.level_model import CONSUMPTION, Series, estimate_wandering, smooth_levels
from socast.core.condition.step_mixture import mix_shocks
from socast.core.models import EXTENDED_PHYSICAL, Model
from socast.core.models.trees import Trees
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits, Settings
from socast.core.wire.arrow_batch import write_rows
from socast.core.wire.decoder import Decoder
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Leg, Message, Plan, Telemetry, Vehicle, Weather, encode
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.structured_log import log_lines

INTERVAL_S: Final = 2.0
"""Time between two reports of the progress. [s]"""
START: Final = 1.7e9
"""Time of the first made-up sample. [Unix s]"""

_log = logging.getLogger("socast.kernels")


def log_progress(compiled: int, total: int) -> None:
    """Log how many kernels have been compiled."""
    _log.info("compiling kernels, once after installation: %d of %d", compiled, total)


def compile_kernels(*models: Model, report: Callable[[int, int], None] = log_progress) -> int:
    """Compile the kernels that are not in the cache, so that telemetry does not wait for the compiler.

    Parameters
    ----------
    report : callable
        Function that receives the number of kernels compiled or begun so far and the number of all kernels, at the
        first one, every `INTERVAL_S` and at the last one; it is not called if all kernels are in the cache.
    """
    progress = _Progress(report)
    event.register("numba:compile", progress)  # type: ignore[no-untyped-call]
    try:
        _run_kernels(*(models or (EXTENDED_PHYSICAL,)))
    finally:
        event.unregister("numba:compile", progress)  # type: ignore[no-untyped-call]
    progress.end()
    return len(progress.compiled)


class _Progress(event.Listener):
    """Count the cached kernels that numba compiles."""

    def __init__(self, report: Callable[[int, int], None]) -> None:
        self.compiled: set[Dispatcher] = set()
        self._report = report
        self._all = list_kernels()
        self._reported_s, self._reported = -INTERVAL_S, 0

    def on_start(self, event: Any) -> None:
        """Count a kernel whose compilation begins."""
        dispatcher = event.data["dispatcher"]
        if dispatcher not in self._all:  # it becomes a part of one of them
            return
        self.compiled.add(dispatcher)
        now = time.monotonic()
        if now - self._reported_s >= INTERVAL_S:
            self._reported_s, self._reported = now, len(self.compiled)
            self._report(self._reported, len(self._all))

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""

    def end(self) -> None:
        """Report the last kernel."""
        if self._reported < len(self.compiled):
            self._report(len(self.compiled), len(self._all))


def list_kernels() -> set[Dispatcher]:
    """Return the compiled functions of the modules imported so far that numba keeps in its cache."""
    modules = [
        module for name, module in list(sys.modules.items()) if name.startswith(("socast.core.", "socast.stream."))
    ]
    found = {each for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}
    return {each for each in found if isinstance(getattr(each, "_cache", None), FunctionCache)}


def compile_in_parallel() -> int:
    """Compile all kernels, those of the cleaning in a process of its own; return the number of the others."""
    command = [sys.executable, "-m", __spec__.name if __name__ == "__main__" else __name__, "--cleaning"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as other:  # noqa: S603 - this module itself
        _run_independent_kernels()
        if status := other.wait():
            raise subprocess.CalledProcessError(status, command)
    return compile_kernels()


def _run_cleaning() -> None:
    """Clean two made-up rows."""
    ones = np.ones(2)
    columns = dict.fromkeys(Batch._fields, ones) | {"lane": np.zeros(2, np.int64), "ride": np.full(2, NO_RIDE)}
    Cleaner(Settings()).clean(Batch(**columns), 1)


def _run_independent_kernels() -> None:
    """Run the kernels that need no cleaned rows but made-up ones, the longest first."""
    columns = dict(zip(Clean._fields, np.ones((len(Clean._fields), 4)), strict=True))
    whole = {name: np.zeros(4, np.int64) for name in ("lane", "ride", "window", "quality")}
    smooth_elevation(Clean(**(columns | whole | {"due": np.zeros(4, np.bool_)})))  # type: ignore[arg-type]
    lanes = Lanes()
    batch, _ = Decoder(lanes).decode(_make_messages())
    FleetSilences(Settings()).find(select_inputs(batch), batch.lane, len(lanes), np.full(batch.size, np.nan))
    leaf = {"roots": (0,), "feature": (-1,), "threshold": (0.0,), "value": (0.0,)}
    Trees(features=(), baseline=0.0, left=(0,), right=(0,), missing_left=(0,), **leaf).predict({})  # type: ignore[arg-type]
    _record_and_read(_make_messages())
    series = Series(np.arange(2), np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)))
    smooth_levels(*estimate_wandering(series, CONSUMPTION)[::-1])
    one = np.ones(1)
    mix_shocks(one > 0.0, one, one, one, CONSUMPTION.compute_variances(), np.zeros(1, np.int64), one, one, one)


def _make_messages() -> list[Message]:
    """Return a few made-up messages."""
    first = Weather("compile", START - 60.0, 45.5, -73.6, temperature_c=5.0)
    vehicle = Vehicle("compile", START - 60.0, "kia-soul-ev-2015")
    plan = Plan("compile", START, START + 3600.0, 20.0, [Leg(5.0, 600.0), Leg(None, 600.0, charge_to_soc_pct=80.0)])
    samples = [
        Telemetry(
            "compile",
            START + 3.0 * i,
            seq=i,
            ride_id="compile" if i < 90 else None,
            latitude_deg=45.5 + 1e-4 * i,
            longitude_deg=-73.6,
            elevation_m=30.0,
            speed_kmh=13.3,
            soc_pct=80.0,
        )
        for i in range(100)
    ]
    return [
        Message("weather/compile", encode(first), 0),
        Message("fleet/compile/vehicle", encode(vehicle), 0),
        Message("fleet/compile/plan", encode(plan), 0),
        *(Message("fleet/compile/telemetry", encode(sample), 0) for sample in samples),
        Message("fleet/compile/batch", write_rows(pa.table({"vehicle_id": ["compile"], "time_s": [START]})), 0),
        Message("fleet/compile/telemetry", b"{", 0),  # refused messages have a kernel, too
    ]


def _run_kernels(model: Model, *shadows: Model) -> None:
    """Run a few made-up messages through every step that has a kernel."""
    messages = _make_messages()
    live = Pipeline(model, shadows=shadows, limits=Limits(key_rate=1000.0))
    read = _record_and_read(messages)
    for part in (read[:1], read[1:]):  # the batch in the other part is hashed in another way
        live.push(part)
    live.finish()
    tables = Pipeline(keep_forecasts=False, two_sided=True)
    tables.push(messages)
    tables.finish()
    _run_independent_kernels()


def _record_and_read(messages: Sequence[Message]) -> MessageBlock:
    """Return messages from a recording, as a copy."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "compile.mcap"
        with McapSink(path) as sink:
            sink.put(messages)
        return MessageBlock.join(McapSource(path)).compact()


def main(arguments: Sequence[str] | None = None) -> None:
    """Compile the kernels, and say what was done."""
    about = "Compile the kernels and keep them in the cache, so that later starts need no compilation."
    parser = argparse.ArgumentParser(prog="python -m socast.tools.terminal.kernels", description=about)
    parser.add_argument("--cleaning", action="store_true", help="compile only the kernel of the cleaning")
    if parser.parse_args(arguments).cleaning:
        _run_cleaning()
        return
    log_lines()
    begun = time.monotonic()
    _log.info("compiling kernels, once after installation")
    if len(os.sched_getaffinity(0)) > 1:
        compile_in_parallel()
    else:
        compile_kernels()
    _log.info("%d kernels compiled in %.1f s", len(list_kernels()), time.monotonic() - begun)


if __name__ == "__main__":
    main()
