"""Declare how far the compiled filters are from filterpy's."""

from typing import Annotated, Final

from socast.core.records import Record, declare

GOAL: Final = 1e-9
"""Largest relative difference between a compiled filter and filterpy's. [1]"""


class CarDifference(Record, frozen=True):
    """Hold how far a compiled filter is from filterpy's for one car."""

    vehicle_id: Annotated[str, declare("Name of the car.", "car")]
    steps: Annotated[int, declare("Number of steps of the filter.", "steps", "count")]
    compared: Annotated[int, declare("Steps that were compared.", "compared", "count")]
    passed_over: Annotated[dict[str, int], declare("Cause -> steps that no linear filter describes.")]
    mean: Annotated[
        float | None,
        declare(
            "Largest difference of an estimate, over its value or its standard deviation, whichever is larger; "
            "null without a compared step, or where either is not finite. [1]",
            "difference of the estimate",
            "power_of_ten",
        ),
    ]
    covariance: Annotated[
        float | None,
        declare(
            "Largest difference of a covariance, over the product of both standard deviations; null as above. [1]",
            "difference of the covariance",
            "power_of_ten",
        ),
    ]
    meets_goal: Annotated[
        bool | None, declare("Whether both are at most the goal; null without a compared step.", "verdict", "verdict")
    ]


class FilterDifference(Record, frozen=True):
    """Hold how far a compiled filter is from filterpy's for all cars."""

    filter: Annotated[str, declare("What the filter estimates.", "filter")]
    steps: Annotated[int, declare("Number of steps of the filter.", "steps", "count")]
    compared: Annotated[int, declare("Steps that were compared.", "compared", "count")]
    passed: Annotated[int, declare("Steps that no linear filter describes.", "passed over", "count")]
    passed_over: Annotated[dict[str, int], declare("Cause -> such steps.")]
    mean: Annotated[
        float | None,
        declare("Largest difference of an estimate, as of a car. [1]", "difference of the estimate", "power_of_ten"),
    ]
    covariance: Annotated[
        float | None,
        declare("Largest difference of a covariance, as of a car. [1]", "difference of the covariance", "power_of_ten"),
    ]
    meets_goal: Annotated[
        bool | None, declare("Whether both are at most the goal; null without a compared step.", "verdict", "verdict")
    ]
    cars: list[CarDifference]


class Verification(Record, frozen=True):
    """Hold how far the compiled filters are from filterpy's on recordings."""

    goal: Annotated[float, declare("Largest relative difference. [1]")]
    filters: list[FilterDifference]

    @property
    def meets_goal(self) -> bool:
        """Whether no filter misses the goal, and at least one was compared."""
        verdicts = {each.meets_goal for each in self.filters}
        return True in verdicts and False not in verdicts
