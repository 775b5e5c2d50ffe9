"""The main path in order: one entry a stage.

A stage is one file in `visioncal.stages`. Its adapter here hands it what it needs of what is known
and adds what it gives.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.errors import DataError, DegenerateError
from visioncal.estimation.chain import robot_part
from visioncal.estimation.intervals import freedom_of
from visioncal.estimation.observability import FEWEST_VIEWS, directions, refuse_too_few
from visioncal.estimation.parts import ROBOT, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fit_problem
from visioncal.pipeline.known import Known, rms_of
from visioncal.pipeline.layout import middles, middles_of, without_lost_boards
from visioncal.pipeline.unseen import left_out
from visioncal.pipeline.unused import not_used
from visioncal.pipeline.views import holdout_rms, used_rms, view_results
from visioncal.session import STREAMS
from visioncal.session.single import check_one_of_each
from visioncal.stages import thermal
from visioncal.stages.agree import agree
from visioncal.stages.arms import check_arms
from visioncal.stages.cameras import detect_targets, estimate_lenses, locate_targets
from visioncal.stages.choose import choose_by
from visioncal.stages.clocks import set_clocks, waits_for_clock
from visioncal.stages.diagnose import Diagnosis, diagnose, sources
from visioncal.stages.handeye import solve_hand_eye
from visioncal.stages.judge import Arm as ArmFindings
from visioncal.stages.judge import Findings, Pair, Place, Sensor, judge
from visioncal.stages.kinematics import check_asked, doubts, findings
from visioncal.stages.loads import check_stops
from visioncal.stages.need import Fitted, picks_of
from visioncal.stages.observed import all_held_back, nothing_seen
from visioncal.stages.place import place
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.priors import most_contradicted, prior_words
from visioncal.stages.readings import mounted, read_instrument
from visioncal.stages.refine import held, look, refine
from visioncal.stages.robots import check_joints, read_robots
from visioncal.stages.side import FramesSide
from visioncal.stages.validate import HeldOut
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray, Rejection

# Views move in and out of the fit at most so often; they settle after one or two, as does the
# linearisation of the arm's errors, to a step far below any arm's repeatability. A rotation that is
# supplied to readings of points needs less: it counts by its square.
_ROUNDS = 4
_ARM_AT_REST_RAD, _TURN_AT_REST_RAD = 1e-7, 1e-5


@dataclass(frozen=True)
class Stage:
    """One step of the way, by the name that progress shows."""

    name: str
    run: Callable[[Known], Known]


def _read_robot(known: Known) -> Known:
    check_one_of_each(known.session)
    session = known.session
    if not session.views:
        what = "streams and no views" if session.streams else "no views"
        raise DataError(
            " ".join([f"session {session.name!r} has {what}.", *session.warnings]),
            culprits=[f"{STREAMS}/{it}.csv" for it in session.streams] or [session.name],
            next_step="Calibration needs views.csv; streams of torques alone are for visioncal "
            "dynamics identify.",
        )
    known = known.noting((), (*session.warnings, *not_used(known)))
    if len(known.held_back) == len(session.views):
        raise all_held_back(known)
    # Views that have a time alone get their poses once the camera's are known.
    return known if waits_for_clock(session) else _reported(known)


def _reported(known: Known) -> Known:
    """Takes up what is reported of the robot."""
    known = read_robots(known)
    matched = known.reported.matched
    if matched is not None and matched.misread:
        check_asked(known.level, can=False, misread=matched.misread)
    if not known.base_from_flange:
        raise DataError(
            f"session {known.session.name!r}: no view has a pose of the robot.",
            culprits=known.lost_views,
            next_step=" ".join(known.session.warnings)
            or "Fill in x_m to qw, or joint angles and [robot] model.",
        )
    views, declared = (
        tuple(known.base_from_flange),
        {it.number: it.stop for it in known.session.views},
    )
    check_stops(known.loads(views), views, [declared[it] for it in views])
    check_arms({ROBOT: known.robot_arm}, known.level)
    return known


def _clock(known: Known) -> Known:
    """Gives views that have a time alone the robot's poses out of its stream."""
    return _reported(set_clocks(known)) if waits_for_clock(known.session) else known


def _readings(known: Known) -> Known:
    """Takes up an instrument's readings, where these are what was observed."""
    if known.session.mount != "instrument":
        return known
    readings = read_instrument(known.session)
    known = known.noting(readings.rejections)
    if not readings.are_poses:
        if known.solver != "joint":
            raise DataError(
                f"solver {known.solver!r} needs poses, and the instrument reads places alone.",
                next_step="Leave --solver out.",
            )
        views = [
            view
            for view in readings.read_m
            if view in known.base_from_flange and view not in known.held_back
        ]
        if not views:
            raise nothing_seen(known)
        readings = mounted(readings, views, known.base_from_flange, known.stops_of(views))
    return known.with_readings(readings)


