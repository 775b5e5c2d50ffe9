"""Camera, robot, target and instrument of each row, and their files; a table of known instruments.

Boards and robots are shared between sessions, so files that session.toml names may be outside of
the session's folder, and a warning names each of them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from visioncal.core.documents.toml import parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import absence, is_inside, read_text
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray, Target
from visioncal.robot.files import ROBOT_SUFFIXES, read_robot_document
from visioncal.session.columns import POSITION
from visioncal.session.document import KINDS, Declaration, InstrumentTable, Kind, RobotTable
from visioncal.session.table import View
from visioncal.vision.targets import misspelt_keys, read_target, target_from_document

_FILE = Path(__file__).with_name("instruments.toml")


@dataclass(frozen=True)
class Instrument:
    """Noise of an instrument's readings, as standard deviations."""

    sigma_m: float  # Of each coordinate of a position, at the instrument's origin [m].
    sigma_per_m: float = 0.0  # Its growth with the distance from there [m/m].
    # Of a probe's rotation about each axis; None where unknown [rad].
    sigma_rad: float | None = None
    words: str = ""  # Its description, or its name.

    def sigmas_m(self, places: FloatArray) -> FloatArray:
        """Standard deviations (m,) of each coordinate of (m, 3) measured positions [m]."""
        distance = np.linalg.norm(places, axis=-1)
        return np.asarray(self.sigma_m + self.sigma_per_m * distance)


@cache
def known_instruments() -> Mapping[str, Instrument]:
    """The table of known instruments, by name."""
    rows = parse_toml(read_text(_FILE), _FILE.name)["instrument"]
    return {row.pop("name"): Instrument(**row) for row in rows}


def stated_instrument(table: InstrumentTable) -> Instrument:
    """Instrument of a session: stated values, with those of a known one for the others.

    Raises:
        DataError: The name is unknown and no noise is stated.
    """
    known = known_instruments()
    name = table.name.strip().lower()
    values = vars(known[name]) if name in known else {"words": table.name}
    stated = {key: getattr(table, key) for key in ("sigma_m", "sigma_per_m", "sigma_rad")}
    values = values | {key: value for key, value in stated.items() if value is not None}
    if "sigma_m" not in values:
        raise DataError(
            f"session.toml: the instrument {table.name!r} is not in the table of known ones, and "
            "its noise is not stated.",
            culprits=["session.toml: instrument"],
            next_step=f"{did_you_mean(table.name, known)} State sigma_m (and sigma_per_m) in "
            f"[instrument], or name one of {', '.join(sorted(known))}.".strip(),
        )
    return Instrument(**values)


_Test: TypeAlias = Callable[[View], bool]


def is_camera_observation(view: View) -> bool:
    """Whether a row is a camera's observation: an image, corners of one, or a measured pose."""
    return bool(view.image) or view.has_corners or "cft_x_m" in view.numbers


def has_robot_state(view: View) -> bool:
    """Whether a row has a robot's pose or joints."""
    return POSITION[0] in view.numbers or "q1_rad" in view.numbers


def is_instrument_reading(view: View) -> bool:
    """Whether a row is an instrument's reading."""
    return view.reading_m is not None


