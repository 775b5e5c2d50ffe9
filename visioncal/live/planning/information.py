"""The predicted information of a stop, by the estimator's own derivatives and priors.

A stop's corners are predicted, compressed as seen ones are, and joined with the noise of the robot;
what comes out is the information that the joint fit would have of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.appearance import (
    SCALE,
    Appearance,
    LensBoardParameters,
    board_prior,
    compress,
    shape_basis,
)
from visioncal.estimation.arm import ArmErrors, link_basis
from visioncal.estimation.armmodel import COMPLIANCE, ArmModel, block_size
from visioncal.estimation.armpair import ArmPair
from visioncal.estimation.chain import chain
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.linalg import covariance_from, gram
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information
from visioncal.estimation.variance import Knowledge
from visioncal.estimation.workspace import postures
from visioncal.live.planning.cell import Box, PlanCell
from visioncal.live.planning.purposes import Purpose
from visioncal.robot import Robot
from visioncal.vision.camera import project
from visioncal.vision.targets import FOUND_IN_PART, corner_positions

# Worlds over which a plan is made: the guess, and some drawn from what is known of it.
WORLDS = 4
# A calibration takes nothing from the guesses: what is assumed of the edges beforehand only keeps
# the information invertible [rad and m], for directions that the stops leave open.
WEAK_SIGMA = 0.2
# What an edge's component is counted in where unknowns of different kinds are compared.
_EDGE_UNITS: FloatArray = np.tile(np.repeat([1e-3, 5e-4], 3), 2)
# Postures that are tried for a declared workspace, and how many of those in it stand for it.
_TRIED, _POSTURES = 8000, 400
# A ChArUco board that the image cuts is found with so many corners.
_FEWEST_CORNERS = 6


@dataclass(frozen=True, eq=False)
class RecordedStops:
    """Stops that were recorded already.

    Attributes:
        problem: The stops, without errors of the arm. Of its effects, what lens and boards leave
            open comes first.
        edges: Those of the problem: the camera's, that of the board that is planned for, and those
            of further boards.
        free: Lens and boards as the views see them.
        q: (s, n) joint angles of the stops [rad]; None where they are not known.
        noise: Of the robot at the stops.
        first_corner: The number of the first corner of the board that is planned for.
        arm: Errors that follow the arm's posture, at the stops; None where the stops show none.
        inflation: By how much larger their noise's variance counts than they show alone.
        beside: (12, c) by how much the edges are off beside that, for c independent errors of one:
            of an arm without joint angles, which more stops do not change.
        held: (k, c) gradient of what the views share and a fit holds: how the stops pull at it.
            Further stops are expected to pull no more than by noise.
    """

    problem: Problem
    edges: FloatArray
    free: LensBoardParameters
    q: FloatArray | None
    noise: Noise
    first_corner: int = 0
    arm: ArmErrors | None = None
    inflation: float = 1.0
    beside: FloatArray = field(default_factory=lambda: np.zeros((12, 0)))
    held: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def shared(self) -> FloatArray:
        """(k, k) information on what the views share, from corners and priors."""
        return _of_effects(self.problem)

    def edges_in(self, cell: PlanCell) -> FloatArray:
        """The edges where a cell is guessed to be; further boards go with the one planned for."""
        boards = cell.z @ invert(self.edges[1]) @ self.edges[1:]
        return np.concatenate([cell.x[None], boards])


@dataclass(frozen=True, eq=False)
class World:
    """The information of k candidates on p unknowns if a cell is as it is guessed to be.

    Unknown are x, z, uncertain values of lens and board, and the arm's errors, in this order.

    Attributes:
        factors: (k, 6, p) the squares of each stop's are its information.
        prior: (p, p) what is known beforehand.
        recorded: (p, p) information of the stops that are recorded.
        counted: (p, p) of which the trace with the covariance is the variance that counts: of a
            place, as a mean over where it matters [m^2].
        place: (p, p) the same for the place that the accuracy is stated of [m^2].
        turn: (p, p) the same for the rotation [rad^2].
        units: (p,) what one unit of each unknown is where different ones are compared.
        looks: How many of the unknowns are of lens and boards; they stand behind the edges.
        misfit: (k, 6, a) how residuals at each stop move, in sigmas of noise, with errors of the
            arm that a fit takes for noise, in sigmas of theirs, and with lens and boards that it
            holds.
        gradient: (p, a) how the recorded stops' gradient moves with them.
        held: How many of these are of lens and boards; they stand last.
    """

    factors: FloatArray
    prior: FloatArray
    recorded: FloatArray
    counted: FloatArray
    place: FloatArray
    turn: FloatArray
    units: FloatArray
    looks: int
    misfit: FloatArray
    gradient: FloatArray
    held: int

    def with_known_looks(self) -> "World":
        """Returns the world as it is where lens and board are known exactly."""
        kept = np.delete(np.arange(len(self.prior)), 12 + np.arange(self.looks))
        block = np.ix_(kept, kept)
        of_arm = slice(self.gradient.shape[1] - self.held)
        return World(
            self.factors[:, :, kept],
            self.prior[block],
            self.recorded[block],
            self.counted[block],
            self.place[block],
            self.turn[block],
            self.units[kept],
            0,
            self.misfit[:, :, of_arm],
            self.gradient[kept, of_arm],
            0,
        )

    def without_misfit(self) -> "World":
        """Returns the world as it is where a fit takes no errors of the arm for noise."""
        of_held = slice(self.gradient.shape[1] - self.held, None)
        return replace(self, misfit=self.misfit[:, :, of_held], gradient=self.gradient[:, of_held])

    def covariance(self, rows: Sequence[int] | IntArray | Mask) -> FloatArray:
        """Covariance (p, p) of the unknowns from some candidates and what is recorded."""
        taken = self.factors[rows]
        fitted = covariance_from(self.prior + self.recorded + gram(taken, taken))
        off = fitted @ (self.gradient + gram(taken, self.misfit[rows]))
        return np.asarray(fitted + off @ off.T)


def worlds_of(
    cells: Sequence[PlanCell],
    purpose: Purpose,
    q: FloatArray,
    *,
    recorded: RecordedStops | None = None,
    workspace: Box | None = None,
) -> tuple[World, ...]:
    """Predicts the information of candidates, in each of some cells.

    Args:
        cells: The cell as it is guessed to be, and as it may be.
        purpose: What the stops are for.
        q: (k, n) joint angles of the candidates [rad].
        recorded: What was recorded already.
        workspace: Where the arm's place counts: its postures that bring what it carries into this
            box; None for all of them.

    Raises:
        DataError: The workspace holds no posture, or joint angles of what was recorded are needed
            and not known.
    """
    with one_blas_thread():
        return tuple(_world(cell, purpose, q, recorded, workspace) for cell in cells)


def stop_factors(
    cell: PlanCell, purpose: Purpose, q: FloatArray, recorded: RecordedStops | None = None
) -> FloatArray:
    """Predicts the information of stops.

    Args:
        cell: The cell, taken as it is guessed to be.
        purpose: What is unknown.
        q: (k, n) joint angles [rad].
        recorded: Information on lens and board; None where they are as stated, the board's size
            being open by as much as is stated.

    Returns:
        (k, 6, p + a) whose squares are the information of each stop; zero where the board is not
        seen. Errors of the arm that a fit takes for noise come last.
    """
    free = stated(cell) if recorded is None else recorded.free
    poses = cell.cam_from_target(q)
    stack, seen = _predicted(cell, poses, 0 if recorded is None else recorded.first_corner)
    known = free.information if recorded is None else recorded.shared
    # Nothing else of what is shared moves a stop that stands still.
    elsewhere = np.zeros((int(seen.sum()), 6, len(known) - len(free.columns)))
    factors = np.zeros((len(q), 6, 12 + len(known) + _arm_size(cell.robot, purpose, recorded)))
    if seen.any():
        found = compress(stack, free.basis, free.appearance, poses[seen])
        flange = cell.robot.base_from_flange(q[seen])
        problem = chain(
            cell.mount,
            flange,
            poses[seen],
            floored_sigma_px(cell.pixel_px) ** 2 * covariance_from(found.information),
            effects=[_effect(known, [found.by_shared[:, :, free.columns], elsewhere])],
        )
        arm = None if recorded is None else recorded.arm
        if arm is not None:
            arm = replace(arm, basis=link_basis(cell.robot, q[seen]))
        problem = _erring(cell, purpose, problem, q[seen], arm)
        state = State(np.stack([cell.x, cell.z]), problem.start_values)
        linear = problem.linear(state, ideal=True)
        root = np.linalg.cholesky(problem.total_covariance(linear, cell.noise))
        factors[seen] = np.linalg.solve(root, linear.jacobian)
    return factors


def place_sigmas(
    cell: PlanCell, purpose: Purpose, covariance: FloatArray, workspace: Box | None = None
) -> tuple[FloatArray, FloatArray]:
    """Predicts how surely the arm's places are known all over its workspace.

    Args:
        cell: The cell, taken as it is guessed to be.
        purpose: What is unknown; one that judges the workspace.
        covariance: (p, p) covariance of the unknowns, as `World.covariance` has it.
        workspace: The part of it that counts; None for all.

    Returns:
        (w, 3) places of what the arm carries, in the base [m], and their (w,) standard deviations
        as a whole, roots of the covariances' traces [m].
    """
    at = _inside(cell, workspace)
    jacobian = _workspace_jacobian(cell, purpose, at)
    arm = jacobian.shape[2] - 12
    rows = np.concatenate([np.arange(12), np.arange(len(covariance) - arm, len(covariance))])
    inner = covariance[np.ix_(rows, rows)]
    carried = cell.robot.base_from_flange(at) @ (cell.x if cell.mount == "eye-in-hand" else cell.z)
    return carried[:, :3, 3], np.sqrt(np.einsum("wij,jk,wik->w", jacobian, inner, jacobian))


def stated(cell: PlanCell) -> LensBoardParameters:
    """Lens and board as they are stated, the board's size being open by as much as is stated."""
    positions = corner_positions(cell.target)
    shape = board_prior(cell.target)
    look = Appearance(cell.camera, np.zeros(len(shape)))
    # The places of a rig's points are taken for what its table says.
    sized = np.array([] if cell.target.kind == "points" else [SCALE], dtype=np.int64)
    return LensBoardParameters(
        look,
        shape_basis(cell.target),
        positions,
        len(look.values) - len(shape) + sized,
        np.ones(len(sized), dtype=bool),
        np.diag(shape[sized] ** -2.0),
        np.zeros(len(sized)),
    )


