"""Collects the verdict's input: results by camera, robot and target; checks observability."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from visioncal.calibration.pipeline.arm_results import doubts_of_arms, notes_on_arms
from visioncal.calibration.pipeline.assessment import FitAssessment
from visioncal.calibration.pipeline.budget import columns_of_boards, middle_jacobians, middles_of
from visioncal.calibration.pipeline.connectivity import (
    connection_advice,
    measuring_advice,
    robot_motion,
    sole_static_view,
    tilting_advice,
)
from visioncal.calibration.pipeline.fault_messages import moved_finding
from visioncal.calibration.pipeline.lens_fields import lens_changes, lens_findings
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cause_ranking import MOVED_FRAME, NO_JOINTS, OF_CHAIN
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.distance_scale import distance_scale, measured_turns
from visioncal.calibration.stages.findings import (
    Findings,
    JudgedArm,
    JudgedPair,
    PointAccuracy,
    Sensor,
    StandingTie,
)
from visioncal.calibration.stages.need import PickInputs, predict_picks
from visioncal.calibration.stages.priors import prior_findings
from visioncal.calibration.stages.random_effects import random_effect_findings
from visioncal.core.conventions import controller_form
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import counted, figure, mm_and_deg, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Rejection
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.estimation.arm import stops_of
from visioncal.estimation.budget import radius95
from visioncal.estimation.intervals import freedom_of
from visioncal.estimation.moves import Move
from visioncal.estimation.observability import (
    CellWords,
    Direction,
    chain_words,
    check_determined,
    directions,
    edge_directions,
    too_little_motion,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.results import HELD_BACK, Edge, Rms, ViewResult


def findings_of(run: RunState) -> Findings:
    """Collects the input of the verdict."""
    answer, solved = run.assessment, run.cell_fit
    frames = solved.cell.tree.branches.keys()
    connected = [view for view in answer.views if {view.seer, view.seen} <= frames]
    explained = {solved.cell.rows[row].view for fault in answer.faults for row in fault.rows}
    worst, places, warnings = _pair_accuracy(run) if run.mount else _cell_accuracy(run)
    doubts = doubts_of_arms(
        solved.arms, answer.residual_tests, answer.arms, solved.level, solved.cell
    )
    of_arms = [_with_alternative(doubt, run) for doubt in doubts]
    if any(warning.kind == "measured_turns" for warning in warnings):
        # These errors come from the camera's poses and appear to depend on the arm's posture; joint
        # angles would not help.
        of_arms = [arm for arm in of_arms if arm.do is not NO_JOINTS]
    of_rest = [
        *prior_findings(answer.problem, answer.state, answer.covariance, solved.cell.priors),
        *solved.camera_findings(answer.covariance),
        *random_effect_findings(solved.inlier_problem, solved.inlier_fit.fit, answer.covariance),
    ]
    of_lenses = [*lens_findings(answer.lenses)]
    doubted = {finding.kind for finding in (*of_arms, *of_lenses, *of_rest)}
    if doubted & OF_CHAIN or not solved.inlier_fit.used.all():
        of_lenses += lens_changes(solved)
    is_read = all(view.seer.startswith("instrument") for view in connected)
    return Findings(
        _pairs(connected, explained, answer, alone=run.mount is not None),
        _sensors(connected, answer.sigmas, solved.residual_px, run),
        _arms(answer),
        worst,
        places,
        (
            *(fault.found for fault in answer.faults),
            *of_arms,
            *of_lenses,
            *run.warnings,
            *(finding for finding in of_rest if finding.kind != NOTE),
            *warnings,
            *_unconnected(run),
        ),
        (
            *run.notes,
            *_clock_words(run),
            *notes_on_arms(solved.arms, answer.arms),
            *(finding.reason for finding in of_rest if finding.kind == NOTE),
        ),
        run.mount or ("instrument" if is_read else "eye-to-hand"),
        run.session.need,
        predict_picks(_pick_inputs(run), run.session.need),
        None if run.mount else _sole_static_view(solved.cell, answer.last_edges),
        run.session.corrects_targets,
        _use(run),
    )


def _use(run: RunState) -> Remedy:
    """How a good result is used: in the robot's own program, or to locate things by it."""
    form = None if run.robot is None else controller_form(run.robot.name)
    if run.mount is None:
        words, command = "Take the frames to another program", "export OUT --to ros --edge all"
    elif form is not None:
        words, command = "Take the transform to the robot", f"export OUT --to {form.name}"
    elif run.mount == "instrument":
        words, command = "Take the transform to another program", "export OUT --to text"
    else:
        words, command = "Locate things by the camera", "locate SESSION -c OUT"
    again = "visioncal verify compares later stops with it."
    return Remedy(f"{words}, and keep the result: {again}", f"visioncal {command}")


