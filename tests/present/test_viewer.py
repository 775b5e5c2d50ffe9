"""What a recording shows: layout, cell, charts, arms, tools and fixtures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from scipy.spatial.transform import RigidTransform, Rotation
from support.aligned_cells import cell_result
from support.arm_documents import calibrated
from support.drawn import column
from support.findings import with_findings
from support.samples import BASE_FROM_FIXTURE, FLANGE_FROM_TOOL, made_up, with_frames

from visioncal.calibration.run import Run
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.interchange.outputs import write_outputs
from visioncal.present import coverage
from visioncal.present.recording import (
    arm,
    board,
    paths,
    read_calibration,
    read_session,
    write_recording,
)
from visioncal.present.recording.scene import Scene
from visioncal.present.report import plots
from visioncal.present.viewer import blueprint
from visioncal.results import Edge, ViewResult, to_document
from visioncal.results.evidence import ViewEvidence
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, cell_session, simulate
from visioncal.vision.boards import find_target
from visioncal.vision.targets import corner_positions, outline, target_from_document

pytestmark = pytest.mark.usefixtures("strict_rerun")


def without_joints(sample):
    session = sample.session
    views = tuple(
        replace(
            view, numbers={key: n for key, n in view.numbers.items() if not key.endswith("_rad")}
        )
        for view in session.views
    )
    columns = tuple(name for name in session.columns if not name.endswith("_rad"))
    return replace(sample, session=replace(session, views=views, columns=columns))


@pytest.fixture(scope="module")
def samples():
    return {
        "images and joints": made_up(),
        "poses alone": made_up(images=False),
        "no joints": without_joints(made_up()),
        "tools and fixtures": with_frames(made_up()),
    }


@pytest.fixture(scope="module")
def recordings(samples, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    files = {}
    for name, sample in samples.items():
        files[name] = folder / f"{name}.rrd"
        layout = blueprint(sample.session, sample.calibration)
        write_recording(files[name], sample.session, sample.calibration, sample.evidence, layout)
    return files


def views_of(container):
    if isinstance(container, rrb.View):
        yield container
        return
    for content in container.contents:
        yield from views_of(content)


@pytest.mark.parametrize(
    "name", ["images and joints", "poses alone", "no joints", "tools and fixtures"]
)
def test_every_panel_shows_something(name, samples, recordings):
    layout = blueprint(samples[name].session, samples[name].calibration)
    logged = {str(chunk.entity_path) for chunk in RrdReader(recordings[name]).stream()}
    for view in views_of(layout.root_container):
        below = f"{view.origin.rstrip('/')}/"
        assert any(f"{entity}/".startswith(below) for entity in logged), view.name


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_placements_are_where_the_views_put_the_target(mount):
    rng = np.random.default_rng(3)
    x, z = exp(0.5 * rng.normal(size=(2, 6)))
    base_from_flange = exp(0.7 * rng.normal(size=(5, 6)))
    moved_m = 1e-3 * rng.normal(size=(5, 3))
    hand = base_from_flange if mount == "eye-in-hand" else invert(base_from_flange)
    shifted = np.array([RigidTransform.from_translation(value).as_matrix() for value in moved_m])
    cam_from_target = invert(hand @ x) @ z @ shifted
    names = {
        "eye-in-hand": ("flange_from_cam", "base_from_target"),
        "eye-to-hand": ("base_from_cam", "flange_from_target"),
    }[mount]
    sample = made_up(views=5)
    calibration = replace(
        sample.calibration,
        mount=mount,
        edges={
            name: Edge(edge, 1e-8 * np.eye(6)) for name, edge in zip(names, (x, z), strict=True)
        },
        views=tuple(replace(view, used=True) for view in sample.calibration.views),
    )
    seen = map(ViewEvidence, range(5), [None] * 5, [None] * 5, base_from_flange, cam_from_target)
    placed = plots.placements(calibration, sample.session, [*seen], ())
    found = [pose[:3, 3] for _, pose in placed]
    # Rounding of poses of about 1 m.
    np.testing.assert_allclose(found, moved_m, atol=1e-12)


@pytest.mark.parametrize(
    "document",
    [
        {"kind": "charuco", "columns": 7, "rows": 5, "square_m": 0.03, "marker_m": 0.022}
        | {"dictionary": "DICT_5X5_100"},
        {"kind": "charuco", "columns": 6, "rows": 8, "square_m": 0.03, "marker_m": 0.022}
        | {"dictionary": "DICT_5X5_100", "legacy": True},
        {"kind": "checkerboard", "columns": 8, "rows": 5, "square_m": 0.02},
        {"kind": "marker", "id": 7, "size_m": 0.1, "dictionary": "DICT_4X4_50"},
    ],
    ids=["charuco", "legacy charuco", "checkerboard", "marker"],
)
def test_the_sheet_shows_the_pattern_in_the_target_s_frame(document):
    target = target_from_document(document, "board")
    picture, margin = board.picture(target), 60
    seen = find_target(
        cv2.copyMakeBorder(picture, *[margin] * 4, cv2.BORDER_CONSTANT, value=255), target
    )
    low, _, high, _ = outline(target)
    px_per_m = picture.shape[1] / (high - low)[0]
    expected = (corner_positions(target)[seen.ids] - low)[:, :2] * px_per_m + margin - 0.5
    assert len(seen.ids) == len(corner_positions(target))
    # Corners of a sharp pattern are found to half a pixel; a square has 48.
    np.testing.assert_allclose(seen.px, expected, atol=0.6)


def test_the_arm_reaches_from_the_base_to_the_flange(tmp_path):
    frames = np.tile(np.eye(4), (4, 1, 1))
    # The third link hangs straight down, the fourth has no length.
    frames[:, :3, 3] = [[0.0, 0.0, 0.4], [0.3, 0.1, 0.5], [0.3, 0.1, 0.2], [0.3, 0.1, 0.2]]
    file = tmp_path / "arm.rrd"
    with rr.RecordingStream("arm") as stream:
        stream.save(file)
        arm.log_arms(stream, [frames], [0])
        stream.disconnect()
    entity = f"{paths.ROBOT}/links"
    starts = np.array(column(file, entity, "Capsules3D:translations")[0])
    lengths = np.array(column(file, entity, "Capsules3D:lengths")[0])
    turns = Rotation.from_quat(column(file, entity, "Capsules3D:quaternions")[0])
    ends = starts + turns.apply(np.outer(lengths, [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(starts[0], 0.0)
    # Single precision of lengths under 1 m.
    np.testing.assert_allclose(ends, frames[:, :3, 3], atol=1e-6)


def test_directions_lie_on_the_side_that_the_camera_is_on():
    # 0.5 m above the board, moved 30 degrees towards the target's x and looking back at it.
    tilt = Rotation.from_euler("y", -30, degrees=True)
    target_from_cam = RigidTransform.from_components(tilt.apply([0.0, 0.0, -0.5]), tilt)
    assert target_from_cam.translation[0] > 0.2
    seen = ViewEvidence(4, cam_from_target=target_from_cam.inv().as_matrix())
    chart = coverage.directions_chart([seen])
    np.testing.assert_allclose(chart.points[4], [[30.0, 0.0]], atol=1e-9)


def test_axes_of_rotation_and_their_reverse_are_one_point():
    turns_deg = [[0, 0, 0], [20, 0, 0], [0, 0, 0], [0, 0, -50]]
    poses = exp(np.pad(np.deg2rad(turns_deg), ((0, 0), (0, 3))))
    seen = [ViewEvidence(view, base_from_flange=pose) for view, pose in enumerate(poses)]
    points = coverage.rotation_axes_chart(seen).points
    np.testing.assert_allclose(np.abs(points[1]), [[90.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(np.abs(points[2]), [[90.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(points[3], [[0.0, 0.0]], atol=1e-9)


def test_the_arm_is_drawn_as_calibrated(samples, tmp_path):
    path, sample = tmp_path / "recording.rrd", samples["images and joints"]
    calibration = with_findings(sample, {"kinematics": calibrated()})
    write_recording(path, sample.session, calibration, sample.evidence, None)
    q = sample.session.views[4].joints_rad
    ours = calibration.calibrated_robot.link_frames(q[None])[0, :, :3, 3]
    drawn = column(path, f"{paths.ROBOT}/links", "Capsules3D:translations")[4]
    np.testing.assert_allclose(drawn, [np.zeros(3), *ours[:-1]], atol=1e-6)


@pytest.mark.parametrize(
    ("child", "parent", "expected"),
    [("tool", "flange", FLANGE_FROM_TOOL), ("fixture", "base", BASE_FROM_FIXTURE)],
)
def test_frames_hang_where_they_belong(recordings, child, parent, expected):
    framed_file = recordings["tools and fixtures"]
    entity = f"{paths.FRAMES}/{child}"
    assert column(framed_file, entity, "Transform3D:parent_frame")[0].tolist() == [parent]
    assert column(framed_file, entity, "Transform3D:child_frame")[0].tolist() == [child]
    place_m = column(framed_file, entity, "Transform3D:translation")[0][0]
    # Columns first, as rerun keeps matrices.
    turn = column(framed_file, entity, "Transform3D:mat3x3")[0][0].reshape(3, 3).T
    # Single precision of lengths under 1 m.
    np.testing.assert_allclose(place_m, expected.translation, atol=1e-6)
    np.testing.assert_allclose(turn, expected.rotation.as_matrix(), atol=1e-6)
    assert column(framed_file, entity, "CoordinateFrame:frame")[0].tolist() == [child]


OPTIONS = NetworkOptions(
    cameras=(CameraAt("top"), CameraAt("hand", "a")),
    boards=(BoardAt("plate", "b"), BoardAt("floor")),
    stops=4,
)


@pytest.fixture(scope="module")
def cell():
    return simulate(OPTIONS)


@pytest.fixture(scope="module")
def session(cell):
    return cell_session(cell, "cell", seen="poses")


def true_result(cell, session):
    """What calibrating a simulated cell would give, were it exact."""
    origin = invert(cell.mountings["base_a"])
    edges = {
        f"{cell.parents[name]}_from_{name}": Edge(
            origin @ transform if cell.parents[name] == "cell" else transform, 1e-8 * np.eye(6)
        )
        for name, transform in cell.mountings.items()
        if name != "base_a"
    }
    views = tuple(
        ViewResult(
            observation.view.number,
            observation.view.number % 5 > 0,
            residual_mm=0.1,
            seer=observation.seer,
            seen=observation.seen,
            stop=observation.station,
        )
        for observation in session.observations
    )
    found = cell_result(edges, 1e-8 * np.eye(6 * len(edges)), views, tree=session.frames)
    return replace(found, session_name=session.name, session_sha256=session.digest())


def test_frames_are_drawn_where_they_were(cell, session):
    scene = Scene.of(session, true_result(cell, session), {})
    for observation in session.observations:
        seer = scene.in_cell(observation.seer, observation.view.number)
        seen = scene.in_cell(observation.seen, observation.view.number)
        mm, _ = pose_difference(invert(seer) @ seen, observation.view.cam_from_target().as_matrix())
        # The pose of a small board as it was measured is off by a few millimetres along the sight.
        assert mm < 6.0
    assert scene.in_cell("cam_nowhere", 0) is None


def test_session_and_result_come_back_from_the_recording(cell, session, tmp_path):
    found = true_result(cell, session)
    files = write_outputs(tmp_path / "out", session, Run(found, ())).files
    assert [file.name for file in files] == ["calibration.json", "report.html", "recording.rrd"]
    recording = tmp_path / "out" / "recording.rrd"
    assert read_session(recording).digest() == session.digest()
    assert to_document(read_calibration(recording)) == to_document(found)
    drawn = {chunk.entity_path for chunk in RrdReader(recording).stream()}
    for entity in ("/cameras/top", "/targets/plate/sheet", "/robots/b/links", "/network"):
        assert entity in drawn
