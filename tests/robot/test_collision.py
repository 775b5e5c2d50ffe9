"""Distances of the arm against plain geometry, and ways without a gap between samples."""

import numpy as np
import pytest
from support.apart import UR5E_PAIRS, clearances, corners
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp
from visioncal.robot import Robot, load_robot
from visioncal.robot.collision import Body, Collisions, arm_bodies, capsule
from visioncal.robot.files import read_robot_document
from visioncal.simulation.arms import arm_named

POST = compose(np.eye(3), np.array([0.45, 0.1, 0.3]))
POST_SIZE = np.array([0.1, 0.15, 0.6])
CLEARANCE = 0.03


def ur5e_with_post(clearance_m=CLEARANCE):
    robot = load_robot("ur5e")
    post = Body("post", 0, "box", POST_SIZE, POST)
    return Collisions(robot, [*arm_bodies(robot), post], clearance_m, 0.0)


def random_joints(count, seed=0):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 6))


def test_the_distances_are_those_of_plain_geometry():
    cell, q = ur5e_with_post(), random_joints(60)
    found = np.array([cell.distances(value).min() for value in q])
    plain = clearances(arm_named("ur5e"), q, 0.0, [(POST, POST_SIZE)])
    # Where bodies overlap the two count differently how far; golden sections end at 2e-7.
    free = found > 0.0
    assert free.sum() > 10
    np.testing.assert_allclose(found[free], plain[free], atol=1e-6)
    assert np.all(plain[~free] <= 1e-6)


def test_contacts_are_what_is_nearer_than_the_clearance():
    cell, q = ur5e_with_post(), random_joints(400, 1)
    contact = cell.first_contact(q)
    lacking = np.array([cell.distances(value) for value in q]) - CLEARANCE
    clear = contact < 0
    assert 20 < clear.sum() < 380
    # Stops keep a few millimetres more, for the ways to and from them.
    assert lacking[clear].min() > 0.003
    named = lacking[~clear, contact[~clear]]
    assert np.all(named < 0.005)


def test_a_clear_way_is_clear_between_all_samples():
    cell, q = ur5e_with_post(), random_joints(300, 2)
    stops = q[cell.first_contact(q) < 0]
    starts, ends = stops[:24], stops[1:25]
    shares = np.linspace(0.0, 1.0, 150)[:, None, None]
    joints = (starts + shares * (ends - starts)).reshape(-1, 6)
    apart = clearances(arm_named("ur5e"), joints, 0.0, [(POST, POST_SIZE)]).reshape(150, -1)
    least = apart.min(axis=0)
    clear = np.array([cell.path_contact(*pair) < 0 for pair in zip(starts, ends, strict=True)])
    assert 3 < clear.sum() < 23
    assert least[clear].min() > CLEARANCE
    # At worst a way is given up that keeps the clearance by less than half the slack.
    assert least[~clear].max() < CLEARANCE + 0.0021


def test_a_thin_wall_between_two_postures_is_not_jumped_over():
    robot = load_robot("ur5e")
    start, end = np.array([0.6, -1.0, 1.0, -1.5, -1.5, 0.0]), np.array([-0.6, -1, 1, -1.5, -1.5, 0])
    place = compose(np.eye(3), np.array([-0.55, 0, 0.31]))
    wall = Body("wall", 0, "box", np.array([0.4, 0.001, 0.6]), place)
    free = Collisions(robot, arm_bodies(robot), 0.0, 0.0)
    walled = Collisions(robot, [*arm_bodies(robot), wall], 0.0, 0.0)
    assert np.all(walled.first_contact(np.array([start, end])) < 0)
    assert free.path_contact(start, end) == -1
    assert "wall" in walled.names[walled.path_contact(start, end)]


