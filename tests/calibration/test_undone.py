"""Mistakes of the record: named first, mended by the command that is printed, no sound one accused.

Cells of poses measured with noise, without images.
"""

from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from support.cells import pairs_session
from support.commands import visioncal as typed
from support.following import follow, judged
from support.marks import crossed, slow
from support.refusals import raised
from support.whole_cells import OPTIONS, recorded

import visioncal
from visioncal.calibration.pipeline import mended_images
from visioncal.calibration.pipeline.explaining import explained
from visioncal.calibration.pipeline.guess_inputs import of_pair
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, run_stages
from visioncal.calibration.stages.corner_numbers import EXCHANGE_COLUMNS
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.calibration.stages.robots import pairs_of
from visioncal.calibration.suspects.misread_poses import misreadings
from visioncal.calibration.suspects.record import Edges, Record
from visioncal.calibration.suspects.suspect import UNDONE
from visioncal.calibration.suspects.undoing import likeliest
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import ranges
from visioncal.core.transforms import compose, exp, invert, rotation_angle
from visioncal.core.types import Camera
from visioncal.core.verdict import Finding
from visioncal.interchange.formats.mending import remove_tool, shift_views, turn_boards
from visioncal.results import Calibration
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.vision.targets import corner_positions, load_target

MOUNTS = ("eye-in-hand", "eye-to-hand")
HALF_TURN = compose(np.diag([-1.0, -1.0, 1.0]), np.array([0.16, 0.12, 0.0]))
BOARD = "charuco_9x6_30mm"
SIZE = (1280, 960)
POINTS = corner_positions(load_target(BOARD))
CASES = Path(__file__).parents[3] / "shared/data/field/cases"


def poses_of(mount, views=24, seed=0):
    """(m, 4, 4) poses of the flange and `cam_from_target`, with a noise of half a millimetre."""
    rng = np.random.default_rng(seed)
    boards = exp(np.column_stack([rng.normal(0, 0.4, (views, 3)), rng.normal(0, 0.08, (views, 3))]))
    boards[:, 2, 3] += 0.6
    x, z = exp(rng.normal(0, 0.3, 6)), exp(rng.normal(0, 0.5, 6))
    flanges = z @ invert(boards) @ invert(x)
    flanges = flanges if mount == "eye-in-hand" else invert(flanges)
    noise = rng.normal(size=(2, views, 6)) * np.repeat([1e-3, 5e-4], 3)
    return flanges @ exp(noise[0]), boards @ exp(noise[1])


@cache
def calibrated(mount):
    """The result of these poses."""
    return visioncal.calibrate(pairs_session(mount, *poses_of(mount)))


def followed(cell):
    """The cause that the first result names, and the result once its advice is followed."""
    first, last = results(cell)
    return first.verdict.causes[0], last


def results(cell):
    """The first result, and that once its advice is followed."""
    ended, found = judged(cell)
    assert ended.last.status == 0, ended.last.said
    return found[0], found[-1]


def shifted(robot, boards, start=10, by=2):
    """From a row on, each image is that of the robot's pose so many rows later."""
    rows = np.arange(len(robot))
    images = np.where(rows >= start, rows + by, rows)
    is_within = images < len(rows)
    return robot[is_within], boards[images[is_within]]


def turned(robot, boards, some=(1, 4, 5, 8, 11, 13, 16, 19)):
    boards = boards.copy()
    boards[[*some]] = boards[[*some]] @ HALF_TURN
    return robot, boards


def flipped(robot, boards, some=(0, 2, 10, 14, 15, 20), side_m=0.05):
    """Views with the second pose that OpenCV finds of a marker of 50 mm, or of another side."""
    boards, marker = (
        boards.copy(),
        side_m / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]),
    )
    for view in some:
        px = cv2.projectPoints(marker, *split(boards[view]), np.eye(3), None)[0]
        _, turns, places, _ = cv2.solvePnPGeneric(
            marker, px, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        boards[view] = compose(cv2.Rodrigues(turns[1])[0], places[1].ravel())
    return robot, boards


def corners_of(mount, distortion=None):
    """Poses of the flange, and each view's corners of a board, all in the image of a lens."""
    boards = poses_of(mount)[1]
    boards[:, :2, 3] = 0.3 * boards[:, :2, 3] - 0.1
    x, z = exp(np.array([0.1, -0.2, 0.3, 0.05, 0.02, 0.1])), exp(np.array([0, 0, 0.4, 0.7, 0, 0]))
    robot = z @ invert(boards) @ invert(x)
    matrix = np.array([[1100.0, 0.0, 655.0], [0.0, 1100.0, 471.0], [0.0, 0.0, 1.0]])
    rng, seen = np.random.default_rng(2), []
    for pose in boards:
        px = cv2.projectPoints(POINTS, *split(pose), matrix, distortion)[0][:, 0]
        seen.append((np.arange(len(POINTS)), px + rng.normal(0, 0.1, px.shape)))
    return robot if mount == "eye-in-hand" else invert(robot), seen


@cache
def calibrated_corners():
    """The result of these corners in a hand."""
    robot, seen = corners_of(MOUNTS[0])
    return visioncal.calibrate(Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]))


def split(pose):
    return cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]


def copied(robot, boards, start=12):
    robot = robot.copy()
    robot[start:] = robot[start - 1]
    return robot, boards


def lingering(robot, boards, some=(1, 8, 13, 15, 16, 19)):
    boards = boards.copy()
    for view in some:
        boards[view] = boards[view - 1]
    return robot, boards


def unsigned(robot, boards):
    robot = robot.copy()
    robot[:, 1, 3] = np.abs(robot[:, 1, 3])
    return robot, boards


def in_two_units(robot, boards, some, factor, axes=slice(3)):
    robot = robot.copy()
    robot[[*some], axes, 3] *= factor
    return robot, boards


def in_radians(robot, boards, some, order):
    """Some rows' angles are in radians, and taken for degrees."""
    robot = robot.copy()
    read = Rotation.from_matrix(robot[some, :3, :3])
    wrong = Rotation.from_rotvec(np.deg2rad(read.as_rotvec()))
    if order:
        wrong = Rotation.from_euler(order, np.deg2rad(read.as_euler(order)))
    robot[some, :3, :3] = wrong.as_matrix()
    return robot, boards


