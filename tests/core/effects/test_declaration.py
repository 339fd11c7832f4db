"""Test that the decorator refuses incomplete declarations of effects."""

import numpy as np
import pytest

from socast.core.effects import Parameter, effect
from socast.core.errors import EffectError


def declare(**changes):
    return effect(**{"coefficient": "c", "unit": "N", "low": 0, "high": 1, "source": "a book"} | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"low": 1, "high": 1}, "plausible range 1 to 1 is empty"),
        ({"high": np.inf}, "infinite"),
        ({"source": " "}, "source or coefficient is empty"),
        ({"coefficient": ""}, "source or coefficient is empty"),
        ({"per": "mile"}, "per='mile': write 'distance'"),
        ({"parameters": {"idle": Parameter(1.0, "m")}}, "parameter 'idle' is declared but is not an argument"),
        ({"words": "{value} of {speed}"}, "words have a place for 'speed': use only {value} and parameters"),
        ({"words": "{value:.2f} N"}, "words have a place for 'value:.2f'"),
        ({"words": "{} N"}, "words have a place for ''"),
        ({"words": "{value N"}, "words are not a format string: "),
    ],
)
def test_incomplete_declarations_are_refused(changes, message):
    def rub(speed):
        """P = F v."""
        return speed

    with pytest.raises(EffectError, match="effect rub: ") as caught:
        declare(**changes)(rub)
    assert message in str(caught.value)


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

    for function, message in (
        (no_formula, "has no formula"),
        (odd, "argument 'sped' is neither"),
        (none, "takes no column"),
    ):
        with pytest.raises(EffectError, match=message):
            declare()(function)


@pytest.mark.parametrize(("value", "low", "high"), [(1.0, 2.0, 3.0), (np.nan, None, None), (1.0, None, np.inf)])
def test_parameters_must_lie_within_finite_bounds(value, low, high):
    with pytest.raises(EffectError, match="outside its bounds"):
        Parameter(value, "K", low, high)


def test_parameter_without_bounds_is_fixed():
    assert Parameter(2.0, "K").bounds == (2.0, 2.0)
    assert Parameter(2.0, "K", 1.0, 3.0).bounds == (1.0, 3.0)


@pytest.mark.parametrize(
    "grid", [(1.0, 3.0), (1.0, 3.0, 2.0), (2.0, 2.0), (1.0, 2.0, 3.5), (0.5, 2.0), (1.0, 2.0, np.nan), (np.nan, 2.0)]
)
def test_grid_must_ascend_within_bounds_and_contain_the_value(grid):
    with pytest.raises(
        EffectError, match="of a parameter must ascend, hold its value 2 and stay within its bounds 1 to 3"
    ):
        Parameter(2.0, "K", 1.0, 3.0, grid=grid)


def test_optional_fields_of_a_declaration_have_defaults():
    @effect(coefficient="drag of the brake pads", unit="N", low=0, high=60, source="a book")
    def rub(speed):
        """P = F v."""
        return speed

    assert (rub.confused_with, rub.shown_by, rub.words, rub.variants) == ((), "", "", ())
    assert rub.base == rub.name == "rub"
    assert rub.in_words(12.0, 3.0) == "drag of the brake pads 12 ± 3 N"


@pytest.mark.parametrize(("low", "high", "sign"), [(0, 1, 1), (0.1, 1, 1), (-1, 0, -1), (-1, 1, 0)])
def test_sign_follows_from_the_plausible_range(low, high, sign):
    assert declare(low=low, high=high)(rubbing).sign == sign


def rubbing(speed):
    """P = F v."""
    return speed


def test_single_confusion_may_be_given_as_a_string():
    assert declare(confused_with="rolling")(rubbing).confused_with == ("rolling",)
