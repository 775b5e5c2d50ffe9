"""Collects the verdict's input: results by camera, robot and target; checks observability."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.assessment import FitAssessment
from visioncal.calibration.pipeline.budget import middle_jacobians, middles_of
from visioncal.calibration.pipeline.connectivity import robot_motion
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.need import PickInputs, predict_picks
from visioncal.calibration.suspects.contest import contested
from visioncal.calibration.suspects.judge import judge
from visioncal.calibration.suspects.judged import Findings, JudgedArm, JudgedPair, Sensor
from visioncal.calibration.suspects.misread_poses import BY_CHAIN, with_misreading
from visioncal.calibration.suspects.outliers import EXCHANGED
from visioncal.calibration.suspects.registry import found_in
from visioncal.calibration.suspects.suspect import LIKE_KNOCKS, UNDONE
from visioncal.core.conventions import controller_form
from visioncal.core.directions import Direction, Turning, edge_directions
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import mm_and_deg, some_of, view_words
from visioncal.core.quantiles import freedom_of
from visioncal.core.types import FloatArray, Rejection
from visioncal.core.verdict import Finding, Remedy, Verdict, of_cell
from visioncal.estimation.arm import stops_of
from visioncal.estimation.observability import (
    CellWords,
    chain_words,
    check_determined,
    directions,
    too_little_motion,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.unknowns import LENS
from visioncal.results import HELD_BACK, Edge, Rms, ViewResult
from visioncal.robot.model import REPEATABILITY
from visioncal.session.tree import Tree


def judge_run(state: RunState) -> RunState:
    """Ranks the causes of what is unexplained, and compares picks with the need."""
    findings = findings_of(state)
    verdict = judge(findings)
    # Exchanged rows show themselves; other poses that are misread explain what follows.
    if verdict.status != "good" and [cause.kind for cause in verdict.causes[:1]] != [EXCHANGED]:
        state = with_misreading(replace(state, warnings=tuple(findings.warnings)))
        if state.misread:
            rest = (found for found in findings.warnings if found.kind not in BY_CHAIN)
            findings = replace(findings, warnings=(*state.misread, *rest))
            verdict = judge(findings)
    return _judged(state, findings, verdict)


def _judged(state: RunState, findings: Findings, verdict: Verdict) -> RunState:
    """The run with a verdict, whose commands are for its robots and cameras."""
    remedies = of_cell(verdict.findings, len(state.robots), len(state.cameras))
    verdict = replace(verdict, findings=remedies)
    return replace(state, warnings=tuple(findings.warnings), findings=findings, verdict=verdict)


def judged_beside(state: RunState, found: Sequence[Finding]) -> RunState:
    """The verdict with causes that pairs of a whole cell show by themselves."""
    if not found or state.findings is None:
        return state
    findings, views = state.findings, {view for each in found for view in each.views}
    pairs = [
        replace(pair, outliers=[out for out in pair.outliers if out.view not in views])
        for pair in findings.pairs
    ]
    # Of a robot's tool, all that it carries seems to have moved; of a lens, its camera.
    seem = ("something_moved", *LIKE_KNOCKS)
    effects = ("moved_frame",) if any(each.kind in seem for each in found) else ()
    warnings = (*found, *(at for at in findings.warnings if at.kind not in effects))
    findings = replace(findings, pairs=pairs, warnings=warnings)
    return _judged(state, findings, judge(findings))


def findings_of(run: RunState) -> Findings:
    """Collects the input of the verdict."""
    answer = run.assessment
    frames = run.cell_fit.cell.tree.branches.keys()
    connected = [view for view in answer.views if {view.seer, view.seen} <= frames]
    explained = {run.cell_fit.cell.rows[row].view for fault in answer.faults for row in fault.rows}
    worst = _worst(run)
    return Findings(
        _pairs(connected, explained | answer.marginal, answer, is_single=run.session.has_one_pair),
        _sensors(connected, run),
        _arms(run),
        worst,
        (*contested(run, found_in(run)), *run.warnings),
        (*run.notes, *_marginal_words(answer)),
        run.session.need,
        predict_picks(_pick_inputs(run, explained), run.session.need),
        run.session.corrects_targets,
        _use(run),
        _is_by_lens(run, worst),
    )


def _is_by_lens(run: RunState, worst: Sequence[Direction]) -> bool:
    """Whether most of the variance of the weakest direction is that of an estimated lens."""
    fit = run.assessment.ended
    lens = fit.unknowns.of_kinds(LENS)
    is_estimated = any(look.table.stated is None for look in run.cameras.values())
    if not (run.session.has_one_pair and is_estimated and len(lens)):
        return False
    inner, names = fit.whole[np.ix_(lens, lens)], chain_words(fit.problem, run.session.mount).names
    known = fit.whole - fit.whole[:, lens] @ np.linalg.pinv(inner, hermitian=True) @ fit.whole[lens]
    given_lens = [found for _, found in directions(fit.problem, fit.state, known, names)]
    at = max(range(len(worst)), key=lambda at: worst[at].sigma / worst[at].limit)
    # Share of a variance that is left without a source to which most of it is due.
    return bool(given_lens[at].sigma ** 2 < 0.3 * worst[at].sigma ** 2)


def _use(run: RunState) -> Remedy:
    """How a good result is used: in the robot's own program, or to locate things by it."""
    stated = next((robot.form for robot in run.session.robots.values()), None)
    form = controller_form("" if run.robot is None else run.robot.name, stated)
    words, command = "Locate things by the camera", "locate SESSION -c OUT"
    if not run.session.has_one_pair:
        words, command = "Take the frames to another program", "export OUT --to ros --edge all"
    elif form is not None:
        to = form.name if form.models or form.name == "ros" else "urdf"
        words, command = "Take the transform to the robot", f"export OUT --to {to}"
    elif run.mount == "instrument" or not run.session.boards:
        words, command = "Take the transform to another program", "export OUT --to text"
    again = "visioncal verify compares later stops with it."
    if run.mount == "instrument":
        again = "visioncal diff compares a later one with it."
    return Remedy(f"{words}, and keep the result: {again}", f"visioncal {command}")


