"""Camera, robot, target and instrument of each row, and the robots' models.

Boards and robots are shared between sessions, so files that session.toml names may be outside of
the session's folder. Since a session may be untrusted, a warning names each such file, and its
errors are reported without its content.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from visioncal.core.errors import DataError
from visioncal.core.files import absence, is_inside
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.robot import ROBOT_SUFFIXES, Robot, read_robot_document
from visioncal.session.columns import POSITION
from visioncal.session.document import KINDS, Declaration, Kind
from visioncal.session.table import View
from visioncal.session.tables import RobotTable

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
        _check_kind(declaration, kind, views)


def _check_kind(declaration: Declaration, kind: Kind, views: Sequence[View]) -> None:
    plural = f"{kind}s"
    named = {view.number: view.text.get(kind, "").strip() for view in views}
    declared = list(declaration.named(kind))
    if declared in ([], [""]):
        _check_single(kind, bool(declared), sorted({name for name in named.values() if name}))
        return
    known = ", ".join(declared)
    unknown = {view: name for view, name in named.items() if name and name not in declared}
    if unknown:
        view, name = next(iter(unknown.items()))
        others = len(unknown) - 1
        raise DataError(
            f"views.csv, view {view}, column {kind}: {name!r} is not declared; session.toml "
            f"declares {known}{f' ({others} more such rows)' if others else ''}.",
            culprits=[f"views.csv: view {index}" for index in unknown],
            next_step=did_you_mean(name, declared) or f"Add [{plural}.{name}], or correct the row.",
        )
    if len(declared) < 2:
        return
    needs, whose, hint = _NAMING_RULES[kind]
    without = [str(view.number) for view in views if needs(view) and not named[view.number]]
    if without:
        raise DataError(
            f"views.csv: of several {plural} ({known}), the column {kind} must name {whose}; it "
            f"is empty in view {some_of(without)}.",
            culprits=[f"views.csv: view {name}" for name in without],
            next_step=f"Name the {kind} in each of these rows{hint}.",
        )


def _check_single(kind: Kind, is_declared: bool, names: Sequence[str]) -> None:
    """Checks that rows have only one name for a kind that is not in a plural table."""
    if len(names) < 2:
        return
    tables = ", ".join(f"[{kind}s.{name}]" for name in names)
    of_target = ", each with target = a name or a path" if kind == "target" else ""
    raise DataError(
        f"views.csv, column {kind}: it names {', '.join(names)}, but session.toml "
        f"{f'has the one {kind} for all' if is_declared else 'declares none'}.",
        culprits=[f"session.toml: {kind}s"],
        next_step=f"Declare {tables}{of_target}.",
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
    several = len(declaration.robots) > 1
    if document is not None:
        return document, []
    models, problems = {}, []
    for name, table in declaration.named("robot").items():
        if not isinstance(table, RobotTable) or table.model is None:
            continue
        try:
            models[name] = _read_robot(table, table.model, folder)
        except DataError as error:
            path = f"robots.{name}" if name else "robot"
            problems.append(f"session.toml: {path}.model: {error}")
    if several:
        return models or None, problems
    return next(iter(models.values()), None), problems


def _read_robot(table: RobotTable, model: str, folder: Path | None) -> dict[str, Any]:
    with without_content(model, "model", folder):
        document = read_robot_document(model, tip=table.tip, folder=folder)
        if outside_file(model, "model", folder) is not None:
            # Recordings contain only valid robots.
            Robot.from_document(document)
    if table.gravity_m_s2 is not None:
        document |= {"gravity_m_s2": table.gravity_m_s2}
    return document


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
    places: list[tuple[str, str]] = []
    fields: tuple[tuple[Kind, str], ...] = (("target", "target"), ("robot", "model"))
    for kind, field in fields:
        for table in declaration.named(kind).values():
            named = getattr(table, field)
            if named is not None:
                places.append((named, field))
    for named, field in dict.fromkeys(places):
        file = outside_file(named, field, folder)
        if file is not None and not absence(file):
            yield (
                f"session.toml: {field} = {named!r} lies outside of the session's folder: {file} "
                "was read."
            )