def _joints(known: Known) -> Known:
    """Refuses joints that only fit what the camera sees where they are read otherwise."""
    drops = known.level != "hand-eye"
    return check_joints(known, drops=drops, takes=drops and known.solver == "joint")


def _choose(known: Known) -> Known:
    views = [
        view.number
        for view in known.session.views
        if view.number in known.poses
        and view.number in known.base_from_flange
        and view.number not in known.held_back
    ]
    known = _placed(known, views)
    names = tuple(known.session.boards) if known.session.targets else ()
    unseen = [name for at, name in enumerate(names) if at not in known.boards]
    return known.noting(
        (), [f"No usable view shows target {name}: it has no place." for name in unseen]
    )


def _placed(known: Known, views: Sequence[int]) -> Known:
    """Leaves one pose to each of some views, and finds where boards are, if there are several."""
    shown = [known.poses[view].board for view in views]
    counts = sorted((-shown.count(it), it) for it in set(shown)) or [(0, 0)]
    known, names = replace(known, boards=tuple(it for _, it in counts)), [*known.session.boards]
    several = len(counts) > 1
    if several and -counts[0][0] < FEWEST_VIEWS:
        told = ", ".join(f"{names[it]} in {-count}" for count, it in counts)
        raise DegenerateError(
            f"hand-eye: of several targets, at least one must be seen in {FEWEST_VIEWS} views, to "
            f"begin with; here {told}.",
            culprits=[f"target {names[it]}" for _, it in counts],
            next_step="Add views of one of them, tilted about different axes.",
        )
    poses = [known.poses[view] for view in views]
    targets = {known.frame_of(at): it for at, it in enumerate(known.session.boards.values())}
    if several or any(len(it.cam_from_target) > 1 for it in poses):
        placed = place(known.problem(views), poses, targets)
        poses = [*placed.views]
        known = known.noting(placed.rejections)
        boards = {it.board for it in poses}
        known = replace(known, boards=tuple(it for it in known.boards if it in boards))
        if several:
            frames = (known.camera_frame, *map(known.frame_of, known.boards))
            known = replace(known, frames={it: placed.tied.edges[it] for it in frames})
    used = tuple(it.view for it in poses)
    # A view whose image failed may still be used by the pose that the session gives.
    reasons = {view: reason for view, reason in known.reasons.items() if view not in used}
    return replace(known.posed(poses), used=used, reasons=reasons)


def _look(known: Known) -> Known:
    scene, views = known.scene, [known.poses[view] for view in known.used]
    if scene is None:
        return known
    if any(view.corners is None for view in views):
        return replace(known, free=held(scene))
    return known.seeing(look(scene, views, _side(known), closed_form=known.solver != "joint"))


def _agree(known: Known) -> Known:
    mount, problem = known.session.mount, known.problem(known.used)
    refuse_too_few(problem, mount, len(known.used))
    frames = known.frames or None
    if known.readings is not None and known.readings.mounting is not None:
        frames = known.framed(known.readings.mounting.edges)
    agreed = agree(problem, known.used, mount, frames)
    known = without_lost_boards(replace(known, candidates=known.used).agreeing(agreed))
    return known.posed(_held_back_poses(known))


def _held_back_poses(known: Known) -> Iterator[ViewPoses]:
    """Chooses the poses of views that no fit may use by the edges of the others."""
    targets, mount, agreed = tuple(known.session.boards.values()), known.session.mount, known.agreed
    if agreed is None:
        return
    for view in known.measurable_held_back:
        poses = known.poses[view]
        robot = robot_part(known.flange_poses([view]), mount)[0]
        z = known.frames[known.frame_of(poses.board)]
        predicted = invert(robot @ known.frames[known.camera_frame]) @ z
        yield choose_by(poses, predicted, targets[poses.board] if targets else None)


def _refine(known: Known) -> Known:
    """Refines with the views that agree, and looks again which do, until they stay the same."""
    scene, free, agreed = known.scene, known.free, known.agreed
    if agreed is None or known.solver != "joint":
        return known
    if scene is None or free is None or any(it is None for it in known.seen(known.used)):
        problem = known.problem(known.used).merged()
        fit = fit_problem(problem, problem.start(known.frames))
        errors = known.arm_at_stops.with_errors(problem, fit).errors
        return replace(known, calibrated=known.robot_arm.erring(errors))
    notes = known.notes
    for _ in range(_ROUNDS):
        views = [known.poses[view] for view in known.used]
        result = refine(scene, views, _side(known), known.frames)
        known = replace(known.seeing(result), notes=(*notes, *result.notes))
        before, all_of = agreed.mask, known.candidates
        problem = known.problem(all_of)
        agreed = agree(problem, all_of, known.session.mount, known.frames, before)
        known = without_lost_boards(known.agreeing(agreed))
        if np.array_equal(before, agreed.mask):
            break
        agreed = known.agreed or agreed
    return known.noting((), result.warnings)