def test_bodies_left_out_are_named_with_their_reason():
    cell = ur5e_with_post()
    left = {(left_out.first, left_out.second): left_out.reason for left_out in cell.left_out}
    assert ("floor", "link shoulder_pan_joint") in left
    assert "100 %" in left["link wrist_1_joint", "link wrist_3_joint"]
    joints = load_robot("ur5e").joint_names
    kept = {frozenset(name) for name in cell.names}
    for a, b in UR5E_PAIRS:
        assert frozenset({f"link {joints[a]}", f"link {joints[b]}"}) in kept


def test_a_body_of_guessed_size_is_kept_farther_away_but_from_the_arm_that_carries_it():
    robot = load_robot("ur5e")
    flange = robot.chain.placements[-1][:3, 3]
    plug = capsule("plug", 6, flange, flange + np.array([0, 0, 0.1]), 0.01, unsure_m=0.05)
    post = Body("post", 0, "box", POST_SIZE, POST, uncertainty_m=0.04)
    cell = Collisions(robot, [*arm_bodies(robot), plug, post], CLEARANCE, 0.0)
    needed = dict(zip(map(frozenset, cell.names), cell.needed_m(), strict=True))
    assert needed[frozenset({"plug", "post"})] == pytest.approx(CLEARANCE + np.hypot(0.04, 0.05))
    assert needed[frozenset({"plug", "floor"})] == pytest.approx(CLEARANCE + 0.05)
    assert needed[frozenset({"plug", "link shoulder_lift_joint"})] == CLEARANCE


def test_a_body_in_millimetres_is_refused():
    document = read_robot_document("ur5e")
    document["joint"][1]["body_radius_m"] = 60.0
    raised(DataError, r"body_radius_m = 60\.0", arm_bodies, Robot.from_document(document))


URDF = """<robot name="r"><link name="base"><collision><origin xyz="0 0 0.05"/>
<geometry><box size="0.1 0.2 0.1"/></geometry></collision></link>
<link name="a"><collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.05" length="0.4"/>
</geometry></collision></link>
<link name="b"><collision><geometry><mesh filename="package://r/b.stl"/></geometry></collision>
<collision><geometry><sphere radius="0.08"/></geometry></collision></link><link name="tool0"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/><origin xyz="0 0 0.1"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/><origin xyz="0 0 0.4"/></joint>
<joint name="fixed" type="fixed"><parent link="b"/><child link="tool0"/><origin xyz="0 0 0.3"/>
</joint></robot>"""


def test_the_simple_bodies_of_a_urdf_are_taken_and_links_of_meshes_are_capsules():
    robot = Robot.from_document({"schema": 1, "name": "r", "tip": "tool0", "urdf": URDF})
    bodies = arm_bodies(robot)
    assert [(body.link, body.shape) for body in bodies] == [
        (0, "box"),
        (1, "cylinder"),
        (2, "capsule"),
        (2, "capsule"),
    ]
    np.testing.assert_allclose(bodies[0].size_m, [0.1, 0.2, 0.1])
    np.testing.assert_allclose(bodies[1].size_m, [0.05, 0.4])
    # The sphere as it is given, and a capsule to the tip for the mesh.
    assert sorted(body.size_m[1] for body in bodies[2:]) == pytest.approx([0.0, 0.3])


def test_a_body_is_where_its_link_is():
    """A box that the tool carries, against its own corners at random postures."""
    robot, q = load_robot("ur5e"), random_joints(50, 5)
    size, pose = np.array([0.2, 0.1, 0.05]), exp(np.array([0.3, -0.2, 0.5, 0.05, 0.02, 0.1]))
    flange = robot.chain.placements[-1]
    box = Body("box", 6, "box", size, flange @ pose)
    cell = Collisions(robot, [box], 0.0, -2.0)
    heights = corners(robot.base_from_flange(q) @ pose, size)[..., 2].min(axis=1) + 2.0
    found = np.array([cell.distances(value)[0] for value in q])
    np.testing.assert_allclose(found, heights, atol=1e-9)
