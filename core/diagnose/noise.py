"""Estimate the variance of each residual of a diagnosis, and the weights that limit the influence of outliers."""

from socast.core.batch import Floats
from socast.core.diagnose.dataset import Windows
from socast.core.fit.row_noise import build_variance_parts, estimate_variance


def estimate_window_variance(windows: Windows, residual: Floats, parts: Floats | None = None) -> Floats:
    """Return the variance of the residual of each window: that of its measurement plus parts that grow with the drive.

    Units: residual [kWh], parts [kWh^2], returns [kWh^2].

    Notes
    -----
    The variance is a sum of the measurement variance and parts proportional to the squares of the rolling energy, of
    the acceleration energy, and of the energy of a constant power. The coefficients are fitted and not negative.
    """
    return estimate_variance(build_variance_parts(windows.table) if parts is None else parts, residual)
