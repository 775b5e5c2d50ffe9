"""Effect of lenses and boards: every camera has its lens, and all see the same boards.

Each camera's corners are compressed to poses with their covariance, to how these move with lens and
boards, and to information on lens and boards; here the latter comes together, with the priors.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.appearance import Appearance, Compressed, compress
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.scene import CornerProblem
from visioncal.estimation.variance import PriorInformation
from visioncal.vision.camera import intrinsics, with_intrinsics

# The effect's name in a problem.
LENSES = "lenses and boards"


@dataclass(frozen=True, eq=False)
class CameraParameters:
    """The cameras' corners, and what lenses and boards are taken to be.

    Attributes:
        problems: Each camera's corners, by the camera.
        values: (k,) all lenses' intrinsics, camera by camera, and then all boards' shapes.
        poses: (v, 4, 4) of the views, camera by camera.
        resized: Printed boards whose scales are free from the start.
    """

    problems: Mapping[str, CornerProblem]
    values: FloatArray
    poses: FloatArray
    resized: tuple[int, ...] = ()

    @classmethod
    def of(
        cls, problems: Mapping[str, CornerProblem], poses: Mapping[str, FloatArray]
    ) -> "CameraParameters":
        """Lenses and boards as they are stated or were estimated before.

        Args:
            problems: Each camera's corners, of the same boards.
            poses: (v, 4, 4) the poses of each camera's views, in the order of its corners.
        """
        lenses = [intrinsics(problem.scene.camera) for problem in problems.values()]
        boards = next(iter(problems.values())).basis.shape[2]
        return cls(
            problems,
            np.concatenate([*lenses, np.zeros(boards)]),
            np.concatenate([poses[name] for name in problems]),
        )

    @cached_property
    def lenses(self) -> Mapping[str, slice]:
        """Places of each camera's intrinsics among the values."""
        places, at = {}, 0
        for name, problem in self.problems.items():
            places[name] = slice(at, at + len(problem.lens))
            at += len(problem.lens)
        return places

    @property
    def boards(self) -> slice:
        """Places of the boards' shapes."""
        return slice(sum(len(problem.lens) for problem in self.problems.values()), len(self.values))

    @property
    def printed(self) -> list[int]:
        """Which boards are printed; see `CornerProblem.printed`."""
        return self._one.printed

    def scale_of(self, board: int) -> IntArray:
        """Place (1,) of one printed board's scale."""
        return self._here(self._one.scale_of(board))

    def shape_of(self, board: int) -> IntArray:
        """Places (9,) of one printed board's aspect, shear and bend."""
        return self._here(self._one.shape_of(board))

    def moved_points(self, rig: int) -> FloatArray:
        """(3 n,) how far the points of a rig are from its table's [m]; empty for exact ones."""
        return self.values[self._here(self._one.points_of(rig))]

    @property
    def corners(self) -> tuple[FloatArray, ...]:
        """The corners (c, 3) of every board, as it is taken to be, in its frame [m]."""
        one = self._one
        places = one.positions + one.basis @ self.values[self.boards]
        return tuple(places[one.corners_of(index)] for index in range(len(one.scene.targets)))

    @property
    def _one(self) -> CornerProblem:
        """Any camera's corners: all see the same boards."""
        return next(iter(self.problems.values()))

    def _here(self, places: IntArray) -> IntArray:
        """Places of boards' values, by those that they have with one camera alone."""
        return np.asarray(places - len(self._one.lens) + self.boards.start)

    @cached_property
    def prior_sigma(self) -> FloatArray:
        """(k,) what the values are known to beforehand; inf where nothing is."""
        lenses = [problem.prior_sigma[problem.lens] for problem in self.problems.values()]
        return np.concatenate([*lenses, self._one.prior_sigma[len(self._one.lens) :]])

    @cached_property
    def stated(self) -> FloatArray:
        """(k,) the values as they are stated, or were estimated before."""
        return CameraParameters.of(
            self.problems, {name: np.zeros((0, 4, 4)) for name in self.problems}
        ).values

    @property
    def first(self) -> IntArray:
        """What is free from the start."""
        found = [self.places(name)[problem.first] for name, problem in self.problems.items()]
        return np.unique(np.concatenate([*found, *map(self.scale_of, self.resized)]))

    @property
    def counted(self) -> IntArray:
        """What is uncertain and counts in the covariance, whether it is free or not."""
        found = (self.places(name)[problem.counted] for name, problem in self.problems.items())
        return np.unique(np.concatenate([*found]))

    @property
    def shape(self) -> IntArray:
        """Places of the printed boards' aspects, shears and bends."""
        return self._here(self._one.shape)

    def stated_scale_sigma(self, board: int) -> float:
        """What the stated size of a printed board is known to, as a share of it."""
        target = self._one.scene.targets[board]
        return target.square_sigma_m / target.square_m

    def lens_of(self, name: str) -> IntArray:
        """Places of one camera's intrinsics."""
        return np.arange(self.lenses[name].start, self.lenses[name].stop)

    @property
    def has_spare_corners(self) -> bool:
        """Whether all cameras show more corners than it takes to free lens and board."""
        return all(problem.has_spare_corners for problem in self.problems.values())

    def without_prior(self, places: Iterable[int]) -> "CameraParameters":
        """The same, some values of which nobody has stated."""
        gone = np.array([*places])
        problems = {
            name: problem.without_prior(np.flatnonzero(np.isin(self.places(name), gone)))
            for name, problem in self.problems.items()
        }
        return replace(self, problems=problems)

    def doubting(self, lenses: Mapping[str, tuple[FloatArray, IntArray]]) -> "CameraParameters":
        """The same, given intrinsics of cameras being known to (k,), and those in doubt counting.

        Args:
            lenses: Both by camera, places being those among its own intrinsics.
        """
        problems = {
            name: problem.with_lens_sigma(*lenses[name]) if name in lenses else problem
            for name, problem in self.problems.items()
        }
        return replace(self, problems=problems)

    def with_sizes(self, scales: Mapping[int, float]) -> "CameraParameters":
        """The same, printed boards being larger than stated by some shares, free from the start."""
        places = [int(self.scale_of(board)[0]) for board in scales]
        unstated = replace(self.without_prior(places), resized=tuple(scales))
        return unstated.with_values(np.array(places), np.array([*scales.values()]))

    def contesting(self, names: Collection[str]) -> "CameraParameters":
        """The same, the intrinsics of some cameras being held although corners contradict them."""
        problems = {
            name: replace(problem, contested=name in names)
            for name, problem in self.problems.items()
        }
        return replace(self, problems=problems)

    def weighed(self, seen: "LinearisedCorners") -> "CameraParameters":
        """The same, views weighing as the residuals of all corners ask for."""
        problems = {
            name: replace(corner_problem, stack=corner_problem.stack.weighed(own.residuals))
            for (name, corner_problem), own in zip(
                self.problems.items(), seen.compressed, strict=True
            )
        }
        return replace(self, problems=problems)

    def with_levels(self, levels: Mapping[str, LensLevels]) -> "CameraParameters":
        """The same, lenses erring beyond their models by these sizes."""
        problems = {
            name: problem.with_levels(levels[name]) if name in levels else problem
            for name, problem in self.problems.items()
        }
        return replace(self, problems=problems)

    @property
    def levels(self) -> dict[str, LensLevels]:
        """The sizes of what lenses do beyond their models, as far as they were estimated."""
        return {
            name: problem.levels
            for name, problem in self.problems.items()
            if problem.levels is not None
        }

    def camera(self, name: str) -> Camera:
        """A camera with its lens as it is taken to be."""
        return with_intrinsics(self.problems[name].scene.camera, self.values[self.lenses[name]])

    @property
    def has_lenses(self) -> bool:
        """Whether every camera has a lens that can be: its focal lengths are positive."""
        return all(self.values[place][:2].min() > 0 for place in self.lenses.values())

    @property
    def points(self) -> FloatArray:
        """(c, 3) where the corners of all boards lie, each on its own board [m]."""
        return np.concatenate(self.corners)

    def with_values(self, free: IntArray, found: FloatArray) -> "CameraParameters":
        """Returns them with (f,) values at some places."""
        values = self.values.copy()
        values[free] = found
        return replace(self, values=values)

    def linearised(
        self, moving: IntArray, before: "LinearisedCorners | None" = None
    ) -> "LinearisedCorners":
        """Compresses all corners, (f,) values being free.

        Args:
            moving: Places of these values.
            before: Where they were linearised before: what a camera's corners say there holds where
                neither its lens, boards, poses nor weights have changed since.
        """
        found, sigmas = [], []
        information = np.zeros((len(self.values), len(self.values)))
        gradient = np.zeros(len(self.values))
        for name, problem in self.problems.items():
            compressed = None if before is None else before.still(self, name)
            compressed, places = compressed or self.compressed(name), self.places(name)
            sigma = problem.sigma_px(compressed, np.flatnonzero(np.isin(places, moving)))
            weight = 1.0 / floored_sigma_px(sigma) ** 2
            information[np.ix_(places, places)] += weight * compressed.shared_information
            gradient[places] += weight * compressed.shared_gradient
            found.append(compressed)
            sigmas.append(sigma)
        poses = np.concatenate([compressed.cam_from_target for compressed in found])
        corners = PriorInformation(information, gradient)
        optics = replace(self, poses=poses)
        return LinearisedCorners(optics, np.sort(moving), tuple(found), tuple(sigmas), corners)

    def compressed(self, name: str) -> Compressed:
        """What one camera's corners say, linearised at its poses."""
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
        """The rows of one camera's views among all."""
        names, counts = (
            list(self.problems),
            [len(problem.stack.views) for problem in self.problems.values()],
        )
        first = sum(counts[: names.index(name)])
        return slice(first, first + counts[names.index(name)])

    def places(self, name: str) -> IntArray:
        """Places of what one camera's corners determine: its lens and all boards."""
        lens, boards = self.lenses[name], self.boards
        return np.concatenate(
            [np.arange(lens.start, lens.stop), np.arange(boards.start, boards.stop)]
        )


