"""The whole way: a folder goes in, a result with its verdict comes out, or one clear message."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import exact

import visioncal
from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.results import Calibration, to_document
from visioncal.session import Session
from visioncal.simulation import CellOptions, read_truth, simulate, write_session

CONTRACT_KEYS = {
    "joint_fit",
    "kinematics",
    "schema",
    "visioncal",
    "created",
    "session",
    "mount",
    "transforms",
    "joint_covariance",
    "solvers",
    "camera",
    "robot",
    "noise",
    "ray_frame",
    "views",
    "rms",
    "validation",
    "verdict",
    "board",
    "uncertainty",
}


@pytest.fixture(scope="module")
def result(rendered) -> Calibration:
    return visioncal.calibrate(Session.load(rendered))


def errors(calibration, truth):
    """Distance [mm] and angle [deg] of the first edge from the truth."""
    name = next(iter(calibration.edges))
    away = invert(truth.transforms[name]) @ calibration.transforms[name].as_matrix()
    return 1e3 * np.linalg.norm(away[:3, 3]), np.rad2deg(rotation_angle(away))


def with_rows(folder, change):
    """Rewrites views.csv through a function of its rows, the header not among them."""
    path = folder / "views.csv"
    header, *rows = path.read_text(encoding="utf-8").splitlines()
    header, rows = change(header, rows)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


@pytest.fixture
def session_copy(rendered, tmp_path):
    return shutil.copytree(rendered, tmp_path / "copy")


def test_a_rendered_session_gives_the_truth_within_its_sigma(result, rendered):
    away_mm, away_deg = errors(result, read_truth(rendered))
    edge = result.edges["flange_from_cam"]
    # The length of an error of three components exceeds three roots of its variance rarely.
    assert away_mm < 3 * edge.sigma_mm
    assert away_deg < 3 * edge.sigma_deg
    # 12 sharp views of 1280 x 800 with an unknown lens reach some tenths of a millimetre.
    assert edge.sigma_mm < 0.5
    assert result.verdict.status == "good"
    assert result.camera.estimated
    truth = read_truth(rendered).camera
    sigma = np.sqrt(np.diag(result.camera.covariance))[:4]
    assert np.all(np.abs(result.camera.camera.matrix - truth.matrix) < 4 * sigma)


def test_the_document_keeps_the_contract(result):
    document = to_document(result)
    assert set(document) == CONTRACT_KEYS
    assert "null" not in json.dumps(document)
    edge = document["transforms"]["flange_from_cam"]
    assert set(edge) == {
        "matrix",
        "quaternion_xyzw",
        "translation_m",
        "covariance",
        "sigma_mm",
        "sigma_deg",
    }
    covariance = np.array(edge["covariance"])
    assert edge["sigma_mm"] == pytest.approx(1e3 * np.sqrt(np.trace(covariance[3:, 3:])))
    joint = np.array(document["joint_covariance"]["matrix"])
    assert document["joint_covariance"]["order"] == ["flange_from_cam", "base_from_target"]
    np.testing.assert_array_equal(joint[:6, :6], covariance)
    assert np.all(np.linalg.eigvalsh(joint) > 0)
    assert len(document["views"]) == 12
    assert all(view["used"] and view["rms_px"] > 0 for view in document["views"])
    assert len(document["camera"]["covariance"]) == 9


@pytest.mark.parametrize(
    ("form", "changed"),
    [
        ("translation_m", lambda old: [old[0], old[1], old[2] + 1e-3]),
        ("quaternion_xyzw", lambda old: [-old[1], old[0], old[3], -old[2]]),
        ("matrix", lambda old: [[*old[0][:3], old[0][3] + 2e-5], *old[1:]]),
    ],
)
@pytest.mark.parametrize("place", ["transforms", "solvers"])
def test_a_pose_whose_forms_contradict_each_other_is_refused(result, place, form, changed):
    document = to_document(result)
    found = document[place]["park"] if place == "solvers" else document[place]
    pose = found["flange_from_cam"]
    pose[form] = changed(pose[form])
    with pytest.raises(
        DataError, match=r"^cal\.json: flange_from_cam: \w+ is .* another pose"
    ) as no:
        Calibration.from_json(json.dumps(document), "cal.json")
    assert form == "matrix" or any(form in culprit for culprit in no.value.culprits)


def test_a_pose_that_was_rounded_to_six_places_is_the_same(result):
    document = to_document(result)
    pose = document["transforms"]["flange_from_cam"]
    for form in ("translation_m", "quaternion_xyzw"):
        pose[form] = [round(-value if form[0] == "q" else value, 6) for value in pose[form]]
    again = Calibration.from_json(json.dumps(document), "cal.json")
    np.testing.assert_array_equal(
        again.edges["flange_from_cam"].matrix, result.edges["flange_from_cam"].matrix
    )


def test_an_unknown_edge_is_refused_with_those_there_are(result):
    with pytest.raises(DataError, match="flange_from_cam, base_from_target"):
        result.covariance("base_from_cam")


def test_the_same_session_gives_the_same_numbers(rendered, result):
    again = to_document(visioncal.calibrate(rendered))
    assert {**again, "created": ""} == {**to_document(result), "created": ""}


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_exact_pose_pairs_give_the_exact_edges(mount, tmp_path):
    folder = write_session(
        simulate(exact(CellOptions(mount=mount, seed=4))), tmp_path / "pairs", images=False
    )
    calibration = visioncal.calibrate(folder)
    away_mm, away_deg = errors(calibration, read_truth(folder))
    # Numbers on disk keep all digits; the solvers are exact to 1e-9 m.
    assert away_mm < 1e-6
    assert away_deg < 1e-6
    assert calibration.camera is None
    assert "pixel_px" not in calibration.noise


def test_joints_stand_in_for_poses(session_copy, result):
    pose = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]

    def without_poses(header, rows):
        columns = header.split(",")
        keep = [at for at, name in enumerate(columns) if name not in pose]
        cut = [",".join(np.array(row.split(","))[keep]) for row in rows]
        return ",".join(np.array(columns)[keep]), cut

    with_rows(session_copy, without_poses)
    by_joints = visioncal.calibrate(session_copy)
    np.testing.assert_allclose(
        by_joints.transforms["flange_from_cam"].as_matrix(),
        result.transforms["flange_from_cam"].as_matrix(),
        atol=1e-9,  # the model's poses and the reported ones agree to rounding
    )


def test_a_view_held_out_by_the_session_is_in_no_fit(session_copy):
    def hold(header, rows, spoil):
        columns = header.split(",")
        x = columns.index("x_m")
        out = []
        for at, row in enumerate(rows):
            cells = row.split(",")
            if at == 3 and spoil:
                cells[x] = repr(float(cells[x]) + 0.05)
            out.append(",".join([*cells, "holdout" if at == 3 else ""]))
        return header + ",role", out

    with_rows(session_copy, lambda header, rows: hold(header, rows, spoil=False))
    whole = visioncal.calibrate(session_copy)
    assert not whole.views[3].used
    assert "holdout" in whole.views[3].reason
    assert whole.validation.holdout.mm < 1.0
    with_rows(
        session_copy,
        lambda header, rows: (
            header.removesuffix(",role"),
            [row.rpartition(",")[0] for row in rows],
        ),
    )
    with_rows(session_copy, lambda header, rows: hold(header, rows, spoil=True))
    spoilt = visioncal.calibrate(session_copy)
    np.testing.assert_array_equal(
        spoilt.transforms["flange_from_cam"].as_matrix(),
        whole.transforms["flange_from_cam"].as_matrix(),
    )
    # The spoilt pose is off by 50 mm, and shows as such.
    assert spoilt.validation.holdout.mm == pytest.approx(50.0, abs=2.0)


def test_missing_cut_and_empty_images_are_named_and_left_out(session_copy, result):
    images = sorted((session_copy / "images").iterdir())
    images[1].unlink()
    images[4].write_bytes(images[4].read_bytes()[:4000])
    images[7].write_bytes(b"")
    cv2.imwrite(str(images[9]), cv2.resize(cv2.imread(str(images[9])), None, fx=0.5, fy=0.5))
    calibration = visioncal.calibrate(session_copy)
    unused = {view.view: view.reason for view in calibration.views if not view.used}
    assert set(unused) == {1, 4, 7, 9}
    assert "640 x 400 px, and the camera's images are 1280 x 800" in unused[9]
    assert "missing" in unused[1]
    assert "cut short" in unused[4]
    assert "empty" in unused[7]
    # Nothing shifts: the others keep their poses, and the answer stays where it was.
    step = invert(result.transforms["flange_from_cam"].as_matrix()) @ (
        calibration.transforms["flange_from_cam"].as_matrix()
    )
    assert 1e3 * np.linalg.norm(step[:3, 3]) < 3 * calibration.edges["flange_from_cam"].sigma_mm


def test_two_views_and_no_board_are_refused(session_copy):
    for path in sorted((session_copy / "images").iterdir())[2:]:
        cv2.imwrite(str(path), np.full((800, 1280), 90, np.uint8))
    with pytest.raises(DataError, match="intrinsics: 2 views show the target"):
        visioncal.calibrate(session_copy)
    for path in sorted((session_copy / "images").iterdir()):
        path.write_bytes(cv2.imencode(".png", np.full((800, 1280), 90, np.uint8))[1].tobytes())
    with pytest.raises(DataError, match="no view shows the target") as caught:
        visioncal.calibrate(session_copy)
    assert "almost uniform" in caught.value.culprits[0]


def test_images_and_measured_poses_in_one_session(session_copy, result):
    """Some rows bring the target's pose themselves, the lens being estimated from the others."""
    evidence = {view.view: view for view in run(session_copy).evidence}
    names = [f"cft_{name}" for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]

    def measured(header, rows):
        image = header.split(",").index("image")
        out = []
        for at, row in enumerate(rows):
            cells = row.split(",")
            pose = [""] * 7
            if at < 3:
                matrix = evidence[at].cam_from_target
                cells[image] = ""
                quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
                pose = [repr(float(value)) for value in (*matrix[:3, 3], *quaternion)]
            out.append(",".join([*cells, *pose]))
        return ",".join([header, *names]), out

    with_rows(session_copy, measured)
    mixed = visioncal.calibrate(session_copy)
    assert all(view.used for view in mixed.views)
    step = invert(result.transforms["flange_from_cam"].as_matrix()) @ (
        mixed.transforms["flange_from_cam"].as_matrix()
    )
    assert 1e3 * np.linalg.norm(step[:3, 3]) < 4 * result.edges["flange_from_cam"].sigma_mm
    # The noise of the measured poses is not known: both kinds are estimated as one.
    assert "combined_translation_mm" in mixed.noise


