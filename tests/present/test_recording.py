"""Recordings: the session in them to the last bit, what they show, and what damage costs."""

import datetime
import os
import random
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

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
from support.kept import assert_same, assert_same_evidence
from support.marks import slow
from support.refusals import raised
from support.samples import BASE_FROM_FIXTURE, FLANGE_FROM_TOOL, made_up, with_frames

from visioncal.calibration.run import Run
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.interchange.outputs import write_outputs
from visioncal.present import coverage
from visioncal.present.recording import (
    arm,
    board,
    codec,
    paths,
    read_calibration,
    read_evidence,
    write_recording,
)
from visioncal.present.recording.overlays import Overlay
from visioncal.present.recording.scene import Scene
from visioncal.present.recording.stored import chunks
from visioncal.present.report import plots
from visioncal.present.viewer import blueprint
from visioncal.results import Edge, ViewResult, to_document
from visioncal.results.evidence import ViewEvidence
from visioncal.session import MemoryImages, Session
from visioncal.session.corners import parse_corners
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, cell_session, simulate
from visioncal.vision.boards import find_target
from visioncal.vision.targets import corner_positions, outline, target_from_document

pytestmark = pytest.mark.usefixtures("strict_rerun")

DATA = Path(__file__).parents[3] / "shared" / "data" / "sessions"


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def recorded(sample, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(
        path, sample.session, sample.calibration, sample.evidence, blueprint(sample.session)
    )
    return path


def write_session(path, session):
    write_recording(path, session, None, (), None)
    return path


def test_recording_gives_the_session_back(sample, recorded):
    assert_same(sample.session, Session.load(recorded))


def test_results_come_back_exactly(sample, tmp_path):
    path = tmp_path / "recording.rrd"
    # In another order than the views': the report goes by it.
    evidence = sample.evidence[::-1]
    write_recording(path, sample.session, sample.calibration, evidence, None)
    calibration = read_calibration(path)
    assert calibration is not None
    assert to_document(calibration) == to_document(sample.calibration)
    assert_same_evidence(evidence, read_evidence(path))
    write_session(path, sample.session)
    assert read_calibration(path) is None
    assert read_evidence(path) == ()


@pytest.mark.parametrize("name", ["ric_charuco_eye_to_hand", "visp_franka_eye_in_hand"])
def test_real_session_round_trip(name, tmp_path):
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip("the shared sessions are not beside this checkout")
    session = Session.load(folder)
    assert_same(session, Session.load(write_session(tmp_path / "real.rrd", session)))


def test_odd_facts_survive(tmp_path):
    document = {
        "schema": 1,
        "name": 'Prüf\n\t"1" \N{ROBOT FACE}',
        "mount": "eye-in-hand",
        "extra": {"list": [1, 1.0, -0.0], "day": datetime.date(2026, 11, 20)},
    }
    pose = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
    columns = ["note", "view", "stamp_s", "tau1_nm", *(f"cft_{name}" for name in pose)]
    cells = [
        ['a,"b"\n', "7", "5e-324", "999999.9999999999", "-0.0", "0", "1", "0", "0", "0", "1"],
        ["", "-3", "", "0.1", "0.30000000000000004", "0", "1", "0", "0", "0", "1"],
    ]
    session = Session.assemble(document, columns, cells, MemoryImages({}))
    assert_same(session, Session.load(write_session(tmp_path / "odd.rrd", session)))


def test_the_date_of_a_boards_description_is_kept_as_text(sample, tmp_path):
    board = {**sample.session.target_document, "printed": datetime.date(2026, 11, 20)}
    session = replace(sample.session, target_document=board)
    read = Session.load(write_session(tmp_path / "dated.rrd", session))
    assert read.target_document["printed"] == "2026-11-20"
    assert read.digest() == session.digest()


def test_views_without_rows_of_corners_csv_survive(sample, tmp_path):
    table = parse_corners("view,point,u_px,v_px\n0,1,310.5,220\n")
    session = replace(sample.session, corner_table=table).only([1, 2])
    assert len(session.corner_table) == 0
    assert_same(session, Session.load(write_session(tmp_path / "some.rrd", session)))


@pytest.mark.parametrize(
    ("step", "words"), [(1, "Install visioncal 9.1 or newer"), (-1, "folder again")]
)
def test_another_format_is_refused_with_the_next_step(step, words, sample, tmp_path, monkeypatch):
    with monkeypatch.context() as other:
        other.setattr(codec, "FORMAT", codec.FORMAT + step)
        other.setattr(codec, "__version__", "9.1")
        path = write_session(tmp_path / "other.rrd", sample.session)
    for read in (Session.load, read_calibration):
        assert words in raised(DataError, f"format {codec.FORMAT + step}", read, path).next_step


def test_images_stay_in_the_recording_until_they_are_read(sample, tmp_path):
    path = write_session(tmp_path / "session.rrd", sample.session)
    session = Session.load(path)
    image = session.views[2].image
    write_session(path, made_up(2).session)
    raised(DataError, r"no longer exists|replaced since", session.images.read, image)
    raised(DataError, r"no image none\.png", session.images.read, "none.png")


def test_missing_and_shared_images_stay_missing_and_shared(sample, tmp_path):
    first, second, third = sample.session.views[:3]
    views = (first, replace(second, image=first.image), replace(third, image="images/none.png"))
    session = replace(sample.session, views=views)
    again = Session.load(write_session(tmp_path / "few.rrd", session))
    assert_same(session, again)
    assert not again.images.exists("images/none.png")


def test_a_file_that_is_no_recording_is_refused(recorded, tmp_path):
    junk, cut, foreign = (tmp_path / f"{name}.rrd" for name in ("junk", "cut", "foreign"))
    junk.write_bytes(b"no recording" * 100)
    cut.write_bytes(recorded.read_bytes()[:500])
    with rr.RecordingStream("other") as stream:
        stream.save(foreign)
        stream.log("points", rr.Points2D([[1.0, 2.0]]))
        stream.disconnect()
    for path in (junk, cut, foreign, tmp_path / "absent.rrd"):
        with pytest.raises(DataError) as error:
            Session.load(path)
        assert path.name in error.value.message


def test_failed_write_leaves_the_old_file(sample, tmp_path):
    class Broken(MemoryImages):
        def read(self, path):
            raise DataError(f"{path} cannot be read.")

    path = tmp_path / "recording.rrd"
    path.write_bytes(b"old")
    broken = replace(
        sample.session, images=Broken({view.image: b"" for view in sample.session.views})
    )
    raised(DataError, r"000\.png", write_session, path, broken)
    assert path.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["recording.rrd"]
    shutil.rmtree(tmp_path)
    raised(DataError, "cannot be written", write_session, path, sample.session)


def test_full_disk_is_an_error(sample, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=3_000_000))
    with pytest.raises(DataError, match="cannot be written: 3 MB are free"):
        write_session(tmp_path / "recording.rrd", sample.session)
    assert list(tmp_path.iterdir()) == []


