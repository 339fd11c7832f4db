"""Describe what is missing and not in the library: its form, its size, and the effect that it resembles."""

from types import MappingProxyType
from typing import Final

import numpy as np
from msgspec.structs import replace

from socast.core import effects
from socast.core.batch import Floats
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.forms.suggestion import derive_unit, format_source_file, list_symbols
from socast.core.diagnose.forms.terms import FormTerm
from socast.core.diagnose.gains import compute_correlation
from socast.core.diagnose.inference.loads import LOADS, find_load
from socast.core.diagnose.inference.posterior import ExpectedCause, Inference, LikelyCause
from socast.core.diagnose.inference.window_columns import WindowColumns
from socast.core.diagnose.records import EstimatedCoefficient, UnknownCause
from socast.core.effects.declaration import VARIANT
from socast.core.records import make_interval

REMAINING: Final = 0.02
"""Probability from which a cause of what remains is listed."""
LIKE: Final = 0.5
"""Correlation from which a form resembles an effect of the library on the same load. [1]"""
CONDITIONS: Final = MappingProxyType(
    {
        "pack_temperature": "ambient",
        "sun_sine": "darkness",
        "solar": "darkness",
        "water": "precipitation",
        "snow": "precipitation",
    }
)
"""Signals and variables that stand for the same condition."""
MOTION: Final = frozenset({*LOADS, "acceleration", "air_density", "dt", "mass", "rolling_resistance"})
"""Signals that belong to the load and not to the conditions."""


def describe_unknown(seen: Windows, inference: Inference, *, dated: bool) -> list[UnknownCause]:
    """Return the records of the likely causes outside the library, the most probable first.

    An effect of the library that would need an implausible coefficient stands for such a cause.

    Parameters
    ----------
    dated : bool
        Whether the dates of the rides are known. If they are invented, nothing is said of what began at a date.
    """
    out = [
        replace(
            _describe_size(seen, one, one.variant, derive_unit(one.form)),
            resembles=find_resembling(one.form, one.column, inference.columns),
            forms={formula: part for formula, part in one.forms.items() if part >= REMAINING},
            symbols=list_symbols(one.form),
            file=format_source_file(one.form, one.size.estimate.value, len(seen.measured)),
        )
        for one in inference.findings
        if one.form is not None and one.is_supported
    ]
    kept = [one for one in inference.findings if dated or one.when.since is None]
    library: list[LikelyCause | ExpectedCause] = [*kept, *inference.expected]
    for each in library:
        if each.is_supported and not each.is_plausible:
            cause = _describe_size(seen, each, _word_implausible(each), effects.get(each.effect).unit)
            out.append(replace(cause, resembles=each.effect))
    return sorted(out, key=lambda cause: -(cause.probability or 0.0))


def _describe_size(seen: Windows, one: LikelyCause | ExpectedCause, formula: str, unit: str) -> UnknownCause:
    """Return the record of a cause with its probability, its share of the energy and its coefficient."""
    size = one.size.estimate
    share = float(np.abs(one.column).sum() / seen.measured.sum())
    low, high = size.interval
    return UnknownCause(
        formula=formula,
        probability=one.probability,
        energy_share=share * size.value,
        energy_share_ci95=make_interval(share * low, share * high),
        coefficient=EstimatedCoefficient(value=size.value, ci95=make_interval(low, high), unit=unit),
    )


def _word_implausible(one: LikelyCause | ExpectedCause) -> str:
    """Return how far the coefficient of an effect lies beyond its plausible range, and where it acts."""
    (lowest, largest), value = one.limits, one.size.estimate.value
    times, end = (value / largest, "largest") if value > 0.0 or lowest == 0.0 else (value / lowest, "smallest")
    where = ""
    if isinstance(one, LikelyCause) and one.family.is_scoped:
        since = f" since {one.when.since}" if one.when.since else ""
        where = f" in {'all cars' if one.family.who == 'all' else one.family.who}{since}"
    return f"{one.effect}{where} at {times:.1f} times its {end} plausible coefficient"


def find_resembling(form: FormTerm, energy: Floats, columns: WindowColumns) -> str | None:
    """Return the effect of the library that is most like a form: on the same load, with conditions that it shares."""
    conditions = {CONDITIONS.get(name, name) for name in form.variables}
    found: dict[str, float] = {}
    for at, name in enumerate(columns.names):
        arguments = effects.get(name).arguments
        read = {CONDITIONS.get(each, each) for each in arguments if each not in MOTION}
        if find_load(name) == form.carrier.name and read and read <= conditions:
            effect = name.partition(VARIANT)[0]
            found[effect] = max(found.get(effect, 0.0), compute_correlation(columns.effects[:, at], energy))
    best = max(found, key=lambda name: found[name], default=None)
    return best if best is not None and found[best] > LIKE else None
