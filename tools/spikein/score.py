"""Score a diagnosis on a recording of the user: put known effects in, and compare what is named with and without."""

import os
from collections.abc import Callable, Mapping, Sequence
from math import hypot, inf
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config
from msgspec.structs import replace
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.batch import Floats
from socast.core.diagnose.add.terms import describe_coefficient
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.deviations import list_credible
from socast.core.diagnose.error_steps import compute_held_out_errors
from socast.core.diagnose.inference.form_search import FormSearch
from socast.core.diagnose.inference.posterior import Inference, LikelyCause, infer_missing
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.selection import MissingEffect, Selection, select_missing
from socast.core.effects.declaration import VARIANT
from socast.core.errors import SocastError
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import get_names
from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.stats.clustered import compute_wilson_interval
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.scores import Estimate
from socast.stream.mcap_reader import McapSource
from socast.tools.simulator.hidden_shapes import get_right_names
from socast.tools.spikein.choice import ScoreChoice
from socast.tools.spikein.recording import NEEDS_WEATHER, write_spiked
from socast.tools.spikein.records import VISIBLE, FoundShare, PlaceboName, SpikeScore, SpikeScores
from socast.tools.spikein.spike import Spike
from socast.tools.terminal.ride_source import tabulate

RECIPE: Final = "road_load_constant"
"""Recipe of the diagnosed model."""
FAINT: Final = 1e-5
"""Size of the effect of a placebo that has the same made-up weather. [1]"""
ALIKE: Final = 0.4
"""Least correlation of an effect of the library with what was put in for it to be its name."""
SAME: Final = {"tyre_pressure": ("tyre_pressure", "brake_drag"), "brake_drag": ("brake_drag", "tyre_pressure")}
"""Effects that have one column in a car of constant mass."""


class Form(NamedTuple):
    """Hold the form of the library that resembles what was put in most.

    Parameters
    ----------
    energy : (n,) float
        Its energy in each window with the coefficient that resembles the truth. [kWh]
    likeness : float
        Share of the squared truth that it explains. [1]
    """

    coefficient: float
    plausible: bool
    energy: Floats
    likeness: float


class Study(NamedTuple):
    """Hold a diagnosis of tables: what is missing in all cars, and the findings within scopes."""

    seen: Windows
    model: LinearModel
    inference: Inference
    selection: Selection
    scoped: tuple[LikelyCause, ...]

    def list_names(self) -> list[tuple[str, str]]:
        """Return each named effect with where it is missing, in the order of the report."""
        everywhere = [(each.effect, "all cars") for each in self.selection.effects]
        return everywhere + [(each.effect, _word_scope(each)) for each in self.scoped]


def _word_scope(found: LikelyCause) -> str:
    """Return where a finding holds."""
    when = f" since {found.when.since}" if found.when.since else ""
    return f"{found.family.who}{when}"


def study_tables(rides: pd.DataFrame, windows: pd.DataFrame) -> Study:
    """Fit a model to tables and infer what it lacks, as `diagnose` does."""
    with threadpool_limits(1):
        model = fit_to_windows(RECIPE, rides, windows, covariance=False)
        seen = gather_windows(rides, windows, model)
        inference = infer_missing(gather_window_columns(seen, model), forms=FormSearch(seen))
        clusters = [ClusterSums(seen.day), ClusterSums(seen.date)]
        selection = select_missing(BaseProjection(seen, model), inference, clusters)
    scoped = tuple(each for each in inference.findings if each.is_likely and each.family.is_scoped)
    return Study(seen, model, inference, selection, scoped)


Method = Callable[[Study], list[str]]
"""Other method of naming: function that returns the effects of a study, the most probable first."""