def _side(known: Known) -> FramesSide:
    problem = known.problem(known.used).with_effects(())
    arm = known.arm_at_stops.erring(None)
    return FramesSide(problem, np.ones(len(problem), dtype=bool), known.used, {ROBOT: arm})


def _thermal(known: Known) -> Known:
    """Takes up the arm's drift, and refines again without it."""
    bare = replace(known, calibrated=known.robot_arm.erring(None))
    arm = bare.arm_at_stops if known.solver == "joint" else replace(bare.arm_at_stops, matched=None)
    problem = bare.problem(known.used).merged()
    fit = arm.with_drift(problem, problem.start(known.frames), known.level).thermal
    if fit is None:
        return known
    known = replace(known, notes=(*known.notes, *thermal.findings(fit)))
    if not thermal.is_found(fit):
        return known
    drifting = replace(known, calibrated=replace(known.robot_arm, thermal=fit))
    refined = _refine(drifting)
    warnings = tuple(dict.fromkeys(refined.warnings))
    notes = tuple(dict.fromkeys((*drifting.notes, *refined.notes)))
    return replace(refined, warnings=warnings, notes=notes)


def _kinematics(known: Known) -> Known:
    """Takes up the arm's errors, again with views that disagree with the arm as stated alone."""
    found = _with_level(known)
    if found.robot_arm.model is None or len(known.used) == len(known.candidates):
        return found
    more = _with_views_back(known, _hand_eye(found))
    return found if more is None else _with_level(more)


def _with_level(known: Known) -> Known:
    """Chooses how far the arm is calibrated, and takes its errors up as unknowns."""
    arm = known.robot_arm
    can = arm.is_modelled and known.solver == "joint"
    check_asked(known.level, can=can)
    if not can or known.level == "hand-eye":
        return known
    stated = replace(known, calibrated=arm.erring(None))
    problem = stated.problem(known.used)
    # What one stop shows of a target goes by its first view.
    first = np.unique(problem.of_one_stop, return_index=True)[1].tolist()
    problem, views = problem.merged(), [known.used[it] for it in first]
    start = problem.start(known.frames)
    arm = arm.calibrated_as(known.arm_at_stops.with_level(problem, start, known.level, views))
    known = replace(known, calibrated=arm)
    if arm.kinematics is None:
        return known
    known = replace(known, notes=(*known.notes, *findings(arm.kinematics)))
    return known.noting((), doubts(arm.kinematics))


def _with_views_back(stated: Known, calibrated: Known) -> Known | None:
    """The views that agree when the arm is calibrated; None where that brings none back."""
    before, all_of = stated.agreed, stated.candidates
    if before is None:
        return None
    mount = stated.session.mount
    again = agree(calibrated.problem(all_of), all_of, mount, calibrated.frames, before.mask)
    alike = stated.arm_at(all_of).reported_alike(before.mask)
    back = again.mask & (before.mask | alike)
    if not (back & ~before.mask).any():
        return None
    return without_lost_boards(stated.agreeing(replace(again, mask=back, frames=before.frames)))


def _hand_eye(known: Known) -> Known:
    """Solves for all edges, without priors that the views contradict."""
    known = _solved(known)
    while (worst := most_contradicted(*_answer(known))) is not None:
        known = _solved(_without_prior(known, worst.name))
    words = list(prior_words(*_answer(known), known.stated_priors))
    notes = (it for it, is_doubt in words if not is_doubt)
    known = replace(known, notes=(*known.notes, *notes))
    return known.noting((), (it for it, is_doubt in words if is_doubt))


def _answer(known: Known) -> tuple[Problem, State, FloatArray]:
    return known.solved.problem, known.solved.state, known.solved.covariance


def _without_prior(known: Known, name: str) -> Known:
    """Leaves a prior out, and looks again which views agree."""
    known = replace(known, contradicted=known.contradicted | {name})
    all_of, before = known.candidates, known.agreed
    mask = None if before is None else before.mask
    again = agree(known.problem(all_of), all_of, known.session.mount, known.frames, mask)
    return without_lost_boards(known.agreeing(again))


