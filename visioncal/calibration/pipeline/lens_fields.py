"""What lenses beyond their model leave in corners: tested, counted in the covariance, worded."""

from collections.abc import Iterator, Mapping

import numpy as np

from visioncal.calibration.pipeline.solving import Solved
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Step
from visioncal.estimation.residual_tests import LensField, lens_field, lens_inflation

# The source of uncertainty, as a budget names it.
LENS_FIELD = "lens_field"


def lens_fields(solved: Solved) -> dict[str, LensField]:
    """Tests the corners of each camera; of a session without images, there are none."""
    if solved.seen is None:
        return {}
    problems = solved.seen.looks.problems.items()
    return {
        name: lens_field(
            it.stack.px,
            own.residuals,
            it.scene.camera.resolution,
            it.shares[it.stack.view_of],
        )
        for (name, it), own in zip(problems, solved.seen.compressed, strict=True)
    }


def covariance_of_fields(solved: Solved, fields: Mapping[str, LensField]) -> dict[str, FloatArray]:
    """Covariances (p, p) of what independent noise of the corners does not account for."""
    seen, part, fit = solved.seen, solved.part, solved.agreed.fit
    found = {}
    for name, it in fields.items():
        if seen is None or it.factor == 1.0:
            continue
        corners = np.zeros((part.size,) * 2)
        columns = solved.columns_of(seen.free)
        corners[np.ix_(columns, columns)] = seen.information_of(name)
        more = lens_inflation(part, fit.state, fit.noise, name, corners, it.factor)
        of = "" if len(fields) == 1 else f" of {name}"
        found[f"{LENS_FIELD}{of}"] = more
    return found


def fields_found(fields: Mapping[str, LensField]) -> Iterator[Finding]:
    """What chance does not explain."""
    for name, it in fields.items():
        if it.is_significant:
            of = "The lens" if len(fields) == 1 else f"The lens of {name}"
            yield Finding(
                "lens_field",
                f"{of} departs from its model: corners of one part of the image are off alike, by "
                f"{figure(it.sigma_px)} px, {figure(np.sqrt(it.factor))} times what their noise "
                "explains. The covariance counts it; more views do not lower it.",
                Step(
                    "Fix the focus, give matrix and distortion of a model that fits the lens, or "
                    "keep the work in the middle of the image."
                ),
                mahalanobis_sq=it.mahalanobis_sq,
            )
