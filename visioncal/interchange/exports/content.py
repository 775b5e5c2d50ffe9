"""Transforms that can be exported, their selection, formats, and the content that they write."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
import yaml

from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.number_format import did_you_mean, figure, known_name
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.frames.naming import PARENTS, FrameKind
from visioncal.interchange.selection import Load, Selection
from visioncal.results import Calibration, CameraResult, Edge, Frame, FrameFile, Verdict
from visioncal.results.conditions import Condition
from visioncal.session.frames import frames_of_kind

Source: TypeAlias = Calibration | FrameFile

# Name of the camera's or the instrument's transform by its mount.
HAND_EYE: Mapping[Mount, str] = {
    "eye-in-hand": "flange_from_cam",
    "eye-to-hand": "base_from_cam",
    "instrument": "base_from_instrument",
}
_COMMANDS: Mapping[str, str] = {"tool": "visioncal tcp", "fixture": "visioncal fixture"}


@dataclass(frozen=True, eq=False)
class Placement:
    """One transform of a source."""

    edge: Edge  # `parent_from_child`.
    origin: str
    verdict: Verdict
    oriented: bool = True  # Whether its rotation was measured.
    rotation_of: str = ""  # The frame whose rotation was copied otherwise; empty for its parent's.
    conditions: tuple[Condition, ...] = ()  # Under which it holds.


@dataclass(frozen=True, eq=False)
class Placements:
    """All transforms of a source, and its camera."""

    by_name: Mapping[str, Placement]
    frames: tuple[str, ...]  # Names of the tools' and fixtures' transforms.
    words: str  # The kind of source, for messages.
    mount: Mount | None  # How the camera is mounted; None where there is no calibration.
    lens: CameraResult | None
    # The result of a cell, which relates any two of its frames; None for other sources.
    cell: Calibration | None = None
    lenses: Mapping[str, CameraResult] = field(default_factory=dict)  # Its cameras by frame.

    def find(self, name: str) -> tuple[Placement, tuple[str, str]]:
        """Finds a transform by its name, with our names of its parent and child.

        Raises:
            DataError: There is none, or it depends on a robot's pose.
        """
        ends = ends_of(name)
        if name in self.by_name and all(ends):
            return self.by_name[name], ends
        if self.cell is not None and all(ends):
            return _between(self.cell, *ends), ends
        inverse = f"{ends[1]}_from_{ends[0]}"
        hint = did_you_mean(name, self.by_name)
        if inverse in self.by_name:
            hint = f"Ask for --edge {inverse} --inverse."
        raise DataError(
            f"The transform {name!r} must be one of {self.words}: {', '.join(self.by_name)}.",
            culprits=[name],
            next_step=hint,
        )

    def chosen(self, holds: "Holds") -> str:
        """Name of the transform of a format, where none is stated: the only one that fits.

        Raises:
            DataError: There is none, or there are several.
        """
        wanted, names = "transform", self.frames
        if holds == "tool" or holds == "fixture":
            wanted, names = holds, tuple(name for name in names if is_kind(name, holds))
        elif self.mount is not None:
            return HAND_EYE[self.mount]
        elif self.cell is not None:
            # Transforms of the cell itself never depend on a robot's pose.
            names = tuple(sorted(self.by_name, key=lambda name: "_from_cam" not in name))
        if len(names) == 1:
            return names[0]
        has = f"it has {', '.join(names or self.by_name) or 'no frames'}"
        raise DataError(
            f"{self.words.capitalize()} has {len(names) or 'no'} {wanted}s, and one is written: "
            f"{has}.",
            culprits=names or ["--edge"],
            next_step=f"Name it, as --edge {names[0]}."
            if names
            else f"Find one with {_COMMANDS[holds]}, or name another transform with --edge."
            if holds in _COMMANDS
            else "",
        )


def ends_of(name: str) -> tuple[str, str]:
    """Names of a transform's parent and child; empty where the name has none."""
    parent, _, child = name.partition("_from_")
    return parent, child


def is_camera(frame: str) -> bool:
    """Whether a frame, by our name, is a camera's optical frame, of images or of depth."""
    return frame == "depth" or bool(frames_of_kind((frame,), "camera"))


def is_kind(name: str, kind: FrameKind) -> bool:
    """Whether a transform is a tool's pose on a flange, or a fixture's in a base."""
    # The parent by our names: flange, flange_2, ...
    return ends_of(name)[0].partition("_")[0] == PARENTS[kind]


