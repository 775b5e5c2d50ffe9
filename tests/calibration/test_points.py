"""Points from elsewhere: corners that another detector found, rigs of known points and tags."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation
from support.boards import any_page, printed
from support.commands import visioncal
from support.edited import changed
from support.marks import slow
from support.misfits import misfit
from support.refusals import raised
from support.rendered import line_kernel

from visioncal import calibrate, doctor
from visioncal.calibration.run import run
from visioncal.calibration.stages.detect import detect
from visioncal.core.errors import DataError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Target
from visioncal.interchange.formats import load_for_rereading
from visioncal.present.recording import write_recording
from visioncal.results import to_document
from visioncal.session import Session, corners
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    prepare_scene,
    project,
    render,
    simulate,
)
from visioncal.simulation.render import developed, encode, light_on
from visioncal.vision.boards import NotFound, find_target
from visioncal.vision.detection import find_corners
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    read_target,
    target_document,
    target_from_document,
)

IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
NOISE_PX = 0.2
CHARUCO = replace(BOARDS["charuco"], square_sigma_m=1e-7)
CHECKERS = replace(BOARDS["checkerboard"], square_sigma_m=1e-7)
TAGS = BOARDS["tags"]


def cube() -> Target:
    """A rig of points on three faces of a cube of 160 mm, whose corner points at the camera."""
    steps = np.linspace(-0.08, 0.08, 4)
    faces = [[a, b, -0.08] for a in steps for b in steps]
    faces += [[a, -0.08, b] for a in steps for b in steps[1:]]
    faces += [[-0.08, a, b] for a in steps[1:] for b in steps[1:]]
    turn, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [[-1.0, -1.0, -1.0]])
    # In the middle of the board that the simulated camera looks at.
    points = tuple(map(tuple, (turn.apply(faces) + np.array([0.135, 0.09, 0.0])).tolist()))
    numbers = tuple(range(700, 700 - 3 * len(points), -3))
    return Target(
        "cube", "points", len(points), 1, 0.3, 0.0, points_m=points, point_numbers=numbers
    )


CUBE = cube()


def seen(target=CUBE, mount=IN_HAND, seed=0, views=15, stated=None, uneven=1.0, joints=False):
    """A cell, and the session of a target's corners in it: every other one errs `uneven` times.

    Its sigma_px is `stated` times the truth, and not stated where that is None.
    """
    rng, points = np.random.default_rng(seed), corner_positions(target)
    board = CHARUCO if target.is_rig else target
    cell = simulate(CellOptions(mount=mount, views=views, seed=seed, target=board))
    numbers = np.array(target.point_numbers or range(len(points)))
    sigmas = NOISE_PX * np.where(np.arange(len(points)) % 2, uneven, 1.0)
    found, lens = [], cell.options.camera
    for pose in cell.cam_from_target:
        px = project(lens, points @ pose[:3, :3].T + pose[:3, 3])
        px += sigmas[:, None] * rng.standard_normal(px.shape)
        inside = np.flatnonzero(np.all((px > 0) & (px < lens.resolution), axis=1))
        found.append((inside, px[inside]))
    robot = {"robot": cell.options.robot, "q": cell.robot.joints} if joints else {}
    session = Session.from_corners(
        [(numbers[inside], px) for inside, px in found],
        cell.robot.base_from_flange,
        target,
        lens.resolution,
        mount=mount,
        camera=lens,
        **robot,
    )
    held = {**session.document["camera"], "intrinsics": "hold"}
    session = replace(session, document={**session.document, "camera": held})
    if stated is not None:
        known = stated * np.concatenate([sigmas[inside] for inside, _ in found])
        session = replace(session, corner_table=replace(session.corner_table, sigmas_px=known))
    return cell, session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The session of the cube."""
    seen()[1].save(tmp_path / "cell")
    return tmp_path / "cell"


