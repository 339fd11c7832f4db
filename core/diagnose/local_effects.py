"""Whether an effect holds for one vehicle, or from a date on, rather than everywhere and always.

Effects are asked of again in places: each vehicle's windows, and those after each of some dates, for all vehicles or
one. There effects have a say too whose shape the model has already, such as a constant drag or standby power: what
comes with a date is no part of what the car always takes.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import SECONDS_PER_DAY
from core.diagnose.candidates import Candidates, compute_least_coefficients
from core.diagnose.dataset import Windows
from core.diagnose.evidence import compute_worst_case_evidence
from core.diagnose.forward_selection import ForwardSelection, SelectedEffect
from core.diagnose.ranking import LEAST_LEFT
from core.fit.ride_blocks import get_names, get_numbers
from core.models.features import SINCE_SCOPE, VEHICLE_SCOPE
from core.stats.multiple_testing import adjust_false_discovery

Mask = NDArray[np.bool_]

"""[s]"""
DATES: Final = 8
"""Dates that are tried, evenly over the rides; the best is then sought among its neighbours."""
LEVEL: Final = 0.01
"""Probability by chance below which an effect is there in a place, adjusted for all that was asked in places of its
kind: of cars, of dates, or of both together."""
DATED: Final = 12.0
"""Fall of the error, in variances, by which a date must do better than none: the best of many does by chance."""
GLANCE: Final = 3.0
"""Standard errors, by what one car leaves, below which a candidate is not looked at further."""
LEAST_WINDOWS: Final = 40
"""Windows on either side of a place's border."""


class ScopedWindows(NamedTuple):
    """Some of the windows.

    Parameters
    ----------
    scope : tuple of str
        Indicator columns that say which.
    rows : (n,) bool
    car : int or None
        Code of the vehicle whose windows alone they are.
    """

    scope: tuple[str, ...]
    rows: Mask
    car: int | None


def list_scopes(windows: Windows) -> Iterator[ScopedWindows]:
    """Give each vehicle, all windows after each of some dates, and each vehicle's after each of them."""
    dates = [(SINCE_SCOPE + date, later) for date, later in _dates(windows, DATES)]
    every = np.ones(len(windows.measured), np.bool_)
    for name, later in dates:
        yield from _parted(ScopedWindows((name,), later, None), every)
    cars = _cars(windows)
    for code, car in cars if len(cars) > 1 else []:
        here = windows.vehicle == code
        yield from _parted(ScopedWindows((VEHICLE_SCOPE + car,), here, code), every)
        for name, later in dates:
            yield from _parted(ScopedWindows((VEHICLE_SCOPE + car, name), here & later, code), here)


def _parted(place: ScopedWindows, whole: Mask) -> Iterator[ScopedWindows]:
    """Give a place that has windows enough on either side of its border."""
    inside = int(place.rows.sum())
    if inside >= LEAST_WINDOWS and int(whole.sum()) - inside >= LEAST_WINDOWS:
        yield place


def select_local_effects(selection: ForwardSelection, everywhere: Candidates) -> None:
    """Name effects that hold in some place only, one after the other, until none is there beyond chance.

    Parameters
    ----------
    search : Search
        With what holds everywhere named.
    everywhere : Asked
        Effects to ask of, at the values that they are declared with.
    """
    while len(selection.selected) < selection.most:
        found = _best(selection, everywhere)
        if found is None:
            return
        selection.select(found)


class _Trial(NamedTuple):
    """What a candidate in a place is worth.

    Parameters
    ----------
    scope : tuple of str
        Of the place.
    at : int
        Its column.
    p : float
        Probability by chance.
    fall : float
        Of the squared error; less `DATED` variances where a date was chosen.
    """

    scope: tuple[str, ...]
    at: int
    p: float
    fall: float


def _best(selection: ForwardSelection, everywhere: Candidates) -> SelectedEffect | None:
    """Return the effect and place that explain most, of those that are there beyond chance."""
    off = selection.build_basis()
    left = selection.compute_residual(off)
    fleet = selection.base.project_out(everywhere.columns)
    fleet -= off @ (off.T @ fleet)
    families: dict[tuple[bool, bool], list[_Trial]] = {}
    for place in list_scopes(selection.base.windows):
        kind = place.car is not None, _since(place.scope) is not None
        families.setdefault(kind, []).extend(_tried(selection, everywhere, place, off, left, fleet))
    good: list[tuple[_Trial, float]] = []
    for tried in families.values():
        q = adjust_false_discovery(np.array([each.p for each in tried]))
        good += [(each, float(chance)) for each, chance in zip(tried, q, strict=True) if chance < LEVEL]
    for each, chance in sorted(good, key=lambda pair: -pair[0].fall):
        named = SelectedEffect(_sharper(selection, everywhere, each.scope, each.at, off, left), each.at, chance)
        if selection.is_new(named) and selection.is_worthwhile(named):
            return named
    return None


