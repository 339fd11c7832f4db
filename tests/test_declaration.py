"""A declaration that is incomplete is refused where it is made."""

import numpy as np
import pytest

from core.effects import Parameter, effect
from core.errors import EffectError


def declare(**changes):
    return effect(**{"coefficient": "c", "unit": "N", "low": 0, "high": 1, "source": "a book"} | changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"low": 1, "high": 1}, "plausible range 1 to 1 is empty"),
        ({"high": np.inf}, "endless"),
        ({"source": " "}, "source and coefficient must be said"),
        ({"coefficient": ""}, "source and coefficient must be said"),
        ({"per": "mile"}, "per='mile': say 'distance'"),
        ({"parameters": {"idle": Parameter(1.0, "m")}}, "parameter 'idle' is declared but is no argument"),
    ],
)
def test_incomplete_declarations_are_refused(changes, said):
    def rub(speed):
        """P = F v."""
        return speed

    with pytest.raises(EffectError, match="effect rub: ") as caught:
        declare(**changes)(rub)
    assert said in str(caught.value)


def test_functions_that_cannot_be_called_are_refused():
    def no_formula(speed):
        """Rubs."""
        return speed

    def odd(sped):
        """P = F v."""
        return sped

    def none():
        """P = F."""
        return 1.0

    for function, said in (
        (no_formula, "has no formula"),
        (odd, "argument 'sped' is neither"),
        (none, "takes no column"),
    ):
        with pytest.raises(EffectError, match=said):
            declare()(function)


@pytest.mark.parametrize(("value", "low", "high"), [(1.0, 2.0, 3.0), (np.nan, None, None), (1.0, None, np.inf)])
def test_parameters_must_lie_within_finite_bounds(value, low, high):
    with pytest.raises(EffectError, match="outside its bounds"):
        Parameter(value, "K", low, high)


def test_a_parameter_without_bounds_is_fixed():
    assert Parameter(2.0, "K").bounds == (2.0, 2.0)
    assert Parameter(2.0, "K", 1.0, 3.0).bounds == (1.0, 3.0)