def _solved(known: Known) -> Known:
    """Solves for all edges, with the arm linearised anew until it stays.

    With it go the rotations that were supplied to readings of points.
    """
    for _ in range(_ROUNDS):
        problem = known.problem(known.used).merged()
        result = solve_hand_eye(
            problem,
            known.session.mount,
            known.solver,
            known.arm_at_stops.errors,
            looks=known.estimates_looks,
            start=problem.start(known.frames),
        )
        frames = dict(zip(problem.unknown, result.state.edges, strict=True))
        known = replace(known, hand_eye=result, frames=frames)
        arm, readings = known.robot_arm, known.readings
        moved, step = arm.moved(problem, result.state)
        if step < _ARM_AT_REST_RAD and _is_aimed(known):
            break
        if arm.model is not None:
            known = replace(known, calibrated=moved)
        if readings is not None:
            known = known.with_readings(readings.moved(result.state))
    return known


def _is_aimed(known: Known) -> bool:
    """Whether rotations that were supplied are still those that the chain predicts."""
    if known.readings is None or known.readings.are_poses:
        return True
    problem, state = known.problem(known.used), known.solved.state
    turns = rotation_angle(invert(problem.predicted(state)) @ problem.measured(state))
    return bool(turns.max() < _TURN_AT_REST_RAD)


def _diagnose(known: Known) -> Known:
    result, mount = known.solved, known.session.mount
    diagnosis = diagnose(
        result,
        mount,
        known.free,
        known.arm_at_stops.errors,
        middles(known),
        calibrated=known.robot_arm.model is not None,
    )
    spread = diagnosis.inflation * result.covariance
    worst = directions(result.problem, result.state, spread, mount)
    wider = replace(result, covariance=spread, worst=worst)
    known = replace(known, hand_eye=wider, diagnosis=diagnosis)
    return known.noting((), diagnosis.warnings)


def _validate(known: Known) -> Known:
    return replace(known, held_out=left_out(known))


def _tell(known: Known) -> Known:
    result = known.solved
    fitted = (result.problem, result.fit, result.covariance)
    found = known.arm_at_stops.found(*fitted, middles_of(known), known.convention)
    known = replace(known, arm_found=found, notes=(*known.notes, *found.notes()))
    return known.noting((), found.doubts())


def _judge(known: Known) -> Known:
    held, diagnosis, agreed = known.held_out, known.diagnosis, known.agreed
    if held is None or diagnosis is None or agreed is None:
        raise RuntimeError("the verdict comes before what it is made of")
    telling, noise, views = known.arm_found.telling, known.robot_noise, view_results(known)
    lost = [Rejection(*it) for it in known.reasons.items() if it[0] not in known.held_back]
    pair = Pair(
        views,
        used_rms(known),
        rms_of(held.away_m, held.away_rad, held.rms_px),
        holdout_rms(known),
        agreed.unexplained,
    )
    sensor = Sensor(
        sum(it.used for it in views), lost, [it.view for it in agreed.rejections], known.pixel_px
    )
    arm = ArmFindings(
        len(np.unique(known.stops)),
        None if noise is None else 1e3 * float(noise[1]),
        None if noise is None else float(np.rad2deg(noise[0])),
        errs=diagnosis.arm is not None,
        workspace_mm=None if telling is None else 1e3 * float(np.median(telling.sigmas_m)),
        modelled=known.robot is not None,
    )
    budget = {name.replace("_", " "): mm for name, mm in diagnosis.budget_mm.items()}
    findings = Findings(
        (pair,),
        (sensor,),
        (arm,),
        known.solved.worst,
        (Place("Where the views look, a point", budget, diagnosis.radius95_mm),),
        (*agreed.doubts(), *known.warnings),
        known.notes,
        known.session.mount,
        known.session.need,
        picks_of(_fitted(known, held, diagnosis), known.session.need),
    )
    return replace(known, findings=findings, verdict=judge(findings))


def _fitted(known: Known, held: HeldOut, diagnosis: Diagnosis) -> Fitted:
    """What picks are predicted from."""
    result, no_columns = known.solved, np.zeros(0, dtype=np.int64)
    return Fitted(
        known.problem(known.used),
        result.state,
        result.noise,
        result.covariance,
        held,
        middles_of(known),
        {ROBOT: freedom_of(diagnosis.intervals.tolist())},
        {ROBOT: known.arm_at_stops},
        sources(result.problem, known.session.mount, known.free).columns.get("board", no_columns),
        result.problem,
        diagnosis.inflation,
    )


STAGES: tuple[Stage, ...] = (
    Stage("robot", _read_robot),
    Stage("readings", _readings),
    Stage("detect", detect_targets),
    Stage("intrinsics", estimate_lenses),
    Stage("pnp", locate_targets),
    Stage("clock", _clock),
    Stage("joints", _joints),
    Stage("choose", _choose),
    Stage("look", _look),
    Stage("agree", _agree),
    Stage("refine", _refine),
    Stage("thermal", _thermal),
    Stage("kinematics", _kinematics),
    Stage("hand-eye", _hand_eye),
    Stage("diagnose", _diagnose),
    Stage("tell", _tell),
    Stage("validate", _validate),
    Stage("judge", _judge),
)
