"""The file in which a diagnosis keeps its findings: read, write, and print what is new and what is gone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from socast.core.diagnose.findings import list_changes
from socast.core.errors import SettingsError, read_input
from socast.core.wire.messages import Finding
from socast.tools.terminal.output import write_json


class _Content(msgspec.Struct):
    """Hold what the file holds besides its format."""

    findings: list[Finding]


def read_findings(path: Path) -> list[Finding]:
    """Return the findings of a file, none if the file does not exist."""
    try:
        return msgspec.json.decode(read_input(path), type=_Content).findings
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SettingsError(f"{path} cannot be read: {error.strerror}; name another file") from error
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is no file of findings: {error}; name another file") from error


def write_findings(path: Path, findings: Sequence[Finding]) -> None:
    """Replace the file of findings as a whole."""
    write_json(path, "findings", {"findings": msgspec.to_builtins(list(findings))})


def show_changes(before: Sequence[Finding], after: Sequence[Finding], console: Console) -> None:
    """Print the findings that became sure, with the commands that try them, and those that are gone."""
    changes = list_changes(before, after)
    lines = [line for one in changes for line in _describe_change(one)]
    for line in lines or ["No finding became sure, and none is gone."]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def make_finding_fields(finding: Finding) -> dict[str, Any]:
    """Return a finding as the fields of a line of the log."""
    names = ("who", "effect", "status", "words", "probability", "kwh_per_month", "range_km_per_month")
    known = {name: value for name in names if (value := getattr(finding, name)) is not None}
    return known | dict(zip(("add", "shadow"), finding.commands, strict=False))


def _describe_change(finding: Finding) -> list[str]:
    """Return the lines of a finding that became sure or is gone."""
    if finding.status == "gone":
        return [f"Gone: {finding.words}"]
    return [f"Sure ({100.0 * finding.probability:.0f} %): {finding.words}", *finding.commands]