PLANTED = {
    **{
        f"mixed_units of angles {order}": (
            partial(in_radians, some=slice(12, 24), order=order),
            [*range(12, 24)],
            "angles are in radians, and were taken for degrees",
        )
        for order in ("", "ZYX")
    },
    "shifted_rows": (shifted, [*range(10, 22)], "From view 10 on, images and poses are 2 rows"),
    "turned_board": (turned, [1, 4, 5, 8, 11, 13, 16, 19], "turned by 180 deg"),
    "flipped_poses": (flipped, [0, 2, 10, 14, 15, 20], "tilted the other way"),
    "copied_poses": (copied, [*range(12, 24)], "to the last digit"),
    "copied_poses of the target": (
        lingering,
        [1, 8, 13, 15, 16, 19],
        "the robot moved: the last that was seen",
    ),
    "mixed_units from a row on": (
        partial(in_two_units, some=range(8, 24), factor=1e3),
        [*range(8, 24)],
        "a thousand times as large",
    ),
    "mixed_units of one axis": (
        partial(in_two_units, some=range(12, 24), factor=1e3, axes=2),
        [*range(12, 24)],
        "z of the robot's position is a thousand times as large",
    ),
    "mixed_units here and there": (
        partial(in_two_units, some=(2, 3, 11, 17), factor=1e-3),
        [2, 3, 11, 17],
        "a thousandth as large",
    ),
    "mixed_units, inches": (
        partial(in_two_units, some=range(8, 24), factor=1.0 / 0.0254),
        [*range(8, 24)],
        "39.37 times as large (inches)",
    ),
    "mixed_units, inches among millimetres": (
        partial(in_two_units, some=(2, 3, 11, 17), factor=1.0 / 25.4),
        [2, 3, 11, 17],
        "25.4 times smaller (inches among millimetres)",
    ),
}


# Another one is found by the same.
ALIKE = [
    "shifted_rows",
    "copied_poses of the target",
    "mixed_units of angles ",
    "mixed_units of angles ZYX",
    "mixed_units of one axis",
    "mixed_units here and there",
    "mixed_units, inches among millimetres",
]


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_positions_that_lost_a_sign_get_it_back_by_the_printed_command(
    tmp_path, monkeypatch, mount
):
    monkeypatch.chdir(tmp_path)
    robot, boards = poses_of(mount)
    negative = np.flatnonzero(robot[:, 1, 3] < 0.0)
    if len(negative) > len(robot) / 2:
        # The other half of the views is what is read otherwise.
        robot = exp(np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0])) @ robot
        negative = np.flatnonzero(robot[:, 1, 3] < 0.0)
    sound = visioncal.calibrate(pairs_session(mount, robot, boards))
    pairs_session(mount, *unsigned(robot, boards)).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert cause.kind == "lost_sign"
    assert {*cause.views} <= {*negative.tolist()}
    # A position within the noise of the boundary has either sign.
    assert np.abs(robot[sorted({*negative.tolist()} - {*cause.views}), 1, 3]).max(initial=0) < 0.05
    for name, edge in sound.edges.items():
        # A few views with the sign of a position near zero are within the noise.
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=2e-3)


@pytest.mark.parametrize(
    ("kind", "mount", "start"),
    [
        slow("unit", MOUNTS[0], 10),
        slow("inverse", MOUNTS[1], 10),
        *(slow("sign", mount, 10) for mount in MOUNTS),
        # Fewer than half of the rows are right.
        ("w first", MOUNTS[0], 8),
        slow("unit", MOUNTS[1], 8),
    ],
)
def test_poses_that_are_misread_and_rows_apart_are_mended_one_after_the_other(
    tmp_path, monkeypatch, mount, kind, start
):
    monkeypatch.chdir(tmp_path)
    sound = calibrated(mount)
    robot, boards = shifted(*poses_of(mount), start=start)
    if kind == "inverse":
        robot = invert(robot)
    if kind == "w first":
        w_first = np.roll(Rotation.from_matrix(robot[:, :3, :3]).as_quat(), 1, axis=1)
        robot = compose(Rotation.from_quat(w_first).as_matrix(), robot[:, :3, 3])
    robot[:, :3, 3] *= {"sign": [1.0, -1.0, 1.0], "unit": 39.3701}.get(kind, 1.0)
    pairs_session(mount, robot, boards).save(tmp_path / "cell")
    cause, found = followed("cell")
    assert cause.kind == "misread_poses"
    assert ("So it is from view 0 to view 8: the other rows have" in cause.words) == (start < 10)
    assert cause.do.command.startswith("visioncal convert cell cell-fixed --guess")
    assert (tmp_path / "cell-fixed-fixed").is_dir()
    if kind == "inverse" and found.mount != mount:
        # Inverse poses before a fixed camera are those of one in hand: no number differs.
        return
    for name, edge in sound.edges.items():
        # A view or two without partner are missing.
        np.testing.assert_allclose(found.edges[name].matrix, edge.matrix, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("forms", "mount"),
    [(("xyz", "ZYX"), MOUNTS[0]), (("ZYX", "xyz"), MOUNTS[1])],
)
def test_angles_of_one_maker_that_were_stated_as_anothers_are_named(
    tmp_path, monkeypatch, mount, forms
):
    monkeypatch.chdir(tmp_path)
    (robot, boards), (stated, true_form) = poses_of(mount), forms
    angles = Rotation.from_matrix(robot[:, :3, :3]).as_euler(true_form)
    rotations = Rotation.from_euler(stated, angles).as_matrix()
    pairs_session(mount, compose(rotations, robot[:, :3, 3]), boards).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert "A, B, C of KUKA and W, P, R of FANUC" in cause.words
    for name, edge in calibrated(mount).edges.items():
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_repeated_poses_hide_no_misread_rotations(mount):
    robot, boards = poses_of(mount)
    angles = Rotation.from_matrix(robot[:, :3, :3]).as_euler("xyz")
    read = compose(Rotation.from_rotvec(angles).as_matrix(), robot[:, :3, 3])
    for view in (5, 12, 13, 20):
        read[view] = read[view - 1]
    cause = visioncal.calibrate(pairs_session(mount, read, boards)).verdict.causes[0]
    assert cause.kind == "misread_poses"
    assert "Euler angles xyz about fixed axes in radians, which were taken for" in cause.words


