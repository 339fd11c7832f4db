"""The quality bits of a sample: what was repaired, rejected or missing. None is silent, each is counted."""

from enum import IntFlag
from typing import Final


class Quality(IntFlag):
    """One bit a cause; a clean sample has none."""

    DUPLICATE = 1 << 0
    """Same content as the sample before it, and the same stamp or counter: sent again. Not used."""
    LATE = 1 << 1
    """Its place in time had passed when it came. Not used; its kilometres are bridged by its successor."""
    REPAIRED_TIME = 1 << 2
    """The stamp was uneven, repeated, missing or wild; the sample was put back on the logger's clock or not used."""
    CLOCK_STEP = 1 << 3
    """The logger's clock had been set; from here on its new time is believed."""
    GAP = 1 << 4
    """Whole periods are missing before this sample."""
    SEQUENCE = 1 << 5
    """The counter restarted, stood still or leapt in no time: a power cycle, or two cars with one identity."""
    SPEED_REJECTED = 1 << 6
    """Speed above the limit, as a tunnel makes it."""
    SPEED_MISSING = 1 << 7
    """No speed, where this car used to send it."""
    POSITION_MISSING = 1 << 8
    """No fix, or the fix 0/0, where this car used to send one."""
    POSITION_JUMP = 1 << 9
    """The fix is farther away than the car can have driven in the step."""
    POSITION_FROZEN = 1 << 10
    """The fix stands still while the car drives."""
    BRIDGED = 1 << 11
    """Distance that the speed did not show was made good from the fix or the odometer."""
    OUT_OF_RANGE = 1 << 12
    """At least one value outside its column's valid range; taken as missing."""
    SOC_MISSING = 1 << 13
    """No state of charge, where this car used to send it."""
    POWER_MISSING = 1 << 14
    """No voltage or no current, where this car used to send both."""
    AMBIENT_FILLED = 1 << 15
    """Outside temperature taken from the nearest weather station."""
    AMBIENT_ASSUMED = 1 << 16
    """Neither the car nor a station knows the temperature; that of the standard atmosphere is used."""


CAUSES: Final = tuple(flag.name.lower() for flag in Quality if flag.name)
"""Name of each bit, from the lowest."""

FORECAST_CAUSES: Final[dict[str, Quality]] = {
    "repaired_time": Quality.REPAIRED_TIME | Quality.CLOCK_STEP,
    "rejected_speed": Quality.SPEED_REJECTED,
    "duplicate": Quality.DUPLICATE | Quality.LATE,
    "gap": Quality.GAP,
    "out_of_range": Quality.OUT_OF_RANGE,
}
"""Count in a published forecast -> the bits that it adds up."""
