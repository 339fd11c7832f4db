"""Diagnose a model: where it fails, which effects it lacks, how certain that is, and what error remains.

Each step is a module of its own:

1. `dataset` collects the windows, and `core.fit.measurement_noise` their measurement noise.
2. `projection` removes what the model could explain if it were refitted; `episodes` finds hours of a few dates that no
   effect explains, which the further steps leave out.
3. `inference` gives the probability and the size of every effect of the library in all cars, in one car or a group,
   always or since a date. `selection` and `deviations` read from it what is missing, in which car and since when.
4. Forms outside the library (`forms`) are weighed by the same inference.
5. `slices` finds groups of rides with a different bias.
6. `error_location` tells between which units (rides, days, cars) the error varies, and by which kind of load.
7. `partial_residual`, `residual_profile` and `error_steps` compute the data of the report's figures.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd
from msgspec.structs import replace
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.batch import Floats
from socast.core.diagnose.add.holdout import drop_dates, select_final_days
from socast.core.diagnose.add.records import list_attempts
from socast.core.diagnose.add.terms import describe_coefficient
from socast.core.diagnose.candidates import NOT_IDENTIFIABLE, Candidates, build_candidates
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.deviations import describe_deviations, list_credible, rank_cars
from socast.core.diagnose.episodes import find_episodes
from socast.core.diagnose.error_location.locate import locate_error
from socast.core.diagnose.error_steps import compute_steps
from socast.core.diagnose.inference.alternatives import count_dates
from socast.core.diagnose.inference.events import KnownEvent
from socast.core.diagnose.inference.form_search import FormSearch
from socast.core.diagnose.inference.groups import list_groups
from socast.core.diagnose.inference.posterior import Inference, infer_missing
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.diagnose.partial_residual import compute_partial_residual
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import (
    NONE,
    BiasedBin,
    CauseProbability,
    DiagnosedData,
    DiagnosedModel,
    Diagnosis,
    ErrorSummary,
    HeldOutRides,
    NamedEffect,
    RivalEffect,
    TestedEffect,
)
from socast.core.diagnose.residual_profile import profile_residual
from socast.core.diagnose.selection import UNKNOWN_GAIN, MissingEffect, Selection, list_scoped, select_missing
from socast.core.diagnose.slices.search import find_slices
from socast.core.diagnose.unknown_causes import REMAINING, describe_unknown
from socast.core.evaluate.compare.models import ComparedRides, compute_errors_by_condition
from socast.core.fit.measurement_noise import compute_noise_floor, compute_noise_variance, is_metered
from socast.core.fit.ride_blocks import ENERGY, assign_vehicle_days, get_names, get_numbers
from socast.core.models import LinearModel
from socast.core.models.features import EFFECT_PREFIX
from socast.core.models.plausibility import describe_implausible
from socast.core.records import make_interval
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.random_effects import link_units

LEAST_DAYS_FOR_SCOPES: Final = 12
"""Vehicle-days below which effects are not tested within scopes."""
MAIN_SHARE: Final = 0.95
"""Share of the windows above which one way of measuring is reported for all of them."""
ONE_SIGN_SHARE: Final = 0.8
"""Share of the absolute energy of an effect that must have one sign for the report to show that sign."""
UNDATED: Final = frozenset({"season", "time of day"})
"""Conditions of rides that invented dates do not show."""
WRONG_SIGN_Z: Final = 3.0
"""Standard errors above which a coefficient of the sign that physics forbids is reported as such."""


def diagnose(
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    model: LinearModel,
    *,
    leave_out: Collection[str] | None = None,
    without: Collection[str] = (),
    least_gain: float = 0.0,
    places: bool = True,
    groups: Mapping[str, str] | None = None,
    events: Sequence[KnownEvent] = (),
    seed: int = 0,
    dated: bool = True,
    report: Callable[[float, str], None] = lambda *_: None,
) -> Diagnosis:
    """Return where a model fails, which effects it lacks, and what error remains.

    Parameters
    ----------
    leave_out : collection of str, optional
        ISO dates whose rides are not used. By default those on which `add` evaluates once it has decided, see
        `socast.core.diagnose.add.holdout.select_final_days`; an empty collection for none.
    least_gain : float
        Share of the squared error of rides that an effect must explain on held-out days to be reported; 0 for no
        limit beside its probability. [1]
    places : bool
        Whether to test whether single cars deviate from their siblings, and what changed since a date.
    groups : mapping of str to str, optional
        Vehicle -> its group, such as a depot.
    events : sequence of KnownEvent
        Known events after which a car may have changed; each is a candidate of its own.
    dated : bool
        Whether the dates of the rides are known. If they are invented, nothing is said of what began at a date, and of
        seasons and hours.
    report : callable
        Function that receives, before each step, the share of the work that is done, and the step in words.
    """
    with threadpool_limits(1):  # matrices are small, so threads would wait, and sums would depend on their number
        dates = get_names(rides, "date")
        final = select_final_days(model.history, dates)
        held_out = tuple(sorted(set(final if leave_out is None else leave_out) & set(dates)))
        kept = drop_dates(rides, windows, held_out)
        seen = gather_windows(*kept, model)
        result = _diagnose(
            seen, model, without, least_gain, groups, events, places=places, seed=seed, dated=dated, report=report
        )
    recorded = {date for attempt in list_attempts(model.history) if attempt.final for date in attempt.final.dates}
    unused = HeldOutRides(
        dates=list(held_out),
        rides=len(rides) - len(kept[0]),
        final=bool(held_out) and set(held_out) <= set(final),
        in_history=bool(held_out) and set(held_out) <= recorded,
    )
    return replace(result, data=replace(result.data, held_out=unused))


def _diagnose(
    seen: Windows,
    model: LinearModel,
    without: Collection[str],
    least_gain: float,
    groups: Mapping[str, str] | None,
    events: Sequence[KnownEvent],
    *,
    places: bool,
    seed: int,
    dated: bool,
    report: Callable[[float, str], None],
) -> Diagnosis:
    """Return the result of `diagnose` for windows."""
    base, candidates = BaseProjection(seen, model), build_candidates(seen, model, without)
    report(0.02, "comparing dates")
    episodes, base = find_episodes(base, candidates)
    report(0.03, "locating the error")
    location = locate_error(seen, base)
    report(0.3, "weighing the effects")
    ignored = np.any([each.rows for each in episodes], axis=0) if episodes else None
    columns = gather_window_columns(seen, model, without, ignored)
    inference = infer_missing(
        columns,
        [effects.get(name).base for name in model.effects],
        list_groups(seen, columns, groups or {}),
        events,
        scopes=places and int(seen.day.max()) + 1 >= LEAST_DAYS_FOR_SCOPES,
        forms=FormSearch(seen),
        seed=seed,
        report=lambda done: report(0.3 + 0.5 * done, "weighing the effects"),
    )
    clusters = [ClusterSums(seen.day), ClusterSums(seen.date)]
    selection = select_missing(base, inference, clusters, seed, least_gain)
    missing = selection.effects
    named = selection.keep((*missing, *list_scoped(inference, dated=dated)))
    floor = compute_noise_floor(compute_noise_variance(seen.rides))
    report(0.9, "searching for slices")
    error = seen.by_ride(seen.predicted - seen.measured)
    for each in episodes:
        error[seen.ride[each.rows]] = np.nan  # such rides would be a slice of their own
    return Diagnosis(
        model=DiagnosedModel(
            name=model.name, version=model.version, recipe=model.recipe, implausible=describe_implausible(model)
        ),
        data=_describe_data(seen, dated=dated),
        episodes=[each.to_record() for each in episodes],
        error=_describe_error(seen, model, base, floor),
        error_location=location,
        slices=find_slices(seen.rides, error, seed=seed, dated=dated),
        biased_bins=_find_biased_bins(seen, dated=dated),
        missing=[_describe_missing(finding, selection, candidates) for finding in missing],
        tested=_tabulate_candidates(inference, candidates, selection.keep(()).on(base), missing),
        verdict=missing[0].effect if missing else None,
        causes=_list_causes(missing[0]) if missing else _list_remaining(inference, ()),
        credible_set=list_credible(missing[0].causes) if missing else [NONE],
        further=_list_remaining(inference, missing) if missing else [],
        further_credible_set=[NONE] if missing else [],
        unknown=describe_unknown(seen, inference, dated=dated),
        steps=compute_steps(selection.on(base), floor),
        profiles=profile_residual(named),
        deviations=describe_deviations(seen, inference, dated=dated),
        cars=rank_cars(inference),
    )


def _describe_data(seen: Windows, *, dated: bool) -> DiagnosedData:
    """Return the number of rides and windows, their dates, and how their energy was measured."""
    metered = is_metered(seen.table)
    measured = "vi" if metered.mean() > MAIN_SHARE else "soc" if metered.mean() < 1.0 - MAIN_SHARE else "mixed"
    length = float(np.median(get_numbers(seen.table, "duration_s")))
    resolution = {
        "vi": f"voltage and current, in windows of about {length:.0f} s",
        "soc": f"the state of charge, in windows of a whole ride of about {length:.0f} s",
        "mixed": "voltage and current in windows of about one minute; where they are missing, state of charge by ride",
    }
    dates = sorted(date for date in get_names(seen.table, "date") if date)
    return DiagnosedData(
        rides=len(seen.rides),
        windows=len(seen.table),
        vehicles=int(seen.vehicle.max()) + 1,
        days=int(seen.day.max()) + 1,
        first_date=dates[0] if dates else None,
        last_date=dates[-1] if dates else None,
        measured=measured,
        resolution_s=length,
        resolution=resolution[measured],
        left_out=dict(seen.left_out),
        dated=dated,
    )


def _describe_error(seen: Windows, model: LinearModel, base: BaseProjection, floor: float) -> ErrorSummary:
    """Return the errors of the model per ride, as given and refitted to windows. [kWh]"""
    # whole rides, as forecasts and comparisons predict them: a constant does not add up over the windows of a ride
    used = get_numbers(seen.rides, ENERGY)
    error = model.predict_energy(seen.rides) - used
    refitted = seen.by_ride(base.convert_to_energy(base.residual))
    mae = float(np.mean(np.abs(error)))
    return ErrorSummary(
        mae_kwh=mae,
        relative=mae / float(np.mean(used)) if float(np.mean(used)) > 0.0 else None,
        bias_kwh=float(np.mean(error)),
        mae_refitted_kwh=float(np.mean(np.abs(refitted))),
        noise_floor_kwh=floor,
    )


def _find_biased_bins(seen: Windows, *, dated: bool) -> list[BiasedBin]:
    """Return the bins of a part of the rides that `socast compare` marks, the largest bias first."""
    measured, predicted = seen.by_ride(seen.measured), seen.by_ride(seen.predicted)
    rides = ComparedRides(seen.rides, measured, {}, assign_vehicle_days(seen.rides), len(measured), {})
    found = [
        BiasedBin(condition=condition, bin=one.bin, rides=one.n, bias_kwh=one.bias_kwh)
        for condition, bins in compute_errors_by_condition(rides, predicted).items()
        for one in bins
        if one.is_significant and one.n < len(measured) and (dated or condition not in UNDATED)
    ]
    return sorted(found, key=lambda one: -abs(one.bias_kwh.value or 0.0))


def _describe_missing(finding: MissingEffect, selection: Selection, candidates: Candidates) -> NamedEffect:
    """Return the record of a missing effect."""
    seen = selection.base.windows
    effect, size = effects.get(finding.variant), finding.size
    energy = finding.column[:, 0] * size.value
    credible = list_credible(finding.causes)
    coefficient = describe_coefficient(effect, size)
    return NamedEffect(
        effect=finding.effect,
        variant=finding.variant,
        probability=finding.probability * finding.causes.get(finding.effect, 1.0),
        causes=_list_causes(finding),
        credible_set=credible,
        columns=[f"{EFFECT_PREFIX}{finding.variant}"],
        gain=finding.gain.value,
        gain_ci95=make_interval(*finding.gain.interval),
        energy_share=np.abs(energy).sum() / seen.measured.sum(),
        effective_dates=float(count_dates(np.abs(energy)[np.newaxis], link_units(seen.date))[0]),
        z=size.value / size.error,
        coefficient=coefficient,
        words=effect.in_words(size.value, size.ci95),
        equivalents=_list_equivalents(energy, seen),
        separate=[
            RivalEffect(effect=name, correlation=r, data=effects.get(name).shown_by)
            for name, r in selection.correlate(finding, candidates, credible)
        ],
        partial_residual=compute_partial_residual(selection, finding),
    )


def _list_causes(finding: MissingEffect) -> list[CauseProbability]:
    """Return the effects that explain the same as a missing effect, and none, the most probable first."""
    chances = {name: share * finding.probability for name, share in finding.causes.items()}
    return _rank_causes(chances | {NONE: 1.0 - finding.probability})


def _list_remaining(inference: Inference, missing: Sequence[MissingEffect]) -> list[CauseProbability]:
    """Return the effects that may be missing beside the others, and none, the most probable first."""
    named = {one.effect for one in missing}
    chances = {name: chance for name, chance in inference.chances.items() if name not in named and chance >= REMAINING}
    none = float(np.prod([1.0 - chance for chance in chances.values()]))
    scale = (1.0 - none) / max(sum(chances.values()), 1e-300)
    return _rank_causes({name: scale * chance for name, chance in chances.items()} | {NONE: none})


def _rank_causes(chances: Mapping[str, float]) -> list[CauseProbability]:
    """Return the records of causes, the most probable first."""
    ranked = sorted(chances.items(), key=lambda item: -item[1])
    return [CauseProbability(effect=name, probability=chance) for name, chance in ranked]


def _list_equivalents(energy: Floats, seen: Windows) -> list[str]:
    """Return the power, the mass and the headwind that would use as much energy in the windows where an effect acts.

    For an effect that costs energy in some windows and saves it in others, such as wind along the road, the absolute
    energy counts, and the values have the sign ±.
    """
    table = seen.table
    acts = np.abs(energy) > 0.0
    net, total = float(energy.sum()), float(np.abs(energy).sum())
    hours = float(get_numbers(table, "duration_s")[acts].sum()) / 3600.0
    if hours <= 0.0:
        return []
    sign = "±" if abs(net) < ONE_SIGN_SHARE * total else "+" if net > 0.0 else "-"
    equal = [f"{sign}{1000.0 * total / hours:,.0f} W"]
    mass = get_numbers(table, "mass_kg")
    road = get_numbers(table, "effect_rolling") * get_numbers(table, "rolling_resistance") + get_numbers(
        table, "effect_climbing"
    )
    per_kg = float(np.nansum((road / mass)[acts]))
    if per_kg > 0.0:
        equal.append(f"{sign}{total / per_kg:,.0f} kg")
    drag, speed = get_numbers(table, "effect_aero_drag"), get_numbers(table, "average_speed_kmh") / 3.6
    per_wind = float(np.nansum((2.0 * drag * get_numbers(table, "drag_area_m2") / np.maximum(speed, 1.0))[acts]))
    if per_wind > 0.0:
        equal.append(f"{sign}{total / per_wind:.1f} m/s of headwind")
    return equal


def _tabulate_candidates(
    inference: Inference, candidates: Candidates, alone: Selection, missing: Sequence[MissingEffect]
) -> list[TestedEffect]:
    """Return all effects that were tested in all cars, the most probable first, then those that were not."""
    rows = []
    expected = {one.effect: one for one in inference.expected}
    chances = inference.chances | {name: one.probability for name, one in expected.items()}
    stated = _list_stated(missing, chances)
    for name in candidates.names:
        if name in inference.unidentified or not (name in expected or name in inference.alone):
            rows.append(TestedEffect(effect=name, variant=name, status=NOT_IDENTIFIABLE))
            continue
        if name in expected:
            size = expected[name].size.estimate
            variant, z = name, size.value / size.error
        else:
            variant, z = inference.alone[name]
        row = TestedEffect(effect=name, variant=variant, z=z, probability=stated[name])
        column = candidates.columns[:, [candidates.variants.index(variant)]]
        gain = alone.compute_gain(MissingEffect(variant, column, UNKNOWN_GAIN, stated[name], {}))
        sign = int(candidates.sign[candidates.variants.index(variant)])
        rows.append(replace(row, gain=gain.value, status=_describe_status(row, sign, missing)))
    rows.sort(key=lambda row: (-(row.probability if row.probability is not None else -1.0), -(row.gain or 0.0)))
    absent = [TestedEffect(effect=name, variant=name, status=why) for name, why in candidates.excluded.items()]
    return rows + absent


def _list_stated(missing: Sequence[MissingEffect], chances: Mapping[str, float]) -> dict[str, float]:
    """Return the probabilities of effects, those of missing ones and of their rivals as their records give them."""
    stated = dict(chances)
    for one in missing:
        stated |= {name: max(stated.get(name, 0.0), share * one.probability) for name, share in one.causes.items()}
    return stated | {one.effect: one.probability * one.causes.get(one.effect, 1.0) for one in missing}


def _describe_status(row: TestedEffect, sign: int, missing: Sequence[MissingEffect]) -> str:
    """Return the result for a candidate."""
    if row.effect in {finding.effect for finding in missing}:
        return "missing"
    for finding in missing:
        if row.effect in list_credible(finding.causes):
            return f"not distinguishable from {finding.effect}"
    if row.z is not None and sign * row.z < -WRONG_SIGN_Z:
        return "wrong sign"
    return "not needed" if row.z is not None and sign * row.z > WRONG_SIGN_Z else "not there"
