"""List percentage errors that other work published, for orientation beside the errors of an evaluation.

Fleets, trips and measures differ, so agreement does not mean equal skill. Long trips have smaller relative errors than
taxi rides of a few kilometres, and a measured energy with noise limits each of them.
"""

from typing import Final, NamedTuple


class LiteratureError(NamedTuple):
    """Hold a published error of predicted trip energy.

    Parameters
    ----------
    share : float
        Mean error relative to the measured energy. [1]
    measure : str
        Measure, in the words of the source.
    setting : str
        Vehicles, and what the model knew of them.
    link : str
        DOI, or the address where no DOI could be verified.
    """

    share: float
    measure: str
    setting: str
    source: str
    publication: str
    link: str


LITERATURE: Final = (
    LiteratureError(
        0.0504,
        "average error",
        "one fleet of cars, model adapted online to each car",
        "Zhu et al. 2024",
        "Predicting electric vehicle energy consumption from field data using machine learning, IEEE Transactions on "
        "Transportation Electrification",
        "DOI 10.1109/TTE.2024.3416532",
    ),
    LiteratureError(
        0.0630,
        "average error",
        "the same fleet, one model for all cars",
        "Zhu et al. 2024",
        "Predicting electric vehicle energy consumption from field data using machine learning, IEEE Transactions on "
        "Transportation Electrification",
        "DOI 10.1109/TTE.2024.3416532",
    ),
    LiteratureError(
        0.0762,
        "MAPE of the consumption per km",
        "cars that the training did not contain",
        "Scientific Reports",
        "Vehicle-wise validated ensemble learning framework for robust electric vehicle energy consumption prediction "
        "using physics-guided features and statistical benchmarking",
        "aimedicalcompendium.com/article.cfm?id=213858 (abstract)",
    ),
    LiteratureError(
        0.074,
        "mean absolute prediction error",
        "electric trucks, speeds known",
        "Litjens et al. 2025",
        "Energy consumption prediction with uncertainty quantification for electric truck operations, SciTePress",
        "scitepress.org/publishedPapers/2025/133629",
    ),
    LiteratureError(
        0.108,
        "mean absolute prediction error",
        "electric trucks, speeds predicted",
        "Litjens et al. 2025",
        "Energy consumption prediction with uncertainty quantification for electric truck operations, SciTePress",
        "scitepress.org/publishedPapers/2025/133629",
    ),
)
"""Published errors. The first three are stated in the abstracts of their sources, the last two in the conclusions."""
