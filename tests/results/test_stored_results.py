"""Stored results open, say the same when written again, and keep what is unknown."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from visioncal.core.errors import DataError
from visioncal.results import Calibration, to_document

DATA = Path(__file__).parents[1] / "data"
# An arm with springs and two payloads; one that warms up; two arms and two cameras.
NAMES = ("elastic", "warm", "pick")


def stored(name: str) -> str:
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
    assert (arm.clock, arm.thermal, arm.board, arm.dense) == (None,) * 4
    warm = Calibration.from_json(stored("warm"), "warm")
    assert warm.thermal.heated_by == "temperatures"
    assert warm.drift.growth_per_k == pytest.approx(
        [joint.growth_per_k for joint in warm.thermal.joints]
    )
    part = Calibration.from_json(stored("pick"), "pick").of("left", "a", "plate_a")
    assert part.uncertainty.noise_95.keys() == {"robot_translation_mm", "robot_rotation_deg"}
    assert part.budget is None
    assert np.isfinite(part.noise_dof)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("joints", 2, "tau_s"), "x", r"thermal\.joints\[2\]\.tau_s is 'x'; a number is needed"),
        (("joints", 2, "tau_s"), True, r"thermal\.joints\[2\]\.tau_s is True; a number is needed"),
        (("joints", 2, "tau_s"), None, r"thermal\.joints\[2\]\.tau_s is None; a number"),
        (("covariance",), [[1.0], [2.0, 3.0]], r"thermal\.covariance is \[\[1.0\].*n x n numbers"),
        (("rises_k", 1), "1", r"thermal\.rises_k\[1\] is '1'; a number is needed"),
        (("lengths_m",), [[0.0, 1.0]], r"thermal\.lengths_m is .* an array of n x 3 numbers"),
        (("heated_by",), "sun", r"heated_by is 'sun'; one of 'temperatures', 'currents' is needed"),
        (("not_determined",), "all", r"thermal\.not_determined is 'all'; a list is needed"),
        (("views", 0), 1, r"thermal\.views\[0\] is 1; a table is needed"),
        (("views", 0, "view"), 1.5, r"thermal\.views\[0\]\.view is 1\.5; a whole number is needed"),
        (("residual_mm",), {"without": 0.1}, r"thermal\.residual_mm\.with is missing"),
    ],
)
def test_the_place_of_what_is_wrong_is_named(place, value, words):
    document = json.loads(stored("warm"))
    inner = document["thermal"]
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with pytest.raises(DataError, match=words) as error:
        Calibration.from_json(json.dumps(document), "changed.json")
    assert error.value.message.startswith("changed.json: ")
