"""What a whole cell is judged by: its cameras, robots and targets, and its weakest link."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from visioncal.calibration import HELD_BACK, Edge, Sight
from visioncal.calibration.whole import holdout_rms, left_out_rms, rms_of, view_results
from visioncal.estimation.arm import stops_of
from visioncal.estimation.budget import radius95
from visioncal.estimation.observability import (
    Direction,
    Scene,
    check_determined,
    edge_directions,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.figures import figure
from visioncal.files import some_of
from visioncal.pipeline.faults import PoseFault, by_way_of
from visioncal.pipeline.solving import Solved
from visioncal.pipeline.ties import robot_motion
from visioncal.stages.cell import Cell
from visioncal.stages.judge import Arm, Findings, Pair, Place, Sensor
from visioncal.stages.need import Picks
from visioncal.types import Mask, Rejection


def findings_of(
    solved: Solved,
    sights: Sequence[Sight],
    faults: Sequence[PoseFault],
    edges: Mapping[str, Edge],
    budget_mm: Mapping[str, Mapping[str, float]],
    noise: Mapping[str, Mapping[str, float]],
    *,
    workspace_mm: Mapping[str, float],
    spared: Collection[int],
    warnings: Sequence[str],
    notes: Sequence[str],
    picks: Sequence[Picks] = (),
) -> Findings:
    """Puts together what a whole cell is judged by.

    Args:
        solved: The fit.
        sights: What became of each observation.
        faults: What of them wrong poses of robots explain.
        edges: The transforms by the frames that they place.
        budget_mm: What these are uncertain by, by source.
        noise: Estimated standard deviations, by frame or robot.
        workspace_mm: Of each calibrated arm, the predicted sigma of a tool's place, in the median.
        spared: Views that are not needed, and those that are held back.
        warnings: Reasons for doubt that were found before.
        notes: What is good to know.
        picks: What picks err by.
    """
    tree = solved.cell.tree
    tied = [it for it in sights if {it.seer, it.seen} <= tree.branches.keys()]
    explained = {solved.cell.rows[row].view for it in faults for row in it.rows}
    directions = [
        it for frame, edge in edges.items() for it in _directions(solved.cell, frame, edge)
    ]
    return Findings(
        _pairs(tied, explained),
        _sensors(tied, noise, spared),
        _arms(solved, noise, workspace_mm),
        sorted(directions, key=lambda it: (it.is_rotation, -it.sigma)),
        [
            Place(frame, budget_mm[frame], 1e3 * radius95(edge.covariance[3:, 3:]))
            for frame, edge in edges.items()
        ],
        (*(it.words for it in faults), *warnings),
        notes,
        "instrument" if all(it.seer.startswith("instrument") for it in tied) else "eye-to-hand",
        solved.cell.session.need,
        picks,
    )


def _pairs(sights: Sequence[Sight], explained: Collection[int]) -> list[Pair]:
    rows: dict[tuple[str, str], list[Sight]] = {}
    for it in sights:
        rows.setdefault((it.seer, it.seen), []).append(it)
    return [
        Pair(
            view_results(mine),
            rms_of(mine),
            left_out_rms(mine),
            holdout_rms(mine),
            disagreeing=[
                Rejection(it.view, it.reason)
                for it in mine
                if _disagrees(it) and it.view not in explained
            ],
            name=f"{seer} of {seen}" if len(rows) > 1 else "",
        )
        for (seer, seen), mine in rows.items()
    ]


def _disagrees(sight: Sight) -> bool:
    """Whether an observation was left out although its chain could be closed."""
    return not sight.used and sight.residual_mm is not None and sight.reason != HELD_BACK


def _sensors(
    sights: Sequence[Sight], noise: Mapping[str, Mapping[str, float]], spared: Collection[int]
) -> list[Sensor]:
    seers = dict.fromkeys(it.seer for it in sights)
    found = []
    for seer in seers:
        mine = [it for it in sights if it.seer == seer]
        lost = [
            Rejection(it.view, it.reason) for it in mine if not it.used and it.view not in spared
        ]
        levels = noise.get(seer, {})
        found.append(
            Sensor(
                sum(it.used for it in mine),
                lost,
                [it.view for it in mine if _disagrees(it)],
                levels.get("pixel_px"),
                levels.get("level", 1.0),
                seer if len(seers) > 1 else "",
            )
        )
    return found


def _arms(
    solved: Solved,
    noise: Mapping[str, Mapping[str, float]],
    workspace_mm: Mapping[str, float],
) -> list[Arm]:
    part = solved.agreed.problem.subset(solved.agreed.used)
    modelled = {name or "robot" for name in solved.cell.session.robot_documents}
    return [
        Arm(
            len(stops_of(part, robot)),
            noise[robot]["translation_mm"],
            noise[robot]["rotation_deg"],
            errs=robot in solved.arms and solved.arms[robot].errors is not None,
            workspace_mm=workspace_mm.get(robot),
            modelled=robot in modelled,
            name=robot if len(part.robots) > 1 else "",
        )
        for robot in part.robots
    ]


def check_cell(solved: Solved, *, looks: bool = False) -> None:
    """Refuses a cell in which the motion does not determine a frame well enough for anybody.

    Args:
        solved: The fit.
        looks: Whether its views have to tell lens and board.

    Raises:
        DegenerateError: A direction of a frame is not determined at all, or its predicted sigma is
            over the limit.
    """
    agreed, cell = solved.agreed, solved.cell
    part = agreed.problem.subset(agreed.used)
    names = {it: _names(part.tree, it) for it in part.unknown}
    lost = agreed.problem.subset(~agreed.used)

    def motion(frame: str) -> str:
        if not _of_frame(part, frame).any() and (count := int(_of_frame(lost, frame).sum())):
            return f"all {count} observations of it disagree with the rest of the cell"
        return _motion(cell, part, frame)

    def advice(frame: str, _: str) -> str:
        if _of_frame(part, frame).any() or not len(lost):
            return _more(cell, frame)
        return (
            "Look whether the board that ties it has the stated size, and whether images and poses "
            "belong together."
        )

    scene = Scene("align", names, motion, advice)
    check_determined(part, agreed.fit.state, agreed.fit.noise, scene, looks=looks)


def _names(tree: Tree, frame: str) -> tuple[str, str]:
    """A frame's name in words, and that of the frame that it hangs on."""
    parent = tree.branches[frame].parent
    return frame.partition("@")[0], "the cell" if parent == tree.root else parent


