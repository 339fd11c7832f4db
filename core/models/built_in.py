"""Built-in models: the physical models of the paper that need no fitting."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from socast.core.models.interval import ANY
from socast.core.models.linear import Fit, LinearModel, Term


def make_physical_term(name: str, columns: tuple[str, ...]) -> Term:
    """Return a term whose coefficient is 1 where physics holds."""
    return Term(name=name, columns=columns, unit="1")


BASIC_TERMS: Final = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("climbing", ("effect_climbing",)),
    make_physical_term("aero_drag", ("effect_aero_drag", "drag_area_m2")),
    make_physical_term("inertia", ("effect_inertia",)),
)
_EXTENDED_TERMS: Final = (*BASIC_TERMS, make_physical_term("accessories", ("effect_accessories",)))

BASIC_PHYSICAL: Final = LinearModel(
    name="basic_physical",
    version="1",
    recipe="basic_physical",
    terms=BASIC_TERMS,
    fits={ANY: Fit(coefficients=(1.0,) * len(BASIC_TERMS))},
)
"""Basic physical model, eq. (1) and section 4.1 of the paper: energy at the wheels with the catalogue's parameters."""

EXTENDED_PHYSICAL: Final = LinearModel(
    name="extended_physical",
    version="1",
    recipe="extended_physical",
    terms=_EXTENDED_TERMS,
    fits={ANY: Fit(coefficients=(1.0,) * len(_EXTENDED_TERMS))},
)
"""Extended physical model, section 4.2 of the paper, with the reference accessory curve; `socast.core.fit` fits one."""

BUILT_IN_MODELS: Final[Mapping[str, LinearModel]] = MappingProxyType(
    {model.name: model for model in (BASIC_PHYSICAL, EXTENDED_PHYSICAL)}
)
"""Models that come with the product and need no fitting, by name."""
HILLS_OF_BUILT_IN: Final = (
    "as in the paper, a descent returns all that the climb took, so a hill up and down costs nothing"
)
"""What readers of the predictions of `BUILT_IN_MODELS` need to know."""