def _sole_static_view(cell: Cell, edges: Mapping[str, Edge]) -> StandingTie | None:
    """The static view that alone links the worst frame to the rest, if any."""
    worst = {
        frame: max(value.sigma / value.limit for value in _directions(cell, frame, edge))
        for frame, edge in edges.items()
    }
    return sole_static_view(cell, max(worst, key=worst.__getitem__)) if worst else None


def _with_alternative(finding: Finding, run: RunState) -> Finding:
    """Adds to a frame of one camera and robot that moved what cannot be distinguished from that."""
    steps = [
        test.step for test in run.assessment.residual_tests.values() if isinstance(test.step, Move)
    ]
    if finding.kind != MOVED_FRAME or run.mount is None or not steps:
        return finding
    tree = run.cell_fit.cell.tree
    on_flange = tree.body(steps[0].frame) != tree.root
    same = "Another tool frame in the controller" if on_flange else "A robot's base that was pushed"
    return replace(finding, words=f"{finding.words} {same} would look the same.")


def _pick_inputs(run: RunState) -> PickInputs:
    """Input of the prediction of picks."""
    answer, solved = run.assessment, run.cell_fit
    freedom = [freedom_of(interval.tolist()) for interval in answer.intervals]
    return PickInputs(
        answer.problem,
        answer.fit,
        answer.covariance,
        answer.held_out,
        middles_of(solved.cell),
        dict(zip(answer.problem.robots, freedom, strict=True)),
        solved.arms,
        columns_of_boards(solved),
        middle_jacobians(solved),
        answer.problem,
        {name: lens.noise_px * lens.levels.jitter for name, lens in answer.lenses.items()},
    )


def _unconnected(run: RunState) -> Iterator[Finding]:
    for frame in run.cell_fit.unconnected:
        if run.mount is not None and frame.startswith("target"):
            words = f"No usable view shows {frame.replace('_', ' ', 1)}: it has no place."
            step = Remedy("Add views that show it, or delete it from session.toml.")
            yield Finding("unseen_target", words, step)
        else:
            step = Remedy(connection_advice(run.cell, frame))
            yield Finding("untied", f"{frame} is tied to nothing.", step)


_Parts: TypeAlias = tuple[Sequence[Direction], Sequence[PointAccuracy], Sequence[Finding]]


def _pair_accuracy(run: RunState) -> _Parts:
    """Worst directions, accuracy where the views look, and findings of one camera and one robot."""
    answer, work, mount = run.assessment, run.accuracy_at_work, run.session.mount
    budget = _in_words(work.budget_mm)
    place = PointAccuracy("Where the views look, a point", budget, work.radius95_mm)
    names = chain_words(answer.problem, mount).names
    found = directions(answer.problem, answer.state, answer.covariance, names)
    worst = [direction for _, direction in found]
    return worst, [place], [*_measured_pose_findings(run)]


def _in_words(budget_mm: Mapping[str, float]) -> dict[str, float]:
    """Replaces underscores in the sources' names by spaces, but not in the frames' names."""
    parts = ((name.partition(" of "), mm) for name, mm in budget_mm.items())
    return {f"{source.replace('_', ' ')}{of}{frame}": mm for (source, of, frame), mm in parts}


