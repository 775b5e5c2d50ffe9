"""Predicted information of candidate stops, with the estimator's own Jacobians and priors.

A stop's corners are predicted, compressed as detected ones are, and combined with the robot's
noise; the result is the information that the joint fit would get from the stop.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.linalg import covariance_from, gram
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.appearance import Appearance, LensBoardParameters, compress
from visioncal.estimation.armpair import ArmPair
from visioncal.estimation.fit import Fit
from visioncal.planning.cell import AnyCell, PlanCell
from visioncal.planning.purposes import Purpose
from visioncal.robot import Robot
from visioncal.robot.arm_model import COMPLIANCE, GROUPS, ArmModel
from visioncal.robot.errors import ArmErrors, link_basis
from visioncal.robot.workspace import postures
from visioncal.vision.board_shape import SCALE, shape_basis, stated_board_sigma
from visioncal.vision.camera import intrinsics, project
from visioncal.vision.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.vision.targets import corner_positions, is_seen_in_part

# Number of cells over which a plan is averaged: the guess, and draws from its uncertainty.
WORLDS = 4
# A calibration does not use the guesses. This weak prior on the edges only keeps the information
# invertible [rad and m] in directions that the stops do not determine.
WEAK_SIGMA = 0.2


@dataclass(frozen=True, eq=False)
class RecordedStops:
    """Stops that were recorded already."""

    fit: Fit  # Their fit, without errors of the arm. Its first effect is lens and boards.
    # Edges of the fit: the camera's, the planned board's, then further boards'.
    edges: FloatArray
    free: LensBoardParameters  # Free parameters of lens and boards.
    q: FloatArray | None  # (s, n) joint angles of the stops [rad]; None where they are not known.
    first_corner: int = 0  # Number of the first corner of the planned board.
    # Posture-dependent errors of the arm at the stops; None where the stops show none.
    arm: ArmErrors | None = None
    # (a,) their values, in radians, where picks are by the controller's own poses; None for targets
    # that are corrected, or errors that are not estimated.
    arm_values: FloatArray | None = None
    # (12, c) root of the covariance of the edges' further errors, those of an arm without joint
    # angles. More stops do not reduce them.
    edge_error_root: FloatArray = field(default_factory=lambda: np.zeros((12, 0)))
    # (m, 6, 6) covariances of picks at these stops by such errors and by noise, at look and pick,
    # in the axes of what carries the camera; None where the arm has joint angles.
    arm_picks: FloatArray | None = None
    # (k, c) gradient at shared parameters that a fit holds. Further stops are expected to add
    # nothing but noise to it.
    held: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def stops(self) -> int:
        """Number of the stops."""
        return len(next(iter(self.fit.flanges.values())))

    @property
    def shared(self) -> FloatArray:
        """(k, k) information on what the views share, from corners and priors."""
        return prior_of_effects(self.fit)


@dataclass(frozen=True, eq=False)
class World:
    """Information of k candidates on p unknowns, for one possible cell.

    The unknowns are x, z, free parameters of lens and board, and errors of the arm, in this order.

    Attributes:
        factors: (k, m, p) whitened Jacobian F of each stop; F^T F is its information. The first six
            rows are of its pose; further ones, of a lens that is estimated, of its corners.
        prior: (p, p) prior information.
        recorded: (p, p) information of the recorded stops.
        objective: (p, p) weight W such that trace(W C) is the variance to be minimised with a
            covariance C: of a position, as a mean over where it matters [m^2].
        position: (p, p) the same for the position whose accuracy is reported [m^2].
        rotation: (p, p) the same for the rotation [rad^2].
        unestimated: (k, m, a) whitened Jacobian of each stop in parameters that a fit does not
            estimate: arm errors that it treats as noise, in their sigmas, and held parameters of
            lens and boards.
        gradient: (p, a) the same of the recorded stops' gradient.
    """

    factors: FloatArray
    prior: FloatArray
    recorded: FloatArray
    objective: FloatArray
    position: FloatArray
    rotation: FloatArray
    unestimated: FloatArray
    gradient: FloatArray

    def of_candidates(self, rows: IntArray) -> "World":
        """Returns the same world with the given candidates."""
        return replace(self, factors=self.factors[rows], unestimated=self.unestimated[rows])

    def covariance(self, rows: Sequence[int] | IntArray | Mask) -> FloatArray:
        """Covariance (p, p) of the unknowns from some candidates and the recorded stops."""
        size = len(self.prior)
        return self.joint_covariance(rows)[:size, :size]

    def joint_covariance(self, rows: Sequence[int] | IntArray | Mask) -> FloatArray:
        """Covariance (p + a, p + a) of the unknowns and of what a fit does not estimate."""
        taken = self.factors[rows]
        fitted = covariance_from(self.prior + self.recorded + gram(taken, taken))
        bias = fitted @ (self.gradient + gram(taken, self.unestimated[rows]))
        # The fit deviates by its bias times the errors, and the truth from it the other way.
        return np.block([[fitted + bias @ bias.T, -bias], [-bias.T, np.eye(bias.shape[1])]])

    def variances(self, covariance: FloatArray) -> tuple[float, float]:
        """Variances of the reported position [m^2] and rotation [rad^2] with a covariance."""
        place, turn = (np.sum(square * covariance) for square in (self.position, self.rotation))
        return float(place), float(turn)


def predict_worlds(
    cells: Sequence[PlanCell],
    purpose: Purpose,
    q: FloatArray,
    *,
    recorded: RecordedStops | None = None,
    estimates_lens: bool = False,
) -> tuple[World, ...]:
    """Predicts the information of candidates with joints (k, n) [rad] in each possible cell.

    Args:
        cells: The possible cells.
        purpose: The purpose of the stops.
        q: The candidates.
        recorded: Stops that were recorded already.
        estimates_lens: Whether the stops determine the lens, too.

    Raises:
        DataError: Joint angles of recorded stops are needed and not known.
    """
    with one_blas_thread():
        return tuple(
            _world(cell, purpose, q, recorded, estimates_lens=estimates_lens) for cell in cells
        )


def stop_factors(
    cell: PlanCell,
    purpose: Purpose,
    q: FloatArray,
    recorded: RecordedStops | None = None,
    *,
    estimates_lens: bool = False,
) -> FloatArray:
    """Whitened Jacobian F (k, m, p + a) of stops with joints (k, n) [rad]; F^T F is information.

    It is zero where the board is not seen. Errors of the arm that a fit treats as noise come last.
    Lens and board are those of the recorded stops; without any, the stated ones, with the stated
    uncertainty of the board's size. There are six rows, and those of a lens that is estimated.
    """
    free = parameters_of(cell, recorded, estimates_lens=estimates_lens)
    lens = is_of_lens(free) & ~free.anchored & estimates_lens
    poses = cell.cam_from_target(q)
    stack, seen = predicted_corners(cell, poses, 0 if recorded is None else recorded.first_corner)
    count = len(free.columns)
    shared = count if recorded is None else len(recorded.shared)
    columns = 12 + shared + arm_size(cell.robot, purpose, recorded)
    factors = np.zeros((len(q), 6 + int(lens.sum()), columns))
    if seen.any():
        compressed = compress(stack, free.basis, free.appearance, poses[seen])
        fit = Fit.of_stops(
            cell.mount,
            (cell.x, cell.z),
            cell.robot.base_from_flange(q[seen]),
            cell.noise,
            floored_sigma_px(cell.pixel_px) ** 2 * covariance_from(compressed.information),
            [free.effect(compressed.by_shared[:, :, free.columns])],
        )
        arm = None if recorded is None else recorded.arm
        if arm is not None:
            arm = replace(arm, basis=link_basis(cell.robot, q[seen]))
        fit = with_arm_errors(cell, purpose, fit, q[seen], arm)
        # The other shared parameters do not affect a stop at which the arm stands still.
        affecting = np.delete(np.arange(columns), slice(12 + count, 12 + shared))
        factors[np.ix_(seen, np.arange(6), affecting)] = fit.whitened
        if lens.any():
            found = _lens_rows(stack, free, poses[seen], free.columns[lens], cell.pixel_px)
            at = 12 + np.flatnonzero(lens)
            factors[np.ix_(np.flatnonzero(seen), np.arange(6, factors.shape[1]), at)] = found
    return factors


def _lens_rows(
    stack: CornerStack,
    free: LensBoardParameters,
    poses: FloatArray,
    columns: IntArray,
    pixel_px: float,
) -> FloatArray:
    """(v, l, l) whitened Jacobian by l intrinsics of what v views show of them with free poses."""
    camera = free.appearance.camera
    bent = replace(stack, points=stack.points + free.basis[stack.ids] @ free.appearance.board)
    seen, units = reproject(bent, camera, poses), _lens_sigmas(camera)[columns]
    by_lens = seen.by_intrinsics[:, :, columns] * units
    left = WithoutPoses.of(bent, seen.by_pose, by_lens, None).left
    values, vectors = np.linalg.eigh(bent.products_by_view(left, left))
    roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.mT
    return np.asarray(roots / (units * floored_sigma_px(pixel_px)))


def _lens_sigmas(camera: Camera) -> FloatArray:
    """(k,) weak prior sigmas of a camera's intrinsics."""
    # Of coefficients of distortion, and of the matrix, as a share of the focal length. A third
    # radial coefficient is known from ten stops to about 0.7.
    sigmas = np.full(len(intrinsics(camera)), 10.0)
    sigmas[:4] = 0.1 * camera.matrix[0]
    return sigmas


