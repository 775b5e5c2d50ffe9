"""The fields of session.toml: their types, their ranges, and what is wrong when they are not."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError

from visioncal.errors import DataError
from visioncal.files import did_you_mean
from visioncal.types import CameraKind, CameraMount

Positive = Annotated[FiniteFloat, Field(gt=0)]
# Nobody knows a focal length better than the least of these, or worse than the largest [px].
PixelSigma = Annotated[FiniteFloat, Field(ge=1e-3, le=1e4)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0)]

_COEFFICIENTS: Mapping[str, tuple[int, ...]] = {"brown": (5, 8), "fisheye": (4,)}
_SEVERAL = ("cameras", "robots", "instruments")
# Names become parts of the names of frames: base_from_target_NAME.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_EDGES = ("flange_from_cam", "base_from_target", "base_from_cam", "flange_from_target")


class _TableModel(BaseModel):
    # Unknown keys are kept: a newer version, or the user, may have put them there.
    model_config = ConfigDict(extra="allow", strict=True, frozen=True)


class CameraTable(_TableModel):
    """`[camera]`. matrix: fx, fy, cx, cy [px]; resolution: width, height [px]."""

    name: str = "camera"
    resolution: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)] | None = None
    model: CameraKind = "brown"
    matrix: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)] | None = None
    distortion: list[FiniteFloat] | None = None
    intrinsics: Literal["auto", "hold", "refine"] = "auto"
    matrix_sigma_px: PixelSigma | None = None


class RobotTable(_TableModel):
    """`[robot]`. model: a built-in name, or the path of a .urdf, a DH .toml or an arm's .json.

    gravity_m_s2: its acceleration in the robot's base, for a base that does not stand upright.
    """

    model: str
    tip: str | None = None
    gravity_m_s2: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None


class InstrumentTable(_TableModel):
    """`[instrument]`. Standard deviations of its readings [m], [m/m], [rad]; see `instruments`."""

    name: str = "instrument"
    sigma_m: NotNegative | None = None
    sigma_per_m: NotNegative | None = None
    sigma_rad: NotNegative | None = None


class ClockTable(_TableModel):
    """`[clock]`. What the camera's stamps are ahead of the robot's [s]."""

    camera_minus_robot_s: FiniteFloat = 0.0


class PriorTable(_TableModel):
    """`[prior.EDGE]`. Measured components of an unknown edge and their standard deviation [m]."""

    x_m: FiniteFloat | None = None
    y_m: FiniteFloat | None = None
    z_m: FiniteFloat | None = None
    sigma_m: Positive


class TargetTable(_TableModel):
    """`[targets.NAME]`, one of several. target: a name in targets/, or the path of a .toml."""

    target: str


def _as_table(value: object) -> object:
    """Takes the short form `floor = "..."` for the table `[targets.floor]`."""
    return {"target": value} if isinstance(value, str) else value


class Declaration(_TableModel):
    """session.toml, typed. Unknown keys stay in `model_extra`."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    mount: CameraMount | None = None
    target: str | None = None
    targets: dict[str, Annotated[TargetTable, BeforeValidator(_as_table)]] = Field(
        default_factory=dict
    )
    camera: CameraTable | None = None
    robot: RobotTable | None = None
    instrument: InstrumentTable | None = None
    clock: ClockTable = ClockTable()
    prior: dict[str, PriorTable] = Field(default_factory=dict)


def read_declaration(
    document: Mapping[str, Any], label: str, *, observed: bool = True
) -> Declaration:
    """Checks the content of a session.toml.

    Args:
        document: The content, as TOML or JSON gives it.
        label: The file's name, for messages.
        observed: Whether there are views, which something observed.

    Raises:
        DataError: A field is missing, of another type, out of range, or contradicts another; the
            message names all of them by their dotted paths.
    """
    for plural in _SEVERAL:
        if plural in document:
            raise DataError(
                f"{label}: [{plural}.*] declares several {plural}; this version reads one of a "
                f"kind, as [{plural[:-1]}].",
                culprits=[f"{label}: {plural}"],
                next_step=f"Split the session into one for each of the {plural}.",
            )
    # Before the fields: those of another schema would be reported one by one, and wrongly.
    schema = document.get("schema")
    if schema is not None and schema != 1:
        raise DataError(
            f"{label}: schema is {schema!r}; this version reads schema 1.",
            culprits=[f"{label}: schema"],
            next_step="A newer visioncal may read it.",
        )
    try:
        declaration = Declaration.model_validate(dict(document))
    except ValidationError as error:
        problems = [(_dotted(entry["loc"]), _in_words(entry)) for entry in error.errors()]
    else:
        problems = list(_contradictions(declaration, observed))
    if problems:
        raise DataError(
            f"{label}: {'; '.join(f'{field} {words}' for field, words in problems)}.",
            culprits=[f"{label}: {field}" for field, _ in problems],
        )
    return declaration


def _dotted(location: Sequence[int | str]) -> str:
    """Writes a place in the document as a dotted path: `camera.matrix[2]`."""
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return path.removeprefix(".")


