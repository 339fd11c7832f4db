"""Fit the coefficients that turn the evidence of causes into probabilities, on simulated data sets.

The shapes of the hidden effects are the first and bent ones. The other shapes, and the seeds of the benchmark, judge.

Example: python -m socast.tools.bench.hidden.calibration --seeds 500-521 --keep build/calibration
"""

import argparse
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import log
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from scipy.optimize import minimize

from socast.core.batch import Floats
from socast.core.diagnose.posterior.causes import CauseEvidence
from socast.core.diagnose.posterior.probabilities import (
    CALIBRATION,
    NONE,
    SEVERAL,
    UNKNOWN,
    Calibration,
    Causes,
    compute_probabilities,
)
from socast.core.errors import SocastError
from socast.tools.bench.hidden.calibration_data import Kind, LabelledEvidence, make_seed_records
from socast.tools.bench.hidden.reliability import compute_calibration_error, tabulate_reliability
from socast.tools.bench.nothing_hidden import parse_seeds

WEIGHTS: Final[Mapping[Kind, float]] = MappingProxyType(
    {"none": 0.18, "one": 0.41, "two": 0.14, "outside": 0.18, "mixed": 0.09}
)
"""Share of each kind of data set that the probabilities assume. [1]"""
FAINT_AS_NONE: Final = 0.05
"""Credit for the probability of no effect where an effect outside the library may be too small to see. [1]"""
LEAST_LOG: Final = -12.0
"""Least logarithm of a probability in the loss, so that no single data set decides the fit."""
RIDGE: Final = 1e-4
"""Penalty of the squared coefficients."""
FOLDS: Final = 5
"""Number of groups of seeds that are left out in turn."""


def fit_calibration(records: Sequence[LabelledEvidence], start: Calibration = CALIBRATION) -> Calibration:
    """Return the coefficients with the largest likelihood.

    Parameters
    ----------
    records : sequence of LabelledEvidence
        Evidence with the truth; each kind has its share of `WEIGHTS`, however many records it has.
    """
    lean = [record._replace(evidence=_keep_best_pair(record.evidence)) for record in records]

    def loss(values: Floats) -> float:
        """Return the penalised loss."""
        tried = Calibration(*values.tolist())
        logs = [get_log_probability(r, compute_probabilities(r.evidence, tried)) for r in lean]
        return compute_loss(logs, lean) + RIDGE * float(values @ values)

    found = minimize(loss, np.array(start), method="BFGS")
    return Calibration(*(round(float(value), 3) for value in found.x))


def _keep_best_pair(evidence: CauseEvidence) -> CauseEvidence:
    """Return the evidence with the best pair only, on which alone the probability of several effects depends."""
    if not evidence.pairs:
        return evidence
    best = max(evidence.pairs, key=lambda pair: evidence.pairs[pair])
    return replace(evidence, pairs={best: evidence.pairs[best]})


def get_log_probability(record: LabelledEvidence, causes: Causes) -> float:
    """Return the logarithm of the probability that the truth was given."""
    p = causes.probabilities
    if record.kind == "two":
        given = p.get(SEVERAL, 0.0)
    elif record.kind == "outside":
        given = p.get(UNKNOWN, 0.0) + FAINT_AS_NONE * p[NONE]
    else:
        given = sum(p.get(name, 0.0) for name in record.truths[0])
    return max(log(given), LEAST_LOG) if given > 0.0 else LEAST_LOG


def compute_loss(logs: Sequence[float], records: Sequence[LabelledEvidence]) -> float:
    """Return the mean negative logarithm of the probability of the truth, with each kind at its share."""
    counts = Counter(record.kind for record in records)
    whole = sum(WEIGHTS[kind] for kind in counts)
    shares = (WEIGHTS[record.kind] / counts[record.kind] for record in records)
    return -sum(share * value for share, value in zip(shares, logs, strict=True)) / whole


def predict_left_out(
    records: Sequence[LabelledEvidence], start: Calibration = CALIBRATION, processes: int = 1
) -> list[Causes]:
    """Return the probabilities of each record by a fit to the records of other seeds."""
    seeds = sorted({record.seed for record in records})
    group_of = {seed: number % FOLDS for number, seed in enumerate(seeds)}
    fits = Parallel(n_jobs=processes)(
        delayed(fit_calibration)([r for r in records if group_of[r.seed] != group], start)
        for group in range(min(FOLDS, len(seeds)))
    )
    return [compute_probabilities(r.evidence, fits[group_of[r.seed]]) for r in records]


def describe_predictions(records: Sequence[LabelledEvidence], causes: Sequence[Causes]) -> list[str]:
    """Return the loss of each kind, what leads, and how often a stated probability is right."""
    logs = [get_log_probability(r, c) for r, c in zip(records, causes, strict=True)]
    lines = [f"log loss {compute_loss(logs, records):.4f}"]
    for kind in WEIGHTS:
        some = [i for i, record in enumerate(records) if record.kind == kind]
        if some:
            right = [any(causes[i].first in names for names in records[i].truths) for i in some]
            held = [any(n in causes[i].list_credible_set() for each in records[i].truths for n in each) for i in some]
            size = np.median([len(causes[i].list_credible_set()) for i in some])
            lines.append(
                f"{kind}: {len(some)} data sets, log loss {-np.mean([logs[i] for i in some]):.3f}, "
                f"truth leads {np.mean(right):.1%}, credible set holds it {np.mean(held):.1%}, median size {size:g}"
            )
    counts = Counter(record.kind for record in records)
    led = [
        (c.leading[c.first], any(c.first in names for names in r.truths), WEIGHTS[r.kind] / counts[r.kind])
        for r, c in zip(records, causes, strict=True)
        if r.kind != "two" and c.first not in {NONE, UNKNOWN}
    ]
    stated, weights = [(probability, right) for probability, right, _ in led], [weight for *_, weight in led]
    error = compute_calibration_error(stated, weights)
    lines += [f"expected calibration error of the leading effect {error:.3f}, with each kind at its share", ""]
    return lines + tabulate_reliability(stated, weights)


def main(arguments: list[str] | None = None) -> int:
    """Compute the evidence, fit the coefficients and print them."""
    parser = argparse.ArgumentParser("calibration", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="500-521", help="seeds, such as 420-440 or 7,9")
    parser.add_argument("--keep", type=Path, default=Path("build/calibration"), help="folder for the evidence")
    parser.add_argument("--processes", type=int, default=2, help="number of processes")
    options = parser.parse_args(arguments)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    try:
        seeds = parse_seeds(options.seeds)
    except SocastError as error:
        print(error, file=sys.stderr)
        return 2
    options.keep.mkdir(parents=True, exist_ok=True)
    with parallel_config(backend="loky", inner_max_num_threads=1):
        made = Parallel(n_jobs=options.processes)(delayed(make_seed_records)(seed, options.keep) for seed in seeds)
    records = [record for of_seed in made for record in of_seed]
    fitted = fit_calibration(records)
    console.print(f"{len(records)} records of seeds {options.seeds}\n\nCALIBRATION: Final = {fitted}\n")
    if len(seeds) > 1:
        console.print("Each seed by a fit to other seeds:")
        console.print("\n".join(describe_predictions(records, predict_left_out(records, fitted, options.processes))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