@pytest.mark.parametrize(
    ("column", "mount"), [slow("", MOUNTS[0]), slow("rail_m", MOUNTS[1]), ("rail_mm", MOUNTS[0])]
)
def test_a_rail_that_is_in_no_pose_is_named_and_added_from_its_column(
    tmp_path, monkeypatch, mount, column
):
    monkeypatch.chdir(tmp_path)
    robot, boards = poses_of(mount)
    places = np.random.default_rng(1).uniform(-1.0, 1.0, len(robot))
    logged = robot.copy()
    logged[:, 1, 3] -= places
    sound = calibrated(mount)
    pairs_session(mount, logged, boards).save(tmp_path / "cell")
    if column:
        path = tmp_path / "cell/views.csv"
        lines, unit = path.read_text().splitlines(), 1e3 if column.endswith("_mm") else 1.0
        cells = [column, *(repr(value) for value in (unit * places).tolist())]
        path.write_text("".join(f"{a},{b}\n" for a, b in zip(lines, cells, strict=True)))
    if column:
        cause, mended = followed("cell")
    else:
        cause, mended = visioncal.calibrate(tmp_path / "cell").verdict.causes[0], None
    assert cause.kind == "misread_poses"
    assert "lack a motion along y of its base" in cause.words
    assert (f"Column {column} of views.csv has it" in cause.words) == bool(column)
    if mended is not None:
        for name, edge in sound.edges.items():
            np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scaled", "mount"),
    [
        (("z", "mm", 1e3), MOUNTS[0]),
        (("y", "another unit", 10.0), MOUNTS[1]),
        *(slow(("x", "inch", 1 / 0.0254), mount) for mount in MOUNTS),
    ],
)
def test_one_axis_in_another_unit_is_no_rail(tmp_path, monkeypatch, mount, scaled):
    monkeypatch.chdir(tmp_path)
    axis, unit, per_m = scaled
    robot, boards = poses_of(mount)
    sound = calibrated(mount)
    logged = robot.copy()
    logged[:, "xyz".index(axis), 3] *= per_m
    pairs_session(mount, logged, boards).save(tmp_path / "cell")
    followed = follow("calibrate", "cell", "-o", "out")
    # Where the camera lies by such poses is no second cause.
    assert "how far the" not in followed.runs[0].said
    assert f"Most likely: The robot's {axis} is in {unit}, its other" in followed.runs[0].said
    assert followed.last.status == 0
    mended = Calibration.load("out")
    for name, edge in sound.edges.items():
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "mount"),
    [
        *crossed([kind for kind in PLANTED if kind not in ALIKE], MOUNTS),
        *(slow(*pair) for pair in product(ALIKE, MOUNTS)),
    ],
)
def test_a_mistake_is_named_and_its_command_mends_it(tmp_path, monkeypatch, kind, mount):
    monkeypatch.chdir(tmp_path)
    plant, views, words = PLANTED[kind]
    sound = calibrated(mount)
    session = pairs_session(mount, *plant(*poses_of(mount)))
    session.save(tmp_path / "cell")
    found, _ = results("cell")
    cause = found.verdict.causes[0]
    assert cause.kind == kind.split()[0].rstrip(",")
    assert words in cause.words
    assert [*cause.views] == views
    checked = visioncal.doctor(session).findings[0]
    assert (checked.words, checked.views) == (cause.words, cause.views)
    # The others alone give the result.
    assert not {view.view for view in found.views if view.used} & {*views}
    for name, edge in sound.edges.items():
        # Ten times the noise of one view; what is wrong is off by centimetres.
        np.testing.assert_allclose(found.edges[name].matrix, edge.matrix, atol=5e-3)


@pytest.mark.parametrize(
    ("views", "mount"), [(5, MOUNTS[0]), slow(6, MOUNTS[1]), slow(7, MOUNTS[0])]
)
def test_one_flipped_view_of_few_is_named(views, mount):
    """Twelve cells each, of which at most one may hide it; no sound one is accused."""
    named = []
    for seed in range(12):
        sound = poses_of(mount, views, seed)
        for robot, boards in (sound, flipped(*sound, some=(3,))):
            found = likeliest(located(pairs_session(mount, robot, boards)))
            named.append(found and (found.found.kind, found.found.views))
    assert not any(named[::2])
    assert named[1::2].count(("flipped_poses", (3,))) >= 11


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
@pytest.mark.parametrize("some", [(3, 9, 12), slow((0, 1, 2, 3, 4, 5, 6))])
def test_flipped_views_of_a_near_marker_are_named(mount, some):
    """Its second pose is degrees off the mirror image, many times the noise of the others."""
    named = []
    for seed in range(6):
        robot, boards = flipped(*poses_of(mount, 20, seed), some=some, side_m=0.25)
        found = likeliest(located(pairs_session(mount, robot, boards)))
        named.append(found and (found.found.kind, found.found.views))
    # A flip by a few degrees may be no outlier.
    assert named.count(("flipped_poses", some)) >= 5


@pytest.mark.parametrize("by", [5, -2, *map(slow, (1, -1, 3, -6))])
def test_images_and_poses_a_few_rows_apart_are_named(by):
    session = pairs_session(MOUNTS[0], *shifted(*poses_of(MOUNTS[0], 30), 15, by))
    cause = visioncal.calibrate(session).verdict.causes[0]
    assert cause.kind == "shifted_rows"
    # The row before a shift back has the image before once more, which fits both.
    assert cause.views[0] in (15, 15 - by if by < 0 else 15)
    assert f":{by} &&" in cause.do.command


@pytest.mark.slow
@pytest.mark.parametrize(("first", "last", "by"), [(6, 14, 1), (10, 16, -2), (4, 9, 1)])
def test_rows_amid_the_table_that_are_apart_are_one_command(tmp_path, monkeypatch, first, last, by):
    monkeypatch.chdir(tmp_path)
    robot, boards = poses_of(MOUNTS[0])
    # The log has the pose of a neighbouring row in these, as where it was late for a while.
    late = robot.copy()
    late[first : last + 1] = robot[first - by : last + 1 - by]
    pairs_session(MOUNTS[0], late, boards).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert cause.kind == "shifted_rows"
    assert f"--shift {first}-{last}:{by} " in cause.do.command
    assert sum(view.used for view in mended.views) == len(robot) - abs(by)
    for name, edge in calibrated(MOUNTS[0]).edges.items():
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "whose"), [((10, 17), "image"), ((8, 20), "pose")])
def test_rows_that_two_losses_leave_apart_are_mended_one_after_the_other(
    tmp_path, monkeypatch, lost, whose
):
    monkeypatch.chdir(tmp_path)
    # No half of the rows is right, and none is apart by one number of rows.
    robot, boards = poses_of(MOUNTS[0], 26)
    kept, whole = np.delete(np.arange(26), lost), np.arange(24)
    rows = (robot[whole], boards[kept]) if whose == "image" else (robot[kept], boards[whole])
    pairs_session(MOUNTS[0], *rows).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert cause.kind == "shifted_rows"
    # A row at each end of a run that is apart has no partner left.
    assert sum(view.used for view in mended.views) >= 24 - 4
    sound = visioncal.calibrate(pairs_session(MOUNTS[0], robot, boards))
    for name, edge in sound.edges.items():
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=2e-3)


def test_a_whole_table_two_rows_apart_is_named():
    session = pairs_session(MOUNTS[1], *shifted(*poses_of(MOUNTS[1]), 0, 2))
    cause = visioncal.calibrate(session).verdict.causes[0]
    assert cause.kind == "shifted_rows"
    assert "--shift 0-21:2" in cause.do.command


def located(session):
    """What is known of a session before its fit."""
    return run_stages(RunState(session), STAGES[:5])


def test_edges_are_not_those_of_a_robot_that_waits_while_another_moves():
    robot, boards = poses_of("eye-in-hand")
    rng, waits = np.random.default_rng(0), np.arange(24) % 2 == 1
    # Noise of a tenth of what separates places.
    robot[waits] = robot[1] @ exp(1e-4 * rng.normal(size=(12, 6)))
    boards[waits] = boards[1] @ exp(1e-3 * rng.normal(size=(12, 6)))
    boards[:, :3, 3] *= 0.95
    every = np.arange(24)
    record = Record(every, robot, "eye-in-hand", every, boards[:, None], np.zeros((0, 3)), False,
                    "image", False)  # fmt: skip
    edges = Edges.by(record, every, every >= 0)
    # Turns are right, whatever the size of the board: the poses have a noise of a milliradian.
    assert rotation_angle(edges.turned(every)).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [3, 6])