def _in_words(entry: Mapping[str, Any]) -> str:
    """Says what is wrong with a field, from an entry of pydantic's list of errors."""
    context = entry.get("ctx", {})
    needed = {
        "int_type": "a whole number",
        "float_type": "a number",
        "finite_number": "a finite number",
        "string_type": 'a "text"',
        "list_type": "a [list]",
        "dict_type": "a table",
        "model_type": "a table",
        "literal_error": str(context.get("expected")).replace("'", '"'),
        "greater_than": f"a number above {context.get('gt', 0):g}",
        "greater_than_equal": f"a number of at least {context.get('ge', 0):g}",
        "less_than_equal": f"a number of at most {context.get('le', 0):g}",
        "too_short": f"a list of {context.get('min_length')}",
        "too_long": f"a list of {context.get('max_length')}",
    }
    kind = str(entry["type"])
    if kind == "missing":
        return f"is missing{_MISSING.get(str(entry['loc'][-1]), '')}"
    return f"is {entry['input']!r}, but must be {needed.get(kind, kind)}"


_MISSING = {
    "schema": " (schema = 1)",
    "name": ' (name = "...")',
    "mount": ' (mount = "eye-in-hand" or "eye-to-hand")',
    "target": " (target = a name in targets/, or the path of a .toml)",
    "sigma_m": " (the standard deviation of the measured component)",
}


def _contradictions(declaration: Declaration, observed: bool) -> Iterator[tuple[str, str]]:
    """Finds fields that are well typed but do not fit together: (dotted path, words)."""
    camera = declaration.camera
    unseen = declaration.instrument is None and observed
    if declaration.mount is None and (unseen or camera is not None):
        yield "mount", "is missing" + _MISSING["mount"]
    if camera is not None:
        yield from _camera_contradictions(camera)
    if declaration.targets and declaration.target is not None:
        yield (
            "targets",
            "is there beside target: give target = ... for one, [targets.NAME] for several",
        )
    for name in declaration.targets:
        if not _NAME.fullmatch(name):
            yield f"targets.{name}", "is a name of other than letters, digits and _ after a letter"
    for edge, prior in declaration.prior.items():
        if prior.x_m is None and prior.y_m is None and prior.z_m is None:
            yield f"prior.{edge}", "names no component, but must give x_m, y_m or z_m"


def _camera_contradictions(camera: CameraTable) -> Iterator[tuple[str, str]]:
    counts = _COEFFICIENTS[camera.model]
    if camera.distortion is not None and len(camera.distortion) not in counts:
        needed = " or ".join(map(str, counts))
        padding = " (write 0 for those that are not used)"
        yield (
            "camera.distortion",
            f'has {len(camera.distortion)} coefficients, but the "{camera.model}" model needs '
            f"{needed}{padding if len(camera.distortion) < max(counts) else ''}",
        )
    if camera.matrix is not None:
        if camera.distortion is None:
            yield "camera.distortion", "is missing beside camera.matrix: give both or neither"
        if camera.resolution is None:
            yield "camera.resolution", "is missing: camera.matrix holds for one resolution only"
        for place, letter in enumerate(("fx", "fy")):
            if camera.matrix[place] <= 0:
                yield (
                    f"camera.matrix[{place}]",
                    f"is {camera.matrix[place]!r}, but {letter} must be above 0",
                )
    elif camera.distortion is not None:
        yield "camera.matrix", "is missing beside camera.distortion: give both or neither"


def declaration_warnings(declaration: Declaration, label: str) -> Iterator[str]:
    """Words what is allowed but suspicious: unknown keys, a principal point off the image."""
    yield from _unknown_keys(declaration, "", label)
    for edge in declaration.prior:
        if edge not in _EDGES:
            hint = did_you_mean(edge, _EDGES)
            yield f"{label}: prior.{edge} is no unknown edge and is ignored. {hint}".strip()
    camera = declaration.camera
    if camera is not None and camera.matrix is not None and camera.resolution is not None:
        (width, height), (_, _, cx, cy) = camera.resolution, camera.matrix
        if not (0 < cx < width and 0 < cy < height):
            yield (
                f"{label}: camera.matrix puts the principal point at ({cx:g}, {cy:g}) px, outside "
                f"the image of {width} x {height} px. Check the order fx, fy, cx, cy and that the "
                "matrix belongs to this resolution."
            )


def _unknown_keys(table: BaseModel, path: str, label: str) -> Iterator[str]:
    fields = type(table).model_fields
    known = [field.alias or name for name, field in fields.items()]
    for key in table.model_extra or {}:
        hint = did_you_mean(key, known)
        yield f"{label}: {path}{key} is not a known field and is ignored. {hint}".strip()
    for name in fields:
        value = getattr(table, name)
        if isinstance(value, BaseModel):
            yield from _unknown_keys(value, f"{path}{name}.", label)
        elif name in ("prior", "targets"):
            for key, entry in cast(Mapping[str, BaseModel], value).items():
                yield from _unknown_keys(entry, f"{path}{name}.{key}.", label)
