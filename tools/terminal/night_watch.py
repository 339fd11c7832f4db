"""The option `--watch` of `socast live`: a diagnosis after every midnight, on what the service recorded."""

from pathlib import Path

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.stream.nightly_diagnosis import NightlyDiagnosis
from socast.stream.source import Sink
from socast.stream.zenoh_session import parse_prefix
from socast.tools.terminal.diagnosis_process import DiagnosisProcess
from socast.tools.terminal.findings_file import make_finding_fields, read_findings
from socast.tools.terminal.forecast_options import ForecastOptions
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import check_outputs


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
