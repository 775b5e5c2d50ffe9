"""Stored results open, say the same when written again, and keep what is unknown."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from visioncal.results import Calibration, to_document

DATA = Path(__file__).parents[1] / "data"
# An arm with springs and two payloads; one that warms up; two arms and two cameras.
NAMES = ("elastic", "warm", "pick")


def stored(name):
    return gzip.decompress((DATA / f"calibration_{name}.json.gz").read_bytes()).decode()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_read_and_written_again_is_the_same(name):
    document = json.loads(stored(name))
    again = json.loads(json.dumps(to_document(Calibration.from_json(stored(name), name))))
    assert again.pop("visioncal")
    assert document.pop("visioncal")
    assert again == document
    # In the same order, too; of a cell, what it has by name stands together.
    assert name == "pick" or list(again) == list(document)


def test_what_this_version_does_not_know_is_kept():
    document = json.loads(stored("warm"))
    document["tides"] = {"height_m": 0.3}
    document["thermal"]["humidity"] = [0.4]
    read = Calibration.from_json(json.dumps(document), "later")
    assert read.further == {"tides": {"height_m": 0.3}}
    again = to_document(read)
    assert again["tides"] == document["tides"]
    assert again["thermal"] == document["thermal"]


def test_sections_have_types_and_none_where_nothing_was_computed():
    arm = Calibration.from_json(stored("elastic"), "elastic")
    assert arm.arm.level == "elastic"
    assert arm.elastic.weight_moments is None
    assert arm.joint_fit.covariance.shape == (len(arm.joint_fit.covariance),) * 2
    assert arm.uncertainty.radius95_mm > arm.uncertainty.total_mm > 0.0
    assert (arm.clock, arm.thermal, arm.board) == (None,) * 3
    warm = Calibration.from_json(stored("warm"), "warm")
    assert warm.thermal.heated_by == "temperatures"
    assert warm.drift.growth_per_k == pytest.approx(
        [joint.growth_per_k for joint in warm.thermal.joints]
    )
    part = Calibration.from_json(stored("pick"), "pick").of("left", "a", "plate_a")
    assert part.uncertainty.noise_95.keys() == {"robot_translation_mm", "robot_rotation_deg"}
    assert part.budget is None
    assert np.isfinite(part.noise_dof)
