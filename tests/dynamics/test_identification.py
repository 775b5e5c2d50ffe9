"""Torques and the parameters that they tell: the regression, simulated arms, and a real one."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.kept import kept_session
from support.moved_arms import recorded, robot_with_bodies, true_base
from support.refusals import raised

from visioncal.core.errors import DataError, DegenerateError
from visioncal.dynamics import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import condition
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.identify import SLOW_RAD_S, Options, identify, predict, validate
from visioncal.dynamics.model import DynamicModel, Friction, FrictionTerms, JointMotion
from visioncal.dynamics.reading import RecordedSamples
from visioncal.dynamics.regression import NoiseBlock, regress
from visioncal.robot import Robot, load_robot
from visioncal.robot.files import read_robot_document, robot_names
from visioncal.robot.inertia import Inertias
from visioncal.robot.torques import joint_torques, torque_regressor
from visioncal.robot.writing import small_urdf, urdf_with_inertias, with_inertias
from visioncal.simulation.dynamics import (
    drive_torques,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    slow_sweep,
)

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
    model, masses = robot.pinocchio_model.copy(), robot.inertias.masses
    model.gravity.linear = robot.gravity
    bodies = zip(masses.kg, masses.centres_m, robot.inertias.about_centres, strict=True)
    for joint, body in enumerate(bodies, start=1):
        model.inertias[joint] = pin.Inertia(*body)
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
        frames = robot.link_frames(q)[0, :-1]
        masses = robot.masses
        centres = np.einsum("nij,nj->ni", frames[:, :3, :3], masses.centres_m) + frames[:, :3, 3]
        return 0.5 * speeds[0] @ momentum[0] - masses.kg @ centres @ robot.gravity

    q, dq, ddq = course(0.7)
    torques = joint_torques(robot, robot.inertias, q, dq, ddq)
    power = float(torques[0] @ (robot.chain.jacobian(q) * dq)[0])
    # A central difference of some hundred watts; its third derivative is some 1e4 W/s^2.
    changed = (energy(0.7 + 1e-5) - energy(0.7 - 1e-5)) / 2e-5
    assert changed == pytest.approx(power, rel=1e-6)


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
    raised(DataError, "a robot of a URDF is needed", urdf_with_inertias, load_robot("ur5e"), found)


TRUE = np.array([2.0, -1.0, 0.5])
SIGMAS = np.array([0.1, 1.0])
NONE = np.zeros(0)


def block(seed, count=400, taps=(1.0,)):
    """Slow columns, which correlated noise hurts, for two joints of different noise."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    angle = 0.05 * np.arange(count)[:, None, None] * np.array([0.3, 0.7, 1.1]) + phase
    x = np.sin(angle)
    weights = np.array(taps) / np.linalg.norm(taps)
    white = rng.standard_normal((count + len(taps) - 1, 2))
    noise = np.apply_along_axis(np.convolve, 0, white, weights, "valid")
    return NoiseBlock(x, x @ TRUE + SIGMAS * noise, np.ones((count, 2), dtype=bool), NONE)


def chi2(fit):
    away = fit.values - TRUE
    return float(away @ np.linalg.solve(fit.covariance, away))


@pytest.mark.parametrize("taps", [(1.0,), (1.0, 1.0, 1.0, 1.0)])
def test_the_covariance_counts_white_and_correlated_noise(taps):
    found = np.mean([chi2(regress([block(seed, taps=taps)])) for seed in range(60)])
    # The mean of 60 draws of chi-square of 3 degrees of freedom is known to 0.32; covariances that
    # took four equal neighbours for four samples would make it 12.
    assert found == pytest.approx(3.0, abs=1.2)


def test_each_joint_gets_the_weight_of_its_noise():
    fit = regress([block(1, 2000)])
    # The standard deviation of 2000 draws is known to 1.6 %.
    assert fit.sigmas[0] == pytest.approx(SIGMAS, rel=0.06)
    (only,), (left,), (sigma,) = fit.blocks, fit.residuals, fit.sigmas
    assert np.sum((only.used * left / sigma) ** 2) == pytest.approx(4000.0, rel=0.06)


