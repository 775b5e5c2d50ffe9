"""What lenses do beyond their models: how large it is, and in words where chance is no cause."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from visioncal.calibration.pipeline.solving import Solved
from visioncal.core.number_format import figure
from visioncal.core.verdict import Finding, Step
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.lens_levels import SIGNIFICANT
from visioncal.estimation.residual_tests import common_errors, lens_field


@dataclass(frozen=True)
class LensErrors:
    """What one lens does beyond its model.

    Attributes:
        levels: Its sizes, over the noise of a corner's coordinate.
        noise_px: That [px].
        is_of_lens: Whether corners err by where they are in the image, not by which ones they are.
    """

    levels: LensLevels
    noise_px: float
    is_of_lens: bool

    @property
    def field_px(self) -> float:
        """Standard deviation of the field, an axis [px]."""
        return self.levels.field * self.noise_px


def lens_errors(solved: Solved) -> dict[str, LensErrors]:
    """What was found of each camera's lens; of a session without images, nothing."""
    seen = solved.seen
    if seen is None:
        return {}
    found = {}
    for (name, problem), noise_px in zip(seen.looks.problems.items(), seen.sigmas_px, strict=True):
        levels = problem.levels or LensLevels()
        found[name] = LensErrors(levels, noise_px, _is_of_lens(solved, name))
    return found


def _is_of_lens(solved: Solved, camera: str) -> bool:
    """Compares means of residuals by cells of the image with those by corners of the board."""
    seen = solved.seen
    if seen is None:
        return False
    looks = seen.looks
    problem = looks.problems[camera]
    if problem.levels is None or problem.levels.gains[0] < SIGNIFICANT:
        return False
    bare = replace(looks, problems={**looks.problems, camera: problem.without_levels()})
    own = bare.compressed(camera)
    stack, shares = problem.stack, problem.shares[problem.stack.view_of]
    by_place = lens_field(stack.px, own.residuals, problem.scene.camera.resolution, shares)
    by_corner = common_errors(stack.ids, own.residuals, shares)
    return by_place.is_significant and by_place.mahalanobis_sq > by_corner.mahalanobis_sq


def errors_found(lenses: Mapping[str, LensErrors]) -> Iterator[Finding]:
    """What chance does not explain."""
    for name, it in lenses.items():
        of = "The lens" if len(lenses) == 1 else f"The lens of {name}"
        field, breathing, jitter = it.levels.gains
        if it.is_of_lens:
            yield Finding(
                "lens_field",
                f"{of} departs from its model: corners of one part of the image are off alike, by "
                f"{figure(it.field_px)} px. The result counts it, and belongs to this lens.",
                Step(
                    "Give matrix and distortion of a model that fits the lens, or keep the work in "
                    "the middle of the image."
                ),
                mahalanobis_sq=field,
            )
        if max(breathing, jitter) > SIGNIFICANT:
            share = 100.0 * it.noise_px
            how = [f"by {figure(share * it.levels.breathing)} % where the distance doubles"] * (
                breathing > SIGNIFICANT
            ) + [f"by {figure(share * it.levels.jitter)} % from view to view"] * (
                jitter > SIGNIFICANT
            )
            yield Finding(
                "focus",
                f"{of} changes its focal length {' and '.join(how)}. The result counts it.",
                Step("Fix the focus (no autofocus), or work at one distance."),
                mahalanobis_sq=max(breathing, jitter),
            )
