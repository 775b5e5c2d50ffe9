"""The verdict on a whole cell names what is wrong: a camera, a pose, a board, the motion."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import observed, pose, world
from support.whole_cells import FLOOR, OPTIONS, PLATE, recorded

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError, DegenerateError
from visioncal.interchange.formats.rereading import exchange_views
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import (
    BoardAt,
    CameraAt,
    RobotAt,
    cell_session,
    fine_camera,
    simulate,
)

# Three cameras, so that two or more see by way of a robot at most stops.
CELL = replace(
    OPTIONS,
    cameras=(
        *OPTIONS.cameras,
        CameraAt("right", place_m=(0.3, -1.0, 1.2), camera=fine_camera()),
    ),
    boards=(
        BoardAt("floor", place_m=(0.0, 0.0, 0.05), target=FLOOR),
        BoardAt("plate_a", on="a", target=FLOOR),
        BoardAt("plate_b", on="b", target=PLATE),
    ),
    stops=16,
)


@pytest.fixture(scope="module")
def session():
    return recorded(simulate(CELL))


def rewritten(session, change, document=None):
    """The session with its rows as `change` makes them: a function of the view and its texts."""
    rows = []
    for view in session.views:
        row = {column: view.cell(column) for column in session.columns}
        change(view, row)
        rows.append(list(row.values()))
    return Session.assemble(
        document or session.document,
        session.columns,
        rows,
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=session.corner_table,
    )


def of_plate(session, plate, stop):
    """The views of a plate at a stop, one of which has the pose of its robot."""
    return [
        view.number for view in session.views if view.stop == stop and view.text["target"] == plate
    ]


def seen_often(session, plate):
    """The stops at which several cameras see a plate, after the first ones."""
    return [index for index in range(3, CELL.stops) if len(of_plate(session, plate, index)) > 1]


def poses(session, robot):
    """The rows that have a robot's pose by stop, without its joints: they go with the pose."""
    rows = {}
    for view in session.views:
        if view.text.get("robot") == robot and view.cell("x_m"):
            row = {column: view.cell(column) for column in session.columns[5:]}
            rows[view.stop] = row | {value: "" for value in row if value.endswith("_rad")}
    return rows


def test_a_sound_cell_is_good_and_says_how_good(session):
    found = calibrate(session)
    assert found.verdict.status == "good"
    good_for, reason = found.verdict.reasons
    assert good_for.startswith("It is good for tasks of ")
    used = sum(view.used for view in found.views)
    assert reason.startswith(
        f"All {used} used views agree. Checked with views that were not used in the fit:"
    )
    assert "offset along the cell's" in reason


@pytest.mark.slow
def test_frames_that_take_up_a_calibrated_arms_zeros_are_no_doubt():
    slipped = RobotAt("b", CELL.robots[1].place_m, offset_sigma_rad=5e-3)
    found = calibrate(
        recorded(simulate(replace(CELL, robots=(CELL.robots[0], slipped), stops=24, seed=0)))
    )
    # No stop tells the zeros of the first joint and of the last one from a base and a plate that
    # are turned, and more stops would not: both are as uncertain as zeros of 5 mrad (0.29 deg),
    # whose size is estimated from four others to a third.
    assert found.cell.robots["b"].arm.level == "offsets"
    assert found.edges["cell_from_base_b"].sigma_deg > 0.2
    assert found.edges["flange_b_from_target_plate_b"].sigma_deg > 0.2
    assert found.verdict.status == "good", found.verdict.reasons


