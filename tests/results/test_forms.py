"""Results that were edited by hand, or damaged: refused with the place, before they are used."""

import json

import pytest
from support.aligned_cells import made_up_cell
from support.samples import made_up, with_frames

from visioncal.core.errors import DataError
from visioncal.results import Calibration, to_document


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    path = tmp_path_factory.mktemp("result") / "calibration.json"
    with_frames(made_up(5)).calibration.save(path)
    return path.read_text()


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("created",), 5, "created is 5; a text is needed"),
        (("views", 2, "rms_px"), "0.2", r"views\[2\].rms_px is '0.2'; a number is needed"),
        (("views", 1, "used"), 1, r"views\[1\].used is 1; true or false is needed"),
        (("views", 1), [], r"views\[1\] is \[\]; a table is needed"),
        (("noise", "pixel_px"), float("nan"), "noise.pixel_px is nan; a number that a cell has"),
        (("rms", "mm"), 10**400, "rms.mm is inf; a number that a cell has"),
        (("rms", "mm"), None, "rms.mm is None"),
        (("rms",), {}, "rms.mm is missing"),
        (("verdict", "status"), "perfect", "verdict.status is 'perfect'"),
        (("verdict", "reasons"), "none", "verdict.reasons is 'none'; a list is needed"),
        (("solvers", "park", "rms_mm"), True, "solvers.park.rms_mm is True; a number"),
        (("frames", "flange_from_tool", "created"), [], "flange_from_tool.created is"),
        (("kinematics",), "nominal", "kinematics is 'nominal'; a table is needed"),
        (("uncertainty",), {"budget_mm": {}}, "uncertainty.point_cam_m is missing"),
        (("joint_covariance", "matrix", 2, 2), -1e-8, "matrix is no covariance"),
        (("joint_covariance", "matrix", 2, 3), 1.0, "matrix is no covariance"),
        (("transforms", "flange_from_cam", "matrix", 3, 0), 1.0, "not a rigid transform"),
        (
            ("transforms", "flange_from_cam", "matrix", 0, 0),
            1e300,
            "1e\\+300; a number that a cell has",
        ),
        (("elastic",), {"joints": [{"compliance_rad_per_nm": {}}]}, r"joints\[0\].compliance"),
        (("elastic",), {"weight_moments": [[1], [1, 2]]}, "an array of n x n numbers"),
        (("kinematics",), {"level": "offsets", "robot": {"joint": 1}}, "robot: name is missing"),
        (("mount",), "eye-to-hand", r"transforms.base_from_cam is missing, and mount is 'eye-to"),
        (("schema",), 9, r"schema is 9, this version reads 2\. A newer"),
    ],
)
def test_what_a_calibration_does_not_hold_is_named(calibrated, tmp_path, place, value, words):
    content = json.loads(calibrated)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=words) as error:
        Calibration.load(path)
    assert str(path) in error.value.message


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("views", [{"view": 0}], r"views\[0\]\.[a-z]+ is missing"),
        ("noise", {"a": {"translation_mm": "0.1"}}, "noise.a.translation_mm is '0.1'"),
        ("cameras", [], r"cameras is \[\]; a table is needed"),
        ("weakest", None, "weakest is None; a text is needed"),
    ],
)
def test_what_a_cell_s_result_does_not_hold_is_named(tmp_path, key, value, words):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(to_document(made_up_cell(1)) | {key: value}))
    with pytest.raises(DataError, match=words):
        Calibration.load(path)