def _world(
    cell: PlanCell,
    purpose: Purpose,
    q: FloatArray,
    recorded: RecordedStops | None,
    workspace: Box | None,
) -> World:
    shared = stated(cell).information if recorded is None else recorded.shared
    factors = stop_factors(cell, purpose, q, recorded)
    looks, sigma, arm = len(shared), _sigma(purpose), _arm_size(cell.robot, purpose, recorded)
    inflation = 1.0
    if recorded is not None and not purpose.blocks:
        inflation = recorded.inflation
        if recorded.arm is not None:
            # Those that a fit takes for noise are no unknowns.
            arm *= recorded.arm.is_estimated
    weak = np.full(12, max(WEAK_SIGMA, cell.sigma_rad, cell.sigma_m) ** -2.0)
    prior = block_diag(np.diag(weak), shared, sigma**-2.0 * np.eye(arm)) / inflation
    size, every = len(prior), factors.shape[2]
    known = np.zeros((every, every))
    if recorded is not None:
        known = _recorded_information(cell, purpose, recorded)
    scale = np.ones(every)
    scale[:size] = inflation**-0.5
    factors, known = scale * factors, np.outer(scale, scale) * known
    of_looks = np.sqrt(np.diag(covariance_from(shared))) if looks else np.zeros(0)
    units = np.concatenate([_EDGE_UNITS, of_looks, np.full(arm, sigma)])
    if purpose.judged == "sight":
        judged = _of_sight(cell, arm, q)
    else:
        judged = _of_workspace(cell, purpose, workspace)
    counted, place, turn = (_widened(array, looks) for array in judged)
    misfit, gradient, held = factors[:, :, size:], known[:size, size:], 0
    if recorded is not None and not purpose.blocks:
        beside, held = recorded.beside, recorded.held.shape[1]
        pull = np.zeros((size, held))
        pull[12 : 12 + len(recorded.held)] = -recorded.held / inflation
        further = (prior + known[:size, :size])[:, :12] @ beside
        gradient = np.hstack([gradient, further, pull])
        still = np.zeros((*factors.shape[:2], held))
        misfit = np.concatenate([misfit, factors[:, :, :12] @ beside, still], axis=2)
    return World(
        factors[:, :, :size],
        prior,
        known[:size, :size],
        counted,
        place,
        turn,
        units,
        looks,
        misfit,
        gradient,
        held,
    )


