"""calibration.json."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

from visioncal.core.documents import Kinds, shown
from visioncal.core.types import Mount
from visioncal.core.version import __version__
from visioncal.results.codec import read_fields, write
from visioncal.results.edge import (
    edge_document,
    pose_document,
    read_covariance,
    read_edge,
    read_pose,
)
from visioncal.results.forms import CALIBRATION, SCHEMA, check
from visioncal.results.frame import frames_document, present, read_frames
from visioncal.results.lens import camera_document, read_camera
from visioncal.results.parts import (
    Rms,
    SolverResult,
    Validation,
    ViewResult,
)
from visioncal.results.sections import CalibrationSections
from visioncal.results.verdicts import (
    need_document,
    read_need,
    read_verdict,
    verdict_document,
)
from visioncal.results.whole import whole_document
from visioncal.robot import Robot

if TYPE_CHECKING:
    from visioncal.results.result import Calibration

# What the fields hold beside numbers, by their names.
KINDS = Kinds(
    re.compile(
        "reasons?|method|status|level|name|source|created|mount|words|weight|cause|sentence"
    ),
    re.compile(
        "session|transforms|joint_covariance|solvers|noise|rms|validation|held_out|verdict|need"
        "|kinematics|elastic|thermal|uncertainty|noise_95|joint_fit|observability|camera|conditions"
    ),
    re.compile("views|levels|parameters|left_out|stops|joints|course|observations|causes"),
)


def to_document(calibration: "Calibration") -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    if calibration.cell is not None:
        return whole_document(replace(calibration.cell, placed=calibration.frames))
    camera, robot = calibration.camera, calibration.robot
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "visioncal": __version__,
        "created": calibration.created,
        "session": {"name": calibration.session_name, "sha256": calibration.session_sha256},
        "mount": calibration.mount,
        "transforms": {name: edge_document(edge) for name, edge in calibration.edges.items()},
        "joint_covariance": {
            "order": list(calibration.edges),
            "matrix": calibration.joint_covariance.tolist(),
        },
        "solvers": {name: _solver_document(it) for name, it in calibration.solvers.items()},
    }
    if camera is not None:
        document["camera"] = camera_document(camera)
    if robot is not None:
        document["robot"] = dict(robot.document)
    document |= {
        "noise": dict(calibration.noise),
        "views": [present(vars(view)) for view in calibration.views],
        "rms": present(vars(calibration.rms)),
        "validation": _validation_document(calibration.validation),
        "verdict": verdict_document(calibration.verdict),
        **need_document(calibration.need),
    }
    if calibration.frames:
        document["frames"] = frames_document(calibration.frames)
    return document | write(CalibrationSections, calibration)


def _solver_document(result: SolverResult) -> dict[str, Any]:
    poses = {name: pose_document(pose) for name, pose in result.matrices.items()}
    return poses | present({"rms_mm": result.rms_mm, "rms_deg": result.rms_deg})


def _validation_document(validation: Validation) -> dict[str, Any]:
    document: dict[str, Any] = {
        "method": validation.method,
        "held_out": present(vars(validation.held_out)),
    }
    if validation.holdout is not None:
        document["holdout"] = present(vars(validation.holdout))
    return document


_OWN_KEYS = frozenset(
    {"schema", "visioncal", "created", "session", "mount", "transforms", "joint_covariance"}
    | {"solvers", "camera", "robot", "noise", "views", "rms", "validation", "verdict", "need"}
    | {"frames"}
)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of a calibration from what `to_document` built.

    Raises:
        LookupError, TypeError, ValueError, AttributeError: It is no calibration of this schema.
    """
    if document.get("schema") != SCHEMA:
        raise ValueError(f"schema is {document.get('schema')!r}, this version reads {SCHEMA}")
    check(document, CALIBRATION)
    if document["mount"] not in get_args(Mount):
        raise ValueError(f"mount is {document['mount']!r}")
    if not document["transforms"]:
        raise ValueError("transforms is empty")
    camera = document.get("camera")
    robot = document.get("robot")
    return {
        "session_name": document["session"]["name"],
        "session_sha256": document["session"]["sha256"],
        "created": document["created"],
        "mount": document["mount"],
        "edges": {name: read_edge(edge, name) for name, edge in document["transforms"].items()},
        "joint_covariance": read_covariance(document["joint_covariance"], "matrix", (-1, -1)),
        "solvers": {name: _solver(it) for name, it in document["solvers"].items()},
        "noise": _figures(document["noise"]),
        "views": tuple(_view(it) for it in document["views"]),
        "rms": Rms(**_figures(document["rms"])),
        "validation": _validation(document["validation"]),
        "verdict": read_verdict(document["verdict"]),
        "need": read_need(document),
        "camera": None if camera is None else read_camera(camera),
        "robot": None if robot is None else Robot.from_document(robot),
        "frames": read_frames(document.get("frames", {})),
        **read_fields(
            CalibrationSections, {k: v for k, v in document.items() if k not in _OWN_KEYS}, ""
        ),
    }


def _view(document: Mapping[str, Any]) -> ViewResult:
    _figures({name: it for name, it in document.items() if name not in ("used", "reason")})
    return ViewResult(**document)


def _figures(document: Mapping[str, Any]) -> dict[str, float]:
    """Checks that the fields of a table are single numbers."""
    for name, value in document.items():
        if not isinstance(value, int | float):
            raise TypeError(f"{name} is {shown(value)}, and one number is needed")
    return dict(document)


def _solver(document: Mapping[str, Any]) -> SolverResult:
    poses = {name: read_pose(it, name) for name, it in document.items() if isinstance(it, Mapping)}
    return SolverResult(poses, document["rms_mm"], document.get("rms_deg"))


def _validation(document: Mapping[str, Any]) -> Validation:
    holdout = document.get("holdout")
    return Validation(
        document["method"],
        Rms(**_figures(document["held_out"])),
        None if holdout is None else Rms(**_figures(holdout)),
    )
