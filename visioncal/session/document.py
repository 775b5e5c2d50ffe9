"""Tables of session.toml: fields, types and ranges."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.choices import POSE_FORMS
from visioncal.core.codec import Check, Key, Lenient, Section, entries, one_of, read, within
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import compose
from visioncal.core.types import Camera, CameraKind, CameraMount, FloatArray, Need

# Limit that keeps squares and products from overflowing.
_LARGEST = 1e15
Number = Annotated[float, Check("a finite number up to 1e15", lambda value: abs(value) <= _LARGEST)]
# Plausible standard deviations of a focal length [px].
PixelSigma = Annotated[float, within(1e-3, 1e4)]
# Standard deviations of measured lengths [m] and angles [rad]: the least is a tenth of what the
# best measuring machines reach. Beside smaller ones nothing is left of the images' information.
MeasuredSigma = Annotated[float, within(1e-7, _LARGEST)]
NotNegative = Annotated[float, within(0.0, _LARGEST)]
Positive = Annotated[
    float, Check("a number above 0 and up to 1e15", lambda value: 0.0 < value <= _LARGEST)
]
# Largest side of an image: four times that of the largest sensors [px].
Side = Annotated[int, within(1, 65_535)]

_COEFFICIENTS: Mapping[str, tuple[int, ...]] = {"brown": (5, 8), "fisheye": (4,)}


def check_coefficients(model: str, count: int) -> None:
    """Checks the number of a lens's coefficients of distortion; raises ValueError."""
    if count not in (counts := _COEFFICIENTS[model]):
        raise ValueError(
            f'it has {count} coefficients of distortion, but the "{model}" model needs '
            f"{' or '.join(map(str, counts))} (0 for those that are not used)"
        )


@dataclass(frozen=True, kw_only=True)
class TableModel(Section):
    """A table of session.toml. Unknown keys, of newer versions or users, are in `further`."""


def _flat(value: object) -> object:
    """A list without the lists in it: cv2 has coefficients and matrices by rows."""
    if not isinstance(value, list):
        return value
    return [item for row in value for item in (row if isinstance(row, list) else [row])]


def _four(value: object) -> object:
    """fx, fy, cx, cy, also of cv2's 3 x 3 matrix, flat or by rows."""
    match _flat(value):
        case [fx, 0, cx, 0, fy, cy, 0, 0, 1] | [fx, fy, cx, cy]:
            return [fx, fy, cx, cy]
        case [fx, _, cx, _, fy, cy, x, y, _]:
            hint = f", as {[fx, fy, cx or x, cy or y]}"
        case _:
            hint = ""
    raise ValueError(f"it is {value}, but must be [fx, fy, cx, cy] [px]{hint}")


@dataclass(frozen=True, kw_only=True)
class CameraTable(TableModel):
    """`[camera]`. matrix: fx, fy, cx, cy [px]; resolution: width, height [px]."""

    name: str = "camera"
    resolution: tuple[Side, Side] | None = None
    # "points": it measures points (meas_x_m ...), as of a ball, and has no lens.
    seeing: Annotated[Literal["brown", "fisheye", "points"], Key("model")] = "brown"
    matrix: Annotated[tuple[Number, ...], Lenient(_four)] | None = None
    distortion: Annotated[tuple[Number, ...], Lenient(_flat)] | None = None
    intrinsics: Literal["auto", "hold", "refine"] = "auto"
    matrix_sigma_px: PixelSigma | None = None
    focus: Literal["auto", "fixed"] = "auto"
    # Of depth pictures: their unit [m], and whether they have distances along z or along the ray.
    depth_unit_m: Positive | None = None
    depth_of: Literal["z", "ray"] = "z"
    # Of measured poses (`cft_`): standard deviation of their scale, the size of the target.
    scale_sigma: Annotated[Positive, within(0.0, 0.2)] | None = None

    @property
    def model(self) -> CameraKind:
        """The model of the camera's lens."""
        return "brown" if self.seeing == "points" else self.seeing

    @property
    def stated(self) -> Camera | None:
        """The stated intrinsics; None where they are to be estimated."""
        if self.matrix is None or self.distortion is None or self.resolution is None:
            return None
        matrix, distortion = np.array(self.matrix), np.array(self.distortion)
        return Camera(self.model, self.resolution, matrix, distortion)

    def __post_init__(self) -> None:
        if self.distortion is not None:
            check_coefficients(self.model, len(self.distortion))
        if (self.matrix is None) != (self.distortion is None):
            raise ValueError("it has one of matrix and distortion: give both or neither")
        if self.matrix is not None and self.resolution is None:
            raise ValueError("it has no resolution, and its matrix holds for one alone")
        if self.matrix is not None and min(self.matrix[:2]) <= 0:
            raise ValueError(f"it has the matrix {[*self.matrix]}, but fx and fy must be above 0")
        # No lens of a camera sees more than 170 degrees without distortion.
        if self.matrix and min(self.matrix[:2]) < 0.04 * max(self.resolution or ()):
            raise ValueError(
                f"it has the matrix {[*self.matrix]}, but fx and fy are in pixels: the focal "
                "length over the side of a pixel, both in mm"
            )


