"""Alarms of a fleet: cars that may end below their reserve, cars that fell silent, and findings of the diagnosis."""

from typing import Any, Final

import numpy as np

from socast.core.wire.messages import Finding
from socast.tools.commands.ask import HIGH_RISK, LOW_RISK
from socast.tools.workbench.fleet.board import Board

EMPTY_PCT: Final = 1.0
"""Charge below which a car counts as empty. [%]"""
MOST_ALARMS: Final = 50
"""Largest number of alarms of a list, the most serious first."""


def list_alarms(board: Board) -> dict[str, Any]:
    """Return the alarms of a fleet as a JSON record.

    Returns
    -------
    dict
        `total`, the number of alarms, and `list`, the most serious ones first, each with `kind` (`reserve`, `silent`
        or `finding`), `level` (`bad` or `warn`), `car` (None for a finding about no single car), `value` (risk [1],
        silence in whole minutes, or probability) and `words`.
    """
    with board.lock:
        risk = board.column("reserve_risk")
        age, is_silent = board.get_ages(), board.find_silent()
        silent = is_silent & (board.column("riding") > 0.0)
        names = board.vehicle_ids
        soc = board.column("soc_pct")
        may_run_low = (risk >= LOW_RISK) & (~is_silent | (risk > HIGH_RISK))
        rows = np.flatnonzero(may_run_low & (~board.find_over() | (soc < EMPTY_PCT)))
        alarms = [
            _describe_risk(names[row], float(risk[row]), float(soc[row]), is_silent=bool(is_silent[row]))
            for row in rows.tolist()
        ]
        alarms += [_describe_silence(names[row], float(age[row])) for row in np.flatnonzero(silent).tolist()]
        alarms += [
            _describe_finding(each, each.who if each.who in board.models else None)
            for each in board.findings.values()
            if each.status != "gone"
        ]
    alarms.sort(key=lambda each: (each["level"] != "bad", each["kind"], -each["value"]))
    return {"total": len(alarms), "list": alarms[:MOST_ALARMS]}


def _describe_risk(car: str, risk: float, soc: float, *, is_silent: bool) -> dict[str, Any]:
    """Return the alarm of a car that is empty or may fall below its reserve; a silent car keeps it if it is likely."""
    level = "bad" if risk > HIGH_RISK else "warn"
    words = "may fall below its reserve before its shift ends"
    if soc < EMPTY_PCT:
        words = "is empty"
    elif is_silent:
        words = "was likely to end below its reserve when it sent last"
    return _alarm("reserve", level, car, round(risk, 2), words)


def _describe_silence(car: str, age: float) -> dict[str, Any]:
    """Return the alarm of a car that was silent during a ride."""
    minutes = int(age // 60)
    return _alarm("silent", "warn", car, minutes, "fell silent during a ride")


def _describe_finding(finding: Finding, car: str | None) -> dict[str, Any]:
    """Return the alarm of a finding; the page names the car before the words."""
    words = finding.words if car is None else finding.words.removeprefix(f"{car} ")
    return _alarm("finding", "warn", car, finding.probability, words)


def _alarm(kind: str, level: str, car: str | None, value: float, words: str) -> dict[str, Any]:
    """Return an alarm as a JSON record."""
    return {"kind": kind, "level": level, "car": car, "value": value, "words": words}
