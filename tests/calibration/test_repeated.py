"""Rows of one stop: declared stops, several images, copies, and poses against joint angles."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import session_of
from support.marks import slow
from support.misfits import misfit

from visioncal import calibrate
from visioncal.calibration.stages.repeats import repeated_rows
from visioncal.calibration.stages.reported_poses import reported_poses
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.robot import load_robot
from visioncal.session import MemoryImages, Session, View, target_document
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, pose_row
from visioncal.session.corners import CornerTable
from visioncal.simulation import BOARDS, CellOptions, cell_session, read_cell, simulate
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, tracked
from visioncal.simulation.instrument_session import session_of as readings_of

_PLACES = tuple(f"{of}{axis}_m" for of in ("", "cft_", "meas_") for axis in "xyz")


def copied(session: Session, jitter_m: float, *, interleaved: bool) -> Session:
    """A session with every row twice; all positions of the copies jitter.

    Interleaved copies follow their rows; others follow the whole session.
    """
    rng, step = np.random.default_rng(0), 1 + max(view.number for view in session.views)
    rows = [*session.views]
    for at, view in enumerate(session.views):
        moved = {
            name: value + jitter_m * rng.standard_normal()
            for name, value in view.numbers.items()
            if name in _PLACES
        }
        copy = replace(view, number=view.number + step, numbers={**view.numbers, **moved})
        rows.insert(2 * at + 1 if interleaved else len(rows), copy)
    table = session.corner_table
    if table is not None:
        table = CornerTable(
            np.concatenate([table.views, table.views + step]),
            np.tile(table.points, 2),
            np.tile(table.px, (2, 1)),
            table.targets * 2,
        )
    return Session.assemble(
        session.document,
        session.columns,
        [[row.cell(column) for column in session.columns] for row in rows],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=table,
    )


SIGMA_PX = 0.05
# The size of the board is known: else it is most of what transforms are uncertain by.
BOARD = replace(BOARDS["charuco"], square_sigma_m=1e-7)
CELL = simulate(CellOptions(views=8, seed=3))
ROBOT = load_robot(CELL.options.robot)
SIDEWAYS = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
STEADY = simulate(CellOptions(views=12, cut_views=0.0, seed=3))


def table(shown, rng):
    """Corners of views, each with noise of its own."""
    counts = [len(exact.ids) for _, exact in shown]
    px = np.concatenate([exact.px for _, exact in shown])
    return CornerTable(
        np.repeat([view for view, _ in shown], counts),
        np.concatenate([exact.ids for _, exact in shown]),
        px + SIGMA_PX * rng.standard_normal(px.shape),
        ("",) * len(px),
    )


def bent(corners, bias_px):
    """Corners that are off by a cubic of their places, which their places in the image choose."""
    rng = np.random.default_rng(np.round(1e3 * corners.px[0]).astype(int))
    u = 2.0 * (corners.px - corners.px.mean(axis=0)) / np.ptp(corners.px, axis=0)
    terms = np.column_stack([u**2, u[:, 0] * u[:, 1], u**3])
    return replace(corners, px=corners.px + bias_px * terms @ rng.standard_normal((5, 2)))


@pytest.mark.slow
def test_a_film_of_a_few_stops_is_so_many_views():
    session = of_one_camera(8)
    shown = session.corner_table
    # The arm was still moving when the fourth image was taken.
    px = shown.px + 3.0 * (shown.views == 3)[:, None]
    found = calibrate(replace(session, corner_table=replace(shown, px=px)))
    kept = {view.view for view in found.views if view.used or "mean" not in view.reason}
    assert kept == {8 * stop for stop in range(12)} | {3}
    assert found.views[1].reason == "counts in the mean of view 0, of its stop"


def measured(rows):
    """A session of measured poses: where the robot stood along x, when, and what was read."""

    def cells(along_m):
        return [repr(value) for value in pose_row(exp(np.array([0, 0, 0, along_m, 0, 0]))).values()]

    return Session.assemble(
        {"schema": 1, "name": "near", "mount": "eye-in-hand"},
        ["view", "stamp_s", *POSE, *MEASURED_CAM_POSE],
        [
            [str(view), "" if stamp_s is None else str(stamp_s), *cells(stood_m), *cells(read_m)]
            for view, (stood_m, stamp_s, read_m) in enumerate(rows)
        ],
        MemoryImages({}),
    )


@pytest.mark.parametrize(
    ("rows", "repeated"),
    [
        ([(0.1, None, 0.0), (0.2, None, 0.0), (0.1, None, 1e-5)], {2: 0}),
        ([(0.1, 1.0, 0.0), (0.2, 2.0, 0.0), (0.1, 3.0, 1e-5)], {}),
        ([(0.1, 1.0, 0.0), (0.2, 2.0, 0.0), (0.1, 1.0, 1e-5)], {2: 0}),
        # No sensor repeats to the last digit.
        ([(0.1, 1.0, 0.0), (0.2, 2.0, 0.0), (0.1, 3.0, 0.0)], {2: 0}),
        # Farther away than rows of one stop are.
        ([(0.1, None, 0.0), (0.2, None, 0.0), (0.102, None, 0.0)], {}),
    ],
)
def test_near_readings_are_copies_where_no_time_distinguishes_them(rows, repeated):
    assert repeated_rows(measured(rows), {}) == repeated


def of_one_camera(images, *, stops=True, trembling_m=0.0):
    """A session with so many images a stop, whose poses are read anew for each of them."""
    rng = np.random.default_rng(8)
    rows, shown = [], []
    for stop, pose in enumerate(STEADY.robot.base_from_flange):
        for _ in range(images):
            shown.append((len(rows), STEADY.exact_corners[stop]))
            # Radians count as metres here: both tremble alike.
            read = pose @ exp(trembling_m * rng.standard_normal(6))
            named = {"stop": stop} if stops else {}
            rows.append({"view": len(rows), **named, **pose_row(read)})
    optics = STEADY.options.camera
    camera = {"resolution": list(optics.resolution), "model": optics.model, "intrinsics": "hold"}
    camera |= {"matrix": optics.matrix.tolist(), "distortion": optics.distortion.tolist()}
    document = {"schema": 1, "name": "repeated", "mount": "eye-in-hand", "target": "board.toml"}
    return Session.assemble(
        document | {"camera": camera},
        list(rows[0]),
        [[str(value) for value in row.values()] for row in rows],
        MemoryImages({}),
        target_document=target_document(BOARD),
        corners=table(shown, rng),
    )


@pytest.mark.slow
def test_images_of_a_stop_share_the_robots_error():
    once, name = calibrate(of_one_camera(1)).edges["flange_from_cam"], "flange_from_cam"
    for stops, trembling_m in ((True, 2e-6), (False, 1e-5)):
        found = calibrate(of_one_camera(6, stops=stops, trembling_m=trembling_m))
        edge = found.edges[name]
        # Six independent views for each would give 0.41; corners alone get better.
        assert 0.55 < edge.sigma_mm / once.sigma_mm < 1.05
        assert found.verdict.status == "good", found.verdict.reasons
        # Chi-square of six exceeds this in one case of a thousand.
        assert misfit(edge, STEADY.transforms[name]) < 22.5


@pytest.mark.slow
def test_images_of_what_stands_still_are_no_copies_at_other_stops():
    cell = simulate(replace(read_cell("two-cameras"), stops=14, pixel_sigma_px=0.002))
    found = calibrate(cell_session(cell, "still", seen="corners"))
    assert all(view.used for view in found.views)


def test_pictures_that_were_stored_anew_are_copies():
    session = of_one_camera(1)
    shown = session.corner_table
    of_first = shown.views < 6
    # Views 6 to 11 are the pictures of views 0 to 5 at their poses, stored by another program.
    again = replace(
        shown,
        views=np.concatenate([shown.views[of_first], shown.views[of_first] + 6]),
        points=np.tile(shown.points[of_first], 2),
        px=np.concatenate([shown.px[of_first], shown.px[of_first] + 2e-3]),
        targets=("",) * (2 * int(of_first.sum())),
    )
    numbers = [view.numbers for view in session.views[:6]] * 2
    pairs = zip(session.views, numbers, strict=True)
    views = tuple(replace(view, numbers=row) for view, row in pairs)
    found = calibrate(replace(session, views=views, corner_table=again))
    (finding,) = (one for one in found.verdict.findings if one.kind == "repeated_views")
    assert finding.views == tuple(range(6, 12))
    assert finding.words.startswith("Views 6-11 repeat 0-5: ")


@pytest.mark.slow
def test_a_lens_is_not_moved_by_what_repeated_views_have_wrong_alike():
    """The bias is within the noise of one view, and clear in fourteen that count as one."""
    options = read_cell("two-cameras")
    boards = tuple(
        replace(board, target=replace(board.target, square_sigma_m=1e-7))
        for board in options.boards
    )
    # Beside such a robot, corners are nearly exact.
    robots = tuple(replace(robot, robot_sigma_m=1e-4) for robot in options.robots)
    cell = simulate(replace(options, stops=14, boards=boards, robots=robots))
    session = cell_session(cell, "repeated", seen="corners")
    # All views of the board on the floor by one camera have the same bias, as a detector has it.
    seen = [
        (sight.view, bent(sight.exact, SIGMA_PX) if sight.board == "floor" else sight.exact)
        for sight in cell.sights
    ]
    corners = table(seen, np.random.default_rng(8))
    found = calibrate(replace(session, corner_table=corners))
    for name, edge in found.edges.items():
        truth = cell.mountings[name.partition("_from_")[2]]
        if name.startswith("cell"):
            truth = invert(cell.mountings["base_a"]) @ truth
        assert misfit(edge, truth) < 22.5, name


KINDS = {
    "poses": lambda: cell_session(simulate(CellOptions(views=12)), "cell", seen="poses"),
    "corners": lambda: cell_session(
        simulate(CellOptions(views=12, seed=3)), "cell", seen="corners"
    ),
    "readings": lambda: readings_of(tracked(InstrumentOptions(stops=24, seed=18, points=THREE))),
}


@pytest.mark.parametrize(
    ("kind", "jitter_m", "interleaved"),
    [slow("poses", 1e-4, False), ("corners", 0.0, True), slow("readings", 1e-4, True)],
)
def test_copies_of_rows_change_nothing(kind, jitter_m, interleaved):
    session = KINDS[kind]()
    before = calibrate(session)
    after = calibrate(copied(session, jitter_m, interleaved=interleaved))
    assert before.edges.keys() == after.edges.keys()
    for name, edge in before.edges.items():
        assert np.array_equal(after.edges[name].covariance, edge.covariance)
    assert sum(view.used for view in after.views) == sum(view.used for view in before.views)
    # Readings that differ are named without a doubt: an instrument is read several times a stop.
    kind = "repeated_readings" if jitter_m else "repeated_views"
    (found,) = (finding for finding in after.verdict.findings if finding.kind == kind)
    originals = {view.number for view in session.views}
    assert originals.isdisjoint(found.views)
    assert originals.union(found.views) >= {view.view for view in after.views}


@pytest.mark.slow
def test_readings_of_one_stated_stop_are_no_copies_to_delete():
    session = KINDS["readings"]()
    stated = replace(session, views=tuple(replace(row, stop=row.number) for row in session.views))
    found = calibrate(copied(stated, 1e-5, interleaved=True))
    assert not {one.kind for one in found.verdict.findings} & {"repeated_readings"}
    reasons = {view.reason for view in found.views if not view.used}
    assert reasons == {"read anew at its stop, which counts once"}


def stated_session(poses=None, joints=None, stops=None):
    """A session of poses or joint angles or both, one row each."""
    views = []
    for at in range(len(CELL.robot.joints)):
        numbers = {} if poses is None else pose_row(poses[at])
        if joints is not None:
            numbers |= {f"q{joint + 1}_rad": angle for joint, angle in enumerate(joints[at])}
        stop = None if stops is None else stops[at]
        views.append(View(at, image=f"{at}.png", stop=stop, numbers=numbers))
    return replace(session_of(CELL), views=tuple(views))


def in_pairs(step, poses=True):
    """The cell's rows in pairs: the second of each is the first, changed by a step."""
    values = CELL.robot.base_from_flange if poses else CELL.robot.joints
    rows = [step(values[at - 1]) if at % 2 else values[at] for at in range(len(values))]
    return stated_session(**{"poses" if poses else "joints": rows}, stops=np.arange(8) // 2)


@pytest.mark.parametrize(
    ("poses", "step", "words"),
    [
        (True, lambda pose: pose @ exp(5e-3 * SIDEWAYS), "5 mm and"),
        (True, lambda pose: pose @ exp(np.deg2rad([0.2, 0, 0, 0, 0, 0])), "0.2 deg apart"),
        (False, lambda angles: angles + 0.01 * np.eye(6)[5], "0.573 deg apart"),
    ],
)
def test_rows_of_one_stop_that_lie_apart_are_refused(poses, step, words):
    with pytest.raises(DataError, match=r"rows of stop 0 \(views 0, 1\)") as caught:
        reported_poses(in_pairs(step, poses), ROBOT)
    assert words in caught.value.message
    assert caught.value.culprits == ("views.csv: view 0", "views.csv: view 1")
    assert "Remove the stop numbers" in caught.value.next_step


def test_rows_of_one_stop_may_be_read_anew_and_a_pose_beside_its_joints_is_named():
    anew = in_pairs(lambda pose: pose @ exp(5e-4 * SIDEWAYS))
    assert len(reported_poses(anew, ROBOT).base_from_flange) == 8
    poses = CELL.robot.base_from_flange.copy()
    poses[5] = poses[5] @ exp(0.3 * SIDEWAYS)
    (found,) = reported_poses(stated_session(poses, CELL.robot.joints), ROBOT).warnings
    assert found.views == (5,)
    words = "Pose and joint angles disagree in view 5, by up to 300 mm and under 0.001 deg"
    assert found.words.startswith(words)