def placements(source: Source, camera: str | None = None) -> Placements:
    """Lists the transforms of a source; `camera` selects one of a cell, by name or frame.

    Raises:
        DataError: There is no such camera.
    """
    frames = {name: _of_frame(frame) for name, frame in source.frames.items()}
    cell = source.cell if isinstance(source, Calibration) else None
    if isinstance(source, FrameFile):
        return Placements(frames, tuple(frames), "this file of frames", None, None)
    if cell is None:
        origin = f"calibrated by visioncal from {source.session_name!r}, {source.created}"
        holds = source.conditions
        edges = {
            name: Placement(edge, origin, source.verdict, edge.oriented, conditions=holds)
            for name, edge in source.edges.items()
        }
        edges |= _of_depth(source, edges)
        by_name = edges | {name: replace(one, conditions=holds) for name, one in frames.items()}
        words = "this calibration"
        return Placements(by_name, tuple(frames), words, source.mount, source.camera)
    # The reference and the cell are one frame; two frames would split the tree.
    tree, lenses = source.tree, cell.lenses
    edges = {
        f"{parent}_from_{name}": _in_cell(source, tree.edge_of(name))
        for name, parent in tree.parents.items()
        if name not in tree.flanges
    }
    lens = next(iter(lenses.values())) if len(lenses) == 1 else None
    if camera is not None:
        frame = camera if camera in lenses else f"cam_{camera}"
        lens = lenses[known_name("camera", frame, lenses, "--camera", of="This cell")]
    return Placements(edges | frames, tuple(frames), "this cell", None, lens, source, lenses)


def _of_depth(source: Calibration, edges: Mapping[str, Placement]) -> dict[str, Placement]:
    """The camera of depth beside that of the images: in this one's frame, and in its parent's."""
    model = None if source.camera is None else source.camera.depth
    if model is None or model.by is None or source.mount is None:
        return {}
    on_camera = edges[HAND_EYE[source.mount]]
    pose, origin = model.by.cam_from_depth, f"stated in session {source.session_name!r}"
    stated = Edge(pose, np.diag(np.repeat(model.by.sigmas, 3) ** 2))
    # T exp(x) D exp(y) = T D exp(adjoint(D^-1) x + y).
    carried = adjoint(invert(pose))
    covariance = carried @ on_camera.edge.covariance @ carried.T + stated.covariance
    placed = Edge(on_camera.edge.matrix @ pose, covariance)
    parent = HAND_EYE[source.mount].removesuffix("cam")
    return {
        f"{parent}depth": replace(on_camera, edge=placed),
        "cam_from_depth": replace(on_camera, edge=stated, origin=origin),
    }


def worst_of(verdicts: Iterable[Verdict]) -> Verdict:
    """The first of the worst verdicts."""
    return min(verdicts, key=lambda verdict: ("bad", "check", "good").index(verdict.status))


def _in_cell(source: Calibration, edge: Edge) -> Placement:
    origin = f"calibrated by visioncal from {source.session_name!r}, {source.created}"
    return Placement(edge, origin, source.verdict, conditions=source.conditions)


def _between(source: Calibration, first: str, second: str) -> Placement:
    """Relates two frames of a cell, with the worst verdict of the cell and their placements."""
    tree = source.tree
    placement = _in_cell(source, tree.between(first, second))
    for parent, frame in filter(None, (tree.placement(first), tree.placement(second))):
        origin = f"{placement.origin}; {_of_frame(frame).origin}"
        verdict = worst_of((placement.verdict, frame.verdict))
        placement = replace(placement, origin=origin, verdict=verdict)
        if not frame.oriented:
            placement = replace(placement, oriented=False, rotation_of=parent)
    return placement


def _of_frame(frame: Frame) -> Placement:
    origin = f"calibrated by visioncal from {frame.source!r}, {frame.created}: {frame.method}"
    return Placement(frame.edge, origin, frame.verdict, frame.oriented)


