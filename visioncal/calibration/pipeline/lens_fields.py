"""What lenses do beyond their models: how large it is, and in words where chance is no cause."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.stages.cause_ranking import LENS_CHANGED
from visioncal.core.number_format import figure
from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.lens_field import LensLevels, depths_m, displacements
from visioncal.estimation.lens_levels import SIGNIFICANT
from visioncal.estimation.lens_step import LensStep, lens_step
from visioncal.estimation.residual_tests import common_errors, lens_field
from visioncal.results.lens import LensField

# Variance of displacements that is none beside that of corners; and places an axis to see that.
_INVISIBLE, _GRID = 1e-4, 12
# Parts of a step of a lens that are named, in sigmas.
_CLEARLY = 3.0


@dataclass(frozen=True)
class LensErrors:
    """What one lens does beyond its model.

    Attributes:
        levels: Its sizes, over the noise of a corner's coordinate.
        noise_px: That [px].
        is_of_lens: Whether corners err by where they are in the image, not by which ones they are.
        distance_m: The mean distance of the views [m].
        focal_px: The focal length [px].
    """

    levels: LensLevels
    noise_px: float
    is_of_lens: bool
    distance_m: float
    focal_px: float

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
    for which, (name, problem) in enumerate(seen.looks.problems.items()):
        found[name] = LensErrors(
            problem.levels or LensLevels(),
            seen.sigmas_px[which],
            _is_of_lens(solved, name),
            _distance_m(seen, which),
            float(np.mean(seen.looks.camera(name).matrix[:2])),
        )
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


def lens_field_of(
    solved: Solved, camera: str, covariance: FloatArray, edges: int
) -> LensField | None:
    """What one lens does beyond its model, as a result has it; None where that is nothing.

    Args:
        solved: The fit.
        camera: The camera.
        covariance: (p, p) of its unknowns.
        edges: How many of these, the first, are edges'.
    """
    seen = solved.seen
    if seen is None:
        return None
    looks, which = seen.looks, list(seen.looks.problems).index(camera)
    levels, noise_px = looks.problems[camera].levels, floored_sigma_px(seen.sigmas_px[which])
    if levels is None or not (levels.field or levels.breathing or levels.jitter):
        return None
    lens, place = looks.lens_of(camera), looks.places(camera)
    mean, rows, root = np.zeros(0), np.zeros((0, len(covariance))), np.zeros((0, 0))
    if (found := seen.compressed[which].coefficients) is not None:
        # Coefficients follow lens and boards; what poses moved with of the rest is in the fit.
        state = solved.agreed.fit.state
        open_, beyond = np.isin(place, seen.free), _columns_beyond(solved, which)
        shared = solved.columns_of(place[open_])
        rows = np.zeros((len(found.mean), len(covariance)))
        rows[:, shared], rows[:, beyond] = found.slope[:, open_], found.open
        values = solved.agreed.problem.values_of(LENSES, state)
        moved = values[: len(seen.free)] - looks.values[seen.free]
        fitted = values[beyond - solved.lens_columns.start]
        mean = found.mean + found.slope[:, open_] @ moved[np.isin(seen.free, place)]
        mean = (mean + found.open @ fitted) / noise_px
        own = rows @ covariance @ rows.T / noise_px**2 + found.rest @ found.rest.T
        root = _root(own, looks.camera(camera), levels)
    shared_lens, free = np.zeros((len(mean), len(lens))), np.isin(lens, seen.free)
    shared_lens[:, free] = rows @ covariance[:, solved.columns_of(lens[free])] / noise_px
    return LensField(
        field_px=noise_px * levels.field,
        length=levels.length,
        breathing=noise_px * levels.breathing,
        jitter=noise_px * levels.jitter,
        distance_m=_distance_m(seen, which),
        coefficients=mean,
        root=root,
        intrinsics_covariance=shared_lens,
        edge_covariance=rows @ covariance[:, :edges] / noise_px,
    )


def _columns_beyond(solved: Solved, which: int) -> IntArray:
    """The problem's columns of what one lens does beyond its model."""
    seen = solved.seen
    sizes = [] if seen is None else [compressed.by_field.shape[2] for compressed in seen.compressed]
    first = sum(sizes[:which])
    return solved.field_columns[first : first + sizes[which]]


