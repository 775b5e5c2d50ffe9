"""A ball that a 3D sensor sees from poses of an arm, and what its calibration errs by."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.transforms import invert, log
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import pose_row

CAM = RigidTransform.from_components(
    [0.042, -0.061, 0.078], Rotation.from_rotvec([0.07, -0.02, 1.5])
)
REACH_M = (0.5, 0.0, 0.4), (0.7, 0.2, 0.6)
BALL_M = np.array([0.52, 0.13, 0.02])


def session_of(seed, mount, *, count=16, turns=(0.6, 0.6, 1.5), sigma_m=1e-4):
    """A ball that a camera sees from 16 poses, with noise of each coordinate."""
    rng, rows = np.random.default_rng(seed), []
    for view in range(count):
        turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * turns) * Rotation.from_rotvec(
            [3.1, 0, 0]
        )
        flange = RigidTransform.from_components(rng.uniform(*REACH_M), turn)
        seen = (flange * CAM).inv().apply(BALL_M)
        if mount == "eye-to-hand":
            seen = CAM.inv().apply(flange.apply(BALL_M - [0.5, 0.1, 0.0]))
        seen = seen + sigma_m * rng.standard_normal(3)
        row = {"view": str(view)} | {k: repr(v) for k, v in pose_row(flange.as_matrix()).items()}
        row |= dict(
            zip(("meas_x_m", "meas_y_m", "meas_z_m"), map(repr, map(float, seen)), strict=True)
        )
        rows.append(row)
    document = {
        "schema": 1,
        "name": "ball",
        "mount": mount,
        "cameras": {"top": {"model": "points"}},
    }
    cells = [[*row.values()] for row in rows]
    return Session.assemble(document, list(rows[0]), cells, MemoryImages({}))


def squared(result):
    """Squared error of the camera's transform over its covariance, by each of its six numbers."""
    edge = next(iter(result.edges.values()))
    error = log(invert(edge.matrix) @ CAM.as_matrix())
    return error @ np.linalg.solve(edge.covariance, error) / 6.0
