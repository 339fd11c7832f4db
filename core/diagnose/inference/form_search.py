"""Choose forms outside the library that may explain windows: a carrier of energy times functions of variables.

Each form is weighed alone beside what a model knows, as an effect of the library is. The best forms are tried with a
second and a third variable. A form that is a missing effect of the library in other words is left out.

All forms share the prior probability that something outside the library is missing: half of it belongs to those of at
most one variable, a quarter to those of two, an eighth to those of three.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations
from math import inf, log, prod
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from socast.core.batch import Floats
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.forms.building_blocks import CARRIERS, VARIABLES
from socast.core.diagnose.forms.suggestion import format_formula
from socast.core.diagnose.forms.terms import FormTerm, Modulator, list_modulators
from socast.core.diagnose.inference.alternatives import LEAST_LEFT, count_dates, factorise_free, weigh_alone
from socast.core.diagnose.inference.loads import find_load
from socast.core.diagnose.inference.window_columns import UnknownForm
from socast.core.diagnose.inference.window_model import WindowModel
from socast.core.effects.declaration import VARIANT
from socast.core.stats.random_effects import link_units

SHARE: Final = 0.05
"""Standard deviation beforehand of the energy of a form, as a share of all energy. [1]"""
KEPT: Final = 16
"""Number of forms that are kept each time."""
LEAST_DATES: Final = 6.0
"""Effective number of dates on which a form must act. What acts on fewer is an episode. [1]"""
ALIKE: Final = 2
"""Largest number of kept forms with the same carrier and variables."""
SAME: Final = 0.9
"""Least absolute correlation, the base projected out, from which a form counts as an effect on its load. [1]"""
EXTENDED: Final = (6, 3)
"""Numbers of forms that are tried with a second and with a third variable."""


class _Scores(NamedTuple):
    """Hold forms, and the log odds of each against none."""

    forms: list[UnknownForm]
    odds: Floats


class _Library:
    """Tell which forms count as effects of the library that may be missing.

    Parameters
    ----------
    inside : collection of str
        Effects that the model has, which do not count.
    """

    def __init__(self, model: WindowModel, inside: Collection[str]) -> None:
        columns = model.columns
        at = [place for place, name in enumerate(columns.names) if name.partition(VARIANT)[0] not in inside]
        self._root = np.sqrt(model.weight / model.variance)[:, np.newaxis]
        self._basis, _ = np.linalg.qr(self._root * np.column_stack([columns.base, columns.common]))
        self._loads = [find_load(columns.names[place]) for place in at]
        self._left = self._project(columns.effects[:, at])

    def _project(self, energy: Floats) -> Floats:
        """Return energies after the base is projected out, each of unit length; (n, k) to (n, k). [kWh to 1]"""
        scaled = self._root * energy
        left = scaled - self._basis @ (self._basis.T @ scaled)
        length = np.sqrt((left**2).sum(axis=0))
        return np.asarray(left / np.maximum(length, 1e-6 * np.sqrt((scaled**2).sum(axis=0)) + 1e-300))

    def has(self, load: str, energy: Floats) -> bool:
        """Return whether a form of the energy, on the load of that name, counts as an effect of the library. [kWh]"""
        at = [place for place, other in enumerate(self._loads) if other == load]
        own = self._project(energy[:, np.newaxis])[:, 0]
        return bool(np.abs(self._left[:, at].T @ own).max(initial=0.0) >= SAME)


class FormSearch:
    """Search for forms that may explain some windows.

    Parameters
    ----------
    windows : Windows
        Windows whose table has the energies of the loads.
    """

    def __init__(self, windows: Windows) -> None:
        table, self._measured = windows.table, float(np.abs(windows.measured).sum())
        values: dict[str, Floats] = {}
        for variable in VARIABLES:
            value = variable.value(table)
            if not any(np.array_equal(value, other) for other in values.values()):  # one may stand for an unknown other
                values[variable.name] = value
        self._modulators = {
            each.name: list(list_modulators(each, values[each.name])) for each in VARIABLES if each.name in values
        }
        self._values = {
            modulator: modulator.evaluate(values[name])
            for name, modulators in self._modulators.items()
            for modulator in modulators
        }
        self._carriers = {carrier.name: carrier.energy(table) for carrier in CARRIERS}
        sizes = [len(each) for each in self._modulators.values()]
        # a carrier has so many forms of at most one variable, of two, and of three; they share 1/2, 1/4 and 1/8
        numbers = [1 + sum(sizes), *(sum(map(prod, combinations(sizes, of))) for of in range(2, len(EXTENDED) + 2))]
        shares = [log(0.5 ** (at + 1) / (len(CARRIERS) * max(number, 1))) for at, number in enumerate(numbers)]
        self._log_share = [shares[0], *shares]  # by the number of variables, from none on

    def extend(self, model: WindowModel, inside: Collection[str] = ()) -> WindowModel:
        """Return the model with the best forms beside what it knows among the columns that may be missing.

        Parameters
        ----------
        inside : collection of str
            Effects that the model has in all cars, so that they are not missing; other forms of them may be.
        """
        columns, evidence = model.columns, _Evidence(model)
        found = [self._score_longer(evidence, FormTerm(carrier)) for carrier in CARRIERS]
        for variables, extended in enumerate(EXTENDED, 1):
            heads: dict[tuple[str, frozenset[str]], FormTerm] = {}
            for form in _rank(found):
                if len(form.term.modulators) == variables and len(heads) < extended:
                    heads.setdefault((form.term.carrier.name, form.term.variables), form.term)
            found += [self._score_longer(evidence, head) for head in heads.values()]
        known = {format_formula(form.term) for form in columns.unknown}
        alike: Counter[tuple[str, frozenset[str]]] = Counter()
        chosen = []
        library = _Library(model, inside)
        for form in _rank(found):
            key = form.term.carrier.name, form.term.variables
            is_full = alike[key] >= ALIKE or alike.total() >= KEPT
            if is_full or library.has(form.term.carrier.name, self._build_energy(form.term)):
                continue
            alike[key] += 1
            if format_formula(form.term) not in known:
                chosen.append(form)
        energies = [self._build_energy(form.term) for form in chosen]
        return model.replace_columns(
            replace(
                columns,
                effects=np.column_stack([columns.effects, *energies]),
                unknown=(*columns.unknown, *chosen),
            )
        )

    def _build_energy(self, term: FormTerm) -> Floats:
        """Return the energy of a form in each window, per unit of its coefficient. [kWh]"""
        energy = self._carriers[term.carrier.name]
        for each in term.modulators:
            energy = energy * self._values[each]
        return energy

    def _find_place(self, modulator: Modulator) -> int:
        """Return the place of the variable of a modulator, so that equal forms have equal formulas."""
        return list(self._modulators).index(modulator.variable.name)

    def _score_longer(self, evidence: "_Evidence", head: FormTerm) -> _Scores:
        """Return a form without variables and those with one variable more, or only these if it has a variable."""
        longer = [
            FormTerm(head.carrier, tuple(sorted((*head.modulators, each), key=self._find_place)))
            for name, modulators in self._modulators.items()
            for each in modulators
            if name not in head.variables and name not in head.carrier.without
        ]
        terms = longer if head.modulators else [head, *longer]
        if not terms:
            return _Scores([], np.empty(0))
        energy = np.column_stack([self._build_energy(term) for term in terms])
        size = SHARE * self._measured / np.maximum(np.abs(energy).sum(axis=0), 1e-300)
        forms = [
            UnknownForm(term, one, self._log_share[len(term.modulators)])
            for term, one in zip(terms, size.tolist(), strict=True)
        ]
        odds = evidence.compute(energy, size) + np.array([form.log_share for form in forms])
        return _Scores(forms, np.where(evidence.count_dates(energy) < LEAST_DATES, -np.inf, odds))


class _Evidence:
    """Compute the evidence of forms beside what a model knows.

    Notes
    -----
    With I + XᵀX/σ² = L Lᵀ of the columns X of the model, a form x off the model has the squared length
    xᵀx/σ² - |L⁻¹Xᵀx/σ²|². Its product with the energy follows in the same way.
    """

    def __init__(self, model: WindowModel) -> None:
        size = model.size
        self._products = model.prepare_products()
        self._lower = np.linalg.cholesky(np.eye(size) + model.total[:size, :size])
        self._energy = solve_triangular(self._lower, model.total[:size, size], lower=True)
        self._free = factorise_free(model)
        self._adding = link_units(model.columns.date_of_day[model.columns.day])

    def compute(self, energy: Floats, size: Floats) -> Floats:
        """Return the log evidence of each form alone; minus infinity where a free base could explain it.

        Parameters
        ----------
        energy : (n, m) float
            Energies of the forms. [kWh]
        size : (m,) float
            Standard deviation of the coefficient of each beforehand.
        """
        raw, beside = self._products.multiply(energy * size)
        along = solve_triangular(self._lower, beside[:-1], lower=True)
        match = beside[-1] - along.T @ self._energy
        own = np.maximum(raw - (along**2).sum(axis=0), 0.0)
        loose = solve_triangular(self._free, beside[:-1], lower=True)
        left = raw - (loose**2).sum(axis=0)
        return np.where(left > LEAST_LEFT * raw, weigh_alone(own, match, (-inf, inf)), -np.inf)

    def count_dates(self, energy: Floats) -> Floats:
        """Return the effective number of dates of each form."""
        return count_dates(np.abs(energy).T, self._adding)


def _rank(found: Sequence[_Scores]) -> list[UnknownForm]:
    """Return the forms that are identifiable, each once, the most probable first."""
    rows = {
        format_formula(form.term): (odds, form)
        for scores in found
        for form, odds in zip(scores.forms, scores.odds.tolist(), strict=True)
        if np.isfinite(odds)
    }
    return [form for _, form in sorted(rows.values(), key=lambda row: -row[0])]