def rewrite(folder: Path, name: str, change) -> Path:
    """Changes a table of a folder: its rows as lists of texts, the header the first of them."""
    rows = [line.split(",") for line in (folder / name).read_text().splitlines()]
    (folder / name).write_text("\n".join(map(",".join, change(rows) or rows)) + "\n")
    return folder


def error_of(cell, calibration) -> float:
    """The square of the camera's error in sigmas."""
    name, edge = next(iter(calibration.edges.items()))
    return misfit(edge, cell.transforms[name])


def test_points_that_are_not_where_the_table_has_them_are_named():
    rng, loose = np.random.default_rng(0), 1e-4
    _, session = seen()
    table = np.array(CUBE.points_m) + loose * rng.normal(size=(len(CUBE.points_m), 3))
    table[4, 0] += 1e-3
    rig = replace(
        CUBE, points_m=tuple(map(tuple, table.tolist())), point_sigmas_m=(loose,) * len(table)
    )
    result = calibrate(replace(session, target=rig))
    assert result.verdict.status == "check"
    (sentence,) = (reason for reason in result.verdict.reasons if "table has it" in reason)
    assert sentence.startswith(f"Point {CUBE.point_numbers[4]} of target cube lies 0.")
    # The views have it where it is, to some tenths of a millimetre.
    away_m = CUBE.points_m[4][0] - table[4, 0]
    assert result.rig.shape[4][0] == pytest.approx(away_m, abs=3e-4)


def test_exchanged_points_of_an_exact_rig_are_left_out():
    cell, session = seen()
    places = [*CUBE.points_m]
    places[3], places[-3] = places[-3], places[3]
    result = calibrate(replace(session, target=replace(CUBE, points_m=tuple(places))))
    # What is left determines the camera as well as it says: 40 is what chance leaves of six
    # numbers in less than one of a hundred thousand cases, with a noise known to 20 %.
    assert error_of(cell, result) < 40.0


@pytest.mark.slow
def test_a_rig_that_is_larger_than_its_table_is_named_with_its_size():
    """Views alone do not tell: a larger rig farther away looks the same, and so do longer links."""
    _, session = seen(mount=TO_HAND, views=20, joints=True)

    def sized(by):
        points = tuple(map(tuple, (by * np.array(CUBE.points_m)).tolist()))
        return calibrate(replace(session, target=replace(CUBE, points_m=points))).verdict

    (found,) = (cause for cause in sized(1.0 / 1.01).causes if cause.kind == "board_size")
    (advised,) = re.findall(r"--board-scale ([0-9.]+)", found.do.command)
    # The sentence has a sigma of 0.1 %, by residuals that are the size's own doing.
    assert float(advised) == pytest.approx(1.01, abs=3e-3)
    mended = sized(float(advised) / 1.01)
    assert not any(finding.kind == "board_size" for finding in mended.findings)


@pytest.mark.slow
def test_sigmas_weigh_the_corners_and_the_camera_is_within_its_sigma():
    squares, variances = 0.0, {None: 0.0, 1.0: 0.0}
    for seed in range(2):
        for stated in variances:
            cell, session = seen(CHARUCO, seed=seed, uneven=5.0, stated=stated)
            found = calibrate(session)
            variances[stated] += np.trace(next(iter(found.edges.values())).covariance)
            squares += error_of(cell, found)
        cell, session = seen(mount=(IN_HAND, TO_HAND)[seed], seed=seed)
        squares += error_of(cell, calibrate(session))
    # Half of the corners are five times as good as the rest: alone, they have a 13th of the mean
    # variance at half the number; the robot's noise is common to both.
    assert variances[1.0] < 0.6 * variances[None]
    low, high = chi2_limit(np.array([0.9995, 0.0005]), 36)
    # The robot's noise is known to 10 % from so few stops, and its square to 20 %.
    assert low / 1.2 < squares < 1.2 * high