def _pick_inputs(run: RunState, explained: Collection[int]) -> PickInputs:
    """Input of the prediction of picks."""
    answer, cell_fit, fit = run.assessment, run.cell_fit, run.assessment.ended
    freedom = [freedom_of(interval.tolist()) for interval in answer.intervals]
    return PickInputs(
        fit,
        answer.held_out,
        middles_of(cell_fit.cell),
        dict(zip(fit.robots, freedom, strict=True)),
        cell_fit.arms,
        middle_jacobians(fit, run.session),
        _strays(answer, explained),
    )


def _marginal_words(answer: FitAssessment) -> Iterator[str]:
    """Remark on views that an arm's ordinary errors put off."""
    if views := sorted(answer.marginal):
        were = "was" if len(views) == 1 else "were"
        yield f"V{view_words(views)[1:]} {were} left out: off by what arms err by now and then."


def _strays(answer: FitAssessment, explained: Collection[int]) -> dict[str, FloatArray]:
    """(m, 2) turn [rad] and shift [m] of rejected views without a reason, by camera.

    Larger errors than views of a sound cell have are mistakes of the session.
    """
    limits, strays = CalibrationLimits(), dict[str, list[tuple[float, float]]]()
    for view in answer.views:
        mm, deg = view.residual_mm or 0.0, view.residual_deg or 0.0
        is_small = mm < limits.scatter_mm[0] and deg < limits.scatter_deg[0]
        if _is_outlier(view) and view.view not in explained and is_small:
            strays.setdefault(view.seer, []).append((float(np.deg2rad(deg)), 1e-3 * mm))
    return {seer: np.array(errors) for seer, errors in strays.items()}


def _worst(run: RunState) -> list[Direction]:
    """The least certain directions of the unknown frames, the worst first."""
    answer, cell, fit = run.assessment, run.cell_fit.cell, run.assessment.ended
    if run.session.has_one_pair:
        names = chain_words(fit.problem, run.session.mount).names
        found = directions(fit.problem, fit.state, fit.whole, names)
        return [direction for _, direction in found]
    absorbing = {*_absorbing(run)}
    edges = {frame: edge for frame, edge in answer.last_edges.items() if frame not in absorbing}
    worst = [value for frame, edge in edges.items() for value in _directions(cell, frame, edge)]
    return sorted(worst, key=lambda value: (value.is_rotation, -value.sigma))


def _absorbing(run: RunState) -> Iterator[str]:
    """Frames that absorb undetermined parameters of a calibrated arm's first and last link.

    The arm's poses compensate that, so that the sigma of such a frame alone says little.
    """
    answer, cell = run.assessment, run.cell_fit.cell
    for robot, base in cell.tree.bases.items():
        found = answer.arms[robot].sections.arm
        if found is None or found.workspace_sigma_mm is None:
            continue
        bodies = {cell.tree.flanges[robot]}
        # Static frames are placed from the reference, and rotate with the zero of its arm.
        bodies |= {cell.tree.root} if base == cell.reference else set()
        yield base
        yield from (frame for frame in cell.tree.branches if cell.tree.body(frame) in bodies)


