"""A session's poses read anew: what `convert --guess` writes, and when it writes nothing."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.advice import printed_commands
from support.commands import visioncal as typed
from support.foreign_samples import easy_handeye_file
from support.marks import slow
from typer.testing import CliRunner

import visioncal
from visioncal.cli.app import app
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.interchange.formats import (
    DoubtfulSession,
    ImportOptions,
    assemble,
    read_foreign,
    reread,
)
from visioncal.robot import Robot, read_robot_document
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
JOINTS = tuple(f"q{at}_rad" for at in range(1, 7))


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return write_session(simulate(CellOptions(views=12, seed=4)), tmp_path / "cell", images=False)


def rewritten(folder, change):
    """Changes the rows of views.csv, each a dictionary, in place."""
    file = folder / "views.csv"
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows, names = list(reader), reader.fieldnames
    change(rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)


def shifted(columns):
    def change(rows):
        before = [dict(row) for row in rows]
        for at, row in enumerate(rows):
            row.update({name: before[(at + 1) % len(rows)][name] for name in columns})

    return change


def in_millimetres(rows):
    for row in rows:
        row.update({name: repr(1e3 * float(row[name])) for name in POSE[:3]})


def guessed(source, dest, *more, strict=False):
    words = ["convert", str(source), str(dest), "--guess", *more]
    return CliRunner().invoke(app, words, catch_exceptions=not strict)


def by_view(session, names):
    return {
        view.number: [view.numbers[name] for name in names]
        for view in session.views
        if names[0] in view.numbers
    }


def test_poses_and_joints_of_one_log_change_rows_together(cell, tmp_path):
    sound = Session.load(cell)
    rewritten(cell, shifted((*POSE, *JOINTS)))
    done = guessed(cell, tmp_path / "fixed", "--yes")
    assert done.exit_code == 0, done.stderr
    fixed = Session.load(tmp_path / "fixed")
    for names in (POSE, JOINTS):
        found, wanted = by_view(fixed, names), by_view(sound, names)
        # One row at the end has lost its partner; the rest are the numbers that were written.
        assert len(found) == len(wanted) - 1
        np.testing.assert_allclose(
            list(found.values()), [wanted[index] for index in found], atol=1e-15
        )


def test_joints_that_were_right_stay_where_they_are(cell, tmp_path):
    sound = Session.load(cell)
    rewritten(cell, shifted(POSE))
    assert guessed(cell, tmp_path / "fixed", "--yes").exit_code == 0
    fixed = Session.load(tmp_path / "fixed")
    assert by_view(fixed, JOINTS) == by_view(sound, JOINTS)


def test_nothing_is_written_without_a_word_of_the_user(cell, tmp_path):
    rewritten(cell, in_millimetres)
    done = guessed(cell, tmp_path / "fixed")
    assert done.exit_code != 0
    assert "the robot's positions in mm" in done.stderr
    assert not (tmp_path / "fixed").exists()


def test_a_sound_session_is_not_accused_and_stays_what_it_is(cell, tmp_path):
    done = guessed(cell, tmp_path / "same", "--yes")
    assert done.exit_code == 0, done.stderr
    assert "fit as declared" in done.stderr
    assert Session.load(tmp_path / "same").digest() == Session.load(cell).digest()


@pytest.mark.parametrize("corners", [slow(False), True], ids=["poses", "corners"])
def test_poses_are_mirrored_only_when_that_is_asked_for(tmp_path, corners):
    cell = simulate(CellOptions(views=18, seed=3))
    flange, width = cell.robot.base_from_flange, cell.stated[""].resolution[0]
    mirror = np.eye(4) if corners else np.diag([1.0, -1.0, 1.0, 1.0])
    seen = [
        view_corners.px * [-1, 1] + [width - 1, 0] if corners else view_corners.px
        for view_corners in cell.corners
    ]
    Session.from_corners(
        [(view_corners.ids, px) for view_corners, px in zip(cell.corners, seen, strict=True)],
        mirror @ flange @ mirror,
        replace(cell.options.target, square_sigma_m=1e-7),
        cell.stated[""].resolution,
        mount="eye-in-hand",
    ).save(tmp_path / "cell")
    done = typed("calibrate", tmp_path / "cell", "-o", tmp_path / "out")
    # Mirrored images fit as well, and no reading of the poses helps these.
    assert "Look at an image first: where it is mirrored" in done.said
    assert "--mirror-poses" in done.said
    assert not any("--guess" in command for command in printed_commands(done.said))
    with pytest.raises(DataError, match="mirrored images are the usual cause"):
        guessed(tmp_path / "cell", tmp_path / "fixed", "--yes", strict=True)
    assert not (tmp_path / "fixed").exists()
    assert guessed(tmp_path / "cell", tmp_path / "fixed", "--yes", "--mirror-poses").exit_code == 0
    fixed = Session.load(tmp_path / "fixed")
    assert "left-handed frame" in fixed.declaration.corrected[0]
    # Of mirrored corners the board is still seen from behind.
    assert visioncal.calibrate(fixed).verdict.status == ("check" if corners else "good")


# A cell: what the camera is from the flange, and the target from the base; or the other way round.
NEAR, FAR = (
    exp(np.array([0.1, 0.2, 1.5, 0.03, 0.02, 0.08])),
    exp(np.array([0.1, 2, 0.5, 1, 0.2, 0])),
)


def joints_and_poses(count, seed):
    """(n, 6) joint angles of a ur5e, and its (n, 4, 4) poses."""
    rng = np.random.default_rng(seed)
    joints = 0.5 * rng.normal(size=(count, 6)) + [0, -1.5, 1.5, -1.5, -1.5, 0]
    return joints, Robot.from_document(read_robot_document("ur5e", tip=None)).base_from_flange(
        joints
    )


def one_late(rows):
    return np.concatenate([rows[:1], rows[:-1]])


@pytest.fixture
def late(tmp_path):
    """Writes a log in which the robot's rows are one late."""

    def write(*, with_poses):
        joints, poses = joints_and_poses(12, seed=1)
        camera = invert(poses @ NEAR) @ FAR
        keyed = {"joints": one_late(joints), "camera_pose": camera}
        keyed |= {"robot_pose": one_late(poses)} if with_poses else {}
        rows = [
            {name: value[at].tolist() for name, value in keyed.items()} for at in range(len(joints))
        ]
        (tmp_path / "log.json").write_text(json.dumps(rows))
        foreign = read_foreign(
            tmp_path / "log.json", ImportOptions(mount="eye-in-hand", robot_model="ur5e")
        )
        return foreign, joints

    return write