def _recorded_information(cell: PlanCell, purpose: Purpose, recorded: RecordedStops) -> FloatArray:
    """(p + a, p + a) of the stops and of what was measured by hand, known effects aside."""
    q = recorded.q
    if q is None and purpose.blocks:
        raise DataError(
            f"stops for {purpose.name} cannot be added: the recorded views have no joint angles.",
            culprits=["q1_rad"],
            next_step="Record q1_rad ..., or plan without the recorded session.",
        )
    stops = len(next(iter(recorded.problem.poses.values())))
    at = np.zeros((stops, cell.robot.joint_count)) if q is None else q
    problem = _erring(cell, purpose, recorded.problem, at, recorded.arm)
    state = State(recorded.edges_in(cell), problem.start_values)
    found = fisher_information(problem, state, recorded.noise)
    edges = 6 * len(problem.unknown)
    found[edges:, edges:] -= _of_effects(problem)
    # Further boards lie anywhere: what is left once they are eliminated is known of all else.
    further = slice(12, edges)
    cross = np.delete(found[further], further, axis=1)
    taken = cross.T @ np.linalg.solve(found[further, further], cross)
    return np.delete(np.delete(found, further, axis=0), further, axis=1) - taken


def _erring(
    cell: PlanCell, purpose: Purpose, problem: Problem, q: FloatArray, arm: ArmErrors | None
) -> Problem:
    """The problem with errors of the arm: those that a purpose is about, or that stops show."""
    if purpose.blocks:
        basis = _model(cell.robot, purpose).basis(q)
        arm = ArmErrors(basis, _sigma(purpose), 0.0, of_links=True)
    elif arm is not None:
        arm = replace(arm, basis=arm.sigma * arm.basis, sigma=1.0)
    if arm is None:
        return problem
    return problem.with_effects([*problem.effects, arm.effect(problem.robots[0])])


