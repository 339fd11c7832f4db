"""Provide the text of a valid file of effects."""

GOOD = '''
import numpy as np
from socast.core.effects import Parameter, effect

@effect(coefficient="door area times flow", unit="W/K", low=0, high=500, source="Somebody 2020, p. 7", per="time",
        parameters={"inside": Parameter(294.15, "K", 288.15, 298.15)})
def door_loss(stopped, inside, ambient):
    """Heat through open doors: P = H stopped (T_in - T)."""
    return stopped * np.maximum(inside - ambient, 0.0)
'''