@pytest.mark.parametrize("mount", MOUNTS)
def test_sound_and_otherwise_wrong_sessions_are_not_accused(mount, seeds):
    rng = np.random.default_rng(3)
    for seed in range(seeds):
        robot, boards = poses_of(mount, 20, seed)
        assert likeliest(located(pairs_session(mount, robot, boards))) is None
        boards[[2, 9]] = boards[[2, 9]] @ exp(rng.normal(0, 0.3, (2, 6)))
        assert likeliest(located(pairs_session(mount, robot, boards))) is None
        # Two views of each stop, of which one shows something else.
        robot, boards = np.repeat(robot, 2, axis=0), np.repeat(boards, 2, axis=0)
        assert likeliest(located(pairs_session(mount, robot, boards))) is None


@pytest.mark.slow
def test_of_long_sessions_every_row_is_named():
    run = located(pairs_session(MOUNTS[0], *shifted(*poses_of(MOUNTS[0], 200), 90, 3)))
    found = likeliest(run)
    assert found.found.kind == "shifted_rows"
    assert len(found.found.views) == 107


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_corners_that_are_numbered_a_column_on_get_their_own_numbers(tmp_path, monkeypatch, mount):
    monkeypatch.chdir(tmp_path)
    (robot, seen), wrong = corners_of(mount), (1, 6, 12, 15)
    first, *_, last = np.unique(POINTS[:, 0])
    for view in wrong:
        # The first column is in the shade there.
        ids, px = seen[view]
        seen[view] = ids[POINTS[:, 0] < last], px[POINTS[:, 0] > first]
    Session.from_corners(seen, robot, BOARD, (1280, 960), mount=mount).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert (cause.kind, cause.views) == ("turned_board", wrong), cause.words
    assert "numbered some squares on" in cause.words
    assert sum(view.used for view in mended.views) == len(robot)
    assert not {"turned_board", "lost_views"} & {one.kind for one in mended.verdict.causes}


@pytest.mark.parametrize(
    ("share", "some"), [(0.5, range(9, 15)), slow(0.75, range(14, 24)), slow(0.5, [2, 7, 11])]
)
def test_corners_of_smaller_pictures_are_scaled_by_the_printed_command(
    tmp_path, monkeypatch, share, some
):
    monkeypatch.chdir(tmp_path)
    robot, seen = corners_of(MOUNTS[0])
    sound = calibrated_corners()
    seen = scaled_at(some, share, seen)
    Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]).save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert cause.kind == "image_sizes"
    assert sorted(cause.views) == sorted(some)
    assert mended.verdict.status == "good"
    for name, edge in sound.edges.items():
        # Their noise is as much larger as they were smaller.
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=2e-3)


@pytest.mark.parametrize("some", [slow([6]), [3, 4, 12, 19]])
def test_pictures_that_were_taken_before_are_left_out_by_the_printed_command(
    tmp_path, monkeypatch, some
):
    monkeypatch.chdir(tmp_path)
    robot, seen = corners_of(MOUNTS[0])
    for view in some:
        ids, px = seen[view - 1]
        seen[view] = ids, px + np.random.default_rng(view).normal(0, 0.1, px.shape)
    Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]).save(tmp_path / "cell")
    follow("calibrate", "cell", "-o", "out", run=typed)
    first, mended = (Calibration.load(out).verdict for out in ("out", "out-new"))
    (cause,) = first.causes
    assert cause.kind == "copied_poses"
    assert "the picture of the row before once more, to within the noise" in cause.words
    assert [*cause.views] == some
    assert mended.status == "good"


def test_pictures_of_stops_that_are_taken_twice_are_not_taken_before():
    robot, seen = corners_of(MOUNTS[0])
    rng, robot = np.random.default_rng(3), np.repeat(robot[:12], 2, axis=0)
    seen = [(ids, px + rng.normal(0, 0.1, px.shape)) for ids, px in seen[:12] for _ in range(2)]
    robot[9, 0, 3] += 0.02
    found = visioncal.calibrate(Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]))
    assert found.verdict.causes[0].kind == "wrong_views"
    assert found.verdict.causes[0].views == (9,)


@pytest.mark.slow
def test_pictures_of_a_slow_motion_whose_log_is_late_are_not_taken_before():
    """Each is within the noise of the one before, and the last of the late ones 0.2 m away."""
    rng, count, late = np.random.default_rng(0), 400, slice(133, 213)
    keys = np.hstack([rng.normal(0, 0.35, (4, 3)), rng.normal(0, 0.05, (4, 3))])
    boards = exp(CubicSpline(np.linspace(0, 1, 4), keys)(np.linspace(0, 1, count)))
    boards[:, :3, 3] = boards[:, :3, 3] * [0.3, 0.3, 1.0] + [-0.1, -0.1, 0.6]
    x, z = exp(np.array([[0.1, -0.2, 0.3, 0.05, 0.02, 0.1], [0, 0, 0.4, 0.7, 0, 0]]))
    robot = z @ invert(boards) @ invert(x)
    matrix = np.array([[1100.0, 0, 655], [0, 1100, 471], [0, 0, 1]])
    pictures = [cv2.projectPoints(POINTS, *split(pose), matrix, None)[0][:, 0] for pose in boards]
    seen = [(np.arange(len(px)), px + rng.normal(0, 0.1, px.shape)) for px in pictures]
    robot[late] = robot[late.start - 12 : late.stop - 12]
    robot = robot @ exp(rng.normal(size=(count, 6)) * np.repeat([1e-3, 5e-4], 3))
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0])
    found = likeliest(located(session))
    assert found is None or found.found.kind != "copied_poses"


def scaled_at(views, share, seen):
    """The corners, and those of some views as if they were of smaller pictures."""
    return [
        (ids, share * (px + 0.5) - 0.5 if view in views else px)
        for view, (ids, px) in enumerate(seen)
    ]


@pytest.mark.parametrize("focal", [1100.0, slow(1140.0)])
def test_a_wrong_stated_lens_makes_no_smaller_pictures(focal):
    """Its misfit is as large with corners that are scaled."""
    lens = Camera("brown", SIZE, np.array([focal, focal, 655.0, 471.0]), np.zeros(5))
    robot, seen = corners_of(MOUNTS[0], np.array([-0.12, 0.05, 0.0, 0.0, 0.0]))
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0], camera=lens)
    found = visioncal.calibrate(session)
    assert "image_sizes" not in {each.kind for each in found.verdict.causes}


