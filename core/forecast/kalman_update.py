"""How what is known of a car (`core.forecast.soc_filter`) is corrected: by a measurement, and by who drives.

What a car takes today, the logarithm `a` less `c`, is what it always takes, its driver's part and the day's. A driver
who becomes known in a shift has driven it all along: a measurement. One who takes over from another is none: the first
one's part is taken out, with the share of what was found today that is likely to be theirs, and the other's put in.

References
----------
Kalman, Journal of Basic Engineering 82 (1960) 35, DOI 10.1115/1.3662552.
"""

from typing import Any

from numba import njit


@njit(cache=True)
def correct(s: Any, off: float, by_s: float, by_a: float, by_c: float, variance: float) -> None:
    """Correct the state by a measurement that is `off`, with its covariances with the state and its own variance."""
    nudge(s, off, by_s, by_a, by_c, variance)
    gain_s, gain_a, gain_c = by_s / variance, by_a / variance, by_c / variance
    s.ss -= gain_s * by_s
    s.sa -= gain_s * by_a
    s.sc -= gain_s * by_c
    s.aa -= gain_a * by_a
    s.ac -= gain_a * by_c
    s.cc -= gain_c * by_c


@njit(cache=True)
def nudge(s: Any, off: float, by_s: float, by_a: float, by_c: float, variance: float) -> None:
    """Move the state by a measurement that is `off`, and make it no surer."""
    s.s += by_s / variance * off
    s.a += by_a / variance * off
    s.c += by_c / variance * off


@njit(cache=True)
def drive(s: Any, wandered: float) -> None:
    """Take who was named meanwhile: they have driven all along, or take over.

    `wandered` is the variance of what `a` may have changed by since the shift began.
    """
    if s.next >= 0.0 and s.next != s.driver:
        if s.driver < 0.0:
            learn_driver(s, wandered)
        else:
            change_driver(s, wandered)
        s.usual += s.next_mean - s.driver_mean
        s.usual_variance += s.next_variance - s.driver_variance
        s.driver, s.driver_mean, s.driver_variance = s.next, s.next_mean, s.next_variance
        s.drivers += 1.0
    s.next = -1.0


@njit(cache=True)
def learn_driver(s: Any, wandered: float) -> None:
    """Take what is known of the driver, as far as it is surer than what was assumed when the shift began."""
    known = s.usual_variance + s.next_variance - s.driver_variance
    if known < s.usual_variance:
        noise = 1.0 / (1.0 / known - 1.0 / s.usual_variance)
        told = noise * ((s.usual + s.next_mean) / known - s.usual / s.usual_variance)
        total = s.aa + s.cc - 2.0 * s.ac + noise + wandered
        correct(s, told - s.a + s.c, s.sa - s.sc, s.aa - s.ac, s.ac - s.cc, total)


@njit(cache=True)
def change_driver(s: Any, wandered: float) -> None:
    """Let another driver take over: of what was found today, the share that was the first one's goes with them."""
    stays = 1.0 - s.driver_variance / (s.usual_variance + wandered)
    by_s, by_c, own = s.sa - s.sc, s.ac - s.cc, s.aa + s.cc - 2.0 * s.ac
    s.a = s.c + s.usual + stays * (s.a - s.c - s.usual) + s.next_mean - s.driver_mean
    s.sa, s.ac = s.sc + stays * by_s, s.cc + stays * by_c
    s.aa = s.cc + 2.0 * stays * by_c + stays**2 * own + stays * s.driver_variance + s.next_variance