@pytest.mark.parametrize("with_poses", [False, True], ids=["joints alone", "both"])
def test_a_shift_moves_the_joints(late, with_poses):
    foreign, joints = late(with_poses=with_poses)
    session = assemble(foreign)
    for name, recorded in {
        "recording": DoubtfulSession.of(foreign),
        "session": DoubtfulSession(session),
    }.items():
        guess = recorded.guess()
        assert guess.stands_out
        fixed = reread(recorded, guess.best)
        found = [view.joints_rad for view in fixed.views]
        # The last row's robot was never logged, and the first one's twice.
        np.testing.assert_array_equal(found[:-1], joints[:-1], err_msg=name)
        assert found[-1] is None
        assert fixed.digest() != session.digest()
        assert any("read otherwise" in warning for warning in fixed.warnings)


def test_what_joints_cannot_be_is_refused(late):
    foreign, _ = late(with_poses=False)
    recorded = DoubtfulSession.of(foreign)
    best = recorded.guess().best
    inverse = replace(best.hypothesis, robot=replace(best.hypothesis.robot, inverse=True))
    with pytest.raises(DataError, match="known by its joint angles alone"):
        reread(recorded, replace(best, hypothesis=inverse))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_mount_of_samples_that_do_not_say_it(tmp_path, mount):
    options = CellOptions(mount=mount, views=12)
    sound = Session.load(write_session(simulate(options), tmp_path / "cell", images=False))
    robot, camera = (
        np.array([getattr(view, name)().as_matrix() for view in sound.views])
        for name in ("base_from_flange", "cam_from_target")
    )
    # With the camera on the base easy_handeye2 stores the inverse.
    stored = robot if mount == "eye-in-hand" else invert(robot)
    source = easy_handeye_file(tmp_path / "cell.samples", stored, camera)
    done = guessed(source, tmp_path / "read", "--yes")
    assert done.exit_code == 0, done.stderr
    session = Session.load(tmp_path / "read")
    assert session.mount == mount
    found = np.array([view.base_from_flange().as_matrix() for view in session.views])
    # A quaternion and back, and two inversions, in double precision.
    np.testing.assert_allclose(found, robot, atol=1e-13)


def test_poses_that_close_under_no_reading_are_not_written(cell, tmp_path):
    def scrambled(rows):
        turns = np.random.default_rng(0).normal(size=(len(rows), 4))
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        for row, turn in zip(rows, turns.tolist(), strict=True):
            row.update(zip(POSE[3:], map(repr, turn), strict=True))

    rewritten(cell, scrambled)
    done = guessed(cell, tmp_path / "fixed", "--yes")
    assert isinstance(done.exception, DataError)
    assert "no other reading stands out" in str(done.exception)
    assert not (tmp_path / "fixed").exists()


def test_a_robot_that_nobody_knows_is_named_with_what_to_correct(cell):
    document = cell / "session.toml"
    document.write_text(document.read_text("utf-8").replace('"ur10e"', '"ur10ee"'), "utf-8")
    found = visioncal.doctor(cell).findings[0]
    assert found.kind == "misread_joints"
    assert "There is no robot named 'ur10ee'. Did you mean ur10e" in found.words
    assert found.do.words.startswith("Correct [robot] model in session.toml")
    # Without poses there is no result, and that is why.
    rewritten(cell, lambda rows: [row.update(dict.fromkeys(POSE, "")) for row in rows])
    with pytest.raises(DataError) as caught:
        visioncal.calibrate(cell)
    assert caught.value.message.startswith("session.toml: robot.model: There is no robot named")
    assert caught.value.next_step == found.do.words
