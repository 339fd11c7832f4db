"""Turn diagnoses of successive nights into findings: proposed, sure, and gone.

A finding is real with a probability. From `SURE` on it is sure, if the interval of its share excludes zero, and if the
Bayes factor of a deviation is so large that no number of repeated diagnoses reaches it often by chance, see
`compute_sure_evidence`. It stays sure until a diagnosis no longer finds it.
"""

from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from msgspec.structs import replace

from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.deviation_words import MONTH, word_deviation
from socast.core.diagnose.records import CarDeviation, Diagnosis, NamedEffect
from socast.core.fit.ride_blocks import get_names, get_numbers, parse_ride_date
from socast.core.models.features import VEHICLE_SCOPE
from socast.core.wire.keys import identity
from socast.core.wire.messages import Cause, Finding, Message, encode

SURE: Final = 0.9
"""Probability from which a finding is sure; one minus it is the chance that a fleet without deviations ever has a sure
one. [1]"""
GROWTH: Final = 1000.0
"""Growth of the number of shifts over which diagnoses are repeated: from 6 of a car, the fewest with a change. [1]"""
ALL: Final = "all"
"""Name of all vehicles together."""


class FleetUse(NamedTuple):
    """Hold what a fleet used on its rides.

    Parameters
    ----------
    energy : float
        Measured energy. [kWh]
    distance : float
        Distance of the rides with measured energy. [km]
    months : float
        Time from the first to the last day. [months]
    """

    energy: float
    distance: float
    months: float
    last_day: date


def measure_fleet_use(rides: pd.DataFrame) -> FleetUse:
    """Return what a fleet used."""
    energy, distance = get_numbers(rides, "energy_kwh"), get_numbers(rides, "distance_km")
    known = np.isfinite(energy) & np.isfinite(distance)
    days = sorted(parse_ride_date(day) for day in set(get_names(rides, "date")) if day)
    months = ((days[-1] - days[0]).days + 1) / MONTH
    return FleetUse(float(energy[known].sum()), float(distance[known].sum()), months, days[-1])


def compute_sure_evidence(tests: int) -> float:
    """Return the logarithm of the Bayes factor from which a deviation is sure, however often one looks.

    Notes
    -----
    Without a deviation, a Bayes factor of growing data is a martingale with the mean 1, and ever reaches c with a
    probability of at most 1/c (Ville). That of a change is a mean over n possible dates. The sum S of n martingales,
    of which one begins at each date, grows by 1 per date. By the inequality of Chow for weights 1/n that fall,

        P(S / n ≥ c for any n from m to g m) ≤ (1 + log g) / c,

    with g = `GROWTH`. All tests together reach c by chance with a probability of at most 1 - `SURE` if

        c = tests (1 + log g) / (1 - SURE).

    The bound holds for steps of one size with known variances. Ramps, whose prior follows the length of the data, and
    estimated variances make it approximate. A missing effect needs no such limit: the share of false ones among those
    whose posterior probability ever reaches `SURE` is at most 1 - `SURE`.

    References
    ----------
    Ville, Étude critique de la notion de collectif (1939). Chow, Proceedings of the American Mathematical Society 11
    (1960) 107. Grünwald, de Heide and Koolen, Journal of the Royal Statistical Society B 86 (2024) 1091,
    DOI 10.1093/jrsssb/qkae011. Hendriksen, de Heide and Grünwald, Bayesian Analysis 16 (2021) 961,
    DOI 10.1214/20-BA1234, on posterior probabilities.

    Examples
    --------
    >>> round(compute_sure_evidence(1000), 1)
    11.3
    """
    return float(np.log(tests * (1.0 + np.log(GROWTH)) / (1.0 - SURE)))


def list_findings(result: Diagnosis, use: FleetUse) -> list[Finding]:
    """Return the findings of one diagnosis, each proposed or sure."""
    missing = [_make_finding(one, use, _measure_missing(one, use)) for one in result.missing]
    return missing + [_make_finding(one, use, _measure_deviation(one)) for one in result.deviations]


def merge_findings(earlier: Sequence[Finding], found: Sequence[Finding], use: FleetUse) -> list[Finding]:
    """Return the findings after a diagnosis: those that it made, and those that were sure once and are gone.

    Notes
    -----
    A finding is the same as an earlier one about the same vehicle if the earlier effect is among its causes. It then
    keeps its effect, which names its key, and its dates. A proposed finding that vanishes leaves no trace.
    """
    merged: list[Finding] = []
    left = list(earlier)
    for finding in found:
        before = next((one for one in left if _is_same(one, finding)), None)
        if before is None:
            merged.append(finding)
            continue
        left.remove(before)
        stays = before.status == "sure" or finding.status == "sure"
        merged.append(
            replace(
                finding,
                effect=before.effect,
                status="sure" if stays else "proposed",
                first_seen=before.first_seen,
                sure_since=before.sure_since if before.status == "sure" else finding.sure_since,
            )
        )
    time = _find_end(use.last_day)
    gone = [one if one.status == "gone" else replace(one, status="gone", time_s=time) for one in left]
    return merged + [one for one in gone if one.sure_since]


