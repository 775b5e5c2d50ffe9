"""Several images of one stop share the robot's error, and copies of a row are no new reading."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.marks import slow
from support.whole_cells import misfit

from visioncal import calibrate
from visioncal.calibration.stages.repeats import repeated_rows
from visioncal.core.transforms import exp, invert
from visioncal.session import MemoryImages, Session, target_document
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, pose_row
from visioncal.session.corners import CornerTable
from visioncal.simulation import BOARDS, CellOptions, cell_session, read_cell, simulate
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, session_of, tracked

_PLACES = tuple(f"{of}{axis}_m" for of in ("", "cft_", "meas_") for axis in "xyz")


def copied(
    session: Session, times: int, jitter_m: float = 0.0, *, seed: int = 0, interleaved: bool = False
) -> Session:
    """A session with every row so many times; all positions of the copies jitter.

    Interleaved copies follow their rows; others follow the whole session.
    """
    rng, step = np.random.default_rng(seed), 1 + max(view.number for view in session.views)
    views = []
    for copy in range(times):
        for at, view in enumerate(session.views):
            moved = {
                name: value + jitter_m * rng.standard_normal()
                for name, value in view.numbers.items()
                if copy and name in _PLACES
            }
            number = view.number + copy * step
            row = replace(view, number=number, numbers={**view.numbers, **moved})
            views.append(((at, copy) if interleaved else (copy, at), row))
    table = session.corner_table
    if table is not None:
        table = CornerTable(
            np.concatenate([table.views + copy * step for copy in range(times)]),
            np.tile(table.points, times),
            np.tile(table.px, (times, 1)),
            table.targets * times,
        )
    rows = [row for _, row in sorted(views, key=lambda item: item[0])]
    return Session.assemble(
        session.document,
        session.columns,
        [[row.cell(column) for column in session.columns] for row in rows],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=table,
    ).with_streams(session.streams)


SIGMA_PX = 0.05
# The size of the board is known: else it is most of what transforms are uncertain by.
BOARD = replace(BOARDS["charuco"], square_sigma_m=1e-7)


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


def of_one_camera(images, *, stops, trembling_m=0.0):
    """A session with so many images a stop, whose poses are read anew for each of them."""
    cell = simulate(CellOptions(views=12, cut_views=0.0, seed=3))
    rng = np.random.default_rng(8)
    rows, shown = [], []
    for stop, pose in enumerate(cell.robot.base_from_flange):
        for _ in range(images):
            shown.append((len(rows), cell.exact_corners[stop]))
            # Radians count as metres here: both tremble alike.
            read = pose @ exp(trembling_m * rng.standard_normal(6))
            named = {"stop": stop} if stops else {}
            rows.append({"view": len(rows), **named, **pose_row(read)})
    optics = cell.options.camera
    camera = {"resolution": list(optics.resolution), "model": optics.model, "intrinsics": "hold"}
    camera |= {"matrix": optics.matrix.tolist(), "distortion": optics.distortion.tolist()}
    document = {"schema": 1, "name": "repeated", "mount": "eye-in-hand", "target": "board.toml"}
    session = Session.assemble(
        document | {"camera": camera},
        list(rows[0]),
        [[str(value) for value in row.values()] for row in rows],
        MemoryImages({}),
        target_document=target_document(BOARD),
        corners=table(shown, rng),
    )
    return cell, session


def of_a_cell(images, *, stops, seed, bias_px=0.0):
    """A session of two fixed cameras, one arm and a board on the floor, likewise.

    All views of the board on the floor by one camera have the same bias, as a detector has it.
    """
    options = read_cell("two-cameras")
    boards = tuple(
        replace(board, target=replace(board.target, square_sigma_m=1e-7))
        for board in options.boards
    )
    # Beside such a robot, corners are nearly exact.
    robots = tuple(replace(robot, robot_sigma_m=1e-4) for robot in options.robots)
    cell = simulate(replace(options, stops=14, boards=boards, robots=robots, seed=seed))
    told = cell_session(cell, "repeated", seen="names")
    columns = [
        column for column in told.columns if column != "image" and (stops or column != "stop")
    ]
    exact = {sight.view: sight.exact for sight in cell.sights}
    for sight in cell.sights:
        if bias_px and sight.board == "floor":
            exact[sight.view] = bent(sight.exact, bias_px)
    rows, shown = [], []
    for view in sorted(told.views, key=lambda other: other.stop):
        for _ in range(images):
            if view.number in exact:
                shown.append((len(rows), exact[view.number]))
            rows.append([str(len(rows)), *(view.cell(column) for column in columns[1:])])
    return cell, Session.assemble(
        told.document,
        columns,
        rows,
        told.images,
        target_document=told.target_document,
        corners=table(shown, np.random.default_rng([8, seed])),
    )


def bent(corners, bias_px):
    """Corners that are off by a cubic of their places, which their places in the image choose."""
    rng = np.random.default_rng(np.round(1e3 * corners.px[0]).astype(int))
    u = 2.0 * (corners.px - corners.px.mean(axis=0)) / np.ptp(corners.px, axis=0)
    terms = np.column_stack([u**2, u[:, 0] * u[:, 1], u**3])
    return replace(corners, px=corners.px + bias_px * terms @ rng.standard_normal((5, 2)))


def off(cell, found, name):
    edge, truth = found.edges[name], cell.mountings[name.partition("_from_")[2]]
    if name.startswith("cell"):
        truth = invert(cell.mountings["base_a"]) @ truth
    return misfit(edge.matrix, edge.covariance, truth)


@cache
def one_image_a_stop():
    return calibrate(of_one_camera(1, stops=True)[1])


@pytest.mark.parametrize(("stops", "trembling_m"), [slow(True, 2e-6), (False, 1e-5)])
def test_images_of_a_stop_share_the_robots_error(stops, trembling_m):
    cell, session = of_one_camera(6, stops=stops, trembling_m=trembling_m)
    found = calibrate(session)
    once = one_image_a_stop()
    edge, name = found.edges["flange_from_cam"], "flange_from_cam"
    # Six independent views for each would give 0.41; corners alone get better.
    assert 0.55 < edge.sigma_mm / once.edges[name].sigma_mm < 1.05
    assert found.verdict.status == "good", found.verdict.reasons
    # Chi-square of six exceeds this in one case of a thousand.
    assert misfit(edge.matrix, edge.covariance, cell.transforms[name]) < 22.5


def test_pictures_that_were_stored_anew_are_copies():
    _, session = of_one_camera(1, stops=True)
    shown = session.corner_table
    pairs = shown.views < 6
    # Views 6 to 11 are the pictures of views 0 to 5 at their poses, stored by another program.
    px = shown.px.copy()
    again = replace(
        shown,
        views=np.concatenate([shown.views[pairs], shown.views[pairs] + 6]),
        points=np.tile(shown.points[pairs], 2),
        px=np.concatenate([px[pairs], px[pairs] + 2e-3]),
        targets=("",) * (2 * int(pairs.sum())),
    )
    views = tuple(
        replace(view, numbers=session.views[at % 6].numbers)
        for at, view in enumerate(session.views)
    )
    found = calibrate(replace(session, views=views, corner_table=again))
    (finding,) = (one for one in found.verdict.findings if one.kind == "repeated_views")
    assert finding.views == tuple(range(6, 12))
    assert finding.words.startswith("Views 6 to 11 repeat 0 to 5: ")


def test_a_film_of_a_few_stops_is_so_many_views():
    _, session = of_one_camera(8, stops=True)
    shown = session.corner_table
    # The arm was still moving when the fourth image was taken.
    px = shown.px + 3.0 * (shown.views == 3)[:, None]
    found = calibrate(replace(session, corner_table=replace(shown, px=px)))
    kept = {view.view for view in found.views if view.used or "mean" not in view.reason}
    assert kept == {8 * stop for stop in range(12)} | {3}
    assert found.views[1].reason == "counts in the mean of view 0, of its stop"


@pytest.mark.slow
def test_still_boards_seen_often_outvote_no_robot():
    """Most rows are of still cameras and a still board, and agree best of all."""
    seed, images = 2, 3
    cell, session = of_a_cell(images, stops=True, seed=seed)
    found, once = calibrate(session), calibrate(of_a_cell(1, stops=True, seed=seed)[1])
    assert sum(not view.used for view in found.views) <= 0.01 * len(found.views)
    for name, edge in found.edges.items():
        assert edge.sigma_mm > 0.6 * once.edges[name].sigma_mm, name
        assert off(cell, found, name) < 22.5, name


@pytest.mark.slow
def test_rows_of_a_cell_in_which_the_robot_stands_still_are_of_one_stop():
    _, session = of_a_cell(3, stops=True, seed=1)
    _, unnamed = of_a_cell(3, stops=False, seed=1)
    stations = [observation.station for observation in session.observations]
    assert len(set(stations)) == 14
    # Without stops, rows that tell no robot's pose stand alone.
    told = [observation.station for observation in unnamed.observations if observation.robots]
    assert len(set(told)) == 14
    named, other = calibrate(session), calibrate(unnamed)
    for name, edge in named.edges.items():
        assert other.edges[name].sigma_mm == pytest.approx(edge.sigma_mm, rel=1e-3), name


@pytest.mark.parametrize("seed", [0, slow(3)])
def test_a_lens_is_not_moved_by_what_repeated_views_have_wrong_alike(seed):
    """The bias is within the noise of one view, and clear in fourteen that count as one."""
    cell, session = of_a_cell(1, stops=True, seed=seed, bias_px=SIGMA_PX)
    found = calibrate(session)
    for name in found.edges:
        assert off(cell, found, name) < 22.5, name


KINDS = {
    "poses": lambda: cell_session(simulate(CellOptions(views=12)), "cell", seen="poses"),
    "corners": lambda: cell_session(
        simulate(CellOptions(views=12, seed=3)), "cell", seen="corners"
    ),
    "readings": lambda: session_of(tracked(InstrumentOptions(stops=24, seed=18, points=THREE))),
}


@pytest.mark.parametrize(
    ("kind", "jitter_m", "interleaved"),
    [("poses", 1e-4, False), ("corners", 0.0, True), slow("readings", 1e-4, True)],
)
def test_copies_of_rows_change_nothing(kind, jitter_m, interleaved):
    session = KINDS[kind]()
    before = calibrate(session)
    more = copied(session, 2, jitter_m, interleaved=interleaved)
    after = calibrate(more)
    assert before.edges.keys() == after.edges.keys()
    for name, edge in before.edges.items():
        assert np.array_equal(after.edges[name].covariance, edge.covariance)
    assert sum(view.used for view in after.views) == sum(view.used for view in before.views)
    # Readings that differ are named without a doubt: an instrument is read several times a stop.
    is_of_corners = session.corner_table is not None or any(view.image for view in session.views)
    kind = "repeated_readings" if jitter_m and not is_of_corners else "repeated_views"
    (found,) = (finding for finding in after.verdict.findings if finding.kind == kind)
    originals = {view.number for view in session.views}
    assert originals.isdisjoint(found.views)
    assert originals.union(found.views) >= {view.view for view in after.views}


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
def test_near_readings_are_copies_where_no_time_tells_them_apart(rows, repeated):
    assert repeated_rows(measured(rows), {}) == repeated