def _of_frame(problem: Problem, frame: str) -> Mask:
    """(n,) the observations on whose way an edge is."""
    rows = np.zeros(len(problem), dtype=bool)
    for group in problem.groups:
        rows[group.rows] = any(step.frame == frame for step in group.path)
    return rows


def _motion(cell: Cell, part: Problem, frame: str) -> str:
    """Says how the robots stood by way of which a frame was observed."""
    rows, told = _of_frame(part, frame), []
    for branch in part.tree.branches.values():
        if branch.robot:
            stops = np.unique(part.observations.stops[rows & by_way_of(part, branch.robot)])
            told += [robot_motion(cell, branch.parent, stops)] if len(stops) > 1 else []
    return "; ".join(told) or f"{int(rows.sum())} observations are too few or too poor"


def worst_direction(cell: Cell, frame: str, edge: Edge) -> Direction:
    """The direction of a frame that is known worst, in the axes of the frame that it hangs on."""
    found = _directions(cell, frame, edge)
    return max(found, key=lambda it: it.sigma / it.limit)


def _directions(cell: Cell, frame: str, edge: Edge) -> list[Direction]:
    """The worst directions of a frame: of its offset and, where it has one, of its rotation."""
    found = edge_directions(edge.matrix, edge.covariance, *_names(cell.tree, frame))
    return [it for it in found if edge.oriented or not it.is_rotation]


def _more(cell: Cell, frame: str) -> str:
    """What would determine a frame better."""
    frame = frame.partition("@")[0]
    rows = [it for it in cell.rows if frame in (it.seer, it.seen)]
    others = sorted({it.seen if it.seer == frame else it.seer for it in rows})
    if not others:
        return "Add stops at which its robot turns about two axes or more."
    if frame.startswith("target") and len(others) == 1 and frame not in _carried(cell):
        return (
            f"Let another camera than {others[0]} see {frame}, too, or measure its squares and "
            "state square_sigma_m."
        )
    return (
        f"Add stops with {some_of(others)} and {frame}, turned by 30 degrees or more about two "
        "axes."
    )


def _carried(cell: Cell) -> set[str]:
    """The frames that robots carry."""
    return {it for it in cell.tree.branches if cell.tree.body(it) != cell.tree.root}


def weakest_link(cell: Cell, edges: Mapping[str, Edge]) -> str:
    """Names the link of the cell that is known worst, and what it rests on."""
    if not edges:
        return ""
    name, edge = max(edges.items(), key=lambda it: it[1].sigma_mm)
    worst = worst_direction(cell, name, edge)
    return (
        f"The weakest link is {name}: sigma {figure(edge.sigma_mm)} mm and "
        f"{figure(edge.sigma_deg)} deg, most of it in {worst.words}. {_resting(cell, name)}"
    )


def _resting(cell: Cell, frame: str) -> str:
    rows = [it for it in cell.rows if frame in cell.tree.above(it.seer)]
    rows += [it for it in cell.rows if frame in cell.tree.above(it.seen)]
    pairs: dict[str, int] = {}
    for it in rows:
        key = f"{it.seer} of {it.seen}"
        pairs[key] = pairs.get(key, 0) + 1
    least = sorted(pairs.items(), key=lambda it: it[1])
    return f"It rests on {some_of([f'{count} views by {key}' for key, count in least], 4)}."