def test_blocks_have_noise_of_their_own():
    quiet, loud = block(2, 1000), block(3, 1000)
    loud = replace(loud, y=loud.x @ TRUE + 10.0 * (loud.y - loud.x @ TRUE))
    fit = regress([quiet, loud])
    assert fit.sigmas[1] / fit.sigmas[0] == pytest.approx([10.0, 10.0], rel=0.1)


def test_outliers_are_left_out():
    wrong = block(4)
    y = wrong.y.copy()
    y[[10, 100], 0] += 5.0
    y[50:60, 1] -= 30.0
    fit = regress([replace(wrong, y=y)])
    used = fit.blocks[0].used
    assert not used[[10, 100], 0].any()
    assert not used[50:60, 1].any()
    assert used.mean() > 0.97
    assert chi2(fit) < 16.3  # chance exceeds it once in a thousand


def test_unused_rows_count_for_nothing():
    whole = block(5)
    used = whole.used.copy()
    used[200:] = False
    y = whole.y.copy()
    y[200:] = 1e6
    half = regress([NoiseBlock(whole.x[:200], whole.y[:200], whole.used[:200], NONE)])
    fit = regress([replace(whole, y=y, used=used)])
    assert fit.values == pytest.approx(half.values, rel=1e-12)
    assert np.diag(fit.covariance) == pytest.approx(np.diag(half.covariance), rel=1e-9)


PANDA = Path(__file__).parents[3] / "shared" / "data" / "dyn_franka_panda"
TERMS = FrictionTerms(motor_inertia=True, slow_rad_s=SLOW_RAD_S)
PLAIN = Options(terms=TERMS, stribeck=False)


def known_arm(name="ur5e"):
    """The arm as its maker publishes it, which real ones are off from by a fifth."""
    return robot_with_bodies(nominal_dynamics(name))