# By kind: which rows must name one of several, and what the column names.
_NAMING_RULES: Mapping[Kind, tuple[_Test, str]] = {
    "camera": (is_camera_observation, "the one that took a row's image"),
    "robot": (has_robot_state, "the one whose pose or joints a row has"),
    "target": (
        is_camera_observation,
        "the one that a row shows (of several in one image, each in a row of the same stop)",
    ),
    "instrument": (is_instrument_reading, "the one that read a row's meas_ columns"),
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
        is_plain = declared in ([], [""])
        names = sorted({*named.values()} - {""})
        needs, needed_rows = _NAMING_RULES[kind]
        # A column of one name beside a singular table is no matter.
        unknown = [name for name in names if name not in declared] if len(names) > is_plain else []
        if unknown:
            rows = [str(view) for view, name in named.items() if name in unknown]
            has = "the one for all" if is_plain and declared else ", ".join(declared) or "none"
            raise DataError(
                f"views.csv, column {kind}: it names {', '.join(unknown)} in view {some_of(rows)}, "
                f"but of {kind}s session.toml declares {has}.",
                culprits=[f"session.toml: {kind}s", *(f"views.csv: view {row}" for row in rows)],
                next_step=did_you_mean(unknown[0], declared)
                or f"Declare {', '.join(f'[{kind}s.{name}]' for name in unknown)}"
                f"{', each with target = a name or a path' * (kind == 'target')}, or correct the "
                "rows.",
            )
        without = [str(row.number) for row in views if needs(row) and not named[row.number]]
        if len(declared) > 1 and without:
            raise DataError(
                f"views.csv: of several {kind}s ({', '.join(declared)}), the column {kind} must "
                f"name {needed_rows}; it is empty in view {some_of(without)}.",
                culprits=[f"views.csv: view {name}" for name in without],
                next_step=f"Name the {kind} in each of these rows.",
            )


def target_warnings(
    declaration: Declaration, document: Mapping[str, Any] | None
) -> Iterator[tuple[str, str]]:
    """Warnings of misspelt keys in the targets' descriptions, see `read_targets`; and files."""
    for name, path in (paths := declared_targets(declaration)).items():
        described = document if len(paths) == 1 else (document or {}).get(name)
        for words in misspelt_keys(described or {}):
            yield f"{path}: {words}", path


def is_file(name: object) -> bool:
    """Whether the name of a target or a robot is a path, not a built-in name."""
    return isinstance(name, str) and name.lower().endswith((*ROBOT_SUFFIXES, ".yaml", ".yml"))


def outside_notes(declaration: Declaration, folder: Path | None) -> Iterator[str]:
    """Notes that name the files outside of the folder that were read."""
    if folder is None:
        return
    named = [(path, "target") for path in declared_targets(declaration).values()]
    robots = declaration.named("robot").values()
    named += [(getattr(table, "model", None) or "", "model") for table in robots]
    for path, key in dict.fromkeys(named):
        file = folder / path.replace("\\", "/")
        if is_file(path) and not absence(file) and not is_inside(file, folder):
            yield (
                f"session.toml: {key} = {path!r} lies outside of the session's folder: "
                f"{file.resolve()} was read."
            )


def read_robots(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[Mapping[str, Any] | None, list[str]]:
    """Models of the declared robots, of several by name, and messages for what cannot be read.

    Relative paths are below the folder or, where None, the working directory; `document` has the
    models in the same form, if they are read already.
    """
    if document is not None:
        return document, []
    models, problems = {}, []
    for name, table in declaration.named("robot").items():
        if not isinstance(table, RobotTable) or table.model is None:
            continue
        try:
            model = read_robot_document(table.model, tip=table.tip, folder=folder)
        except DataError as error:
            path = f"robots.{name}" if name else "robot"
            problems.append(f"session.toml: {path}.model: {error}")
        else:
            gravity = table.gravity_m_s2
            models[name] = model if gravity is None else model | {"gravity_m_s2": gravity}
    if len(declaration.robots) > 1:
        return models or None, problems
    return next(iter(models.values()), None), problems


# The column of views.csv that names the target of a row.
COLUMN = "target"


def read_targets(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[dict[str, Target], Mapping[str, Any] | None]:
    """Declared targets by name, empty for the only one, and their document, of several by name.

    Relative paths are below the folder or, where None, the working directory; `document` has the
    contents in the same form, if they are read already. Raises DataError.
    """
    paths = declared_targets(declaration)
    is_only = len(paths) == 1
    given = dict.fromkeys(paths, document) if is_only and document is not None else document
    targets: dict[str, Target] = {}
    contents: dict[str, Mapping[str, Any]] = {}
    for name, path in paths.items():
        if given is None:
            targets[name], contents[name] = read_target(path, folder)
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


def declared_targets(declaration: Declaration) -> dict[str, str]:
    """Built-in names or paths of the targets, by their names in rows."""
    if declaration.target is not None:
        return {"": declaration.target}
    return {name: table.target for name, table in declaration.targets.items()}


def check_images_can_be_used(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks that target and camera are declared where a view has an image; raises DataError."""
    view = next((view for view in views if view.image or view.has_corners), None)
    examples: tuple[tuple[Kind, str], ...] = (
        ("target", 'target = "charuco_9x6_30mm", or the name or .toml of your board'),
        ("camera", "[camera]"),
    )
    for kind, example in examples:
        if view is not None and not declaration.named(kind):
            near = get_close_matches(kind, declaration.further, 1)
            raise DataError(
                f"session.toml: {kind} is missing, but view {view.number} has "
                f"{'an image' if view.image else 'rows in corners.csv'}.",
                culprits=[f"session.toml: {kind}"],
                next_step=f"Write {kind} for {near[0]}." if near else f"Add {example}.",
            )