@dataclass(frozen=True, eq=False)
class LinearisedCorners:
    """What all corners say of poses, lenses and boards, where they were linearised.

    Attributes:
        camera_parameters: Where that was.
        moving: Places of the values that a fit moves.
        compressed: What each camera's corners say.
        sigmas_px: Each camera's noise of a corner's coordinate [px].
        corners: What the corners say of all values, the poses being free.
    """

    camera_parameters: CameraParameters
    moving: IntArray
    compressed: tuple[Compressed, ...]
    sigmas_px: tuple[float, ...]
    corners: PriorInformation

    @cached_property
    def free(self) -> IntArray:
        """(f,) places of the values that are uncertain: those that move, and others that count."""
        return np.union1d(self.moving, self.camera_parameters.counted)

    @property
    def held(self) -> Mask:
        """(f,) which of them stay where they are."""
        return ~np.isin(self.free, self.moving)

    def holds_lens(self, name: str) -> bool:
        """Whether a camera has a lens that is uncertain, and stays where it is."""
        optics = self.camera_parameters
        if name not in optics.lenses:
            return False
        lens = optics.lens_of(name)
        return bool(np.isin(lens, self.free).any() and not np.isin(lens, self.moving).any())

    @property
    def known(self) -> PriorInformation:
        """What is known of the free values without any robot."""
        optics, free = self.camera_parameters, self.free
        prior = 1.0 / optics.prior_sigma[free] ** 2
        return PriorInformation(
            self.corners.information[np.ix_(free, free)] + np.diag(prior),
            self.corners.gradient[free] + prior * (optics.values - optics.stated)[free],
        )

    def freed(
        self, moving: IntArray, optics: CameraParameters | None = None
    ) -> "LinearisedCorners":
        """The same with other values moving, or with other priors."""
        return replace(
            self, moving=np.sort(moving), camera_parameters=optics or self.camera_parameters
        )

    def still(self, optics: CameraParameters, name: str) -> Compressed | None:
        """What one camera's corners say, if other parameters have it alike; else None."""
        mine, there = self.camera_parameters.problems[name], optics.problems[name]
        places = optics.places(name)
        is_alike = (
            there.stack is mine.stack
            and there.levels == mine.levels
            and optics.poses is self.camera_parameters.poses
            and np.array_equal(optics.values[places], self.camera_parameters.values[places])
        )
        return self.compressed[list(optics.problems).index(name)] if is_alike else None

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
        """How all views' poses (v, 6, f) move with the free values."""
        found = np.zeros((len(self.views), 6, len(self.free)))
        for name, compressed in zip(self.camera_parameters.problems, self.compressed, strict=True):
            places = self.camera_parameters.places(name)
            own = np.isin(self.free, places)
            columns = np.searchsorted(places, self.free[own])
            found[self.camera_parameters.rows(name), :, own] = compressed.by_shared[:, :, columns]
        return found

    @cached_property
    def by_field(self) -> FloatArray:
        """How all views' poses (v, 6, m) move with the lenses beyond their models."""
        sizes = [compressed.by_field.shape[2] for compressed in self.compressed]
        found = np.zeros((len(self.views), 6, sum(sizes)))
        view = at = 0
        for compressed, size in zip(self.compressed, sizes, strict=True):
            found[view : view + len(compressed.by_field), :, at : at + size] = compressed.by_field
            view, at = view + len(compressed.by_field), at + size
        return found

    def effect(self, rows: IntArray) -> Effect:
        """The free values as an effect on observations, and behind them those of `by_field`.

        Args:
            rows: (n,) which of the views each observation is; -1 for none of them.
        """
        mine, fields = rows >= 0, self.by_field.shape[2]
        by_sensor = np.zeros((len(rows), 6, len(self.free) + fields))
        by_sensor[mine] = np.concatenate([self.by_free, self.by_field], axis=2)[rows[mine]]
        sizes = [compressed.by_field.shape[2] for compressed in self.compressed]
        variances = np.repeat([floored_sigma_px(sigma) ** 2 for sigma in self.sigmas_px], sizes)
        # Coefficients follow the free values: neither says anything of the other.
        known = PriorInformation(
            np.asarray(block_diag(self.known.information, np.diag(1.0 / variances))),
            np.append(self.known.gradient, np.zeros(fields)),
        )
        values = np.append(self.camera_parameters.values[self.free], np.zeros(fields))
        held = np.append(self.held, np.zeros(fields, dtype=bool))
        return Effect(LENSES, values, known, held, by_sensor, random=fields)

    @property
    def views(self) -> tuple[int, ...]:
        """The views, camera by camera."""
        return tuple(
            view
            for problem in self.camera_parameters.problems.values()
            for view in problem.stack.views
        )
