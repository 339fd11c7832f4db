"""Summarise all records: figures with goals, and how often stated probabilities are right, as a table and a picture."""

from collections.abc import Sequence
from math import isnan, nan
from statistics import median
from typing import Final, NamedTuple

import numpy as np

from socast.core.stats.clustered import compute_wilson_interval
from socast.tools.bench.figures.published import write_table, write_verdict
from socast.tools.bench.hidden.cases import ABSORBED
from socast.tools.bench.hidden.evaluation import LIKELY, Record
from socast.tools.simulator.hidden_shapes import strip_shape

BINS: Final = 10
Stated = Sequence[tuple[float, bool]]
"""Stated probabilities, and whether each name was right."""

FILE: Final = "docs/hidden-reliability.svg"
"""Place of the figure in the repository."""
WIDTH, HEIGHT = 560, 440
LEFT, RIGHT, TOP, BOTTOM = 80, 440, 50, 380
"""Edges of the plot. [px]"""
INK, QUIET, GRID, POINT = "#1f2933", "#5f6b76", "#c9d1d9", "#1f6fb2"
TICKS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
LEAST: Final = {"vi": 0.015, "soc": 0.03}
"""Share of the energy from which on diagnosis should name an effect. [1]"""
SURE: Final = 0.9
"""Probability from which on a name is given as sure. [1]"""
LEAST_WAY: Final = 0.03
"""Share of the error that knowing the truth must remove for the way there to be judged. [1]"""
JUDGED: Final = ("one", "two", "none", "outside")
"""Parts on which probabilities are judged."""


