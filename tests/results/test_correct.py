"""Compensation: what is sent to the nominal controller brings the real arm to its target."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated
from support.commands import visioncal as run
from support.commands import write_poses
from support.refusals import raised
from support.wrong_arms import WRONG_LINKS

import visioncal
from visioncal.calibration.pipeline.result import result_of
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.results.arm import (
    ArmResult,
    ElasticResult,
    JointRange,
    JointSpring,
    Sag,
    WorkspacePlace,
    WorkspaceSigma,
)
from visioncal.results.compensation.correction import predicted_sigma_mm
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse
from visioncal.simulation import forward, simulate

HOME = np.array([0.4, -1.3, 1.5, -1.75, -1.57, 0.3])
SEED = "0.4,-1.3,1.5,-1.75,-1.57,0.3"


@pytest.fixture(scope="module")
def cell():
    return simulate(replace(WRONG_LINKS, seed=0, views=40))


@pytest.fixture(scope="module")
def result(cell):
    return result_of(calibrated(cell))


@pytest.fixture(scope="module")
def by_poses(cell):
    """What is known without joint angles: the nominal arm."""
    return result_of(calibrated(cell, joints=False))


@pytest.fixture(scope="module")
def exact(cell, result):
    """A calibration that found the true arm to the last digit."""
    arm, nominal = cell.robot.true_arm, result.robot
    numbers = zip(arm.a, arm.alpha, arm.beta, arm.d, arm.offset, strict=True)
    keys = ("a_m", "alpha_rad", "beta_rad", "d_m", "theta_offset_rad")
    rows = [dict(zip(keys, map(float, number), strict=True)) for number in numbers]
    named = [{"name": name} | row for name, row in zip(nominal.joint_names, rows, strict=True)]
    robot = Robot.from_document(
        {"schema": 1, "name": "true", "tip": nominal.tip, "convention": "hayati", "joint": named}
    )
    return replace(result, arm=replace(result.arm, robot=robot.corrected()))


def joints_near(count, seed=1, size=0.5):
    return HOME + np.random.default_rng(seed).uniform(-size, size, (count, 6))


def targets_near(count, calibration, **draw):
    return calibration.robot.base_from_flange(joints_near(count, **draw))


def cam_from_target(calibration, flange):
    x, z = (edge.matrix for edge in calibration.edges.values())
    return invert(flange @ x) @ z


def rms_mm(wanted, got):
    """How far the camera is from where it is wanted, seen from the target."""
    away = (invert(wanted) - invert(got))[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


# --- The library.


def test_the_true_arm_brings_the_camera_to_where_it_is_wanted(cell, result, by_poses):
    flange = targets_near(100, result)
    wanted = cam_from_target(result, flange)
    x, z = cell.transforms.values()

    def seen(q):
        return invert(forward(cell.robot.true_arm, q) @ x) @ z

    sent = visioncal.correct(result, flange, HOME)
    assert sent.reached.all()
    after = rms_mm(wanted, seen(sent.q))
    # Without joint angles: the edges alone, and the nominal controller.
    nominal_x, nominal_z = (edge.matrix for edge in by_poses.edges.values())
    nominal_flanges = nominal_z @ invert(wanted) @ invert(nominal_x)
    nominal = Inverse(result.robot)
    before = rms_mm(
        wanted, seen(np.array([nominal.solve(value, HOME).positions for value in nominal_flanges]))
    )
    assert before > 2.0
    # Forty views leave 4 to 10 % of the nominal arm's error.
    assert after < 0.1 * before
    # The stated sigma counts the board's size, which is exact here.
    assert after < 2.0 * result.arm.workspace_sigma_mm.median


def test_a_model_that_is_the_truth_is_inverted_exactly(cell, exact):
    flange = targets_near(50, exact, size=1.0)
    sent = visioncal.correct(exact, flange, HOME)
    assert sent.reached.all()
    assert forward(cell.robot.true_arm, sent.q) == pytest.approx(flange, abs=1e-9)
    assert (sent.off_m < 1e-9).all()
    assert (sent.off_rad < 1e-9).all()
    # Links off by 0.5 mm and 1 mrad, on an arm that reaches 0.9 m.
    assert 5e-4 < np.median(sent.moved_m) < 5e-3
    assert 2e-4 < np.median(sent.moved_rad) < 5e-3


def test_the_controller_finds_the_joints_again_in_the_pose(result):
    q = joints_near(20)
    sent = visioncal.correct(result, result.robot.base_from_flange(q), q)
    nominal = Inverse(result.robot)
    again = [
        nominal.solve(pose, near).positions
        for pose, near in zip(sent.base_from_flange, q, strict=True)
    ]
    # 0.1 nm of the pose over the least singular value, some hundredths.
    assert np.array(again) == pytest.approx(sent.q, abs=1e-7)
    # Back through the calibrated arm: what was wanted.
    reached = result.base_from_flange(sent.q).as_matrix()
    assert reached == pytest.approx(sent.wanted, abs=1e-9)


def test_targets_are_one_or_many_matrices_or_transforms(result):
    flange = targets_near(3, result)
    many = visioncal.correct(result, flange, joints_near(3))
    one = visioncal.correct(result, flange[1], joints_near(3)[1])
    assert len(one) == 1
    assert one.q[0] == pytest.approx(many.q[1], abs=1e-12)
    arm = visioncal.CalibratedArm.of(result)
    assert np.array_equal(visioncal.correct(arm, flange, joints_near(3)).q, many.q)
    as_transforms = result.base_from_flange(many.q)
    assert visioncal.correct(result, as_transforms, HOME).q == pytest.approx(many.q, abs=1e-7)
    assert len(visioncal.correct(result, np.empty((0, 4, 4)))) == 0
    # Printed to five digits, a matrix is no rotation; the nearest one is reached.
    rounded = visioncal.correct(result, np.round(flange, 5), HOME)
    assert rounded.reached.all()
    assert rounded.q == pytest.approx(many.q, abs=1e-3)


def test_each_target_follows_the_one_before_it(result):
    """A line of 40 cm in steps of 1 cm stays in its branch, and so does a row without a seed."""
    start = result.robot.base_from_flange(HOME[None])[0]
    line = np.tile(start, (41, 1, 1))
    line[:, 1, 3] += np.linspace(0.0, 0.4, 41)
    path = visioncal.correct(result, line, HOME)
    assert path.reached.all()
    # 1 cm at 0.4 m from the base's axis is 25 mrad; a wrist turns by a few times as much.
    assert path.turned_rad.max() < 0.1
    seeds = np.full((41, 6), np.nan)
    seeds[0] = HOME
    assert np.array_equal(visioncal.correct(result, line, seeds).q, path.q)


def test_without_a_seed_the_posture_is_nearest_to_the_middle(result):
    flange = targets_near(1, result)
    free = visioncal.correct(result, flange)
    others = [
        visioncal.correct(result, flange, near).q[0]
        for near in np.random.default_rng(0).uniform(-3.0, 3.0, (30, 6))
    ]
    # A UR's limits are the same both ways.
    assert np.linalg.norm(free.q) <= min(map(np.linalg.norm, others)) + 1e-6
    assert not free.turned_rad.any()


@pytest.mark.parametrize(
    ("targets", "seed", "said"),
    [
        (np.eye(3), None, "shape"),
        (2 * np.eye(4), None, "rigid"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), None, "rigid"),
        (np.eye(4) + 400 * np.eye(4, k=3), None, "no arm reaches"),
        (np.full((4, 4), np.nan), None, "rigid"),
        (np.eye(4), np.zeros(5), "seeds must have the shape"),
        (np.eye(4), [0, 90, 0, 0, 0, 0], "degrees"),
        (np.eye(4), [0, np.nan, 0, 0, 0, 0], "must be a finite number"),
    ],
)
def test_malformed_targets_and_seeds_are_refused(result, targets, seed, said):
    raised(DataError, said, visioncal.correct, result, targets, seed)


def test_without_a_calibrated_arm_there_is_nothing_to_correct(result, by_poses):
    raised(DataError, "no joint angles", visioncal.correct, by_poses, np.eye(4))
    nominal = ArmResult(level="nominal", levels=())
    raised(DataError, "level nominal", visioncal.correct, replace(result, arm=nominal), np.eye(4))


def test_sigmas_come_from_the_map_or_else_from_the_median(result):
    places = np.array([[0.4, 0.0, 0.2], [0.41, 0.0, 0.2]])
    plain = replace(result.arm, workspace_sigma_mm=WorkspaceSigma(0.3, 0.5), workspace_map=())
    rows = tuple(
        WorkspacePlace(x, 0.0, 0.2, sigma) for x, sigma in ((0.4, 0.1), (0.45, 0.2), (0.6, 0.9))
    )
    for arm, sigmas in (
        (plain, (0.3, 0.3)),
        # On a place of the map, and between two of them, nearer to the first.
        (replace(plain, workspace_map=rows), (0.1, 0.11)),
        (replace(plain, workspace_sigma_mm=None), (np.nan, np.nan)),
    ):
        found = predicted_sigma_mm(replace(result, arm=arm), places)
        assert found == pytest.approx(np.array(sigmas), abs=0.01, nan_ok=True)


def test_postures_as_they_were_measured_have_a_map_of_their_own(result):
    names = result.robot.joint_names
    arm = replace(
        result.arm,
        workspace_map=(WorkspacePlace(0.4, 0.0, 0.2, 0.9),),
        measured_map=(WorkspacePlace(0.5, 0.0, 0.2, 0.1),),
        measured=tuple(JointRange(name, -1.0, 1.0) for name in names),
    )
    q = np.zeros((3, len(names)))
    q[1, 2], q[2] = 1.2, -1.0
    found = predicted_sigma_mm(replace(result, arm=arm), np.full((3, 3), 0.4), q)
    assert found == pytest.approx(np.array([0.1, 0.9, 0.1]))


# --- The command.


@pytest.fixture
def stored(result, tmp_path):
    result.save(tmp_path / "calibration.json")
    return tmp_path


def rows_of(text):
    return list(csv.DictReader(text.splitlines()))


def numbers(row, names):
    return np.array([float(row[index]) for index in names])


JOINTS = tuple(f"q{index}_rad" for index in range(1, 7))


def test_a_table_is_corrected_and_keeps_its_other_columns(stored, result):
    poses = targets_near(4, result)
    columns = {"view": range(7, 11), "note": ["", 'say "a, b"', "", "x"]}
    table = write_poses(stored / "t.csv", poses, columns)
    done = run(
        "correct", table, "--against", stored, "-o", stored / "o.csv", "--seed-joints", SEED
    ).good()
    assert "4 of 4 targets corrected" in done.out
    rows = rows_of((stored / "o.csv").read_text())
    assert [row["view"] for row in rows] == ["7", "8", "9", "10"]
    assert rows[1]["note"] == 'say "a, b"'
    sent = visioncal.correct(result, poses, HOME)
    for row, q, mm in zip(rows, sent.q, 1e3 * sent.moved_m, strict=True):
        # Poses in the table have 0.1 um and 1e-9.
        assert numbers(row, JOINTS) == pytest.approx(q, abs=2e-6)
        assert float(row["moved_mm"]) == pytest.approx(mm, abs=1e-3)
        assert float(row["sigma_mm"]) > 0.0
        expected = result.robot.base_from_flange(numbers(row, JOINTS)[None])[0, :3, 3]
        # Joints are written to 0.1 nrad, positions to 0.1 nm.
        assert numbers(row, ("x_m", "y_m", "z_m")) == pytest.approx(expected, abs=2e-9)
    run("correct", stored / "o.csv", "-c", stored).refused("would be so twice")


def test_seeds_in_the_rows_pick_the_branch(stored, result):
    flipped = HOME * [1, 1, 1, 1, -1, 1] + [0, 0, 0, np.pi, 0, np.pi]
    poses = result.robot.base_from_flange(np.array([HOME, HOME, HOME]))
    seeds = np.array([flipped, HOME, flipped])
    columns = {name: [f"{seed:.6f}" for seed in seeds[:, at]] for at, name in enumerate(JOINTS)}
    done = run("correct", write_poses(stored / "t.csv", poses, columns), "-c", stored).good()
    # The wrist turns its other side to the same pose.
    found = [float(row["q5_rad"]) for row in rows_of(done.out)]
    # What a correction of 2 mm turns is far less than what the other branch would.
    assert found == pytest.approx([1.57, -1.57, 1.57], abs=0.05)
    assert "warning" not in done.err


def test_targets_of_a_tool_are_answered_for_the_tool(stored, result):
    poses = targets_near(3, result)
    flange_from_cam = result.edges["flange_from_cam"].matrix
    at_flange = rows_of(
        run(
            "correct", write_poses(stored / "f.csv", poses), "-c", stored, "--seed-joints", SEED
        ).out
    )
    table = write_poses(stored / "c.csv", poses @ flange_from_cam)
    command = ("correct", table, "-c", stored, "--tool", "cam", "--seed-joints", SEED)
    for row, flange in zip(rows_of(run(*command).out), at_flange, strict=True):
        # The tables' 0.1 um, and 1e-9 of a quaternion at 0.1 m.
        assert numbers(row, JOINTS) == pytest.approx(numbers(flange, JOINTS), abs=2e-6)
        q = numbers(row, JOINTS)[None]
        expected = (result.robot.base_from_flange(q) @ flange_from_cam)[0, :3, 3]
        assert numbers(row, ("x_m", "y_m", "z_m")) == pytest.approx(expected, abs=2e-9)
    run("correct", table, "-c", stored, "--tool", "camm").refused("Did you mean cam?")


def test_targets_out_of_reach_are_named_and_nothing_is_written(stored, result):
    poses = targets_near(3, result)
    poses[1, :3, 3] = [1.5, 0.0, 0.3]
    table, out = write_poses(stored / "t.csv", poses), stored / "o.csv"
    left = "t.csv, line 3: out of reach within the joints' limits: the nearest posture leaves"
    run("correct", table, "-c", stored, "-o", out, "--seed-joints", SEED).refused(
        "1 of 3 targets", left
    )
    assert not out.exists()
    done = run("correct", table, "-c", stored, "-o", out, "--skip-unreachable").good()
    assert "left out: t.csv, line 3" in done.err
    assert len(rows_of(out.read_text())) == 2
    done = run("correct", table, "-c", stored, "--json").refused()
    assert json.loads(done.out)["error"]["culprits"] == ["t.csv, line 3"]
    poses[:, :3, 3] = [1.5, 0.0, 0.3]
    run("correct", write_poses(table, poses), "-c", stored, "--skip-unreachable").refused(
        "3 of 3 targets"
    )


def test_another_branch_is_reported(stored, result):
    poses = result.robot.base_from_flange(np.array([HOME, [2.9, *HOME[1:]]]))
    table = write_poses(stored / "t.csv", poses)
    command = ("correct", table, "-c", stored, "--seed-joints", SEED)
    done = run(*command).good()
    assert "t.csv, line 3: " in done.err
    assert "no posture nearer was found" in done.err
    assert "warning" not in run(*command, "--widest-deg", 160).err
    assert run(*command, "--widest-deg", 0).status == 2


def test_ways_through_singular_postures_are_found(stored, result):
    """A UR's wrist is singular where joint 5 is zero; the way through turns joint 4 far."""
    joints = np.tile([*HOME[:4], 0.0, 0.3], (41, 1))
    joints[:, 4] = np.linspace(-0.1, 0.1, 41)
    table = write_poses(stored / "t.csv", result.robot.base_from_flange(joints))
    done = run(
        "correct", table, "-c", stored, "--seed-joints", "0.4,-1.3,1.5,-1.75,-0.1,0.3"
    ).good()
    # To the digits of the table.
    for row, pose in zip(rows_of(done.out), result.robot.base_from_flange(joints), strict=True):
        (reached,) = result.base_from_flange(numbers(row, JOINTS)[None]).as_matrix()
        assert reached == pytest.approx(pose, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{POSE}\n400,100,200,0,1,0,0\n", "t.csv, line 2: these are millimetres, most likely"),
        ("x_m,y_m,z_m,qx,qy,qz\n0.4,0.1,0.2,0,1,0\n", "qw are missing"),
        ("x_m,y_m,z_m,qx,qy,qz,q4\n0.4,0.1,0.2,0,0.6,0,0\n", "qw are missing"),
        ("{POSE}\n0.4,0.1,,0,0,0,1\n", "column z_m: it is empty"),
        ("{POSE}\n0.4,0.1,0.2,0,0,1,1\n", "norm is 1.41"),
        ("{POSE},{JOINTS}\n0.4,0.1,0.2,0,1,0,0,10,-80,90,-100,-90,0\n", "look like degrees"),
        ("{POSE},q1_rad\n0.4,0.1,0.2,0,1,0,0,0.1\n", "its joints are q1_rad"),
    ],
)
def test_a_table_without_targets_is_named(stored, text, words):
    names = {"POSE": "x_m,y_m,z_m,qx,qy,qz,qw", "JOINTS": ",".join(JOINTS)}
    (stored / "t.csv").write_text(text.format(**names))
    assert run("correct", stored / "t.csv", "-c", stored).refused(words).out == ""