@pytest.mark.slow
def test_sizes_that_are_no_listed_share_are_not_named():
    """800 x 600 px of 1280 x 960: neither 0.6 nor 2/3 of it."""
    robot, seen = corners_of(MOUNTS[0])
    seen = scaled_at(range(14, 22), 0.625, seen)
    found = visioncal.calibrate(Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]))
    assert "image_sizes" not in {each.kind for each in found.verdict.causes}


@pytest.mark.parametrize(("share", "named"), [(0.5, True), slow(1.0, False)])
def test_a_camera_whose_corners_are_all_of_smaller_pictures_is_named(share, named):
    """Its lens is estimated, and shows the size by its centre."""
    robot, seen = corners_of(MOUNTS[0])
    seen = scaled_at(range(len(seen)), share, seen)
    found = visioncal.calibrate(Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]))
    said = [each.do.words for each in found.verdict.findings if each.kind == "image_sizes"]
    assert ["resolution = [640, 480]" in words for words in said] == [True] * named


def test_the_noise_of_scaled_corners_is_scaled_with_them():
    robot, seen = corners_of(MOUNTS[0])
    seen = scaled_at(range(9, 15), 0.5, seen)
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0])
    table = session.corner_table
    table = replace(table, sigmas_px=np.full(len(table), 0.1))
    mended = mended_images.mend_images(session.with_content(corners=table)).corner_table
    is_scaled = np.isin(mended.views, [*range(9, 15)])
    np.testing.assert_allclose(mended.sigmas_px, np.where(is_scaled, 0.2, 0.1))


@pytest.mark.parametrize("views", [1, 24])
def test_stated_lenses_without_usable_corners_have_nothing_to_mend(views):
    lens = Camera("brown", SIZE, np.array([1100.0, 1100.0, 655.0, 471.0]), np.zeros(5))
    robot, seen = corners_of(MOUNTS[0])
    few = [(ids[:3], px[:3]) for ids, px in seen[:views]]
    for some in (few, seen[:1]):
        poses = robot[: len(some)]
        session = Session.from_corners(some, poses, BOARD, SIZE, mount=MOUNTS[0], camera=lens)
        raised(DataError, "nothing was written", mended_images.mend_images, session)


def test_corners_numbered_from_behind_are_not_exchanged_by_half_a_pixel():
    robot, seen = corners_of(MOUNTS[0])
    order = np.argsort(np.lexsort((POINTS[:, 0], -POINTS[:, 1])))
    inside = [(px > 0).all(axis=1) & (px < SIZE[1]).all(axis=1) for _, px in seen]
    seen = [(order[ids[at]], px[at]) for (ids, px), at in zip(seen, inside, strict=True)]
    seen[0][1][np.argmax(seen[0][1][:, 1]), 1] = SIZE[1] + 0.5
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0])
    (cause, *_) = visioncal.calibrate(session).verdict.causes
    assert cause.kind == "corner_numbers"
    assert "seen from behind" in cause.words
    raised(DataError, "nothing was written", mended_images.mend_images, session)


def test_exchanged_columns_of_one_camera_of_several_are_exchanged_back_alone(monkeypatch):
    robot, seen = corners_of(MOUNTS[0])
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0])
    error = OtherBoardError.of(Finding("corner_numbers", "Exchanged.", EXCHANGE_COLUMNS, (3, 4)))
    stage = Mock(side_effect=error.within("cam_left"))
    monkeypatch.setattr(mended_images, "run_stages", stage)
    table, mended = session.corner_table, mended_images.mend_images(session).corner_table
    is_exchanged = np.isin(table.views, [3, 4])[:, None]
    np.testing.assert_array_equal(mended.px, np.where(is_exchanged, table.px[:, ::-1], table.px))


@pytest.mark.parametrize("beyond", [True, slow(False)])
def test_exchanged_columns_of_corners_are_exchanged_back_by_the_printed_command(
    tmp_path, monkeypatch, beyond
):
    monkeypatch.chdir(tmp_path)
    robot, seen = corners_of(MOUNTS[0])
    if not beyond:
        # All would be in the picture, too; the lens's centre is not in its middle.
        inside = [(px > 0).all(axis=1) & (px < SIZE[1]).all(axis=1) for _, px in seen]
        seen = [(ids[at], px[at]) for (ids, px), at in zip(seen, inside, strict=True)]
    session = Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0])
    sound = calibrated_corners() if beyond else visioncal.calibrate(session)
    seen = [(ids, px[:, ::-1]) for ids, px in seen]
    Session.from_corners(seen, robot, BOARD, SIZE, mount=MOUNTS[0]).save(tmp_path / "cell")
    found = follow("calibrate", "cell", "-o", "out")
    said = found.runs[0].said.replace("\n", " ")
    assert "In corners.csv, u_px and v_px are exchanged" in said
    assert found.last.status == 0
    for name, edge in Calibration.load("out").edges.items():
        np.testing.assert_allclose(edge.matrix, sound.edges[name].matrix, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_pictures_that_are_turned_from_a_view_on_are_no_other_camera(mount):
    robot, boards = poses_of(mount)
    boards[14:] = compose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ boards[14:]
    cause = visioncal.calibrate(pairs_session(mount, robot, boards)).verdict.causes[0]
    assert (cause.kind, cause.views) == ("turned_pictures", (*range(14, 24),))
    assert "From view 14 on, the pictures are turned by 180 deg" in cause.words
    # Half a turn elsewhere is another camera's or tool's.
    boards[14:, 0, 3] += 0.05
    cause = visioncal.calibrate(pairs_session(mount, robot, boards)).verdict.causes[0]
    assert cause.views == (*range(14, 24),)
    assert "pictures" not in cause.words


@pytest.mark.parametrize(
    ("kind", "degrees", "mount"),
    [
        slow("corners", 180, MOUNTS[0]),
        ("pairs", 270, MOUNTS[1]),
        slow("corners", 90, MOUNTS[1]),
        slow("pairs", 180, MOUNTS[0]),
    ],
)
def test_turned_pictures_are_turned_back_by_the_printed_command(
    tmp_path, monkeypatch, kind, degrees, mount
):
    """Here and there or from a view on; with a lens of a centre off the middle, to be estimated."""
    monkeypatch.chdir(tmp_path)
    if kind == "pairs":
        some, (robot, boards) = [1, 4, 5, 9], poses_of(mount)
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        sound = calibrated(mount)
        boards[some] = compose(turn, np.zeros(3)) @ boards[some]
        session = pairs_session(mount, robot, boards)
    else:
        some, (robot, seen) = [*range(14, 24)], corners_of(mount)
        sound = visioncal.calibrate(
            Session.from_corners(seen, robot, BOARD, (1280, 960), mount=mount)
        )
        for view in some:
            ids, (u, v) = seen[view][0], seen[view][1].T
            turned = {180: (1279 - u, 959 - v), 90: (959 - v, u)}[degrees]
            seen[view] = ids, np.column_stack(turned)
        session = Session.from_corners(seen, robot, BOARD, (1280, 960), mount=mount)
    session.save(tmp_path / "cell")
    cause, mended = followed("cell")
    assert (cause.kind, cause.views) == ("turned_pictures", (*some,))
    assert f"turned by {degrees} deg" in cause.words
    assert f"--turned {ranges(some)}:{degrees} " in cause.do.command
    assert sum(view.used for view in mended.views) == len(robot)
    for name, edge in sound.edges.items():
        np.testing.assert_allclose(mended.edges[name].matrix, edge.matrix, atol=1e-6)


def test_views_without_pictures_are_not_said_to_be_turned_back():
    rows = [["0", "2.0", "0.1", "0.2"], ["1", "2.1", "0.1", "0.2"]]
    columns, images = ["view", "meas_x_m", "meas_y_m", "meas_z_m"], MemoryImages({})
    document = {"schema": 1, "name": "read", "mount": "eye-to-hand"}
    read = Session.assemble(document, columns, rows, images)
    words = "Views 0-1 have neither pictures nor corners or poses of the target"
    raised(DataError, words, turn_boards, read, [0, 1], (180.0,))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "columns", "mount"),
    [
        (np.s_[:, 0, 3], "x_m", MOUNTS[0]),
        (np.s_[:, :2, 3], "x_m and y_m", MOUNTS[1]),
        (np.s_[:, :3, :3], "qx to qw", MOUNTS[0]),
    ],
)
def test_columns_that_stand_in_other_rows_are_no_rail(part, columns, mount):
    robot, boards = poses_of(mount)
    mixed = robot.copy()
    mixed[part] = np.roll(robot, 1, axis=0)[part]
    cause = visioncal.calibrate(pairs_session(mount, mixed, boards)).verdict.causes[0]
    assert f"the numbers of {columns} stand 1 row later than the others" in cause.words
    assert f"move the cells of {columns} up by 1 row" in cause.do.words
    # Once moved, the last row has none.
    mixed[:-1][part] = mixed[1:][part]
    mended = visioncal.calibrate(pairs_session(mount, mixed[:-1], boards[:-1]))
    assert sum(view.used for view in mended.views) == len(boards) - 1


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_column_in_other_rows_is_named_where_it_hardly_varies(mount):
    edges, (flat, _) = calibrated(mount).edges, poses_of(mount)
    flat[:, 2, 3] = 0.5 + 0.1 * (flat[:, 2, 3] - 0.5)
    x, z = (edge.matrix for edge in edges.values())
    boards = invert(flat @ x) @ z if mount == MOUNTS[0] else invert(x) @ flat @ z
    flat[:, 2, 3] = np.roll(flat[:, 2, 3], 1)
    cause = visioncal.calibrate(pairs_session(mount, flat, boards)).verdict.causes[0]
    assert "the numbers of z_m stand 1 row later than the others" in cause.words


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_column_that_was_sorted_by_itself_is_no_rail(mount):
    robot, boards = poses_of(mount)
    robot[:, 2, 3] = np.sort(robot[:, 2, 3])
    cause = visioncal.calibrate(pairs_session(mount, robot, boards)).verdict.causes[0]
    assert "The robot's z has the numbers of other rows" in cause.words