class Bin(NamedTuple):
    """Hold the names within a range of stated probabilities.

    Parameters
    ----------
    low, high : float
        The range. [1]
    stated, right : float
        Mean stated probability and share of right names. [1]
    """

    low: float
    high: float
    stated: float
    right: float
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of right names. [1]"""
        return compute_wilson_interval(self.right, self.of)


def bin_probabilities(stated: Stated) -> list[Bin]:
    """Return the bins of equal width that hold names.

    Examples
    --------
    >>> [(each.low, each.of) for each in bin_probabilities([(0.95, True), (1.0, False), (0.12, False)])]
    [(0.1, 1), (0.9, 2)]
    """
    values = np.array(stated, dtype=np.float64).reshape(-1, 2)
    place, out = np.minimum((values[:, 0] * BINS).astype(np.int64), BINS - 1), []
    for number in np.unique(place).tolist():
        inside = values[place == number]
        probability, right = inside.mean(axis=0).tolist()
        out.append(Bin(number / BINS, (number + 1) / BINS, probability, right, len(inside)))
    return out


def compute_calibration_error(stated: Stated) -> float:
    """Return the expected calibration error: the mean distance of a name's bin from being right as often as stated. [1]

    References
    ----------
    Naeini, Cooper and Hauskrecht, AAAI 2015, 2901, "Obtaining Well Calibrated Probabilities Using Bayesian Binning".
    """
    return (
        sum(each.of * abs(each.right - each.stated) for each in bin_probabilities(stated)) / len(stated)
        if stated
        else nan
    )


def draw_calibration_error(stated: Stated, draws: int = 2000) -> tuple[float, float]:
    """Return the range that holds 95 % of the calibration errors if each name is right as often as stated.

    Few names in a bin differ from their mean probability by chance, so the error of right probabilities is not zero.

    References
    ----------
    Bröcker and Smith, Weather and Forecasting 22 (2007) 651, DOI 10.1175/WAF993.1, consistency resampling.
    """
    if not stated:
        return nan, nan
    rng = np.random.default_rng(0)
    values = [probability for probability, _ in stated]
    right = rng.uniform(size=(draws, len(values))) < np.array(values)
    errors = [compute_calibration_error(list(zip(values, row, strict=True))) for row in right.tolist()]
    low, high = np.quantile(errors, [0.025, 0.975]).tolist()
    return low, high


def tabulate_reliability(stated: Stated) -> list[str]:
    """Return a table of stated probabilities and of how often they are right."""
    rows = [
        [
            f"{100 * each.low:.0f} to {100 * each.high:.0f} %",
            *(f"{100 * share:.0f} %" for share in (each.stated, each.right)),
            f"{100 * low:.0f} to {100 * high:.0f} %",
            f"{each.of:,}",
        ]
        for each in bin_probabilities(stated)
        for low, high in [each.interval]
    ]
    return write_table(["stated probability", "mean stated", "right", "95 % interval", "names"], rows)


def draw_reliability(stated: Stated) -> str:
    """Return the figure of stated probabilities and of how often they are right, with 95 % intervals."""
    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            "role='img' font-family='Helvetica, Arial, sans-serif' font-size='14'>"
        ),
        "<title>Share of right names against the stated probability</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        f"<text x='{LEFT - 60}' y='28' fill='{INK}' font-weight='bold'>Share of names that are right [%]</text>",
    ]
    for tick in TICKS:
        x, y = _across(tick), _down(tick)
        lines += [
            f"<line x1='{LEFT}' x2='{RIGHT}' y1='{y:.1f}' y2='{y:.1f}' stroke='{GRID}'/>",
            f"<text x='{LEFT - 10}' y='{y + 5:.1f}' fill='{QUIET}' text-anchor='end'>{100 * tick:.0f}</text>",
            f"<text x='{x:.1f}' y='{BOTTOM + 22}' fill='{QUIET}' text-anchor='middle'>{100 * tick:.0f}</text>",
        ]
    middle = (LEFT + RIGHT) / 2
    lines += [
        f"<text x='{middle}' y='{BOTTOM + 46}' fill='{QUIET}' text-anchor='middle'>stated probability [%]</text>",
        f"<line x1='{LEFT}' y1='{BOTTOM}' x2='{RIGHT}' y2='{TOP}' stroke='{QUIET}' stroke-dasharray='7 5'/>",
        f"<text x='{RIGHT + 10}' y='{TOP + 5}' fill='{QUIET}'>as stated</text>",
    ]
    for each in bin_probabilities(stated):
        lines += _draw_bin(each)
    return "\n".join([*lines, "</svg>"]) + "\n"


def _draw_bin(each: Bin) -> list[str]:
    """Return the point of a bin, its interval, and its number of names."""
    x, (low, high) = _across(each.stated), each.interval
    return [
        (
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{_down(low):.1f}' y2='{_down(high):.1f}' stroke='{POINT}' "
            "stroke-width='2'/>"
        ),
        f"<circle cx='{x:.1f}' cy='{_down(each.right):.1f}' r='5' fill='{POINT}'/>",
        f"<text x='{x + 8:.1f}' y='{_down(each.right) + 5:.1f}' fill='{POINT}'>{each.of}</text>",
    ]


def _across(probability: float) -> float:
    """Return the horizontal place of a probability. [px]"""
    return LEFT + (RIGHT - LEFT) * probability


def _down(share: float) -> float:
    """Return the vertical place of a share. [px]"""
    return BOTTOM - (BOTTOM - TOP) * share


class Figure(NamedTuple):
    """Hold a figure and its goal.

    Parameters
    ----------
    what, goal : str
        Description and goal; no goal where the figure is only reported.
    text, interval : str
        The value and its 95 % interval as text.
    of : int
        Number of data sets or names behind the value.
    """

    what: str
    goal: str
    value: float
    text: str
    interval: str
    of: int
    met: bool

    @property
    def verdict(self) -> str:
        """Whether the goal is met, as text; empty without a goal."""
        return write_verdict(self.met if self.goal else None)


def compute_figures(records: Sequence[Record]) -> list[Figure]:
    """Return the figures that have goals."""
    vi, soc = select_counted(records, "vi"), select_counted(records, "soc")
    one, two = [*vi, *soc], select_part(records, "two")
    none, outside = select_part(records, "none"), select_part(records, "outside")
    named = [r for r in one if r["names"]]
    stated = list_stated(records)
    sure = [right for probability, right in stated if probability >= SURE]
    contained = [i["holds"] for r in [*select_part(records, "one"), *two] for i in r["intervals"] if i["right"]]
    visible_vi, visible_soc = ([r for r in some if r["visible"]] for some in (vi, soc))
    return [
        _share("V·I, 1.5 % or more, visible: truth first", [is_right(r) for r in visible_vi], least=0.90),
        _share("V·I, 1.5 % or more, all: truth first", [is_right(r) for r in vi], least=0.82),
        _share("SOC only, 3 % or more, visible: truth first", [is_right(r) for r in visible_soc]),
        _share("SOC only, 3 % or more, all: truth first", [is_right(r) for r in soc], least=0.85),
        _share("all of these: wrong name first", [r["outcome"] == "wrong" for r in one], most=0.05),
        _share("all of these: a name that is wrong and sure (90 % or more)", [is_wrong_and_sure(r) for r in one]),
        _share(
            "of these, those with a name: credible set of 90 % holds the truth",
            [r["set_holds"] for r in named],
            0.88,
            0.95,
        ),
        _median_size(named),
        _share("names given with 90 % or more are right", sure, least=0.88),
        _calibration_error(stated),
        _share("truth not in the library: wrong and sure", [is_wrong_and_sure(r) for r in outside], most=0.02),
        _share(
            "truth not in the library, no name: a cause outside it is told",
            [r["unknown"] for r in outside if not r["names"]],
        ),
        _claims(none),
        _share(
            "all data sets: a single car, or a change, is blamed falsely",
            [bool(r["deviations"]) for part in JUDGED for r in select_part(records, part)],
            most=0.05,
        ),
        _share(
            "two effects, both visible: both named with 50 % or more",
            [r["found"] == 2 for r in two if r["visible"]],
            least=0.85,
        ),
        _share("95 % intervals of the coefficient contain the truth", contained, 0.90, 0.98),
        _way(one),
    ]


def select_part(records: Sequence[Record], part: str) -> list[Record]:
    """Return the records of a part that could be made, without effects that the base absorbs."""
    return [r for r in records if r["part"] == part and "refused" not in r and not is_absorbed(r)]


def select_counted(records: Sequence[Record], measurement: str) -> list[Record]:
    """Return the records of one hidden effect that count towards the goal of a measurement."""
    one = select_part(records, "one")
    return [r for r in one if r["measurement"] == measurement and get_share(r) >= LEAST[measurement]]


def list_stated(records: Sequence[Record]) -> Stated:
    """Return the probability of each name of each data set, and whether it is right."""
    judged = [r for part in JUDGED for r in select_part(records, part)]
    return [(name["probability"], name["right"]) for r in judged for name in r["names"]]


def is_right(record: Record) -> bool:
    """Return whether the first name is right."""
    return bool(record["outcome"] == "right")


def is_wrong_and_sure(record: Record) -> bool:
    """Return whether a name is wrong and has a probability of 90 % or more."""
    return any(name["probability"] >= SURE and not name["right"] for name in record["names"])


def is_absorbed(record: Record) -> bool:
    """Return whether columns of the base explain the hidden effect."""
    return any(strip_shape(effect) in ABSORBED for effect, _ in record["hidden"])


def get_share(record: Record) -> float:
    """Return the share of the energy of the first hidden effect."""
    return float(record["hidden"][0][1])


def compute_hit_rate(records: Sequence[Record]) -> float:
    """Return the share of records whose first name is right, NaN without records."""
    return sum(is_right(r) for r in records) / len(records) if records else nan


def compute_error_reduction(records: Sequence[Record]) -> float:
    """Return the reduction of the error divided by that of the model that knows the truth, over all rides together."""
    reduction = sum(r["errors"]["before"] - r["errors"]["after"] for r in records)
    best = sum(r["errors"]["before"] - r["errors"]["truth"] for r in records)
    return reduction / best if best > 0.0 else nan


def select_far(records: Sequence[Record]) -> list[Record]:
    """Return the records in which the model that knows the truth has an error at least `LEAST_WAY` smaller."""
    return [r for r in records if r["errors"]["before"] - r["errors"]["truth"] > LEAST_WAY * r["errors"]["before"]]


def summarise_timing(records: Sequence[Record]) -> tuple[float, float, int]:
    """Return the median time of diagnosis [s], its ratio to that of sparse regression, and the number of timings."""
    timed = [r for r in records if r.get("stlsq_seconds")]
    if not timed:
        return nan, nan, 0
    seconds = float(np.median([r["seconds"] for r in timed]))
    return seconds, seconds / float(np.median([r["stlsq_seconds"] for r in timed])), len(timed)


def format_rate(successes: Sequence[bool]) -> str:
    """Return a share in per cent with its 95 % interval.

    Examples
    --------
    >>> format_rate([True, True, False, True])
    '75 % (30 to 95)'
    """
    if not successes:
        return ""
    share = sum(successes) / len(successes)
    low, high = compute_wilson_interval(share, len(successes))
    return f"{100 * share:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _share(what: str, successes: Sequence[bool], least: float = 0.0, most: float = 1.0) -> Figure:
    """Return the figure of a share, with a goal where a bound is given."""
    value = sum(successes) / len(successes) if successes else nan
    if least == 0.0 and most == 1.0:
        goal = ""
    elif least == 0.0:
        goal = f"{100 * most:g} % or less"
    else:
        goal = f"{100 * least:g} % or more" if most == 1.0 else f"{100 * least:g} to {100 * most:g} %"
    text = "" if isnan(value) else f"{100 * value:.1f} %"
    return Figure(
        what, goal, value, text, _format_interval(value, len(successes)), len(successes), least <= value <= most
    )


def _format_interval(share: float, count: int) -> str:
    """Return Wilson's 95 % interval of a share as text; empty without data sets."""
    if not count:
        return ""
    low, high = compute_wilson_interval(share, count)
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def _median_size(records: Sequence[Record]) -> Figure:
    """Return the figure of the size of credible sets."""
    value = float(median(r["set_size"] for r in records)) if records else nan
    text = "" if isnan(value) else f"{value:g}"
    return Figure("its median size", "2 or less", value, text, "", len(records), value <= 2.0)


