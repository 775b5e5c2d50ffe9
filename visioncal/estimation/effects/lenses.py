"""Effect of lenses and boards: each camera has its own lens, and all see the same boards.

Each camera's corners are compressed to poses with their covariance and Jacobian with respect to
lens and boards, and to information on lens and boards, which is summed here and joined by priors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.appearance import Appearance, Compressed, compress
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.scene import CornerProblem
from visioncal.estimation.unknowns import BOARD, LENS
from visioncal.vision.board_shape import shape_slices
from visioncal.vision.camera import intrinsics, with_intrinsics
from visioncal.vision.corners import floored_sigma_px

# The effect's name in a problem.
LENSES = "lenses and boards"


@dataclass(frozen=True, eq=False)
class CameraParameters:
    """Parameters of all lenses and boards, with the cameras' corners."""

    problems: Mapping[str, CornerProblem]  # Each camera's corners, by camera name.
    values: FloatArray  # (k,) intrinsics of all lenses, camera by camera, then all boards' shapes.
    poses: FloatArray  # (v, 4, 4) `cam_from_target` of the views, camera by camera.

    @classmethod
    def of(
        cls, problems: Mapping[str, CornerProblem], poses: Mapping[str, FloatArray]
    ) -> "CameraParameters":
        """Lenses and boards as stated or previously estimated.

        Args:
            problems: Each camera's corners, of the same boards.
            poses: (v, 4, 4) poses of each camera's views, in the order of its corners.
        """
        lenses = [intrinsics(problem.scene.camera) for problem in problems.values()]
        boards = next(iter(problems.values())).basis.shape[2]
        return cls(
            problems,
            np.concatenate([*lenses, np.zeros(boards)]),
            np.concatenate([poses[name] for name in problems]),
        )

    @cached_property
    def parts(self) -> Mapping[tuple[str, str], slice]:
        """Slice of each lens and each board among the values."""
        scene, lenses = self._one.scene, [len(problem.lens) for problem in self.problems.values()]
        ends = np.cumsum([0, *lenses]).tolist()
        shapes = shape_slices(scene.targets, self.boards.start)
        names = [(LENS, name) for name in self.problems] + [(BOARD, name) for name in scene.names]
        return dict(zip(names, (*map(slice, ends, ends[1:]), *shapes), strict=True))

    @property
    def boards(self) -> slice:
        """Slice of the boards' shapes among the values."""
        return slice(sum(len(problem.lens) for problem in self.problems.values()), len(self.values))

    @property
    def scales(self) -> IntArray:
        """Indices of the printed boards' scales."""
        return self.places(next(iter(self.problems)))[self._one.scale]

    @property
    def _one(self) -> CornerProblem:
        """Corners of the first camera; as to boards, all cameras are alike."""
        return next(iter(self.problems.values()))

    @cached_property
    def prior_information(self) -> FloatArray:
        """(k, k) information on the values by what is stated and the sizes of their errors."""
        information = np.zeros((len(self.values),) * 2)
        for name, problem in self.problems.items():
            places = self.places(name)
            information[np.ix_(places, places)] = problem.prior_information
        return information

    @cached_property
    def free(self) -> IntArray:
        """(f,) indices of the uncertain values, whether fitted or held."""
        problems = self.problems.items()
        return np.unique(np.concatenate([self.places(at)[of.is_uncertain] for at, of in problems]))

    @cached_property
    def held(self) -> IntArray:
        """Indices of the values that no fit moves."""
        problems = self.problems.items()
        return np.unique(np.concatenate([self.places(at)[of.is_held] for at, of in problems]))

    @cached_property
    def stated(self) -> FloatArray:
        """(k,) stated or previously estimated values."""
        return CameraParameters.of(
            self.problems, {name: np.zeros((0, 4, 4)) for name in self.problems}
        ).values

    def weighed(self, seen: "LinearisedCorners") -> "CameraParameters":
        """Reweights views by the residuals of all corners."""
        problems = {
            name: replace(corner_problem, stack=corner_problem.stack.weighed(compressed.residuals))
            for (name, corner_problem), compressed in zip(
                self.problems.items(), seen.compressed, strict=True
            )
        }
        return replace(self, problems=problems)

    def camera(self, name: str) -> Camera:
        """A camera with its present intrinsics."""
        return with_intrinsics(
            self.problems[name].scene.camera, self.values[self.parts[LENS, name]]
        )

    @property
    def points(self) -> FloatArray:
        """(c, 3) corners of all boards, each in its board's frame [m]."""
        return self._one.positions + self._one.basis @ self.values[self.boards]

    def with_values(self, free: IntArray, found: FloatArray) -> "CameraParameters":
        """Replaces (f,) values at the given indices."""
        values = self.values.copy()
        values[free] = found
        return replace(self, values=values)

    def linearised(self) -> "LinearisedCorners":
        """Compresses all corners."""
        by_camera, sigmas = [], []
        information = np.zeros((len(self.values), len(self.values)))
        gradient = np.zeros(len(self.values))
        for name, problem in self.problems.items():
            compressed, places = self.compressed(name), self.places(name)
            sigma = problem.sigma_px(compressed)
            weight = 1.0 / floored_sigma_px(sigma) ** 2
            information[np.ix_(places, places)] += weight * compressed.shared_information
            gradient[places] += weight * compressed.shared_gradient
            by_camera.append(compressed)
            sigmas.append(sigma)
        poses = np.concatenate([compressed.cam_from_target for compressed in by_camera])
        corners = PriorInformation(information, gradient)
        optics = replace(self, poses=poses)
        return LinearisedCorners(optics, tuple(by_camera), tuple(sigmas), corners)

    def compressed(self, name: str) -> Compressed:
        """Compresses one camera's corners, linearised at its poses."""
        problem = self.problems[name]
        return compress(
            problem.stack,
            problem.basis,
            Appearance(self.camera(name), self.values[self.boards]),
            self.poses[self.rows(name)],
            problem.scale,
            problem.shares,
            problem.levels,
        )

    def rows(self, name: str) -> slice:
        """Slice of one camera's views among all views."""
        names = list(self.problems)
        ends = np.cumsum([0, *(len(problem.stack.views) for problem in self.problems.values())])
        return slice(*ends[names.index(name) : names.index(name) + 2].tolist())

    def places(self, name: str) -> IntArray:
        """Indices of the values that one camera's corners depend on: its lens and all boards."""
        return np.asarray(np.r_[self.parts[LENS, name], self.boards])


