"""Test that the check of an effect reports its error in one line."""

import pytest

from socast.core.columns import SIGNALS
from socast.core.effects import Effect, check_effect, load_file, registry
from socast.core.effects.declaration import SIGNAL_UNITS
from socast.core.effects.verification import ORDINARY_DRIVING
from socast.core.errors import EffectError

# Each case below introduces one error into this effect

GOOD = '''
import numpy as np
from socast.core.effects import Parameter, effect

@effect(coefficient="door area times flow", unit="W/K", low=0, high=500, source="Somebody 2020, p. 7", per="time",
        parameters={"inside": Parameter(294.15, "K", 288.15, 298.15)})
def door_loss(stopped, inside, ambient):
    """Heat through open doors: P = H stopped (T_in - T)."""
    return stopped * np.maximum(inside - ambient, 0.0)
'''
BODY = "stopped * np.maximum(inside - ambient, 0.0)"


def refusal(text: str) -> str:
    """Return the message with which `check_effect` refuses the effect in a text."""
    names: dict = {}
    exec(text, names)
    (declared,) = [value for value in names.values() if isinstance(value, Effect)]
    with pytest.raises(EffectError) as caught:
        check_effect(declared)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('unit="W/K"', 'unit="W"', "times the coefficient's [W] that is [K * W], not [W]"),
        ('unit="W/K"', 'unit="kW/K"', "not [W]"),
        (BODY, "stopped / 2.0", "function gives [1], times the coefficient's [W/K] that is [W / K], not [W]"),
        (BODY, "stopped * (inside == stopped)", "units do not fit: Cannot convert"),
        ('unit="W/K"', 'unit="wattage"', "pint does not know the unit 'wattage'"),
        ('unit="W/K"', 'unit="3 W/K"', "pint does not know the unit '3 W/K'"),
        ('"K", 288', '"kg", 288', "units do not fit: Cannot convert"),
        (
            '"K", 288',
            '"degC", 288',
            "parameter inside is in [degC], but columns are in SI units: give its value in [K]",
        ),
        ('"K", 288', '"mK", 288', "parameter inside is in [mK], but columns are in SI units: give its value in [K]"),
        ("inside - ambient", "294.15 - ambient + 0 * inside", "a number with a dimension must be a Parameter"),
        (
            BODY,
            "np.asarray(stopped) * np.maximum(inside - ambient, 0.0)",
            "units do not fit: The unit of the quantity is stripped",
        ),
        (BODY, "(inside - ambient) / (stopped - stopped + 0)", "gives"),
        (BODY, BODY + " / (stopped > 0.1)", "gives nan at stopped=0"),
        (BODY, "np.sqrt(stopped - 0.5) * (inside - ambient)", "gives nan at stopped=0"),
        (BODY, "(inside - ambient).sum() * stopped", "alone give another result than among all"),
        (BODY, "(stopped * (inside - ambient))[:-1]", "returns float64 (256,) for 257 rows"),
        (BODY, "(inside - inside) * 0", "returns float for 257 rows"),
        (BODY, "stopped.nothing", "raises AttributeError"),
        (BODY, "[][1]", "raises IndexError: list index out of range"),
        (BODY, "np.multiply(stopped, 2.0, out=stopped) * (inside - ambient)", "raises "),
    ],
)
def test_invalid_effect_is_refused_in_one_line(before, after, message):
    assert GOOD.count(before) == 1
    assert message in refusal(GOOD.replace(before, after))


BARE = GOOD.replace(f"return {BODY}", "return stopped * (EXPRESSION)").replace("door_loss", "bare")