def parameters_of(
    cell: PlanCell, recorded: RecordedStops | None, *, estimates_lens: bool
) -> LensBoardParameters:
    """Free parameters of lens and boards: those of recorded stops, or of the stated cell."""
    return stated(cell, estimates_lens=estimates_lens) if recorded is None else recorded.free


def is_of_lens(free: LensBoardParameters) -> Mask:
    """(k,) mask of those free parameters of lens and boards that are the lens's."""
    return np.asarray(free.columns < len(intrinsics(free.appearance.camera)))


def stated(cell: PlanCell, *, estimates_lens: bool = False) -> LensBoardParameters:
    """Stated lens and board; the board's size is free within its stated uncertainty.

    A lens that is estimated is free, too.
    """
    positions = corner_positions(cell.target)
    shape = stated_board_sigma(cell.target)
    look = Appearance(cell.camera, np.zeros(len(shape)))
    # The positions of a rig's points are taken as exact.
    sized = np.array([] if cell.target.is_rig else [SCALE], dtype=np.int64)
    size = len(look.values) - len(shape)
    lens = np.arange(size if estimates_lens else 0)
    sigmas = np.concatenate([_lens_sigmas(cell.camera)[lens], shape[sized]])
    return LensBoardParameters(
        look,
        shape_basis(cell.target),
        positions,
        np.concatenate([lens, size + sized]),
        np.arange(len(sigmas)) >= len(lens),
        np.diag(sigmas**-2.0),
        np.zeros(len(sigmas)),
    )


