"""calibration.json: its schema, stored files, and files that were edited or damaged.

Run as a program, this file writes the schema that the package ships.
"""

import gzip
import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import jsonschema
import numpy as np
import pytest
from support.aligned_cells import made_up_cell
from support.refusals import raised
from support.result_schema import SHIPPED, faults
from support.samples import made_up, with_frames

from visioncal.core.codec import INLINE, REST, Array, WrittenForm, entries
from visioncal.core.errors import DataError
from visioncal.core.types import scalar_of
from visioncal.results import Calibration, to_document
from visioncal.results.document import CalibrationForm, CellForm
from visioncal.results.sections import CalibrationSections

_TYPES = {float: "number", int: "integer", str: "string", bool: "boolean"}


def calibration_schema() -> dict[str, Any]:
    """Describes calibration.json, of one camera and robot and of a whole cell."""
    found = _Schemas()
    forms = {
        "Calibration": found.table(CalibrationForm, CalibrationSections),
        "Cell": found.table(CellForm),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "calibration.json of visioncal",
        "if": {"required": ["tree"]},
        "then": {"$ref": "#/$defs/Cell"},
        "else": {"$ref": "#/$defs/Calibration"},
        "$defs": forms | dict(sorted(found.definitions.items())),
    }


class _Schemas:
    """Schemas of dataclasses, each described once."""

    def __init__(self) -> None:
        self.definitions: dict[str, Any] = {}

    def table(self, *classes: type) -> dict[str, Any]:
        """The keys of dataclasses that stand in one table, described as the first."""
        properties: dict[str, Any] = {}
        required: list[str] = []
        more: dict[str, Any] = {}
        for cls in classes:
            words = _words(cls)
            for entry in entries(cls):
                schema = self.of(entry.kind)
                if INLINE in entry.marks:
                    inner = self.definitions[schema["$ref"].rpartition("/")[2]]
                    properties |= inner["properties"]
                    required += inner["required"] if entry.required else []
                elif REST in entry.marks:
                    more = {"additionalProperties": schema.get("additionalProperties", {})}
                else:
                    note = {"description": words[entry.name]} if entry.name in words else {}
                    properties[entry.key] = note | schema
                    required += [entry.key] if entry.required else []
        described = {"description": inspect.cleandoc(classes[0].__doc__ or "").partition("\n")[0]}
        table = {"type": "object", "properties": properties, "required": required}
        return described | table | more

    def of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type."""
        origin, args = get_origin(kind), get_args(kind)
        if origin is Annotated:
            return self._marked(args)
        if origin in (Union, UnionType):
            several = [self.of(argument) for argument in args if argument is not NoneType]
            return several[0] if len(several) == 1 else {"anyOf": several}
        if origin is Literal:
            return {"enum": list(args)}
        if origin is tuple and args[-1] is Ellipsis:
            return {"type": "array", "items": self.of(args[0])}
        if origin is tuple:
            sizes = {"minItems": len(args), "maxItems": len(args)}
            return {
                "type": "array",
                "prefixItems": [self.of(argument) for argument in args],
            } | sizes
        if origin is not None and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self.of(args[1])}
        if isinstance(kind, type) and is_dataclass(kind):
            name = kind.__name__
            if name not in self.definitions:
                self.definitions[name] = self.table(kind)
            return {"$ref": f"#/$defs/{name}"}
        return {"type": _TYPES[kind]} if kind in _TYPES else {}

    def _marked(self, args: tuple[Any, ...]) -> dict[str, Any]:
        inner, *marks = args
        for mark in marks:
            if isinstance(mark, Array):
                kind = scalar_of(inner)
                return _array("boolean" if kind is np.bool_ else "number", mark.shape)
            if isinstance(mark, WrittenForm):
                return {"type": "object"} if mark.form is None else self.of(mark.form)
        return self.of(inner)


def _array(kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
    found: dict[str, Any] = {"type": kind}
    for size in reversed(shape):
        sizes = {} if size < 0 else {"minItems": size, "maxItems": size}
        found = {"type": "array", "items": found} | sizes
    return found


def _words(cls: type) -> dict[str, str]:
    """What the comments at the fields of a dataclass and its bases say: behind them, or above."""
    found: dict[str, str] = {}
    for base in filter(is_dataclass, reversed(cls.__mro__)):
        above: list[str] = []
        for line in inspect.getsource(base).splitlines():
            if comment := re.fullmatch(r"    # (.*)", line):
                above.append(comment[1])
                continue
            if field := re.match(r"    (\w+): [^#]*(?:# (.*))?$", line):
                found[field[1]] = field[2] or " ".join(above)
            above = []
    return {name: words for name, words in found.items() if words}


DATA = Path(__file__).parents[1] / "data"


def generated():
    return json.dumps(calibration_schema(), indent=1) + "\n"


def stored(name):
    return json.loads(gzip.decompress((DATA / f"calibration_{name}.json.gz").read_bytes()))


def test_the_shipped_schema_is_that_of_the_types():
    assert SHIPPED.read_text() == generated(), (
        "run PYTHONPATH=tests python tests/results/test_result_schema.py"
    )
    jsonschema.Draft202012Validator.check_schema(json.loads(generated()))


@pytest.mark.parametrize("name", ["elastic", "warm", "pick"])
def test_stored_files_fit_the_schema(name):
    assert faults(stored(name)) == []


def test_a_faulty_document_does_not_fit_the_schema():
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
def test_a_result_that_is_read_and_written_again_is_the_same(name):
    document = json.loads(stored_text(name))
    again = json.loads(json.dumps(to_document(Calibration.from_json(stored_text(name), name))))
    assert again.pop("visioncal")
    assert document.pop("visioncal")
    assert again == document
    # In the same order, too; of a cell, what it has by name stands together.
    assert name == "pick" or list(again) == list(document)


def test_unknown_content_of_a_later_version_is_kept():
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
        (("views", 2, "rms_px"), "0.2", r"views\[2\].rms_px is '0.2', but must be a number"),
        (("views", 1, "used"), 1, r"views\[1\].used is 1, but must be true or false"),
        (
            ("noise", "pixel_px"),
            float("nan"),
            "pixel_px is nan, but must be at most",
        ),
        (("rms", "mm"), 10**400, "rms.mm is inf, but must be at most"),
        (("rms",), {}, "rms.mm is missing"),
        (("verdict", "status"), "perfect", "verdict.status is 'perfect'"),
        (("kinematics",), "nominal", "kinematics is 'nominal', but must be a table"),
        (("joint_covariance", "matrix", 2, 2), -1e-8, "matrix is no covariance"),
        (("transforms", "flange_from_cam", "matrix", 3, 0), 1.0, "not a rigid transform"),
        (("elastic",), {"joints": [{"compliance_rad_per_nm": {}}]}, r"joints\[0\].compliance"),
        (("kinematics",), {"level": "offsets", "robot": {"joint": 1}}, "robot: name is missing"),
        (("mount",), "eye-to-hand", r"transforms.base_from_cam is missing, and mount is 'eye-to"),
        (("camera", "distortion"), [0.0] * 6, "has 6 coefficients .* needs 5 or 8"),
        (("camera", "matrix"), [0.0, 900.0, 1.0, 1.0], "fx and fy must be above 0"),
        (("camera", "resolution"), [0, 480], "resolution, fx and fy must be above 0"),
        (("schema",), 9, r"schema is 9, this version reads 2\. A newer"),
    ],
)
def test_absent_parts_of_a_calibration_are_named(calibrated, tmp_path, place, value, words):
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
        ("cameras", [], r"cameras is \[\], but must be a table"),
        ("weakest", None, "weakest is null, but must be a text"),
    ],
)
def test_absent_parts_of_a_cell_s_result_are_named(tmp_path, key, value, words):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(to_document(made_up_cell(1)) | {key: value}))
    raised(DataError, words, Calibration.load, path)


if __name__ == "__main__":
    SHIPPED.write_text(generated())