def test_a_payload_is_counted_where_joints_bend(stored, result):
    spring = {"compliance_rad_per_nm": 1e-4, "sigma_rad_per_nm": 1e-6, "determined": True}
    springs = tuple(
        JointSpring(joint=name, torque_nm=(0.0, 9.0), **spring) for name in result.robot.joint_names
    )
    sagging = {"not_determined": (), "weight": "unknown", "payload_kg": (0.0, 0.0)}
    elastic = ElasticResult(joints=springs, sag_mm=Sag(0.1, 0.2), **sagging)
    bending = replace(result, elastic=elastic)
    poses = targets_near(2, result)
    table = write_poses(stored / "t.csv", poses)
    load = ("--payload-kg", "3", "--payload-m", "0,0,0.1", "--seed-joints", SEED)
    done = run("correct", table, "-c", stored, *load).good()
    assert "--payload-kg 3 changes nothing" in " ".join(done.err.split())
    bending.save(stored / "calibration.json")
    done = run("correct", table, "-c", stored, *load)
    assert "changes nothing" not in done.err
    q = np.array([numbers(row, JOINTS) for row in rows_of(done.out)])
    stands = bending.base_from_flange(q, payload_kg=3.0, payload_m=(0.0, 0.0, 0.1)).as_matrix()
    # The table's digits, and what three looks at a bent arm leave.
    assert stands == pytest.approx(poses, abs=1e-5)
    for wrong, words in (
        (("--payload-kg", "-1"), "payload is -1 kg"),
        (("--payload-kg", "5000"), "2500 kg at most, as on the flange of every arm"),
        (("--payload-kg", "5", "--payload-m", "10,-20,100"), "payload_m must be 3 m at most"),
    ):
        run("correct", table, "-c", stored, *wrong, "--seed-joints", SEED).refused(words)


