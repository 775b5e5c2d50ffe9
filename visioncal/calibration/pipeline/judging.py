"""What a session is judged by: its cameras, robots and targets, and its weakest link."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from visioncal.calibration.pipeline.answer import Answer
from visioncal.calibration.pipeline.arm_results import doubts_of_arms, notes_on_arms
from visioncal.calibration.pipeline.budget import columns_of_boards, middles_moved, middles_of
from visioncal.calibration.pipeline.fault_messages import moved_found
from visioncal.calibration.pipeline.lens_fields import errors_found, lens_changes
from visioncal.calibration.pipeline.network_ties import (
    or_measured,
    robot_motion,
    standing_tie,
    tilting_advice,
    untied_words,
)
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
from visioncal.calibration.stages.need import PickInputs, picks_of
from visioncal.calibration.stages.priors import prior_words
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount, Rejection
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.estimation.arm import stops_of
from visioncal.estimation.budget import radius95
from visioncal.estimation.intervals import freedom_of
from visioncal.estimation.moves import Move
from visioncal.estimation.observability import (
    CellWords,
    Direction,
    check_determined,
    check_observability,
    directions,
    edge_directions,
    too_little_motion,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.results import HELD_BACK, Edge, Rms, ViewResult


def findings_of(known: RunState) -> Findings:
    """Puts together what a session is judged by."""
    answer, solved = known.solved, known.fitted
    tree = solved.cell.tree
    tied = [view for view in answer.views if {view.seer, view.seen} <= tree.branches.keys()]
    explained = {solved.cell.rows[row].view for fault in answer.faults for row in fault.rows}
    worst, places, warnings = _of_pair(known) if known.mount else _of_cell(known)
    of_arms = [
        _with_alike(doubt, known)
        for doubt in doubts_of_arms(
            solved.arms, answer.misfits, answer.arms, solved.asked, solved.cell
        )
    ]
    if any(warning.kind == "measured_turns" for warning in warnings):
        # They follow what the camera sees, and so the arm's posture, and joint angles do not help.
        of_arms = [arm for arm in of_arms if arm.do is not NO_JOINTS]
    of_rest = [
        *prior_words(answer.problem, answer.state, answer.covariance, solved.cell.priors),
        *solved.found_of_looks(answer.covariance),
    ]
    of_lenses = [*errors_found(answer.lenses)]
    doubted = {finding.kind for finding in (*of_arms, *of_lenses, *of_rest)}
    if doubted & OF_CHAIN or not solved.agreed.used.all():
        of_lenses += lens_changes(solved)
    return Findings(
        _pairs(tied, explained, answer, alone=known.mount is not None),
        _sensors(tied, answer.sigmas, solved.shown_px, known),
        _arms(answer),
        worst,
        places,
        (
            *(fault.found for fault in answer.faults),
            *of_arms,
            *of_lenses,
            *known.warnings,
            *(finding for finding in of_rest if finding.kind != NOTE),
            *warnings,
            *_untied(known),
        ),
        (
            *known.notes,
            *_clock_words(known),
            *notes_on_arms(solved.arms, answer.arms),
            *(finding.reason for finding in of_rest if finding.kind == NOTE),
        ),
        known.mount or _mount(tied),
        known.session.need,
        picks_of(_pickable(known), known.session.need),
        None if known.mount else _standing_tie(solved.cell, answer.last_edges),
    )


def _standing_tie(cell: Cell, edges: Mapping[str, Edge]) -> StandingTie | None:
    worst = {
        frame: max(value.sigma / value.limit for value in _directions(cell, frame, edge))
        for frame, edge in edges.items()
    }
    return standing_tie(cell, max(worst, key=worst.__getitem__)) if worst else None


def _with_alike(found: Finding, known: RunState) -> Finding:
    """A frame of one camera and robot that moved at once, with what would look the same."""
    steps = [test.step for test in known.solved.misfits.values() if isinstance(test.step, Move)]
    if found.kind != MOVED_FRAME or known.mount is None or not steps:
        return found
    tree = known.fitted.cell.tree
    on_flange = tree.body(steps[0].frame) != tree.root
    same = "Another tool frame in the controller" if on_flange else "A robot's base that was pushed"
    return replace(found, words=f"{found.words} {same} would look the same.")


def _pickable(known: RunState) -> PickInputs:
    """What picks are predicted from."""
    answer, solved = known.solved, known.fitted
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
        middles_moved(solved),
        answer.problem,
        {name: lens.noise_px * lens.levels.jitter for name, lens in answer.lenses.items()},
    )


def _untied(known: RunState) -> Iterator[Finding]:
    for frame in known.fitted.untied:
        if known.mount is not None and frame.startswith("target"):
            words = f"No usable view shows {frame.replace('_', ' ', 1)}: it has no place."
            yield Finding("unseen_target", words)
        else:
            step = Remedy(untied_words(known.cell, frame))
            yield Finding("untied", f"{frame} is tied to nothing.", step)


_Parts: TypeAlias = tuple[Sequence[Direction], Sequence[PointAccuracy], Sequence[Finding]]


def _of_pair(known: RunState) -> _Parts:
    """The worst directions and the place of work of one camera and one robot."""
    answer, work = known.solved, known.work
    budget = _in_words(work.budget_mm)
    place = PointAccuracy("Where the views look, a point", budget, work.radius95_mm)
    mount = known.session.mount
    found = [*_of_measured(known)]
    return directions(answer.problem, answer.state, answer.covariance, mount), [place], found


def _in_words(budget_mm: Mapping[str, float]) -> dict[str, float]:
    """A budget by sources in words; the names of frames, of which they are, stay."""
    parts = ((name.partition(" of "), mm) for name, mm in budget_mm.items())
    return {f"{source.replace('_', ' ')}{of}{frame}": mm for (source, of, frame), mm in parts}


def _of_measured(known: RunState) -> Iterator[Finding]:
    """Whether poses that another program measured have the robot's scale, and turn as it does."""
    views = [
        index
        for index in known.base_from_flange
        if index in known.poses and index not in known.reasons
    ]
    if known.cameras or known.mount == "instrument" or not views:
        return
    poses = np.array([known.base_from_flange[view] for view in views])
    seen = np.array([known.poses[view].cam_from_target[0] for view in views])
    parent = poses if known.mount == "eye-in-hand" else invert(poses)
    # The one camera may have a name.
    (edge,) = (edge for name, edge in known.solved.last_edges.items() if name.startswith("cam"))
    if (found := distance_scale(parent, seen, edge.matrix)) is not None:
        yield found
    from_seer = edge.matrix @ seen
    if known.mount == "eye-in-hand":
        found = measured_turns(poses, from_seer)
    else:
        found = measured_turns(np.eye(4), parent @ from_seer)
    if found is not None:
        yield found


