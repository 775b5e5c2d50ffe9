"""What is asked for of a result, what a format is, and what it then writes."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import yaml

from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray, Mount
from visioncal.results import CameraResult, Edge, Verdict
from visioncal.results.lens import RefittedLens, refitted

_OF_LENS = "it goes with the lens of that calibration: with other intrinsics, use its ray_frame"
# Any transform; the camera's alone, in its own direction; the lens alone; where something sits on
# the flange; or where something stands in the base.
Holds: TypeAlias = Literal["any edge", "hand-eye", "lens", "tool", "fixture"]
# What of a selection formats have a use for, by its options: of transforms, and of some forms.
OfTransforms: TypeAlias = Literal["edge", "inverse", "parent", "child"]
Takes: TypeAlias = (
    OfTransforms | Literal["number", "load", "convention", "hash", "onto", "with-corrections"]
)
_OPTIONS: Mapping[Takes, str] = {"load": "--mass-kg and --cog-mm"}
_T = TypeVar("_T")


@dataclass(frozen=True)
class Load:
    """What a tool weighs, which no calibration determines.

    Attributes:
        mass_kg: Its mass.
        centre_mm: Where its centre of mass is in the flange's frame.
    """

    mass_kg: float
    centre_mm: tuple[float, float, float]


@dataclass(frozen=True)
class Selection:
    """What to export; what is None is left to the format.

    Attributes:
        edge: A transform by name; None for the camera's, or in a format of tools or fixtures for
            the only one of its kind.
        inverse: Whether its inverse is wanted.
        parent: What to call the frame in which the pose is given.
        child: What to call the frame whose pose it is; the camera, in a format of lenses.
        number: Which of the controller's tools or bases it becomes.
        load: What the tool weighs.
        convention: In which form the joints of an arm are tabulated.
        calibration_hash: The `hash` of a UR's own kinematics.
        onto: The document of the reader's own that is to be written onto.
        camera: Which camera of a whole cell is meant, in a format of lenses.
        robot: Which robot of a whole cell: its part of it is exported as of one camera and robot.
        target: Which target of a whole cell; likewise.
        with_corrections: Whether the table of joints' corrections goes with the arm.
    """

    edge: str | None = None
    inverse: bool = False
    parent: str | None = None
    child: str | None = None
    number: int | None = None
    load: Load | None = None
    convention: str | None = None
    calibration_hash: str | None = None
    onto: str | None = None
    camera: str | None = None
    robot: str | None = None
    target: str | None = None
    with_corrections: bool = False

    @property
    def said(self) -> tuple[Takes, ...]:
        """What was asked for beside which camera, robot and target are meant."""
        options: Mapping[Takes, object] = {
            "edge": self.edge,
            "inverse": self.inverse,
            "parent": self.parent,
            "child": self.child,
            "number": self.number,
            "load": self.load,
            "convention": self.convention,
            "hash": self.calibration_hash,
            "onto": self.onto,
            "with-corrections": self.with_corrections,
        }
        return tuple(name for name, option in options.items() if option not in (None, False))


@dataclass(frozen=True, eq=False)
class Content:
    """What a format writes.

    Attributes:
        name: Which transform of the result it is.
        edge: `parent_from_child`: its translation and rotation are the child's pose in the parent.
        parent: Name of the parent's frame, as its readers know it.
        child: Name of the child's frame likewise.
        frames: Our own names of parent and child.
        mount: How the camera is mounted; None for a frame that belongs to no calibration.
        lens: The camera, where there is one.
        origin: Where the result comes from, in one line.
        verdict: Whether it can be trusted.
        rotation_of: Our name of the frame whose rotation was taken over unmeasured; None where
            the rotation was measured.
        number: Which of the controller's tools or bases it becomes, where that was said.
        load: What the tool weighs, where that was said.
        onto: The document that is to be written onto, where there is one.
    """

    name: str
    edge: Edge
    parent: str
    child: str
    frames: tuple[str, str]
    mount: Mount | None
    lens: CameraResult | None
    origin: str
    verdict: Verdict
    rotation_of: str | None = None
    number: int | None = None
    load: Load | None = None
    onto: str | None = None

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) `parent_from_child` [m]."""
        return self.edge.matrix

    @cached_property
    def plain_lens(self) -> RefittedLens | None:
        """The lens as matrix and coefficients say it; None where there is no camera."""
        return None if self.lens is None else refitted(self.lens)

    @property
    def left_of_field(self) -> str:
        """What matrix and coefficients leave of what the lens does beyond them; else empty."""
        lens = self.plain_lens
        if lens is None or lens.rms_px == 0.0:
            return ""
        return (
            "the lens departs from its model, and matrix and coefficients are those that come "
            f"nearest to it: they leave {figure(lens.rms_px)} px rms where it was seen, "
            f"{figure(lens.most_px)} px at the most (visioncal locate corrects that)"
        )

    @property
    def quality(self) -> str:
        """The verdict and the sigma of the transform, in one line."""
        position = f"verdict {self.verdict.status}; sigma {self.edge.sigma_mm:.2g} mm"
        if self.rotation_of is None:
            return f"{position} and {self.edge.sigma_deg:.2g} deg"
        of = self.rotation_of if "_" in self.rotation_of else f"the {self.rotation_of}"
        return f"{position}; rotation taken from {of}, not measured"

    @property
    def direction(self) -> str:
        """What the transform does, in one line."""
        return f"{self.name}, the pose of {self.child} in {self.parent}: p_parent = R p_child + t"

    @property
    def notes(self) -> list[str]:
        """Lines for a comment: where it comes from, its quality, and what it does."""
        is_of_lens = self.lens is not None and any(frame.startswith("cam") for frame in self.frames)
        return [self.origin, self.quality, self.direction, *([_OF_LENS] if is_of_lens else [])]


