"""Joint angles and models of robots that are mistaken: named, and sound ones left alone."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from support.fuzz.slips import (
    SLIPS,
    Identifiability,
    alarms,
    as_built,
    as_identified,
    in_the_world,
    is_named,
    with_stray_offset,
    with_tool,
)

from visioncal.calibration.guess.joints import guess_joints
from visioncal.calibration.stages.joints import match_joints
from visioncal.calibration.stages.reported_poses import reported_poses
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.robot import (
    load_robot,
    other_convention,
    table_document,
    with_base,
)
from visioncal.robot.conversion import table_of
from visioncal.simulation import CellOptions, fine_camera, simulate

OPTIONS = CellOptions(
    camera=fine_camera(),
    pixel_sigma_px=0.1,
    robot="ur5e",
    views=16,
    dh_sigma_m=5e-4,
    dh_sigma_rad=1e-3,
    seed=4,
)
CELLS = {name: simulate(replace(OPTIONS, mount=name)) for name in ("eye-in-hand", "eye-to-hand")}
IN_HAND = CELLS["eye-in-hand"]
TURN = np.array([0.2, -0.1, 0.4, 0.3, 0.1, -0.2])


def finished(told, **changes):
    """What is known at the end of the way."""
    return deque(told.known(**changes), maxlen=1).pop()


def planted(name, *, with_poses, seed=0):
    told = Identifiability.of(IN_HAND, with_poses=with_poses)
    return SLIPS[name](told, np.random.default_rng(seed))


# Beside poses, and where joints are all that there is; no camera tells how the base is turned, and
# exchanged rows are told by the rejection of views.
BESIDE_POSES = ("base_link for base", "two rows exchanged")


@pytest.mark.parametrize(
    ("name", "with_poses"),
    [(name, at % 2 == 0 or name in BESIDE_POSES) for at, name in enumerate(SLIPS)],
)
def test_slips_are_named(name, with_poses):
    mount = "eye-to-hand" if with_poses else "eye-in-hand"
    told = Identifiability.of(CELLS[mount], with_poses=with_poses)
    told = SLIPS[name](told, np.random.default_rng(int(with_poses)))
    assert is_named(told), told.said()


@pytest.mark.parametrize(
    "change", [as_built, as_identified, in_the_world, with_stray_offset, with_tool]
)
def test_sound_sessions_raise_no_alarm(change):
    told = change(Identifiability.of(IN_HAND, with_poses=True), np.random.default_rng(0))
    assert not alarms(told), told.said()


def test_joints_alone_that_are_misread_are_refused_with_the_fix():
    with pytest.raises(DataError, match="opposite sign, they fit") as caught:
        finished(planted("a joint's sign", with_poses=False))
    error = caught.value
    assert "not those of ur5e" in error.message
    (column,) = error.culprits
    assert column.startswith("views.csv: q")
    assert error.next_step.startswith(f"Negate {column.removeprefix('views.csv: ')}")


def test_with_poses_the_hand_eye_goes_on_without_misread_joints():
    told = planted("joints in degrees", with_poses=True)
    known = finished(told)
    assert known.reported.joints_rad is None
    assert known.robot_arm.kinematics is None
    assert known.verdict.status != "good"
    assert any("pi / 180" in reason for reason in known.verdict.reasons)
    alone = finished(replace(told, robot=None))
    # What is done with the poses is what would be done if there were no joints.
    assert np.array_equal(known.assessment.state.edges[0], alone.assessment.state.edges[0])


def test_an_arm_asked_for_is_refused_where_its_joints_are_misread():
    with pytest.raises(DataError, match="needs the joint angles") as caught:
        finished(planted("joints in degrees", with_poses=True), level="kinematics")
    assert "multiply q1_rad to q6_rad by pi / 180" in caught.value.next_step


def test_rows_without_poses_are_not_taken_by_misread_joints():
    session = planted("joints in degrees", with_poses=True).session
    views = list(session.views)
    joints = {name: number for name, number in views[3].numbers.items() if name.endswith("_rad")}
    views[3] = replace(views[3], numbers=joints)
    reported = reported_poses(replace(session, views=tuple(views)), load_robot("ur5e"))
    (rejection,) = reported.rejections
    assert rejection.view == 3
    assert "joint angles are misread" in rejection.reason


def test_degrees_are_known_by_their_fit_and_not_by_their_size():
    # A table whose zeros are where the arm works: all angles are within a few degrees.
    middle = IN_HAND.robot.joints.mean(axis=0)
    zeros = np.pad(middle[:, None], ((0, 0), (0, 3)))
    robot = load_robot("ur5e").corrected(functions=zeros)
    near = 0.1 * (IN_HAND.robot.joints - middle)
    poses = robot.base_from_flange(near)
    assert np.abs(np.rad2deg(near)).max() < 13.0
    assert not guess_joints(robot, near, poses).stands_out
    guess = guess_joints(robot, np.rad2deg(near), poses)
    assert guess.best.reading.words == "the angles in degrees"


def test_two_turns_are_no_degrees():
    # Joints of many arms turn by two turns either way.
    robot = load_robot("ur5e")
    q = IN_HAND.robot.joints + 2.0 * np.pi * np.where(IN_HAND.robot.joints > 0.0, -1.0, 1.0)
    assert not guess_joints(robot, q, robot.base_from_flange(q)).stands_out


def test_poses_that_turn_about_one_axis_accuse_nobody():
    robot = load_robot("ur5e")
    q = np.tile(IN_HAND.robot.joints[0], (12, 1))
    q[:, 5] += np.linspace(-1.0, 1.0, 12)
    assert not guess_joints(robot, q * [1, 1, -1, 1, 1, -1], robot.base_from_flange(q)).stands_out


def test_readings_that_no_row_tells_apart_are_all_named():
    robot = load_robot("ur5e")
    q = IN_HAND.robot.joints.copy()
    # These two never move, and stand alike: exchanged with a third they are the same.
    q[:, 1] = q[:, 4] = -1.2
    guess = guess_joints(robot, q[:, [0, 2, 1, 3, 4, 5]], robot.base_from_flange(q))
    assert guess.stands_out
    assert "q2_rad and q3_rad exchanged" in guess.sentence("the reported poses")


def test_a_lost_encoder_is_named_and_estimated_with_the_arm():
    told = Identifiability.of(IN_HAND, with_poses=True)
    joints = told.joints - np.deg2rad([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])
    poses = load_robot("ur5e").base_from_flange(joints)
    known = finished(replace(told, joints=joints, poses=poses))
    nominal, found = known.robot_arm.kinematics.result.levels
    assert nominal.held_out_mm > 10.0
    assert found.held_out_mm < 0.5
    assert known.verdict.status == "check"
    assert known.verdict.causes[0].kind == "misread_joints"
    assert known.verdict.causes[0].do.words.startswith("Home elbow_joint anew")
    # What is seen of the target hardly depends on whose errors the last tenths of a degree are.
    found = known.robot_arm.model.robot.base_from_flange(joints)
    true = IN_HAND.robot.true_base_from_flange
    moved, moves = invert(found[:-1]) @ found[1:], invert(true[:-1]) @ true[1:]
    away = np.linalg.norm((moved - moves)[:, :3, 3], axis=1)
    assert np.median(away) < 1e-3


def test_zeros_that_differ_between_poses_and_joints_are_named():
    told = Identifiability.of(IN_HAND, with_poses=True)
    off = np.deg2rad([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])
    session = replace(told, joints=told.joints - off).session
    matched = match_joints(session.views, load_robot("ur5e"))
    assert matched.joints_rad == {}
    assert "moved by 10.00 deg" in matched.warnings[0].reason
    assert "Home elbow_joint anew, or add 10.00 deg to q3_rad" in matched.warnings[0].reason


def test_one_row_of_wrong_joints_costs_its_view_alone():
    told = Identifiability.of(IN_HAND, with_poses=True)
    joints = told.joints.copy()
    joints[5, 1] += 0.3
    known = finished(replace(told, joints=joints))
    assert known.reported.joints_rad.keys() == set(range(16)) - {5}
    assert known.robot_arm.kinematics.level == "geometry"
    assert known.reasons[5].endswith("with which the camera agrees")


@pytest.mark.parametrize("as_chain", [False, True])
def test_arms_move_with_their_base(as_chain):
    robot = load_robot("ur5e")
    if as_chain:
        robot = robot.corrected()
    base = exp(TURN)
    q = IN_HAND.robot.joints
    assert with_base(robot, base).base_from_flange(q) == pytest.approx(
        base @ robot.base_from_flange(q), abs=1e-12
    )


def test_the_other_convention_of_a_table_is_the_arm_that_was_meant():
    # A modified table that is declared standard: read as modified it is the right arm again.
    robot = load_robot("ur5e")
    document = table_document(table_of(robot, "modified")) | {"convention": "standard"}
    other, convention = other_convention(type(robot).from_document(document))
    assert convention == "modified"
    guess = guess_joints(other, IN_HAND.robot.joints, robot.base_from_flange(IN_HAND.robot.joints))
    assert guess.declared.score < 1e-3
