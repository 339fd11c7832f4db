"""Test the settings of a simulation: bounds, and texts that select phenomena, faults and effects."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from socast.core.errors import SettingsError
from socast.tools.simulator.physics import PARTS, WHEEL
from socast.tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    PLAIN_PHENOMENA,
    Faults,
    Hidden,
    parse_faults,
    parse_hidden,
    parse_models,
    parse_phenomena,
    parse_start,
)
from tests.support.simulated import SMALL


class TestSettings:
    @pytest.mark.parametrize(
        ("parse", "text", "message"),
        [
            (parse_faults, "fog=0.1", "no fault is called 'fog'; choose from jitter"),
            (parse_faults, "gap=2", "fault gap has rate '2'; give gap=0 to gap=1"),
            (parse_faults, "gap", "fault gap has rate ''"),
            (parse_phenomena, "all,-fog", "no phenomenon is called 'fog'"),
            (parse_hidden, "headwind:x", "has size 'x'"),
            (parse_start, "yesterday", "'yesterday' is not a date"),
            (parse_models, " , ", "names none"),
        ],
    )
    def test_error_names_the_unknown_name(self, parse, text, message):
        with pytest.raises(SettingsError, match=message):
            parse(text)

    @pytest.mark.parametrize(
        "change",
        [
            {"vehicles": 0},
            {"days": 0},
            {"day_step": 0},
            {"shift_hours": 30.0},
            {"seed": -1},
            {"hidden": (Hidden("age", 0.0),)},
            {"hidden": (Hidden("age"), Hidden("age"))},
            {"days": 100, "day_step": 100},
            {"start": datetime(1970, 1, 1, tzinfo=UTC)},
            {"charging": "never"},
        ],
    )
    def test_settings_out_of_bounds_are_rejected(self, change):
        with pytest.raises(SettingsError, match=r"give|choose"):
            replace(SMALL, **change)

    def test_text_selects_phenomena_faults_and_start(self):
        assert parse_phenomena("plain") == PLAIN_PHENOMENA
        assert parse_phenomena("all") == ALL_PHENOMENA
        assert parse_phenomena("plain,-climate") == PLAIN_PHENOMENA._replace(climate=False)
        assert parse_faults("none") == NO_FAULTS
        assert parse_faults("default") == Faults()
        assert parse_start("2018-01-15T07:00-05:00") == datetime(2018, 1, 15, 12, tzinfo=UTC)
        assert set(WHEEL) < set(PARTS)