@dataclass(frozen=True)
class Format(Generic[_T]):
    """A form in which others read a result.

    Attributes:
        name: As the command line has it.
        words: What it is and who reads it, with its units, in one line.
        write: Builds the document.
        takes: What of a selection it has a use for; see `check`.
        warn: What its user should know or do before the document serves, in sentences.
    """

    name: str
    words: str
    write: Callable[[_T], str]
    takes: frozenset[Takes] = frozenset()
    warn: Callable[[_T], Iterable[str]] = field(default=lambda _: ())

    def check(self, selection: Selection, also: Collection[str] = ()) -> None:
        """Refuses what it has no place for.

        Args:
            selection: What is asked for.
            also: What it has a use for beside what it takes.

        Raises:
            DataError: Something of the kind was said.
        """
        unused = [name for name in selection.said if name not in (*self.takes, *also)]
        if unused:
            raise DataError(
                f"{self.name} has no place for "
                f"{', '.join(_OPTIONS.get(name, f'--{name}') for name in unused)}.",
                culprits=[f"--{name}" for name in unused],
                next_step="Leave it out.",
            )


@dataclass(frozen=True)
class ExportFormat(Format[Content]):
    """A form in which others read a transform or a lens.

    Attributes:
        holds: What of a result it can hold.
        frames: What its readers call our frames; ours keep their names where it says nothing.
        counterpart: The maker's format of fixtures, for one of tools; and the other way round.
        write_all: Builds the document of all transforms of a cell; None where it holds one.
    """

    holds: Holds = "any edge"
    frames: Mapping[str, str] = field(default_factory=dict)
    counterpart: str = ""
    write_all: Callable[[Sequence[Content]], str] | None = None


def numbers(values: FloatArray) -> list[float]:
    """Turns an array into plain floats, whose text reads back as the same doubles."""
    # A negative zero would only raise questions.
    return [float(value) + 0.0 for value in values.ravel()]


def rows(matrix: FloatArray) -> list[list[float]]:
    """Turns (n, m) numbers into n lists of plain floats."""
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
