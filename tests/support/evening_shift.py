"""The shift of the demonstration, forecast by a consumer that has learned from the mornings before."""

from socast.core import models
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.tools.commands.demo import HISTORY, SHIFT
from socast.tools.terminal.forecast_options import learn_from_recordings
from socast.tools.terminal.model_comparison import find_models

EVENING = SHIFT
"""Recording of the shift."""


def make_evening_pipeline() -> Pipeline:
    """Return a pipeline with the fitted model of the demonstration that has learned from its history."""
    (name,) = find_models(None, EVENING.parent)
    model = models.load(name)
    pipeline = Pipeline(model)
    earlier = learn_from_recordings(model, [], Settings(), [HISTORY])
    assert earlier is not None
    pipeline.learn_from(earlier)
    return pipeline
