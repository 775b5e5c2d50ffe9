"""Storage of a session: atomic writing as a self-contained folder, and digest of its content."""

import json
from collections.abc import Mapping
from datetime import date, time
from pathlib import Path
from typing import Any

import tomli_w

from visioncal.core.codec import write
from visioncal.core.errors import DataError
from visioncal.core.files import named_errors, sha256, write_atomically
from visioncal.core.temporary import temporary
from visioncal.robot.files import robot_file
from visioncal.robot.model import LINK_KEYS
from visioncal.session.content import SessionContent
from visioncal.session.corners import FILE as CORNERS
from visioncal.session.corners import write_corners
from visioncal.session.document import Kind
from visioncal.session.images import inside_path
from visioncal.session.kinds import is_file
from visioncal.session.streams import FOLDER as STREAMS
from visioncal.session.streams import write_stream
from visioncal.session.table import write_csv
from visioncal.vision.targets import stored_target


def refuse_filled(folder: Path, more: str = "") -> None:
    """Checks that a session can be written to a folder; raises DataError, with a further step."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(
            f"{folder} exists and is not empty; a session is written to a new folder.",
            culprits=[str(folder)],
            next_step=f"Choose another name, or remove it first{more}.",
        )


def save_session(session: SessionContent, folder: Path) -> None:
    """Writes a session atomically; see `Session.save`."""
    folder = folder.absolute()
    document, texts = _placed_files(session)
    texts["session.toml"] = tomli_w.dumps(document)
    if session.views or not session.streams:
        texts["views.csv"] = write_csv(session.columns, session.views)
    if session.corner_table is not None:
        texts[CORNERS] = write_corners(session.corner_table)
    for name, stream in session.streams.items():
        texts[f"{STREAMS}/{name}.csv"] = write_stream(stream)
    images = session.images
    refuse_filled(folder)
    with named_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with temporary(folder.parent, is_folder=True) as (aside, _):
            new = aside / "new"
            new.mkdir()
            for path in dict.fromkeys(path for view in session.views for path in view.files):
                # Reading fails for an image of which only the digest is available.
                if images.exists(path) or images.sha256(path):
                    _write_below(new, path, images.read(path))
            for path, text in texts.items():
                _write_below(new, path, text)
            if folder.exists():
                folder.rmdir()
            new.replace(folder)


def _write_below(folder: Path, path: str, data: bytes | str) -> None:
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / path, data)


def _placed_files(session: SessionContent) -> tuple[dict[str, Any], dict[str, str | bytes]]:
    """Moves target and robot files into the session's folder."""
    declaration, placed, texts = (
        session.declaration,
        dict(session.document),
        dict[str, str | bytes](),
    )
    stored: tuple[tuple[Kind, str, Mapping[str, Any] | None], ...] = (
        ("target", "target", session.target_document),
        ("robot", "model", session.robot_document),
    )
    for kind, field, documents in stored:
        several = len(getattr(declaration, f"{kind}s")) > 1
        for name, table in declaration.named(kind).items():
            stated, tables = getattr(table, field), dict[str, str | bytes]()
            described = (documents or {}).get(name) if several else documents
            if described is None or not is_file(stated):
                continue
            if kind == "target":
                toml = f"{stated.rpartition('.')[0]}.toml"
                path = _place_inside(toml, f"target_{name}.toml" if name else "target.toml")
                content, tables = stored_target(described, Path(path).stem)
                text = tomli_w.dumps(content)
            else:
                file, text = robot_file(described, stated)
                path = _place_inside(stated, f"{name}_{file}" if name else file)
            texts |= {str(Path(path).with_name(table)): rows for table, rows in tables.items()}
            texts[path] = text
            if name:
                kept = {**write(type(table), table), field: path}
                placed[f"{kind}s"] = {**placed[f"{kind}s"], name: kept}
            else:
                placed[kind] = path if kind == "target" else {**placed[kind], field: path}
    return placed, texts


def _place_inside(path: str, fallback: str) -> str:
    """A path if it is inside the session's folder, else `fallback`."""
    try:
        return inside_path(path)
    except DataError:
        return fallback


def digest_of(session: SessionContent) -> str:
    """Computes the SHA-256 digest of a session's canonical content; see `Session.digest`.

    The robot's link dimensions, masses and drives, the form of poses of its results,
    and the task's need are not part of it.
    """
    paths = sorted({path for view in session.views for path in view.files})
    digests = {path: session.images.sha256(path) for path in paths}
    document = {name: value for name, value in session.document.items() if name != "need"}
    if is_file(document.get("target")):
        del document["target"]
    if "robot" in document and document["robot"].keys() != {"form"}:
        document["robot"] = _pathless(document["robot"], "model")
    else:
        document.pop("robot", None)
    for kind, field in (("targets", "target"), ("robots", "model")):
        several = document.get(kind)
        if isinstance(several, Mapping):
            document[kind] = {name: _pathless(entry, field) for name, entry in several.items()}
    robots, models = document.get("robots"), session.robot_document
    if models is not None and isinstance(robots, Mapping) and len(robots) > 1:
        items = models.items()
        models = {name: _without_bodies(one) for name, one in items if isinstance(one, Mapping)}
    elif models is not None:
        models = _without_bodies(models)
    facts: dict[str, object] = {
        "document": document,
        "target": session.target_document,
        "robot": models,
        "columns": session.columns,
        # Values of numbers, independent of their spelling.
        "rows": [
            [
                view.numbers[column] if column in view.numbers else view.cell(column)
                for column in session.columns
            ]
            for view in session.views
        ],
        "images": {path: digest for path, digest in digests.items() if digest},
    }
    if session.streams:
        facts["streams"] = {name: stream.fact() for name, stream in session.streams.items()}
    if session.corner_table is not None:
        facts["corners"] = session.corner_table.fact()
    return sha256(json.dumps(_canonical(facts), sort_keys=True).encode())


def _without_bodies(document: Mapping[str, object]) -> dict[str, object]:
    """A robot's document without dimensions, masses and drives of the links."""
    if "urdf" in document:
        # The name is that of its file, and not of its content.
        return {**document, "name": "robot"}
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
    """Entry of one of several targets or robots without its path, and a robot's form of poses."""
    table = {field: entry} if isinstance(entry, str) else entry
    if isinstance(table, Mapping):
        dropped = {"form", *({field} if is_file(table.get(field)) else ())}
        return {key: value for key, value in table.items() if key not in dropped}
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
