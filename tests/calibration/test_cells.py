"""Whole cells: frames and their sigmas, what is wrong with them, priors, drift and clocks."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.drawn import column
from support.edited import rewritten
from support.marks import slow
from support.misfits import misfit
from support.problems import observed, pose, world
from support.refusals import raised
from support.slopes import twists
from support.whole_cells import OPTIONS, recorded

from visioncal import results
from visioncal.calibration.pipeline.checkup import doctor
from visioncal.calibration.run import calibrate
from visioncal.calibration.suspects.moved_frames import moved_findings
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import view_words
from visioncal.core.transforms import exp, invert
from visioncal.core.types import Target
from visioncal.interchange.formats.mending import exchange_views, shift_views
from visioncal.present.recording import paths, read_evidence
from visioncal.results import Calibration
from visioncal.results.edge import Edge
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    BoardAt,
    CameraAt,
    NetworkOptions,
    RobotAt,
    Swept,
    cell_session,
    simulate,
    write_session,
)
from visioncal.simulation.heat import Heat
from visioncal.simulation.layout import InstrumentAt, Moved, PointAt

# Looks the same after half a turn: both counts are even.
ALIKE = Target("checkerboard_8x6_25mm", "checkerboard", 8, 6, 0.025, 2.5e-5)
FLOOR = BoardAt("floor", place_m=(0.0, 0.0, 0.05))
LEFT = CameraAt("left", place_m=(0.0, -1.0, 1.1))
PLAIN = NetworkOptions(stops=20)
ROBOTS = PLAIN.robots
# Chi-square of six, and of twelve, exceed these in one case of a thousand.
MOST, MOST_OF_TWELVE = 22.5, 32.9


def session_of(cell, **document):
    """The session of a cell, of which something more is said."""
    session = cell_session(cell, "cell", seen="names")
    return replace(session, document={**session.document, **document})


def solved(cell, session=None, level="auto", **document):
    """The calibration of a cell, from its corners."""
    corners = {corner.view: corner for corner in cell.corners}
    return calibrate(session or session_of(cell, **document), corners=corners, level=level)


def off(cell, found, first, second):
    """Distance [m] of a frame from where it is in another, and the squared error in sigmas."""
    edge, truth = found.between(first, second), cell.between(first, second)
    return np.linalg.norm((invert(truth) @ edge.matrix)[:3, 3]), misfit(edge, truth)


def reason(found, words):
    """The one reason of a verdict with these words."""
    (said,) = (reason for reason in found.verdict.reasons if words in reason)
    return said


@pytest.fixture(scope="module")
def clean():
    cell = simulate(PLAIN)
    return cell, solved(cell)


def test_a_sound_cell_is_as_near_as_its_covariance_says_and_is_good(clean):
    cell, found = clean
    away_m, squared = off(cell, found, "base_a", "base_b")
    # 2e-4 m: four sigma of what twenty stops tell at a metre.
    assert away_m < 2e-4
    assert squared < MOST
    assert found.tree.edge_of("base_b").sigma_mm < 0.1
    assert off(cell, found, "cam_left", "cam_right")[1] < MOST
    assert all(view.used for view in found.views)
    assert not found.cell.moved
    assert found.cell.reference == "base_a"
    noise, sigma_px = found.cell.noise, cell.options.pixel_sigma_px
    assert noise["cam_left"]["pixel_px"] == pytest.approx(sigma_px, rel=0.1)
    # Twenty stops tell a robot's to some 15 %.
    assert [noise[name]["translation_mm"] for name in "ab"] == pytest.approx([0.03] * 2, rel=0.5)
    assert found.verdict.status == "good"
    assert reason(found, "It is good for tasks of ")
    assert reason(found, f"All {len(found.views)} used views agree. Checked with views that")


@pytest.fixture(scope="module")
def three():
    """The session of a cell of three cameras: two or more see by way of a robot at most stops."""
    right = CameraAt("right", place_m=(0.3, -1.0, 1.2), camera=CAMERAS["fine"])
    cameras = (*OPTIONS.cameras, right)
    return recorded(simulate(replace(OPTIONS, cameras=cameras, stops=12)))


def test_any_frame_is_placed_in_any_other_with_the_covariance_of_the_chain(clean):
    _, found = clean
    forth, back = found.between("cam_left", "base_b"), found.between("base_b", "cam_left")
    np.testing.assert_allclose(forth.matrix @ back.matrix, np.eye(4), atol=1e-12)
    assert not found.between("base_a", "base_a").covariance.any()
    ends = ("cam_left", "target_plate_b")
    poses = {"b": exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, 0.6]))}

    def moved(by):
        steps = zip(found.edges.items(), exp(by.reshape(-1, 6)), strict=True)
        edges = {name: replace(edge, matrix=edge.matrix @ step) for (name, edge), step in steps}
        return replace(found, edges=edges).between(*ends, poses).matrix

    jacobian = twists(moved, 6 * len(found.edges))
    expected = jacobian @ found.joint_covariance @ jacobian.T
    # Differences of 1e-6 are exact to 1e-6 of themselves.
    covariance = found.between(*ends, poses).covariance
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-13)
    raised(DataError, "moves with robot .b., whose pose must be given", found.between, *ends)
    raised(DataError, "no frame 'cam_lft'", found.between, "cam_lft", "base_a")


def test_cameras_that_have_each_others_images_from_a_stop_on_are_no_moves():
    top, side = np.eye(4), exp(np.array([0.0, 1.0, 0.0, 1.9, 0.0, 0.0]))
    near = exp(np.array([0.0, 0.0, 1e-3, 1e-3, 0.0, 0.0]))
    places = {"cam_top": side @ near, "cam_side": top, "target_floor": side}
    places |= {"cam_top_until_stop_19": top, "cam_side_until_stop_19": side}
    places |= {"target_floor_until_stop_19": near}
    edges = {name: Edge(place, np.eye(6)) for name, place in places.items()}
    moves = [
        move
        for frame in ("cam_top", "target_floor", "cam_side")
        for move in [results.Moved(frame, f"{frame}_until_stop_19", 19, 20, 1900.0, 57.0)]
    ]
    found = [finding.words for finding in moved_findings(moves, edges)]
    assert len(found) == 2
    assert found[0].startswith("From stop 20 on, or up to there, cam_top and cam_side have each")
    assert found[1].startswith("target_floor moved between stops 19 and 20, by 1900 mm")
    # A camera that came near to another's place is moved.
    first_words = [finding.words for finding in moved_findings(moves[:2], edges)]
    assert first_words[0].startswith("cam_top was bumped between stops 19 and 20")


def test_the_joint_covariance_is_in_the_order_of_the_transforms_where_a_frame_moved():
    boards = (FLOOR, BoardAt("plate_a", "a"))
    options = replace(PLAIN, robots=ROBOTS[:1], boards=boards, stops=12, seed=3)
    found = solved(simulate(replace(options, moved=(Moved("cam_left", 6),))))
    assert [value.frame for value in found.cell.moved] == ["cam_left"]
    for at, edge in enumerate(found.edges.values()):
        block = found.joint_covariance[6 * at :, 6 * at :][:6, :6]
        # They are the same numbers.
        np.testing.assert_allclose(block, edge.covariance, rtol=1e-12)


@pytest.mark.slow
def test_all_faults_are_named_and_the_answer_is_that_of_a_sound_cell():
    pushes = (Moved("target_floor", 9), Moved("cam_right", 12))
    cell = simulate(replace(PLAIN, moved=pushes, swapped_rows=1, stray_images=3, seed=3))
    found = solved(cell)
    moved = [(value.before, value.last_stop, value.first_stop) for value in found.cell.moved]
    assert moved == [("target_floor_until_stop_8", 8, 9), ("cam_right_until_stop_11", 11, 12)]
    assert [value.frame for value in found.cell.moved] == ["target_floor", "cam_right"]
    assert {f"cell_from_{before}" for before, *_ in moved} < set(found.edges)
    # A pushed frame's own place is known to 0.1 mm.
    assert [value.shift_mm for value in found.cell.moved] == pytest.approx([5.0] * 2, abs=0.4)
    reasons = {view.view: view.reason for view in found.views if not view.used}
    assert sorted(reasons) == list(cell.wrong_views)
    assert sum("exchanged" in reason for reason in reasons.values()) == 2
    assert sum("its image is of stop" in reason for reason in reasons.values()) == 3
    assert found.verdict.status == "check"
    assert reason(found, "cam_right was bumped between stops 11 and 12")
    away_m, squared = off(cell, found, "base_a", "base_b")
    assert squared < MOST
    assert away_m < 2.5e-4


def test_a_camera_that_was_bumped_is_not_one_whose_lens_crept():
    cell = simulate(replace(PLAIN, moved=(Moved("cam_left", 9, shift_m=0.02),), seed=5))
    assert [cause.kind for cause in solved(cell).verdict.causes] == ["moved_frame"]


def test_a_camera_that_was_bumped_before_most_of_the_earliest_stops_is_named():
    boards = (FLOOR, BoardAt("plate_a", "a"))
    options = replace(PLAIN, robots=ROBOTS[:1], boards=boards, stops=36, seed=5)
    found = solved(simulate(replace(options, moved=(Moved("cam_left", 6, shift_m=0.02),))))
    assert [(value.frame, value.first_stop) for value in found.cell.moved] == [("cam_left", 6)]
    assert all(view.used for view in found.views)


@pytest.mark.parametrize("stop", [slow(6), 12])
def test_a_base_that_was_pushed_is_one_finding(stop):
    cell = simulate(replace(PLAIN, moved=(Moved("base_b", stop),), seed=3))
    found = solved(cell)
    assert reason(found, f"Between stops {stop - 1} and {stop}, base_b moved by 5.1 mm and 0.57")
    (fault,) = (at for at in found.verdict.findings if at.kind == "something_moved")
    assert sorted(fault.views) == [view.view for view in found.views if not view.used]
    first = min(view.number for view in session_of(cell).views if view.stop == stop)
    assert fault.do.command.endswith(f"--views {first}-79")
    # The result has it where it stood first.
    away_m, squared = off(cell, found, "base_a", "base_b")
    assert squared < MOST
    assert away_m < 2.5e-4


@pytest.mark.parametrize("frame", ["cam_right", slow("target_floor")])
def test_a_frame_that_creeps_was_not_bumped_again_and_again(frame):
    crept = Moved(frame, creeps=True, shift_m=0.012)
    cell = simulate(replace(PLAIN, moved=(crept,), stops=14, seed=3))
    found = solved(cell)
    assert not found.cell.moved
    assert all(view.used for view in found.views)
    assert f"{frame} by 12 mm and 0.5" in reason(found, "crept during the session")
    # The result is that of its end.
    for ends in (("base_a", "base_b"), ("base_a", frame)):
        away_m, squared = off(cell, found, *ends)
        assert squared < MOST
        assert away_m < 5e-4


@pytest.mark.slow
def test_a_robot_whose_poses_are_misread_is_named_first(three):
    def turned(view):
        """With w first: what other programs write into the same columns."""
        numbers = {name: number for name, number in view.numbers.items() if name in POSE}
        if view.text.get("robot") == "b" and numbers:
            order = [numbers[name] for name in ("qw", "qx", "qy", "qz")]
            numbers |= dict(zip(POSE[3:], order, strict=True))
        return replace(view, numbers=numbers)

    with pytest.raises(DegenerateError) as refused:
        calibrate(replace(three, views=tuple(map(turned, three.views))))
    words = "Robot b: With the robot's rotations as a quaternion w, x, y, z, robot and camera"
    assert str(refused.value).startswith(words)
    # The command reads the rows of this robot anew, and none else.
    assert "visioncal convert SESSION FIXED --guess --yes && " in refused.value.next_step


def misread(session, changes):
    """The session with the poses of some robots, by name, changed by functions of (4, 4) poses."""
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    for view, row in zip(session.views, cells, strict=True):
        at = view.base_from_flange()
        if at is not None and view.text["robot"] in changes:
            numbers = pose_row(changes[view.text["robot"]](at.as_matrix()))
            row.update({name: str(number) for name, number in numbers.items()})
    rows = [[row[name] for name in session.columns] for row in cells]
    return session.with_content(document=session.document, cells=rows)


def in_mm(matrix):
    return matrix * np.append(np.ones(3), 1e3)


@pytest.mark.parametrize(
    "changes", [slow({"a": in_mm}), slow({"b": invert}), {"a": in_mm, "b": invert}]
)
def test_robots_of_a_cell_are_read_anew_one_by_one(tmp_path, monkeypatch, three, changes):
    monkeypatch.chdir(tmp_path)
    misread(three, changes).save("cell")
    found = visioncal("doctor", "cell").said
    line = next(at for at in found.splitlines() if "convert cell" in at)
    assert line.strip().startswith("visioncal convert cell cell-fixed --guess --yes && ")
    said = visioncal("convert", "cell", "cell-fixed", "--guess", "--yes").good().said
    mended = Session.load("cell-fixed")
    assert [f"Robot {name}:" in said for name in "ab"] == [name in changes for name in "ab"]
    assert len(mended.declaration.corrected) == len(changes)
    for before, after in zip(three.views, mended.views, strict=True):
        first, second = before.base_from_flange(), after.base_from_flange()
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            # To the digits of what was written.
            np.testing.assert_allclose(second.as_matrix(), first.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("column", "names", "stops"),
    [
        ("camera", ("left", "right"), (4, 5, 6)),
        slow("target", ("plate_a", "floor"), (3, 7, 9)),
        ("robot", ("a", "b"), (4, 5, 6)),
    ],
)
def test_rows_with_the_name_of_another_camera_or_board_are_named(column, names, stops):
    right = CameraAt("right", place_m=(0.3, -1.0, 1.2), camera=CAMERAS["fine"])
    cell = simulate(replace(OPTIONS, cameras=(*OPTIONS.cameras, right), stops=14))
    session, other = cell_session(cell, "cell", seen="poses"), dict([names, names[::-1]])
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    wrong = dict[int, str]()
    for view, row in zip(session.views, cells, strict=True):
        # Both robots' poses at a stop are exchanged, whatever their rows see.
        is_spared = row["camera"] == "hand" and column != "robot"
        if view.stop in stops and not is_spared and row[column] in other:
            row[column] = wrong[view.number] = other[row[column]]
    rows = [[row[name] for name in session.columns] for row in cells]
    found = calibrate(session.with_content(document=session.document, cells=rows))
    (cause,) = (at for at in found.verdict.causes if at.kind == "misnamed_rows")
    assert cause is found.verdict.causes[0]
    # Rows may have a robot's pose alone: these are none that were left out.
    assert {*cause.views} == {
        view.number for view in session.views if view.number in wrong and "cft_x_m" in view.numbers
    }
    for name in names:
        views = [view for view in sorted(wrong) if wrong[view] == name]
        assert f"{other[name]} for {name} in column {column} of view" in cause.do.words
        assert f"column {column} of {view_words(views)}" in cause.do.words


@pytest.mark.parametrize(
    ("stops", "words"),
    [((5, 7), "fit a pose of their target"), ((5,), "fits a pose of its target")],
)
def test_rows_with_the_name_of_a_camera_of_another_lens_are_named(stops, words):
    fine, names = CAMERAS["fine"], {"left": "hand", "hand": "left"}
    short = replace(fine, matrix=np.array(fine.matrix) * [0.67, 0.67, 1.0, 1.0])
    cameras = (OPTIONS.cameras[0], CameraAt("hand", on="a", camera=short))
    session = recorded(simulate(replace(OPTIONS, cameras=cameras, stops=16)))
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    wrong = set[int]()
    for view, row in zip(session.views, cells, strict=True):
        is_first = len(stops) > 1 or not wrong
        if view.stop in stops and row["camera"] in names and is_first:
            row["camera"] = names[row["camera"]]
            wrong.add(view.number)
    rows = [[row[name] for name in session.columns] for row in cells]
    found = calibrate(session.with_content(document=session.document, cells=rows))
    cause = found.verdict.causes[0]
    assert cause.kind == "misnamed_rows"
    assert {*cause.views} == wrong
    assert words in cause.words
    assert "left for hand in column camera of view" in cause.do.words
    assert ("hand for left in column camera of view" in cause.do.words) == (len(stops) > 1)


def between_arms(folder, change):
    """A session of a camera on one arm before a board on another, which a fixed one sees, too.

    `change` is given what the hand sees at 16 stops, (16, 4, 4), and returns what the fixed one
    sees of a board on the floor, by stop; the hand sees that, too, at some of the first stops.
    """
    rng = np.random.default_rng(5)
    flange_a, flange_b = (
        exp(np.column_stack([rng.normal(0, 0.5, (16, 3)), rng.uniform(0.2, 0.6, (16, 3))]))
        for _ in "ab"
    )
    x, y, base_b, top, floor = exp(
        np.array([[0.2, 0.1, 1.0, 0.03, 0.05, 0.08], [0.1, 3.0, 0.2, 0.0, 0.02, 0.06],
                  [0.0, 0.0, 2.9, 1.3, 0.1, 0.0], [2.2, 0.3, 0.1, 0.6, -0.9, 0.9],
                  [3.0, 0.1, 0.1, 0.5, -0.2, 0.0]])
    )  # fmt: skip
    noise = exp(rng.normal(0, 1e-4, (3, 16, 6)))
    plate = base_b @ flange_b @ y
    by_hand, by_top = invert(flange_a @ x) @ plate @ noise[0], invert(top) @ plate @ noise[1]
    on_floor = invert(flange_a @ x) @ floor @ noise[2]
    by_top_on_floor = change(by_hand)
    cft = [f"cft_{name}" for name in POSE]
    rows = [",".join(["view", "stop", "camera", "target", "robot", *POSE, *cft])]
    for stop in range(16):
        seen = [("hand", "plate", "a", by_hand[stop]), ("top", "plate", "b", by_top[stop])]
        seen += [("hand", "floor", "a", on_floor[stop])] * (stop % 2 and stop < 9)
        if stop in by_top_on_floor:
            seen.append(("top", "floor", "", by_top_on_floor[stop]))
        for camera, target, robot, pose_seen in seen:
            flange = {"a": flange_a, "b": flange_b}.get(robot)
            state = [""] * 7 if flange is None else pose_row(flange[stop]).values()
            numbers = [*state, *pose_row(pose_seen).values()]
            rows.append(",".join(map(str, [len(rows) - 1, stop, camera, target, robot, *numbers])))
    folder.mkdir()
    (folder / "views.csv").write_text("\n".join(rows) + "\n", "utf-8")
    (folder / "session.toml").write_text(
        'schema = 1\nname = "cell"\n[robots]\na = {}\nb = {}\n[cameras]\nhand = {}\ntop = {}\n'
        '[targets]\nplate = "charuco_9x6_30mm"\nfloor = "charuco_7x5_36mm"\n[frames]\n'
        'cam_hand = "flange_a"\ncam_top = "cell"\ntarget_plate = "flange_b"\n'
        'target_floor = "cell"\n',
        "utf-8",
    )
    return Session.load(folder), base_b


def test_pictures_of_a_camera_on_one_arm_before_a_board_on_another_that_are_a_stop_apart(tmp_path):
    def later(by_hand):
        # From stop 9 on, they are those of the stop before.
        by_hand[9:] = by_hand[8:-1].copy()
        return {}

    session, _ = between_arms(tmp_path / "cell", later)
    (cause, *_) = calibrate(session).verdict.causes
    of_hand = [view.number for view in session.views if view.cell("target") == "plate"
               and view.cell("camera") == "hand" and view.stop >= 9]  # fmt: skip
    assert cause.kind == "shifted_rows"
    first = f"From view {of_hand[0]} on, images of cam_hand are apart from their rows"
    assert cause.words.startswith(first)
    option = cause.do.option
    assert [*option.views] == [
        view.number
        for view in session.views
        if view.cell("camera") == "hand" and view.number >= of_hand[0]
    ]
    assert option.value == "-1:images"


@pytest.mark.parametrize("stops", [(4,), (4, 9)])
def test_a_few_wrong_views_of_fixed_frames_do_not_join_these(tmp_path, stops):
    session, base_b = between_arms(
        tmp_path / "cell", lambda by_hand: {stop: by_hand[stop] for stop in stops}
    )
    found = calibrate(session)
    lost = [view.view for view in found.views if not view.used]
    numbers = [view.number for view in session.views
               if view.cell("camera") == "top" and view.cell("target") == "floor"]  # fmt: skip
    assert lost == numbers
    away = invert(base_b) @ found.between("base_a", "base_b").matrix
    assert np.linalg.norm(away[:3, 3]) < 1e-3


def test_a_log_that_is_stuck_at_stops_of_two_boards_is_one_finding_with_one_command():
    cell = simulate(replace(OPTIONS, stops=20))
    session = cell_session(cell, "cell", seen="poses")
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    # The plate on a is seen at stop 10, the floor by the camera on a at stop 11.
    of_a = [at for at, row in enumerate(cells) if row["robot"] == "a"]
    (source,) = {
        tuple(cells[at][name] for name in POSE) for at in of_a if session.views[at].stop == 9
    }
    stuck = [at for at in of_a if session.views[at].stop in (10, 11)]
    for at in stuck:
        cells[at] |= dict(zip(POSE, source, strict=True))
    rows = [[row[name] for name in session.columns] for row in cells]
    verdict = calibrate(session.with_content(document=session.document, cells=rows)).verdict
    found = [one for one in verdict.findings if one.kind in ("copied_poses", "wrong_views")]
    assert [one.kind for one in found] == ["copied_poses"]
    assert {*found[0].views} == {session.views[at].number for at in stuck}


@pytest.mark.parametrize(("at_stops", "later"), [((5, 6, 7), 8), ((5,), 17)])
def test_a_sound_return_to_the_pose_of_a_stuck_log_is_not_accused(at_stops, later):
    """At the next stop, or much later: there the camera sees what it saw from this pose."""
    session = cell_session(simulate(replace(OPTIONS, stops=20)), "cell", seen="poses")
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    of_a = [(v, row) for v, row in zip(session.views, cells, strict=True) if row["robot"] == "a"]
    by_hand = {
        view.stop: row for view, row in of_a if (row["camera"], row["target"]) == ("hand", "floor")
    }
    first, back = by_hand[4], by_hand[later]
    back |= {name: first[name] for name in first if name in POSE or re.match(r"cft_|q\d", name)}
    # What is seen again differs by noise.
    back["cft_x_m"] = repr(float(back["cft_x_m"]) + 2e-6)
    stuck = [(view.number, row) for view, row in of_a if view.stop in at_stops]
    for _, row in stuck:
        row |= {name: first[name] for name in POSE}
    # Other cameras see another place at the stop of the return.
    lost = [id(row) for view, row in of_a if view.stop == later and row is not back]
    rows = [row for row in cells if id(row) not in lost]
    table = [[row[name] for name in session.columns] for row in rows]
    verdict = calibrate(session.with_content(document=session.document, cells=table)).verdict
    (found,) = (one for one in verdict.findings if one.kind == "copied_poses")
    assert [*found.views] == [view for view, _ in stuck]


@pytest.mark.slow
def test_rotation_vectors_of_a_whole_cell_become_quaternions(tmp_path, monkeypatch, three):
    monkeypatch.chdir(tmp_path)
    three.save("cell")
    turns = {
        view.number: at.as_matrix()[:3, :3]
        for view in three.views
        if (at := view.base_from_flange()) is not None
    }

    def as_vector(row):
        if int(row["view"]) not in turns:
            return row
        vector = Rotation.from_matrix(turns[int(row["view"])]).as_rotvec().tolist()
        return row | dict(zip(POSE[3:], [*map(str, vector), ""], strict=True))

    rewritten(Path("cell"), lambda _, row: as_vector(row))
    visioncal("calibrate", "cell").refused("visioncal convert cell cell-fixed --guess --yes && ")
    visioncal("convert", "cell", "cell-fixed", "--guess", "--yes").good()
    mended = Session.load("cell-fixed")
    # No number was misread: these are the columns of another form.
    assert not mended.declaration.corrected
    read = {at.number: at.base_from_flange() for at in mended.views}
    for number, turn in turns.items():
        np.testing.assert_allclose(read[number].as_matrix()[:3, :3], turn, atol=1e-9)


def test_rows_without_a_pose_stay_where_those_of_their_robot_are_shifted():
    options = NetworkOptions(
        robots=ROBOTS[:1], cameras=(LEFT,), boards=(FLOOR, BoardAt("plate", on="a")), stops=8
    )
    session = cell_session(simulate(options), "cell", seen="poses")
    posed = [view.number for view in session.views if view.base_from_flange() is not None]
    before = {view.number: view for view in session.views}
    # Rows that show the floor are named, too, as by a range of views.
    shifted = shift_views(session, range(posed[2], max(before) + 1), -1)
    after = {view.number: view for view in shifted.views}
    # The row before keeps its pose, which no other row has then.
    assert before.keys() - after.keys() == {posed[2]}
    for number, source in zip(posed[3:], posed[2:], strict=False):
        assert after[number].cell("x_m") == before[source].cell("x_m")
        assert after[number].cell("cft_x_m") == before[number].cell("cft_x_m")
    for number in after.keys() - {*posed[3:]}:
        assert all(after[number].cell(at) == before[number].cell(at) for at in session.columns)


@pytest.mark.slow
def test_a_sound_cell_stays_as_it_is_where_other_readings_are_tried(tmp_path, monkeypatch, three):
    monkeypatch.chdir(tmp_path)
    three.save("cell")
    said = visioncal("convert", "cell", "copy", "--guess", "--yes").good().said
    assert "note: The poses of each robot that enough views test fit as first read." in said
    assert Session.load("copy").digest() == Session.load("cell").digest()


@pytest.mark.slow
def test_a_robot_that_no_reading_mends_leaves_the_other_one_to_be_mended(
    tmp_path, monkeypatch, three
):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    turns = iter(exp(rng.normal(size=(200, 6))))
    misread(three, {"a": in_mm, "b": lambda matrix: matrix @ next(turns)}).save("cell")
    said = visioncal("convert", "cell", "cell-fixed", "--guess", "--yes").good().said
    assert "note: Poses of robot b stay as they are: no reading stands out." in said
    (note,) = Session.load("cell-fixed").declaration.corrected
    assert note.startswith("Poses of robot a are read otherwise than at first: ")


@pytest.mark.slow
def test_a_reading_of_more_than_a_robots_poses_is_left_to_the_user(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session = cell_session(simulate(replace(OPTIONS, stops=12)), "cell", seen="poses")
    names = ("cft_x_m", "cft_y_m", "cft_z_m")
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    for row in cells:
        row.update({name: str(1e3 * float(row[name])) for name in names if row[name]})
    rows = [[row[name] for name in session.columns] for row in cells]
    session.with_content(document=session.document, cells=rows).save("cell")
    refused = visioncal("convert", "cell", "cell-fixed", "--guess", "--yes")
    refused.refused("changes more than the poses of this robot: nothing was written")


@pytest.mark.slow
def test_boards_that_look_alike_from_both_ends_are_distinguished_across_cameras():
    cell = simulate(
        replace(PLAIN, boards=tuple(replace(board, target=ALIKE) for board in PLAIN.boards))
    )
    found = solved(cell)
    assert all(view.used for view in found.views)
    for frames in (("base_a", "base_b"), ("cam_left", "cam_right")):
        assert off(cell, found, *frames)[1] < MOST


@pytest.mark.slow
def test_a_lens_that_is_stated_wrong_is_refined(clean):
    cell, _ = clean
    cameras = session_of(cell).document["cameras"]
    wrong = np.add(cameras["left"]["matrix"], [8.0, 8.0, -3.0, 4.0])
    left = {**cameras["left"], "matrix": wrong.tolist(), "intrinsics": "auto"}
    found = solved(cell, cameras=cameras | {"left": left})
    got, said = found.cell.lenses["cam_left"], reason(found, "the given intrinsics do not fit")
    assert said.startswith("cam_left: ")
    assert "were refined" in said
    sigma = np.sqrt(np.diag(got.covariance))[:4]
    assert np.all(np.abs(got.camera.matrix - LEFT.camera.matrix) < 5 * sigma)
    assert off(cell, found, "base_a", "base_b")[1] < MOST


@pytest.mark.slow
def test_cameras_whose_wrong_lenses_are_held_leave_out_few_views():
    """They disagree about every stop, unless the board shrinks until they agree."""
    front = CameraAt("front", place_m=(0.9, -0.5, 1.2))
    right = CameraAt("right", place_m=(0.15, 0.95, 1.25))
    robot = RobotAt("a", (-0.6, 0.0, 0.0), wrong_stops=2)
    board = BoardAt("plate", "a", target=BOARDS["checkerboard"])
    cell = simulate(NetworkOptions((robot,), (LEFT, right, front), (board,), stops=16))
    cameras = {**session_of(cell).document["cameras"]}
    for name, share in (("left", 0.03), ("right", -0.03), ("front", 0.05)):
        longer = np.multiply(cameras[name]["matrix"], [1.0 + share, 1.0 + share, 1.0, 1.0])
        cameras[name] = {**cameras[name], "matrix": longer.tolist(), "intrinsics": "hold"}
    found = solved(cell, cameras=cameras)
    assert found.verdict.status == "bad"
    left_out = {view.view for view in found.views if not view.used}
    assert set(cell.wrong_views) <= left_out
    # An eighth is wrong, and the lenses make as many more doubtful at the most.
    assert len(left_out) < 0.25 * len(found.views)


@pytest.mark.slow
def test_cameras_in_the_hand_are_calibrated_by_given_poses():
    cameras = (CameraAt("left", "a"), CameraAt("right", "b"))
    cell = simulate(replace(PLAIN, cameras=cameras, boards=(FLOOR,)))
    found = calibrate(cell_session(cell, "cell", seen="poses"))
    away_m, squared = off(cell, found, "base_a", "base_b")
    assert away_m < 1e-3
    # The noise of the given poses is estimated, too: fewer are told than they are.
    assert squared < 40.0
    # A board that is seen squarely turns unseen: errors of its pose have no single size.
    assert all(view.used for view in found.views)


POINTS = (
    PointAt("n1", "cell", (0.2, 0.3, 0.1)),
    PointAt("n2", "cell", (-0.2, 0.35, 0.2)),
    PointAt("n3", "cell", (0.1, -0.4, 0.15)),
    PointAt("fa", "a", (0.05, 0.02, 0.08)),
    PointAt("fb", "b", (0.03, -0.04, 0.09)),
)
TRACKERS = (InstrumentAt("t1", (0.0, -3.0, 1.2)), InstrumentAt("t2", (0.5, 3.0, 1.2), 2.5))


def test_readings_of_points_that_are_off_at_some_stops_are_wrong_readings():
    """A single place shows no motion of the tracker: they are left out one by one."""
    points = tuple(
        replace(POINTS[-2], name=f"p{at}", place_m=(0.05, 0.03 * at, 0.08)) for at in (0, 1, 2)
    )
    options = NetworkOptions(
        robots=ROBOTS[:1], cameras=(CameraAt("hand", on="a"),), boards=(FLOOR,),
        instruments=TRACKERS[:1], points=points, stops=14,
    )  # fmt: skip
    cell = simulate(options)
    session = cell_session(cell, "cell", seen="poses")
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    off = set[int]()
    for view, row in zip(session.views, cells, strict=True):
        if row["meas_x_m"] and view.stop in (3, 7, 11):
            row["meas_x_m"] = str(float(row["meas_x_m"]) + 0.02)
            off.add(view.number)
    rows = [[row[name] for name in session.columns] for row in cells]
    found = calibrate(session.with_content(document=session.document, cells=rows))
    assert {view.view for view in found.views if not view.used} == off
    assert {cause.kind for cause in found.verdict.causes} == {"wrong_views"}


@pytest.mark.slow
def test_instruments_and_the_points_that_they_share_tie_robots_without_a_camera():
    cell = simulate(NetworkOptions(cameras=(), instruments=TRACKERS, points=POINTS, stops=12))
    # The second stands alone but for the points in the cell.
    kept = [read for read in cell.readings if read.instrument == "t1" or read.point[0] == "n"]
    found = solved(replace(cell, readings=tuple(kept)))
    for frames in (("base_a", "base_b"), ("instrument_t1", "instrument_t2")):
        assert off(cell, found, *frames)[1] < MOST
    # Places alone were read: a point's axes are its parent's by choice.
    assert not found.tree.edge_of("point_n1").oriented
    assert all(view.residual_deg is None for view in found.views)
    # Some 250 coordinates tell what a tracker's noise is of what is said of it, to 5 %.
    assert found.cell.noise["instrument_t1"]["level"] == pytest.approx(1.0, rel=0.25)


@pytest.mark.slow
def test_an_instrument_without_common_readings_is_reported_with_a_way_to_tie_it():
    cell = simulate(NetworkOptions(instruments=TRACKERS[:1], points=POINTS[:3], stops=8))
    untied = solved(cell).cell.untied
    (remedy,) = {value.remedy for value in untied if value.frame == "instrument_t1"}
    assert "read points on a robot's flange" in remedy


@pytest.mark.slow
def test_a_lone_camera_and_board_are_reported_with_a_way_to_tie_them():
    cell = simulate(replace(PLAIN, stops=8))
    kept = [one for one in cell.sights if (one.camera == "left") == (one.board == "floor")]
    untied = solved(replace(cell, sights=tuple(kept))).cell.untied
    steps = {value.frame: value.remedy for value in untied}
    assert steps.pop("cam_left") == (
        "To tie cam_left: let it see a board that is tied, at 5 stops or more."
    )
    assert steps == {
        "target_floor": "To tie target_floor: let a camera that is tied see it, at 5 stops or more."
    }


@pytest.mark.slow
def test_arms_that_err_are_named_and_their_offsets_found_where_that_is_asked_for():
    robots = tuple(replace(robot, offset_sigma_rad=1e-3) for robot in ROBOTS)
    cell = simulate(replace(PLAIN, robots=robots))
    reported = solved(cell, level="hand-eye")
    assert sum("follow the arm's posture" in reason for reason in reported.verdict.reasons) == 2
    found = solved(cell)
    assert found.verdict.status == "good"
    for robot in ("a", "b"):
        kinematics, real = found.cell.robots[robot].arm, cell.robots[robot]
        assert kinematics.level == "offsets"
        true = real.true_arm.offset - real.arm.offset
        zeros = [value for value in kinematics.parameters if value.name == "theta_rad"]
        changes = np.array([zero.change for zero in zeros])
        # Others than the first and the last are known to some 0.05 mrad by this many stops.
        assert changes[1:-1] == pytest.approx(true[1:-1], abs=2.5e-4)
        surprises = (changes - true) / [zero.sigma for zero in zeros]
        assert np.abs(surprises).max() < 4.5  # one of twelve in ten thousand sessions
        one, q = found.of("cam_left", robot, f"target_plate_{robot}"), real.joints
        poses = kinematics.robot.base_from_flange(q)
        np.testing.assert_allclose(one.standing(q), poses, atol=1e-12)
    assert off(cell, found, "cam_left", "cam_right")[1] < MOST
    after, before = (it.between("cam_left", "cam_right").sigma_mm for it in (found, reported))
    # Well under a half: what the arms err by puts the given lenses in doubt, too.
    assert after < 0.45 * before


@pytest.mark.slow
def test_a_robot_without_joints_stays_as_it_reports_itself():
    cell = simulate(replace(PLAIN, stops=8))
    session = session_of(cell)
    bare = [
        replace(view, numbers={name: it for name, it in view.numbers.items() if name in POSE})
        for view in session.views
    ]
    bare = replace(session, views=tuple(bare))
    found = solved(cell, bare, level="offsets")
    assert sum("stays as it reports itself" in reason for reason in found.verdict.reasons) == 2
    raised(DataError, "level 'all'", calibrate, bare, level="all")


def test_an_untied_robot_is_refused_with_a_way_to_tie_it():
    cell = simulate(replace(PLAIN, boards=PLAIN.boards[:2], stops=8))
    caught = raised(DegenerateError, "nothing ties base_b to base_a", solved, cell)
    assert "a camera see a board, one of the two on base_b or on its robot" in caught.next_step


@pytest.mark.slow
def test_a_camera_that_one_standing_view_ties_is_refused():
    far = replace(LEFT, place_m=(0.0, -1.5, 1.6))
    boards, cameras = (FLOOR, BoardAt("plate_b", "b")), (far, CameraAt("hand", on="a"))
    cell = simulate(NetworkOptions(cameras=cameras, boards=boards, stops=12, pixel_sigma_px=0.3))
    kept = [sight for sight in cell.sights if (sight.camera, sight.board) != ("hand", "plate_b")]
    caught = raised(DegenerateError, "cam_left", solved, replace(cell, sights=tuple(kept)))
    assert "cam_left" in caught.next_step


@pytest.mark.slow
def test_a_camera_that_a_board_ties_either_way_round_is_refused():
    neighbour = CameraAt("right", place_m=(0.15, 0.95, 1.25), looks_at_m=(0.0, 0.0, 0.05))
    boards = (replace(FLOOR, target=ALIKE), BoardAt("plate_a", "a"))
    cell = simulate(NetworkOptions(ROBOTS[:1], cameras=(LEFT, neighbour), boards=boards, stops=12))
    kept = [sight for sight in cell.sights if (sight.camera, sight.board) != ("right", "plate_a")]
    with pytest.raises(DegenerateError, match="cam_right may be in two places: target_floor looks"):
        solved(replace(cell, sights=tuple(kept)))


def turned(tilt_deg, stops=14, noise=1.0, turn_deg=35.0, prior=None):
    """A session of measured poses in which robot b is tilted by so much, and turned about z."""
    rng = np.random.default_rng(3)
    cell = world(rng, stops, seen=1.0)
    angles = rng.uniform(-1.0, 1.0, (stops, 3)) * [tilt_deg, tilt_deg, turn_deg]
    places = np.array([0.9, 0.1, 0.45]) + rng.uniform(-0.2, 0.2, (stops, 3))
    flanges = [pose(*pair) for pair in zip(angles, places, strict=True)]
    cell.flanges["b"] = np.linalg.inv(cell.truth["base_b"]) @ np.array(flanges)
    problem = observed(cell, rng, noise=noise)
    seen, rows, stated = problem.observations, [], set()
    for at, (camera, target, stop) in enumerate(cell.pairs):
        row = {"view": at, "stop": stop, "camera": camera[4:], "target": target[7:]}
        # Each robot's pose stands once a stop.
        robot = {"target_a": "a", "target_b": "b"}.get(target)
        fresh = robot is not None and (robot, stop) not in stated
        stated.add((robot, stop))
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
        "prior": {"flange_b_from_target_b": prior} if prior else {},
    }
    cells = [[str(value) for value in row.values()] for row in rows]
    return cell, Session.assemble(document, list(rows[0]), cells, MemoryImages({}))


@pytest.mark.slow
def test_poor_motion_is_refused_with_the_direction_that_it_leaves_open():
    words = "offset along the cell's z has a predicted"
    caught = raised(DegenerateError, words, calibrate, turned(0.3)[1])
    assert "base_b's offset along the cell's z" in caught.culprits
    assert "all 14 stops of robot b turn about base_b's z to within 0." in caught.message
    (found,) = doctor(turned(0.3)[1]).findings
    assert found.kind == "motion"
    assert found.words.startswith("cell: base_b's offset along the cell's z has a predicted sigma")
    assert found.do.words == caught.next_step
    assert doctor(turned(35.0)[1]).is_sound


@pytest.mark.slow
def test_noise_alone_refuses_no_cell():
    # Thirty times a usual camera's and robot's.
    found = calibrate(turned(35.0, noise=30.0)[1])
    assert found.verdict.status == "bad"
    assert any("Weakly determined by the motion" in reason for reason in found.verdict.reasons)
    assert reason(found, "Where the others predict them, views are off")


@pytest.mark.slow
def test_a_measured_offset_ties_an_arm_of_four_axes_to_a_cell():
    height = {"z_m": 0.06, "sigma_m": 1e-4}
    cell, session = turned(0.0, stops=8, turn_deg=115.0, prior=height)
    edge = calibrate(session).between("base_a", "base_b")
    assert misfit(edge, cell.truth["base_b"]) < MOST
    assert edge.sigma_mm < 1.0
    with pytest.raises(DegenerateError, match="differ in position only") as caught:
        calibrate(turned(0.0, stops=8, turn_deg=0.0)[1])
    assert caught.value.next_step == (
        "To tie base_b: let a camera see a board, one of the two on base_b or on its robot and the "
        "other one tied, at 5 stops or more, tilted by 20 to 40 degrees about different axes."
    )


@pytest.mark.slow
def test_a_prior_narrows_its_frame_and_is_named_where_it_is_wrong(clean):
    cell, before = clean
    height = float(cell.between("base_a", "base_b")[2, 3])
    found = solved(cell, prior={"base_a_from_base_b": {"z_m": height, "sigma_m": 1e-6}})
    after = found.between("base_a", "base_b")
    turn = after.matrix[:3, :3]
    sigma_m = np.sqrt(np.diag(turn @ after.covariance[3:, 3:] @ turn.T))
    assert after.matrix[2, 3] == pytest.approx(height, abs=4e-6)
    assert sigma_m[2] <= 1.01e-6
    assert after.sigma_mm < before.between("base_a", "base_b").sigma_mm
    assert found.verdict.status == "good"
    found = solved(cell, prior={"base_a_from_base_b": {"z_m": height + 0.02, "sigma_m": 1e-3}})
    doubt = reason(found, "contradicted")
    assert "z_m of base_a_from_base_b" in doubt
    said_mm, sigma_mm = map(float, re.search(r"alone say (\S+) mm to (\S+) mm", doubt).groups())
    # Four of the sigmas that are stated: one run in fifteen thousand.
    assert abs(said_mm - 1e3 * height) < 4 * sigma_mm < 0.4
    assert found.verdict.status == "check"


HEIGHT = {"z_m": 0.1, "sigma_m": 1e-3}


@pytest.mark.parametrize(
    ("name", "prior", "words"),
    [
        ("base_a_from_camleft", HEIGHT, "Did you mean cam_left"),
        slow("base_a_from_target_plate_a", HEIGHT, "robot a moves one"),
        slow("cam_left_from_cam_left", HEIGHT, "they are one"),
        (
            "cam_left_from_cam_right",
            HEIGHT | {"sigma_rad": 1e-3},
            "quaternion_xyzw and sigma_rad together",
        ),
    ],
)
def test_a_prior_of_no_fixed_place_is_refused(clean, name, prior, words):
    with pytest.raises(DataError) as raised:
        solved(clean[0], prior={name: prior})
    assert words in f"{raised.value.message} {raised.value.next_step}"


@pytest.fixture(scope="module")
def warm():
    """Two robots before two cameras, one of them cold at the first of 40 stops; with its drift."""
    cell = simulate(
        NetworkOptions(
            robots=(replace(ROBOTS[0], warms_up=True), ROBOTS[1]),
            cameras=tuple(replace(camera, camera=CAMERAS["fine"]) for camera in PLAIN.cameras),
            boards=PLAIN.boards,
            stops=40,
            pace_s=150.0,
        )
    )
    return cell, solved(cell, level="thermal")


@pytest.mark.slow
def test_an_arm_of_a_cell_drifts_with_its_own_temperatures(warm, tmp_path):
    cell, found = warm
    found.save(tmp_path / "calibration.json")
    drift = Calibration.load(tmp_path / "calibration.json").of("left", "a").drift
    heat, names = Heat.drawn(0), ("growth_per_k", "drift_rad_per_k")
    away = np.concatenate([getattr(drift, name) - getattr(heat, name) for name in names])
    assert away @ np.linalg.solve(drift.covariance[:12, :12], away) < MOST_OF_TWELVE
    thermal = found.cell.robots["a"].thermal
    assert thermal.residual_mm.with_drift < 0.7 * thermal.residual_mm.without
    assert len(thermal.views) > 30
    assert reason(found, "Robot a: the arm drifts with its temp")
    # A robot without temperatures stays as it is.
    assert found.cell.robots["b"].thermal is None
    assert not any(reason.startswith("Robot b: the arm drift") for reason in found.verdict.reasons)
    budget = found.cell.uncertainty.budget_mm["flange_a_from_target_plate_a"]
    assert 0.0 < budget["temperature of a"] < budget["total"]
    few = session_of(cell).only([sight.view for sight in cell.sights if sight.stop < 8])
    with pytest.raises(DataError, match=r"robot a: level 'thermal' needs .* temp1_c"):
        solved(cell, replace(few, streams={}), "thermal")
    raised(DataError, "warms up needs pace_s", replace, cell.options, pace_s=0.0)


@pytest.mark.slow
def test_a_camera_that_sees_a_moving_robot_by_a_clock_of_its_own_is_placed():
    robots = tuple(replace(robot, offset_sigma_rad=1e-3) for robot in ROBOTS)
    # At its stops it takes no image.
    side = CameraAt("side", place_m=(0.9, 0.1, 1.3), at_stops=False)
    swept = Swept("side", "b", "plate_b", camera_minus_robot_s=0.037, frames_hz=20.0)
    cameras = (*PLAIN.cameras, side)
    options = NetworkOptions(robots, cameras=cameras, stops=16, sweeps=(swept,), seed=4)
    cell = simulate(options)
    session, pair = session_of(cell), "cam_side and robot b"
    found = solved(cell, session)
    clock = found.cell.details.clocks[pair]
    assert clock.method == "motion"
    assert clock.sigma_s < 1e-4
    # Three sigma: one run in 370. What the motion tells of the arm as stated is off by more.
    assert abs(clock.camera_minus_robot_s - 0.037) < 3 * clock.sigma_s
    assert found.of("side", "b").clock == clock
    assert found.of("left", "b").clock is None
    assert off(cell, found, "cam_left", "cam_side")[1] < MOST
    # Its lens is estimated, with a field and a focus of its own.
    assert found.between("cam_left", "cam_side").sigma_mm < 0.3
    assert sum(view.used for view in found.views if view.seer == "cam_side") > 30
    assert found.session_sha256 == session.digest()
    with pytest.raises(DataError, match=r"clocks\.sied is of no camera"):
        solved(cell, clocks={"sied": {"camera_minus_robot_s": 0.02}})


def wide(width, height, focal):
    matrix = np.array([focal, focal, 0.5 * width, 0.5 * height])
    return replace(CAMERAS["wide"], resolution=(width, height), matrix=matrix)


PICTURED = NetworkOptions(
    cameras=(
        CameraAt("left", place_m=(0.0, -0.5, 0.9), camera=wide(800, 600, 760.0)),
        CameraAt(
            "right", place_m=(0.1, 0.45, 0.95), camera=wide(640, 480, 560.0), state_intrinsics=False
        ),
    ),
    boards=(
        BoardAt(
            "plate_a", "a", target=replace(BOARDS["checkerboard"], name="6x5", columns=6, rows=5)
        ),
        BoardAt("plate_b", "b", target=replace(BOARDS["charuco"], name="5x4", columns=5, rows=4)),
    ),
    stops=8,
    lens_views=6,
    swapped_rows=1,
)


@pytest.mark.slow
def test_pictures_of_several_cameras_are_one_cell(tmp_path):
    cell, out = simulate(PICTURED), tmp_path / "out"
    session = Session.load(write_session(cell, tmp_path / "cell"))
    assert visioncal("calibrate", tmp_path / "cell", "-o", out).status == 0
    found = Calibration.load(out)
    for frame in ("base_b", "cam_left", "cam_right"):
        # Six squared sigmas are exceeded once in 4e5; pictures of small boards are not ideal.
        assert off(cell, found, "base_a", frame)[1] < 60.0, frame
    # Both rows whose pictures were exchanged are left out.
    left_out = {view.view: view.reason for view in found.views if not view.used}
    assert all("disagrees" in left_out[view] for view in cell.wrong_views)
    assert found.cell.lenses["cam_right"].estimated
    assert not found.cell.lenses["cam_left"].estimated
    # What was detected lies over the image of the camera that saw it.
    recording = out / "recording.rrd"
    assert Session.load(recording).digest() == session.digest()
    seen = read_evidence(recording)
    assert [view.view for view in seen] == [view.number for view in session.views]
    frames = column(recording, paths.DETECTED, "CoordinateFrame:frame")
    cameras = enumerate(view.text["camera"] for view in session.views)
    of_camera = {row: f"image_of_cam_{camera}" for row, camera in cameras}
    assert {row: str(frame[0]) for row, frame in frames.items()} == of_camera
    assert "Worst used view" in (out / "report.html").read_text()


@pytest.mark.slow
def test_two_images_that_are_exchanged_have_a_command_that_mends_them(three):
    # The images of one camera at two stops.
    views = [view for view in three.views if view.text.get("target") == "plate_b"]
    of_one = [view.number for view in views if view.text["camera"] == views[0].text["camera"]]
    first, second = of_one[1], of_one[3]
    swapped = exchange_views(three, first, second)
    findings = calibrate(swapped).verdict.findings
    (wrong,) = (finding for finding in findings if finding.kind == "exchanged_views")
    assert set(wrong.views) == {first, second}
    assert f"--exchange {first},{second}" in wrong.do.command
    mended = exchange_views(swapped, first, second)
    assert len(mended.declaration.corrected) == 2
    now, was, then = (each.corner_table.views.tolist() for each in (mended, three, swapped))
    assert now == was != then
    other = next(view.number for view in three.views if view.text.get("target") == "floor")
    raised(DataError, r"another .*target", exchange_views, three, first, other)


@pytest.mark.slow
def test_poses_of_one_arm_that_are_exchanged_have_a_command_that_mends_them():
    options = replace(PLAIN, robots=ROBOTS[:1], boards=(PLAIN.boards[1],), stops=14)
    session = recorded(simulate(options))
    first, second = (
        [view.number for view in session.views if view.stop == stop] for stop in (4, 9)
    )
    pairs = [view for pair in zip(first, second, strict=True) for view in pair]
    swapped = exchange_views(session, *pairs)
    (wrong,) = (
        each for each in calibrate(swapped).verdict.findings if each.kind == "exchanged_views"
    )
    assert {*wrong.views} == {*pairs}
    typed = re.search(r"--exchange ([\d,]+) ", wrong.do.command)[1]
    mended = exchange_views(swapped, *map(int, typed.split(",")))
    again, first, then = (each.corner_table.views.tolist() for each in (mended, session, swapped))
    assert again == first != then
    assert calibrate(mended).verdict.status == calibrate(session).verdict.status
