"""The result of a whole cell: its frames, each with respect to all others."""

from datetime import UTC, datetime

import numpy as np

from visioncal.calibration.pipeline.judging import weakest_link
from visioncal.calibration.pipeline.lens_documents import (
    boards_of,
    cameras_of,
    fit_section,
    rigs_of,
)
from visioncal.calibration.pipeline.network_ties import untied_words
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.need import need_met
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import stops_of
from visioncal.results import Alignment, RobotResult, Untied
from visioncal.results.arm import ArmSections
from visioncal.results.sections import CellDetails, CellUncertainty, Intervals
from visioncal.robot import Robot
from visioncal.vision.targets import target_document


def alignment_of(known: RunState) -> Alignment:
    """Puts together what is known of a whole cell when all steps have run.

    Raises:
        RuntimeError: One has not.
    """
    session, cell, solved, answer = known.session, known.cell, known.fitted, known.solved
    if known.verdict is None or known.findings is None:
        raise RuntimeError("a step is missing")
    branches, edges = answer.problem.tree.branches, answer.edges
    parents = {version.name: branches[version.key].parent for version in answer.versions.values()}
    kept = {
        name: branch.parent
        for name, branch in cell.tree.branches.items()
        if name in solved.cell.tree.branches
    }
    size = 6 * len(edges)
    return Alignment(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        reference=cell.reference,
        frames=kept | parents,
        robots={flange: robot for robot, flange in solved.cell.tree.flanges.items()},
        edges={f"{parents[name]}_from_{name}": edge for name, edge in edges.items()},
        joint_covariance=answer.covariance[:size, :size],
        cameras=cameras_of(known),
        noise=answer.sigmas,
        sights=answer.sights,
        left_out=answer.held_out.method if np.isfinite(answer.held_out.away_m).any() else "",
        moved=answer.moved,
        untied=tuple(Untied(name, untied_words(cell, name)) for name in solved.untied),
        weakest=weakest_link(solved.cell, answer.last_edges),
        verdict=known.verdict,
        details=_details(known),
        arms=_arms(known),
        targets={
            name or "target": target_document(plate) for name, plate in session.plates.items()
        },
        boards=boards_of(known),
        rigs=rigs_of(known),
        joint_fit=fit_section(known),
        uncertainty=CellUncertainty(
            budget_mm={f"{parents[name]}_from_{name}": mm for name, mm in answer.budget_mm.items()},
            noise_95=_intervals(known),
        ),
        need=need_met(known.findings.need, known.findings.picks, whole=True),
    )


def _arms(known: RunState) -> dict[str, RobotResult]:
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


def _intervals(known: RunState) -> dict[str, Intervals]:
    """95 % intervals of the levels of robots, as the noise names them."""
    pairs = zip(known.solved.problem.robots, known.solved.intervals, strict=True)
    return {
        robot: {
            "translation_mm": pair_of(1e3 * shift_m),
            "rotation_deg": pair_of(np.rad2deg(turn_rad)),
        }
        for robot, (turn_rad, shift_m) in pairs
    }


def pair_of(interval: FloatArray) -> tuple[float, float]:
    """The ends of an interval."""
    low, high = interval.tolist()
    return low, high
