"""Noise of corners by view: blur, distance and light differ from view to view, and noise with them.

The residuals of a view's own pose give its variance with so many degrees of freedom. Variances of
views are draws of one inverse gamma distribution, whose two parameters all views determine (Smyth
2004), and each view's is drawn towards it by what it lacks of degrees of freedom.
"""

import numpy as np
from scipy.special import digamma, polygamma

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray

# Views of one noise are taken for views of several in one session of ten thousand.
_FALSE_ALARM = 1e-4
# Between views, logarithms of variances vary by so much; and the logarithms of the distribution's
# shape that have such variances.
_BETWEEN, _LOGS = (1e-3, 1e2), (-3.0, 8.0)


def weights_by_view(squares: FloatArray, freedom: FloatArray) -> FloatArray | None:
    """Estimates how well the corners of each view are known.

    Args:
        squares: (v,) sums of squared residuals [px^2].
        freedom: (v,) their degrees of freedom.

    Returns:
        (v,) ratios of a typical standard deviation to each view's; None where chance explains how
        views differ, or where one of them says nothing.
    """
    if len(squares) < 2 or not np.all((squares > 0.0) & (freedom > 0.0)):
        return None
    # Logarithms of the views' variances, without bias, and their own variances.
    logs = np.log(squares / 2.0) - digamma(freedom / 2.0)
    by_chance = polygamma(1, freedom / 2.0)
    about = logs - np.average(logs, weights=1.0 / by_chance)
    if np.sum(about**2 / by_chance) < chi2_limit(_FALSE_ALARM, len(logs) - 1):
        return None
    # Few sessions have such views, and `locate` need not wait a tenth of a second for this import.
    from scipy.optimize import brentq

    between = float(np.clip(np.var(logs, ddof=1) - np.mean(by_chance), *_BETWEEN))
    half = float(np.exp(brentq(lambda value: polygamma(1, np.exp(value)) - between, *_LOGS)))
    scale = np.exp(np.mean(logs) + digamma(half))
    variances = (scale + squares / 2.0) / (half + freedom / 2.0)
    return np.asarray(np.exp(np.mean(np.log(variances)) / 2.0) / np.sqrt(variances), dtype=float)
