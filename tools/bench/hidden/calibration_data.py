"""Make the data sets on which probabilities are calibrated, and compute the evidence of each cause once."""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import permutations
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.posterior.causes import CauseEvidence, SelectedForm, compute_cause_evidence
from socast.core.diagnose.posterior.probabilities import NONE, UNKNOWN
from socast.core.diagnose.projection import BaseProjection
from socast.core.errors import SocastError
from socast.core.fit.recipes import fit_to_windows
from socast.tools.bench.hidden.cases import BARE, Case, SeedData, get_right_names
from socast.tools.bench.hidden.evaluation import describe_case
from socast.tools.bench.hidden.parts import ABSORBED
from socast.tools.simulator.bent_shapes import BENT
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.settings import Hidden

Kind = Literal["none", "one", "two", "outside", "mixed"]

SINGLES: Final = 15
"""Number of data sets with one effect for each seed."""
PAIRS: Final = 3
"""Number of data sets with two effects for each seed."""
CLEAR: Final = 3.0
"""Log evidence above which the larger of two effects counts as one effect where the library lacks the other one."""
PLAIN: Final = 0.35
"""Share of the effects that have their first shape; the others are bent."""


class LabelledEvidence(NamedTuple):
    """Hold the evidence of a data set and its truth.

    Parameters
    ----------
    kind : {"none", "one", "two", "outside", "mixed"}
        Nothing, one effect or two effects are hidden, or one that is removed from the candidates, or two of which one
        is removed while the other one leads.
    truths : tuple of tuple of str
        Right names of each hidden effect; `NONE` or `UNKNOWN` where no effect of the library is right.
    """

    kind: Kind
    seed: int
    truths: tuple[tuple[str, ...], ...]
    evidence: CauseEvidence


def draw_cases(seed: int) -> list[Case]:
    """Return the data sets of a seed: one effect, nothing and two effects hidden, with V·I and SOC only."""
    rng = np.random.default_rng([seed, 77])
    able = [effect for effect in EFFECTS if effect not in ABSORBED]
    cases = []
    for number, effect in enumerate(rng.permutation(able)[:SINGLES].tolist()):
        name = _draw_shape(effect, rng, seed * 100 + number)
        measurement: Literal["vi", "soc"] = "soc" if number % 4 == 3 else "vi"
        share = float(rng.choice([0.015, 0.03])) if measurement == "vi" else 0.03
        share = 0.06 if rng.uniform() < 0.15 else share
        weather: Literal["none", "noisy"] = "noisy" if rng.uniform() < 0.5 else "none"
        cases.append(Case(seed, (Hidden(name, share),), measurement, weather))
    cases += [Case(seed), Case(seed, (), "soc", "noisy")]
    pairable = [effect for effect in able if effect not in BARE]
    for number in range(PAIRS):
        both = rng.choice(pairable, 2, replace=False).tolist()
        hidden = tuple(Hidden(_draw_shape(effect, rng, seed * 100 + 50 + number), 0.03) for effect in both)
        cases.append(Case(seed, hidden, "vi", "noisy" if number == 1 else "none"))
    return sorted(cases, key=lambda case: (case.weather, str(case.hidden)))


def _draw_shape(effect: str, rng: np.random.Generator, number: int) -> str:
    """Return the name of an effect in its first shape, or bent."""
    return effect if rng.uniform() < PLAIN else f"{effect}{BENT}{number}"


def compute_evidence(case: Case, data: SeedData) -> CauseEvidence:
    """Return the evidence of each cause in a data set."""
    tables = data.tables(case)
    model = fit_to_windows(case.recipe, tables.rides, tables.windows)
    windows = gather_windows(tables.rides, tables.windows, model)
    with threadpool_limits(1):
        return compute_cause_evidence(BaseProjection(windows, model), build_candidates(windows, model))


def label_evidence(hidden: Iterable[Sequence[Any]], seed: int, evidence: CauseEvidence) -> list[LabelledEvidence]:
    """Return the evidence of a data set with its truth, and as if the library lacked one of the effects."""
    truths = tuple(get_right_names(str(effect)) for effect, _ in hidden)
    if not truths:
        return [LabelledEvidence("none", seed, ((NONE,),), evidence)]
    if len(truths) > 1:
        mixed = (
            LabelledEvidence("mixed", seed, (names,), drop_effects(evidence, other))
            for names, other in permutations(truths)
        )
        return [LabelledEvidence("two", seed, truths, evidence), *(each for each in mixed if _leads(each))]
    without = drop_effects(evidence, truths[0])
    return [
        LabelledEvidence("one", seed, truths, evidence),
        LabelledEvidence("outside", seed, ((UNKNOWN,),), without),
    ]


def _leads(record: LabelledEvidence) -> bool:
    """Return whether the truth has the largest evidence of all effects, and clearly more than no effect."""
    single = {name: value for name, value in record.evidence.single.items() if np.isfinite(value)}
    best = max(single, key=lambda name: single[name])
    return best in record.truths[0] and single[best] > CLEAR


def drop_effects(evidence: CauseEvidence, names: Iterable[str]) -> CauseEvidence:
    """Return the evidence without some effects.

    Notes
    -----
    The evidence of unknown shapes stays that with the whole library, in which shapes like those of the removed effects
    do not count. It is therefore rather too small.
    """
    gone = set(names)
    return replace(
        evidence,
        single={name: value for name, value in evidence.single.items() if name not in gone},
        forms={name: form for name, form in evidence.forms.items() if name not in gone},
        stiff={name: value for name, value in evidence.stiff.items() if name not in gone},
        beside={name: value for name, value in evidence.beside.items() if name not in gone},
        pairs={pair: value for pair, value in evidence.pairs.items() if not gone & set(pair)},
    )


def make_seed_records(seed: int, keep: Path) -> list[LabelledEvidence]:
    """Return the records of a seed; the evidence that a folder holds is not computed again."""
    path = keep / f"{seed}.json"
    known: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    data = SeedData(seed)
    records = []
    for case in draw_cases(seed):
        key = json.dumps(describe_case(case))
        if key not in known:
            try:
                known[key] = encode_evidence(compute_evidence(case, data))
            except SocastError as error:
                known[key] = str(error)
            beside = path.with_suffix(f".{os.getpid()}")
            beside.write_text(json.dumps(known) + "\n", encoding="utf-8")
            beside.replace(path)
        if not isinstance(known[key], str):
            records += label_evidence(case.hidden, seed, decode_evidence(known[key]))
    return records


def encode_evidence(evidence: CauseEvidence) -> dict[str, Any]:
    """Return evidence as JSON holds it."""
    return asdict(evidence) | {
        "forms": {name: list(form) for name, form in evidence.forms.items()},
        "pairs": [[*pair, value] for pair, value in evidence.pairs.items()],
    }


def decode_evidence(stored: Mapping[str, Any]) -> CauseEvidence:
    """Return evidence from what `encode_evidence` made."""
    forms = {name: SelectedForm(*form) for name, form in stored["forms"].items()}
    pairs = {(first, second): value for first, second, value in stored["pairs"]}
    return CauseEvidence(**{**stored, "forms": forms, "pairs": pairs})