@dataclass(frozen=True, kw_only=True)
class RobotTable(TableModel):
    """`[robot]`. model: a built-in name, or the path of a .urdf, a DH .toml or an arm's .json.

    Optional where poses are enough. form: the maker's form of poses, in which results are stated.
    gravity_m_s2: acceleration of gravity in the robot's base, for a base that is not upright.
    serial: its serial number, for a report on its accuracy by ISO 9283.
    """

    model: str | None = None
    tip: str | None = None
    form: Annotated[str, one_of(*POSE_FORMS)] | None = None
    gravity_m_s2: tuple[Number, Number, Number] | None = None
    serial: str | int | None = None


@dataclass(frozen=True, kw_only=True)
class InstrumentTable(TableModel):
    """`[instrument]`. Standard deviations of its readings [m], [m/m], [rad]; see `instruments`."""

    name: str = "instrument"
    sigma_m: MeasuredSigma | None = None
    sigma_per_m: NotNegative | None = None
    sigma_rad: MeasuredSigma | None = None


@dataclass(frozen=True, kw_only=True)
class ClockTable(TableModel):
    """`[clock]`. Offset of the camera's stamps from the robot's [s]; None for not stated."""

    camera_minus_robot_s: Number | None = None


def _is_place(at: object) -> bool:
    numbers = at if isinstance(at, list) else []
    are_numbers = len(numbers) == 3 and all(type(number) in (int, float) for number in numbers)
    return at == "views" or (are_numbers and all(abs(number) <= FAR_M for number in numbers))


@dataclass(frozen=True, kw_only=True)
class NeedTable(TableModel):
    """`[need]`. Required accuracy of picks [mm], [deg], and where; see `types.Need`."""

    mm: Positive | None = None
    deg: Positive | None = None
    corrected: bool = False
    at: Annotated[
        Any, Check(f'"views" or [x, y, z] in the base, in metres (under {FAR_M:g})', _is_place)
    ] = "views"

    @property
    def need(self) -> Need:
        """The typed need."""
        if self.at == "views":
            return Need(self.mm, self.deg, corrected=self.corrected)
        x, y, z = map(float, self.at)
        return Need(self.mm, self.deg, (x, y, z), self.corrected)

    def __post_init__(self) -> None:
        if self.mm is None and self.deg is None and not self.corrected:
            raise ValueError("it says neither mm nor deg: give how near picks have to come")


@dataclass(frozen=True, kw_only=True)
class PriorTable(TableModel):
    """`[prior.A_from_B]`. Measured components of B's position in A, with sigma_m [m].

    quaternion_xyzw: its rotation, with sigma_rad about each axis [rad].
    """

    x_m: Number | None = None
    y_m: Number | None = None
    z_m: Number | None = None
    sigma_m: MeasuredSigma | None = None
    quaternion_xyzw: tuple[Number, Number, Number, Number] | None = None
    sigma_rad: MeasuredSigma | None = None

    @property
    def pose(self) -> FloatArray | None:
        """(4, 4) all that is stated; None where a component is not."""
        if None in (self.x_m, self.y_m, self.z_m, self.quaternion_xyzw):
            return None
        turn = Rotation.from_quat(self.quaternion_xyzw or [])
        return compose(turn.as_matrix(), np.array([self.x_m, self.y_m, self.z_m], float))

    def __post_init__(self) -> None:
        turn, is_placed = self.quaternion_xyzw, {self.x_m, self.y_m, self.z_m} != {None}
        if not is_placed and turn is None:
            raise ValueError("it names no component: x_m, y_m or z_m, or quaternion_xyzw")
        if is_placed and self.sigma_m is None:
            raise ValueError("it has no sigma_m, the standard deviation of x_m, y_m and z_m")
        if (turn is None) != (self.sigma_rad is None):
            raise ValueError("it needs quaternion_xyzw and sigma_rad together, or neither")
        if turn is not None and not 0.9 < sum(value * value for value in turn) < 1.1:
            raise ValueError(f"it has quaternion_xyzw {[*turn]}, but its length must be 1")


