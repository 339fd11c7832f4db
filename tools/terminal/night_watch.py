"""The option `--watch` of `socast live`: a diagnosis after every midnight, on what the service recorded."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.stream.nightly_diagnosis import NightlyDiagnosis
from socast.stream.source import Sink
from socast.stream.zenoh_session import parse_prefix
from socast.tools.terminal.findings_file import make_finding_fields, read_findings
from socast.tools.terminal.forecast_options import ForecastOptions
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import check_outputs

LOW_PRIORITY: Final = 15
"""Niceness of the process, so that the loop goes first."""
END_S: Final = 5.0
"""Time that the process has to end when it is asked to. [s]"""


class DiagnosisProcess:
    """Run `socast diagnose` beside the loop."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self._error = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            [sys.executable, "-m", "socast", "diagnose", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._error,
            start_new_session=True,  # a signal of the terminal ends the loop, which then ends the process
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, LOW_PRIORITY)

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        return self._process.poll()

    def get_error(self) -> str:
        """Return the last line that the process wrote to standard error."""
        self._error.seek(0)
        lines = self._error.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self._process.returncode}"

    def end(self) -> None:
        """End the process if it runs."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._error.close()


def check_watch(options: ForecastOptions, record: Path | None, watch: Path | None) -> None:
    """Refuse --watch without recordings, and a file that holds no findings or cannot be written."""
    if watch is None:
        return
    if record is None:
        raise SettingsError("--watch diagnoses what --record keeps: give --record DIR too")
    check_outputs(options.files, watch)
    read_findings(watch)


def make_nightly_diagnosis(
    options: ForecastOptions, pipeline: Pipeline, sink: Sink, record: Path, file: Path
) -> NightlyDiagnosis:
    """Return the diagnosis of the first model after every midnight, on the recordings of a folder."""
    arguments = [str(record), "--model", options.models[0] if options.models else DEFAULT_MODEL]
    arguments += [word for path in options.effect_files for word in ("--effects", str(path))]
    arguments += [word for path in options.vehicle_files for word in ("--vehicles", str(path))]
    arguments += ["--findings", str(file)]
    return NightlyDiagnosis(
        lambda: pipeline.day_rollover.midnight,
        lambda: DiagnosisProcess(arguments),
        lambda: read_findings(file),
        sink,
        make_finding_fields,
        parse_prefix(options.prefix),
    )