def _measured_pose_findings(run: RunState) -> Iterator[Finding]:
    """Findings on measured poses whose scale or rotations differ from the robot's."""
    usable = run.poses.keys() - run.reasons.keys()
    views = [view for view in run.base_from_flange if view in usable]
    if run.cameras or run.mount == "instrument" or not views:
        return
    poses = np.array([run.base_from_flange[view] for view in views])
    seen = np.array([run.poses[view].cam_from_target[0] for view in views])
    parent = poses if run.mount == "eye-in-hand" else invert(poses)
    # The camera may have a name.
    (edge,) = (edge for name, edge in run.assessment.last_edges.items() if name.startswith("cam"))
    if (finding := distance_scale(parent, seen, edge.matrix)) is not None:
        yield finding
    target = edge.matrix @ seen
    in_hand = run.mount == "eye-in-hand"
    finding = (
        measured_turns(poses, target) if in_hand else measured_turns(np.eye(4), parent @ target)
    )
    if finding is not None:
        yield finding


def _cell_accuracy(run: RunState) -> _Parts:
    """Worst directions, accuracy of the frames, and moved frames of a whole cell."""
    answer, cell, budget = run.assessment, run.cell_fit.cell, run.assessment.budget_mm
    absorbing = {*_absorbing(run)}
    edges = {frame: edge for frame, edge in answer.last_edges.items() if frame not in absorbing}
    worst = [value for frame, edge in edges.items() for value in _directions(cell, frame, edge)]
    return (
        sorted(worst, key=lambda value: (value.is_rotation, -value.sigma)),
        [
            PointAccuracy(frame, _in_words(budget[frame]), 1e3 * radius95(edge.covariance[3:, 3:]))
            for frame, edge in edges.items()
        ],
        [moved_finding(move) for move in answer.moved],
    )


def _absorbing(run: RunState) -> Iterator[str]:
    """Frames that absorb undetermined parameters of a calibrated arm's first and last link.

    The arm's poses compensate that, so that the sigma of such a frame alone says little.
    """
    answer, cell = run.assessment, run.cell_fit.cell
    for robot, base in cell.tree.bases.items():
        if answer.arms[robot].identifiability is None:
            continue
        bodies = {cell.tree.flanges[robot]}
        # Static frames are placed from the reference, and rotate with the zero of its arm.
        bodies |= {cell.tree.root} if base == cell.reference else set()
        yield base
        yield from (frame for frame in cell.tree.branches if cell.tree.body(frame) in bodies)


def _clock_words(run: RunState) -> Iterator[str]:
    """Notes on clock offsets of a whole cell that the fit estimates."""
    for pair, clock in run.assessment.clocks(run).items():
        if run.mount is None and clock is not run.clocks[pair].clock:
            yield (
                f"{pair.words}: the fit of the whole cell has the camera's clock "
                f"{1e3 * clock.camera_minus_robot_s:+.2f} ms ahead (sigma "
                f"{figure(1e3 * (clock.sigma_s or 0.0))} ms)."
            )


def _pairs(
    views: Sequence[ViewResult], explained: Collection[int], answer: FitAssessment, *, alone: bool
) -> list[JudgedPair]:
    """Results by camera and target; all in one for one camera and one robot."""
    by_pair: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        by_pair.setdefault(("", "") if alone else (view.seer, view.seen), []).append(view)
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
    used, held_out, limits = answer.problem.observations, answer.held_out, CalibrationLimits()
    pairs = {(view.seer, view.seen) for view in views}
    of_pairs = np.array([pair in pairs for pair in zip(used.observers, used.observed, strict=True)])

    def rms(block: slice, residuals: FloatArray, doubt: float) -> FloatArray | None:
        finite = of_pairs & np.isfinite(residuals)
        if not finite.any():
            return None
        noise = np.trace(used.covariance[finite, block, block], axis1=1, axis2=2)
        weights = (noise + doubt**2) ** -2.0
        squares = np.stack([noise, residuals[finite] ** 2], axis=1)
        return np.sqrt(np.average(squares, axis=0, weights=weights))

    rad = rms(slice(3), held_out.residual_rad, float(np.deg2rad(limits.scatter_deg[0])))
    metres = rms(slice(3, 6), held_out.residual_m, 1e-3 * limits.scatter_mm[0])
    noise, residual = (
        Rms(
            0.0 if metres is None else 1e3 * float(metres[at]),
            None if rad is None else float(np.rad2deg(rad[at])),
        )
        for at in (0, 1)
    )
    return noise, residual


