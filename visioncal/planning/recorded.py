"""Start of a plan that adds stops to a session: what the session determines already."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.conventions import controller_form
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.linalg import covariance_among
from visioncal.core.number_format import counted
from visioncal.core.prediction import through
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Mount, Progress
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem_parts import Noise
from visioncal.planning.cell import Box, Limits, PlanCell
from visioncal.planning.information import RecordedStops
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.files import robot_names
from visioncal.session import Session
from visioncal.vision.targets import extent_m, first_corners

# Lower bound of a robot's noise; few stops may show less by chance [rad and m].
_LEAST_NOISE = Noise.of_robot(2e-5, 1e-5)


@dataclass(frozen=True, eq=False)
class SessionStart:
    """A session to which stops are added."""

    cell: PlanCell  # The cell as far as the session determines it.
    recorded: RecordedStops  # The session's information.
    refusal: str  # Why the session alone gives no result; empty where it does.
    views: tuple[int, ...]  # Number of the first view of each stop.


def calibrate_partially(session: Session, *, progress: Progress) -> tuple[RunState, str]:
    """Calibrates the hand-eye level of a session as far as it goes; raises DataError.

    Returns:
        The run, and why it ended early; empty where it did not.
    """
    if not session.robot_documents:
        raise _missing_model_error(session)
    run = RunState(session, progress, level="hand-eye")
    for index, stage in enumerate(STAGES):
        progress(stage.name, index, len(STAGES))
        try:
            run = stage.run(run)
        except DegenerateError as error:
            return run, error.message
    return run, ""


def start_from_session(
    run: RunState, refusal: str = "", *, limits: Limits | None = None, boxes: tuple[Box, ...] = ()
) -> SessionStart:
    """Prepares a session as the start of a plan.

    In directions that the stops leave undetermined, the edges are those with the mounted camera or
    board nearest to the flange.

    Args:
        run: The session, calibrated as far as it goes.
        refusal: Why that ended early; empty where it did not.
        limits: Limits of the added stops.
        boxes: Obstacles in the cell.

    Raises:
        DataError: The session lacks a robot's model, a camera or a board, or has too few
            usable views for a fit.
    """
    robot, targets = run.robot, tuple(run.session.boards.values())
    if robot is None or not targets or run.pixel_px is None or not run.scenes:
        raise _missing_input_error(run)
    if run.cell_fit_or_none is None:
        raise _too_vague_error(run)
    fit = _of_stops(run)
    with one_blas_thread():
        edges, covariance = _posterior_edges(fit, run.session.mount)
    sigmas = np.sqrt(np.diag(covariance).reshape(2, 2, 3).mean(axis=(0, 2)))
    # Too uncertain to plan stops [rad, m].
    if sigmas[0] > 0.5 or sigmas[1] > 0.5:
        raise _too_vague_error(run)
    # Up to the frame of the reported poses, calibrated where possible.
    first = np.unique(fit.seen.stops, return_index=True)[1]
    arm = run.robot_arm.at(np.unique(run.cell_fit.fit.seen.stops))
    if arm.model is not None:
        robot = arm.model.robot
    elif arm.joints_rad is not None:
        robot = ArmModel.of(robot, arm.joints_rad, arm.poses).robot
    _, board, *_ = fit.frames
    planned = [*run.session.board_frames.values()].index(board)
    free = fit.lens_and_boards
    cell = PlanCell(
        run.session.mount,
        robot,
        free.appearance.camera,
        targets[planned],
        edges[0],
        edges[1],
        float(sigmas[0]),
        float(sigmas[1]),
        fit.noise,
        run.pixel_px,
        limits or Limits(),
        boxes,
        covariance,
    )
    # Least and greatest distance at which stops show the planned board.
    of_board = fit.seen.stops[np.array(fit.seen.observed) == board]
    flange = next(iter(fit.flanges.values()))[of_board]
    low, high = extent_m(cell.target)
    poses, centre = cell.seen_from(flange), np.append(0.5 * (low + high), 0.0)
    distance = np.linalg.norm(poses[:, :3, :3] @ centre + poses[:, :3, 3], axis=1)
    cell = replace(cell, observed_distances_m=(float(distance.min()), float(distance.max())))
    first_corner = int(first_corners(targets)[planned])
    # With few stops, error sizes that noise alone explains are mostly chance.
    is_likely = arm.is_modelled and arm.errors is not None and arm.errors.is_likely
    errors = arm.errors if is_likely else None
    is_missed = errors is not None and errors.is_estimated and not run.session.corrects_targets
    values = run.cell_fit.fit.values(("arm", arm.robot)) if is_missed else None
    recorded = RecordedStops(fit, edges, free, arm.joints_rad, first_corner, errors, values)
    if run.assessment_or_none is not None:
        recorded = _with_errors(recorded, run)
    return SessionStart(cell, recorded, refusal, tuple(run.used[at] for at in first.tolist()))


def _with_errors(recorded: RecordedStops, run: RunState) -> RecordedStops:
    """Recorded stops with what a fit holds, and with errors of an arm without joint angles."""
    fit = run.assessment.fit
    columns = [fit.problem.effect_columns[effect.name] for effect in recorded.fit.problem.effects]
    held = np.concatenate([np.zeros(0), *(fit.held_gradient[part] for part in columns)])
    recorded = replace(recorded, held=held[:, None])
    by_arm = fit.by_source.get("arm")
    if run.robot_arm.is_modelled or by_arm is None:
        return recorded
    index = np.r_[*(fit.problem.edge_columns(frame) for frame in [*recorded.fit.frames][:2])]
    values, vectors = np.linalg.eigh(by_arm[np.ix_(index, index)])
    root = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 0.0]
    recorded = replace(recorded, edge_error_root=root)
    if run.findings is None or not run.findings.picks:
        return recorded
    first = run.findings.picks[0]
    # By the arm and its noise alone, not by the calibration and its boards.
    picks = first.covariances - first.without("arm", "look", "pick").covariances
    if run.session.mount == "eye-in-hand":
        turn = np.zeros_like(picks)
        flanges = next(iter(fit.flanges.values()))[fit.seen.stops, :3, :3]
        turn[:, :3, :3] = turn[:, 3:, 3:] = flanges.mT
        picks = through(turn, picks)
    return replace(recorded, arm_picks=picks)


def _of_stops(run: RunState) -> Fit:
    """The fit of the stops without errors of the arm, even if it leaves a direction undetermined.

    The planned board, which is in the most views, comes first.
    """
    fit, arm = run.cell_fit.fit, run.robot_arm
    if fit.corners is None:
        raise _missing_input_error(run)
    part = fit.problem
    observed = part.observations.observed
    planned = max(dict.fromkeys(observed), key=observed.count)
    stops, of = np.unique(part.observations.stops, return_inverse=True)
    # Errors of the arm are added again with the purpose's priors.
    bare = part.with_effects(
        [effect for effect in part.effects if effect.name != f"arm of {arm.robot}"]
    )
    kept_stops = np.isin(np.arange(len(arm.has_pose)), stops)
    camera, *boards = part.unknown
    order = [branch for branch in part.tree.branches if branch not in part.unknown]
    order += [camera, planned, *(board for board in boards if board != planned)]
    problem = replace(
        bare,
        tree=replace(part.tree, branches={name: part.tree.branches[name] for name in order}),
        poses={name: pose[stops] for name, pose in part.poses.items()},
        observations=replace(part.observations, stops=of),
        effects=tuple(effect.of_stops(kept_stops) for effect in bare.effects),
    )
    noise = replace(fit.noise, robots=np.maximum(fit.noise.robots, _LEAST_NOISE.robots))
    solution = replace(fit.solution, state=problem.start(fit.frames), noise=noise)
    return Fit(problem, solution, fit.corners)


def _posterior_edges(fit: Fit, mount: Mount) -> tuple[FloatArray, FloatArray]:
    """Posterior edges with the prior, and the covariance (12, 12) of camera and planned board."""
    prior, problem = np.full((2, 2, 3), 1e-6), fit.problem
    # The mounted camera or board is within some 0.1 m of the flange.
    prior[0 if mount == "eye-in-hand" else 1, 1] = 0.1**-2.0
    weights = np.zeros((problem.size, problem.size))
    weights[:12, :12] = np.diag(prior.ravel())
    # The problem is nearly linear.
    for _ in range(20):
        information, gradient = fit.equations
        # Twists from the prior to the edges.
        distance, edges = np.zeros(problem.size), fit.state.edges
        distance[3:6], distance[9:12] = (edge[:3, :3].T @ edge[:3, 3] for edge in edges[:2])
        step = -covariance_among(information + weights, problem.moving) @ (
            gradient + weights @ distance
        )
        # Shared parameters have converged before; they are marginalised, but not moved.
        step[6 * len(edges) :] = 0.0
        fit = fit.at(fit.state.moved(step))
    return fit.state.edges, covariance_among(fit.fisher + weights, problem.counted)[:12, :12]


def _missing_input_error(run: RunState) -> DataError:
    session, missing = run.session, []
    if run.robot is None:
        return _missing_model_error(session)
    if not session.boards:
        missing.append("a board (target)")
    if run.pixel_px is None or not run.scenes:
        missing.append("images of the board")
    return DataError(
        f"session {session.name!r}: stops cannot be added to it without {' and '.join(missing)}.",
        culprits=[f"session {session.name!r}"],
    )


def _missing_model_error(session: Session) -> DataError:
    forms = {table.form for table in session.robots.values()}
    maker_robots = [
        name for name in robot_names() if (form := controller_form(name)) and form.name in forms
    ]
    return DataError(
        f"session {session.name!r}: stops cannot be added to it without a model of its robot, "
        "which says where the arm reaches.",
        culprits=[f"session {session.name!r}"],
        next_step="Name the arm in session.toml ([robot] model), or by --robot; that of a whole "
        "cell in its own table, as model in [robots.a]. Built in are "
        f"{', '.join(maker_robots or robot_names())}; any other by its .urdf, or a DH "
        "table (.toml).",
    )


def _too_vague_error(run: RunState) -> DataError:
    posed = [view for view in run.poses if view in run.base_from_flange]
    return DataError(
        f"session {run.session.name!r}: its {counted(len(posed), 'usable stop')} of "
        "the robot do not show where camera and board are, not even roughly.",
        culprits=[f"session {run.session.name!r}"],
        next_step="Plan without it, from rough guesses of both, in mm and degrees: visioncal plan "
        "ROBOT --cam 'X Y Z RX RY RZ' --board 'X Y Z RX RY RZ'.",
    )
