"""Digest of a session's content, independent of its storage."""

import json
from collections.abc import Mapping, Sequence
from datetime import date, time

from visioncal.core.files import sha256
from visioncal.robot import LINK_KEYS, ROBOT_SUFFIXES
from visioncal.session.corners import CornerTable
from visioncal.session.images import ImageStore
from visioncal.session.streams import Stream
from visioncal.session.table import View


def digest_facts(
    document: Mapping[str, object],
    target_document: Mapping[str, object] | None,
    robot_document: Mapping[str, object] | None,
    columns: Sequence[str],
    views: Sequence[View],
    images: ImageStore,
    streams: Mapping[str, Stream],
    corners: CornerTable | None,
) -> str:
    """Computes the SHA-256 digest of a session's canonical content.

    It depends on the contents of target and robot files, not on their names, nor on folders,
    formatting and the spelling of numbers. The robot's link dimensions, masses and drives, and the
    task's need, are not part of it.
    """
    digests = {path: images.sha256(path) for path in sorted({view.image for view in views} - {""})}
    facts: dict[str, object] = {
        "document": _without_paths(document),
        "target": target_document,
        "robot": None if robot_document is None else _robots(document, robot_document),
        "columns": columns,
        # Values of numbers, independent of their spelling.
        "rows": [
            [
                view.numbers[column] if column in view.numbers else view.cell(column)
                for column in columns
            ]
            for view in views
        ],
        "images": {path: digest for path, digest in digests.items() if digest},
    }
    if streams:
        facts["streams"] = {name: stream.fact() for name, stream in streams.items()}
    if corners is not None:
        facts["corners"] = corners.fact()
    return sha256(json.dumps(_canonical(facts), sort_keys=True).encode())


def is_file(name: object) -> bool:
    """Whether a name is a path, not a built-in name."""
    return isinstance(name, str) and name.lower().endswith(ROBOT_SUFFIXES)


def _without_paths(document: Mapping[str, object]) -> dict[str, object]:
    """The document without the paths of target and robot files, and without the need."""
    kept = {name: value for name, value in document.items() if name != "need"}
    if is_file(kept.get("target")):
        del kept["target"]
    targets = kept.get("targets")
    if isinstance(targets, Mapping):
        kept["targets"] = {name: _pathless(entry, "target") for name, entry in targets.items()}
    robot = kept.get("robot")
    if isinstance(robot, Mapping) and is_file(robot.get("model")):
        kept["robot"] = {key: value for key, value in robot.items() if key != "model"}
    robots = kept.get("robots")
    if isinstance(robots, Mapping):
        kept["robots"] = {name: _pathless(entry, "model") for name, entry in robots.items()}
    return kept


def _robots(
    document: Mapping[str, object], robot_document: Mapping[str, object]
) -> dict[str, object]:
    """The robot's model, or several by name."""
    several = document.get("robots")
    if not isinstance(several, Mapping) or len(several) < 2:
        return _without_bodies(robot_document)
    models = robot_document.items()
    return {name: _without_bodies(value) for name, value in models if isinstance(value, Mapping)}


def _without_bodies(document: Mapping[str, object]) -> dict[str, object]:
    """A robot's document without dimensions, masses and drives of the links."""
    joints = document.get("joint")
    if not isinstance(joints, list | tuple):
        return dict(document)
    kept = [
        {key: value for key, value in joint.items() if key not in LINK_KEYS}
        if isinstance(joint, Mapping)
        else joint
        for joint in joints
    ]
    return {**document, "joint": kept}


def _pathless(entry: object, field: str) -> object:
    """Entry of one of several targets or robots without its path."""
    table = {field: entry} if isinstance(entry, str) else entry
    if isinstance(table, Mapping) and is_file(table.get(field)):
        return {key: value for key, value in table.items() if key != field}
    return table


def _canonical(value: object) -> object:
    """Canonical form: equal for 1 and 1.0, lists and tuples, -0.0 and 0.0; dates as text."""
    if isinstance(value, Mapping):
        return {str(key): _canonical(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(entry) for entry in value]
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        # Adding zero turns -0.0 into 0.0; integers beyond a double's range keep their digits.
        return float(value) + 0.0 if abs(value) < 1e300 else str(value)
    return value.isoformat() if isinstance(value, date | time) else str(value)