def score_spikes(
    recordings: Sequence[Path],
    choice: ScoreChoice,
    report: Callable[[float], None] = lambda _: None,
    methods: Mapping[str, Method] = MappingProxyType({}),
) -> SpikeScores:
    """Return how well a diagnosis finds known effects in recordings.

    Parameters
    ----------
    report : callable
        Function that receives the share of the work that is done.
    methods : dict of str to callable
        Other methods, which are judged on the effects that the data can show.

    Raises
    ------
    SocastError
        Where the recordings cannot be read, or hold too few rides to diagnose.
    """
    with TemporaryDirectory(prefix="socast-spikein-") as folder:
        placebos = _make_placebos(recordings, choice, Path(folder))
        plain = placebos[None]
        spikes = choice.list_spikes()
        jobs = (
            delayed(_score_case)(
                recordings, spike, _get_placebo(placebos, spike), Path(folder) / f"{number}.mcap", methods
            )
            for number, spike in enumerate(spikes)
        )
        scores: list[SpikeScore] = []
        refused: dict[str, str] = {}
        with parallel_config(backend="loky", inner_max_num_threads=1):
            results = Parallel(n_jobs=os.cpu_count() or 1, return_as="generator")(jobs)
            for done, (spike, result) in enumerate(zip(spikes, results, strict=True)):
                if isinstance(result, str):
                    refused[spike.effect] = result
                else:
                    scores.append(result)
                report((done + 1) / len(spikes))
        seen = plain.seen
        return SpikeScores(
            recordings=[str(path) for path in recordings],
            rides=len(seen.rides),
            days=int(seen.day.max()) + 1,
            cars=int(seen.vehicle.max()) + 1,
            recipe=RECIPE,
            placebo=_list_placebo_names(plain),
            scores=scores,
            found=[_summarise(size, scores) for size in choice.sizes],
            refused=refused,
        )


def _make_placebos(recordings: Sequence[Path], choice: ScoreChoice, folder: Path) -> dict[int | None, Study]:
    """Return the diagnosis of the recordings as they are, and with the made-up weather of each seed, if needed."""
    sources = [McapSource(path) for path in recordings]
    out: dict[int | None, Study] = {None: study_tables(*_make_tables(recordings))}
    if not any(effect.partition("~")[0] in NEEDS_WEATHER for effect in choice.effects):
        return out
    for seed in choice.seeds:
        file = folder / f"placebo-{seed}.mcap"
        if write_spiked(sources, Spike("headwind", FAINT, seed=seed), file).made_weather:
            out[seed] = study_tables(*_make_tables([file]))
        file.unlink()
    return out


def _get_placebo(placebos: dict[int | None, Study], spike: Spike) -> Study:
    """Return the diagnosis with the same weather as that of a spike."""
    needs = spike.effect.partition("~")[0] in NEEDS_WEATHER
    return placebos.get(spike.seed if needs else None, placebos[None])


