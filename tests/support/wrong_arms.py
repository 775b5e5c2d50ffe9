"""Arms that are not as stated, and how far off what they carry is all over the workspace."""

from dataclasses import replace

import numpy as np

from visioncal.core.transforms import exp, invert
from visioncal.robot.workspace import postures
from visioncal.simulation import CAMERAS, CellOptions, Payload
from visioncal.simulation.boards import centre_m, corners_m

GOOD = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1, robot="ur5e", views=30)
WRONG_LINKS = replace(GOOD, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
# A cobot's joints, from the base to the wrist [N m/rad].
COBOT = np.array([2e4, 1.6e4, 1.2e4, 8e3, 7e3, 6e3])
SAGGING = replace(
    WRONG_LINKS,
    robot="ur10e",
    views=40,
    branches=True,
    roll_rad=np.pi,
    compliance_rad_per_nm=tuple(1.0 / COBOT),
    target=replace(WRONG_LINKS.target, square_sigma_m=3e-7),
)
CARRIED = (Payload(), Payload(5.0, (0.0, 0.0, 0.1)), Payload(10.0, (0.02, 0.0, 0.1)))


def target_in_camera(mount, x, z, flange):
    """(m, 4, 4) where the camera has the target."""
    return invert(flange @ x) @ z if mount == "eye-in-hand" else invert(x) @ flange @ z


def told_frame(sheet):
    """(4, 4) the frame of a bent sheet as it is told: of the plane that fits its corners best."""
    x, y, z = corners_m(sheet).T
    (depth, by_x, by_y), *_ = np.linalg.lstsq(np.column_stack([np.ones_like(x), x, y]), z)
    return exp(np.array([by_y, -by_x, 0.0, 0.0, 0.0, depth]))


def error_m(cell, known, robot):
    """Root mean square error of what the arm carries, all over the workspace [m].

    `robot` may be an `ArmModel`, which bends under its own weight.
    """
    q = postures(getattr(robot, "nominal", robot))
    return away_m(cell, known.assessment.fit.state.edges, q, robot.base_from_flange(q))


def away_m(cell, edges, q, flanges):
    """The same, of (2, 4, 4) edges and of (m, 4, 4) flanges at (m, n) joints [m].

    Seen from what stands still: the camera's place seen from the target, or that of the target's
    middle seen from the camera.
    """
    mount = cell.options.mount
    true = target_in_camera(mount, *cell.transforms.values(), cell.robot.flange_at(q))
    true = true @ told_frame(cell.board())
    ours = target_in_camera(mount, *edges, flanges)
    if mount == "eye-in-hand":
        away = (invert(true) - invert(ours))[:, :3, 3]
    else:
        away = (true - ours)[:, :3] @ [*centre_m(cell.board()), 1.0]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