def _is_outlier(view: ViewResult) -> bool:
    """Whether an observation was rejected although its chain can be closed."""
    return not view.used and view.residual_mm is not None and view.reason != HELD_BACK


def _sensors(
    views: Sequence[ViewResult],
    noise: Mapping[str, Mapping[str, float]],
    residual_px: Mapping[str, float],
    run: RunState,
) -> list[Sensor]:
    seers = dict.fromkeys(view.seer for view in views)
    not_needed = run.spared.keys() | run.held_back
    seen, sensors = run.cell_fit.linearised_corners, []
    for seer in seers:
        seer_views = [view for view in views if view.seer == seer]
        unused = (view for view in seer_views if not view.used and view.view not in not_needed)
        lost = [Rejection(view.view, view.reason) for view in unused]
        levels = noise.get(seer, {})
        sensors.append(
            Sensor(
                sum(view.used for view in seer_views),
                lost,
                [view.view for view in seer_views if _is_outlier(view)],
                residual_px.get(seer, levels.get("pixel_px")),
                levels.get("level", 1.0),
                sum(view.view in run.spared for view in seer_views),
                seer if len(seers) > 1 else "",
                seen is not None and seen.holds_lens(seer),
                seer in run.scenes and run.scenes[seer].matrix_sigma_px is not None,
            )
        )
    return sensors


def _arms(answer: FitAssessment) -> list[JudgedArm]:
    problem, solved = answer.problem, answer.cell_fit
    modelled = {name or "robot" for name in solved.cell.session.robot_documents}
    arms = []
    for robot, intervals in zip(problem.robots, answer.intervals, strict=True):
        noise, numbers, arm = (
            answer.sigmas[robot],
            answer.arms[robot].identifiability,
            solved.arms[robot],
        )
        is_known = not problem.is_combined
        lower_bounds = (1e3 * float(intervals[1, 0]), float(np.rad2deg(intervals[0, 0])))
        arms.append(
            JudgedArm(
                len(stops_of(problem, robot)),
                noise["translation_mm"] if is_known else None,
                noise["rotation_deg"] if is_known else None,
                lower_bounds if is_known else None,
                has_posture_errors=arm.errors is not None and arm.errors.is_significant,
                workspace_mm=None if numbers is None else 1e3 * float(np.median(numbers.sigmas_m)),
                modelled=robot in modelled,
                by_functions=arm.function_gain > 0.0,
                can_tilt=arm.can_tilt,
                name=robot if len(problem.robots) > 1 else "",
            )
        )
    return arms


def poor_motion(run: RunState) -> Finding | None:
    """Finding that the motion of one robot is too poor for one camera; None for a whole cell."""
    if run.mount is None or len(run.base_from_flange) < 2:
        return None
    poses = np.array([*run.base_from_flange.values()])
    words, advice = too_little_motion(poses, run.mount)
    return Finding("weak_motion", words, Remedy(advice)) if words else None


