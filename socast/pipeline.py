"""Run messages through the same steps as the live consumer.

`Pipeline.push` takes messages in the order of their arrival and returns the forecasts that are due. The pipeline reads
no clock and starts no thread, so the same messages always give the same forecasts.
"""

from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Message

__all__ = ["Message", "Pipeline", "Settings"]