def test_one_wrong_pose_of_a_robot_is_named(session):
    stop = seen_often(session, "plate_b")[0]
    mine, pose = of_plate(session, "plate_b", stop), poses(session, "b")[stop]

    def push(view, row):
        if view.stop == stop and view.text.get("robot") == "b" and view.cell("x_m"):
            row.update(pose | {"x_m": repr(float(pose["x_m"]) + 0.02)})

    found = calibrate(rewritten(session, push))
    (reason,) = [reason for reason in found.verdict.reasons if "Robot b did not stand" in reason]
    assert f"at stop {stop} where its pose says: all {len(mine)} views" in reason
    assert "moved by 20 mm" in reason
    assert all(str(value) in reason for value in mine)
    assert found.verdict.status == "check"
    # What a fault explains is not said once more of each camera.
    assert not any("were left out; view" in reason for reason in found.verdict.reasons)
    why = {view.view: view.reason for view in found.views if not view.used}
    assert sorted(why) == mine
    assert all(f"the pose of robot b at stop {stop} is wrong" in name for name in why.values())


def test_a_robot_whose_poses_are_misread_is_named_first(session):
    def turn(view, row):
        # w first: what other programs write into the same columns.
        if view.text.get("robot") == "b" and row["qx"]:
            turned = [row[name] for name in ("qw", "qx", "qy", "qz")]
            row.update(zip(POSE[3:], turned, strict=True))
        row.update({value: "" for value in row if value.endswith("_rad")})

    with pytest.raises(DegenerateError) as refused:
        calibrate(rewritten(session, turn))
    words = "Robot b: With the robot's rotations as a quaternion w, x, y, z, robot and camera"
    assert str(refused.value).startswith(words)
    assert "rows of robot b in views.csv" in refused.value.next_step


@pytest.mark.slow
def test_poses_of_a_robot_that_are_exchanged_are_named(session):
    first, second = seen_often(session, "plate_b")[:2]
    told = poses(session, "b")

    def exchange(view, row):
        other = {first: second, second: first}.get(view.stop)
        if other is not None and view.text.get("robot") == "b" and view.cell("x_m"):
            row.update(told[other])

    found = calibrate(rewritten(session, exchange))
    words = f"The poses of robot b at stops {first} and {second} are exchanged: views"
    assert any(reason.startswith(words) for reason in found.verdict.reasons)
    out = [view.view for view in found.views if not view.used]
    assert out == [*of_plate(session, "plate_b", first), *of_plate(session, "plate_b", second)]


@pytest.mark.slow
def test_two_images_that_are_exchanged_have_a_command_that_mends_them(session):
    # The images of one camera at two stops.
    views = [view for view in session.views if view.text["target"] == "plate_b"]
    of_one = [view.number for view in views if view.text["camera"] == views[0].text["camera"]]
    first, second = of_one[1], of_one[3]
    swapped = exchange_views(session, first, second)
    found = calibrate(swapped)
    (wrong,) = (finding for finding in found.verdict.findings if finding.kind == "exchanged_views")
    assert set(wrong.views) == {first, second}
    assert f"--exchange {first},{second}" in wrong.do.command
    mended = exchange_views(swapped, first, second)
    assert len(mended.declaration.corrected) == 2
    for at in (first, second):
        (was,) = (view for view in session.views if view.number == at)
        (now,) = (view for view in mended.views if view.number == at)
        assert now.numbers == was.numbers
    other = next(view.number for view in session.views if view.text["target"] != "plate_b")
    with pytest.raises(DataError, match=r"of another .*target"):
        exchange_views(session, first, other)


@pytest.mark.slow
def test_a_camera_whose_corners_are_bad_is_named(session):
    table = session.corner_table
    mine = {view.number for view in session.views if view.text.get("camera") == "right"}
    noise = np.random.default_rng(0).normal(0.0, 1.5, table.px.shape)
    blurred = np.where(np.isin(table.views, list(mine))[:, None], table.px + noise, table.px)
    verdict = calibrate(replace(session, corner_table=replace(table, px=blurred))).verdict
    assert verdict.status == "check"
    (reason,) = [reason for reason in verdict.reasons if "corners deviate" in reason]
    assert reason.startswith("cam_right: corners deviate by 1.5 px")
    assert not any(reason.startswith(("cam_left: ", "cam_hand: ")) for reason in verdict.reasons)