def _of_cell(known: RunState) -> _Parts:
    """The worst directions and the frames of a whole cell, and what moved in it."""
    answer, solved = known.solved, known.fitted
    edges, budget = answer.last_edges, answer.budget_mm
    taken_up = {*_taking_up(known)}
    edges = {frame: edge for frame, edge in edges.items() if frame not in taken_up}
    worst = [
        direction
        for frame, edge in edges.items()
        for direction in _directions(solved.cell, frame, edge)
    ]
    return (
        sorted(worst, key=lambda value: (value.is_rotation, -value.sigma)),
        [
            PointAccuracy(frame, _in_words(budget[frame]), 1e3 * radius95(edge.covariance[3:, 3:]))
            for frame, edge in edges.items()
        ],
        [moved_found(move) for move in answer.moved],
    )


def _taking_up(known: RunState) -> Iterator[str]:
    """The frames that take up what is open of a calibrated arm's first and last link.

    Its poses make up for that, so that the sigma of such a frame alone says little.
    """
    answer, cell = known.solved, known.fitted.cell
    for robot, base in cell.tree.bases.items():
        if answer.arms[robot].numbers is None:
            continue
        bodies = {cell.tree.flanges[robot]}
        # All that stands in the cell is placed from the reference, and turns with its arm's zero.
        bodies |= {cell.tree.root} if base == cell.reference else set()
        yield base
        yield from (frame for frame in cell.tree.branches if cell.tree.body(frame) in bodies)


def _mount(sights: Sequence[ViewResult]) -> Mount:
    is_read = all(sight.seer.startswith("instrument") for sight in sights)
    return "instrument" if is_read else "eye-to-hand"


def _clock_words(known: RunState) -> Iterator[str]:
    """Says what the fit makes of clocks that the motion determined."""
    for pair, clock in known.solved.clocks(known).items():
        if known.mount is None and clock is not known.clocks[pair].clock:
            yield (
                f"{pair.words}: the fit of the whole cell has the camera's clock "
                f"{1e3 * clock.camera_minus_robot_s:+.2f} ms ahead (sigma "
                f"{figure(1e3 * clock.sigma_s)} ms)."
            )


