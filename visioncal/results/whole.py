"""calibration.json of a whole cell: the sections of one camera's, several of a kind by name.

What differs: `tree` says what each frame hangs on, `reference` which frame the cell's is, and
`cameras`, `robots` and `targets` have by name what `camera` and `robot` have of one.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.core.version import __version__
from visioncal.results.alignment import (
    Alignment,
    Sight,
    Untied,
    moved_document,
    read_moved,
)
from visioncal.results.arm import ArmSections
from visioncal.results.codec import entries, read, read_fields, write
from visioncal.results.edge import edge_document, read_covariance, read_edge
from visioncal.results.forms import SCHEMA, WHOLE, check
from visioncal.results.frame import frames_document, present, read_frames
from visioncal.results.lens import camera_document, read_camera
from visioncal.results.parts import (
    HELD_BACK,
    Rms,
    RobotResult,
    ViewResult,
)
from visioncal.results.sections import CellDetails, CellSections
from visioncal.results.verdicts import (
    need_document,
    read_need,
    read_verdict,
    verdict_document,
)
from visioncal.robot import Robot
from visioncal.session import frame_name
from visioncal.session.frames import frames_of_kind, robots_between, thing_name

_OWN_KEYS = frozenset(
    {"schema", "visioncal", "created", "session", "reference", "tree", "transforms", "noise"}
    | {"validation"}
    | {"joint_covariance", "cameras", "robots", "targets", "views", "rms", "moved", "untied"}
    | {"weakest", "verdict", "need", "frames", "details"}
)


def is_whole(document: Mapping[str, Any]) -> bool:
    """Whether a document is of a whole cell, as calibration.json has it."""
    return "tree" in document


def whole_document(cell: Alignment) -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "visioncal": __version__,
        "created": cell.created,
        "session": {"name": cell.session_name, "sha256": cell.session_sha256},
        "reference": cell.reference,
        "tree": dict(cell.frames),
        "transforms": {name: edge_document(edge) for name, edge in cell.edges.items()},
        "joint_covariance": {
            "order": list(cell.edges),
            "matrix": cell.joint_covariance.tolist(),
        },
        "cameras": {
            thing_name(frame, "camera"): camera_document(it) for frame, it in cell.cameras.items()
        },
        "robots": {name: _arm_document(it) for name, it in cell.arms.items()},
        "targets": {name: dict(it) for name, it in cell.targets.items()},
        "noise": {name: dict(it) for name, it in cell.noise.items()},
        "views": [_view_document(cell, it) for it in cell.sights],
        "rms": present(vars(rms_of(cell.sights))),
        "moved": moved_document(cell.moved),
        "untied": [vars(it) for it in cell.untied],
        "weakest": cell.weakest,
        "verdict": verdict_document(cell.verdict),
        **need_document(cell.need),
        "details": write(CellDetails, cell.details),
    }
    if cell.left_out:
        document["validation"] = _validation_document(cell)
    if cell.placed:
        document["frames"] = frames_document(cell.placed)
    return document | write(CellSections, cell)


def read_whole(document: Mapping[str, Any]) -> Alignment:
    """Reads what `whole_document` built.

    Raises:
        LookupError, TypeError, ValueError, AttributeError: It is no whole cell of this schema.
    """
    if document.get("schema") != SCHEMA:
        raise ValueError(f"schema is {document.get('schema')!r}, this version reads {SCHEMA}")
    check(document, WHOLE)
    tree = dict(document["tree"])
    return Alignment(
        session_name=document["session"]["name"],
        session_sha256=document["session"]["sha256"],
        created=document["created"],
        reference=document["reference"],
        frames=tree,
        robots={it: thing_name(it, "robot") for it in frames_of_kind(tree, "flange")},
        edges={name: read_edge(edge, name) for name, edge in document["transforms"].items()},
        joint_covariance=read_covariance(document["joint_covariance"], "matrix", (-1, -1)),
        cameras={
            _frame(tree, "camera", name): read_camera(it)
            for name, it in document["cameras"].items()
        },
        noise={name: dict(it) for name, it in document["noise"].items()},
        sights=tuple(_sight(tree, it) for it in document["views"]),
        moved=read_moved(document["moved"]),
        untied=tuple(Untied(**it) for it in document["untied"]),
        weakest=document["weakest"],
        verdict=read_verdict(document["verdict"]),
        need=read_need(document),
        details=read(CellDetails, document["details"], "details"),
        arms={name: _arm(it, name) for name, it in document["robots"].items()},
        targets={name: dict(it) for name, it in document["targets"].items()},
        placed=read_frames(document.get("frames", {})),
        left_out=document.get("validation", {}).get("method", ""),
        **read_fields(CellSections, {k: v for k, v in document.items() if k not in _OWN_KEYS}, ""),
    )


def _validation_document(cell: Alignment) -> dict[str, Any]:
    """Residuals of what was left out of fits in turn: of all, and by camera and target."""
    pairs: dict[tuple[str, str], list[Sight]] = {}
    for it in cell.sights:
        if it.left_out_mm is not None:
            pairs.setdefault((it.seer, it.seen), []).append(it)
    holdout = holdout_rms(cell.sights)
    return {
        "method": cell.left_out,
        "held_out": present(vars(left_out_rms(cell.sights))),
        **({} if holdout is None else {"holdout": present(vars(holdout))}),
        "pairs": [
            {
                **_seer_and_seen(mine[0]),
                "views": len(mine),
                **present(vars(left_out_rms(mine))),
            }
            for mine in pairs.values()
        ],
    }


def _seer_and_seen(sight: Sight) -> dict[str, str]:
    """What saw, and what was seen, by their kinds."""
    seer = "camera" if sight.seer in frames_of_kind([sight.seer], "camera") else "instrument"
    seen = "target" if sight.seen in frames_of_kind([sight.seen], "target") else "point"
    return {seer: thing_name(sight.seer, seer), seen: thing_name(sight.seen, seen)}


def left_out_rms(sights: Iterable[Sight]) -> Rms:
    """Root mean square residuals of observations by fits that were made without them."""
    unseen = (
        replace(it, residual_mm=it.left_out_mm, residual_deg=it.left_out_deg, rms_px=it.left_out_px)
        for it in sights
    )
    return rms_of(unseen)


def holdout_rms(sights: Iterable[Sight]) -> Rms | None:
    """Root mean square residuals of what the session holds back; None where that is nothing."""
    held = [
        replace(it, used=True)
        for it in sights
        if it.reason == HELD_BACK and it.residual_mm is not None
    ]
    return rms_of(held) if held else None


def rms_of(sights: Iterable[Sight]) -> Rms:
    """Root mean square residuals over the used ones of some observations; zero of none."""
    used = [it for it in sights if it.used]

    def rms(values: list[float | None]) -> float | None:
        known = [it for it in values if it is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    return Rms(
        rms([it.residual_mm for it in used]) or 0.0,
        rms([it.residual_deg for it in used]),
        rms([it.rms_px for it in used]),
    )


def view_results(sights: Iterable[Sight]) -> tuple[ViewResult, ...]:
    """Observations as one camera's views."""
    return tuple(
        ViewResult(
            it.view, it.used, it.reason, it.corners, it.rms_px, it.residual_mm, it.residual_deg
        )
        for it in sights
    )