def list_changes(before: Sequence[Finding], after: Sequence[Finding]) -> list[Finding]:
    """Return the findings that became sure, and those that were sure and are gone."""
    status = {identity(one): one.status for one in before}
    return [one for one in after if one.status != "proposed" and status.get(identity(one)) != one.status]


def make_finding_message(finding: Finding, prefix: str = "") -> Message:
    """Return the message of a finding."""
    return Message(f"{prefix}findings/{identity(finding)}", encode(finding), int(finding.time_s * 1e9))


class _Measured(NamedTuple):
    """Hold who has a finding, its words, its share of the energy with a 95 % interval, and its monthly kWh."""

    who: str
    words: str
    share: float
    low: float
    high: float
    kwh: float


def _make_finding(one: NamedEffect | CarDeviation, use: FleetUse, measured: _Measured) -> Finding:
    """Return the finding of an entry of a diagnosis."""
    lasting, since = True, None
    if isinstance(one, CarDeviation):
        probability, since = 1.0 - _get_number(one.q), one.since
        lasting = _get_number(one.evidence) >= compute_sure_evidence(one.tests)
        credible = {cause.effect for cause in one.causes}
    else:
        probability, credible = _get_number(one.probability), set(one.credible_set)
    share, low, high = map(_get_known, (measured.share, measured.low, measured.high))
    day = use.last_day.isoformat()
    known = low is not None and high is not None and low * high > 0.0
    sure = probability >= SURE and known and lasting
    causes = [Cause(each.effect, each.probability or 0.0) for each in one.causes if each.effect in credible]
    return Finding(
        who=measured.who,
        effect=one.effect,
        time_s=_find_end(use.last_day),
        status="sure" if sure else "proposed",
        probability=probability,
        causes=causes or [Cause(one.effect, probability)],
        first_seen=day,
        sure_since=day if sure else None,
        since=since,
        share=share,
        share_lower=low,
        share_upper=high,
        kwh_per_month=_get_known(measured.kwh),
        range_km_per_month=_get_known(_find_range(measured.kwh, use)),
        words=measured.words + _word_savings(one, measured.kwh, use),
        commands=one.commands,
    )


def _measure_missing(one: NamedEffect, use: FleetUse) -> _Measured:
    """Return who lacks a missing effect, its words and its size, with the relative interval of its coefficient."""
    scopes = [column.removeprefix(VEHICLE_SCOPE) for column in one.columns if column.startswith(VEHICLE_SCOPE)]
    share, value = _get_number(one.energy_share), _get_number(one.coefficient.value)
    limits = one.coefficient.ci95 or (float("nan"), float("nan"))
    ends = [share * end / value if value else float("nan") for end in limits]
    who = scopes[0] if scopes else ALL
    return _Measured(
        who,
        f"{one.effect} is missing in {'all cars' if who == ALL else who}: {one.words}",
        share,
        min(ends),
        max(ends),
        share * use.energy / use.months,
    )


def _measure_deviation(one: CarDeviation) -> _Measured:
    """Return who deviates, the words and the size of the deviation."""
    low, high = one.share_ci95 or (float("nan"), float("nan"))
    return _Measured(one.who, word_deviation(one), _get_number(one.share), low, high, _get_number(one.kwh_per_month))


def _word_savings(one: NamedEffect | CarDeviation, kwh: float, use: FleetUse) -> str:
    """Return what mending a deviation would save, or what a missing effect takes; nothing for what saves energy."""
    range_km = _find_range(kwh, use)
    if not (np.isfinite(range_km) and kwh > 0.0):
        return ""
    verb = "mending it would save" if isinstance(one, CarDeviation) else "it accounts for"
    return f"; {verb} {kwh:.3g} kWh or {range_km:.3g} km of range a month"


def _find_range(kwh: float, use: FleetUse) -> float:
    """Return the distance that the fleet drives with an energy, NaN where its rides have no energy. [km]"""
    return kwh * use.distance / use.energy if use.energy > 0.0 else float("nan")


def _is_same(earlier: Finding, finding: Finding) -> bool:
    """Return whether a finding is the same as an earlier one."""
    causes = {finding.effect, *(cause.effect for cause in finding.causes)}
    both_change = (earlier.since is None) == (finding.since is None)
    return earlier.who == finding.who and both_change and earlier.effect in causes


def _find_end(day: date) -> float:
    """Return the midnight at which a UTC day ends. [Unix s]"""
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp() + SECONDS_PER_DAY


def _get_number(value: float | None) -> float:
    """Return a number of a diagnosis, NaN where it is unknown."""
    return float("nan") if value is None else value


def _get_known(value: float) -> float | None:
    """Return a number, None where it is not finite."""
    return float(value) if np.isfinite(value) else None