def _pairs(
    views: Sequence[ViewResult],
    explained: Collection[int],
    answer: FitAssessment,
    *,
    is_single: bool,
) -> list[JudgedPair]:
    """Results by camera and target; all in one for one camera and one robot."""
    by_pair: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        by_pair.setdefault(("", "") if is_single else (view.seer, view.seen), []).append(view)
    return [
        JudgedPair(
            pair_views,
            [
                Rejection(view.view, view.reason)
                for view in pair_views
                if _is_outlier(view) and view.view not in explained
            ],
            f"{seer} of {seen}" if len(by_pair) > 1 else "",
            *_weighted_rms(answer, pair_views),
        )
        for (seer, seen), pair_views in by_pair.items()
    ]


def _weighted_rms(answer: FitAssessment, views: Sequence[ViewResult]) -> tuple[Rms, Rms]:
    """Weighted rms of the sensor's noise in the poses of some views, and of left-out residuals."""
    # The variance of a square is proportional to the square of its mean, so that views are weighted
    # by the inverse square of the expected residual at the limit of doubt: a view whose own pose is
    # uncertain says nothing of the others.
    used, held_out, limits = answer.fit.problem.observations, answer.held_out, CalibrationLimits()
    pairs = {(view.seer, view.seen) for view in views}
    of_pairs = np.array([pair in pairs for pair in zip(used.observers, used.observed, strict=True)])
    rms: list[tuple[float, float] | None] = []
    for axes, residuals, limit in (
        (slice(3, 6), 1e3 * held_out.residual_m, limits.scatter_mm[0]),
        (slice(3), np.rad2deg(held_out.residual_rad), limits.scatter_deg[0]),
    ):
        finite, unit = of_pairs & np.isfinite(residuals), 1e3 if axes.start else np.rad2deg(1.0)
        noise = unit**2 * np.trace(used.covariance[finite, axes, axes], axis1=1, axis2=2)
        squares, weights = np.stack([noise, residuals[finite] ** 2]), (noise + limit**2) ** -2.0
        means = np.average(squares, axis=1, weights=weights) if finite.any() else None
        rms.append(None if means is None else (float(means[0] ** 0.5), float(means[1] ** 0.5)))
    mm, deg = rms[0] or (0.0, 0.0), rms[1] or (None, None)
    return Rms(mm[0], deg[0]), Rms(mm[1], deg[1])


def _is_outlier(view: ViewResult) -> bool:
    """Whether an observation was rejected although its chain can be closed."""
    return not view.used and view.residual_mm is not None and view.reason != HELD_BACK


def _sensors(views: Sequence[ViewResult], run: RunState) -> list[Sensor]:
    seers = dict.fromkeys(view.seer for view in views)
    not_needed = run.spared.keys() | run.held_back
    undone = {at for found in run.warnings if found.kind in UNDONE for at in found.views}
    sensors = []
    for seer in seers:
        seer_views = [view for view in views if view.seer == seer]
        unused = [view for view in seer_views if not view.used and view.view not in not_needed]
        sensors.append(
            Sensor(
                used=sum(view.used for view in seer_views),
                lost=[Rejection(view.view, view.reason) for view in unused],
                outliers=[v.view for v in seer_views if _is_outlier(v) or v.view in undone],
                pixel_px=run.cell_fit.fit.shown_px(seer),
                spared=sum(view.view in run.spared for view in seer_views),
                name=seer if len(seers) > 1 else "",
            )
        )
    return sensors