@pytest.mark.parametrize(
    ("value", "words"), [("1e300", "x_m"), ("1e9", "no place in a robot cell")]
)
def test_a_number_that_is_no_place_is_refused(session_copy, value, words):
    def absurd(header, rows):
        at = header.split(",").index("x_m")
        cells = rows[0].split(",")
        cells[at] = value
        return header, [",".join(cells), *rows[1:]]

    with_rows(session_copy, absurd)
    with pytest.raises(DataError, match=words):
        visioncal.calibrate(session_copy)


def test_progress_tells_of_every_stage_and_image(rendered):
    told = []
    run(rendered, progress=lambda stage, done, total: told.append((stage, done, total)))
    assert ("detect", 12, 12) in told
    assert {"pnp", "solve", "examine", "judge"} <= {stage for stage, *_ in told}


def test_options_that_do_not_exist_are_refused(rendered):
    with pytest.raises(DataError, match=r"solver is text .'best'"):
        visioncal.calibrate(rendered, solver="best")
    with pytest.raises(DataError, match="level 'seven'"):
        visioncal.calibrate(rendered, level="seven")


def test_evidence_shows_what_was_seen_and_where_it_should_be(rendered):
    done = run(rendered)
    assert len(done.evidence) == 12
    for seen, view in zip(done.evidence, done.calibration.views, strict=True):
        away = seen.predicted_px - seen.corners.px
        assert np.sqrt(np.mean(np.sum(away**2, axis=1))) == pytest.approx(view.rms_px)
    angle = Rotation.from_matrix(done.evidence[0].cam_from_target[:3, :3]).magnitude()
    assert 0 < angle < np.pi