def shown_fit(
    cell: PlanCell,
    q: FloatArray,
    recorded: RecordedStops | None,
    free: LensBoardParameters,
    by_boards: FloatArray | None = None,
) -> Fit:
    """Stops (k, n) [rad] at which things are seen whose size is not that of the board.

    `by_boards` is the (3, b) Jacobian of their places by the free shapes of boards [m]; the boards'
    are none where None.
    """
    poses, is_lens = cell.cam_from_target(q), is_of_lens(free)
    stack, seen = predicted_corners(cell, poses, 0 if recorded is None else recorded.first_corner)
    shown = np.zeros((len(q), 6, len(is_lens)))
    if is_lens.any() and seen.any():
        compressed = compress(stack, free.basis, free.appearance, poses[seen])
        shown[seen] = compressed.by_shared[:, :, free.columns] * is_lens
    if by_boards is not None:
        shown[:, 3:, ~is_lens] = -by_boards
    flange, edges = cell.robot.base_from_flange(q), (cell.x, cell.z)
    return Fit.of_stops(cell.mount, edges, flange, cell.noise, effects=[free.effect(shown)])


def located_jacobian(fit: Fit, middle: FloatArray) -> FloatArray:
    """Jacobian (k, 6, p) of things seen where stops see a point (3,) of the board [m].

    By the unknowns of `shown_fit`, in the frame that carries the camera.
    """
    return fit.located(next(iter(fit.frames)), np.tile(middle, (len(fit.seen), 1)))