@pytest.mark.slow
def test_views_that_do_not_serve_are_left_out_by_name_and_images_are_not_searched(folder):
    row, outside = [str(number) for number in CUBE.point_numbers[:4]], []

    def spoil(rows):
        """View 1 has three points, view 2 none, view 3 four of a row, view 4 one far outside."""
        of = {view: [line for line in rows if line[0] == str(view)] for view in range(5)}
        of[4][0][3] = "4000.0"
        in_row = [line for line in of[3] if line[1] in row]
        rest = [line for line in rows if line[0] not in ("1", "2", "3", "4")]
        outside.extend(of[4][0])
        return [*rest, *of[1][:3], *in_row, *of[4]]

    def with_images(rows):
        for at, line in enumerate(rows):
            line.append({0: "image", 1: "broken.png", 3: "a.png"}.get(at, ""))

    rewrite(rewrite(folder, "corners.csv", spoil), "views.csv", with_images)
    (folder / "broken.png").write_bytes(b"no image")
    cv2.imwrite(str(folder / "a.png"), np.full((800, 1280), 200, dtype=np.uint8))
    result = calibrate(folder)
    reasons = {view.view: view.reason for view in result.views if not view.used}
    assert reasons.keys() == {1, 2, 3, 4}
    assert "3 of 37, needs 4" in reasons[1]
    # A rig is not looked for in images.
    assert "rig of points, which no image is searched for" in reasons[2]
    assert "on one line" in reasons[3]
    _, point, u_px, _ = outside
    assert f"point {point} at ({float(u_px):g}, 4000) px lies far outside" in reasons[4]
    # An image with corners is not searched.
    assert result.views[0].corners == len(CUBE.points_m)


def test_a_table_of_corners_that_was_cut_off_is_named(folder):
    lost = range(10, 15)
    rewrite(
        folder, "corners.csv", lambda rows: [row for row in rows if row[0] not in map(str, lost)]
    )
    most = calibrate(folder)
    assert most.verdict.status == "check"
    (found,) = (found for found in most.verdict.findings if found.kind == "lost_views")
    assert found.views == tuple(lost)
    assert found.words.startswith("5 of 15 rows of views.csv have neither an image nor rows in")
    assert "it has neither image nor rows in corners.csv" in most.views[10].reason
    assert doctor(folder).findings[0].kind == "lost_views"


def test_numbers_that_do_not_lie_as_drawn_are_refused_or_left_out_by_name():
    for target, columns, rows in ((CHARUCO, 6, 9), (CHECKERS, 8, 7)):
        session = replace(seen(target)[1], target=replace(target, columns=columns, rows=rows))
        stated = f"columns = {target.columns} and rows = {target.rows}"
        caught = raised(DataError, f"lie as on a board with {stated}, and ", detect, session)
        assert f"Write {stated} in the board's .toml" in caught.next_step
    _, session = seen(CHARUCO)
    table = session.corner_table
    shuffled = table.points % 5 * 8 + table.points // 5
    by_column = table.points % 8 * 5 + table.points // 8
    for points, advice in (
        (shuffled, "Compare columns, rows and the order"),
        (by_column, "Number them row by row"),
    ):
        everywhere = replace(session, corner_table=replace(table, points=points))
        caught = raised(DataError, "do not lie as its drawing numbers them", detect, everywhere)
        assert advice in caught.next_step
    points = np.where(table.views == 2, shuffled, table.points)
    (rejection,) = detect(replace(session, corner_table=replace(table, points=points))).rejections
    assert rejection.view == 2
    assert "do not lie as the target's drawing numbers them" in rejection.reason


@pytest.mark.parametrize("kind", ["aprilgrid", "gridboard"])
def test_tags_of_another_spacing_are_named(kind):
    """Of 32 mm, 9.6 mm apart: 0.3 of a side, where 0.28 is stated, and 1.9 % in a scale."""
    described = {"kind": kind, "columns": 6, "rows": 4, "size_m": 0.032, "spacing": 0.3}
    target = target_from_document({**described, "dictionary": "DICT_APRILTAG_36h11"}, "tags")
    session = seen(target)[1]
    detect(session)
    for spacing in (0.28, 0.32):
        other = replace(session, target=replace(target, spacing=spacing))
        caught = raised(
            DataError, f"spacing = 0.3, and tags has spacing = {spacing}", detect, other
        )
        assert "Write spacing = 0.3" in caught.next_step