@pytest.mark.slow
@pytest.mark.parametrize(
    ("when", "degrees"), [("from view 12 on", 90.0), ("in all of these", 180.0)]
)
def test_a_base_that_turned_is_no_board_that_was_read_turned(when, degrees):
    some = slice(12, None) if when == "from view 12 on" else slice(1, None, 2)
    robot, boards = poses_of("eye-in-hand")
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    robot[some] = compose(turn, np.array([1.4, 0.2, 0.0])) @ robot[some]
    cause = visioncal.calibrate(pairs_session("eye-in-hand", robot, boards)).verdict.causes[0]
    assert cause.kind == "something_moved", cause.words
    assert when in cause.words
    assert "or the controller's base frame was another one" in cause.words
    assert f"mm and {degrees:.0f} deg" in cause.words


@pytest.mark.slow
def test_rows_in_reverse_order_are_mended_by_one_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, boards = poses_of("eye-in-hand")
    robot[14:] = robot[14:][::-1].copy()
    pairs_session("eye-in-hand", robot, boards).save(Path("cell"))
    followed = follow("calibrate", "cell", "-o", "out")
    assert followed.last.status == 0
    mended = visioncal.calibrate("cell-fixed")
    used, sound = (
        [view.used for view in result.views] for result in (mended, calibrated("eye-in-hand"))
    )
    assert sum(used) == sum(sound)
    assert "exchanged_views" not in {finding.kind for finding in mended.verdict.findings}
    assert "rows 14 to 23 are in reverse order" in followed.runs[0].said
    assert "--exchange 14,23,15,22,16,21,17,20,18,19 " in followed.runs[0].said
    again = typed("convert", "cell", "other", "--exchange", "14,23,23,14")
    assert "Views 23 and 14 must be exchanged once" in again.refused("--exchange").err


@pytest.mark.parametrize("seed", [2, 109, 114, 120])
def test_two_views_that_are_exchanged_are_named_where_readings_differ_in_noise(seed, tmp_path):
    """A view fits another stop where it would be an inlier, as at its own."""
    cell = simulate(CellOptions(views=15, seed=seed))
    session = Session.load(write_session(cell, tmp_path / "cell", images=False))
    rows = [{key: view.numbers[key] for key in POSE} for view in session.views]
    rows[5], rows[6] = rows[6], rows[5]
    views = [
        {key: value for key, value in (view.numbers | row).items() if not key.endswith("_rad")}
        for view, row in zip(session.views, rows, strict=True)
    ]
    pairs = zip(session.views, views, strict=True)
    exchanged = replace(session, views=tuple(replace(view, numbers=row) for view, row in pairs))
    cause = visioncal.calibrate(exchanged).verdict.causes[0]
    assert (cause.kind, cause.views) == ("exchanged_views", (5, 6))


@pytest.mark.slow
def test_rows_exchanged_among_stops_that_are_alike_have_one_partner_each():
    """Each of two pairs of rows fits those of the other, as where a programme ran twice."""
    rng, count = np.random.default_rng(3), 12
    x, z = exp(np.array([[0.3, -0.1, 1.5, 0.03, -0.05, 0.02], [0, 3, 0, 0.3, 0, 0.1]]))
    cam = exp(rng.uniform(-1, 1, (count, 6)) * [0.6, 0.6, 1.5, 0.05, 0.05, 0.05])
    cam[:, 2, 3] += 0.3
    cam = np.concatenate([cam, cam])
    noise = [exp(rng.normal(0, [2e-3] * 3 + [1e-3] * 3, (2 * count, 6))) for _ in range(2)]
    order = np.arange(2 * count)
    order[[2, 7, 14, 19]] = order[[7, 2, 19, 14]]
    robot = z @ invert(cam) @ invert(x) @ noise[0]
    session = pairs_session(MOUNTS[0], robot, (cam @ noise[1])[order])
    cause = visioncal.calibrate(session).verdict.causes[0]
    assert cause.kind == "exchanged_views"
    assert sorted(cause.views) == [2, 7, 14, 19]
    pairs = np.reshape([int(view) for view in cause.do.command.split()[5].split(",")], (2, 2))
    assert (np.sort(pairs % count, axis=1) == [2, 7]).all()