def _arms(run: RunState) -> list[JudgedArm]:
    answer, cell_fit = run.assessment, run.cell_fit
    problem, arms = answer.fit.problem, []
    budget = run.uncertainty.budget_mm if run.session.has_one_pair else {}
    for index, (robot, intervals) in enumerate(zip(problem.robots, answer.intervals, strict=True)):
        arm, found = cell_fit.arms[robot], answer.arms[robot].sections.arm
        accuracy = None if found is None else found.workspace_sigma_mm
        model = arm.nominal
        stops = stops_of(problem, robot)
        poses = problem.poses[robot][stops]
        judged = JudgedArm(
            len(stops),
            # Those of a calibrated arm are estimated, and what is left is noise.
            has_posture_errors=arm.errors is not None
            and arm.errors.is_significant
            and (arm.errors.fit_sigmas is not None or arm.model is None),
            # The greater part of the variance.
            are_lasting=budget.get("arm", 0.0) > 0.7 * budget.get("total", np.inf),
            workspace_mm=None if accuracy is None else accuracy.median,
            modelled=model is not None,
            repeatability=REPEATABILITY if model is None else model.repeatability,
            can_tilt=Turning.of(poses).is_enough if model is None else model.can_tilt,
            name=f"Robot {robot}" if len(problem.robots) > 1 else "",
        )
        # Of pose pairs without a stated noise, the detection's may be in the flange's.
        if not problem.is_combined and problem.observations.covariance.any():
            noise, (least_rad, least_m) = answer.sigmas[robot], intervals[:, 0].tolist()
            # A board whose size is held leaves residuals that no flange has.
            fits = (answer.sized_of_noise, answer.fit_of_noise)
            pair = (fit.noise.robots[index] for fit in fits)
            share_rad, share_m = np.minimum(np.divide(*pair), 1.0).tolist()
            judged = replace(
                judged,
                noise_mm=share_m * noise["translation_mm"],
                noise_deg=share_rad * noise["rotation_deg"],
                lower_bounds=(1e3 * share_m * least_m, float(np.rad2deg(share_rad * least_rad))),
            )
        arms.append(judged)
    return arms


def poor_motion(run: RunState) -> Finding | None:
    """Finding that the motion of one robot is too poor for one camera; None for a whole cell."""
    if not run.session.has_one_pair or len(run.base_from_flange) < 2:
        return None
    poses = np.array([*run.base_from_flange.values()])
    words, advice = too_little_motion(poses, run.session.mount)
    return Finding("weak_motion", words, Remedy(advice)) if words else None


def check_answer(run: RunState) -> None:
    """Refuses motion that does not determine all frames.

    Raises:
        DegenerateError: A direction of a frame is undetermined, or its predicted sigma exceeds the
            limit.
    """
    if run.misread and poor_motion(run) is None:
        # With misread poses, sigmas predicted at their fit say nothing of the motion.
        return
    fit = run.cell_fit.fit
    is_estimated = bool(fit.sigmas_px) and any(scene.estimated for scene in run.scenes.values())
    words = words_of(run.cell_fit.cell, fit.problem, can_tilt=run.can_tilt)
    check_determined(
        *(fit.problem, fit.state, fit.noise, words, fit.sigmas_px), with_first_effect=is_estimated
    )


def words_of(cell: Cell, part: Problem, *, can_tilt: bool | None = None) -> CellWords:
    """The fault of a motion that leaves a frame undetermined, and its remedy."""
    if cell.session.has_one_pair:
        return chain_words(part, cell.session.mount, can_tilt=can_tilt)

    def advice(frame: str, _: str) -> str:
        frame = frame.partition("@")[0]
        rows = [row for row in cell.rows if frame in (row.seer, row.seen)]
        others = sorted({row.seen if row.seer == frame else row.seer for row in rows})
        shown = f" with {some_of(others)} and {frame}" * bool(others)
        return f"Add stops{shown}, turned by 30 degrees or more about two axes."

    def motion(frame: str) -> str:
        rows, words = part.observations_through(frame), []
        for robot, base in part.tree.bases.items():
            through = rows & part.observations_through(part.tree.flanges[robot])
            stops = np.unique(part.observations.stops[through])
            words += [robot_motion(cell, base, stops)] if len(stops) > 1 else []
        return "; ".join(words) or f"{int(rows.sum())} observations are too few or too poor"

    return CellWords(
        "cell", {name: _names(part.tree, name) for name in part.unknown}, motion, advice
    )


def _names(tree: Tree, frame: str) -> tuple[str, str]:
    """Names of a frame and of its parent in words."""
    parent = tree.branches[frame].parent
    return frame.partition("@")[0], "the cell" if parent == tree.root else parent


def _directions(cell: Cell, frame: str, edge: Edge) -> list[Direction]:
    """The worst directions of a frame: of its translation and, if estimated, of its rotation."""
    found = edge_directions(edge.matrix, edge.covariance, *_names(cell.tree, frame))
    return [direction for direction in found if edge.oriented or not direction.is_rotation]


def weakest_link(cell: Cell, edges: Mapping[str, Edge]) -> str:
    """Names the most uncertain frame of the cell, and its worst direction."""
    if not edges:
        return ""
    name, edge = max(edges.items(), key=lambda pair: pair[1].sigma_mm)
    worst = max(_directions(cell, name, edge), key=lambda value: value.sigma / value.limit)
    return (
        f"The weakest link is {name}: sigma {mm_and_deg(edge.sigma_mm, edge.sigma_deg)}, most of "
        f"it in {worst.words}."
    )
