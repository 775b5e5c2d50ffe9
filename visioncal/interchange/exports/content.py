"""Selection of what to export, formats, and the content that they write."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import yaml

from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray, Mount
from visioncal.results import CameraResult, Edge, Verdict
from visioncal.results.conditions import Condition
from visioncal.results.lens import RefittedLens, fit_coefficients

_OF_LENS = "it goes with the lens of that calibration: for other intrinsics, export it with --lens"
# Any transform; the camera's own, not inverted; the lens only; a pose on the flange; or one in the
# base.
Holds: TypeAlias = Literal["any edge", "hand-eye", "lens", "tool", "fixture"]
# Options that apply to formats: to all of transforms, and to some formats.
OfTransforms: TypeAlias = Literal["edge", "inverse", "parent", "child", "lens"]
Takes: TypeAlias = (
    OfTransforms | Literal["number", "load", "convention", "hash", "with-corrections"]
)
_OPTIONS: Mapping[Takes, str] = {"load": "--mass-kg and --cog-mm"}
_T = TypeVar("_T")


@dataclass(frozen=True)
class Load:
    """A tool's load, which no calibration determines."""

    mass_kg: float
    centre_mm: tuple[float, float, float]  # Its centre of mass in the flange's frame.


@dataclass(frozen=True)
class Selection:
    """What to export; None leaves the choice to the format."""

    # A transform by name; None for the camera's, or in a format of tools or fixtures for the only
    # one of its kind.
    edge: str | None = None
    inverse: bool = False
    parent: str | None = None  # Exported name of the frame in which the pose is given.
    # Exported name of the frame whose pose it is; the camera, in a format of lenses.
    child: str | None = None
    number: int | None = None  # Number of the controller's tool or base.
    load: Load | None = None
    convention: str | None = None
    calibration_hash: str | None = None  # The `hash` of a UR's own kinematics.
    camera: str | None = None  # Which camera of a cell is meant, in a format of lenses.
    # Which robot of a cell: its part is exported as of one camera and robot.
    robot: str | None = None
    target: str | None = None  # Which target of a cell; likewise.
    with_corrections: bool = False  # Whether the table of joint corrections is used with the arm.
    # A file with the lens of the receiving program, for which the camera's transform is written;
    # None for the calibration's own.
    lens: Path | None = None


@dataclass(frozen=True, eq=False)
class Content:
    """Content for a format of transforms or lenses."""

    name: str  # Name of the transform in the result.
    # `parent_from_child`: its translation and rotation are the child's pose in the parent.
    edge: Edge
    parent: str  # Exported name of the parent frame.
    child: str  # Exported name of the child frame.
    frames: tuple[str, str]  # Our own names of parent and child.
    mount: Mount | None
    lens: CameraResult | None  # The camera, where there is one.
    origin: str  # Where the result comes from, in one line.
    verdict: Verdict
    conditions: tuple[Condition, ...] = ()  # Under which the transform holds.
    # Our name of the frame whose rotation was copied; None where it was measured.
    rotation_of: str | None = None
    number: int | None = None  # Of the controller's tool or base.
    load: Load | None = None

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) `parent_from_child` [m]."""
        return self.edge.matrix

    @cached_property
    def refitted_lens(self) -> RefittedLens | None:
        """The lens refitted without its field; None where there is no camera."""
        return None if self.lens is None else fit_coefficients(self.lens)

    @property
    def field_error_words(self) -> str:
        """Remaining error of the refitted lens, in words; empty where the lens has no field."""
        lens = self.refitted_lens
        if lens is None or lens.rms_px == 0.0:
            return ""
        return (
            "the lens departs from its model, and matrix and coefficients are those that come "
            f"nearest to it: they leave {figure(lens.rms_px)} px rms where it was seen, "
            f"{figure(lens.most_px)} px at the most (visioncal locate corrects that)"
        )

    @property
    def notes(self) -> list[str]:
        """Comment lines: origin, quality, meaning of the transform, and its conditions."""
        sigma = f"sigma {self.edge.sigma_mm:.2g} mm"
        if self.rotation_of is None:
            sigma += f" and {self.edge.sigma_deg:.2g} deg"
        else:
            of = self.rotation_of if "_" in self.rotation_of else f"the {self.rotation_of}"
            sigma += f"; rotation taken from {of}, not measured"
        is_of_lens = self.lens is not None and any(frame.startswith("cam") for frame in self.frames)
        return [
            self.origin,
            f"verdict {self.verdict.status}; {sigma}",
            f"{self.name}, the pose of {self.child} in {self.parent}: p_parent = R p_child + t",
            *([_OF_LENS] if is_of_lens else []),
            *(f"only where: {condition.words}" for condition in self.conditions),
        ]


@dataclass(frozen=True)
class Format(Generic[_T]):
    """A foreign format of a result."""

    name: str  # Its name on the command line.
    words: str  # Its description with its reader and units, in one line.
    write: Callable[[_T], str]  # Builds the document.
    takes: frozenset[Takes] = frozenset()  # Options that apply to it; see `check`.
    # What its user should know or do before using the document, in sentences.
    warn: Callable[[_T], Iterable[str]] = field(default=lambda _: ())

    def check(self, selection: Selection, also: Collection[str] = ()) -> None:
        """Refuses options that do not apply to the format.

        Args:
            selection: The user's selection.
            also: Options that apply beside `takes`.

        Raises:
            DataError: An option does not apply.
        """
        options: Mapping[Takes, object] = {
            "edge": selection.edge,
            "inverse": selection.inverse,
            "parent": selection.parent,
            "child": selection.child,
            "number": selection.number,
            "load": selection.load,
            "convention": selection.convention,
            "hash": selection.calibration_hash,
            "with-corrections": selection.with_corrections,
            "lens": selection.lens,
        }
        given = [name for name, option in options.items() if option not in (None, False)]
        unused = [name for name in given if name not in (*self.takes, *also)]
        if unused:
            raise DataError(
                f"{self.name} has no place for "
                f"{', '.join(_OPTIONS.get(name, f'--{name}') for name in unused)}.",
                culprits=[f"--{name}" for name in unused],
                next_step="Leave it out.",
            )


@dataclass(frozen=True)
class ExportFormat(Format[Content]):
    """A foreign format of a transform or a lens."""

    holds: Holds = "any edge"
    # Its names of our frames; a frame that is missing keeps our name.
    frames: Mapping[str, str] = field(default_factory=dict)
    counterpart: str = ""  # The maker's format of fixtures, for one of tools; and vice versa.
    # Builds the document of all transforms of a cell; None where it holds one.
    write_all: Callable[[Sequence[Content]], str] | None = None
    carries_lens: bool = False  # Whether the camera's own lens is written with its transform.


def numbers(values: FloatArray) -> list[float]:
    """Converts an array to plain floats, whose text reads back as the same doubles."""
    # Negative zeros are written as zero.
    return [float(value) + 0.0 for value in values.ravel()]


def rows(matrix: FloatArray) -> list[list[float]]:
    """Converts (n, m) numbers to n lists of plain floats."""
    return [numbers(row) for row in matrix]


def comments(mark: str, lines: Iterable[str]) -> str:
    """Writes lines as comments, each behind `mark`; no text can end its comment early."""
    return "".join(f"{mark} {one_line(line)}\n" for line in lines)


def yaml_text(document: dict[str, Any], *, short_lists: bool = False) -> str:
    """Writes YAML in the order given; `short_lists` puts lists of numbers on one line."""
    style = None if short_lists else False
    return yaml.safe_dump(
        document, sort_keys=False, default_flow_style=style, width=float("inf"), allow_unicode=True
    )