def _make_tables(recordings: Sequence[Path]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride and window tables of recordings."""
    pipeline = Pipeline(also=effects.list_tabulated(), keep_forecasts=False, two_sided=True)
    parts: list[tuple[pd.DataFrame, pd.DataFrame]] = []
    tabulate([McapSource(path) for path in recordings], pipeline, lambda *tables: parts.append(tables))
    rides, windows = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    return rides, windows


def _score_case(
    recordings: Sequence[Path], spike: Spike, placebo: Study, file: Path, methods: Mapping[str, Method]
) -> SpikeScore | str:
    """Return what is found of a spike, or why it cannot be put in."""
    try:
        write_spiked([McapSource(path) for path in recordings], spike, file)
        spiked = study_tables(*_make_tables([file]))
        score = compare_studies(spike, placebo, spiked)
        if not (score.visible and score.plausible):
            return score
        right = _list_right_names(spike)
        return replace(
            score, methods={name: is_named_first(rank, placebo, spiked, right) for name, rank in methods.items()}
        )
    except SocastError as error:
        return str(error)
    finally:
        file.unlink(missing_ok=True)
        file.with_name(f"{file.name}.truth.json").unlink(missing_ok=True)


def _list_right_names(spike: Spike) -> tuple[str, ...]:
    """Return the effects of the library that are right names for a spike."""
    return SAME.get(spike.effect.partition("~")[0], get_right_names(spike.effect))


def is_named_first(rank: Method, placebo: Study, spiked: Study, right: Sequence[str]) -> bool:
    """Return whether the first name of a method that is right or not given for the placebo is right."""
    earlier = set(rank(placebo)) - set(right)
    return next((name in right for name in rank(spiked) if name not in earlier), False)


def compare_studies(spike: Spike, placebo: Study, spiked: Study) -> SpikeScore:
    """Return what a diagnosis finds of a spike, against that of the placebo."""
    scoped = bool(spike.vehicles) or spike.since_s is not None
    right = _list_right_names(spike)
    truth = _subtract(spiked.seen, placebo.seen)
    form = _find_form(spiked, truth, right)
    same = len(truth) == len(placebo.seen.measured)
    evidence = _weigh_energy(placebo, truth, truth) if same else None
    names, before = spiked.list_names(), set(placebo.list_names())
    ours = [name for name in names if name[0] in right and (name[1] != "all cars") == scoped]
    new = [name for name in names if name in ours or name not in before]
    ratio = _compare_size(spiked, truth, right, 1.0 if form is None else form.likeness, scoped=scoped)
    variant, probability, estimate, causes, since = _read_finding(spiked, right, scoped=scoped)
    return SpikeScore(
        effect=spike.effect,
        size=spike.size,
        since=None if spike.since_s is None else pd.Timestamp(spike.since_s, unit="s").date().isoformat(),
        seed=spike.seed,
        visible=evidence is not None and evidence > np.log(VISIBLE),
        evidence=evidence,
        form_evidence=_weigh_energy(placebo, truth, form.energy) if same and form is not None else None,
        plausible=form is not None and form.plausible,
        rank=names.index(ours[0]) + 1 if ours else None,
        new_rank=new.index(ours[0]) + 1 if ours else None,
        probability=probability,
        in_credible_set=bool(set(right) & set(list_credible(causes))),
        coefficient=None if estimate is None else describe_coefficient(effects.get(variant), estimate),
        true_coefficient=None if form is None else form.coefficient,
        ratio=None if ratio is None else ratio.value,
        covered=None if ratio is None else _holds_one(ratio),
        found_since=since,
        way=_measure_way(spiked, truth, right) if not scoped else None,
        others=[f"{effect} ({where})" for effect, where in new if (effect, where) not in ours],
    )


def _compare_size(study: Study, truth: Floats, right: Sequence[str], share: float, *, scoped: bool) -> Estimate | None:
    """Return the energy that the right effects find of a truth over what they can find, None where none is named. [1]

    Units: share [1].

    Notes
    -----
    The same effects are fitted with and without the true energies, so that what the car itself has of them does not
    count. The standard error is that of the sizes of the named effects.
    """
    inference = study.inference
    model, columns = inference.model, inference.columns
    gained = model.coefficients - model.shift(-truth).coefficients
    parts = [
        (model.known[:, at] * gained[model.locate_known()][at], each)
        for at, each in enumerate(inference.known)
        if each.effect in right and each.family.is_scoped == scoped
    ] + [
        (columns.common[:, one.at] * (model.scale[:-1] * gained)[model.shared + one.at], each)
        for one, each in zip(columns.expected, inference.expected, strict=True)
        if each.effect in right and each.is_likely and not scoped
    ]
    if not parts:
        return None
    whole = float(truth @ truth) * share
    error = hypot(*(float(each.column @ truth) / whole * each.size.estimate.error for _, each in parts))
    return Estimate(sum(float(energy @ truth) for energy, _ in parts) / whole, error, inf)


def _holds_one(ratio: Estimate) -> bool:
    """Return whether the 95 % interval of a ratio holds 1."""
    low, high = ratio.interval
    return low <= 1.0 <= high


def _subtract(spiked: Windows, placebo: Windows) -> Floats:
    """Return the energy that was put into each window. [kWh]"""
    earlier = dict(zip(_list_keys(placebo), placebo.measured.tolist(), strict=True))
    return np.array(
        [
            energy - earlier.get(key, energy)
            for key, energy in zip(_list_keys(spiked), spiked.measured.tolist(), strict=True)
        ]
    )


def _list_keys(seen: Windows) -> list[tuple[str, float]]:
    """Return the ride and the number of each window; -1 for a whole ride."""
    number = seen.table["window"].fillna(-1.0).tolist() if "window" in seen.table else [-1.0] * len(seen.measured)
    return list(zip(get_names(seen.table, "ride_key"), number, strict=True))


def _weigh_energy(placebo: Study, truth: Floats, energy: Floats) -> float:
    """Return the log likelihood ratio of energies in the recording with the truth, less that in the placebo."""
    model = placebo.inference.model
    return model.shift(truth).weigh(energy) - model.weigh(energy)


def _find_form(spiked: Study, truth: Floats, right: Sequence[str]) -> Form | None:
    """Return the form of the library that resembles a truth most, None where none does."""
    columns = spiked.inference.columns
    acts = truth != 0.0
    best: tuple[float, int, float] | None = None
    for at, name in enumerate(columns.names):
        if name.partition(VARIANT)[0] not in right:
            continue
        own, wanted = columns.effects[acts, at], truth[acts]
        size = float(own @ own)
        if size <= 0.0:
            continue
        likeness = float(own @ wanted) / np.sqrt(size * float(wanted @ wanted))
        if best is None or likeness > best[0]:
            best = likeness, at, float(own @ wanted) / size
    if best is None or best[0] < ALIKE:
        return None
    likeness, at, coefficient = best
    effect = effects.get(columns.names[at])
    plausible = abs(coefficient) <= effect.largest
    return Form(coefficient, plausible, columns.effects[:, at] * coefficient, likeness**2)


def _read_finding(
    study: Study, right: Sequence[str], *, scoped: bool
) -> tuple[str, float | None, Estimate | None, dict[str, float], str | None]:
    """Return variant, probability, size, causes and date of a named effect."""
    if scoped:
        for each in study.scoped:
            if each.effect in right or set(right) & set(list_credible(each.causes)):
                named = each.size.estimate if each.effect in right else None
                return each.variant, each.probability, named, each.causes, each.when.since
        return "", None, None, {}, None
    for missing in study.selection.effects:
        if missing.effect in right or set(right) & set(list_credible(missing.causes)):
            named = missing.size if missing.effect in right else None
            return missing.variant, missing.probability, named, missing.causes, None
    return "", None, None, {}, None


def _measure_way(spiked: Study, truth: Floats, right: Sequence[str]) -> float | None:
    """Return the fall of the error of rides by the named effect over that by the true energies, beside the others."""
    selection = spiked.selection
    ours = [each for each in selection.effects if each.effect in right]
    if not ours:
        return None
    others = [each for each in selection.effects if each.effect not in right]
    known = MissingEffect(ours[0].variant, truth[:, np.newaxis], ours[0].size, 1.0, {})
    errors = [
        float(np.mean(compute_held_out_errors(selection.keep([*others, *more])))) for more in ((), ours[:1], (known,))
    ]
    return (errors[0] - errors[1]) / (errors[0] - errors[2]) if errors[0] > errors[2] else None


def _list_placebo_names(study: Study) -> list[PlaceboName]:
    """Return the names of the placebo, and in how many halves of the dates each comes again."""
    again = [_name_half(study, half) for half in (0, 1)]
    known = all(half is not None for half in again)
    out = []
    for each in study.selection.effects:
        count = sum(each.effect in (half or ()) for half in again)
        coefficient = describe_coefficient(effects.get(each.variant), each.size)
        out.append(
            PlaceboName(
                effect=each.variant,
                where="all cars",
                probability=each.probability,
                coefficient=coefficient,
                halves=count if known else None,
            )
        )
    for found in study.scoped:
        coefficient = describe_coefficient(effects.get(found.variant), found.size.estimate)
        out.append(
            PlaceboName(
                effect=found.variant,
                where=_word_scope(found),
                probability=found.probability,
                coefficient=coefficient,
            )
        )
    return out


def _name_half(study: Study, half: int) -> set[str] | None:
    """Return what is named on every second date, None where these are too few."""
    seen = study.seen
    rides = seen.rides
    dates = {name: place for place, name in enumerate(sorted(set(get_names(rides, "date"))))}
    kept = rides.loc[[dates[name] % 2 == half for name in get_names(rides, "date")]]
    try:
        part = study_tables(kept, seen.table.loc[seen.table["ride_key"].isin(kept["ride_key"])])
    except SocastError:
        return None
    return {each.effect for each in part.selection.effects}


def _summarise(size: float, scores: Sequence[SpikeScore]) -> FoundShare:
    """Return how many effects of a size are found."""
    tried = [score for score in scores if score.size == size]
    visible = [score for score in tried if score.visible and score.plausible]
    named = sum(score.rank is not None for score in visible)
    share = named / len(visible) if visible else None
    return FoundShare(
        size=size,
        tried=len(tried),
        visible=len(visible),
        named=named,
        first=sum(score.new_rank == 1 for score in visible),
        share=share,
        share_ci95=None if share is None else compute_wilson_interval(share, len(visible)),
    )
