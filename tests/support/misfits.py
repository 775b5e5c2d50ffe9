"""Errors in units of what is stated of them."""

import numpy as np

from visioncal.core.transforms import invert, log


def misfit(edge, truth, among=slice(None)) -> float:
    """The squared error of an edge over its covariance, of all or some of its six numbers."""
    error = log(invert(truth) @ edge.matrix)[among]
    return float(error @ np.linalg.solve(edge.covariance[among, among], error))