@pytest.mark.parametrize(
    ("expression", "number", "part"),
    [
        ("inside - ambient * (ambient < 278.15)", "278.15", "ambient < 278.15"),
        ("inside - ambient * (278.15 > ambient)", "278.15", "278.15 > ambient"),
        ("inside - ambient * (ambient == 278.15)", "278.15", "ambient == 278.15"),
        ("inside - ambient * (ambient != 278.15)", "278.15", "ambient != 278.15"),
        ("inside - ambient * (278.15 != ambient)", "278.15", "278.15 != ambient"),
        ("inside - ambient * np.equal(ambient, 278.15)", "278.15", "np.equal(ambient, 278.15)"),
        ("inside - ambient * (-5 <= ambient)", "-5", "-5 <= ambient"),
        ("inside - np.where(ambient < LIMIT, 1.0, 0.0)", "LIMIT", "ambient < LIMIT"),
        ("inside - np.where(stopped > 0.5, ambient, 278.15)", "278.15", "np.where(stopped > 0.5, ambient, 278.15)"),
        ("inside - np.maximum(ambient, 278.15)", "278.15", "np.maximum(ambient, 278.15)"),
        ("inside - np.clip(ambient, 268.15, 278.15)", "268.15", "np.clip(ambient, 268.15, 278.15)"),
        ("inside - ambient * np.less(ambient, 278.15)", "278.15", "np.less(ambient, 278.15)"),
        ("inside - 278.15", "278.15", "inside - 278.15"),
        ("278.15 - ambient + 0 * inside", "278.15", "278.15 - ambient"),
        ("inside + (5 + 273.15)", "5 + 273.15", "inside + (5 + 273.15)"),
    ],
)
@pytest.mark.usefixtures("_checks_here")
def test_bare_number_next_to_a_quantity_is_refused_with_line_and_remedy(tmp_path, expression, number, part):
    path = tmp_path / "bare.py"
    path.write_text(BARE.replace("EXPRESSION", expression).replace("@effect", "LIMIT = 278.15\n\n@effect"))
    line = path.read_text()[: path.read_text().index("    return")].count("\n") + 1
    with pytest.raises(EffectError) as caught:
        load_file(path)
    assert str(caught.value) == (
        f"{path}:{line}: effect bare: {number} has no unit, but meets a quantity in [K] in `{part}`: make {number} a "
        f'Parameter: declare parameters={{"limit": Parameter({number}, "K")}}, add the argument limit to the function, '
        f"and write limit in place of {number}"
    )


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("inside - ambient + stopped", "units do not fit in `inside - ambient + stopped`: Cannot convert"),
        ("inside - np.exp(ambient)", "units do not fit in `np.exp(ambient)`: Cannot convert"),
        ("[inside - ambient][1]", "raises IndexError: list index out of range"),
    ],
)
@pytest.mark.usefixtures("_checks_here")
def test_error_of_a_file_names_the_line(tmp_path, expression, message):
    path = tmp_path / "bare.py"
    path.write_text(BARE.replace("EXPRESSION", expression))
    line = path.read_text()[: path.read_text().index("    return")].count("\n") + 1
    with pytest.raises(EffectError) as caught:
        load_file(path)
    assert str(caught.value).startswith(f"{path}:{line}: effect bare: {message}")


@pytest.mark.usefixtures("_checks_here")
def test_zero_needs_no_unit(tmp_path):
    path = tmp_path / "zero.py"
    path.write_text(
        BARE.replace("EXPRESSION", "(inside - ambient) * (ambient > 0) * (ambient != 0)").replace(
            "bare", "zero_needs_no_unit"
        )
    )
    assert [effect.name for effect in load_file(path)] == ["zero_needs_no_unit"]
    registry._library.pop("zero_needs_no_unit"), registry._brought_by.pop("zero_needs_no_unit")


FULL = """
import numpy as np
from socast.core.effects import Parameter, effect

@effect(coefficient="share", unit="1", low=0, high=1, source="Somebody 2020, p. 7",
        parameters={"full": Parameter(0.9, "1", 0.5, 1.0)})
def full(traction, speed, charge, full):
    'A full battery: P = max(-F v, 0) max((s - s0)/(1 - s0), 0).'
    return np.maximum(-traction * speed, 0.0) * np.maximum((charge - full) / (1.0 - full), 0.0)
"""


def test_bounds_at_which_an_effect_has_no_value_are_refused():
    message = refusal(FULL)
    assert "effect full: gives nan at full=1 1, traction=" in message
    assert "guard it" in message


def test_ordinary_driving_covers_every_signal_within_its_range():
    assert list(ORDINARY_DRIVING) == [column.name for column in SIGNALS]
    for column in SIGNALS:
        low, high = ORDINARY_DRIVING[column.name]
        assert column.low <= low < high <= column.high
        assert SIGNAL_UNITS[column.name] == column.unit
