"""The fit of a cell, as all that reports, judges, verifies and picks from it reads it.

Readers ask by the names of `unknowns`: which unknowns there are, what they are, how their errors
are correlated, and what a forward model of them errs by (`closure`). They do not know how the fit
was made: `problem`, `solution` and `corners` are of the engine, read by its own modules and by
tests of residuals alone. Another engine stands behind the same door if it gives

    unknowns, values, frames, camera      what there is, and its estimates
    robots, noise, sigmas_px, shown_px    noise of flanges, sensors and corners
    seen, measured, expected, closure     sightings, and their forward model
    fisher, whitened                      information, and that of each sighting
    by_noise, beside, shift               covariances by source; what held values would have moved
    absorbed, equations, with_columns     score tests of further unknowns
    bias, beside_lasting                  the response to what it takes for noise, or estimates last

Everything else here follows from these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.core.linalg import covariance_among
from visioncal.core.prediction import to_points
from visioncal.core.transforms import adjoint, apply_each, invert, robot_part
from visioncal.core.types import Camera, FloatArray, IntArray, Mount
from visioncal.estimation.appearance import Appearance, LensBoardParameters
from visioncal.estimation.arm import arm_effect
from visioncal.estimation.chain import chain
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.normal_equations import fisher_information, normal_equations
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Linear, Noise, Observations, State
from visioncal.estimation.solve import Solution, covariance_of
from visioncal.estimation.unknowns import BOARD, EDGE, LENS, LENS_ERRORS, SIZE, Unknown, Unknowns
from visioncal.robot.errors import ArmErrors
from visioncal.session.tree import Tree
from visioncal.vision.lens_field import LensLevels


@dataclass(frozen=True, eq=False)
class Closure:
    """Residuals of m sightings against the chain of frames, as a forward model.

    It is a right perturbation (rotation [rad], translation [m]); of a mere place, without rotation.
    """

    problem: Problem  # The sightings, of the engine.
    linear: Linear  # It linearised where the chain closes.
    poses: FloatArray  # (m, 4, 4) pose of what was seen in the frame in which the chain closes.

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """(m, 6, 6) covariances J C J' by a (p, p) covariance of the unknowns."""
        return self.linear.covariance(covariance)

    def noise(self, levels: Noise) -> FloatArray:
        """(m, 6, 6) covariances by the noise of the robots' flanges."""
        total = self.problem.total_covariance(self.linear, levels)
        return np.asarray(total - self.problem.covariance(levels))

    def by_flange(self, robot: str) -> FloatArray:
        """(m, 6, 6) Jacobian by errors of a robot's flange, on its right."""
        of, members = self.problem.units
        by_slots = self.linear.by_flanges.reshape(len(of), 6, -1, 6)
        robot_slots = members[of] == self.problem.robots.index(robot)
        return np.asarray(np.einsum("mw,mawb->mab", robot_slots, by_slots))


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimates of all unknowns, from the observations that agree, with their covariance."""

    problem: Problem  # The observations that agree, with everything that is unknown.
    solution: Solution  # The unknowns and noise levels.
    # All corners, linearised in poses, lenses and boards; None without images.
    corners: LinearisedCorners | None = None
    # (p, p) covariances from sources other than noise and priors, by source.
    by_source: Mapping[str, FloatArray] = field(default_factory=dict)

    @classmethod
    def of_stops(
        cls,
        mount: Mount,
        edges: Sequence[FloatArray] | FloatArray,
        base_from_flange: FloatArray,
        noise: Noise,
        covariance: FloatArray | None = None,
        effects: Sequence[Effect] = (),
        *,
        measured: FloatArray | None = None,
        targets: Sequence[str] = (),
        order: Sequence[str] = (),
    ) -> "Fit":
        """Stops of one robot and one camera, one view each, by known edges; nothing is fitted.

        Args:
            mount: Mounting of the camera.
            edges: The (4, 4) edges of the camera and of what it sees.
            base_from_flange: (s, 4, 4) the stops.
            noise: Noise of the flange.
            covariance: (s, 6, 6) of the poses that are measured there; None where unknown.
            effects: Effects common to many views.
            measured: (s, 4, 4) these poses; None for stops that are yet to be taken.
            targets: See `chain`.
            order: See `chain`.
        """
        if measured is None:
            measured = invert(robot_part(base_from_flange, mount) @ edges[0]) @ edges[1]
        problem = chain(
            *(mount, base_from_flange, measured, covariance),
            targets=targets,
            order=order,
            effects=effects,
        )
        return cls(problem, Solution(State(np.stack([*edges]), problem.start_values), noise))

    @property
    def state(self) -> State:
        """Estimated unknowns, as the engine orders them."""
        return self.solution.state

    @property
    def noise(self) -> Noise:
        """Noise levels: of the robots in the order of `problem.robots`, and of the sensors."""
        return self.solution.noise

    def at(self, state: State) -> "Fit":
        """The fit at other values of the unknowns."""
        return replace(self, solution=replace(self.solution, state=state))

    @property
    def linearised(self) -> LinearisedCorners:
        """The corners of a fit with images."""
        if self.corners is None:
            raise RuntimeError("a fit without images has no lens")
        return self.corners

    @cached_property
    def unknowns(self) -> Unknowns:
        """The unknowns with their p columns."""
        problem, parts, uncertain = self.problem, dict[Unknown, slice](), dict[Unknown, IntArray]()
        parts |= {Unknown(EDGE, frame): problem.edge_columns(frame) for frame in problem.unknown}
        if self.corners is not None:
            free, first = self.corners.free, self.lens_columns.start
            for key, values in self.corners.camera_parameters.parts.items():
                unknown = Unknown(*key)
                low, high = np.searchsorted(free, [values.start, values.stop]).tolist()
                parts[unknown] = slice(first + low, first + high)
                uncertain[unknown] = free[low:high] - values.start
            at = first + len(free)
            cameras = self.corners.camera_parameters.problems
            for camera, size in zip(cameras, self.corners.field_sizes, strict=True):
                parts[Unknown(LENS_ERRORS, camera)] = slice(at, at + size)
                at += size
        for name, columns in problem.effect_columns.items():
            if name != LENSES:
                parts[Unknown.of_effect(name)] = columns
        return Unknowns(parts, uncertain, problem.moving)

    @property
    def lens_and_boards(self) -> LensBoardParameters:
        """Lens and boards of the only camera, and their covariance."""
        cameras, prior = self.linearised.camera_parameters, self.linearised.known
        ((name, problem),) = cameras.problems.items()
        return LensBoardParameters(
            Appearance(cameras.camera(name), cameras.values[cameras.boards]),
            problem.basis,
            problem.positions,
            self.linearised.free,
            self.linearised.held,
            prior.information,
            prior.gradient,
        )

    @property
    def lens_columns(self) -> slice:
        """Columns of the uncertain values of lenses and boards together."""
        first = 6 * len(self.problem.unknown)
        return slice(first, first + (0 if self.corners is None else len(self.corners.free)))

    @cached_property
    def camera_parameters(self) -> CameraParameters:
        """Lenses and boards as fitted; exact values are the stated ones."""
        free = self.linearised.free
        return self.linearised.camera_parameters.with_values(free, self.state.values[: len(free)])

    @property
    def sigmas_px(self) -> dict[str, float]:
        """Noise of a corner's coordinate, by camera [px]; empty without images."""
        sigmas = () if self.corners is None else self.corners.sigmas_px
        return dict(zip(self.unknowns.of(LENS), sigmas, strict=True))

    def lens_levels(self, camera: str) -> LensLevels:
        """Sizes of a lens's errors beyond its model, in units of the noise of its corners."""
        return self.linearised.camera_parameters.problems[camera].levels or LensLevels()

    def shown_px(self, camera: str) -> float | None:
        """Scatter of a camera's corner coordinates [px]; None without images of it."""
        cameras = self.unknowns.of(LENS)
        if camera not in cameras:
            return None
        problem = self.linearised.camera_parameters.problems[camera]
        compressed = self.linearised.compressed[cameras.index(camera)]
        return problem.stack.shown_px(compressed.residuals, problem.unknowns(compressed))

    @property
    def tree(self) -> Tree:
        """The frames, of which one that moved is several."""
        return self.problem.tree

    @property
    def flanges(self) -> Mapping[str, FloatArray]:
        """(s, 4, 4) `base_from_flange` of each robot at the stops, without unknown errors of it."""
        return self.problem.poses

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the order of their noise levels."""
        return self.problem.robots

    @property
    def measured(self) -> FloatArray:
        """(n, 4, 4) `observer_from_observed` that the sightings measured, by lenses and boards."""
        return self.problem.measured(self.state)

    @property
    def seen(self) -> Observations:
        """The n sightings: who saw what at which stop."""
        return self.problem.observations

    @property
    def is_combined(self) -> bool:
        """Whether robot and camera have one noise together, that of each sighting."""
        return self.problem.is_combined

    @cached_property
    def expected(self) -> FloatArray:
        """(n, 6, 6) covariance of the sightings' residuals by all unknowns and all noise."""
        linear = self.problem.linear(self.state, ideal=True)
        by_noise = self.problem.total_covariance(linear, self.noise)
        return linear.covariance(self.whole) + by_noise

    def closure(self, rows: IntArray, frame: str = "", things: FloatArray | None = None) -> Closure:
        """The closure of the chains of (m,) some sightings, in the frames that they saw.

        Args:
            rows: The sightings.
            frame: A frame to close in instead: it is seen from there, through what they saw.
            things: (m, 3, b) Jacobian, by the columns of boards, of places of things that they see
                instead of boards, whose size is not that of their distance.
        """
        part = self.problem.subset(np.isin(np.arange(len(self.seen)), rows))
        poses, carry, seen = part.measured(self.state), np.eye(6), part.observations
        if frame:
            reverse = replace(seen, observers=(frame,) * len(seen), observed=seen.observers)
            every = np.ones(len(seen), dtype=bool)
            seen = replace(seen, observed=reverse.observers, has_rotation=every)
            poses = replace(part, observations=reverse).predicted(self.state) @ poses
            part = replace(part, observations=seen, points=frozenset(), with_repeats=False)
            carry = adjoint(poses)
        effects, at, boards = [], 6 * len(self.frames), self.unknowns.of_kinds(BOARD, SIZE)
        for effect in part.effects:
            of_boards = np.isin(np.arange(at, at := at + len(effect)), boards)
            by_sensor = effect.by_sensor
            if by_sensor is not None and (frame or things is not None):
                by_sensor = carry @ by_sensor * ~of_boards
                if things is not None and of_boards.any():
                    by_sensor[:, 3:, of_boards] = -things
            effects.append(replace(effect, by_sensor=by_sensor))
        closed = replace(part, effects=tuple(effects))
        return Closure(closed, closed.linear(self.state, ideal=True), poses)

    def located(self, camera: str, points_m: FloatArray) -> FloatArray:
        """Jacobian of things that a camera sees where its m sightings saw points (m, 3) [m].

        Returns:
            (m, 6, p) of rotation [rad] and place [m], in the frame that carries the camera.
        """
        rows = np.flatnonzero(np.array(self.seen.observers) == camera)
        jacobian = self.closure(rows, self.tree.branches[camera].parent).linear.jacobian
        places = apply_each(self.frames[camera] @ self.measured[rows], points_m)
        return np.asarray(to_points(places) @ jacobian)

    @property
    def frames(self) -> dict[str, FloatArray]:
        """Poses (4, 4) `parent_from_frame` of the unknown frames."""
        return self.problem.frames(self.state)

    def camera(self, name: str) -> Camera:
        """A camera with the fitted lens."""
        return self.camera_parameters.camera(name)

    def values(self, unknown: tuple[str, str]) -> FloatArray:
        """(k,) all values of an unknown but an edge, exact ones included; empty if there is none.

        Those of arms, times and what grows are the change from what the problem was built with.
        """
        if self.corners is not None:
            optics = self.camera_parameters
            if (part := optics.parts.get(unknown)) is not None:
                return optics.values[part]
        at, first = self.unknowns[unknown], 6 * len(self.problem.unknown)
        columns = slice(max(at.start - first, 0), max(at.stop - first, 0))
        return np.asarray((self.state.values - self.problem.start_values)[columns])

    @cached_property
    def equations(self) -> tuple[FloatArray, FloatArray]:
        """Information (p, p) on the unknowns, and half the gradient (p,) of the squared error."""
        return normal_equations(self.problem, self.state, self.noise)

    @cached_property
    def fisher(self) -> FloatArray:
        """(p, p) expected information on the unknowns, with priors."""
        return fisher_information(self.problem, self.state, self.noise)

    @property
    def slopes(self) -> FloatArray:
        """(n, 6, p) Jacobian of the sightings' residuals by the unknowns."""
        return self.problem.linear(self.state, ideal=True).jacobian

    @property
    def whitened(self) -> FloatArray:
        """(n, 6, p) the same in units of their noise, F; F^T F is the sightings' information."""
        linear = self.problem.linear(self.state, ideal=True)
        root = np.linalg.cholesky(self.problem.total_covariance(linear, self.noise))
        return np.asarray(np.linalg.solve(root, linear.jacobian))

    @cached_property
    def absorbed(self) -> FloatArray:
        """(p, p) covariance that the fit absorbed of the residuals'; zero for held unknowns."""
        return covariance_among(self.equations[0], self.problem.moving)

    def with_columns(self, *effects: Effect) -> "Fit":
        """The fit with more unknowns, linearised at the same point: for score tests."""
        values = [self.state.values, *(effect.values for effect in effects)]
        state = State(self.state.edges, np.concatenate(values))
        problem = self.problem.with_effects([*self.problem.effects, *effects])
        return replace(self.at(state), problem=problem, by_source={})

    def with_arm(self, robot: str, errors: ArmErrors, name: str = "arm") -> "Fit":
        """The fit with errors of an arm among the unknowns."""
        return self.with_columns(arm_effect(errors, robot, name))

    @cached_property
    def by_noise(self) -> FloatArray:
        """(p, p) covariance of the unknowns by noise and priors, held ones by their prior."""
        return covariance_of(self.problem, self.solution)

    @cached_property
    def whole(self) -> FloatArray:
        """(p, p) covariance of the unknowns from all sources."""
        return np.asarray(sum(self.by_source.values(), self.by_noise))

    @cached_property
    def held_gradient(self) -> FloatArray:
        """(p,) half the gradient of the squared error at held unknowns, beside the others' optimum.

        The step that is left to those that are estimated, by other noise than the state's, is taken
        first: a centre and the camera's turn are so alike that a tenth of a sigma would be ten.
        """
        held, gradient = self.problem.counted & ~self.problem.moving, self.equations[1]
        step = covariance_among(self.fisher, self.problem.moving) @ gradient
        return np.where(held, gradient - self.fisher @ step, 0.0)

    @cached_property
    def shift(self) -> FloatArray:
        """(p,) shift of the unknowns, to first order, if the held ones were estimated as well.

        Its square is the error of holding them, beside their uncertainty, which `by_noise` has.
        """
        if not (self.problem.counted & ~self.problem.moving).any():
            return np.zeros(self.problem.size)
        return np.asarray(-self.by_noise @ self.held_gradient)

    def beside_lasting(self, robot: str, errors: ArmErrors) -> "Fit":
        """The fit with an arm's errors that last in time among the unknowns, before a step.

        The noise is the rest beside these errors.
        """
        in_time, index = errors.basis[:, :, errors.is_time_correlated], self.robots.index(robot)
        noise = self.noise if errors.white is None else self.noise.with_robot(index, errors.white)
        time_errors = replace(errors, basis=in_time, time_correlated_count=in_time.shape[2])
        wide = self.with_arm(robot, time_errors, "lasting errors")
        return replace(wide, solution=replace(wide.solution, noise=noise))

    def step_to(self, wide: "Fit") -> FloatArray:
        """(p,) step of the unknowns to those of a fit with more unknowns or other noise."""
        information, gradient = wide.equations
        step = -covariance_among(information, wide.problem.moving) @ gradient
        return np.asarray(step[: self.problem.size])

    def bias(self, robot: str, errors: ArmErrors) -> FloatArray:
        """(p, q) Jacobian of the estimates by q errors of an arm that the fit takes for noise.

        It is none by errors that last in time, which are estimated.
        """
        size, last = self.problem.size, errors.is_time_correlated
        fit = self.beside_lasting(robot, errors) if last.any() else self
        return np.asarray(-fit.response(arm_effect(errors, robot, "arm"))[:size] * ~last)

    def response(self, effect: Effect) -> FloatArray:
        """(p, c) Jacobian of the estimates by c values of an effect that the fit has as zero."""
        information, first = self.with_columns(effect).equations[0], self.problem.size
        fitted = covariance_among(information[:first, :first], self.problem.moving)
        return np.asarray(-fitted @ information[:first, first:])

    def covariance(self, *unknowns: tuple[str, str]) -> FloatArray:
        """(c, c) covariance of some unknowns from all sources, in their order."""
        at = self.unknowns.columns(*unknowns)
        return self.whole[np.ix_(at, at)]

    def sigmas(self, unknown: tuple[str, str]) -> FloatArray:
        """(c,) standard deviations of an unknown's uncertain values, from all sources."""
        return np.asarray(np.sqrt(np.diag(self.whole)[self.unknowns[unknown]]))
