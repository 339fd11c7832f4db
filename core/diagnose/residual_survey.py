"""Average the residual of a model in bins along every column, and say along which it differs from zero.

The residuals are those of windows, because what meets a car on the way out and on the way home, such as wind, cancels
over a ride. Intervals are clustered by vehicle-day. The rate of false discoveries is controlled over all columns, and
among bins over those of all columns.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.shown_columns import CATEGORIES, NUMBERS, ShownColumn, describe_column, list_columns
from socast.core.evaluate.compare import ride_wind
from socast.core.models import LinearModel
from socast.core.stats.bin_means import average_in_bins, split_at_quantiles
from socast.core.stats.multiple_testing import adjust_false_discovery
from socast.core.stats.scores import NORMAL_95

BINS: Final = 12
"""Largest number of bins along a column."""
MOST_NAMES: Final = 24
"""Largest number of names along a category, and of facets: those with the most rows."""
LEAST_ROWS: Final = 5
"""Least mean number of rows in a bin."""
FLIPS, FLIPS_AT_ONCE = 20, 100
"""Number of times that the signs of vehicle-days are flipped at random: so many blocks of so many."""
SIGNIFICANCE: Final = 0.05
"""Rate of false discoveries below which a column varies, or a bin differs from zero, beyond chance. [1]"""


class ColumnResiduals(NamedTuple):
    """Hold the residuals of rides or windows.

    Parameters
    ----------
    value : (n,) float
        Predicted less measured energy of a ride [kWh], or mean power of a window [W].
    weight : (n,) float
        Weight in means: 1 for a ride, the duration of a window [s].
    day : (n,) int64
        Vehicle-day.
    """

    value: Floats
    weight: Floats
    day: Ints
    keys: list[str]
    columns: list[tuple[ShownColumn, Any]]
    unit: str


def survey_model(
    rides: pd.DataFrame, windows: pd.DataFrame, model: LinearModel, kept: set[str] | None = None
) -> dict[str, Any]:
    """Return where a model fails on the windows of rides."""
    seen = read_window_residuals(gather_windows(rides, windows, model), kept)
    return {"unit": seen.unit, "windows": len(seen.value), "charts": survey_columns(seen)}


def read_window_residuals(seen: Windows, kept: set[str] | None = None) -> ColumnResiduals:
    """Return the residuals of the windows of rides; of all, or of those whose keys are kept."""
    rows = np.arange(len(seen.ride))
    if kept is not None:
        rows = np.flatnonzero(seen.rides["ride_key"].astype(str).isin(kept).to_numpy()[seen.ride])
    table = _select_columns(seen, rows)
    seconds = table["duration_s"].to_numpy(np.float64)
    power = 3.6e6 * (seen.predicted - seen.measured)[rows] / seconds
    day = np.unique(seen.day[rows], return_inverse=True)[1]
    return ColumnResiduals(power, seconds, day, table["ride_key"].astype(str).tolist(), list_columns(table), "W")


def survey_columns(seen: ColumnResiduals) -> list[dict[str, Any]]:
    """Return the mean residual along every column.

    Returns
    -------
    list of dict
        For each `column` its `bins` (see `bin_residual`), each with `q`, the rate of false discoveries if all bins of
        all columns that are at least as significantly off zero were reported; `outside`, the number of bins `of` all
        with an interval for which this rate is below `SIGNIFICANCE`; `spread`, the root mean square of the means beyond
        what their standard errors cause; and `q`, the rate for columns that vary. Columns with a bin off zero come
        first, then those with the largest spread.

    Notes
    -----
    A column is tested by the spread of the means of its bins about their mean: a bias that is the same everywhere
    belongs to no column. The spread is held against those after the signs of all residuals of a vehicle-day were
    flipped at random, which leaves nothing but chance, however few vehicle-days a bin has and however they share bins.

    References
    ----------
    Cameron, Gelbach and Miller, Review of Economics and Statistics 90 (2008) 414, DOI 10.1162/rest.90.3.414.
    """
    charts: list[dict[str, Any]] = []
    p: list[float] = []
    for column, values in seen.columns:
        rows, place = _place_in_bins(column, values, np.arange(len(values)))
        bins = bin_residual(seen, column, values, np.arange(len(values)))
        known = np.array([bool(half) for half in bins["ci95"]])
        if known.sum() > 1:
            chart = {"column": describe_column(column), "bins": bins, "of": int(known.sum())}
            charts.append(chart | {"spread": _measure_spread(bins)})
            p.append(_test_means(seen, rows, place, known))
    for chart, q in zip(charts, adjust_false_discovery(np.array(p)).tolist(), strict=True):
        chart["q"] = q
    _adjust_bins(charts)
    return sorted(charts, key=lambda chart: (not chart["outside"], -chart["spread"]))


def _adjust_bins(charts: list[dict[str, Any]]) -> None:
    """Insert the rate of false discoveries of every bin, over the bins of all columns, and count those off zero."""
    p = []
    for chart in charts:
        bins = chart["bins"]
        p += [each if half else None for each, half in zip(bins.pop("p"), bins["ci95"], strict=True)]
    rates = iter(adjust_false_discovery(np.array(p, dtype=np.float64)).tolist())
    for chart in charts:
        q = [next(rates) for _ in chart["bins"]["mean"]]
        chart["bins"]["q"] = [each if np.isfinite(each) else None for each in q]
        chart["outside"] = sum(each < SIGNIFICANCE for each in q)  # NaN is not


def bin_residual(seen: ColumnResiduals, column: ShownColumn, along: Any, rows: Ints) -> dict[str, Any]:
    """Return the mean residual of some rows in bins along a column.

    Returns
    -------
    dict
        In bins: `x` (mean, or name), `low` and `high` ends, `mean`, half width `ci95` of its interval and probability
        `p` of a mean so far from zero by chance, numbers of `rows` and of vehicle-`days`.
    """
    rows, place = _place_in_bins(column, along, rows)
    if not len(rows):
        return {name: [] for name in ("x", "low", "high", "mean", "ci95", "p", "rows", "days")}
    values, bins = along[rows], int(place.max()) + 1
    ends: list[Any] = [[], []]
    if column.unit:
        middle = (np.bincount(place, values, bins) / np.bincount(place, minlength=bins)).tolist()
        ends = [[float(pick(values[place == i])) for i in range(bins)] for pick in (np.min, np.max)]
    else:
        middle = [str(values[place == i][0]) for i in range(bins)]
    means = average_in_bins(place, bins, seen.value[rows], seen.weight[rows], seen.day[rows])
    return {
        "x": middle,
        "low": ends[0],
        "high": ends[1],
        "mean": means.value.tolist(),
        "ci95": [half if np.isfinite(half) else None for half in means.ci95.tolist()],
        "p": [each if np.isfinite(each) else None for each in means.p.tolist()],
        "rows": means.windows.tolist(),
        "days": means.days.tolist(),
    }


def _place_in_bins(column: ShownColumn, along: Any, rows: Ints) -> tuple[Ints, Ints]:
    """Return the rows whose value is known, and the bin of each: quantiles of numbers, the most frequent names."""
    values = along[rows]
    if column.unit:
        rows = rows[np.isfinite(values)]
        if len(rows) < LEAST_ROWS:
            return rows[:0], rows[:0]
        return rows, split_at_quantiles(along[rows], max(1, min(BINS, len(rows) // LEAST_ROWS)))[0]
    names, place, count = np.unique(values, return_inverse=True, return_counts=True)
    most = np.sort([i for i in np.argsort(-count, kind="stable") if names[i]][:MOST_NAMES]).astype(np.int64)
    inside = np.isin(place, most)
    return rows[inside], np.searchsorted(most, place[inside]).astype(np.int64)


def _test_means(seen: ColumnResiduals, rows: Ints, place: Ints, known: NDArray[np.bool_]) -> float:
    """Return the probability of means of the known bins at least as far from each other, where all are the same."""
    bins, days = len(known), int(seen.day.max()) + 1
    weight = np.bincount(place, seen.weight[rows], bins)
    used = seen.weight[rows] * known[place]
    off = seen.value[rows] - np.average(seen.value[rows], weights=used)
    of_days = np.asarray(np.bincount(seen.day[rows] * bins + place, used * off, days * bins), dtype=np.float64)
    sums = of_days.reshape(days, bins)[:, known] / weight[known]
    share = weight[known] / weight[known].sum()
    sums = sums - (sums @ share)[:, np.newaxis]
    rng, larger = np.random.default_rng(0), 1
    least = (sums.sum(axis=0) ** 2 @ share) * (1.0 - 1e-12)
    for _ in range(FLIPS):
        signs = rng.choice(np.array([-1.0, 1.0]), (FLIPS_AT_ONCE, days))
        larger += int(np.count_nonzero((signs @ sums) ** 2 @ share >= least))
    return larger / (1.0 + FLIPS * FLIPS_AT_ONCE)


def _measure_spread(bins: dict[str, Any]) -> float:
    """Return the root mean square of the means of bins, without what their standard errors cause."""
    known = [i for i, half in enumerate(bins["ci95"]) if half is not None]
    mean, half, rows = (np.array([bins[name][i] for i in known], dtype=np.float64) for name in ("mean", "ci95", "rows"))
    return float(np.sqrt(max(np.average(mean**2 - (half / NORMAL_95) ** 2, weights=rows), 0.0)))


def _select_columns(seen: Windows, rows: Ints) -> pd.DataFrame:
    """Return the columns of some windows that pages show, with the driver of their ride."""
    names = {column.key for column in (*NUMBERS, *CATEGORIES)}
    names |= {"ride_key", "window", "start_s", "duration_s", *ride_wind.COLUMNS}
    table = seen.table[[name for name in seen.table if name in names]].iloc[rows].reset_index(drop=True)
    if "driver_id" in seen.rides:
        table["driver_id"] = seen.rides["driver_id"].to_numpy()[seen.ride[rows]]
    return table
