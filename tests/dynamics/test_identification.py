"""From recorded samples to motions, torques and the parameters that they tell; a real arm."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.kept import kept_session
from support.moved_arms import changed, recorded, robot_with_bodies, true_base
from support.refusals import raised

from visioncal.core.errors import DataError, DegenerateError
from visioncal.dynamics import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import LowPass, condition
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.identified import Identified, judge
from visioncal.dynamics.identify import SLOW_RAD_S, Options, find_lag, identify, predict, validate
from visioncal.dynamics.model import DynamicModel, Friction, FrictionTerms, JointMotion
from visioncal.dynamics.reading import RecordedSamples, read_recorded
from visioncal.dynamics.regression import NoiseBlock, regress
from visioncal.robot import Robot, load_robot
from visioncal.robot.files import read_robot_document, robot_names
from visioncal.robot.inertia import Inertias
from visioncal.robot.torques import joint_torques, torque_regressor
from visioncal.robot.writing import small_urdf, urdf_with_inertias, with_inertias
from visioncal.session import Stream
from visioncal.simulation.dynamics import (
    LinkBody,
    Senses,
    drive_torques,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
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
def test_the_number_of_identifiable_parameters_is_right(name, inertial, all_of_it):
    robot = load_robot(name)
    assert BaseModel.reduce(DynamicModel(robot, NO_FRICTION)).rank == inertial
    for seed in range(3):
        rng = np.random.default_rng(seed)
        base = BaseModel.reduce(DynamicModel(robot, FrictionTerms()), rng)
        assert base.rank == all_of_it == len(base.names)


@pytest.mark.parametrize("name", ["ur5e", "panda", "generic-6r-1800"])
def test_base_parameters_determine_all_torques(name):
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
        free = Friction(*np.zeros((5, robot.joint_count)), np.ones(robot.joint_count))
        held = ArmDynamics(robot, heavier, free).gravity(q)
        assert again.load_torques(q) == pytest.approx(-held, abs=ROUNDING)
        assert again.base_from_flange(q) == pytest.approx(robot.base_from_flange(q), abs=1e-12)


def urdf_of(robot):
    return {"schema": 1, "name": robot.name, "tip": robot.tip, "urdf": small_urdf(robot)}


def test_an_arms_mass_is_no_fact_of_a_recording():
    """A session's digest stays what it was before its robot's table told inertias and drives."""
    document = read_robot_document("panda")
    # The table as it was, in its own words.
    geometry = {"name", "a_m", "alpha_rad", "d_m", "theta_offset_rad", "lower_deg", "upper_deg"}
    bare = [
        {key: value for key, value in row.items() if key in geometry} for row in document["joint"]
    ]
    assert bare != document["joint"]
    session = kept_session()
    digests = [
        replace(session, robot_document=document | {"joint": rows}).digest()
        for rows in (document["joint"], bare, bare[:-1])
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
    raised(DataError, "must come from a URDF", urdf_with_inertias, load_robot("ur5e"), found)


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


def test_each_block_has_its_noise():
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


def test_unused_rows_do_not_count():
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


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "N mm, or mA for A"), (1e-3, "kN m")])
def test_links_that_are_too_heavy_or_light_for_their_reach_name_the_unit(worlds, factor, unit):
    sound = worlds[0][1].identified
    assert not any(finding.kind == "torque_unit" for finding in judge(sound).findings)
    found = judge(replace(sound, values=factor * sound.values))
    assert found.status == "bad"
    assert found.findings[0].words.startswith(f"The torques are in another unit ({unit}")
    assert f"by {1.0 / factor:g}." in found.findings[0].do.words


def test_friction_that_drives_a_joint_is_a_torque_of_the_other_sign(worlds):
    sound = worlds[0][1].identified
    assert not any(finding.kind == "sign" for finding in judge(sound).findings)
    values = sound.values.copy()
    values[sound.base.names.index("Fc5")] *= -1.0
    found = judge(replace(sound, values=values))
    assert found.status == "bad"
    assert found.findings[0].words.startswith("Joint 5: its dry friction is -")
    assert "tau5_nm" in found.findings[0].do.words


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_an_arm_without_humps_gets_no_humps(worlds):
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
    with pytest.raises(DegenerateError, match=r"joint 4 \(wrist_1_joint\) stands still") as refusal:
        identify(known_arm(), [recorded(built, done, rng)])
    assert "visioncal dynamics plan" in refusal.value.next_step


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


@pytest.mark.slow
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


RATE_HZ = 500.0


@pytest.fixture(scope="module")
def stream():
    rng = np.random.default_rng(1)
    return record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng)


def conditioned(stream, **more):
    return condition(read_recorded(stream, "streams/robot.csv", 6), **more)


def test_the_filter_passes_its_band_and_shifts_nothing():
    lowpass, times_s = LowPass.of(8.0, RATE_HZ), np.arange(4000) / RATE_HZ
    for hz, wanted in ((0.0, 1.0), (3.5, 1.0), (8.0, 0.5), (13.0, 0.0)):
        out = lowpass(np.cos(2.0 * np.pi * hz * times_s))
        at = times_s[lowpass.half :: lowpass.step][: len(out)]
        # 60 dB of attenuation and a ripple as small; half at the cut-off by symmetry.
        assert out == pytest.approx(wanted * np.cos(2.0 * np.pi * hz * at), abs=4e-3)


def test_the_filter_knows_what_it_leaves_of_white_noise():
    lowpass = LowPass.of(8.0, RATE_HZ)
    out = lowpass(np.random.default_rng(1).standard_normal(1_500_000))
    seen = [float(out[lag:] @ out[:-lag] / (out @ out)) for lag in (1, 2, 3)]
    # A correlation of 48,000 samples is known to 0.005.
    assert seen == pytest.approx(lowpass.correlation[:3], abs=0.02)


@pytest.mark.parametrize("senses", [Senses(), Senses(q_rad=1e-4, dq_rad_s=None)])
def test_motions_are_recovered(senses):
    rng = np.random.default_rng(6)
    done = multi_sine(6, rng)
    found = conditioned(record(real_dynamics("ur5e", rng), done, rng, senses))
    motion = found.pieces[0].measured.motion
    begin = int(np.searchsorted(done.times_s, motion.times_s[0] - 1e-6))
    rows = slice(begin, begin + len(motion))
    # Noise of 1e-5 rad at 500 Hz, smoothed over a third of a second, leaves a few 1e-4 of speeds
    # and accelerations that range to 2; ten times the noise leaves ten times as much.
    size = max(senses.q_rad / 1e-5, 1.0)
    for got, true, most in (
        (motion.q, done.q, 3e-6 * size),
        (motion.dq, done.dq, 4e-4 * size),
        (motion.ddq, done.ddq, 1e-3 * size),
    ):
        assert np.sqrt(np.mean((got - true[rows]) ** 2)) < most


def test_a_clock_that_jitters_is_evened():
    rng = np.random.default_rng(7)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    true = record(built, done, rng, Senses(q_rad=0.0, torque_share=0.0, dq_rad_s=None))
    uneven = np.sort(done.times_s + rng.uniform(-0.4, 0.4, len(done.times_s)) / RATE_HZ)
    values = [np.interp(uneven, true.stamps_s, true[name]) for name in true.columns[1:]]
    stream = Stream(true.columns, np.column_stack([uneven, *values]))
    found = conditioned(stream)
    motion = found.pieces[0].measured.motion
    ddq = np.stack(
        [np.interp(motion.times_s, done.times_s, column) for column in done.ddq.T], axis=1
    )
    # Straight lines between samples 2 ms apart bend by 2e-6 rad at 4 rad/s^2.
    assert np.abs(motion.ddq - ddq).max() < 0.02


def test_nothing_is_interpolated_across_gaps(stream):
    rows = np.ones(len(stream), dtype=bool)
    rows[4000:4200] = False
    found = conditioned(Stream(stream.columns, stream.values[rows]))
    assert len(found.pieces) == 2
    assert "samples are missing for up to 0.402 s behind 8.00 s" in found.notes[0]
    gap = (found.times_s > 7.998) & (found.times_s < 8.4)
    assert not gap.any()


def test_torques_of_joints_at_rest_are_not_used():
    resolved_rad = 1e-4
    rng = np.random.default_rng(12)
    built, done = real_dynamics("ur5e", rng), slow_sweep(6, rng)
    # To rest and off again, from 20 s to 23 s, with as much as a controller's own ramps take.
    way = np.interp(done.times_s, [0.0, 20.0, 23.0, 60.0], [0.0, 20.0, 20.0, 57.0])
    way = np.convolve(np.pad(way, 50, mode="edge"), np.ones(101) / 101.0, mode="valid")

    def round_off(columns):
        for joint in range(1, 7):
            angles = np.interp(way, done.times_s, columns[f"q{joint}_rad"])
            columns[f"q{joint}_rad"] = np.round(angles / resolved_rad) * resolved_rad

    stream = record(built, done, rng, Senses(q_rad=0.0, dq_rad_s=None))
    found = conditioned(changed(stream, round_off))
    # Friction holds a joint at rest by torques that nothing foretells.
    assert not found.used[(found.times_s > 20.8) & (found.times_s < 22.2)].any()


def test_saturated_torques_are_named_and_left_out(stream):

    most = np.quantile(np.abs(stream["tau2_nm"]), 0.85)

    def cut_off(columns):
        columns["tau2_nm"] = np.clip(columns["tau2_nm"], -most, most)

    found = conditioned(changed(stream, cut_off))
    assert "tau2" in found.notes[0]
    assert "saturated" in found.notes[0]
    used = found.used.mean(axis=0)
    assert used[1] < 0.95
    assert (used[[0, 2, 3, 4, 5]] == 1.0).all()
    at_limit = conditioned(stream, limits_nm=np.array([150.0, most, 150.0, 28.0, 28.0, 28.0]))
    assert 0.5 < at_limit.used[:, 1].mean() < 0.95
    # Beyond a limit nearly all the time: that is another unit, which is named elsewhere.
    in_thousandths = conditioned(stream, limits_nm=np.full(6, 0.15))
    assert in_thousandths.used.all()


def test_speeds_that_contradict_the_angles_are_left_out(stream):

    def degrees(columns):
        for joint in range(1, 7):
            columns[f"dq{joint}_rad_s"] *= 180.0 / np.pi

    found = conditioned(changed(stream, degrees))
    assert "dq1_rad_s ... are not the speeds" in found.notes[0]
    assert np.abs(found.pieces[0].measured.motion.dq).max() < 2.1


def without(*names):
    def change(columns):
        for name in names:
            del columns[name]

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("tau4_nm"), "lacks tau4_nm: the robot has 6 joints"),
        (without("q6_rad", "tau6_nm"), "lacks q6_rad, tau6_nm"),
        (lambda value: value.update(q7_rad=value["q1_rad"]), "has q7_rad, but the robot has 6"),
    ],
)
def test_missing_and_surplus_joints_are_named(stream, change, words):
    raised(DataError, words, conditioned, changed(stream, change))


def test_stamps_of_another_unit_are_refused(stream):
    def scale(columns):
        columns["stamp_s"] *= 1e3

    refusal = raised(DataError, "its samples are 2 s apart", conditioned, changed(stream, scale))
    assert "divide by 1000" in refusal.next_step


def test_short_recordings_are_refused(stream):
    short = Stream(stream.columns, stream.values[:400])
    with pytest.raises(DataError, match=r"the longest part without gaps lasts 0\.8 s"):
        conditioned(short, cutoff_hz=4.0)


TORQUE, ANGLE, SPEED = "tau{}_nm", "q{}_rad", "dq{}_rad_s"
ALL = range(1, 7)


def check(stream, name="ur5e", *, with_inertias=True, gravity=(0.0, 0.0, -9.81)):
    robot = replace(robot_with_bodies(nominal_dynamics(name)), gravity=np.array(gravity))
    robot = robot if with_inertias else replace(robot, inertias=None)
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms()))
    check_recording(base, [condition(read_recorded(stream, "streams/robot.csv", 6))])


def swapped(one, other, *groups):
    def change(columns):
        for group in groups:
            first, second = group.format(one), group.format(other)
            columns[first], columns[second] = columns[second].copy(), columns[first].copy()

    return change


def scaled(by, joints, *groups):
    def change(columns):
        for name in (group.format(joint) for group in groups for joint in joints):
            columns[name] *= by

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (swapped(1, 2, TORQUE), "the torques of joints 1 and 2 are swapped"),
        (swapped(3, 4, ANGLE, SPEED), "the angles of joints 3 and 4 are swapped"),
        (swapped(5, 6, TORQUE, ANGLE, SPEED), "joints 5 and 6 are swapped, with angles"),
        (scaled(-1.0, [2], TORQUE), "the torque of joint 2 has the other sign"),
        (scaled(-1.0, [3], ANGLE, SPEED), "the angle of joint 3 has the other sign"),
        (scaled(-1.0, ALL, TORQUE), "all torques have the other sign"),
        (scaled(57.2958, ALL, ANGLE, SPEED), "angles are in degrees"),
        (scaled(1000.0, ALL, TORQUE), "times what .* need; are they mN m, or mA for A"),
        (scaled(1000.0, [3], TORQUE), "the torques of joint 3 are .* mN m, or mA for A"),
        (scaled(0.01, ALL, TORQUE), "of the motors, before gears of a ratio of about (9|10)"),
    ],
)
def test_mistakes_are_named(stream, change, words):
    wrong = changed(stream, change)
    raised(DataError, words, check, wrong)
    # Without inertias only a scale of all torques is open.
    if "degrees" in words:
        raised(DataError, words, check, wrong, with_inertias=False)


@pytest.mark.parametrize("gravity", [(9.81, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 1.7, -9.66)])
def test_a_base_that_is_mounted_otherwise_is_named(stream, gravity):
    words = r"has gravity along \[(0|-?0.\d+), (0|-?0.\d+), -9.8\d?\]"
    raised(DataError, words, check, stream, gravity=gravity)
    # Without inertias, links of negative masses would fall upwards.
    if gravity[2] <= 0.0:
        raised(
            DataError,
            "is not mounted as stated",
            check,
            stream,
            gravity=gravity,
            with_inertias=False,
        )


def test_a_heavy_tool_is_no_mistake():
    rng = np.random.default_rng(3)
    tool = LinkBody(8.0, np.array([0.08, -0.03, 0.08]), np.zeros((3, 3)))
    check(record(real_dynamics("ur10e", rng).carrying(tool), multi_sine(6, rng), rng), "ur10e")


@pytest.mark.parametrize(
    ("seed", "motion", "with_inertias"), [(0, multi_sine, False), (1, slow_sweep, True)]
)
def test_right_recordings_pass(seed, motion, with_inertias):
    name = "ur10e" if seed % 2 else "ur5e"
    rng = np.random.default_rng(10 + seed)
    stream = record(real_dynamics(name, rng, stribeck=True), motion(6, rng), rng)
    check(stream, name, with_inertias=with_inertias)


USUAL_TERMS = Options().terms


def late(stream, lag_s):
    """The stream with torques that come so much later [s]."""

    def change(columns):
        times_s = columns["stamp_s"]
        for joint in range(1, 7):
            torques = columns[f"tau{joint}_nm"]
            columns[f"tau{joint}_nm"] = np.interp(times_s - lag_s, times_s, torques)

    return changed(stream, change)


def some_of(stream, rng):
    """Four rows in five."""
    rows = np.sort(rng.permutation(len(stream))[: 4 * len(stream) // 5])
    return Stream(stream.columns, stream.values[rows])


def lag_of(stream, name="ur5e"):
    rows = read_recorded(stream, "streams/robot.csv", 6)
    return find_lag(robot_with_bodies(nominal_dynamics(name)), [condition(rows)], USUAL_TERMS)


@pytest.mark.parametrize(("lag_s", "whole"), [(-0.03, False), (0.2, True)])
def test_lags_are_found_to_their_sigmas(lag_s, whole):
    away = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stream = record(real_dynamics("ur5e", rng), multi_sine(6, rng, rate_hz=250.0), rng)
        lag = lag_of(late(stream, lag_s) if whole else some_of(late(stream, lag_s), rng))
        away.append((lag.seconds - lag_s) / lag.sigma_s)
        # Three in a hundred of noise, and dry friction that turns within milliseconds.
        assert lag.sigma_s < 4e-4
        # Motions of 0.1 to 0.25 Hz turn by 0.6 to 1.6 rad a second; dry friction adds its jumps.
        assert 0.5 * abs(lag_s) < lag.share < 4.0 * abs(lag_s)
    # Chance does it once in 150,000 draws; sigmas know nothing of the noise that angles leave in
    # the regressor.
    assert np.abs(away).max() < 4.5


def test_synchronous_torques_have_no_lag():
    rng = np.random.default_rng(4)
    built = real_dynamics("ur5e", rng, stribeck=True)
    assert lag_of(record(built, multi_sine(6, rng), rng)) is None


def test_torques_that_no_lag_explains_have_no_lag():
    rng = np.random.default_rng(5)
    stream = late(record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng), 0.08)
    turned = [column for column in stream.columns if column.startswith("tau")]

    def shuffle(columns):
        kept = {name: columns[name] for name in turned}
        for name, other in zip(turned, [*turned[1:], turned[0]], strict=True):
            columns[name] = kept[other]

    assert lag_of(changed(stream, shuffle)) is None
