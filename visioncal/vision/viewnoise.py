"""Corner noise by view, which varies with blur, distance and light.

The residuals of a view's own pose estimate its variance with some degrees of freedom. The views'
variances are draws of one inverse gamma distribution, whose two parameters all views determine
(Smyth 2004), and each is shrunk towards it by its lack of degrees of freedom.
"""

import numpy as np
from scipy.special import digamma, polygamma

from visioncal.core.quantiles import FALSE_ALARM, chi2_limit, root_of
from visioncal.core.types import FloatArray

# Bounds of the logarithm of the distribution's shape.
_LOGS = (-3.0, 8.0)


def weights_by_view(squares: FloatArray, freedom: FloatArray) -> FloatArray | None:
    """Relative weights (v,) of the views' corners: a typical standard deviation over each one's.

    By (v,) sums of squared residuals [px^2] and their degrees of freedom; None where chance
    explains their differences, or where one has no residuals.
    """
    if len(squares) < 2 or not np.all((squares > 0.0) & (freedom > 0.0)):
        return None
    # Logarithms of the views' variances, without bias, and their own variances.
    logs = np.log(squares / 2.0) - digamma(freedom / 2.0)
    by_chance = polygamma(1, freedom / 2.0)
    deviations = logs - np.average(logs, weights=1.0 / by_chance)
    if np.sum(deviations**2 / by_chance) < chi2_limit(FALSE_ALARM, len(logs) - 1):
        return None
    most, least = polygamma(1, np.exp(_LOGS))
    between = float(np.clip(np.var(logs, ddof=1) - np.mean(by_chance), least, most))
    half = np.exp(root_of(lambda log: between - polygamma(1, np.exp(log)), *_LOGS, 1e-12))
    scale = np.exp(np.mean(logs) + digamma(half))
    variances = (scale + squares / 2.0) / (half + freedom / 2.0)
    return np.asarray(np.exp(np.mean(np.log(variances)) / 2.0) / np.sqrt(variances), dtype=float)