def _distance_m(seen: LinearisedCorners, which: int) -> float:
    """The mean distance of one camera's views."""
    stack = [*seen.looks.problems.values()][which].stack
    return float(np.mean(depths_m(stack, seen.compressed[which].cam_from_target)))


def _root(covariance: FloatArray, camera: Camera, levels: LensLevels) -> FloatArray:
    """(m, r) root of a covariance of coefficients, without what displaces no pixel visibly."""
    wide, high = (np.linspace(0.0, index - 1.0, _GRID) for index in camera.resolution)
    px = np.stack(np.meshgrid(wide, high), axis=-1).reshape(-1, 2)
    # Breathing by as much as the distance changes.
    size = np.sqrt(np.mean(np.sum(displacements(px, camera, 1.0, levels) ** 2, axis=1), axis=0))
    values, vectors = np.linalg.eigh(np.outer(size, size) * covariance)
    kept = values > _INVISIBLE
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]) / size[:, None])


def lens_changes(solved: Solved) -> Iterator[Finding]:
    """Lenses that were zoomed, focused anew or hit midway, by the corners alone."""
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return
    stations = {row.view: row.station for row in solved.cell.rows}
    for which, (name, problem) in enumerate(looks.problems.items()):
        views = problem.stack.views
        # Images of the lens alone have no time.
        timed = np.array([view in stations for view in views])
        stack = replace(problem.stack, zooms=None)
        stack = stack.with_points(looks.points[stack.ids]).keep(timed[stack.view_of])
        order = np.argsort([stations[view] for view in stack.views], kind="stable")
        poses = seen.compressed[which].cam_from_target[timed]
        step = lens_step(stack, looks.camera(name), poses, order)
        if step is None:
            continue
        first = stations[stack.views[int(order[step.first])]]
        of = "The lens" if len(looks.problems) == 1 else f"The lens of {name}"
        yield Finding(
            LENS_CHANGED,
            f"{of} changed: {solved.cell.from_when(first)}, {_step_words(step)}, by the corners "
            "alone; the result is between both lenses.",
            solved.cell.or_apart(
                "Switch off autofocus and image stabilisation, fasten zoom and focus rings", first
            ),
            mahalanobis_sq=step.gain,
        )


def _step_words(step: LensStep) -> str:
    words = []
    if abs(step.zoom) > _CLEARLY * step.sigmas[0]:
        longer = "longer" if step.zoom > 0.0 else "shorter"
        words.append(
            f"its focal length is {figure(100.0 * abs(step.zoom))} % {longer} (sigma "
            f"{figure(100.0 * step.sigmas[0])} %)"
        )
    x, y = step.centre_px
    if max(abs(x) / step.sigmas[1], abs(y) / step.sigmas[2]) > _CLEARLY:
        words.append(
            f"its principal point is ({figure(x)}, {figure(y)}) px from where it was (sigma "
            f"{figure(max(step.sigmas[1:]))} px)"
        )
    return " and ".join(words) or "its focal length and principal point are others"


def errors_found(lenses: Mapping[str, LensErrors]) -> Iterator[Finding]:
    """What chance does not explain."""
    for name, lens in lenses.items():
        of = "The lens" if len(lenses) == 1 else f"The lens of {name}"
        field, breathing, jitter = lens.levels.gains
        if lens.is_of_lens:
            yield Finding(
                "lens_field",
                f"{of} departs from its model: corners of one part of the image are off alike, by "
                f"{figure(lens.field_px)} px. The result counts it, and belongs to this lens.",
                Remedy(
                    "Give matrix and distortion of a model that fits the lens, or keep the work in "
                    "the middle of the image."
                ),
                mahalanobis_sq=field,
                up_to_mm=1e3 * lens.field_px / lens.focal_px * lens.distance_m,
            )
        if max(breathing, jitter) > SIGNIFICANT:
            share = 100.0 * lens.noise_px
            how = [f"by {figure(share * lens.levels.breathing)} % where the distance doubles"] * (
                breathing > SIGNIFICANT
            ) + [f"by {figure(share * lens.levels.jitter)} % from view to view"] * (
                jitter > SIGNIFICANT
            )
            yield Finding(
                "focus",
                f"{of} changes its focal length {' and '.join(how)}. The result counts it.",
                Remedy("Fix the focus (no autofocus), or work at one distance."),
                mahalanobis_sq=max(breathing, jitter),
                up_to_mm=10.0
                * share
                * max(lens.levels.breathing, lens.levels.jitter)
                * lens.distance_m,
            )