def _calibration_error(stated: Stated) -> Figure:
    """Return the figure of the calibration error of the names."""
    value = compute_calibration_error(stated)
    what = "expected calibration error of the names"
    low, high = draw_calibration_error(stated)
    by_chance = "" if isnan(value) else f"by chance alone: {low:.3f} to {high:.3f}"
    text = "" if isnan(value) else f"{value:.3f}"
    return Figure(what, "0.05 or less", value, text, by_chance, len(stated), value <= 0.05)


def _claims(none: Sequence[Record]) -> Figure:
    """Return the figure of names given as likely although nothing is hidden."""
    counts = [sum(name["probability"] >= LIKELY for name in r["names"]) for r in none]
    value = sum(counts) / len(counts) if counts else nan
    any_name = sum(count > 0 for count in counts) / len(counts) if counts else nan
    interval = f"data sets with any: {_format_interval(any_name, len(counts))}" if counts else ""
    return Figure(
        "nothing hidden: names with 50 % or more per data set",
        "0.02 or less",
        value,
        "" if isnan(value) else f"{value:.3f}",
        interval,
        len(counts),
        value <= 0.02,
    )


def _way(records: Sequence[Record]) -> Figure:
    """Return the figure of the error reduction, over data sets where the truth would reduce the error clearly."""
    far = select_far(records)
    value = compute_error_reduction(far)
    return Figure(
        "fall of the error by adding the names, relative to that of the model that knows the truth, where that is "
        "above 3 %",
        "90 % or more",
        value,
        "" if isnan(value) else f"{100 * value:.0f} %",
        "",
        len(far),
        value >= 0.90,
    )