def _world(
    cell: PlanCell,
    purpose: Purpose,
    q: FloatArray,
    recorded: RecordedStops | None,
    *,
    estimates_lens: bool,
) -> World:
    free = parameters_of(cell, recorded, estimates_lens=estimates_lens)
    shared = free.information if recorded is None else recorded.shared
    factors = stop_factors(cell, purpose, q, recorded, estimates_lens=estimates_lens)
    sigma, arm = arm_sigma(purpose), arm_size(cell.robot, purpose, recorded)
    if recorded is not None and not purpose.blocks and recorded.arm is not None:
        # Errors that a fit treats as noise are not unknowns.
        arm *= recorded.arm.is_estimated
    weak = np.full(12, max(WEAK_SIGMA, cell.sigma_rad, cell.sigma_m) ** -2.0)
    prior = block_diag(np.diag(weak), shared, sigma**-2.0 * np.eye(arm))
    size, all_columns = len(prior), factors.shape[2]
    recorded_information = np.zeros((all_columns, all_columns))
    if recorded is not None:
        recorded_information = _recorded_information(cell, purpose, recorded)
    middle = corner_positions(cell.target).mean(axis=0)
    if purpose.judged == "sight":
        # Half the camera's position, half the things that it observes, which are off by errors of
        # the offset, of the rotation times their distance, and of the lens.
        position, rotation, point = (np.zeros((len(q), 3, size)) for _ in range(3))
        position[:, :, 3:6] = rotation[:, :, :3] = np.eye(3)
        located = located_jacobian(shown_fit(cell, q, recorded, free), middle)
        point[:, :, : located.shape[2]] = located[:, 3:]
    else:
        # Zeros for lens and board follow the edges.
        at = np.full(len(shared), 12)
        position, rotation = (
            np.insert(part, at, 0.0, axis=2) for part in workspace_jacobian(cell, purpose, middle)
        )
        point = position
    place, turn, spot = (mean_square(part) for part in (position, rotation, point))
    misfit, gradient = factors[:, :, size:], recorded_information[:size, size:]
    if recorded is not None and not purpose.blocks:
        error_root, held = recorded.edge_error_root, recorded.held.shape[1]
        held_gradient = np.zeros((size, held))
        held_gradient[12 : 12 + len(recorded.held)] = -recorded.held
        edge_gradient = (prior + recorded_information[:size, :size])[:, :12] @ error_root
        gradient = np.hstack([gradient, edge_gradient, held_gradient])
        zeros = np.zeros((*factors.shape[:2], held))
        misfit = np.concatenate([misfit, factors[:, :, :12] @ error_root, zeros], axis=2)
    return World(
        factors[:, :, :size],
        prior,
        recorded_information[:size, :size],
        (place + spot) / 2,
        place,
        turn,
        misfit,
        gradient,
    )