_TARGET = "a name in targets/, or the path of a .toml"


@dataclass(frozen=True, kw_only=True)
class TargetTable(TableModel):
    """`[targets.NAME]`, one of several. target: a name in targets/, or the path of a .toml."""

    target: Annotated[str, Check(_TARGET)]


Kind: TypeAlias = Literal["camera", "robot", "target", "instrument"]
KINDS: tuple[Kind, ...] = ("camera", "robot", "target", "instrument")

# Names that can be part of a frame's name: base_from_target_NAME.
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_EDGES = (
    *("flange_from_cam", "base_from_target", "base_from_cam", "flange_from_target"),
    *("base_from_instrument", "flange_from_probe"),
)


def _short(field: str) -> Lenient:
    """Accepts `floor = "..."` for the table `[targets.floor]` with one field."""
    return Lenient(lambda value: {field: value} if isinstance(value, str) else value)


@dataclass(frozen=True, kw_only=True)
class Declaration(TableModel):
    """Typed content of session.toml. Unknown keys are kept in `further`.

    Of each kind there is one, in the singular table, or several by name, in the plural ones.
    frames: declared parents of frames; see `frames`. corrected: changes that `convert --guess`
    made, in sentences.
    """

    schema_version: Annotated[Literal[1], Key("schema")]
    name: str
    mount: CameraMount | None = None
    target: str | None = None
    targets: Mapping[str, Annotated[TargetTable, _short("target")]] = field(default_factory=dict)
    camera: CameraTable | None = None
    cameras: Mapping[str, CameraTable] = field(default_factory=dict)
    # The camera of depth pictures: `[cameras.depth]` beside `[camera]`.
    depth: CameraTable | None = None
    robot: RobotTable | None = None
    robots: Mapping[str, Annotated[RobotTable, _short("model")]] = field(default_factory=dict)
    instrument: InstrumentTable | None = None
    instruments: Mapping[str, Annotated[InstrumentTable, _short("name")]] = field(
        default_factory=dict
    )
    frames: Mapping[str, Any] = field(default_factory=dict)
    clock: ClockTable = ClockTable()
    clocks: Mapping[str, ClockTable] = field(default_factory=dict)
    prior: Mapping[str, PriorTable] = field(default_factory=dict)
    need: NeedTable | None = None
    corrected: tuple[str, ...] = ()

    def named(self, kind: Kind) -> dict[str, TableModel]:
        """Tables of a kind by name, which is empty for the singular table."""
        several: Mapping[str, TableModel] = getattr(self, f"{kind}s")
        if several:
            return dict(several)
        if kind == "target":
            return {} if self.target is None else {"": TargetTable(target=self.target)}
        only: TableModel | None = getattr(self, kind)
        return {} if only is None else {"": only}

    @property
    def is_network(self) -> bool:
        """Whether frames need names: several cameras, robots or instruments, or `[frames]`."""
        several = (self.cameras, self.robots, self.instruments)
        return bool(self.frames) or any(len(mapping) > 1 for mapping in several)

    @property
    def has_names(self) -> bool:
        """Whether frames have the names of cameras, robots or instruments."""
        return bool(self.frames or self.cameras or self.robots or self.instruments)

    @property
    def only_camera(self) -> CameraTable | None:
        """The only camera; None without or with several."""
        return self.camera if len(self.cameras) != 1 else next(iter(self.cameras.values()))

    @property
    def only_robot(self) -> RobotTable | None:
        """The only robot; None without or with several."""
        return self.robot if len(self.robots) != 1 else next(iter(self.robots.values()))


