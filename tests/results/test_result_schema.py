"""The JSON Schema of calibration.json: made of the types that read it, and kept by what is written.

Run as a program, this file writes the schema that the package ships.
"""

import gzip
import json
from pathlib import Path

import jsonschema
import pytest
from support.made_schema import calibration_schema
from support.result_schema import SHIPPED, faults

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


def test_units_are_told():
    tables = calibration_schema()["$defs"]
    assert tables["JointSpring"]["properties"]["torque_nm"]["description"].endswith("[N m].")
    assert "[mm]" in tables["UncertaintyResult"]["properties"]["radius95_mm"]["description"]


if __name__ == "__main__":
    SHIPPED.write_text(generated())
