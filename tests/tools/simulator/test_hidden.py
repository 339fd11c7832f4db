"""Test the energy of hidden effects, and the refusal of effects that never act."""

from dataclasses import replace

import pytest

from socast.core.errors import SettingsError
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.settings import (
    NO_FAULTS,
    Hidden,
    Simulation,
)
from tests.support.simulated import SMALL, SUMMER, WINTER, run_simulation


class TestHidden:
    @pytest.mark.parametrize("effect", sorted(EFFECTS))
    def test_effect_takes_its_share_of_the_energy(self, effect):
        warm = {"cabin_cooling", "solar_load", "wet_road", "humidity"}
        start = SUMMER if effect in warm else WINTER
        simulation = Simulation(
            vehicles=5, start=start, shift_hours=1.5, seed=1, faults=NO_FAULTS, hidden=(Hidden(effect, 0.04),)
        )
        _, truth = run_simulation(simulation)
        effect_total = truth.summary()["hidden"][effect]
        assert effect_total["absolute_share"] == pytest.approx(0.04, rel=0.02)
        assert effect_total["energy_kwh"] == pytest.approx(sum(r["hidden_kwh"][effect] for r in truth.rides), abs=1e-3)

    def test_hidden_energy_comes_from_the_battery(self):
        plain = Simulation(vehicles=2, start=WINTER, shift_hours=1.5, seed=1, faults=NO_FAULTS)
        both = replace(plain, hidden=(Hidden("standby", 0.05), Hidden("roof_load", 0.02)))
        (_, before), (_, after) = run_simulation(plain), run_simulation(both)
        hidden = sum(sum(ride["hidden_kwh"].values()) for ride in after.rides)
        assert hidden / after.summary()["energy_kwh"] == pytest.approx(0.07, rel=0.05)
        gain = after.summary()["energy_kwh"] - before.summary()["energy_kwh"]
        assert gain == pytest.approx(hidden, rel=0.03)
        assert after.summary()["parts_kwh"]["hidden"] == pytest.approx(hidden, rel=1e-3)

    def test_effect_that_never_acts_is_rejected(self):
        with pytest.raises(SettingsError, match=r"cabin_cooling.*choose other dates"):
            simulate(replace(SMALL, hidden=(Hidden("cabin_cooling"),)))

    def test_unknown_effect_is_rejected(self):
        with pytest.raises(SettingsError, match="no hidden effect is called 'magic'; choose from age"):
            simulate(replace(SMALL, hidden=(Hidden("magic"),)))
