"""What a result of a whole cell has by name: its cameras, robots and targets."""

import numpy as np

from visioncal.calibration.pipeline.judging import weakest_link
from visioncal.calibration.pipeline.lens_documents import cameras_of, fit_section
from visioncal.calibration.pipeline.network_ties import untied_words
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import stops_of
from visioncal.results import CellResult, RobotResult, Untied
from visioncal.results.arm import ArmSections
from visioncal.results.sections import CellDetails, CellUncertainty, Intervals
from visioncal.robot import Robot
from visioncal.session.frames import thing_name
from visioncal.vision.targets import target_document


def cell_of(known: RunState) -> CellResult:
    """Puts together what is known of a whole cell by name when all steps have run."""
    session, cell, solved, answer = known.session, known.cell, known.fitted, known.solved
    placed = cell_edges(known)
    kept = {
        name: branch.parent
        for name, branch in cell.tree.branches.items()
        if name in solved.cell.tree.branches
    }
    parents = {frame: name.partition("_from_")[0] for frame, name in placed.items()}
    return CellResult(
        reference=cell.reference,
        tree=kept | parents,
        cameras={thing_name(name, "camera"): lens for name, lens in cameras_of(known).items()},
        robots=_robots(known),
        targets={
            name or "target": target_document(plate) for name, plate in session.plates.items()
        },
        noise=answer.sigmas,
        moved=answer.moved,
        untied=tuple(Untied(name, untied_words(cell, name)) for name in solved.untied),
        weakest=weakest_link(solved.cell, answer.last_edges),
        details=_details(known),
        joint_fit=fit_section(known),
        uncertainty=CellUncertainty(
            budget_mm={placed[frame]: mm for frame, mm in answer.budget_mm.items()},
            noise_95=noise_intervals(known),
        ),
    )


def cell_edges(known: RunState) -> dict[str, str]:
    """The names of a whole cell's edges by the frames that they place."""
    branches = known.solved.problem.tree.branches
    named = known.solved.versions.values()
    return {
        version.name: f"{branches[version.key].parent}_from_{version.name}" for version in named
    }


def _robots(known: RunState) -> dict[str, RobotResult]:
    session, solved = known.session, known.fitted
    models = session.robot_documents
    found = {
        robot_key(name): RobotResult(Robot.from_document(models[name]) if name in models else None)
        for name in session.robots
    }
    for name in solved.arms:
        found[name] = RobotResult(found[name].model, **vars(arm_sections(known, name)))
    return found


def arm_sections(known: RunState, robot: str) -> ArmSections:
    """What was found of a robot's arm."""
    solved, answer, first = known.fitted, known.solved, dict[int, int]()
    for row in solved.cell.rows:
        first.setdefault(row.station, row.view)
    stops = stops_of(answer.problem, robot)
    found = answer.arms[robot]
    return solved.arms[robot].at(stops).result(found, [first[index] for index in stops.tolist()])


def _details(known: RunState) -> CellDetails:
    """What was found of clocks."""
    return CellDetails({key.words: at.result() for key, at in known.solved.clocks(known).items()})


def noise_intervals(known: RunState) -> dict[str, Intervals]:
    """95 % intervals of the levels of robots, as the noise names them."""
    pairs = zip(known.solved.problem.robots, known.solved.intervals, strict=True)
    return {
        robot: {
            "translation_mm": _ends(1e3 * shift_m),
            "rotation_deg": _ends(np.rad2deg(turn_rad)),
        }
        for robot, (turn_rad, shift_m) in pairs
    }


def _ends(interval: FloatArray) -> tuple[float, float]:
    """The ends of an interval."""
    low, high = interval.tolist()
    return low, high
