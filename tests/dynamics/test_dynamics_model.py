"""The torques of an arm, the parameters that they tell, and what follows from these."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.kept import kept_session

from visioncal.core.errors import DataError
from visioncal.dynamics import (
    ArmDynamics,
    BaseModel,
    DynamicModel,
    Friction,
    FrictionTerms,
    JointMotion,
)
from visioncal.robot import (
    Inertias,
    Loads,
    Robot,
    body_regressor,
    joint_torques,
    load_robot,
    parameters_of,
    pseudo_inertias,
    read_robot_document,
    robot_names,
    torque_regressor,
)
from visioncal.robot.torques import model_with_inertias
from visioncal.robot.writing import small_urdf, urdf_with_inertias, with_inertias

# Sums of some hundred products of numbers about 1 to 100 [N m].
ROUNDING = 1e-10
NO_FRICTION = FrictionTerms(coulomb=False, viscous=False, offset=False)
WEIGHED = [name for name in robot_names() if load_robot(name).inertias is not None]


def states(robot, count=20, seed=0):
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (3, count, robot.joint_count))


def motion_of(robot, count=20, seed=0):
    return JointMotion(np.arange(count) * 0.01, *states(robot, count, seed))


def eccentric(name):
    functions = np.zeros((load_robot(name).joint_count, 4))
    functions[:, 1:] = [0.01, 0.02, 0.03]
    return load_robot(name).corrected(functions=functions)


@pytest.mark.parametrize("name", WEIGHED)
def test_torques_are_those_of_newton_and_euler(name):
    import pinocchio as pin

    robot = load_robot(name)
    model = model_with_inertias(robot, robot.inertias)
    data = model.createData()
    wanted = [pin.rnea(model, data, *row) for row in zip(*states(robot), strict=True)]
    found = joint_torques(robot, robot.inertias, *states(robot))
    assert found == pytest.approx(np.array(wanted), abs=ROUNDING)
    by_regressor = torque_regressor(robot, *states(robot)) @ robot.inertias.values.ravel()
    assert by_regressor == pytest.approx(found, abs=ROUNDING)


def test_encoders_may_be_eccentric():
    """The power of the drives is what the kinetic and the potential energy change by."""
    robot = eccentric("ur5e")
    slow = np.array([0.3, -1.1, 0.8, -0.4, 0.9, 0.2])

    def course(t):
        angle, speed = slow * np.sin(3.0 * t), 3.0 * slow * np.cos(3.0 * t)
        return angle[None], speed[None], (-9.0 * angle)[None]

    def energy(t):
        q, dq, _ = course(t)
        speeds = robot.chain.jacobian(q) * dq
        still = np.zeros_like(q)
        momentum = joint_torques(robot, robot.inertias, q, still, dq)
        momentum -= joint_torques(robot, robot.inertias, q, still, still)
        frames = robot.link_frames(q[0])[:-1]
        masses = robot.masses
        centres = np.einsum("nij,nj->ni", frames[:, :3, :3], masses.centres_m) + frames[:, :3, 3]
        return 0.5 * speeds[0] @ momentum[0] - masses.kg @ centres @ robot.gravity

    q, dq, ddq = course(0.7)
    torques = joint_torques(robot, robot.inertias, q, dq, ddq)
    power = float(torques[0] @ (robot.chain.jacobian(q) * dq)[0])
    # A central difference of some hundred watts; its third derivative is some 1e4 W/s^2.
    changed = (energy(0.7 + 1e-5) - energy(0.7 - 1e-5)) / 2e-5
    assert changed == pytest.approx(power, rel=1e-6)


def test_a_body_on_the_flange_is_a_part_of_the_last_link():
    robot = load_robot("ur10e")
    body = Inertias.of_bodies(
        np.array([2.8]), np.array([[0.02, -0.05, 0.11]]), np.diag([0.02, 0.03, 0.01])[None]
    ).values[0]
    bare = ArmDynamics(robot, robot.inertias, Friction.none(6))
    more = bare.carrying(body).torques(*states(robot)) - bare.torques(*states(robot))
    assert more == pytest.approx(body_regressor(robot, *states(robot)) @ body, abs=ROUNDING)
    # At rest it weighs what the elastic level says of a payload.
    q = states(robot)[0]
    held = robot.load_torques(q, Loads.alike(len(q), 2.8, (0.02, -0.05, 0.11), (0, 0, 0)))
    assert bare.carrying(body).gravity(q) == pytest.approx(-held, abs=ROUNDING)


def test_a_pseudo_inertia_says_the_same():
    values = load_robot("panda").inertias.values
    assert parameters_of(pseudo_inertias(values)) == pytest.approx(values, abs=1e-12)
    assert load_robot("panda").inertias.consistent
    values = values.copy()
    values[3, 4] *= 3.0
    assert not Inertias(values).consistent


@pytest.mark.parametrize(
    ("name", "inertial", "all_of_it"),
    [("ur5e", 36, 54), ("ur10e", 36, 54), ("panda", 43, 64), ("irb120", 36, 54)],
)
def test_so_many_parameters_can_be_told(name, inertial, all_of_it):
    robot = load_robot(name)
    assert BaseModel.reduce(DynamicModel(robot, NO_FRICTION)).rank == inertial
    for seed in range(3):
        rng = np.random.default_rng(seed)
        base = BaseModel.reduce(DynamicModel(robot, FrictionTerms()), rng)
        assert base.rank == all_of_it == len(base.names)


@pytest.mark.parametrize("name", ["ur5e", "panda", "generic-6r-1800"])
def test_base_parameters_tell_all_torques(name):
    robot = load_robot(name)
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms(motor_inertia=True)))
    standard = np.random.default_rng(3).standard_normal(len(base.model.names))
    motion = motion_of(robot, seed=5)
    wanted = base.model.regressor(motion) @ standard
    # Random parameters and states: torques of some ten to hundred.
    assert base.regressor(motion) @ base.of(standard) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("name", ["ur5e", "panda"])
def test_names_say_what_base_parameters_are(name):
    base = BaseModel.reduce(DynamicModel(load_robot(name), FrictionTerms(motor_inertia=True)))
    standard = np.random.default_rng(4).uniform(1.0, 2.0, len(base.model.names))
    # Products are parameters of their own: m3*cx3 is a first moment.
    known = {word.replace("*", "_"): v for word, v in zip(base.model.names, standard, strict=True)}
    products = sorted((word for word in base.model.names if "*" in word), key=len, reverse=True)
    for text, value in zip(base.names, base.of(standard), strict=True):
        plain = text
        for product in products:
            plain = plain.replace(product, product.replace("*", "_"))
        # Coefficients are printed to four digits, and some ten of them add up.
        assert eval(plain, {}, known) == pytest.approx(value, abs=2e-3), text


def test_base_parameters_are_those_that_are_kept():
    model = DynamicModel(load_robot("ur10e"), FrictionTerms())
    base = BaseModel.reduce(model)
    again = BaseModel.keeping(model, base.independent)
    assert again.names == base.names
    # Other states may choose other columns; those of the first go with them as well.
    other = BaseModel.reduce(model, np.random.default_rng(8))
    standard = np.random.default_rng(3).standard_normal(len(model.names))
    motion = motion_of(model.robot, seed=6)
    wanted = other.regressor(motion) @ other.of(standard)
    assert again.regressor(motion) @ again.of(standard) == pytest.approx(wanted, abs=1e-8)
    for wrong in (base.independent[1:], np.append(base.independent, len(model.names) - 1)):
        with pytest.raises(DataError, match="are no base parameters of it"):
            BaseModel.keeping(model, wrong)


def test_friction_acts_on_its_own_joint():
    robot = load_robot("ur5e")
    terms = FrictionTerms(motor_inertia=True)
    motion = motion_of(robot)
    values = np.random.default_rng(0).uniform(1.0, 2.0, (6, 4))
    coulomb, viscous, offset, rotor = values.T
    friction = Friction(coulomb, viscous, offset, rotor, np.zeros(6), np.ones(6))
    assert terms.names(2) == ("Fc1", "Fv1", "offset1", "Ia1", "Fc2", "Fv2", "offset2", "Ia2")
    by_columns = terms.columns(motion) @ values.ravel()
    assert by_columns == pytest.approx(friction.torques(motion.dq, motion.ddq), abs=1e-12)
    stuck = replace(friction, breaking=0.5 * coulomb, breaking_rad_s=np.full(6, 0.03))
    more = stuck.torques(np.full((1, 6), 0.03), np.zeros((1, 6)))
    less = friction.torques(np.full((1, 6), 0.03), np.zeros((1, 6)))
    assert more - less == pytest.approx(0.5 * coulomb[None] * np.exp(-1.0))


@pytest.mark.parametrize("name", ["ur10e", "panda"])
def test_an_arm_with_other_inertias_is_written_and_read(name):
    robot = load_robot(name)
    heavier = Inertias(1.1 * robot.inertias.values)
    for arm in (robot, robot.corrected(), Robot.from_document(urdf_of(robot))):
        weighed = with_inertias(arm, heavier)
        again = Robot.from_document(json.loads(json.dumps(dict(weighed.document))))
        assert again.inertias.values == pytest.approx(heavier.values, abs=1e-12)
        q = states(robot)[0]
        held = ArmDynamics(robot, heavier, Friction.none(robot.joint_count)).gravity(q)
        assert again.load_torques(q) == pytest.approx(-held, abs=ROUNDING)
        assert again.base_from_flange(q) == pytest.approx(robot.base_from_flange(q), abs=1e-12)


def urdf_of(robot):
    return {"schema": 1, "name": robot.name, "tip": robot.tip, "urdf": small_urdf(robot)}


def test_drives_have_limits():
    robot = load_robot("ur5e")
    assert robot.torque_nm.tolist() == [150.0, 150.0, 150.0, 28.0, 28.0, 28.0]
    assert np.rad2deg(robot.velocity_rad_s) == pytest.approx([180.0] * 6)
    assert np.isinf(load_robot("irb120").torque_nm).all()
    # A calibrated arm keeps them.
    assert robot.corrected().rates.torque.tolist() == robot.rates.torque.tolist()
    wrong = read_robot_document("ur5e")
    wrong["joint"][1]["torque_nm"] = -150.0
    with pytest.raises(DataError, match=r"joint shoulder_lift_joint: torque_nm is -150.0"):
        Robot.from_document(wrong)


def test_what_an_arm_weighs_is_no_fact_of_a_recording():
    """A session's digest stays what it was before its robot's table told inertias and drives."""
    told = read_robot_document("panda")
    # The table as it was, in its own words.
    geometry = {"name", "a_m", "alpha_rad", "d_m", "theta_offset_rad", "lower_deg", "upper_deg"}
    bare = [{key: value for key, value in row.items() if key in geometry} for row in told["joint"]]
    assert bare != told["joint"]
    session = kept_session()
    digests = [
        replace(session, robot_document=told | {"joint": rows}).digest()
        for rows in (told["joint"], bare, bare[:-1])
    ]
    assert digests[0] == digests[1] != digests[2]


def test_a_urdf_gets_the_inertias_and_keeps_the_rest():
    robot = Robot.from_document(urdf_of(load_robot("ur5e")))
    text = robot.document["urdf"]
    # Something fixed to a link moves with it, and a gripper's finger is locked.
    more = (
        '<link name="box"><inertial><mass value="2.0"/><inertia ixx="0.01" ixy="0" ixz="0" '
        'iyy="0.01" iyz="0" izz="0.01"/></inertial><visual/></link><link name="finger"/>'
        '<joint name="on" type="fixed"><parent link="link_3"/><child link="box"/></joint>'
        '<joint name="grip" type="prismatic"><parent link="box"/><child link="finger"/>'
        '<limit lower="0" upper="1" effort="0" velocity="0"/></joint></robot>'
    )
    given = dict(robot.document) | {"urdf": text.replace("</robot>", more)}
    heavy = Robot.from_document(given)
    assert heavy.masses.kg[2] == pytest.approx(robot.masses.kg[2] + 2.0)
    found = Inertias(1.2 * heavy.inertias.values)
    written = urdf_with_inertias(heavy, found, ["identified -- yesterday"])
    again = Robot.from_document(given | {"urdf": written})
    assert again.inertias.values == pytest.approx(found.values, abs=1e-12)
    assert again.base_from_flange(states(robot)[0]) == pytest.approx(
        robot.base_from_flange(states(robot)[0]), abs=1e-12
    )
    assert "<visual />" in written
    assert "<!-- identified - - yesterday -->" in written
    with pytest.raises(DataError, match="a robot of a URDF is needed"):
        urdf_with_inertias(load_robot("ur5e"), found)


def test_a_link_of_one_tag_gets_its_inertia_inside():
    robot = Robot.from_document(urdf_of(load_robot("ur5e")))
    whole = str(robot.document["urdf"])
    text = re.sub(r'<link name="link_2">.*?</link>', '<link name="link_2"/>', whole, flags=re.S)
    assert text != whole
    written = urdf_with_inertias(
        Robot.from_document(robot.document | {"urdf": text}), robot.inertias
    )
    again = Robot.from_document(robot.document | {"urdf": written})
    assert again.inertias.values == pytest.approx(robot.inertias.values, abs=1e-12)
