"""Every fault, by its name."""

from tools.bench.league import clock_faults, meter_faults, motion_faults
from tools.bench.league.fault import FAULTS

__all__ = ["FAULTS", "clock_faults", "meter_faults", "motion_faults"]
