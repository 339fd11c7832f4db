"""Every fault, by its name."""

from socast.tools.bench.league import clock_faults, meter_faults, motion_faults
from socast.tools.bench.league.fault import FAULTS

__all__ = ["FAULTS", "clock_faults", "meter_faults", "motion_faults"]