_LIMITED = """
import resource, sys
from pathlib import Path
from support.samples import made_up
from visioncal.core.errors import DataError
from visioncal.present.recording import recorder, write_recording

recorder._WRITTEN_S = 2.0
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
try:
    write_recording(Path(sys.argv[1]), made_up().session, None, (), None)
except DataError as error:
    print(error.message)
"""


@pytest.mark.slow
def test_a_writer_that_has_ended_is_not_waited_for_without_end(tmp_path):
    command = [sys.executable, "-c", _LIMITED, str(tmp_path / "recording.rrd")]
    # A hundred times what it takes: without a limit it would not end at all.
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert "recording.rrd cannot be written" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_corners_are_drawn_where_the_viewer_has_the_pixels(sample, recorded):
    drawn = column(recorded, paths.DETECTED, "Points2D:positions")
    # View 3 found no corners: an empty batch takes those of view 2 off the screen.
    assert len(drawn[3]) == 0
    corners = sample.evidence[4].corners
    assert corners is not None
    # Single precision holds 640 px to 3e-5.
    np.testing.assert_allclose(drawn[4], corners.px + 0.5, atol=1e-4)


def test_camera_is_drawn_at_the_end_of_the_chain(sample, recorded):
    flanges = column(recorded, paths.FLANGE, "Transform3D:translation")
    camera = column(recorded, paths.CAMERA, "Transform3D:translation")[0]
    edge = sample.calibration.transforms["flange_from_cam"]
    # Single precision holds 1 m to 6e-8.
    np.testing.assert_allclose(camera[0], edge.translation, atol=1e-6)
    for position, seen in zip(flanges.values(), sample.evidence, strict=True):
        assert seen.base_from_flange is not None
        np.testing.assert_allclose(position[0], seen.base_from_flange[:3, 3], atol=1e-6)