def _pairs(
    sights: Sequence[ViewResult], explained: Collection[int], answer: Answer, *, alone: bool
) -> list[JudgedPair]:
    """What each camera saw of each target; of one camera and one robot, all that there is."""
    rows: dict[tuple[str, str], list[ViewResult]] = {}
    for sight in sights:
        rows.setdefault(("", "") if alone else (sight.seer, sight.seen), []).append(sight)
    return [
        JudgedPair(
            mine,
            [
                Rejection(view.view, view.reason)
                for view in mine
                if _disagrees(view) and view.view not in explained
            ],
            f"{seer} of {seen}" if len(rows) > 1 else "",
            *_weighed(answer, mine),
        )
        for (seer, seen), mine in rows.items()
    ]


def _weighed(answer: Answer, sights: Sequence[ViewResult]) -> tuple[Rms, Rms]:
    """What a sensor's noise makes of some sights, and by how much they are away when left out."""
    # A square varies as its mean does, so that views weigh by the inverse square of what is
    # expected of each where doubt begins: one whose own pose is known badly says nothing of the
    # others.
    used, held, limits = answer.problem.observations, answer.held_out, CalibrationLimits()
    seen = {(sight.seer, sight.seen) for sight in sights}
    mine = np.array([pair in seen for pair in zip(used.observers, used.observed, strict=True)])

    def rms(block: slice, away: FloatArray, doubt: float) -> FloatArray | None:
        known = mine & np.isfinite(away)
        if not known.any():
            return None
        noise = np.trace(used.covariance[known, block, block], axis1=1, axis2=2)
        weights = (noise + doubt**2) ** -2.0
        squares = np.stack([noise, away[known] ** 2], axis=1)
        return np.sqrt(np.average(squares, axis=0, weights=weights))

    turned = rms(slice(3), held.away_rad, float(np.deg2rad(limits.scatter_deg[0])))
    shifted = rms(slice(3, 6), held.away_m, 1e-3 * limits.scatter_mm[0])
    noise, away = (
        Rms(
            0.0 if shifted is None else 1e3 * float(shifted[at]),
            None if turned is None else float(np.rad2deg(turned[at])),
        )
        for at in (0, 1)
    )
    return noise, away


def _disagrees(view: ViewResult) -> bool:
    """Whether an observation was left out although its chain could be closed."""
    return not view.used and view.residual_mm is not None and view.reason != HELD_BACK


def _sensors(
    sights: Sequence[ViewResult],
    noise: Mapping[str, Mapping[str, float]],
    shown_px: Mapping[str, float],
    known: RunState,
) -> list[Sensor]:
    seers = dict.fromkeys(sight.seer for sight in sights)
    set_aside = known.spared.keys() | known.held_back
    found = []
    for seer in seers:
        mine = [sight for sight in sights if sight.seer == seer]
        lost = [
            Rejection(view.view, view.reason)
            for view in mine
            if not view.used and view.view not in set_aside
        ]
        levels = noise.get(seer, {})
        found.append(
            Sensor(
                sum(view.used for view in mine),
                lost,
                [view.view for view in mine if _disagrees(view)],
                shown_px.get(seer, levels.get("pixel_px")),
                levels.get("level", 1.0),
                sum(view.view in known.spared for view in mine),
                seer if len(seers) > 1 else "",
            )
        )
    return found


def _arms(answer: Answer) -> list[JudgedArm]:
    problem, solved = answer.problem, answer.solved
    modelled = {name or "robot" for name in solved.cell.session.robot_documents}
    found = []
    for robot, intervals in zip(problem.robots, answer.intervals, strict=True):
        noise, numbers, arm = answer.sigmas[robot], answer.arms[robot].numbers, solved.arms[robot]
        known = not problem.is_combined
        surely = (1e3 * float(intervals[1, 0]), float(np.rad2deg(intervals[0, 0])))
        found.append(
            JudgedArm(
                len(stops_of(problem, robot)),
                noise["translation_mm"] if known else None,
                noise["rotation_deg"] if known else None,
                surely if known else None,
                errs=arm.errors is not None and arm.errors.is_significant,
                workspace_mm=None if numbers is None else 1e3 * float(np.median(numbers.sigmas_m)),
                modelled=robot in modelled,
                by_functions=arm.has_functions,
                can_tilt=arm.can_tilt,
                name=robot if len(problem.robots) > 1 else "",
            )
        )
    return found


def poor_motion(known: RunState) -> Finding | None:
    """Says that a robot's poses alone leave one camera and it open; None of whole cells."""
    if known.mount is None or len(known.base_from_flange) < 2:
        return None
    poses = np.array([*known.base_from_flange.values()])
    words, advice = too_little_motion(poses, known.mount)
    return Finding("weak_motion", words, Remedy(advice)) if words else None


