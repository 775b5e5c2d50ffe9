"""Sessions of one tag a view: poses by its four corners, as a detector writes them."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import pairs_session
from support.marks import slow
from support.misfits import misfit

import visioncal
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import MOUNTS

_LENS = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
_CORNERS = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def tags(seed, mount, *, views=25, side_m=0.05, far_m=(0.35, 0.8), arm=(2e-4, 1e-4)):
    """A session of a tag's poses by OpenCV, from corners with 0.3 px of noise; and the truth.

    `arm` is the noise of the robot's poses [rad, m]. Tags nearly frontal have the other of two
    solutions now and then.
    """
    rng = np.random.default_rng([seed, 7])
    x = exp(np.r_[rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.06, 3)])
    z = exp(np.r_[rng.normal(0.0, 0.3, 3), [0.5, 0.1, 0.0]])
    points, robot, seen = side_m / 2.0 * _CORNERS, [], []
    while len(seen) < views:
        away, tilt = rng.uniform([far_m[0], 0.0], [far_m[1], 0.7])
        about, roll = rng.uniform(-np.pi, np.pi, 2)
        tilted = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        turn = tilted * Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec([0, 0, roll])
        place = away * np.array([*rng.uniform([-0.4, -0.25], [0.4, 0.25]), 1.0])
        camera = compose(turn.as_matrix(), place)
        px = (points @ camera[:3, :3].T + place) @ _LENS.T
        px = px[:, :2] / px[:, 2:] + rng.normal(0.0, 0.3, (4, 2))
        _, turned, placed, _ = cv2.solvePnPGeneric(
            points, px[:, None], _LENS, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        seen.append(compose(cv2.Rodrigues(turned[0])[0], placed[0][:, 0]))
        pose = z @ invert(camera) @ invert(x) if mount == MOUNTS[0] else x @ camera @ z
        robot.append(pose @ exp(rng.normal(size=6) * np.repeat(arm, 3)))
    name = "flange_from_cam" if mount == MOUNTS[0] else "base_from_cam"
    return pairs_session(mount, np.array(robot), np.array(seen)), name, x


@pytest.mark.slow
def test_how_well_the_scale_of_measured_poses_is_known_may_be_stated():
    """Distances that are too long by half a percent, to a tag in the hand."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 11])
        x, z = exp(np.array([2.2, 0.3, 0.2, 0.9, -0.2, 1.0])), exp(rng.normal(0.0, 0.1, 6))
        low, high = [-0.5, -0.5, -1.5, -0.1, -0.1, 0.7], [0.5, 0.5, 1.5, 0.1, 0.1, 0.9]
        poses = rng.uniform(low, high, (14, 6))
        seen = compose(exp(np.pad(poses[:, :3], ((0, 0), (0, 3))))[:, :3, :3], poses[:, 3:])
        robot = x @ seen @ invert(z)
        seen = seen @ exp(rng.normal(size=(14, 6)) * np.repeat([3e-3, 3e-4], 3))
        seen[:, :3, 3] *= 1.005
        session = pairs_session("eye-to-hand", robot, seen)
        camera = {"camera": {"scale_sigma": 0.01}}
        session = session.with_content(document={**session.document, **camera})
        found.append(misfit(visioncal.calibrate(session).edges["base_from_cam"], x))
    # Ten times as much where the scale is taken for known.
    assert sum(found) < chi2_limit(1e-3, 6 * len(found))


KINDS = [{}, {"far_m": (0.7, 1.3), "views": 40}, {"arm": (3e-3, 1e-3)}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "how"), [(2, KINDS[0]), *(slow(16, how) for how in KINDS)], ids=str
)
@pytest.mark.parametrize("mount", MOUNTS)
def test_the_covariance_of_single_tags_holds(mount, count, how):
    """Tilt and distance of a tag are ten times less sure than what is across the sight."""
    found = []
    for seed in range(count):
        session, name, truth = tags(seed, mount, **how)
        edge = visioncal.calibrate(session).edges[name]
        found.append(misfit(edge, truth))
    freedom = 6 * count
    assert chi2_limit(1e-3, freedom) > sum(found) > freedom / 4.0
    if count == 16:
        assert 0.5 < np.mean(found) / 6.0 < 2.0
