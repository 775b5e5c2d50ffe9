"""calibration.json: its schema, stored files, and files that were edited or damaged.

Run as a program, this file writes the schema that the package ships.
"""

import gzip
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from support.aligned_cells import made_up_cell
from support.made_schema import calibration_schema
from support.refusals import raised
from support.result_schema import SHIPPED, faults
from support.samples import made_up, with_frames

from visioncal.core.errors import DataError
from visioncal.results import Calibration, to_document

DATA = Path(__file__).parents[1] / "data"


def generated():
    return json.dumps(calibration_schema(), indent=1) + "\n"


def stored(name):
    return json.loads(gzip.decompress((DATA / f"calibration_{name}.json.gz").read_bytes()))


def test_what_is_shipped_is_what_the_types_say():
    assert SHIPPED.read_text() == generated(), (
        "run PYTHONPATH=tests python tests/results/test_result_schema.py"
    )
    jsonschema.Draft202012Validator.check_schema(json.loads(generated()))


@pytest.mark.parametrize("name", ["elastic", "warm", "pick"])
def test_stored_files_keep_it(name):
    assert faults(stored(name)) == []


def test_what_is_wrong_does_not():
    document = stored("warm")
    document["thermal"]["joints"][2]["tau_s"] = "x"
    document["transforms"]["flange_from_cam"]["matrix"].pop()
    del document["verdict"]["status"]
    places = {fault.partition(":")[0] for fault in faults(document)}
    assert places == {
        "$.thermal.joints[2].tau_s",
        "$.transforms.flange_from_cam.matrix",
        "$.verdict",
    }


# An arm with springs and two payloads; one that warms up; two arms and two cameras.
NAMES = ("elastic", "warm", "pick")


def stored_text(name):
    return gzip.decompress((DATA / f"calibration_{name}.json.gz").read_bytes()).decode()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_read_and_written_again_is_the_same(name):
    document = json.loads(stored_text(name))
    again = json.loads(json.dumps(to_document(Calibration.from_json(stored_text(name), name))))
    assert again.pop("visioncal")
    assert document.pop("visioncal")
    assert again == document
    # In the same order, too; of a cell, what it has by name stands together.
    assert name == "pick" or list(again) == list(document)


def test_what_this_version_does_not_know_is_kept():
    document = json.loads(stored_text("warm"))
    document["tides"] = {"height_m": 0.3}
    document["thermal"]["humidity"] = [0.4]
    read = Calibration.from_json(json.dumps(document), "later")
    assert read.further == {"tides": {"height_m": 0.3}}
    again = to_document(read)
    assert again["tides"] == document["tides"]
    assert again["thermal"] == document["thermal"]


def test_sections_have_types_and_none_where_nothing_was_computed():
    arm = Calibration.from_json(stored_text("elastic"), "elastic")
    assert arm.arm.level == "elastic"
    assert arm.elastic.weight_moments is None
    assert arm.joint_fit.covariance.shape == (len(arm.joint_fit.covariance),) * 2
    assert arm.uncertainty.radius95_mm > arm.uncertainty.total_mm > 0.0
    assert (arm.clock, arm.thermal, arm.board) == (None,) * 3
    warm = Calibration.from_json(stored_text("warm"), "warm")
    assert warm.thermal.heated_by == "temperatures"
    assert warm.drift.growth_per_k == pytest.approx(
        [joint.growth_per_k for joint in warm.thermal.joints]
    )
    part = Calibration.from_json(stored_text("pick"), "pick").of("left", "a", "plate_a")
    assert part.uncertainty.noise_95.keys() == {"robot_translation_mm", "robot_rotation_deg"}
    assert part.budget is None
    assert np.isfinite(part.noise_dof)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    path = tmp_path_factory.mktemp("result") / "calibration.json"
    with_frames(made_up(5)).calibration.save(path)
    return path.read_text()


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("views", 2, "rms_px"), "0.2", r"views\[2\].rms_px is '0.2'; a number is needed"),
        (("views", 1, "used"), 1, r"views\[1\].used is 1; true or false is needed"),
        (("noise", "pixel_px"), float("nan"), "noise.pixel_px is nan; a number that a cell has"),
        (("rms", "mm"), 10**400, "rms.mm is inf; a number that a cell has"),
        (("rms",), {}, "rms.mm is missing"),
        (("verdict", "status"), "perfect", "verdict.status is 'perfect'"),
        (("kinematics",), "nominal", "kinematics is 'nominal'; a table is needed"),
        (("joint_covariance", "matrix", 2, 2), -1e-8, "matrix is no covariance"),
        (("transforms", "flange_from_cam", "matrix", 3, 0), 1.0, "not a rigid transform"),
        (("elastic",), {"joints": [{"compliance_rad_per_nm": {}}]}, r"joints\[0\].compliance"),
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
    assert str(path) in raised(DataError, words, Calibration.load, path).message


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
    raised(DataError, words, Calibration.load, path)


if __name__ == "__main__":
    SHIPPED.write_text(generated())