def test_a_cut_recording_is_refused(recorded, tmp_path):
    rng, data, cut = random.Random(3), recorded.read_bytes(), tmp_path / "cut.rrd"
    for size in (12, 13, len(data) - 20, *(rng.randrange(len(data)) for _ in range(30))):
        # A loss of power leaves zeros.
        for rest in (b"", bytes(len(data) - size)):
            cut.write_bytes(data[:size] + rest)
            raised(DataError, r"cut\.rrd (was cut off|must be a recording)", Session.load, cut)


def test_flipped_bytes_in_images_are_named(sample, recorded, tmp_path):
    rng, broken = random.Random(4), tmp_path / "broken.rrd"
    for _ in range(20):
        view = rng.choice(sample.session.views)
        content = sample.session.images.read(view.image)
        # A PNG cannot be compressed further, so that most of it lies in the file as it is.
        place, data = -1, bytearray(recorded.read_bytes())
        while place < 0:
            start = rng.randrange(len(content) - 16)
            place = data.find(content[start : start + 16])
        data[place + rng.randrange(16)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        assert raised(DataError, "SHA-256", Session.load, broken).culprits == (view.image,)


@pytest.mark.parametrize("entity", [slow(paths.SESSION), slow(paths.IMAGE), paths.CALIBRATION])
def test_no_flipped_bit_changes_anything_silently(entity, sample, recorded, tmp_path):
    rng, broken = random.Random(5), tmp_path / "broken.rrd"
    frames = [frame for frame, _, _ in chunks(recorded, (entity,))]
    refused = 0
    for _ in range(40):
        frame = rng.choice(frames)
        data = bytearray(recorded.read_bytes())
        # The 16 bytes before the payload are the message's kind and length.
        data[rng.randrange(frame.offset - 16, frame.end)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        try:
            assert_same(sample.session, Session.load(broken))
            calibration = read_calibration(broken)
            assert calibration is not None
            assert calibration.text == sample.calibration.text
            assert_same_evidence(sample.evidence, read_evidence(broken))
        except DataError:
            refused += 1
    # Bits that mean nothing are in the padding, and in times of day that nobody reads.
    assert refused > 10


def test_changed_result_leaves_the_session(sample, recorded, tmp_path):
    data, path = recorded.read_bytes(), tmp_path / "changed.rrd"
    assert data.count(b"2026-11-20T10:11:12") == 1
    path.write_bytes(data.replace(b"2026-11-20T10:11:12", b"2026-11-20T10:11:13"))
    raised(DataError, "its result cannot be read or was changed", read_calibration, path)
    assert_same(sample.session, Session.load(path))


def test_residuals_of_views_left_out_are_drawn_to_scale(sample, recorded):
    overlay = Overlay.of(
        sample.session, sample.calibration, {view.view: view for view in sample.evidence}
    )
    magnified = column(recorded, paths.magnified_residuals(overlay.factor), "Arrows2D:vectors")
    to_scale = column(recorded, paths.RESIDUALS_TO_SCALE, "Arrows2D:vectors")
    assert overlay.factor > 1
    for view, used in ((4, True), (6, False)):
        seen = sample.evidence[view]
        assert seen.corners is not None
        assert seen.predicted_px is not None
        residuals = seen.predicted_px - seen.corners.px
        expected = (overlay.factor * residuals, []) if used else ([], residuals)
        for found, wanted in zip((magnified[view], to_scale[view]), expected, strict=True):
            # Single precision of arrows that are some ten pixels long.
            np.testing.assert_allclose(found, wanted, atol=1e-4)


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
    views = [*views_of(layout.root_container)]
    # The viewer warns of a view in two containers.
    assert len({view.id for view in views}) == len(views)
    for view in views:
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
    assert Session.load(recording).digest() == session.digest()
    assert to_document(read_calibration(recording)) == to_document(found)
    drawn = {chunk.entity_path for chunk in RrdReader(recording).stream()}
    for entity in ("/cameras/top", "/targets/plate/sheet", "/robots/b/links", "/network"):
        assert entity in drawn
