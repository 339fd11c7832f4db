"""Run messages through the same steps as the live consumer.

`Pipeline.push` takes messages in the order of their arrival and returns the forecasts that are due. The pipeline reads
no clock and starts no thread, so the same messages always give the same forecasts.
"""

from core.pipeline import Pipeline
from core.settings import Settings
from core.wire.messages import Message

__all__ = ["Message", "Pipeline", "Settings"]