_OF_LENS = "it goes with the lens of that calibration, and with no other"
# Any transform; the camera's own, not inverted; the lens only; a pose on the flange; or one in the
# base.
Holds: TypeAlias = Literal["any edge", "hand-eye", "lens", "tool", "fixture"]
# Fields of a selection that select a part of a cell, and those of any transform.
_PARTS = ("camera", "robot", "target")
OF_TRANSFORMS = ("edge", "inverse", "parent", "child", "child_from_cam")
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False, kw_only=True)
class Content(Placement):
    """Content for a format of transforms or lenses: `parent_from_child`."""

    name: str  # Name of the transform in the result.
    parent: str  # Exported name of the parent frame.
    child: str  # Exported name of the child frame, whose pose in the parent it is.
    frames: tuple[str, str]  # Our own names of parent and child.
    mount: Mount | None
    lens: CameraResult | None  # The camera, where there is one.
    camera: Camera | None  # The same as exported, and what a poorer model leaves of it, in words.
    poorer: str = ""
    # Where a camera's child is not the optical frame, that frame's pose in it, in words.
    optical: str = ""
    number: int | None = None  # Of the controller's tool or base.
    load: Load | None = None
    onto: str | None = None  # An existing document, all else of which is kept.

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) `parent_from_child` [m]."""
        return self.edge.matrix

    @property
    def field_error_words(self) -> str:
        """The part of a lens that matrix and coefficients leave out, in words; empty for none."""
        rms_px, most_px = (0.0, 0.0) if self.lens is None else self.lens.beyond_model_px()
        if rms_px < 0.01:
            return self.poorer
        return (f"{self.poorer}; " if self.poorer else "") + (
            "the lens departs from its model, and matrix and coefficients are those that come "
            f"nearest to it: they leave {figure(rms_px)} px rms where it was seen, "
            f"{figure(most_px)} px at the most (visioncal locate corrects that)"
        )

    @property
    def notes(self) -> list[str]:
        """Comment lines: the heading, and the conditions under which the content holds."""
        return [*self.heading, *(f"only where: {condition.words}" for condition in self.conditions)]

    @property
    def heading(self) -> list[str]:
        """Origin, quality and meaning of the transform, in lines."""
        sigma = f"sigma {self.edge.sigma_mm:.2g} mm"
        if self.oriented:
            sigma += f" and {self.edge.sigma_deg:.2g} deg"
        else:
            of = self.rotation_of if "_" in self.rotation_of else f"the {self.rotation_of}"
            sigma += f"; rotation taken from {of}, not measured"
        is_of_lens = self.lens is not None and (any(map(is_camera, self.frames)) or self.optical)
        return [
            self.origin,
            f"verdict {self.verdict.status}; {self.verdict.accuracy(sigma)}",
            *(doubt.words for doubt in self.verdict.findings[: self.verdict.status != "good"]),
            f"{self.name}, the pose of {self.child} in {self.parent}: p_parent = R p_child + t",
            *([self.optical] if self.optical else []),
            *([_OF_LENS] if is_of_lens else []),
        ]


@dataclass(frozen=True)
class Format(Generic[_T]):
    """A foreign format of a result."""

    name: str  # Its name on the command line.
    words: str  # Its description with its reader and units, in one line.
    write: Callable[[_T], str]  # Builds the document.
    takes: frozenset[str] = frozenset()  # Fields of the selection that apply to it; see `check`.
    # Warnings for its user before using the document, in sentences.
    warn: Callable[[_T], Iterable[str]] = field(default=lambda _: ())

    def check(self, selection: Selection, also: Collection[str] = ()) -> None:
        """Refuses options that are neither in `takes` nor in `also`; raises DataError."""
        names = [each.name for each in fields(Selection)]
        given = [name for name in names if getattr(selection, name) not in (None, False)]
        unused = [
            f"--{name.replace('_', '-').removeprefix('calibration-')}"
            for name in given
            if name not in (*self.takes, *also, *_PARTS)
        ]
        if unused:
            raise DataError(
                f"{self.name} has no place for {', '.join(unused)}.",
                culprits=unused,
                next_step="Leave it out.",
            )


@dataclass(frozen=True)
class ExportFormat(Format[Content]):
    """A foreign format of a transform or a lens."""

    holds: Holds = "any edge"
    has_comments: bool = True  # Otherwise the heading of what is written is printed beside it.
    # Its names of our frames; a frame that is missing keeps our name.
    frames: Mapping[str, str] = field(default_factory=dict)
    # Builds the document of all transforms of a cell; None where it holds one.
    write_all: Callable[[Sequence[Content]], str] | None = None


def camera_of(content: Content) -> Camera:
    """The camera of a format of lenses; raises DataError where there is none."""
    if content.camera is None:
        raise DataError(
            "This calibration has no camera: its session brought measured poses of the target, "
            "and no images. A lens is calibrated with images.",
            culprits=["calibration.json: camera"],
            next_step="Export its transform, as with --to ros.",
        )
    return content.camera


def lens_notes(content: Content) -> list[str]:
    """Comment lines of a lens: origin, verdict, and what its model leaves."""
    estimated = content.lens is not None and content.lens.estimated
    how = "estimated from the session's images" if estimated else "as the session gave it"
    said = f"verdict {content.verdict.status}; the lens is {how}"
    return [*filter(None, (content.origin, said, content.field_error_words))]


def warn_of_field(content: Content) -> list[str]:
    """Warns of the remaining error of a lens with a field."""
    return [f"{content.field_error_words}."] * bool(content.field_error_words)


LENS_FORMAT = partial(
    ExportFormat,
    holds="lens",
    frames={"cam": "camera"},
    takes=frozenset({"lens"}),
    warn=warn_of_field,
)


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


def xml_comments(indent: str, lines: Iterable[str]) -> str:
    """Writes lines as comments of XML, which end at two hyphens."""
    plain = (re.sub("-(?=-)", "- ", one_line(line)) for line in lines)
    return "".join(f"{indent}<!-- {line} -->\n" for line in plain)


def yaml_text(document: dict[str, Any], *, short_lists: bool = False) -> str:
    """Writes YAML in the order given; `short_lists` puts lists of numbers on one line."""
    style = None if short_lists else False
    return yaml.safe_dump(
        document, sort_keys=False, default_flow_style=style, width=float("inf"), allow_unicode=True
    )