def test_views_of_a_symmetric_board_that_are_read_turned_are_named_and_turned_back(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    robot, boards = poses_of(MOUNTS[0])
    size, matrix = (1280, 960), np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0, 0, 1.0]])
    empty = [(np.arange(0), np.zeros((0, 2)))] * len(robot)
    # Half a turn maps its pattern onto itself.
    name = str(tmp_path / "board.toml")
    Path(name).write_text('kind = "checkerboard"\ncolumns = 8\nrows = 6\nsquare_m = 0.028\n')
    points = corner_positions(
        next(iter(Session.from_corners(empty, robot, name, size).boards.values()))
    )
    # The middle of the board before the camera.
    boards = boards @ compose(np.eye(3), -points.mean(axis=0))
    rng, seen, read_turned = np.random.default_rng(2), [], (3, 4, 11)
    x, z = exp(np.array([0.1, -0.2, 0.3, 0.05, 0.02, 0.1])), exp(np.array([0, 0, 0.4, 0.7, 0, 0]))
    robot = z @ invert(boards) @ invert(x)
    for view, pose in enumerate(boards):
        px = cv2.projectPoints(points, *split(pose), matrix, None)[0][:, 0]
        ids = np.arange(len(points))
        seen.append((ids[::-1] if view in read_turned else ids, px + rng.normal(0, 0.1, px.shape)))
    Session.from_corners(seen, robot, name, size).save(tmp_path / "cell")
    found = visioncal.calibrate(tmp_path / "cell")
    # The fit had turned them back: nothing is doubted.
    assert found.verdict.status == "good"
    (said,) = (note for note in found.verdict.findings if note.kind == "turned_views")
    assert said.views == read_turned
    assert "as if it was turned by 180 deg" in said.words
    written = said.do.command.partition("--turned ")[2].split(" ")[0]
    assert written.startswith("3-4,11:180,")
    done = typed("convert", "cell", "cell-fixed", "--turned", written)
    assert done.status == 0, done.said
    again = visioncal.calibrate(tmp_path / "cell-fixed")
    assert "turned_views" not in {note.kind for note in again.verdict.findings}
    for edge_name, edge in found.edges.items():
        # The same corners under the same numbers.
        np.testing.assert_allclose(again.edges[edge_name].matrix, edge.matrix, atol=1e-6)


def test_a_tool_is_taken_off_no_view_without_a_pose():
    px = np.random.default_rng(0).uniform(0, 600, (4, 20, 2))
    seen = [(np.arange(20), each) for each in px]
    session = Session.from_corners(seen, poses_of(MOUNTS[0], 4)[0], BOARD, (640, 480))
    cells = [
        ["" if view.number == 1 and name in POSE else view.cell(name) for name in session.columns]
        for view in session.views
    ]
    with pytest.raises(DataError, match="view 1 has no pose of the robot"):
        remove_tool(session.with_content(cells=cells), [1], (0.0,) * 6)


def test_corners_are_numbered_back_and_views_without_partner_go():
    px = np.random.default_rng(0).uniform(0, 600, (4, 20, 2))
    # The 8 x 5 inner corners of the board, the first of which is one square from both edges.
    seen = [(np.arange(20), view_px) for view_px in px]
    session = Session.from_corners(seen, poses_of(MOUNTS[0], 4)[0], BOARD, (640, 480))
    points = corner_positions(next(iter(session.boards.values())))
    back = turn_boards(session, [1], (180.0, *(1e3 * points.mean(axis=0)[:2])))
    np.testing.assert_array_equal(back.corners[0].ids, np.arange(20))
    np.testing.assert_array_equal(
        np.sort(back.corners[1].ids), len(points) - 1 - np.arange(20)[::-1]
    )
    moved = shift_views(session, [2, 3], 1)
    assert [view.number for view in moved.views] == [0, 1, 2]
    assert moved.views[2].cell("x_m") == session.views[3].cell("x_m")
    np.testing.assert_array_equal(moved.corners[2].px, session.corners[2].px)
    assert "3 had none there and were dropped" in moved.declaration.corrected[0]
    # View 1 keeps its pose, which view 2 would have as well.
    earlier = shift_views(session, [2, 3], -1)
    assert [view.number for view in earlier.views] == [0, 1, 3]
    assert earlier.views[2].cell("x_m") == session.views[2].cell("x_m")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "mount", "kind"),
    [
        ("pairing", "eye-in-hand", "shifted_rows"),
        ("symmetric", "eye-to-hand", "turned_board"),
    ],
)
def test_real_records_are_mended(tmp_path, monkeypatch, case, mount, kind):
    if not CASES.is_dir():
        pytest.skip("there are no recordings of others here")
    monkeypatch.chdir(tmp_path)
    source = CASES / case / f"{case}.json"
    typed("convert", source, "cell", "--mount", mount).good()
    assert followed("cell")[0].kind == kind


@pytest.mark.slow
def test_a_small_marker_with_the_other_pose_is_named(tmp_path, monkeypatch):
    if not CASES.is_dir():
        pytest.skip("there are no recordings of others here")
    monkeypatch.chdir(tmp_path)
    typed("convert", CASES / "flips/flips.json", "cell", "--mount", "eye-to-hand").good()
    found = visioncal.calibrate("cell")
    assert found.verdict.causes[0].kind == "flipped_poses"
    assert [*found.verdict.causes[0].views] == [0, 2, 10, 14, 15, 20, 22]
    # Two sigma of what single tags of 50 mm leave, 5 mm a view.
    away = found.edges["base_from_cam"].matrix[:3, 3] - [0.9, 0.2, 0.8]
    assert np.linalg.norm(away) < 0.01


@cache
def whole_cell(seed):
    """The session of a whole cell without a mistake."""
    return recorded(simulate(replace(OPTIONS, seed=seed, stops=24)))