@pytest.mark.slow
def test_a_board_that_is_bent_is_named():
    boards = (*CELL.boards[:2], replace(CELL.boards[2], bow_m=1e-3))
    verdict = calibrate(recorded(simulate(replace(CELL, boards=boards)))).verdict
    assert any(reason.startswith("The board plate_b is not flat") for reason in verdict.reasons)
    assert sum("not flat" in reason for reason in verdict.reasons) == 1


def test_points_of_targets_that_are_exchanged_are_refused(session):
    """A checkerboard of 54 points under the name of a ChArUco board of 40, and the reverse."""
    targets = dict(session.target_document)
    targets["floor"], targets["plate_b"] = targets["plate_b"], targets["floor"]
    with pytest.raises(DataError, match="has no point 40; its 40 points"):
        Session.assemble(
            session.document,
            session.columns,
            [[view.cell(column) for column in session.columns] for view in session.views],
            session.images,
            target_document=targets,
            corners=session.corner_table,
        )


def turned(tilt_deg, stops=14, noise=1.0):
    """A session of measured poses in which robot b is tilted by so much, and turned about z."""
    rng = np.random.default_rng(3)
    cell = world(rng, stops, seen=1.0)
    angles = rng.uniform(-1.0, 1.0, (stops, 3)) * [tilt_deg, tilt_deg, 35.0]
    places = np.array([0.9, 0.1, 0.45]) + rng.uniform(-0.2, 0.2, (stops, 3))
    flanges = [pose(*pair) for pair in zip(angles, places, strict=True)]
    cell.flanges["b"] = np.linalg.inv(cell.truth["base_b"]) @ np.array(flanges)
    problem = observed(cell, rng, noise=noise)
    seen, rows, told = problem.observations, [], set()
    for at, (camera, target, stop) in enumerate(cell.pairs):
        row = {"view": at, "stop": stop, "camera": camera[4:], "target": target[7:]}
        # Each robot's pose stands once a stop.
        robot = {"target_a": "a", "target_b": "b"}.get(target)
        fresh = robot is not None and (robot, stop) not in told
        told.add((robot, stop))
        row["robot"] = robot if fresh else ""
        row |= pose_row(problem.poses[robot][stop]) if fresh else dict.fromkeys(POSE, "")
        row |= {f"cft_{name}": value for name, value in pose_row(seen.measured[at]).items()}
        rows.append(row)
    document = {
        "schema": 1,
        "name": "turned",
        "cameras": {"left": {}, "right": {}},
        "robots": {"a": {}, "b": {}},
        "targets": {name: {"target": "charuco_9x6_30mm"} for name in ("floor", "a", "b")},
        "frames": {
            **dict.fromkeys(("cam_left", "cam_right", "target_floor"), "cell"),
            "target_a": "flange_a",
            "target_b": "flange_b",
        },
    }
    cells = [[str(value) for value in row.values()] for row in rows]
    return Session.assemble(document, list(rows[0]), cells, MemoryImages({}))


def test_poor_motion_is_refused_with_the_direction_that_it_leaves_open():
    with pytest.raises(
        DegenerateError, match="offset along the cell's z has a predicted"
    ) as caught:
        calibrate(turned(0.3))
    assert "base_b's offset along the cell's z" in caught.value.culprits
    assert "all 14 stops of robot b turn about base_b's z to within 0." in caught.value.message


def test_noise_refuses_nothing():
    # Thirty times a usual camera's and robot's.
    verdict = calibrate(turned(35.0, noise=30.0)).verdict
    assert verdict.status == "bad"
    assert any("Weakly determined by the motion" in reason for reason in verdict.reasons)
    assert sum("Left out of the fit, views disagree" in reason for reason in verdict.reasons) == 1


@pytest.mark.slow
def test_poses_that_were_measured_worse_than_others_are_no_outliers():
    # A board that is seen squarely turns unseen: errors of its pose have no single size.
    poses = cell_session(simulate(replace(CELL, seed=6)), "two arms", seen="poses")
    found = calibrate(poses)
    assert found.verdict.status == "good"
    assert all(view.used for view in found.views)
