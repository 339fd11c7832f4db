"""The other shape of a hidden effect has the same cause and another dependence."""

from dataclasses import replace

import numpy as np
import pytest

from socast.core.errors import SettingsError
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.hidden import EFFECTS, EffectInputs
from socast.tools.simulator.hidden_shapes import BENT, OTHER, OTHER_SHAPES, get_power
from socast.tools.simulator.settings import Hidden
from tests.support.simulated import SMALL, SUMMER, WINTER, drive_one_shift, run_simulation

IN_SUMMER = {"cabin_cooling", "solar_load", "wet_road", "humidity"}
ALWAYS_COST = set(EFFECTS) - {"headwind", "air_density", "payload", "roof_load", "age"}


def make_view(effect):
    """Return a shift that the effect acts on, driven by a car with every flaw."""
    _, trace, car, state = drive_one_shift(SUMMER if effect in IN_SUMMER else WINTER, hours=3.0)
    flawed = car._replace(roof_drag_area=0.12, wear=0.1, under_inflation=0.1, brake_drag=8.0)
    ramp = np.linspace(0.0, 1.0, len(trace.time))
    dusk = {"solar": 200.0 * (1 - ramp), "dark": (ramp > 0.7).astype(float)} if effect == "night_lights" else {}
    return EffectInputs(trace._replace(snow=ramp, **dusk), state._replace(soc=1.0 - 0.2 * ramp), flawed)


def compute_cosine(one, other):
    """Return the cosine between two time series of power; it is 1 if they are proportional."""
    return one @ other / np.sqrt((one @ one) * (other @ other))


class TestShapes:
    def test_every_effect_has_another_shape(self):
        assert set(OTHER_SHAPES) == set(EFFECTS)

    @pytest.mark.parametrize("effect", sorted(OTHER_SHAPES))
    def test_bent_shapes_differ_from_each_other_and_resemble_the_effect(self, effect):
        inputs = make_view(effect)
        first, *bent = (get_power(f"{effect}{end}")(inputs) for end in ("", f"{BENT}1", f"{BENT}2"))
        for each in bent:
            assert np.isfinite(each).all()
            assert 0.2 < compute_cosine(first, each) < 0.99999
        assert compute_cosine(*bent) < 0.99999
        assert (get_power(f"{effect}{BENT}1")(inputs) == bent[0]).all()

    @pytest.mark.parametrize("effect", sorted(OTHER_SHAPES))
    def test_shapes_are_similar_and_not_equal(self, effect):
        inputs = make_view(effect)
        first, other = EFFECTS[effect](inputs), OTHER_SHAPES[effect](inputs)
        assert other.shape == first.shape
        assert np.isfinite(other).all()
        assert np.abs(other).sum() > 0.0
        assert compute_cosine(first, other) < 0.9999
        minutes = [np.add.reduceat(power, np.arange(0, len(power), 600)) for power in (first, other)]
        assert compute_cosine(*minutes) > 0.2

    @pytest.mark.parametrize("effect", sorted(ALWAYS_COST))
    def test_effects_that_always_cost_energy_do_so_in_both_shapes(self, effect):
        inputs = make_view(effect)
        assert EFFECTS[effect](inputs).min() >= 0.0
        assert OTHER_SHAPES[effect](inputs).min() >= 0.0

    def test_other_shape_is_selected_by_its_name(self):
        _, truth = run_simulation(replace(SMALL, hidden=(Hidden(f"cold_rolling{OTHER}", 0.05),)))
        effect_total = truth.summary()["hidden"][f"cold_rolling{OTHER}"]
        assert effect_total["absolute_share"] == pytest.approx(0.05, rel=0.02)

    def test_unknown_shape_is_rejected(self):
        with pytest.raises(SettingsError, match="magic~other"):
            simulate(replace(SMALL, hidden=(Hidden("magic~other"),)))
