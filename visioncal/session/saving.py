"""Atomic writing of a session as a self-contained folder."""

import json
from collections.abc import Mapping, Sequence
from datetime import date, time
from pathlib import Path
from typing import Any

import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import sha256, temporary_folder, write_atomically
from visioncal.robot import LINK_KEYS, ROBOT_SUFFIXES, robot_file
from visioncal.session.corners import CornerTable
from visioncal.session.document import Declaration
from visioncal.session.images import ImageStore, inside_path
from visioncal.session.streams import Stream
from visioncal.session.table import View
from visioncal.vision.targets import rig_csv


def refuse_filled(folder: Path) -> None:
    """Checks that a session can be written to a folder.

    Raises:
        DataError: It exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(
            f"{folder} exists and is not empty; a session is written to a new folder.",
            culprits=[str(folder)],
            next_step="Choose another name, or remove it first.",
        )


def write_folder(
    folder: Path, texts: Mapping[str, str], images: ImageStore, paths: Sequence[str]
) -> None:
    """Writes texts by path, and images that are not missing, into a new or empty folder.

    Raises:
        DataError: The folder exists and is not empty, or cannot be written; or only the digest of
            an image is available.
    """
    folder = folder.absolute()
    refuse_filled(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(folder.parent) as (aside, _):
            new = aside / "new"
            new.mkdir()
            for path in paths:
                # Reading fails for an image of which only the digest is available.
                if images.exists(path) or images.sha256(path):
                    _write_below(new, path, images.read(path))
            for path, text in texts.items():
                _write_below(new, path, text)
            if folder.exists():
                folder.rmdir()
            new.replace(folder)
    except OSError as error:
        raise DataError(
            f"{folder} cannot be written: {error.strerror or error}.", culprits=[str(folder)]
        ) from error


def placed_files(
    declaration: Declaration,
    document: Mapping[str, Any],
    target_document: Mapping[str, Any] | None,
    robot_document: Mapping[str, Any] | None,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Moves target and robot files into the session's folder.

    Returns:
        The content of session.toml with paths in the folder, and the files' texts by these paths.
        Built-in names are kept.
    """
    placed = dict(document)
    texts = {} if target_document is None else _place_targets(declaration, placed, target_document)
    if robot_document is not None:
        texts |= _place_robots(declaration, placed, robot_document)
    return placed, texts


def _place_targets(
    declaration: Declaration, document: dict[str, Any], contents: Mapping[str, Any]
) -> dict[str, str]:
    if is_file(declaration.target):
        document["target"] = _place_inside(str(declaration.target), "target.toml")
        return _target_texts(document["target"], contents)
    texts: dict[str, str] = {}
    several = len(declaration.targets) > 1
    for name, table in declaration.targets.items():
        if is_file(table.target):
            path = _place_inside(table.target, f"target_{name}.toml")
            kept = {**table.model_dump(), "target": path}
            document["targets"] = {**document["targets"], name: kept}
            texts |= _target_texts(path, contents[name] if several else contents)
    return texts


def _target_texts(path: str, content: Mapping[str, Any]) -> dict[str, str]:
    """Text of a target's file, and of the table of a rig's points, by path."""
    points = content.get("points")
    if content.get("kind") != "points" or not isinstance(points, Mapping):
        return {path: tomli_w.dumps(content)}
    table = Path(path).with_suffix(".points.csv")
    return {
        path: tomli_w.dumps({**content, "points": table.name}),
        table.as_posix(): rig_csv(points),
    }


def _place_robots(
    declaration: Declaration, document: dict[str, Any], contents: Mapping[str, Any]
) -> dict[str, str]:
    only = declaration.robot
    if only is not None and only.model is not None and is_file(only.model):
        name, content = robot_file(contents, only.model)
        model = _place_inside(only.model, name)
        document["robot"] = {**document["robot"], "model": model}
        return {model: content}
    texts, several = {}, len(declaration.robots) > 1
    for robot, table in declaration.robots.items():
        model_document = contents.get(robot) if several else contents
        if table.model is not None and is_file(table.model) and model_document is not None:
            name, content = robot_file(model_document, table.model)
            path = _place_inside(table.model, f"{robot}_{name}")
            kept = {**table.model_dump(exclude_none=True), "model": path}
            document["robots"] = {**document["robots"], robot: kept}
            texts[path] = content
    return texts


def _place_inside(path: str, fallback: str) -> str:
    """A path if it is inside the session's folder, else `fallback`."""
    try:
        return inside_path(path)
    except DataError:
        return fallback


def _write_below(folder: Path, path: str, data: bytes | str) -> None:
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / path, data)


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
    facts: dict[str, object] = {
        "document": kept,
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