def _frame(tree: Mapping[str, str], kind: str, name: str) -> str:
    """The frame of what is called so."""
    frame = frame_name(kind, name)
    return frame if frame in tree or name != kind else frame_name(kind, "")


def _arm_document(arm: RobotResult) -> dict[str, Any]:
    model = {} if arm.model is None else dict(arm.model.document)
    return model | write(ArmSections, arm)


def _arm(document: Mapping[str, Any], name: str) -> RobotResult:
    ours = {it.key for it in entries(ArmSections)}
    model = {key: it for key, it in document.items() if key not in ours}
    return RobotResult(
        Robot.from_document(model) if model else None,
        **read_fields(ArmSections, document, f"robots.{name}"),
    )


def _view_document(cell: Alignment, sight: Sight) -> dict[str, Any]:
    """One observation: its thing that sees, what is seen, and the robots that part them."""
    both = {sight.seer, sight.seen} <= cell.frames.keys()
    robots = robots_between(cell.frames, sight.seer, sight.seen) if both else ()
    figures = {name: it for name, it in vars(sight).items() if name not in ("seer", "seen")}
    of = {"view": sight.view, "stop": sight.stop, **_seer_and_seen(sight)}
    return present(of | {"robots": [it or "robot" for it in robots]} | figures)


def _sight(tree: Mapping[str, str], document: Mapping[str, Any]) -> Sight:
    figures = dict(document)
    figures.pop("robots", None)
    seer, seen = (
        next(_frame(tree, kind, figures.pop(kind)) for kind in kinds if kind in figures)
        for kinds in (("camera", "instrument"), ("target", "point"))
    )
    return Sight(seer=seer, seen=seen, **figures)
