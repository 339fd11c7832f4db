"""What each quality bit means to those who make loggers and to newcomers: the fault, what it costs, and its remedy."""

from typing import Final, NamedTuple

from socast.core.cleaning.quality import Quality


class LoggerFault(NamedTuple):
    """Describe a quality bit in plain words.

    Parameters
    ----------
    remedy : str
        What the maker of the logger can do.
    is_of_logger : bool
        Whether a logger can do better; false for what is merely absent or normal.
    """

    title: str
    cost: str
    remedy: str
    is_of_logger: bool = True


FAULTS: Final[dict[Quality, LoggerFault]] = {
    Quality.DUPLICATE: LoggerFault(
        "sample sent again", "nothing: it is dropped", "send a sample again only where its receipt is not confirmed"
    ),
    Quality.LATE: LoggerFault(
        "sample out of order",
        "its voltage, current and speed; its distance is kept",
        "send samples in the order in which they were taken",
    ),
    Quality.REPAIRED_TIME: LoggerFault(
        "repaired time",
        "little: uneven, repeated or missing times are put back on the clock",
        "stamp a sample when it is taken, in milliseconds, and send the counter seq",
    ),
    Quality.CLOCK_STEP: LoggerFault(
        "clock set while driving",
        "the time between the samples beside it is a guess",
        "slew the clock, or set it only while parked; keep it in UTC",
    ),
    Quality.GAP: LoggerFault(
        "samples missing",
        "power and speed in the gap; at the ends of a ride, the ride",
        "store samples while there is no connection, and send them later",
    ),
    Quality.SEQUENCE: LoggerFault(
        "counter restarts, stands or leaps",
        "little, where the time is right",
        "count each sample by one, across pauses; give each car a name of its own",
    ),
    Quality.SPEED_REJECTED: LoggerFault(
        "speed above the limit",
        "the speed; the ride where it lasts",
        "send the speed of the wheels in km/h; give --speed-limit-kmh for motorways",
    ),
    Quality.SPEED_MISSING: LoggerFault(
        "speed missing",
        "kinetic energy and drag are less exact; the ride where it lasts",
        "send the speed in each sample",
    ),
    Quality.POSITION_MISSING: LoggerFault(
        "fix missing or 0/0",
        "elevation and wind; the distance is that of the speed",
        "send null without a fix, and place the antenna under open sky",
    ),
    Quality.POSITION_JUMP: LoggerFault(
        "fix jumps", "the fix; the distance is that of the speed", "send fixes with a good dilution of precision only"
    ),
    Quality.POSITION_FROZEN: LoggerFault(
        "fix frozen while driving",
        "elevation and heading",
        "send null once a fix is older than a period",
    ),
    Quality.BRIDGED: LoggerFault(
        "distance that no speed shows",
        "speed in the gap; the ride where it is much",
        "send the odometer, and samples without gaps",
    ),
    Quality.OUT_OF_RANGE: LoggerFault(
        "impossible value", "this value", "send null where a value is unknown, and check its unit"
    ),
    Quality.SOC_MISSING: LoggerFault(
        "state of charge missing", "little, where others follow soon", "send the state of charge in each sample"
    ),
    Quality.POWER_MISSING: LoggerFault(
        "voltage or current missing",
        "the measured energy of these samples",
        "send voltage and current together, in each sample",
    ),
    Quality.AMBIENT_FILLED: LoggerFault(
        "no outside temperature, a station has it", "little", "send ambient_c", is_of_logger=False
    ),
    Quality.AMBIENT_ASSUMED: LoggerFault(
        "no outside temperature anywhere",
        "heating, cooling and air density are guessed",
        "send ambient_c, or weather observations",
        is_of_logger=False,
    ),
    Quality.SOC_JUMP: LoggerFault(
        "state of charge jumps",
        "the energy by the state of charge; the ride without voltage and current",
        "send the value of the battery management, not that of the display",
    ),
    Quality.SOC_FROZEN: LoggerFault(
        "state of charge frozen",
        "the energy by the state of charge; the ride without voltage and current",
        "read the value anew for each sample",
    ),
    Quality.POWER_FROZEN: LoggerFault(
        "current frozen, or 0 while driving",
        "the measured energy of these samples",
        "read voltage and current anew for each sample; send null where they are unknown",
    ),
    Quality.STAMP_SHARED: LoggerFault(
        "several samples with one time",
        "little with a counter; without one, acceleration",
        "stamp each sample in milliseconds when it is taken, not when it is sent",
    ),
    Quality.PAUSE: LoggerFault(
        "counter goes on over a pause", "nothing", "nothing to do where the time is right", is_of_logger=False
    ),
    Quality.SPEED_CONTRADICTED: LoggerFault(
        "speed contradicts odometer and fixes",
        "the speed; the distance is that of odometer and fixes",
        "check the unit of the speed (km/h), and that it is read anew for each sample",
    ),
    Quality.SPEED_SPIKE: LoggerFault(
        "speed leaps for one sample", "this speed", "send the speed of the wheels, or filter that of the GPS"
    ),
    Quality.SPEED_NOISY: LoggerFault(
        "noisy speed", "short accelerations are smoothed", "send the speed of the wheels in place of that of the GPS"
    ),
    Quality.POSITION_DRIFT: LoggerFault(
        "fix wanders at standstill", "nothing: no distance is counted", "send the speed of the wheels or the odometer"
    ),
    Quality.SLOPE_REJECTED: LoggerFault(
        "elevation steeper than any road",
        "the elevation there",
        "send null in tunnels; correct the elevation with --elevation",
    ),
    Quality.CHARGING_INFERRED: LoggerFault(
        "charging without the flag", "nothing, once it is seen", "send charging: true while the car charges"
    ),
    Quality.CURRENT_INVERTED: LoggerFault(
        "current with the wrong sign",
        "the measured energy of these samples, and their rides",
        "send battery_current_a positive when discharging",
    ),
    Quality.SOC_STALE: LoggerFault(
        "state of charge from before a pause",
        "the energy by the first change of the state of charge",
        "read the value anew before the first sample after sleep",
    ),
    Quality.CLOCK_ROLLOVER: LoggerFault(
        "clock 1024 weeks early",
        "nothing: 1024 weeks were added",
        "update the GPS receiver, whose week number has rolled over",
    ),
}
"""Each quality bit in plain words."""