def workspace_jacobian(
    cell: AnyCell, purpose: Purpose, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Jacobians of what the arm carries all over its workspace, by the edges and the arm's errors.

    Returns:
        (w, 3, 12 + a) of the position of a point `at` (3,) of the observed frame, relative to what
        is fixed in the base, and (w, 3, 12 + a) of its rotation.
    """
    q = postures(cell.robot)
    flange = cell.robot.base_from_flange(q)
    fit = Fit.of_stops(cell.mount, (cell.x, cell.z), flange[:1], cell.noise)
    pair = ArmPair.of(fit.problem, fit.state, fit.robots[0])
    basis = np.zeros((len(q), 6, 0))
    if purpose.blocks:
        basis = arm_model(cell.robot, purpose).basis(q)
    poses, jacobian = pair.jacobian(flange, basis)
    return pair.place_jacobian(poses, jacobian, at), jacobian[:, :3]


def _recorded_information(cell: PlanCell, purpose: Purpose, recorded: RecordedStops) -> FloatArray:
    """Information (p + a, p + a) of recorded stops and hand measurements, without priors."""
    q = recorded.q
    if q is None and purpose.blocks:
        raise DataError(
            f"stops for {purpose.name} cannot be added: the recorded views have no joint angles.",
            culprits=["q1_rad"],
            next_step="Record q1_rad ..., or plan without the recorded session.",
        )
    joints = np.zeros((recorded.stops, cell.robot.joint_count)) if q is None else q
    # Further boards keep their pose relative to the planned one.
    boards = cell.z @ invert(recorded.edges[1]) @ recorded.edges[1:]
    at = replace(recorded.fit.state, edges=np.concatenate([cell.x[None], boards]))
    fit = with_arm_errors(cell, purpose, recorded.fit.at(at), joints, recorded.arm)
    information, edges = fit.fisher.copy(), 6 * len(fit.frames)
    information[edges:, edges:] -= prior_of_effects(fit)
    # Schur complement: the poses of further boards are eliminated, of points their places alone.
    further = np.arange(12, edges)
    seen = further[np.diag(information)[further] > 0.0]
    cross = np.delete(information[seen], further, axis=1)
    eliminated = cross.T @ np.linalg.solve(information[np.ix_(seen, seen)], cross)
    return np.delete(np.delete(information, further, axis=0), further, axis=1) - eliminated


def prior_of_effects(fit: Fit) -> FloatArray:
    """Prior information (k, k) of a fit's unknowns but its edges."""
    priors = (effect.prior.information for effect in fit.problem.effects)
    return np.asarray(block_diag(np.zeros((0, 0)), *priors))


def with_arm_errors(
    cell: AnyCell, purpose: Purpose, fit: Fit, q: FloatArray, arm: ArmErrors | None = None
) -> Fit:
    """Adds errors of the arm at stops (s, n): the purpose's, or those that the stops show."""
    if purpose.blocks:
        model = arm_model(cell.robot, purpose)
        arm = ArmErrors(model.basis(q), model.error_rad, 0.0, of_links=True)
    elif arm is not None:
        arm = replace(arm, basis=arm.sigma * arm.basis, sigma=1.0)
    return fit if arm is None else fit.with_arm(fit.robots[0], arm)


def arm_model(robot: Robot, purpose: Purpose) -> ArmModel:
    """The nominal arm with the unknown errors of a purpose; raises DataError."""
    model = ArmModel(robot, np.eye(4), {}, np.zeros(0)).with_errors(purpose.blocks)
    if COMPLIANCE not in purpose.blocks:
        return model
    if robot.masses is None:
        raise DataError(
            f"stops for {purpose.name} cannot be planned: the model of {robot.name} does not state "
            "the masses of its links, and their weight is what bends it.",
            culprits=[robot.name],
            next_step="Add mass_kg and com_m to each [[joint]] of its table, or take its URDF.",
        )
    return model.loaded(postures(robot))


def arm_sigma(purpose: Purpose) -> float:
    """Unit of the arm's unknowns: the first block's prior sigma [rad]."""
    return next(iter(purpose.blocks.values()), 1.0)


def arm_size(robot: Robot, purpose: Purpose, recorded: RecordedStops | None = None) -> int:
    """Number of errors of the arm that `with_arm_errors` adds."""
    if purpose.blocks or recorded is None or recorded.arm is None:
        return sum(GROUPS[name].per_joint for name in purpose.blocks) * robot.joint_count
    return int(recorded.arm.basis.shape[2])


def predicted_corners(
    cell: PlanCell, poses: FloatArray, first_corner: int
) -> tuple[CornerStack, Mask]:
    """Predicted corners at (k, 4, 4) poses, and the mask of poses that show the board."""
    positions = corner_positions(cell.target)
    points = positions @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    px = project(cell.camera, points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    size = np.array(cell.camera.resolution)
    visible = np.all((px > -0.5) & (px < size - 0.5), axis=2)
    in_part = is_seen_in_part(cell.target)
    # A partly visible ChArUco board is detected by six corners.
    fewest = min(6, len(positions)) if in_part else len(positions)
    shows = visible.sum(axis=1) >= fewest
    view, corner = np.nonzero(visible[shows])
    counts = visible[shows].sum(axis=1)
    stack = CornerStack(
        tuple(np.flatnonzero(shows).tolist()),
        (0.0,) * len(counts),
        np.cumsum(counts) - counts,
        view,
        first_corner + corner,
        positions[corner],
        px[shows][view, corner],
    )
    return stack, shows


def mean_square(jacobian: FloatArray) -> FloatArray:
    """Mean over m of J^T J: (m, 3, p) to (p, p)."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    return np.asarray(rows.T @ rows / len(jacobian))
