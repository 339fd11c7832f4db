"""Calibrate the estimate of a campaign by placebos: the same campaign, moved to other cars and dates.

Where the ratios of placebo estimates to their standard errors have the mean square s², standard errors are multiplied
by scale, and intervals have the quantile of Student's t with f + n degrees of freedom:

    scale² = max(1, (f + n s²) / (f + n)),    f = `PRIOR_FREEDOM`.

Neighbouring dates share most of their days. So n is not the number m of placebos but that of independent ones whose
mean square is as uncertain, m² / Σ R², where R are the correlations of placebo estimates by the model. The prior
counts as much as f independent placebos whose spread is that of the model: a few placebos of one car must not decide,
and fifty may.

References
----------
Abadie, Diamond, Hainmueller, Journal of the American Statistical Association 105 (2010) 493, DOI
10.1198/jasa.2009.ap08746.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.condition.campaign import AFTER, BEFORE, LEAST_DAYS, OUT, Campaign, States
from socast.core.condition.campaign_records import PlaceboCampaign, PlaceboSpread
from socast.core.condition.step_fit import DeviationPanel, StepFit, fit_step

MOST_PLACEBOS: Final = 400
"""Number of placebo campaigns from which dates are skipped evenly."""
PRIOR_FREEDOM: Final = 10.0
"""Number of independent placebo campaigns that the model counts as much as."""


class _Placebo(NamedTuple):
    row: int
    shift: int
    fit: StepFit


def try_placebos(
    panel: DeviationPanel, cars: list[str], campaign: Campaign, rows: list[int], others: Ints
) -> tuple[list[PlaceboCampaign], float]:
    """Return the campaign moved to the cars without one, and to earlier dates of its own cars, and how many count."""
    first, last = panel.dates[0], panel.dates[-1]
    shifts = np.arange(first - last, last - first + 1) if campaign.at is None else panel.dates - campaign.at
    pattern = cars[rows[0]]
    allowed = {int(row): np.ones(len(panel.dates), np.bool_) for row in others}
    allowed |= {row: campaign.classify(cars[row], panel.dates) == BEFORE for row in rows}
    shifts = shifts[:: max(len(allowed) * len(shifts) // (10 * MOST_PLACEBOS), 1)]
    moves = {shift: _move(panel, campaign, pattern, shift) for shift in shifts.tolist()}
    has_days = {row: allowed[row] & np.isfinite(panel.value[row]) for row in allowed}
    moved = [
        (row, shift, state)
        for row in allowed
        for shift, states in moves.items()
        if (state := _keep_days(states, has_days[row])) is not None
    ]
    every = -(-len(moved) // MOST_PLACEBOS)
    tried = [_Placebo(row, shift, fit_step(panel, row, state)) for row, shift, state in moved[:: max(every, 1)]]
    together = 0.0
    for row in allowed:
        weights = np.array([each.fit.weight / each.fit.variance**0.5 for each in tried if each.row == row])
        if len(weights):
            noise = np.where(np.isfinite(panel.value[row]), panel.noise[row], 0.0)
            together += float(((weights @ (panel.wander + np.diag(noise)) @ weights.T) ** 2).sum())
    made = [
        PlaceboCampaign(
            vehicle_id=cars[each.row],
            shift_days=each.shift,
            change=float(np.expm1(each.fit.size)),
            ratio=each.fit.ratio,
        )
        for each in tried
    ]
    return made, len(made) ** 2 / together if together else 0.0


def _move(panel: DeviationPanel, campaign: Campaign, car: str, shift: int) -> States:
    """Return the states of the days of a car as if the campaign was some days later."""
    origin = panel.dates - shift
    state = campaign.classify(car, origin)
    if campaign.at is None:
        state = np.where((origin >= panel.dates[0]) & (origin <= panel.dates[-1]), state, OUT).astype(np.int8)
    return state


def _keep_days(state: States, kept: NDArray[np.bool_]) -> States | None:
    """Return states in which other days are left out, None with too few of those that are left."""
    state = np.where(kept, state, np.int8(OUT))
    enough = min(np.count_nonzero(state == BEFORE), np.count_nonzero(state == AFTER)) >= LEAST_DAYS
    return state if enough else None


def calibrate_errors(placebos: list[PlaceboCampaign], independent: float, ratio: float | None) -> PlaceboSpread:
    """Return the factor of the standard error."""
    ratios = np.array([each.ratio for each in placebos])
    square = float(np.mean(ratios**2)) if len(ratios) else 1.0
    pooled = (PRIOR_FREEDOM + independent * square) / (PRIOR_FREEDOM + independent)
    return PlaceboSpread(
        campaigns=placebos,
        independent=independent,
        spread=square**0.5 if len(ratios) else None,
        scale=max(pooled, 1.0) ** 0.5,
        freedom=PRIOR_FREEDOM + independent,
        as_large=0 if ratio is None else int((np.abs(ratios) >= abs(ratio)).sum()),
    )