@pytest.fixture(scope="module")
def worlds():
    """Four arms, each with what its first motion tells and a second motion."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        built = real_dynamics("ur5e", rng)
        first = recorded(built, multi_sine(6, rng), rng)
        fresh = multi_sine(6, rng)
        found.append((built, identify(known_arm(), [first], PLAIN), fresh, rng))
    return found


def test_parameters_are_within_their_sigmas(worlds):
    shares = []
    for built, found, _, _ in worlds:
        result = found.identified
        away = result.values - true_base(result.base, built)
        shares.append(away @ np.linalg.solve(result.covariance, away) / len(away))
    # Chi-square of 58 over its degrees of freedom has a standard deviation of 0.19, the mean of
    # four one of 0.1; that noise is estimated, too, adds 0.03. Sigmas off by a fifth would show.
    assert np.mean(shares) == pytest.approx(1.03, abs=0.3)
    assert max(shares) < 1.9


def test_torques_of_another_motion_are_predicted_to_their_noise(worlds):
    for built, found, fresh, rng in worlds:
        motion = recorded(built, fresh, rng).pieces[0].measured.motion
        begin = int(np.searchsorted(fresh.times_s, motion.times_s[0] - 1e-6))
        rows = slice(begin, begin + len(motion))
        true = drive_torques(built, fresh.q, fresh.dq, fresh.ddq)
        noise = 0.03 * np.sqrt(np.mean(true**2, axis=0))
        for torques in (found.identified.torques, found.identified.consistent_torques):
            away = np.sqrt(np.mean((torques(motion) - true[rows]) ** 2, axis=0))
            assert np.sqrt(1.0 + (away / noise) ** 2).max() < 1.1


def test_links_are_bodies_in_every_run_and_nearer_the_truth(worlds):
    known = known_arm().inertias.values[:, 0]
    before, after = [], []
    for built, found, _, _ in worlds:
        inertias = found.identified.inertias
        assert inertias.consistent
        true = robot_with_bodies(built).inertias.values[:, 0]
        before.append(np.log(known / true))
        after.append(np.log(inertias.values[:, 0] / true))
        # A misfit of chi-square of 58 is what the noise alone would give if the truth were fitted.
        assert found.identified.consistent.misfit < 90.0
    # No motion tells single masses, but what it tells pulls them the right way in the mean.
    assert np.std(after) < np.std(before)


def test_breaking_loose_is_found():
    rng = np.random.default_rng(1)
    built = real_dynamics("ur5e", rng, stribeck=True)
    streams = [recorded(built, exercise(6, rng), rng) for exercise in (multi_sine, slow_sweep)]
    result = identify(known_arm(), streams, replace(PLAIN, stribeck=True)).identified
    humps, size = result.stribeck, result.base.rank
    assert humps.joints.tolist() == [0, 1, 2, 3, 4, 5]
    away = np.concatenate(
        [
            humps.hump_nm - built.gears.stribeck,
            np.log(humps.speed_rad_s / built.gears.stribeck_speed),
        ]
    )
    covariance = result.covariance[size:, size:]
    # Chance exceeds 33 with 12 degrees of freedom once in a thousand.
    assert away @ np.linalg.solve(covariance, away) < 33.0
    assert np.sqrt(np.diag(covariance)[6:]).max() < 0.05


def test_an_arm_without_humps_gets_none(worlds):
    built, _, _, _ = worlds[0]
    rng = np.random.default_rng(7)
    streams = [recorded(built, exercise(6, rng), rng) for exercise in (multi_sine, slow_sweep)]
    result = identify(known_arm(), streams, replace(PLAIN, stribeck=True)).identified
    # Each of six joints is taken for one with a hump once in a thousand cases.
    assert not len(result.stribeck.joints)


def test_joints_that_stand_still_are_named():
    rng = np.random.default_rng(8)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    for values in (done.q, done.dq, done.ddq):
        values[:, 3] = 0.0
    with pytest.raises(DegenerateError, match=r"joint 4 \(wrist_1_joint\) stands still") as told:
        identify(known_arm(), [recorded(built, done, rng)])
    assert "visioncal dynamics plan" in told.value.next_step


def test_results_survive_the_disk(tmp_path, worlds):
    built, found, fresh, rng = worlds[0]
    stream = recorded(built, fresh, rng)
    prediction = predict(found.identified, stream)
    result = replace(found.identified, validation=validate(found.identified, prediction))
    result.save(tmp_path / "dynamics.json")
    again = Identified.load(tmp_path)
    motion = stream.pieces[0].measured.motion
    assert (again.torques(motion) == result.torques(motion)).all()
    assert (again.consistent_torques(motion) == result.consistent_torques(motion)).all()
    assert again.determined == result.determined
    assert (again.validation.rms_nm == result.validation.rms_nm).all()
    assert again.streams[0].label == "streams/robot.csv"


@pytest.fixture(scope="module")
def panda():
    if not PANDA.is_dir():
        pytest.skip("the recording of a Franka Panda is not there")
    load = partial(np.loadtxt, dtype=float)
    q, dq, torques = (
        load(PANDA / f"{name}.txt").reshape(-1, 7) for name in ("positions", "velocity", "torques")
    )
    return RecordedSamples("streams/panda.csv", load(PANDA / "time.txt"), q, dq, torques)


def test_a_real_panda_is_predicted(panda):
    """First 70 % to train, last 30 % to test, 8 Hz; a plain script's errors are the limits."""
    train, test = condition(panda.part(0.0, 0.7), 8.0), condition(panda.part(0.7, 1.0), 8.0)
    found = identify(load_robot("panda"), [train])
    assert found.identified.base.rank == 64
    result = validate(found.identified, predict(found.identified, test))
    limits = np.array([5.0, 1.5, 2.4, 4.9, 6.2, 3.4, 17.9])
    assert (100.0 * result.shares <= limits).all()
    assert found.identified.inertias.consistent
    assert (100.0 * result.consistent_rms_nm / result.torque_nm <= 1.15 * limits).all()