def _of_effects(problem: Problem) -> FloatArray:
    """(k, k) what is known of a problem's effects beforehand."""
    known = (effect.known.information for effect in problem.effects)
    return np.asarray(block_diag(np.zeros((0, 0)), *known))


def _effect(known: FloatArray, moved: list[FloatArray]) -> Effect:
    beforehand = Knowledge(known, np.zeros(len(known)))
    return Effect.free("lens and boards", beforehand, np.concatenate(moved, axis=2))


def _model(robot: Robot, purpose: Purpose) -> ArmModel:
    sigma = _sigma(purpose)
    weights = {name: block / sigma for name, block in purpose.blocks.items()}
    model = ArmModel(robot, np.eye(4), weights, np.zeros(_arm_size(robot, purpose)))
    if COMPLIANCE not in weights:
        return model
    if robot.masses is None:
        raise DataError(
            f"stops for {purpose.name} cannot be planned: the model of {robot.name} does not state "
            "the masses of its links, and their weight is what bends it.",
            culprits=[robot.name],
            next_step="Add mass_kg and com_m to each [[joint]] of its table, or take its URDF.",
        )
    return model.loaded(postures(robot))


def _sigma(purpose: Purpose) -> float:
    """What the arm's unknowns are counted in: the first block's size [rad]."""
    return next(iter(purpose.blocks.values()), 1.0)


def _arm_size(robot: Robot, purpose: Purpose, recorded: RecordedStops | None = None) -> int:
    """How many errors of the arm `_erring` adds."""
    if purpose.blocks or recorded is None or recorded.arm is None:
        return sum(block_size(name, robot.joint_count) for name in purpose.blocks)
    return int(recorded.arm.basis.shape[2])