def test_the_unseen_effect_of_a_payload_counts_in_the_sigma_and_is_reported(stored, result):
    """Shoulder and elbow were seen to yield; the wrist bore nothing, and yields as wrists do."""
    seen = {"determined": True, "torque_nm": (-300.0, 300.0)}
    hidden = {"determined": False, "torque_nm": (-0.2, 0.2), "sigma_rad_per_nm": 5e-6}
    springs = tuple(
        JointSpring(joint=name, compliance_rad_per_nm=0.0, **hidden)
        if at not in (1, 2)
        else JointSpring(
            joint=name,
            compliance_rad_per_nm=4e-6,
            sigma_rad_per_nm=1e-7,
            stiffness_nm_per_rad=2.5e5,
            **seen,
        )
        for at, name in enumerate(result.robot.joint_names)
    )
    sagging = {"not_determined": (), "weight": "of the model's masses", "payload_kg": (0.0, 0.0)}
    elastic = ElasticResult(joints=springs, sag_mm=Sag(0.1, 0.2), **sagging)
    # As soft as the wrists of arms of that size.
    assert elastic.sigmas[5] == pytest.approx(2e-5)
    replace(result, elastic=elastic).save(stored / "calibration.json")
    table = write_poses(stored / "t.csv", targets_near(2, result))
    sigmas = []
    for kg in ("0", "20", "60"):
        load = ("--payload-kg", kg, "--payload-m", "0.05,0,0.15", "--seed-joints", SEED)
        done = run("correct", table, "-c", stored, *load)
        sigmas.append([float(row["sigma_mm"]) for row in rows_of(done.out)])
        assert ("bore up to 0.2 N m at the stops" in done.err) == (kg != "0")
    added = np.sqrt(np.square(sigmas[1:]) - np.square(sigmas[0]))
    assert (added[0] > 0.01).all()
    # Torques, and what they leave open, are in proportion to the load.
    assert added[1] == pytest.approx(3.0 * added[0], rel=0.1)
