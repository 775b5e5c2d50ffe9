"""Camera, robot, target and instrument of each row, and their files; a table of known instruments.

Boards and robots are shared between sessions, so files that session.toml names may be outside of
the session's folder. Since a session may be untrusted, a warning names each such file, and its
errors are reported without its content.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, absence, is_inside, parse_toml, read_text
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray, Target
from visioncal.core.verdict import READ_AGAIN
from visioncal.robot import ROBOT_SUFFIXES, Robot, read_robot_document
from visioncal.session.columns import POSITION
from visioncal.session.document import KINDS, Declaration, Kind, RobotTable
from visioncal.session.table import View
from visioncal.vision.targets import misspelt_keys, read_target, target_from_document

_FILE = Path(__file__).with_name("instruments.toml")


@dataclass(frozen=True)
class Instrument:
    """Noise of an instrument's readings, as standard deviations."""

    words: str  # Description of the instrument.
    sigma_m: float  # Of each coordinate of a position, at the instrument's origin [m].
    sigma_per_m: float = 0.0  # Its growth with the distance from there [m/m].
    # Of a probe's rotation about each axis; None where unknown [rad].
    sigma_rad: float | None = None

    def sigmas_m(self, places: FloatArray) -> FloatArray:
        """Standard deviations (m,) of each coordinate of (m, 3) measured positions [m]."""
        distance = np.linalg.norm(places, axis=-1)
        return np.asarray(self.sigma_m + self.sigma_per_m * distance)


def instrument_names() -> tuple[str, ...]:
    """Names of the instruments in the table."""
    return tuple(sorted(_table()))


def known_instrument(name: str) -> Instrument | None:
    """Finds an instrument in the table; None where it is not there.

    Raises:
        DataError: It measures only lengths or angles, no positions.
    """
    row = _table().get(name.strip().lower())
    if row is None:
        return None
    words = row.text("words")
    if "measures" in row.content:
        raise DataError(
            f"instrument {name!r}: the {words} measures {row.text('measures')}; readings of "
            "places (meas_x_m, meas_y_m, meas_z_m) are needed.",
            culprits=["session.toml: instrument.name"],
        )
    return Instrument(
        words,
        row.number("sigma_m"),
        row.number("sigma_per_m", 0.0),
        row.number("sigma_rad") if "sigma_rad" in row.content else None,
    )


def stated_instrument(
    name: str, sigma_m: float | None, sigma_per_m: float | None, sigma_rad: float | None
) -> Instrument:
    """Instrument of a session: stated values, with those of the table for the others.

    Raises:
        DataError: The name is unknown and no noise is stated.
    """
    in_table = known_instrument(name)
    if sigma_m is None and in_table is None:
        raise DataError(
            f"session.toml: the instrument {name!r} is not in the table of known ones, and its "
            "noise is not stated.",
            culprits=["session.toml: instrument"],
            next_step=f"{did_you_mean(name, instrument_names())} State sigma_m (and sigma_per_m) "
            f"in [instrument], or name one of {', '.join(instrument_names())}.".strip(),
        )
    base = Instrument(name, 0.0) if in_table is None else in_table
    return Instrument(
        base.words,
        base.sigma_m if sigma_m is None else sigma_m,
        base.sigma_per_m if sigma_per_m is None else sigma_per_m,
        base.sigma_rad if sigma_rad is None else sigma_rad,
    )


@cache
def _table() -> Mapping[str, DocumentTable]:
    rows = parse_toml(read_text(_FILE), _FILE.name)["instrument"]
    return {row["name"]: DocumentTable(row, f"{_FILE.name}, {row['name']}") for row in rows}


_Test: TypeAlias = Callable[[View], bool]

_SUFFIXES = {"target": (".toml",), "model": ROBOT_SUFFIXES}


def is_camera_observation(view: View) -> bool:
    """Whether a row is a camera's observation: an image, corners of one, or a measured pose."""
    return bool(view.image) or view.has_corners or "cft_x_m" in view.numbers


def has_robot_state(view: View) -> bool:
    """Whether a row has a robot's pose or joints."""
    return POSITION[0] in view.numbers or "q1_rad" in view.numbers


def is_instrument_reading(view: View) -> bool:
    """Whether a row is an instrument's reading."""
    return view.reading_m is not None