def in_a_cell(seed, kind):
    """A whole cell whose robot b has one mistake from a stop on, and the views that are wrong."""
    session = whole_cell(seed)
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    of_b = [at for at, view in enumerate(session.views) if view.text.get("robot") == "b"]
    stops = sorted({session.views[at].stop for at in of_b})
    half = len(stops) // 2
    # Each pose of the second half is that of the stop after it, or of the last one before.
    source = dict(zip(stops, stops, strict=True))
    later = stops[half + 1 :] if kind == "shifted_rows" else [stops[half - 1]] * len(stops)
    source.update(zip(stops[half:], later, strict=False))
    poses = {session.views[at].stop: dict(cells[at]) for at in of_b}
    for at in of_b if kind != "nothing" else ():
        pose = poses[source[session.views[at].stop]]
        cells[at].update({name: pose[name] for name in session.columns[5:]})
    wrong = {session.views[at].number for at in of_b if session.views[at].stop in stops[half:]}
    rows = [[*row.values()] for row in cells]
    return session.with_content(document=session.document, cells=rows), wrong


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["shifted_rows", "copied_poses", "nothing"])
def test_a_mistake_in_a_whole_cell_is_named_and_a_sound_one_is_not_accused(kind, seed):
    session, wrong = in_a_cell(seed, kind)
    causes = visioncal.calibrate(session).verdict.causes
    checked = [finding.kind for finding in visioncal.doctor(session).findings]
    assert checked == ([] if kind == "nothing" else [kind])
    if kind == "nothing":
        assert not {cause.kind for cause in causes} & {*UNDONE, "exchanged_views"}
        return
    assert causes[0].kind == kind
    assert causes[0].words.startswith("Robot b, in its rows of cam_left and target_plate_b: ")
    if kind == "copied_poses":
        # Views of the robot's plate by the other one go by the stuck poses, too.
        stops = {view.stop for view in session.views if view.number in wrong}
        at_stops = [view for view in session.views if view.stop in stops]
        beside = {at.number for at in at_stops if at.cell("target") == "plate_b"} - wrong
        assert beside
        assert {*causes[0].views} == wrong | beside
        assert "Left out, too, where its poses are repeated: views " in causes[0].words
        others = [at.number for at in session.views if at.number not in causes[0].views]
        assert causes[0].do.command.endswith(f"--views {ranges(others)}")
        mended = visioncal.calibrate(session.only(others))
    else:
        assert {*causes[0].views} <= wrong
        assert len(causes[0].views) >= 0.7 * len(wrong)
        # The command is of all rows of the robot from the first that is apart.
        apart = sorted(wrong)
        assert f"--shift {ranges(apart)}:-1 && " in causes[0].do.command
        mended = visioncal.calibrate(shift_views(session, apart, -1))
    assert mended.verdict.status == "good"
    sound = visioncal.calibrate(in_a_cell(seed, "nothing")[0])
    before, after = ({at.view for at in each.views if at.used} for each in (sound, mended))
    # Rows of stuck poses are gone, and no pose is left for the first that is shifted.
    gone = {*causes[0].views} if kind == "copied_poses" else {min(wrong)}
    assert before - after <= gone


def test_a_camera_that_is_declared_on_another_robot_is_named_with_its_own():
    session = in_a_cell(0, "nothing")[0]
    frames = {**session.document["frames"], "cam_hand": "flange_b"}
    rows = [[view.cell(name) for name in session.columns] for view in session.views]
    wrong = session.with_content(document={**session.document, "frames": frames}, cells=rows)
    (found,) = misreadings(located(wrong))
    assert found.words.startswith("cam_hand is on robot a, and not on robot b as [frames] declares")
    assert 'Write cam_hand = "flange_a" in [frames]' in found.do.words


def test_rows_of_several_robots_are_not_shifted_together():
    session = in_a_cell(0, "nothing")[0]
    of_b = [at.number for at in session.views if at.text.get("robot") == "b"]
    of_a = [at.number for at in session.views if at.text.get("robot") == "a"]
    refused = raised(DataError, "not all of one robot", shift_views, session, [of_a[0], *of_b], 1)
    assert refused.culprits == ("--shift",)


def test_corners_of_other_boards_are_no_corners_of_a_pair_of_a_cell():
    run = RunState(in_a_cell(0, "nothing")[0])
    for stage in STAGES[:5]:
        run = stage.run(run)
    pair = next(one for one in pairs_of(run, "b") if one.target == "target_plate_b")
    pair_run = of_pair(run, "b", pair)
    (look,) = pair_run.cameras.values()
    (board,) = pair_run.session.boards.values()
    assert max(corners.ids.max() for corners in look.corners.values()) < len(
        corner_positions(board)
    )
    assert {*look.corners} == {view.number for view in pair_run.session.views}
    assert {*look.corners} < {*run.cameras[pair.camera].corners}


@pytest.mark.slow
def test_a_cell_gets_no_command_that_would_drop_the_lenses_of_all_its_cameras():
    session = whole_cell(0)
    left = session.document["cameras"]["left"]
    other = {**left, "matrix": [1.3 * left["matrix"][0], *left["matrix"][1:]]}
    cameras = {**session.document["cameras"], "left": other}
    session = session.with_content(document={**session.document, "cameras": cameras})
    cause = visioncal.calibrate(session).verdict.causes[0]
    assert cause.kind == "other_lens"
    assert not cause.do.command


@pytest.mark.slow
def test_behind_a_mistake_of_one_robot_another_one_that_is_misread_is_named():
    session, wrong = in_a_cell(0, "shifted_rows")
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    for row in (row for row in cells if row["robot"] == "a"):
        w_first = [row[name] for name in ("qw", "qx", "qy", "qz")]
        row.update(zip(("qx", "qy", "qz", "qw"), w_first, strict=True))
    rows = [[*row.values()] for row in cells]
    session = session.with_content(document=session.document, cells=rows)
    error = raised(
        DegenerateError, "Robot b, .* poses are 1 row apart", visioncal.calibrate, session
    )
    assert f"--shift {ranges(sorted(wrong))}:-1 && " in error.next_step
    mended = shift_views(session, sorted(wrong), -1)
    raised(
        DegenerateError,
        "Robot a: With the robot's rotations as a quat",
        visioncal.calibrate,
        mended,
    )


def test_a_motion_that_is_ample_is_not_refused_where_no_reading_closes_the_chain():
    robot, boards = poses_of(MOUNTS[0])
    w_first = np.roll(Rotation.from_matrix(robot[:, :3, :3]).as_quat(), 1, axis=1)
    mixed = compose(Rotation.from_quat(w_first).as_matrix(), robot[:, :3, 3])
    others = np.arange(len(mixed)) % 3 > 0
    mixed[others] = np.roll(mixed[others], 3, axis=0)[::-1]
    state = RunState(pairs_session(MOUNTS[0], mixed, boards))
    names = {"robot", "detect", "intrinsics", "pnp"}
    state = run_stages(state, [stage for stage in STAGES if stage.name in names])
    refusal = DegenerateError("a predicted sigma of 108 mm: add views in which it is tilted")
    error = explained(refusal, state, "answer", are_located=True)
    assert error.message.startswith("No reading that was tried stands out: as first read")
    assert "tilted" not in str(error)


@pytest.mark.parametrize("words", ["3", "3-5:0", "3-5:x", "90:2"])
def test_a_shift_that_cannot_be_made_is_refused(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    pairs_session(MOUNTS[0], *poses_of(MOUNTS[0])).save(tmp_path / "cell")
    done = typed("convert", "cell", "moved", "--shift", words)
    assert done.status == 2
    assert "--shift" in done.err
    assert not (tmp_path / "moved").exists()
