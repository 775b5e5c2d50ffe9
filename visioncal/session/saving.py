"""Atomic writing of a session as a self-contained folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.temporary_files import temporary_folder
from visioncal.robot import robot_file
from visioncal.session.digest import is_file
from visioncal.session.document import Declaration
from visioncal.session.images import ImageStore, inside_path
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
