"""Hidden effects in another shape: of the same cause, and yet not the same."""

from dataclasses import replace

import numpy as np
import pytest

from core.errors import SettingsError
from tests.support.simulated import SMALL, SUMMER, WINTER, drive_one_shift, run_simulation
from tools.simulator.fleet import simulate
from tools.simulator.hidden import EFFECTS, EffectInputs
from tools.simulator.hidden_shapes import OTHER, OTHER_SHAPES, POWERS
from tools.simulator.settings import Hidden

IN_SUMMER = {"cabin_cooling", "solar_load", "wet_road", "humidity"}
ALWAYS_COST = set(EFFECTS) - {"headwind", "air_density", "payload", "roof_load", "age"}


def view(effect):
    """Return a shift in which the effect has something to act on, of a car that has all flaws."""
    _, trace, car, state = drive_one_shift(SUMMER if effect in IN_SUMMER else WINTER, hours=3.0)
    flawed = car._replace(roof_drag_area=0.12, wear=0.1, under_inflation=0.1, brake_drag=8.0)
    ramp = np.linspace(0.0, 1.0, len(trace.time))
    dusk = {"solar": 200.0 * (1 - ramp), "dark": (ramp > 0.7).astype(float)} if effect == "night_lights" else {}
    return EffectInputs(trace._replace(snow=ramp, **dusk), state._replace(soc=1.0 - 0.2 * ramp), flawed)


def alike(one, other):
    """Return the cosine between two courses of power, 1 where one is the other times a number."""
    return one @ other / np.sqrt((one @ one) * (other @ other))


class TestShapes:
    def test_every_effect_has_one(self):
        assert set(OTHER_SHAPES) == set(EFFECTS)
        assert len(POWERS) == 2 * len(EFFECTS)

    @pytest.mark.parametrize("effect", sorted(OTHER_SHAPES))
    def test_is_of_the_same_cause_and_not_the_same(self, effect):
        seen = view(effect)
        own, other = EFFECTS[effect](seen), OTHER_SHAPES[effect](seen)
        assert other.shape == own.shape
        assert np.isfinite(other).all()
        assert np.abs(other).sum() > 0.0
        assert alike(own, other) < 0.9999
        minutes = [np.add.reduceat(power, np.arange(0, len(power), 600)) for power in (own, other)]
        assert alike(*minutes) > 0.2

    @pytest.mark.parametrize("effect", sorted(ALWAYS_COST))
    def test_what_only_costs_does_so_in_both(self, effect):
        seen = view(effect)
        assert EFFECTS[effect](seen).min() >= 0.0
        assert OTHER_SHAPES[effect](seen).min() >= 0.0

    def test_is_hidden_by_its_name(self):
        _, truth = run_simulation(replace(SMALL, hidden=(Hidden(f"cold_rolling{OTHER}", 0.05),)))
        found = truth.summary()["hidden"][f"cold_rolling{OTHER}"]
        assert found["absolute_share"] == pytest.approx(0.05, rel=0.02)

    def test_one_that_does_not_exist_is_refused(self):
        with pytest.raises(SettingsError, match="magic~other"):
            simulate(replace(SMALL, hidden=(Hidden("magic~other"),)))