def check_answer(known: RunState) -> None:
    """Refuses motion that does not determine a frame well enough for anybody.

    Raises:
        DegenerateError: A direction of a frame is not determined at all, or its predicted sigma is
            over the limit.
    """
    if known.is_misread and poor_motion(known) is None:
        # Where poses are read wrongly, what is predicted at their fit says nothing of the motion.
        return
    agreed, cell = known.fitted.agreed, known.fitted.cell
    part, fit = known.fitted.part, agreed.fit
    seen = known.fitted.seen
    looks = seen is not None and any(scene.estimated for scene in known.scenes.values())
    pixel_px = {} if seen is None else dict(zip(seen.looks.problems, seen.sigmas_px, strict=True))
    if known.mount is not None:
        check_observability(part, fit.state, fit.noise, known.mount, pixel_px, looks=looks)
        return
    names = {name: _names(part.tree, name) for name in part.unknown}
    lost = agreed.problem.subset(~agreed.used)
    # A robot that was never tilted leaves more open than one standing view does.
    is_tilted = not any(tilting_advice(cell, base) for base in part.tree.bases.values())

    def tie_of(frame: str) -> StandingTie | None:
        return standing_tie(cell, frame) if is_tilted else None

    def motion(frame: str) -> str:
        if not part.through(frame).any() and (count := int(lost.through(frame).sum())):
            return f"all {count} observations of it disagree with the rest of the cell"
        tie = tie_of(frame)
        return _motion(cell, part, frame) if tie is None else tie.words

    def advice(frame: str, culprit: str) -> str:
        if (tie := tie_of(frame)) is not None:
            return tie.advice
        if part.through(frame).any() or not len(lost):
            flanges = part.tree.flanges.values()
            by_way = [name for name in flanges if part.through(name)[part.through(frame)].any()]
            measured = or_measured(cell, by_way[0]) if by_way and "offset along" in culprit else ""
            return f"{_more(cell, frame)} {measured}".rstrip()
        return (
            "Look whether the board that ties it has the stated size, and whether images and poses "
            "belong together."
        )

    scene = CellWords("cell", names, motion, advice)
    check_determined(part, fit.state, fit.noise, scene, pixel_px, looks=looks)


def _names(tree: Tree, frame: str) -> tuple[str, str]:
    """A frame's name in words, and that of the frame that it hangs on."""
    parent = tree.branches[frame].parent
    return frame.partition("@")[0], "the cell" if parent == tree.root else parent


def _motion(cell: Cell, part: Problem, frame: str) -> str:
    """Says how the robots stood by way of which a frame was observed."""
    rows, words = part.through(frame), []
    for robot, base in part.tree.bases.items():
        stops = np.unique(part.observations.stops[rows & part.through(part.tree.flanges[robot])])
        words += [robot_motion(cell, base, stops)] if len(stops) > 1 else []
    return "; ".join(words) or f"{int(rows.sum())} observations are too few or too poor"


def _directions(cell: Cell, frame: str, edge: Edge) -> list[Direction]:
    """The worst directions of a frame: of its offset and, where it has one, of its rotation."""
    found = edge_directions(edge.matrix, edge.covariance, *_names(cell.tree, frame))
    return [direction for direction in found if edge.oriented or not direction.is_rotation]


def _more(cell: Cell, frame: str) -> str:
    """What would determine a frame better."""
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
    """Names the link of the cell that is known worst, and what it rests on."""
    if not edges:
        return ""
    name, edge = max(edges.items(), key=lambda pair: pair[1].sigma_mm)
    worst = max(_directions(cell, name, edge), key=lambda value: value.sigma / value.limit)
    return (
        f"The weakest link is {name}: sigma {mm_and_deg(edge.sigma_mm, edge.sigma_deg)}, most of "
        f"it in {worst.words}. {_resting(cell, name)}"
    )


def _resting(cell: Cell, frame: str) -> str:
    rows = [row for row in cell.rows if frame in cell.tree.above(row.seer)]
    rows += [row for row in cell.rows if frame in cell.tree.above(row.seen)]
    pairs: dict[str, int] = {}
    for row in rows:
        key = f"{row.seer} of {row.seen}"
        pairs[key] = pairs.get(key, 0) + 1
    least = sorted(pairs.items(), key=lambda pair: pair[1])
    return f"It rests on {some_of([f'{count} views by {key}' for key, count in least], 4)}."
