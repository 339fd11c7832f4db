"""The quality bits of a sample: what was repaired, rejected or missing. Every occurrence is counted."""

from enum import IntFlag
from typing import Final


class Quality(IntFlag):
    """Mark each cause by one bit; a clean sample has none."""

    DUPLICATE = 1 << 0
    """Content and stamp or counter equal those of the sample before it: sent again. Rejected."""
    LATE = 1 << 1
    """It arrived after its place in time had passed. Rejected; its successor bridges its distance."""
    REPAIRED_TIME = 1 << 2
    """The stamp was uneven, repeated, missing or wild; the sample was put on the repaired clock or rejected."""
    CLOCK_STEP = 1 << 3
    """The logger's clock had been set; its new time is used from this sample on."""
    GAP = 1 << 4
    """Whole periods are missing before this sample."""
    SEQUENCE = 1 << 5
    """The counter restarted, stood still or leapt in no time: a power cycle, or two cars with one identity."""
    SPEED_REJECTED = 1 << 6
    """The speed is above the limit, as after a tunnel."""
    SPEED_MISSING = 1 << 7
    """The speed is missing, of a car that sends it."""
    POSITION_MISSING = 1 << 8
    """The fix is missing or 0/0, of a car that sends it."""
    POSITION_JUMP = 1 << 9
    """The fix is farther away than the car can have driven in the step."""
    POSITION_FROZEN = 1 << 10
    """The fix is unchanged while the car drives."""
    BRIDGED = 1 << 11
    """Distance that the speed did not show was added from the fix or the odometer."""
    OUT_OF_RANGE = 1 << 12
    """At least one value is outside the valid range of its column and was taken as missing."""
    SOC_MISSING = 1 << 13
    """The state of charge is missing, of a car that sends it."""
    POWER_MISSING = 1 << 14
    """Voltage or current is missing, of a car that sends both."""
    AMBIENT_FILLED = 1 << 15
    """The outside temperature is that of the nearest weather station."""
    AMBIENT_ASSUMED = 1 << 16
    """The outside temperature is that of the standard atmosphere, as neither car nor station reports one."""
    SOC_JUMP = 1 << 17
    """The state of charge changed by more than the car can have used, or than voltage and current drew."""
    SOC_FROZEN = 1 << 18
    """The state of charge has not changed although voltage and current drew several quanta."""
    POWER_FROZEN = 1 << 19
    """The current has not changed although the speed did, or is zero although the car drives. Not metered."""
    STAMP_SHARED = 1 << 20
    """The stamp is that of several samples, or coarser than the period; the sample was placed by counter and order."""
    PAUSE = 1 << 21
    """The counter continues over a pause that the stamp shows; nothing contradicts the stamp, so the pause counts."""
    SPEED_CONTRADICTED = 1 << 22
    """The speed contradicts odometer and fixes, stuck or in another unit; the distance is theirs."""
    SPEED_SPIKE = 1 << 23
    """The speed of the sample before leapt and has returned, as drivers cannot; the last speed before it was used."""
    SPEED_NOISY = 1 << 24
    """The speed of this car is noisy, so that a moving average over two samples or more was applied."""
    POSITION_DRIFT = 1 << 25
    """The fix wanders although the car stands, by its odometer, its speed or the noise of its fixes."""
    SLOPE_REJECTED = 1 << 26
    """The elevation changes more steeply than any road; the elevation was interpolated."""
    CHARGING_INFERRED = 1 << 27
    """The battery takes power at standstill: the car charges, although it does not say so."""
    CURRENT_INVERTED = 1 << 28
    """The current of this car has the wrong sign, by its state of charge or by its accelerations. Not metered."""
    SOC_STALE = 1 << 29
    """The first change of the charge after a pause is larger than the car can have used since: it is from before."""
    CLOCK_ROLLOVER = 1 << 30
    """The stamp is 1024 weeks early, as a receiver reports whose GPS week has rolled over; they were added."""


CAUSES: Final = tuple(flag.name.lower() for flag in Quality if flag.name)
"""Name of each bit, from the lowest."""

FORECAST_CAUSES: Final[dict[str, Quality]] = {
    "repaired_time": Quality.REPAIRED_TIME | Quality.CLOCK_STEP,
    "rejected_speed": Quality.SPEED_REJECTED,
    "duplicate": Quality.DUPLICATE | Quality.LATE,
    "gap": Quality.GAP,
    "out_of_range": Quality.OUT_OF_RANGE,
}
"""Count in a published forecast -> the bits that it sums."""