# By kind: which rows must name one of several, what the column names, and a hint for the remedy.
_NAMING_RULES: Mapping[Kind, tuple[_Test, str, str]] = {
    "camera": (is_camera_observation, "the one that took a row's image", ""),
    "robot": (has_robot_state, "the one whose pose or joints a row has", ""),
    "target": (
        is_camera_observation,
        "the one that a row shows",
        "; one image that shows several takes a row for each, with the same stop",
    ),
    "instrument": (is_instrument_reading, "the one that read a row's meas_ columns", ""),
}


def name_of(declaration: Declaration, kind: Kind, view: View) -> str:
    """Name of a row's camera, robot, target or instrument in session.toml.

    Empty for a singular table, and where the row names none of several.
    """
    names = list(declaration.named(kind))
    if len(names) == 1:
        return names[0]
    return view.text.get(kind, "").strip() if names else ""


def check_kinds_named(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks that rows name the cameras, robots, targets and instruments that are declared.

    Raises:
        DataError: A row names none of several, or one that is not declared.
    """
    for kind in KINDS:
        named = {view.number: view.text.get(kind, "").strip() for view in views}
        declared = list(declaration.named(kind))
        if declared in ([], [""]):
            names = sorted({*named.values()} - {""})
            if len(names) > 1:
                tables = ", ".join(f"[{kind}s.{name}]" for name in names)
                of_target = ", each with target = a name or a path" if kind == "target" else ""
                raise DataError(
                    f"views.csv, column {kind}: it names {', '.join(names)}, but session.toml "
                    f"{f'has the one {kind} for all' if bool(declared) else 'declares none'}.",
                    culprits=[f"session.toml: {kind}s"],
                    next_step=f"Declare {tables}{of_target}.",
                )
            continue
        known = ", ".join(declared)
        unknown = {view: name for view, name in named.items() if name and name not in declared}
        if unknown:
            view, name = next(iter(unknown.items()))
            raise DataError(
                f"views.csv, view {view}, column {kind}: {name!r} is not declared; session.toml "
                f"declares {known}.",
                culprits=[f"views.csv: view {index}" for index in unknown],
                next_step=did_you_mean(name, declared)
                or f"Add [{kind}s.{name}], or correct the row.",
            )
        needs, whose, hint = _NAMING_RULES[kind]
        without = [str(row.number) for row in views if needs(row) and not named[row.number]]
        if len(declared) > 1 and without:
            raise DataError(
                f"views.csv: of several {kind}s ({known}), the column {kind} must name {whose}; it "
                f"is empty in view {some_of(without)}.",
                culprits=[f"views.csv: view {name}" for name in without],
                next_step=f"Name the {kind} in each of these rows{hint}.",
            )


def kind_warnings(declaration: Declaration, views: Sequence[View]) -> Iterator[str]:
    """Warnings of declared cameras, robots, targets and instruments that no row names."""
    for kind in KINDS:
        declared = declaration.named(kind)
        named = {view.text.get(kind, "").strip() for view in views}
        for name in declared if len(declared) > 1 else ():
            if name not in named:
                yield f"session.toml: {kind}s.{name}: no row of views.csv names it."


def read_robots(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[Mapping[str, Any] | None, list[str]]:
    """Reads the models of the robots that a session declares.

    Args:
        declaration: The typed session.toml.
        folder: Base of relative paths; the working directory where None.
        document: Content of the robot's file, if already read; with several robots, contents by
            name.

    Returns:
        The model, with several robots the models by name, or None; and messages for models that
        could not be read.
    """
    if document is not None:
        return document, []
    models, problems = {}, []
    for name, table in declaration.named("robot").items():
        if not isinstance(table, RobotTable) or table.model is None:
            continue
        try:
            with without_content(table.model, "model", folder):
                model = read_robot_document(table.model, tip=table.tip, folder=folder)
                if outside_file(table.model, "model", folder) is not None:
                    # Recordings contain only valid robots.
                    Robot.from_document(model)
        except DataError as error:
            path = f"robots.{name}" if name else "robot"
            problems.append(f"session.toml: {path}.model: {error}")
        else:
            gravity = table.gravity_m_s2
            models[name] = model if gravity is None else model | {"gravity_m_s2": gravity}
    if len(declaration.robots) > 1:
        return models or None, problems
    return next(iter(models.values()), None), problems


@contextmanager
def without_content(named: str, field: str, folder: Path | None) -> Iterator[None]:
    """Removes the content of a file outside of the folder from the errors of reading it.

    Args:
        named: The file, as session.toml names it; built-in names are no files.
        field: The field that names it: `target` or `model`.
        folder: The session's folder; None where it has none.

    Raises:
        DataError: Instead of the errors of reading it, or it is a link to another kind of file.
    """
    file = outside_file(named, field, folder)
    if file is None or absence(file):
        yield
        return
    refusal = DataError(
        f"{file}, outside of the session's folder, is no {field} that can be read.",
        culprits=[f"session.toml: {field}"],
        next_step="Copy it into the session's folder: then the message says what is wrong with it.",
    )
    if file.suffix.lower() not in _SUFFIXES[field]:
        raise refusal
    try:
        yield
    except DataError as error:
        raise refusal from error


def outside_file(named: str, field: str, folder: Path | None) -> Path | None:
    """The file outside of the folder that a field names; None for any other."""
    if folder is None or not named.lower().endswith(_SUFFIXES[field]):
        return None
    path = folder / named.replace("\\", "/")
    try:
        return None if is_inside(path, folder) else path.resolve()
    except (OSError, ValueError, RuntimeError):
        return path


def outside_warnings(declaration: Declaration, folder: Path | None) -> Iterator[str]:
    """Warnings that name the files outside of the folder that were read."""
    fields: tuple[tuple[Kind, str], ...] = (("target", "target"), ("robot", "model"))
    places = dict.fromkeys(
        (getattr(table, field), field)
        for kind, field in fields
        for table in declaration.named(kind).values()
        if getattr(table, field) is not None
    )
    for named, field in places:
        file = outside_file(named, field, folder)
        if file is not None and not absence(file):
            yield (
                f"session.toml: {field} = {named!r} lies outside of the session's folder: {file} "
                "was read."
            )


# The column of views.csv that names the target of a row.
COLUMN = "target"


def read_targets(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[dict[str, Target], Mapping[str, Any] | None]:
    """Reads the targets that a session declares.

    Args:
        declaration: The typed session.toml.
        folder: Base of relative paths; the working directory where None.
        document: Content of the target's file, if already read; with several targets, contents by
            name.

    Returns:
        The targets by name, which is empty for the only one, and their document in the form of the
        argument; None without targets.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    paths = _declared_targets(declaration)
    is_only = len(paths) == 1
    given = dict.fromkeys(paths, document) if is_only and document is not None else document
    targets: dict[str, Target] = {}
    contents: dict[str, Mapping[str, Any]] = {}
    for name, path in paths.items():
        if given is None:
            targets[name], contents[name] = _load(path, folder)
        elif name in given:
            contents[name] = given[name]
            targets[name] = target_from_document(contents[name], Path(path).stem)
        else:
            raise DataError(
                f"session.toml: targets.{name}: its description is not among those given.",
                culprits=[f"session.toml: targets.{name}"],
            )
    if is_only:
        return {"": next(iter(targets.values()))}, next(iter(contents.values()))
    return (targets, contents) if paths else ({}, document)


def _load(path: str, folder: Path | None) -> tuple[Target, dict[str, Any]]:
    with without_content(path, "target", folder):
        try:
            return read_target(path, folder)
        except DataError as error:
            if "metres, such as" not in error.message:
                raise
            # All sizes in millimetres can be converted at once.
            raise type(error)(
                error.message, culprits=error.culprits, next_step=str(READ_AGAIN)
            ) from error


def target_warnings(declaration: Declaration, document: Mapping[str, Any] | None) -> Iterator[str]:
    """Warnings of misspelt keys in the targets' descriptions, in the form of `read_targets`."""
    for name, path in (paths := _declared_targets(declaration)).items():
        described = document if len(paths) == 1 else (document or {}).get(name)
        for words in misspelt_keys(described or {}):
            yield f"{path}: {words}"


def _declared_targets(declaration: Declaration) -> dict[str, str]:
    """Built-in names or paths of the targets, by their names in rows."""
    if declaration.target is not None:
        return {"": declaration.target}
    return {name: table.target for name, table in declaration.targets.items()}


def check_images_can_be_used(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks that target and camera are declared where there are images.

    Raises:
        DataError: One is not declared, and a view has an image or corners.
    """
    with_image = [view for view in views if view.image or view.has_corners]
    for field, declared, example in (
        (
            "target",
            declaration.target or declaration.targets or None,
            'target = "charuco_9x6_30mm", or the name or .toml of your board',
        ),
        ("camera", declaration.camera or declaration.cameras or None, "[camera]"),
    ):
        if with_image and declared is None:
            raise DataError(
                f"session.toml: {field} is missing, but view {with_image[0].number} has "
                f"{'an image' if with_image[0].image else 'rows in corners.csv'}.",
                culprits=[f"session.toml: {field}"],
                next_step=f"Add {example}.",
            )
