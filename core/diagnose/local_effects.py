"""Select effects that hold for one vehicle only, or from a date on, rather than everywhere and always.

Effects are tested again within scopes: the windows of each vehicle, and the windows after each of some dates, for all
vehicles or for one. Within a scope, effects count too whose shape the model has already, such as a constant drag or
standby power, because what begins on a date is not part of what the car always uses.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import SECONDS_PER_DAY
from core.diagnose.candidates import Candidates, compute_least_coefficients
from core.diagnose.dataset import Windows
from core.diagnose.evidence import compute_worst_case_evidence
from core.diagnose.forward_selection import ForwardSelection, SelectedEffect
from core.diagnose.ranking import LEAST_LEFT, ResidualSpace
from core.fit.ride_blocks import get_names, get_numbers
from core.models.features import SINCE_SCOPE, VEHICLE_SCOPE
from core.stats.multiple_testing import adjust_false_discovery

Mask = NDArray[np.bool_]

DATES: Final = 8
"""Number of dates, evenly spaced over the windows, that are tested first; the best one is then refined."""
LEVEL: Final = 0.01
"""Probability below which an effect within a scope is significant, adjusted for all scopes of the same kind: vehicles,
dates, or both together."""
DATE_PENALTY: Final = 12.0
"""Fall of the squared error, in variances, by which a date must be better than none: the best of many dates is better
by chance."""
SCREENING: Final = 3.0
"""Standard errors below which a candidate is not tested further, by the residual of its car."""
LEAST_WINDOWS: Final = 40
"""Least number of windows inside and outside a scope."""


class ScopedWindows(NamedTuple):
    """Hold the windows within a scope.

    Parameters
    ----------
    scope : tuple of str
        Indicator columns that define the scope.
    rows : (n,) bool
        Windows within the scope.
    car : int or None
        Code of the vehicle if the scope has one vehicle.
    """

    scope: tuple[str, ...]
    rows: Mask
    car: int | None


@dataclass(frozen=True)
class _LocalSearch:
    """Hold what all tests within scopes share: the candidates, the residual, and the candidates of the whole fleet."""

    selection: ForwardSelection
    candidates: Candidates
    space: ResidualSpace
    fleet: Floats


class _Trial(NamedTuple):
    """Hold the test of one candidate within a scope; `fall` is that of the squared error, less any date penalty."""

    scope: tuple[str, ...]
    at: int
    p: float
    fall: float


def list_scopes(windows: Windows) -> Iterator[ScopedWindows]:
    """Yield each vehicle, all windows after each of some dates, and the windows of each vehicle after each date.

    Parameters
    ----------
    windows : Windows
        The windows to diagnose.

    Yields
    ------
    ScopedWindows
        A scope with at least `LEAST_WINDOWS` windows inside and outside. A single vehicle is no scope.
    """
    dates = [(SINCE_SCOPE + date, later) for date, later in _list_dates(windows, DATES)]
    every = np.ones(len(windows.measured), np.bool_)
    for name, later in dates:
        yield from _keep_if_large(ScopedWindows((name,), later, None), every)
    cars = _list_cars(windows)
    for code, car in cars if len(cars) > 1 else []:
        here = windows.vehicle == code
        yield from _keep_if_large(ScopedWindows((VEHICLE_SCOPE + car,), here, code), every)
        for name, later in dates:
            yield from _keep_if_large(ScopedWindows((VEHICLE_SCOPE + car, name), here & later, code), here)


def _keep_if_large(scoped: ScopedWindows, whole: Mask) -> Iterator[ScopedWindows]:
    """Yield a scope that has enough windows inside and outside, within a whole."""
    inside = int(scoped.rows.sum())
    if inside >= LEAST_WINDOWS and int(whole.sum()) - inside >= LEAST_WINDOWS:
        yield scoped


def select_local_effects(selection: ForwardSelection, candidates: Candidates) -> None:
    """Select effects that hold within a scope only, one after the other, until no further one is significant.

    Parameters
    ----------
    selection : ForwardSelection
        A selection that has selected the effects that hold everywhere.
    candidates : Candidates
        Effects to test, at the declared values of their parameters.
    """
    while len(selection.selected) < selection.settings.max_effects:
        effect = _find_best(selection, candidates)
        if effect is None:
            return
        selection.select(effect)


def _find_best(selection: ForwardSelection, candidates: Candidates) -> SelectedEffect | None:
    """Return the significant effect and scope that explain most, or None."""
    space = selection.build_space()
    search = _LocalSearch(selection, candidates, space, space.project_out(candidates.columns))
    families: dict[tuple[bool, bool], list[_Trial]] = {}
    for scoped in list_scopes(selection.base.windows):
        kind = scoped.car is not None, _find_date_column(scoped.scope) is not None
        families.setdefault(kind, []).extend(_test_scope(search, scoped))
    significant: list[tuple[_Trial, float]] = []
    for trials in families.values():
        q = adjust_false_discovery(np.array([each.p for each in trials]))
        significant += [(each, float(chance)) for each, chance in zip(trials, q, strict=True) if chance < LEVEL]
    for each, chance in sorted(significant, key=lambda pair: -pair[0].fall):
        effect = SelectedEffect(_refine_date(search, each.scope, each.at), each.at, chance)
        if selection.is_new(effect) and selection.is_worthwhile(effect):
            return effect
    return None


def _find_date_column(scope: tuple[str, ...]) -> str | None:
    """Return the indicator column of the first date of a scope, or None."""
    return next((name for name in scope if name.startswith(SINCE_SCOPE)), None)


def _screen(search: _LocalSearch, scoped: ScopedWindows) -> Ints:
    """Return the candidates to test; those of one car are screened by the projection off its own columns."""
    if scoped.car is None:
        return np.arange(len(search.candidates.names))
    base, residual = search.selection.base, search.space.residual
    of_car = base.cars[scoped.car]
    columns = base.project_out_for_car(
        search.candidates.columns[of_car] * scoped.rows[of_car][:, np.newaxis], scoped.car
    )
    size = np.maximum((columns**2).sum(axis=0), 1e-300)
    return np.flatnonzero((columns.T @ residual[of_car]) ** 2 / size > SCREENING**2 * float(np.mean(residual**2)))


def _test_scope(search: _LocalSearch, scoped: ScopedWindows) -> list[_Trial]:
    """Return the test of each candidate within a scope.

    The effect of one car is tested beside the same effect of the fleet: what all cars show, such as distortions by
    coarse sampling, is not specific to the car.
    """
    candidates, space = search.candidates, search.space
    chosen = _screen(search, scoped)
    p, fall = np.ones(len(candidates.names)), np.zeros(len(candidates.names))
    if len(chosen):
        energies = candidates.columns[:, chosen] * scoped.rows[:, np.newaxis]
        columns = space.project_out(energies)
        if scoped.car is not None:
            columns = _project_out_pairwise(columns, search.fleet[:, chosen])
        size = (columns**2).sum(axis=0)
        identifiable = size > LEAST_LEFT * (space.base.apply_weights(energies) ** 2).sum(axis=0)
        kept, columns = chosen[identifiable], columns[:, identifiable]
        least = compute_least_coefficients(energies[:, identifiable], candidates.measured * scoped.rows)
        if len(kept):
            clusters = search.selection.clusters
            p[kept] = compute_worst_case_evidence(space.residual, columns, candidates.sign[kept], clusters, least).p
            fall[kept] = (columns.T @ space.residual) ** 2 / size[identifiable]
    if _find_date_column(scoped.scope) is not None:
        fall -= DATE_PENALTY * float(np.mean(space.residual**2))
    return [_Trial(scoped.scope, at, float(p[at]), float(fall[at])) for at in range(len(p))]


def _project_out_pairwise(columns: Floats, others: Floats) -> Floats:
    """Return each column less its projection on the column at the same place among others, (n, k)."""
    size = (others**2).sum(axis=0)
    share = np.divide((columns * others).sum(axis=0), size, out=np.zeros(len(size)), where=size > 0.0)
    return np.asarray(columns - others * share)


def _refine_date(search: _LocalSearch, scope: tuple[str, ...], at: int) -> Candidates:
    """Return the candidates within a scope, from the exact date that explains most where the scope has a date."""
    space, candidates = search.space, search.candidates
    windows = space.base.windows
    begin = _find_date_column(scope)
    car = next((code for code, name in _list_cars(windows) if VEHICLE_SCOPE + name in scope), None)
    here = np.ones(len(space.residual), np.bool_) if car is None else windows.vehicle == car
    if begin is None:
        return candidates.restrict_to(here, scope)
    whole = candidates.columns[:, [at]]
    best, most = candidates, -1.0
    for date, later in _list_dates(windows, None):
        rows = here & later
        if not LEAST_WINDOWS <= rows.sum() <= here.sum() - LEAST_WINDOWS:
            continue
        column = space.project_out(whole * rows[:, np.newaxis])[:, 0]
        fall = float(column @ space.residual) ** 2 / max(float(column @ column), 1e-300)
        if fall > most:
            refined = tuple(SINCE_SCOPE + date if name == begin else name for name in scope)
            best, most = candidates.restrict_to(rows, refined), fall
    return best


def _list_cars(windows: Windows) -> list[tuple[int, str]]:
    """Return the code and the name of each vehicle."""
    names = dict(zip(windows.vehicle.tolist(), get_names(windows.table, "vehicle_id"), strict=True))
    return sorted(names.items())


def _list_dates(windows: Windows, count: int | None) -> list[tuple[str, Mask]]:
    """Return all dates except the first, or a number of them evenly spaced, with the windows from each date on."""
    start = get_numbers(windows.table, "start_s")
    days = np.unique(np.floor(start / SECONDS_PER_DAY))[1:]
    if count is not None and len(days) > count:
        wanted = np.quantile(start, np.linspace(0.0, 1.0, count + 2)[1:-1]) / SECONDS_PER_DAY
        days = np.unique(days[np.clip(np.searchsorted(days, wanted), 0, len(days) - 1)])
    stamps = days.astype("datetime64[D]")
    return [(str(stamp), start >= day * SECONDS_PER_DAY) for stamp, day in zip(stamps, days, strict=True)]