def _since(scope: tuple[str, ...]) -> str | None:
    """Return the indicator column of the date that a place begins with, None where there is none."""
    return next((name for name in scope if name.startswith(SINCE_SCOPE)), None)


def _glance(selection: ForwardSelection, everywhere: Candidates, place: ScopedWindows, left: Floats) -> Ints:
    """Return the candidates that might be there, by their own car's columns alone where the place is of one car."""
    if place.car is None:
        return np.arange(len(everywhere.names))
    own = selection.base.cars[place.car]
    columns = selection.base.project_out_for_car(everywhere.columns[own] * place.rows[own][:, np.newaxis], place.car)
    here = left[own]
    size = np.maximum((columns**2).sum(axis=0), 1e-300)
    return np.flatnonzero((columns.T @ here) ** 2 / size > GLANCE**2 * float(np.mean(left**2)))


def _tried(
    selection: ForwardSelection, everywhere: Candidates, place: ScopedWindows, off: Floats, left: Floats, fleet: Floats
) -> list[_Trial]:
    """Return what each candidate in a place is worth.

    One car is held against its siblings: what they all show, as what samples distort, is no matter of its own.
    """
    chosen = _glance(selection, everywhere, place, left)
    p, fall = np.ones(len(everywhere.names)), np.zeros(len(everywhere.names))
    if len(chosen):
        asked = everywhere.columns[:, chosen] * place.rows[:, np.newaxis]
        columns = selection.base.project_out(asked)
        columns -= off @ (off.T @ columns)
        if place.car is not None:
            columns = _beside(columns, fleet[:, chosen])
        size = (columns**2).sum(axis=0)
        told = size > LEAST_LEFT * (selection.base.apply_weights(asked) ** 2).sum(axis=0)
        kept, columns = chosen[told], columns[:, told]
        variants = [everywhere.variants[at] for at in kept]
        least = compute_least_coefficients(variants, asked[:, told], everywhere.measured * place.rows)
        if len(kept):
            p[kept] = compute_worst_case_evidence(left, columns, everywhere.sign[kept], selection.clusters, least).p
            fall[kept] = (columns.T @ left) ** 2 / size[told]
    if _since(place.scope) is not None:
        fall -= DATED * float(np.mean(left**2))
    return [_Trial(place.scope, at, float(p[at]), float(fall[at])) for at in range(len(p))]


def _beside(columns: Floats, others: Floats) -> Floats:
    """Return what is left of each column beside its like among others, (n, k)."""
    size = (others**2).sum(axis=0)
    share = np.divide((columns * others).sum(axis=0), size, out=np.zeros(len(size)), where=size > 0.0)
    return np.asarray(columns - others * share)


def _sharper(
    selection: ForwardSelection, everywhere: Candidates, scope: tuple[str, ...], at: int, off: Floats, left: Floats
) -> Candidates:
    """Return what is asked of in a place, from the very date that explains most where a date is part of it."""
    windows = selection.base.windows
    begin = _since(scope)
    of_car = next((code for code, name in _cars(windows) if VEHICLE_SCOPE + name in scope), None)
    here = np.ones(len(left), np.bool_) if of_car is None else windows.vehicle == of_car
    if begin is None:
        return everywhere.restrict_to(here, scope)
    whole = everywhere.columns[:, [at]]
    best, most = everywhere, -1.0
    for date, later in _dates(windows, None):
        rows = here & later
        if not LEAST_WINDOWS <= rows.sum() <= here.sum() - LEAST_WINDOWS:
            continue
        column = selection.base.project_out(whole * rows[:, np.newaxis])[:, 0]
        column -= off @ (off.T @ column)
        fall = float(column @ left) ** 2 / max(float(column @ column), 1e-300)
        if fall > most:
            place = tuple(SINCE_SCOPE + date if name == begin else name for name in scope)
            best, most = everywhere.restrict_to(rows, place), fall
    return best


def _cars(windows: Windows) -> list[tuple[int, str]]:
    """Return code and name of each vehicle."""
    found = dict(zip(windows.vehicle.tolist(), get_names(windows.table, "vehicle_id"), strict=True))
    return sorted(found.items())


def _dates(windows: Windows, count: int | None) -> list[tuple[str, Mask]]:
    """Return dates but the first, all or so many evenly over the windows, and the windows from each on."""
    start = get_numbers(windows.table, "start_s")
    days = np.unique(np.floor(start / SECONDS_PER_DAY))[1:]
    if count is not None and len(days) > count:
        wanted = np.quantile(start, np.linspace(0.0, 1.0, count + 2)[1:-1]) / SECONDS_PER_DAY
        days = np.unique(days[np.clip(np.searchsorted(days, wanted), 0, len(days) - 1)])
    stamps = days.astype("datetime64[D]")
    return [(str(stamp), start >= day * SECONDS_PER_DAY) for stamp, day in zip(stamps, days, strict=True)]