@pytest.mark.slow
def test_one_image_of_two_targets_is_two_views_and_rows_name_their_targets(tmp_path):
    """A board, and the same board's corners as a rig of another size beside it, in one row."""
    aside = exp(np.array([0.0, 0.0, 0.5, 0.05, 0.02, 0.03]))
    points = corner_positions(CHARUCO) @ aside[:3, :3].T + aside[:3, 3]
    rig = replace(
        CUBE,
        name="both",
        points_m=tuple(map(tuple, np.vstack([corner_positions(CHARUCO), points]).tolist())),
        point_numbers=tuple(range(80)),
    )
    seen(rig)[1].save(tmp_path / "cell")
    folder = tmp_path / "cell"
    (folder / "board.toml").write_text(tomli_w.dumps(target_document(CHARUCO)))
    text = (folder / "session.toml").read_text().replace('target = "target.toml"\n', "")
    (folder / "session.toml").write_text(
        f'{text}\n[targets]\nboard = "board.toml"\nsame = "board.toml"\n'
    )

    def named(rows):
        rows[0].append("target")
        for row in rows[1:]:
            at = int(row[1])
            row[1] = str(at % 40)
            row.append("board" if at < 40 else "same")
        return [row for row in rows if row[0] != "4" or row[-1] != "board"]

    session = Session.load(rewrite(folder, "corners.csv", named))
    # Fifteen images show one board, and fourteen of them the other, too.
    assert len(session.views) == 29
    result = calibrate(session)
    assert all(view.used for view in result.views)
    one, other = (result.edges[f"base_from_target_{name}"] for name in ("board", "same"))
    between = log(invert(one.matrix) @ other.matrix @ invert(aside))
    # Four standard deviations of both places, as if they were independent.
    sigmas = np.sqrt(np.diag(one.covariance + other.covariance))
    assert np.all(np.abs(between[3:]) < 4.0 * np.linalg.norm(sigmas[3:]))
    session.save(tmp_path / "copy")
    assert Session.load(tmp_path / "copy").digest() == session.digest()
    words = "'wall', but must be one of board, same"
    changed(folder, "corners.csv", ",board\n", ",wall\n")
    raised(DataError, words, Session.load, folder)
    changed(folder, "corners.csv", ",wall\n", ",board\n")
    rewrite(
        folder,
        "views.csv",
        lambda rows: [
            [name, *row] for row, name in zip(rows, ["target", *["same"] * 99], strict=False)
        ],
    )
    raised(DataError, r"views\.csv says that view 0 shows 'same'", Session.load, folder)


def test_a_board_in_millimetres_is_read_in_millimetres(tmp_path):
    seen(CHARUCO)[1].save(tmp_path / "cell")
    changed(tmp_path / "cell", "target.toml", "square_m = 0.03", "square_m = 30.0")
    changed(tmp_path / "cell", "target.toml", "square_sigma_m = 1e-07", "")
    changed(tmp_path / "cell", "target.toml", "marker_m = 0.022", "marker_m = 22.0")
    read = load_for_rereading(tmp_path / "cell").session
    # The unit's own rounding.
    assert read.target.square_m == pytest.approx(CHARUCO.square_m, rel=1e-12)
    assert read.target.marker_m == pytest.approx(CHARUCO.marker_m, rel=1e-12)
    assert read.warnings[0].endswith("30 is read as 30 mm.")