@dataclass(frozen=True, eq=False)
class LinearisedCorners:
    """All corners, linearised in poses, lenses and boards."""

    camera_parameters: CameraParameters  # The linearisation point.
    compressed: tuple[Compressed, ...]  # Normal equations of each camera's corners.
    sigmas_px: tuple[float, ...]  # Each camera's noise of a corner's coordinate [px].
    corners: PriorInformation  # Information of the corners on all values, with free poses.

    @cached_property
    def free(self) -> IntArray:
        """(f,) indices of the uncertain values: those that a fit moves, and held ones."""
        return self.camera_parameters.free

    @property
    def held(self) -> Mask:
        """(f,) mask of the held ones among the `free` values."""
        return np.isin(self.free, self.camera_parameters.held)

    @property
    def known(self) -> PriorInformation:
        """Information on the free values from corners and priors, without any robot."""
        optics, free = self.camera_parameters, self.free
        corners = self.corners.information[np.ix_(free, free)]
        prior = optics.prior_information[np.ix_(free, free)]
        gradient = prior @ (optics.values - optics.stated)[free]
        return PriorInformation(corners + prior, self.corners.gradient[free] + gradient)

    @property
    def covariance(self) -> FloatArray:
        """Covariances (v, 6, 6) of all views' poses."""
        return np.concatenate(
            [
                floored_sigma_px(sigma) ** 2 * compressed.covariance
                for compressed, sigma in zip(self.compressed, self.sigmas_px, strict=True)
            ]
        )

    @property
    def by_free(self) -> FloatArray:
        """Jacobian (v, 6, f) of all views' poses with respect to the free values."""
        moves = np.zeros((len(self.views), 6, len(self.free)))
        for name, compressed in zip(self.camera_parameters.problems, self.compressed, strict=True):
            places = self.camera_parameters.places(name)
            kept = np.isin(self.free, places)
            columns = np.searchsorted(places, self.free[kept])
            moves[self.camera_parameters.rows(name), :, kept] = compressed.by_shared[:, :, columns]
        return moves

    @property
    def field_sizes(self) -> list[int]:
        """Number of coefficients of each camera's lens errors beyond its model."""
        return [compressed.by_field.shape[2] for compressed in self.compressed]

    @property
    def by_field(self) -> FloatArray:
        """Jacobian (v, 6, m) of all views' poses by the coefficients of lens errors."""
        by_camera = [compressed.by_field for compressed in self.compressed]
        flat = block_diag(*(array.reshape(6 * len(array), array.shape[2]) for array in by_camera))
        return np.asarray(flat.reshape(len(self.views), 6, flat.shape[1]))

    def effect(self, rows: IntArray) -> Effect:
        """The free values, then the coefficients of `by_field`, as an effect on observations.

        Args:
            rows: (n,) the view of each observation; -1 for none.
        """
        is_view, sizes = rows >= 0, self.field_sizes
        fields = sum(sizes)
        by_sensor = np.zeros((len(rows), 6, len(self.free) + fields))
        by_sensor[is_view] = np.concatenate([self.by_free, self.by_field], axis=2)[rows[is_view]]
        variances = np.repeat([floored_sigma_px(sigma) ** 2 for sigma in self.sigmas_px], sizes)
        # Coefficients are independent of the free values: no information between them.
        prior = PriorInformation(
            np.asarray(block_diag(self.known.information, np.diag(1.0 / variances))),
            np.append(self.known.gradient, np.zeros(fields)),
        )
        values = np.append(self.camera_parameters.values[self.free], np.zeros(fields))
        held = np.append(self.held, np.zeros(fields, dtype=bool))
        scales = np.flatnonzero(np.isin(self.free, self.camera_parameters.scales))
        return Effect(LENSES, values, prior, held, by_sensor, sizes=scales)

    @property
    def views(self) -> tuple[int, ...]:
        """Numbers of the views, camera by camera."""
        return tuple(
            view
            for problem in self.camera_parameters.problems.values()
            for view in problem.stack.views
        )