def read_declaration(document: Mapping[str, Any], *, observed: bool) -> Declaration:
    """Checks the content of a session.toml; raises DataError.

    `observed` says whether there are views, which need something that observed them.
    """
    content = dict(document)
    cameras = content.get("cameras")
    if "camera" in content and isinstance(cameras, Mapping) and cameras.keys() == {"depth"}:
        content |= {"cameras": {}, "depth": cameras["depth"]}
    try:
        declaration = read(Declaration, content, "")
        _check_consistent(declaration, observed)
    except DataError as error:
        message, *culprits = (f"session.toml: {part}" for part in (error.message, *error.culprits))
        raise error.but(message, culprits=culprits) from error
    return declaration


def _check_consistent(declaration: Declaration, observed: bool) -> None:
    """Checks that well-typed tables do not contradict each other."""
    if problems := dict(_contradictions(declaration, observed)):
        hints = [key for key in _unknown_keys(declaration) if "Did you mean" in key]
        words = "; ".join(f"{field} {words}" for field, words in problems.items())
        raise DataError(f"{words}.", culprits=[*problems], next_step=" ".join(hints))


def _contradictions(declaration: Declaration, observed: bool) -> Iterator[tuple[str, str]]:
    """Contradictions between well-typed tables: (dotted path, message)."""
    reads = declaration.instrument is not None or bool(declaration.instruments) or not observed
    implied = declaration.is_network or (reads and not declaration.named("camera"))
    if declaration.mount is None and not implied:
        yield "mount", 'is missing (mount = "eye-in-hand" or "eye-to-hand")'
    for kind in KINDS:
        several: Mapping[str, TableModel] = getattr(declaration, f"{kind}s")
        if several and getattr(declaration, kind) is not None:
            one = "target = ..." if kind == "target" else f"[{kind}]"
            yield (
                f"{kind}s",
                f"is there beside {kind}: give {one} for one, [{kind}s.NAME] for several",
            )
        for name in several:
            if not NAME.fullmatch(name):
                words = "is a name of other than letters, digits and _ after a letter"
                yield f"{kind}s.{name}", words
    for name in declaration.clocks:
        if name not in declaration.cameras:
            yield f"clocks.{name}", "is of no camera: [clocks.NAME] is for [cameras.NAME]"
    yield from _depth_problems(declaration)
    yield from _far_priors(declaration)


def _depth_problems(declaration: Declaration) -> Iterator[tuple[str, str]]:
    if declaration.depth is None:
        return
    if declaration.depth.stated is None:
        yield "cameras.depth", "has no resolution, matrix and distortion, but must have a lens"
    prior = declaration.prior.get("cam_from_depth")
    if prior is None or prior.pose is None:
        words = "is not stated whole, but must have x_m, y_m, z_m, quaternion_xyzw and sigmas"
        yield "prior.cam_from_depth", words


def _far_priors(declaration: Declaration) -> Iterator[tuple[str, str]]:
    for edge, prior in declaration.prior.items():
        on_flange = any(part.partition("_")[0] == "flange" for part in edge.split("_from_"))
        # Lengths that are written in millimetres exceed these [m].
        most, where = (3.0, "on a flange") if on_flange else (100.0, "in a cell")
        for axis in ("x_m", "y_m", "z_m"):
            place = getattr(prior, axis)
            if place is not None and abs(place) > most:
                words = f"is {place:g}, but is in metres, at most {most:g} {where}"
                yield f"prior.{edge}.{axis}", words


def declaration_warnings(declaration: Declaration) -> Iterator[str]:
    """Warnings: unknown keys, unknown priors, a principal point outside the image."""
    yield from _unknown_keys(declaration)
    edges = [*_EDGES, *(f"{edge}_{name}" for edge in _EDGES for name in declaration.targets)]
    edges += ["cam_from_depth"] * (declaration.depth is not None)
    for edge in declaration.prior:
        if not declaration.has_names and edge not in edges:
            hint = did_you_mean(edge, edges)
            yield f"session.toml: prior.{edge} names no unknown edge and is ignored. {hint}".strip()


def _unknown_keys(value: object, path: str = "") -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _unknown_keys(entry, f"{path}{key}.")
    if isinstance(value, TableModel):
        kind: type = type(value)
        known = [entry.key for entry in entries(kind)]
        for key in value.further:
            hint = did_you_mean(key, known)
            yield f"session.toml: {path}{key} is not a known field and is ignored. {hint}".strip()
        for name, part in vars(value).items():
            yield from _unknown_keys(part, f"{path}{name}.")
