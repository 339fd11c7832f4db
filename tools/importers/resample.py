"""Resample the unevenly spaced rows of a car to evenly spaced samples and keep the integrals."""

import numpy as np

from socast.core.batch import Floats, Ints

LONGEST_HOLD = 30.0
"""A row is valid until the next one. If the next one is later than this, the time between is a gap. [s]"""


def make_grid(duration: float, period: float) -> Floats:
    """Return evenly spaced sample times from 0 to `duration`, both included.

    Units: duration [s], period [s].

    Returns
    -------
    (m,) float64
        Times of the samples. The spacing is the one nearest to `period` that divides `duration`, so that the samples
        cover the whole drive. [s]

    Examples
    --------
    >>> make_grid(10.0, 3.0).tolist()
    [0.0, 3.3333333333333335, 6.666666666666667, 10.0]
    >>> make_grid(0.0, 3.0).tolist()
    [0.0]
    """
    if duration <= 0:
        return np.zeros(1)
    return np.linspace(0.0, duration, max(1, round(duration / period)) + 1)


def find_valid_rows(times: Floats, at: Floats, longest_hold: float = LONGEST_HOLD) -> Ints:
    """Return for each moment the index of the row that is valid then, or -1 in a gap.

    Units: times [s], at [s], longest_hold [s].

    Examples
    --------
    >>> find_valid_rows(np.array([0.0, 1.0, 100.0]), np.array([0.5, 1.0, 50.0, 100.0])).tolist()
    [0, 1, -1, 2]
    """
    rows = np.searchsorted(times, at, side="right") - 1
    until_next = np.append(np.diff(times), 0.0)
    unknown = (rows < 0) | ((until_next[rows] > longest_hold) & (at > times[rows]))
    return np.where(unknown, -1, rows)


def compute_window_means(
    times: Floats, values: Floats, at: Floats, width: float, longest_hold: float = LONGEST_HOLD
) -> Floats:
    """Return the means of a quantity over windows centred on `at`; each row is valid until the next row.

    Units: times [s], at [s], width [s], longest_hold [s].

    Parameters
    ----------
    values : (n,) float64
        Value of each row, NaN if unknown.

    Returns
    -------
    (m,) float64
        Mean over the known part of each window, the value itself if the window has no width, NaN if nothing is known.

    Notes
    -----
    If `at` is spaced by `width` from the first row to the last, the trapezoid rule over the means equals the integral
    of the rows. Each inner mean covers its whole window; the first and the last cover the half that lies inside.

    Examples
    --------
    >>> means = compute_window_means(np.arange(4.0), np.array([2.0, 4.0, 4.0, 0.0]), np.array([0.0, 1.5, 3.0]), 1.5)
    >>> means.round(3).tolist()
    [2.0, 3.667, 4.0]
    """
    step = np.diff(times)
    held = np.where(np.isfinite(values[:-1]) & (step <= longest_hold), step, 0.0)
    integral = np.concatenate(([0.0], np.cumsum(np.where(held > 0, values[:-1], 0.0) * held)))
    known = np.concatenate(([0.0], np.cumsum(held)))
    low, high = at - width / 2, at + width / 2
    span = np.interp(high, times, known) - np.interp(low, times, known)
    total = np.interp(high, times, integral) - np.interp(low, times, integral)
    rows = find_valid_rows(times, at, longest_hold)
    instant = np.where(rows >= 0, values[rows], np.nan) if len(times) == 1 else np.full(len(at), np.nan)
    return np.divide(total, span, out=instant, where=span > 1e-9)
