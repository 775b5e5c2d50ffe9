"""The robot's side of a session: declared stops, and poses against joint angles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import session_of

from visioncal.calibration.stages.reported_poses import reported_poses
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.robot import load_robot
from visioncal.session import View
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, simulate

CELL = simulate(CellOptions(views=8, seed=3))
ROBOT = load_robot(CELL.options.robot)
SIDEWAYS = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def session(poses=None, joints=None, stops=None):
    """A session of poses or joint angles or both, one row each."""
    views = []
    for at in range(len(CELL.robot.joints)):
        numbers = {}
        if poses is not None:
            turn = Rotation.from_matrix(poses[at][:3, :3]).as_quat()
            numbers |= dict(zip(POSE, [*poses[at][:3, 3], *turn], strict=True))
        if joints is not None:
            numbers |= {f"q{joint + 1}_rad": angle for joint, angle in enumerate(joints[at])}
        stop = None if stops is None else stops[at]
        views.append(View(at, image=f"{at}.png", stop=stop, numbers=numbers))
    return replace(session_of(CELL), views=tuple(views))


def in_pairs(values, step):
    """Rows in pairs: the second of each is the first, changed by a step."""
    return [step(values[at - 1]) if at % 2 else values[at] for at in range(len(values))]


@pytest.mark.parametrize(
    ("of_joints", "step", "words"),
    [
        (False, lambda pose: pose @ exp(5e-3 * SIDEWAYS), "5 mm and"),
        (False, lambda pose: pose @ exp(np.deg2rad([0.2, 0, 0, 0, 0, 0])), "0.2 deg apart"),
        (True, lambda angles: angles + 0.01 * np.eye(6)[5], "0.573 deg apart"),
    ],
)
def test_rows_of_one_stop_that_lie_apart_are_refused(of_joints, step, words):
    name, values = (
        ("joints", CELL.robot.joints) if of_joints else ("poses", CELL.robot.base_from_flange)
    )
    apart = session(**{name: in_pairs(values, step)}, stops=np.arange(8) // 2)
    with pytest.raises(DataError, match=r"rows of stop 0 \(views 0, 1\)") as caught:
        reported_poses(apart, ROBOT)
    assert words in caught.value.message
    assert caught.value.culprits == ("views.csv: view 0", "views.csv: view 1")
    assert "Remove the stop numbers" in caught.value.next_step


def test_rows_of_one_stop_may_be_read_anew():
    anew = in_pairs(CELL.robot.base_from_flange, lambda pose: pose @ exp(5e-4 * SIDEWAYS))
    assert len(reported_poses(session(anew, stops=np.arange(8) // 2), ROBOT).base_from_flange) == 8


def test_one_row_whose_pose_and_joints_disagree_is_named():
    poses = CELL.robot.base_from_flange.copy()
    poses[5] = poses[5] @ exp(0.3 * SIDEWAYS)
    (found,) = reported_poses(session(poses, CELL.robot.joints), ROBOT).warnings
    assert found.views == (5,)
    assert found.words.startswith(
        "Pose and joint angles disagree in view 5, by up to 300 mm and under 0.001 deg"
    )
