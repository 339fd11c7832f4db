"""The predicted energy of a ride in progress, by term of the model."""

import numpy as np

from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.totals.tables import model_columns


def compute_ride_parts(pipeline: Pipeline, vehicle_id: str) -> dict[str, float] | None:
    """Return the predicted energy of a car's ride in progress by term of the first model.

    Returns
    -------
    dict of str to float, or None
        Energy by name of the term [kWh]; None between rides, and for a model that has no terms.
    """
    lane = pipeline.lanes.find(vehicle_id)
    if lane is None or lane not in pipeline.totals.cleaner.lanes_heard() or not isinstance(pipeline.model, LinearModel):
        return None
    totals = pipeline.totals.describe_running(np.array([lane]))
    if totals.ride[0] < 0:
        return None
    needs = (*pipeline.model.needs, "vehicle_model", "vehicle_id")
    parts = pipeline.model.predict_parts(model_columns(totals, pipeline.context, needs))
    return {name: float(energy[0]) for name, energy in parts.items()}