def _predicted(cell: PlanCell, poses: FloatArray, first_corner: int) -> tuple[CornerStack, Mask]:
    """The corners at (k, 4, 4) poses as they would be found, and which of these show the board."""
    positions = corner_positions(cell.target)
    points = positions @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    px = project(cell.camera, points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    size = np.array(cell.camera.resolution)
    visible = np.all((px > -0.5) & (px < size - 0.5), axis=2)
    in_part = cell.target.kind in FOUND_IN_PART or cell.target.point_tags
    fewest = min(_FEWEST_CORNERS, len(positions)) if in_part else len(positions)
    seen = visible.sum(axis=1) >= fewest
    view, corner = np.nonzero(visible[seen])
    counts = visible[seen].sum(axis=1)
    stack = CornerStack(
        tuple(np.flatnonzero(seen).tolist()),
        (0.0,) * len(counts),
        np.cumsum(counts) - counts,
        view,
        first_corner + corner,
        positions[corner],
        px[seen][view, corner],
    )
    return stack, seen


def _of_sight(cell: PlanCell, arm: int, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What counts of x: the camera's own place, and as much the places that it looks at."""
    # A point that it sees comes out wrong by the offset's error and by the rotation's at the
    # point's distance, wherever the arm stands.
    middle = corner_positions(cell.target).mean(axis=0)
    looked_at = cell.cam_from_target(q) @ [*middle, 1.0]
    place, turn, there = (np.zeros((len(q), 3, 12 + arm)) for _ in range(3))
    place[:, :, 3:6] = there[:, :, 3:6] = turn[:, :, :3] = np.eye(3)
    there[:, :, :3] = -skew(looked_at[:, :3])
    return (_mean_square(place) + _mean_square(there)) / 2, _mean_square(place), _mean_square(turn)


def _of_workspace(
    cell: PlanCell, purpose: Purpose, workspace: Box | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What counts of what the arm carries: its place seen from what stands still."""
    at = _inside(cell, workspace)
    place = _mean_square(_workspace_jacobian(cell, purpose, at))
    turn = _mean_square(_arm_jacobian(cell, purpose, at)[2][:, :3])
    return place, place, turn


def _workspace_jacobian(cell: PlanCell, purpose: Purpose, at: FloatArray) -> FloatArray:
    """(w, 3, 12 + a) how the places of what the arm carries move with edges and arm."""
    pair, poses, jacobian = _arm_jacobian(cell, purpose, at)
    return pair.place_jacobian(poses, jacobian, corner_positions(cell.target).mean(axis=0))


def _arm_jacobian(
    cell: PlanCell, purpose: Purpose, at: FloatArray
) -> tuple[ArmPair, FloatArray, FloatArray]:
    """The camera and the board, and their (w, 4, 4) poses with slopes (w, 6, 12 + a)."""
    model, flange = _model(cell.robot, purpose), cell.robot.base_from_flange(at)
    problem = chain(cell.mount, flange[:1], cell.cam_from_target(at[:1]))
    pair = ArmPair.of(problem, State(np.stack([cell.x, cell.z]), np.zeros(0)), problem.robots[0])
    return pair, *pair.jacobian(flange, model.basis(at))


def _inside(cell: PlanCell, workspace: Box | None) -> FloatArray:
    """(w, n) postures that stand for the workspace."""
    if workspace is None:
        return postures(cell.robot)
    at = postures(cell.robot, _TRIED)
    carried = cell.robot.base_from_flange(at) @ (cell.x if cell.mount == "eye-in-hand" else cell.z)
    there = (invert(workspace.base_from_box) @ carried)[:, :3, 3]
    within = np.all(np.abs(there) <= np.asarray(workspace.size_m) / 2, axis=1)
    if not within.any():
        raise DataError(
            f"workspace {workspace.name}: none of {len(at)} postures all over the {cell.robot.name}"
            "'s reach brings what it carries into the box.",
            culprits=[f"workspace {workspace.name}"],
            next_step="Give its centre in the base frame and its full lengths [m].",
        )
    return at[within][:_POSTURES]


def _mean_square(jacobian: FloatArray) -> FloatArray:
    """Mean over m of slopes^T slopes: (m, 3, p) to (p, p)."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    return np.asarray(rows.T @ rows / len(jacobian))


def _widened(square: FloatArray, looks: int) -> FloatArray:
    """Puts columns of zeros for lens and board behind those of the edges."""
    size = len(square) + looks
    wide = np.zeros((size, size))
    rows = np.concatenate([np.arange(12), np.arange(12 + looks, size)])
    wide[np.ix_(rows, rows)] = square
    return wide