@pytest.mark.parametrize(
    ("target", "mount", "words"),
    [
        (CHECKERS, TO_HAND, "numbers the corners of the board as if it was"),
        slow(load_target("aruco_4x4_50_id0_120mm"), IN_HAND, "counterclockwise"),
    ],
    ids=["bottom up", "marker"],
)
def test_numbers_that_turn_the_board_over_are_named(target, mount, words):
    cell, session = seen(target, mount)
    table = session.corner_table
    points = 3 - table.points
    if target is CHECKERS:
        points = target.columns * (target.rows - 1 - table.points // 9) + table.points % 9
    session = replace(session, corner_table=replace(table, points=points))
    found = calibrate(session)
    assert [finding.kind for finding in doctor(session).findings] == ["corner_numbers"]
    cause = found.verdict.causes[0]
    assert cause.kind == "corner_numbers"
    assert words in cause.words
    if target is CHECKERS:
        assert found.verdict.status == "check"
        assert "row by row from corner 0" in str(cause.do)
        # The board's z axis points at the camera, and the camera is where it is.
        camera, board = cell.transforms
        assert found.edges[board].matrix[:3, 2] @ cell.transforms[board][:3, 2] < -0.99
        away = found.edges[camera].matrix - cell.transforms[camera]
        assert np.linalg.norm(away[:3, 3]) < 1e-3


def errors_px(found, truth):
    """The errors of corners that were found, of more than twenty of them."""
    common, ours, theirs = np.intersect1d(found.ids, truth.ids, return_indices=True)
    assert len(common) > 20
    return found.px[ours] - truth.px[theirs]


@pytest.mark.slow
def test_tags_are_found_to_a_hundredth_of_a_pixel():
    cell = simulate(CellOptions(target=TAGS, views=3, seed=2))
    truth, image = cell.exact_corners[0], render(prepare_scene(cell), 0)
    error = errors_px(find_target(image, TAGS), truth)
    # OpenCV's own corners are off by 0.1 px, and maps made once, from those, leave 0.010 px.
    assert np.sqrt(np.mean(error**2)) < 0.009
    assert np.abs(error.mean(axis=0)).max() < 0.005
    # Out of one plane they are found one by one.
    lifted = tuple((x, y, 0.01 * (at // 4)) for at, (x, y, _) in enumerate(TAGS.points_m))
    error = errors_px(find_target(image, replace(TAGS, points_m=lifted)), truth)
    assert np.sqrt(np.mean(error**2)) < 0.06
    # One tag will do for a view.
    names = ("points_m", "point_numbers", "point_tags")
    first = {name: getattr(TAGS, name)[:4] for name in names}
    found, _ = find_corners(image, replace(TAGS, columns=4, **first), 0)
    assert found.ids.tolist() == [0, 1, 2, 3]
    # Another page is named.
    moved = tuple((x + 0.2 * (at < 4), y, z) for at, (x, y, z) in enumerate(TAGS.points_m))
    lost = find_target(image, replace(TAGS, points_m=moved))
    assert "do not lie as the target describes" in lost.reason
    others = tuple((tag + 200, corner) for tag, corner in TAGS.point_tags)
    lost = find_target(image, replace(TAGS, point_tags=others))
    assert isinstance(lost, NotFound)
    assert lost.misfit
    assert "no tag of the target's, of DICT_APRILTAG_36h11, is seen; seen instead:" in lost.reason


def test_corners_outside_the_stated_image_are_refused(folder):
    changed(folder, "session.toml", "    1280,\n    800,\n", "640, 400")
    refused = raised(DataError, "lie outside the image of", calibrate, folder)
    assert "Correct resolution" in refused.next_step
    (found,) = (item for item in doctor(folder).findings if item.words == refused.message)
    assert found.do.words == refused.next_step
    text = (folder / "session.toml").read_text().partition("[camera]")[0]
    (folder / "session.toml").write_text(f"{text}[camera]\n")
    raised(DataError, "the camera's resolution is missing, and none of 0", calibrate, folder)
    (folder / "session.toml").write_text(text)
    raised(DataError, "camera is missing, but view 0 has rows in corners", calibrate, folder)


@pytest.mark.slow
def test_dense_corners_bring_in_refused_views_and_leave_sharp_ones_alone():
    # The board moves by centimetres, and the robot's poses are those of the middle.
    # A quarter of the pixels.
    lens = replace(CAMERAS["wide"], resolution=(640, 400), matrix=CAMERAS["wide"].matrix / 2)
    cell = simulate(CellOptions(views=8, seed=3, blur_px=0.5, target=CHECKERS, camera=lens))
    scene, images = prepare_scene(cell), []
    for at, pose in enumerate(cell.cam_from_target):
        light, along = light_on(scene, pose), np.array([np.cos(at), np.sin(at)])
        # Five sharp images; the others are smeared by 18 px, most of a square.
        if at >= 5:
            light = cv2.filter2D(light, -1, line_kernel(9.0 * along), borderType=cv2.BORDER_REFLECT)
        images.append(encode(developed(light, cell.options, np.random.default_rng(at)), None))
    session = Session.from_arrays(
        images, cell.robot.base_from_flange, CHECKERS, camera=cell.options.camera
    )
    stated = replace(session, document={**session.document, "clock": {"camera_minus_robot_s": 0.0}})
    plain, unsure = (run(session, dense=dense).calibration for dense in (False, True))
    dense = run(stated, dense=True).calibration
    used = [{view.view for view in found.views if view.used} for found in (plain, unsure, dense)]
    assert used == [set(range(5)), set(range(5)), set(range(8))]
    assert "it serves the lens alone" in unsure.views[6].reason
    assert any("write [clock] into session.toml" in reason for reason in unsure.verdict.reasons)
    edge, known = (found.edges["flange_from_cam"] for found in (dense, plain))
    # Beyond 16.8 is a chi-square of six degrees of freedom in 1 % of sessions.
    assert error_of(cell, dense) < 16.8
    assert np.trace(edge.covariance[3:, 3:]) < np.trace(known.covariance[3:, 3:])
    assert any("--dense" in reason for reason in dense.verdict.reasons)
    found = run(session.only(range(5)), dense=True).calibration.edges["flange_from_cam"]
    np.testing.assert_array_equal(found.matrix, known.matrix)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "status", "said", "level"),
    [(1.1, "good", "", 1.1 * NOISE_PX), (0.4, "check", "corners.csv states 0.08 px", NOISE_PX)],
)
def test_the_verdict_says_where_the_corners_contradict_what_is_stated(stated, status, said, level):
    result = calibrate(seen(CHARUCO, stated=stated)[1])
    assert result.verdict.status == status
    sentences = " ".join(result.verdict.reasons)
    assert said in sentences
    assert ("states" in sentences) is bool(said)
    assert "Corners deviate by" not in sentences
    # The scatter of 1200 coordinates shows the noise to 2 %.
    assert result.noise["pixel_px"] == pytest.approx(level, rel=0.06)


@pytest.mark.slow
def test_every_stored_form_is_the_same_session(tmp_path):
    seen(stated=1.0)[1].save(tmp_path / "cell")
    session = Session.load(tmp_path / "cell")
    write_recording(tmp_path / "cell.rrd", session, None, (), None)
    recorded = Session.load(tmp_path / "cell.rrd")
    recorded.save(tmp_path / "back")
    ours, result = session.corner_table, to_document(calibrate(session))
    for again in (recorded, Session.load(tmp_path / "back")):
        theirs = again.corner_table
        assert again.digest() == session.digest()
        assert again.boards == {"": replace(session.boards[""], name=again.boards[""].name)}
        for name in ("views", "points", "px", "sigmas_px"):
            np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
        assert to_document(calibrate(again)) | {"created": ""} == result | {"created": ""}


def test_commands_take_a_rig_or_say_why_not(folder, tmp_path):
    out = tmp_path / "out"
    visioncal("calibrate", folder, "-o", out).good()
    cell = tmp_path / "fresh"
    rewrite(folder, "views.csv", lambda rows: rows[:7]).rename(cell)
    visioncal("verify", cell, "--against", out).good()
    assert visioncal("locate", cell, "-c", out).out.count("view ") == 6
    fixture = visioncal("fixture", cell, "-c", out, "-o", tmp_path / "fixture.json")
    assert "rig target seen in 6 images" in fixture.said
    visioncal("locate", cell, "-c", out, "--target", "charuco_9x6_30mm").refused(
        "corners of its own target"
    )
    changed(cell, "session.toml", "[camera]", '[robot]\nmodel = "ur10e"\n[camera]')
    visioncal("plan", cell, "--add", 2, "-o", tmp_path / "plan").refused(
        "rig of points outside the plane z = 0"
    )


def test_tags_are_printed_where_the_table_has_them():
    turned = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    points = tuple((*(np.array(point[:2]) @ turned).tolist(), 0.0) for point in TAGS.points_m)
    target = replace(TAGS, points_m=points)
    sheet, page = any_page(target), printed(target, 200)
    seen = find_target(cv2.GaussianBlur(page, (0, 0), 0.7), target)
    assert len(seen.ids) == len(points)
    places_mm = np.array(sheet.origin_mm) + 1e3 * corner_positions(target)[seen.ids, :2]
    # A page in whole pixels is stretched by up to one.
    np.testing.assert_allclose(seen.px, places_mm * 200 / 25.4 - 0.5, atol=1.0)
    lifted = replace(TAGS, points_m=tuple((x, y, x) for x, y, _ in TAGS.points_m))
    raised(DataError, "in one plane z = 0", any_page, lifted)


def with_line(line: str):
    return lambda rows: rows.append(line.split(","))


def with_column(name: str, value: str):
    return lambda rows: [[*rows[0], name], *([*row, value] for row in rows[1:])]


@pytest.mark.parametrize(
    ("table", "change", "said"),
    [
        ("corners", with_line("99,700,10,10"), "column view: views.csv has no view 99"),
        ("corners", with_line("0,5,10,10"), "no point 5; its 37 points have the numbers 592 to 70"),
        ("corners", with_line("0,700,10,10"), "point 700 of view 0 is there twice, first in corne"),
        (
            "corners",
            with_line("0,x,10,10"),
            "corners.csv, line 512, column point: 'x' must be a whole",
        ),
        ("corners", with_line("0,700,nan,10"), "column u_px: 'nan' must be a finite number"),
        ("corners", with_line("0,700,10"), "it has 3 fields, but the header has 4 columns"),
        ("corners", with_column("score", "1"), "others are not read"),
        # Its square overflows.
        ("corners", with_column("sigma_px", "1e150"), "1e+150 px must be the standard deviation"),
        (
            "corners",
            lambda rows: [*with_column("sigma_px", "1")(rows), ["0", "0", "10", "10", ""]],
            "it is empty; all rows state it, or none",
        ),
        # Corners that are counted from 0, of a rig that is not.
        (
            "corners",
            lambda rows: [
                rows[0],
                *([row[0], str(at), *row[2:]] for at, row in enumerate(rows[1:38])),
            ],
            "numbers 592 to 700",
        ),
        ("views", lambda rows: [*rows[:3], ["77", *rows[3][1:]], *rows[4:]], "csv has no view 2"),
    ],
)
def test_tables_of_corners_that_do_not_fit_are_refused(folder, table, change, said):
    rewrite(folder, f"{table}.csv", change)
    with pytest.raises(DataError) as error:
        Session.load(folder)
    assert said.lower() in f"{error.value.message} {error.value.next_step}".lower()
    # One sentence, and not a line for each of hundreds of corners.
    assert "\n" not in error.value.message


PLACED = "point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n"
SURE = "point,x_m,y_m,z_m,sigma_m\n0,0,0,0,{}\n1,1,0,0,1\n2,0,1,0,1\n3,0,1,1,{}\n"
TAGGED = "point,x_m,y_m,z_m{}\n0,0,0,0{}\n1,.1,0,0{}\n2,.1,.1,0{}\n3,0,.1,0{}\n"


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (PLACED, "has 3 points"),
        (f"{PLACED}2,0,1,1\n", "has 2 again as point of row 4"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,99,0,0\n2,0,99,0\n3,0,0,80\n", "looks like millimetres"),
        (f"{PLACED}3,0,b,1\n", "line 5, column y_m: 'b'"),
        ("point,x_m,y_m\n0,0,0\n1,1,0\n2,0,1\n3,0,1\n", "point, x_m, y_m, z_m"),
        (SURE.format(1, 0), "has 0 as sigma_m of row 4"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,2,0,0\n3,5,0,0\n", "all points on one line"),
        ("point,x_m,y_m,z_m\n0,1,0,0\n1,1,0,0\n2,1,0,0\n3,1,0,0\n", "all points in one place"),
        (TAGGED.format(",tag,corner", ",7,0", ",7,1", ",7,2", ",7,4"), "with tag 7, corner 4"),
        (TAGGED.format(",tag,corner", ",7,0", ",7,1", ",7,2", ",7,2"), "corner 2 of tag 7 twice"),
        (TAGGED.format(",tag,corner", *[f",587,{at}" for at in range(4)]), "tags 0 to 586"),
        (TAGGED.format(",corner", *[f",{at}" for at in range(4)]), "a table with corner alone"),
    ],
)
def test_wrong_rigs_are_refused(folder, table, said):
    (folder / "target.points.csv").write_text(table)
    with pytest.raises(DataError) as error:
        load_target("target.toml", folder)
    assert said in str(error.value)


def test_a_rig_is_described_by_its_document(folder):
    target, document = read_target("target.toml", folder)
    assert target_document(target) == document
    assert target_from_document(document, "target") == target
    assert target.point_numbers == CUBE.point_numbers
    # A table says which corner of which tag each point is.
    (folder / "target.points.csv").write_text(
        TAGGED.format(",tag,corner", *[f",7,{at}" for at in range(4)])
    )
    target = load_target("target.toml", folder)
    assert target.point_tags == ((7, 0), (7, 1), (7, 2), (7, 3))
    assert target.dictionary == "DICT_APRILTAG_36h11"
    assert target_from_document(target_document(target), "target") == target


def test_files_lie_beside_what_names_them(folder, tmp_path, monkeypatch):
    (folder / "target.points.csv").rename(tmp_path / "points.csv")
    changed(folder, "target.toml", "target.points.csv", "../points.csv")
    raised(DataError, "leads out of the folder", load_target, "target.toml", folder)
    (folder / "corners.csv").rename(tmp_path / "corners.csv")
    (folder / "corners.csv").symlink_to(tmp_path / "corners.csv")
    raised(DataError, "leads out of its folder", corners.read_corners, folder)
    monkeypatch.setattr(corners, "_MOST_CORNERS", 2)
    text = (tmp_path / "corners.csv").read_text()
    raised(DataError, "more than 2 rows", corners.parse_corners, text)


def test_measurements_count_in_the_digest_and_a_deleted_row_takes_its_corners(folder):
    digest, text = Session.load(folder).digest(), (folder / "corners.csv").read_text()
    rig = (folder / "target.points.csv").read_text()
    for name, whole in (("corners.csv", text), ("target.points.csv", rig)):
        line = whole.split("\n")[1]
        changed(folder, name, line, line.replace(".", ".5"))
        assert Session.load(folder).digest() != digest
        changed(folder, name, line.replace(".", ".5"), line)
    # Spelling counts for nothing.
    (folder / "corners.csv").write_text(text.replace(",", " , "))
    assert Session.load(folder).digest() == digest
    rewrite(folder, "views.csv", lambda rows: rows.pop(3) and None)
    session = Session.load(folder)
    assert len(session.views) == 14
    assert set(session.corner_table.views.tolist()) == {view.number for view in session.views}