def check_answer(run: RunState) -> None:
    """Refuses motion that does not determine all frames.

    Raises:
        DegenerateError: A direction of a frame is undetermined, or its predicted sigma exceeds the
            limit.
    """
    if run.is_misread and poor_motion(run) is None:
        # With misread poses, sigmas predicted at their fit say nothing of the motion.
        return
    inliers, cell = run.cell_fit.inlier_fit, run.cell_fit.cell
    part, fit = run.cell_fit.inlier_problem, inliers.fit
    seen = run.cell_fit.linearised_corners
    is_estimated = seen is not None and any(scene.estimated for scene in run.scenes.values())
    pixel_px = (
        {}
        if seen is None
        else dict(zip(seen.camera_parameters.problems, seen.sigmas_px, strict=True))
    )
    if run.mount is not None:
        words = chain_words(part, run.mount)
        check_determined(
            part, fit.state, fit.noise, words, pixel_px, with_first_effect=is_estimated
        )
        return
    names = {name: _names(part.tree, name) for name in part.unknown}
    outliers = inliers.problem.subset(~inliers.used)
    # A robot that was never tilted leaves more undetermined than a static view does.
    is_tilted = not any(tilting_advice(cell, base) for base in part.tree.bases.values())

    def static_view(frame: str) -> StandingTie | None:
        return sole_static_view(cell, frame) if is_tilted else None

    def motion(frame: str) -> str:
        if not part.observations_through(frame).any() and (
            count := int(outliers.observations_through(frame).sum())
        ):
            return f"all {count} observations of it disagree with the rest of the cell"
        view = static_view(frame)
        return _motion(cell, part, frame) if view is None else view.words

    def advice(frame: str, culprit: str) -> str:
        if (view := static_view(frame)) is not None:
            return view.advice
        if part.observations_through(frame).any() or not len(outliers):
            flanges = part.tree.flanges.values()
            between = [
                name
                for name in flanges
                if part.observations_through(name)[part.observations_through(frame)].any()
            ]
            measured = ""
            if between and "offset along" in culprit:
                measured = measuring_advice(cell, between[0])
            return f"{_frame_advice(cell, frame)} {measured}".rstrip()
        return (
            "Look whether the board that ties it has the stated size, and whether images and poses "
            "belong together."
        )

    scene = CellWords("cell", names, motion, advice)
    check_determined(part, fit.state, fit.noise, scene, pixel_px, with_first_effect=is_estimated)


def _names(tree: Tree, frame: str) -> tuple[str, str]:
    """Names of a frame and of its parent in words."""
    parent = tree.branches[frame].parent
    return frame.partition("@")[0], "the cell" if parent == tree.root else parent


def _motion(cell: Cell, part: Problem, frame: str) -> str:
    """Describes the motion of the robots between a frame and its observers."""
    rows, words = part.observations_through(frame), []
    for robot, base in part.tree.bases.items():
        stops = np.unique(
            part.observations.stops[rows & part.observations_through(part.tree.flanges[robot])]
        )
        words += [robot_motion(cell, base, stops)] if len(stops) > 1 else []
    return "; ".join(words) or f"{int(rows.sum())} observations are too few or too poor"


def _directions(cell: Cell, frame: str, edge: Edge) -> list[Direction]:
    """The worst directions of a frame: of its translation and, if estimated, of its rotation."""
    found = edge_directions(edge.matrix, edge.covariance, *_names(cell.tree, frame))
    return [direction for direction in found if edge.oriented or not direction.is_rotation]


def _frame_advice(cell: Cell, frame: str) -> str:
    """Advice on what would determine a frame better."""
    frame = frame.partition("@")[0]
    rows = [row for row in cell.rows if frame in (row.seer, row.seen)]
    others = sorted({row.seen if row.seer == frame else row.seer for row in rows})
    if not others:
        return "Add stops at which its robot turns about two axes or more."
    if frame.startswith("target") and len(others) == 1 and cell.tree.body(frame) == cell.tree.root:
        return (
            f"Let another camera than {others[0]} see {frame}, too, or measure its squares and "
            "state square_sigma_m."
        )
    return (
        f"Add stops with {some_of(others)} and {frame}, turned by 30 degrees or more about two "
        "axes."
    )


def weakest_link(cell: Cell, edges: Mapping[str, Edge]) -> str:
    """Names the most uncertain frame of the cell, and the observations that determine it."""
    if not edges:
        return ""
    name, edge = max(edges.items(), key=lambda pair: pair[1].sigma_mm)
    worst = max(_directions(cell, name, edge), key=lambda value: value.sigma / value.limit)
    return (
        f"The weakest link is {name}: sigma {mm_and_deg(edge.sigma_mm, edge.sigma_deg)}, most of "
        f"it in {worst.words}. {_determining_views(cell, name)}"
    )


def _determining_views(cell: Cell, frame: str) -> str:
    rows = [row for row in cell.rows if frame in cell.tree.above(row.seer)]
    rows += [row for row in cell.rows if frame in cell.tree.above(row.seen)]
    counts = Counter(f"{row.seer} of {row.seen}" for row in rows)
    fewest = sorted(counts.items(), key=lambda pair: pair[1])
    words = [f"{counted(count, 'view')} by {key}" for key, count in fewest]
    return f"It rests on {some_of(words, 4)}."
