"""A cell the other way round, one without a robot, and what is carried where none is."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.guess.fit import CAMERA_OVER_BOARD, SWITCH_OFF, are_of_camera
from visioncal.calibration.pipeline.guess_inputs import chain_fit
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.misread_poses import BY_CHAIN
from visioncal.calibration.suspects.suspect import CHAIN, FACT, SOURCES, Suspect
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure
from visioncal.core.transforms import apply
from visioncal.core.types import MOUNTS, FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.vision.targets import corner_positions

# A part on a flange may be so far from it [m], also where the poses are in the board's frame;
# seldom so far, or a camera so far behind the flange: more than the length of one beside the wrist;
# farther behind than the last link is long, no bracket has it.
_NEAR_M, _FAR_M, _BEHIND_M, _FAR_BEHIND_M = 0.3, 0.5, 0.05, 0.08


def _found(run: RunState) -> Iterator[Finding]:
    if run.mount not in MOUNTS:
        return
    # Where a model's poses are those of the joints, they are no inverse ones.
    matched = run.reported.matched
    if matched is not None and matched.joints_rad:
        return
    edges = [*run.assessment.last_edges.items()][:2]
    if found := _of_camera(run, *(edge.matrix for _, edge in edges)):
        yield found
        return
    camera, target = (
        (name, float(np.linalg.norm(edge.transform.translation))) for name, edge in edges
    )
    in_hand = run.mount == MOUNTS[0]
    (carried, carried_m), (placed, placed_m) = (camera, target) if in_hand else (target, camera)
    if carried_m > max(_NEAR_M, CLEAR_RATIO * placed_m):
        yield Finding(
            "mirrored_cell",
            f"By this result, {carried} is {carried_m:.2f} m away from the flange that carries it, "
            f"and {placed} only {placed_m:.2f} m from the robot's base. With inverse poses of the "
            f"robot and the mount {MOUNTS[in_hand]} the views fit just as well, and both change "
            "places.",
            Remedy(
                "Measure roughly which is right. If it is the other, convert the recording again "
                f"with --mount {MOUNTS[in_hand]} and --robot-inverse (for easy_handeye, --mount "
                "alone)."
            ),
            until_mm=0.0,
        )
        return
    edge = run.assessment.last_edges[carried]
    depth_m, (*_, along_z) = -edge.matrix[2, 3], edge.matrix[:3, :3] @ edge.covariance[3:, 3:]
    sigma_m = float(np.sqrt(max(along_z @ edge.matrix[2, :3], 0.0)))
    away_m = carried_m if in_hand else _middle_m(run, edge.matrix)
    where = f"{away_m:.2f} m away from" if away_m > _FAR_M else ""
    if in_hand and depth_m > _BEHIND_M + 3.0 * sigma_m:
        where = f"{figure(1e3 * depth_m)} mm behind"
    # Where session.toml has its place, that was measured.
    measured = [prior.second for prior in run.cell_fit.cell.priors if prior.axes]
    if where and carried not in measured:
        thing, is_odd = ("camera" if in_hand else "target"), in_hand
        is_odd &= bool(depth_m > _FAR_BEHIND_M + 3.0 * sigma_m)
        stated = f" If it is, state z_m of [prior.flange_from_{carried}] in session.toml." * is_odd
        yield Finding(
            "tool_active" if is_odd else "carried_away",
            f"By the robot's poses, the {thing} is {where} the flange that carries it. Was a tool "
            "active on the controller when they were recorded? Then they are of its tip, and the "
            "transform is from there, and not from the flange.",
            Remedy(
                f"Measure roughly how far the {thing} is from the flange. If it is not {where} it, "
                "set the controller's tool to zero and record again, or use the result with that "
                f"tool active alone.{stated}"
            ),
        )


def _middle_m(run: RunState, flange_from_target: FloatArray) -> float:
    """Distance of a carried target from its flange: a large board's first corner is farther [m]."""
    middles = [corner_positions(board).mean(axis=0) for board in run.session.boards.values()]
    middle = middles[0] if len(middles) == 1 else np.zeros(3)
    return float(np.linalg.norm(apply(flange_from_target, middle)))


def of_camera(run: RunState) -> Iterator[Finding]:
    """The finding that the robot's poses are the camera's, before anything is fitted."""
    matched = run.reported.matched
    if run.mount not in MOUNTS or (matched is not None and matched.joints_rad):
        return
    fit = chain_fit(run.base_from_flange, run.poses_of_one_board, run.session.mount)
    if fit is not None and fit.closes and (found := _of_camera(run, fit.x, fit.z)):
        yield found


def _of_camera(run: RunState, camera: FloatArray, target: FloatArray) -> Finding | None:
    """The finding by both edges; a tracker of no images may be set to the robot's own frames."""
    if not are_of_camera(camera, target):
        return None
    return Finding(
        "camera_poses",
        f"{CAMERA_OVER_BOARD[0].upper()}{CAMERA_OVER_BOARD[1:]}.",
        Remedy(
            f"Convert the recording again, with the poses that the robot reported; {SWITCH_OFF}."
        ),
        is_fatal=bool(run.corners),
        until_mm=0.0,
    )


# A result by such poses is of nothing else.
CAMERA_POSES = Suspect("camera_poses", None, FACT, hides=(CHAIN, *BY_CHAIN), inflates=SOURCES)
MIRRORED_CELL = Suspect("mirrored_cell", _found, 1e-2, of_result=True)
TOOL_ACTIVE = Suspect("tool_active", chance=1e-2, of_result=True)
